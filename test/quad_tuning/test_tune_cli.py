"""`quad-tune design`: table, JSON, file, exit status and one line on stderr."""

import json

import pytest

from quad_sysid.report.model_file import save_models
from quad_tuning.cli import design_main, main


@pytest.fixture
def stored(tmp_path, model):
    path = tmp_path / 'model.json'
    save_models({'roll': model(), 'pitch': model('pitch', gain=-400.0)}, path)
    return path


def test_the_table_shows_before_and_after_and_one_refused_axis_is_no_failure(stored, capsys):
    assert main(['design', str(stored)]) == 0
    out, err = capsys.readouterr()
    assert err == ''
    assert 'roll.rate.kp' in out
    assert 'phase margin' in out
    assert 'pitch (pid): no gains: pitch: a positive command lowers the rate' in out
    row = next(line for line in out.splitlines() if 'RMS error' in line).split()
    assert float(row[-3]) > float(row[-2])


def test_json_and_file_hold_the_same(stored, tmp_path, capsys):
    out = tmp_path / 'gains.json'
    assert main(['design', str(stored), '--axis', 'roll', '--json', '--out', str(out)]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads(out.read_text())
    assert printed['schema'] == 'quad_tuning/design/1'
    assert set(printed['axes']) == {'roll'}
    assert printed['axes']['roll']['gains']['roll.angle.kp'] > 3.0


def test_steps_lead_to_the_target_and_the_use_of_effects_is_said(stored, capsys):
    assert main(['design', str(stored), '--axis', 'roll', '--json']) == 0
    answer = json.loads(capsys.readouterr().out)['axes']['roll']
    assert answer['steps'][-1] == answer['target'] == answer['gains']
    assert len(answer['steps']) >= 2
    assert answer['effects_used'][0]['name'] == 'bias_torque'
    assert main(['design', str(stored), '--axis', 'roll']) == 0
    assert f'makes {len(answer["steps"])} updates of it' in capsys.readouterr().out


def test_pictures_are_drawn_for_the_axis_that_has_gains(stored, tmp_path, capsys):
    folder = tmp_path / 'pictures'
    assert main(['design', str(stored), '--pictures', str(folder)]) == 0
    capsys.readouterr()
    names = sorted(path.name for path in folder.iterdir())
    assert names == ['roll_bode.png', 'roll_nyquist.png', 'roll_step.png']
    assert all(path.read_bytes().startswith(b'\x89PNG') for path in folder.iterdir())
    (tmp_path / 'file').touch()
    assert main(['design', str(stored), '--pictures', str(tmp_path / 'file')]) == 2
    assert 'file' in capsys.readouterr().err


def test_brysons_weights_are_options(stored, capsys):
    rise = []
    for given in ([], ['--max-rate', '0.3']):
        arguments = ['design', str(stored), '--method', 'lqr', '--axis', 'roll', '--json']
        assert main([*arguments, *given]) == 0
        answer = json.loads(capsys.readouterr().out)['axes']['roll']
        rise.append(answer['figures']['rise_time_s'])
    assert rise[1] > 1.2 * rise[0]
    with pytest.raises(SystemExit) as left:
        main(['design', str(stored), '--method', 'lqr', '--max-angle', '-1'])
    assert left.value.code == 2
    assert 'must be a positive number' in capsys.readouterr().err


def test_lqr_by_the_ros_name_of_the_command(stored, capsys):
    assert design_main([str(stored), '--method', 'lqr', '--axis', 'roll', '--json']) == 0
    answer = json.loads(capsys.readouterr().out)['axes']['roll']
    assert answer['gains']['roll.lqr.share'] == 1.0
    assert len(answer['gains']) == 10
    assert main(['design', str(stored), '--method', 'lqr', '--axis', 'roll']) == 0
    assert 'roll.lqr.k_angle' in capsys.readouterr().out


@pytest.mark.parametrize(
    ('arguments', 'status', 'said'),
    [
        (['--axis', 'pitch'], 3, 'lowers the rate'),
        (['--axis', 'pitch', '--method', 'lqr'], 3, 'lowers the rate'),
        (['--axis', 'yaw'], 2, 'holds no model of yaw'),
        (['--out', 'no/such/folder/x.json'], 2, 'cannot be written'),
    ],
)
def test_exit_status_and_the_one_line(stored, capsys, arguments, status, said):
    assert main(['design', str(stored), *arguments]) == status
    err = capsys.readouterr().err
    assert said in err
    assert err.count('\n') == 1


def test_bad_files_and_arguments(tmp_path, capsys):
    assert main(['design', str(tmp_path / 'none.json')]) == 2
    assert 'none.json' in capsys.readouterr().err
    with pytest.raises(SystemExit) as left:
        main(['design'])
    assert left.value.code == 2
    assert capsys.readouterr().err.count('\n') == 1
