"""`quad-tune design`: table, JSON, file, exit status and one line on stderr."""

import json
from pathlib import Path

import numpy as np
import pytest

from quad_sysid.bags import write_bag
from quad_sysid.record import Record
from quad_sysid.report.model_file import save_models
from quad_tuning.cli import main, ros2


@pytest.fixture
def stored(tmp_path, model):
    path = tmp_path / 'model.json'
    save_models({'roll': model(), 'pitch': model('pitch', gain=-400.0)}, path)
    return str(path)


@pytest.fixture
def shaken(tmp_path):
    """A bag of a flight in which the frame shakes at 70 Hz."""
    t = np.arange(2500) * 0.004
    rates = 0.02 * np.random.default_rng(1).standard_normal((t.size, 3))
    rates[:, 0] += 0.8 * np.sin(2.0 * np.pi * 70.0 * t)
    still, hover = np.zeros_like(rates), np.full((t.size, 4), 0.4)
    return str(write_bag(Record(
        source='shaken', dt=0.004, rates=rates, control=hover * (1.0, 0.0, 0.0, 0.0),
        angles=still, motors=hover, attitude_setpoint=still, rate_setpoint=still,
    ), tmp_path / 'shaken'))  # fmt: skip


@pytest.mark.usefixtures('quick')
def test_table_and_file_tell_the_same(stored, shaken, tmp_path, capsys):
    file = tmp_path / 'gains.json'
    assert main(['design', stored, '--flight', shaken, '--out', str(file)]) == 0
    tree = json.loads(file.read_text())
    roll, (notch,) = tree['axes']['roll'], tree['notches']
    assert notch['frequency_hz'] == pytest.approx(70.0, abs=1.0)
    assert f'{notch["place"]}_hz' in notch['gains']
    assert roll['gains']['roll.angle.kp'] > 3.0
    assert roll['steps'][-1] == roll['target'] == roll['gains']
    assert len(roll['steps']) >= 2
    out, err = capsys.readouterr()
    assert err == ''
    for words in (
        'roll.rate.kp', 'phase margin', f'applies it in {len(roll["steps"])} steps, 3 s apart',
        'pitch (pid): no gains: pitch: a positive command lowers the rate',
    ):
        assert words in out
    row = next(line for line in out.splitlines() if 'tracking error' in line).split()
    assert float(row[-3]) > float(row[-2])


@pytest.mark.usefixtures('quick')
def test_lqr_by_the_ros_name_of_the_command_with_brysons_weights(
    stored, tmp_path, printed, capsys, monkeypatch
):
    words, file = (stored, '--axis', 'roll', '--method', 'lqr'), tmp_path / 'slow.json'
    monkeypatch.setattr('sys.argv', ['lib/design', *words, '--json'])
    assert ros2() == 0
    tree = json.loads(capsys.readouterr().out)
    assert (tree['schema'], set(tree['axes'])) == ('quad_tuning/design/1', {'roll'})
    plain = tree['axes']['roll']
    assert (plain['gains']['roll.lqr.share'], len(plain['gains'])) == (1.0, 10)
    said = printed(main, 'design', *words, '--max-rate', 0.3, '--out', file)
    assert 'roll.lqr.k_angle' in said
    slow = json.loads(file.read_text())['axes']['roll']
    assert slow['figures']['rise_time_s'] > 1.2 * plain['figures']['rise_time_s']


@pytest.mark.parametrize(
    ('part', 'row', 'value', 'field'),
    [
        ('base', 1, -0.04, 'base.lag.value'), ('base', 2, -0.004, 'base.delay.value'),
        ('covariance', 1, -1e-6, 'covariance.lag'),
    ],
)
def test_what_no_plant_can_be_is_the_fault_of_a_field(stored, refused, part, row, value, field):
    tree = json.loads(Path(stored).read_text())
    entry = tree['axes']['roll'][part][row]
    entry['value' if part == 'base' else row] = value
    Path(stored).write_text(json.dumps(tree))
    assert refused(main, 'design', stored, '--axis', 'roll') == (
        f'quad-tune: {stored}: axes.roll.{field}: must not be negative: found {value}; identify '
        'again with this version\n'
    )


@pytest.mark.parametrize('method', ['pid', 'lqr'])
def test_no_gains_come_of_a_model_whose_data_forbid_them(stored, refused, method):
    tree = json.loads(Path(stored).read_text())
    tree['axes']['roll']['no_gains_because'] = 'the commands predict nothing'
    Path(stored).write_text(json.dumps(tree))
    said = refused(main, 'design', stored, '--axis', 'roll', '--method', method, status=3)
    assert said == 'quad-tune: no gains: roll: the commands predict nothing\n'


@pytest.mark.parametrize(
    ('words', 'status', 'said'),
    [
        ('{model} --axis pitch', 3, 'lowers the rate'),
        ('{model} --axis pitch --method lqr', 3, 'lowers the rate'),
        ('{model} --axis roll,yaw', 2, 'axes: lacks yaw; it holds'),
        ('none.json', 2, 'none.json'), ('', 2, 'MODEL.json'),
        ('{model} --method lqr --max-angle -1', 2, 'must be a positive number'),
        ('{model} --method lqr --max-control 5', 2, 'is a share of the range, at most 1'),
        ('{model} --max-angle -1', 2, '--max-angle: belongs to --method lqr'),
        ('{model} --out {model}', 2, 'exists, and is no design'),
    ],
)
def test_exit_status_and_the_one_line(stored, refused, words, status, said):
    words = words.format(model=stored).split()
    assert said in refused(main, 'design', *words, status=status)
