"""Gains become parameters of PX4 and ArduPilot that give back the same controller."""

from __future__ import annotations

import json

import pytest

from quad_tuning.cli import main
from quad_tuning.history import read_design

GAINS = {
    'roll.angle.kp': 9.5, 'roll.rate.kp': 0.08, 'roll.rate.ki': 0.13, 'roll.rate.kd': 0.0028,
    'roll.rate.d_filter_hz': 69.0, 'yaw.angle.kp': 2.0, 'yaw.rate.kp': 0.17, 'yaw.rate.ki': 0.001,
    'yaw.rate.kd': 0.0, 'yaw.rate.d_filter_hz': 30.0,
}
ONES = ['--scale', 'roll=1', '--scale', 'yaw=1']
UNITS = ['--scale', 'roll=0.25', '--scale', 'yaw=1']


def design(axes):
    return json.dumps({'schema': 'quad_tuning/design/1', 'axes': axes})


def roll(**changed):
    """A design of roll with other values, by the last part of their names."""
    return design({'roll': {'gains': {f'roll.rate.{name}': value
                                      for name, value in changed.items()}}})


@pytest.fixture
def file(tmp_path):
    path = tmp_path / 'gains.json'
    axes = {axis: {'gains': {k: v for k, v in GAINS.items() if k.startswith(axis)}}
            for axis in ('roll', 'yaw')}
    path.write_text(design(axes))
    return path


def test_px4_gives_the_same_command_for_the_same_error(file, capsys):
    assert main(['export', str(file), '--to', 'px4', *UNITS]) == 0
    told = capsys.readouterr().out
    rows = [line.split('\t') for line in told.splitlines() if not line.startswith('#')]
    values = {row[2]: float(row[3]) for row in rows}
    assert all(row[:2] == ['1', '1'] and row[4] == '9' for row in rows)
    # PX4's torque for an error of 1 rad/s, times our command per torque, is our kp
    assert values['MC_ROLLRATE_K'] * values['MC_ROLLRATE_P'] * 0.25 == pytest.approx(0.08)
    assert values['MC_ROLLRATE_D'] * 0.25 == pytest.approx(0.0028)
    assert values['MC_YAWRATE_P'] == pytest.approx(0.17)
    assert values['MC_ROLL_P'] == 9.5
    assert values['IMU_DGYRO_CUTOFF'] == 30.0
    assert '# MC_ROLLRATE_P = roll.rate.kp 0.08 / 0.25' in told


def test_ardupilot_through_a_file(file, tmp_path, capsys):
    out = tmp_path / 'gains.param'
    assert main(['export', str(file), '--to', 'ardupilot', '--out', str(out), *ONES]) == 0
    rows = [line.split(',') for line in out.read_text().splitlines() if not line.startswith('#')]
    values = {name: float(value) for name, value in rows}
    assert values['ATC_RAT_RLL_P'] == pytest.approx(0.08)
    assert values['ATC_RAT_RLL_FLTD'] == 69.0
    assert values['ATC_ANG_YAW_P'] == 2.0
    assert 'differentiates the error' in out.read_text()
    assert main(['export', str(file), '--to', 'ardupilot', '--out', str(out), *ONES]) == 2
    assert 'exists already' in capsys.readouterr().err


@pytest.mark.parametrize(
    ('content', 'arguments', 'words'),
    [
        (roll(ki=-1.0), [], 'json: axes.roll.gains.roll.rate.ki: must lie in 0 .. 1 1/rad: found'),
        (roll(kp=float('nan')), [], 'rate.kp: must be a finite number: found nan; design again'),
        (roll(kp=10**400), [], 'rate.kp: must be a finite number'),
        (roll(kp='much'), [], "rate.kp: must be a finite number: found 'much'"),
        (roll(kpp=1.0), [], 'rate.kpp: is no gain that a design changes'),
        (None, [], 'cannot be read'), ('{', [], 'is not JSON'),
        pytest.param('[' * 100_000, [], 'is not JSON', id='deep'),
        ('{"schema": "x/1"}', [], 'design/1 or quad_sysid/report/1: found x/1; give the file of'),
        ('[]', [], 'schema'), (design(None), [], 'axes: is missing'),
        (design({'roll': {'gains': None}, 'pitch': 1}), [], 'holds none'),
        (roll(kp=0.1), ONES, 'lack angle.kp'),
        ('', ['--scale', 'roll=1'], '--scale yaw: is missing'),
        ('', ['--scale', 'roll=0'], '--scale'), ('', ['--scale', 'nose=1'], '--scale'),
        ('', [*ONES, '--scale', 'pitch=0.3'], '--scale: names an axis without gains'),
    ],
)
def test_wrong_files_and_options_are_one_line(file, content, arguments, words, capsys, tmp_path):
    path = file if content == '' else tmp_path / 'other.json'
    if content:
        path.write_text(content)
    assert main(['export', str(path), '--to', 'px4', *arguments]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert len(error.splitlines()) == 1


@pytest.mark.parametrize(
    ('content', 'words'),
    [
        ('{"schema": "x/1", "axes": {}}', 'schema: must be'),
        (roll(kp='much'), "axes.roll.gains.roll.rate.kp: must be a finite number: found 'much'"),
        (design({'roll': {'gains': {'roll.rate.kp': 0.1}, 'figures': {'rate_rms_ratio': 'low'}}}),
         "axes.roll.figures.rate_rms_ratio: must be a finite number: found 'low'"),
    ],
)
def test_such_files_are_not_sent_either(content, words, capsys, tmp_path):
    path = tmp_path / 'other.json'
    path.write_text(content)
    assert main(['send', str(path)]) == 2
    assert capsys.readouterr().err.startswith(f'quad-tune: {path}: {words}')


def test_bounds_of_what_is_sent_are_those_of_the_bridge(tmp_path):
    path = tmp_path / 'other.json'
    path.write_text(roll(kp=0.9))
    assert read_design(path) == ({'roll.rate.kp': 0.9}, {})


def test_what_is_not_exported_is_told(file, tmp_path, capsys):
    tree = json.loads(file.read_text())
    tree['axes']['roll']['gains'] |= {'roll.sag.exponent': 1.5, 'roll.lqr.share': 0.0}
    file.write_text(json.dumps(tree))
    assert main(['export', str(file), '--to', 'px4', *ONES]) == 0
    told = capsys.readouterr().out
    assert '# Left out, it has no counterpart here: roll.sag.exponent 1.5\n# Veh' in told
    out = str(tmp_path / 'gains.params')
    assert main(['export', str(file), '--to', 'px4', *ONES, '--out', out]) == 0
    told = capsys.readouterr().out
    assert told.endswith('left out: roll.sag.exponent 1.5\n')


@pytest.mark.parametrize('name', ['design', 'export', 'send', 'history', 'rollback'])
def test_every_command_has_an_example_in_its_help(name, capsys):
    with pytest.raises(SystemExit):
        main([name, '--help'])
    assert f'quad-tune {name}' in ' '.join(capsys.readouterr().out.split())


def test_betaflight_gets_whole_numbers_step_by_step(tmp_path, capsys):
    unit = 57.29578 / 1000.0
    before, after = ({'roll.rate.kp': p * 0.032029 * unit, 'roll.rate.ki': 80 * 0.244381 * unit,
                      'roll.rate.kd': d * 0.000529 * unit} for p, d in ((45, 30), (60, 38)))
    path = tmp_path / 'gains.json'
    path.write_text(design({'roll': {'gains': after, 'steps': [before, after]}}))
    assert main(['export', str(path), '--to', 'betaflight']) == 0
    lines = capsys.readouterr().out.splitlines()
    sets = [line for line in lines if not line.startswith('#')]
    assert sets == ['set simplified_pids_mode = OFF', 'set p_roll = 45', 'set i_roll = 80',
                    'set d_roll = 30', 'save', 'set simplified_pids_mode = OFF',
                    'set p_roll = 60', 'set i_roll = 80', 'set d_roll = 38', 'save']
    assert any('from 45 (+15)' in line for line in lines)
    assert main(['export', str(path), '--to', 'inav']) == 0
    assert 'set mc_p_roll = 60' in capsys.readouterr().out  # 1/31 beside 0.032029
    assert main(['export', str(path), '--to', 'inav', '--scale', 'roll=1']) == 2
    assert '--scale: is not needed for inav' in capsys.readouterr().err
