"""Gains become parameters of PX4 and ArduPilot that give back the same controller."""

import json

import pytest

from quad_tuning.cli import main

GAINS = {
    'roll.angle.kp': 9.5, 'roll.rate.kp': 0.08, 'roll.rate.ki': 0.13, 'roll.rate.kd': 0.0028,
    'roll.rate.d_filter_hz': 69.0, 'yaw.angle.kp': 2.0, 'yaw.rate.kp': 0.17, 'yaw.rate.ki': 0.001,
    'yaw.rate.kd': 0.001, 'yaw.rate.d_filter_hz': 30.0,
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


def test_px4_gives_the_same_command_for_the_same_error(file, printed):
    told = printed(main, 'export', file, '--to', 'px4', *UNITS)
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
    assert 'Warning: roll was designed with D filtered at 69 Hz. Here all axes share 30 Hz' in told
    file.write_text(file.read_text().replace('"yaw.rate.kd": 0.001', '"yaw.rate.kd": 0'))
    without = printed(main, 'export', file, '--to', 'px4', *UNITS)
    assert 'IMU_DGYRO_CUTOFF\t69\t' in without
    assert 'Warning' not in without
    file.write_text(file.read_text().replace('"yaw.rate.kd": 0', '"yaw.rate.kd": 0.001'))
    half = {name: 0.5 * value for name, value in GAINS.items() if name.startswith('roll')}
    tree = json.loads(file.read_text())
    beyond = {name: 1.5 * value for name, value in half.items()}  # after another flight
    tree['axes']['roll']['steps'] = [half, tree['axes']['roll']['gains'], beyond]
    file.write_text(json.dumps(tree))
    told = printed(main, 'export', file, '--to', 'px4', *UNITS)
    assert '# Step 1 of 2, set and fly it before the next: MC_ROLL_P 4.75, ' in told
    assert [line for line in told.splitlines() if not line.startswith('#')] == [
        '\t'.join(row) for row in rows]


def test_ardupilot_through_a_file(file, tmp_path, refused):
    out = tmp_path / 'gains.param'
    assert main(['export', str(file), '--to', 'ardupilot', '--out', str(out), *ONES]) == 0
    rows = [line.split(',') for line in out.read_text().splitlines() if not line.startswith('#')]
    values = {name: float(value) for name, value in rows}
    assert values['ATC_RAT_RLL_P'] == pytest.approx(0.08)
    assert values['ATC_RAT_RLL_FLTD'] == 69.0
    assert values['ATC_ANG_YAW_P'] == 2.0
    assert 'differentiates the error' in out.read_text()
    outside = [line for line in out.read_text().splitlines() if 'Out of range' in line]
    assert [line.partition(';')[0] for line in outside] == ['# Out of range: ATC_ANG_YAW_P = 2']
    assert 'Warning' not in out.read_text()  # each axis has its own D filter here
    assert 'exists already' in refused(
        main, 'export', file, '--to', 'ardupilot', '--out', out, *ONES)


@pytest.mark.parametrize(
    ('content', 'arguments', 'words'),
    [
        (roll(ki=-1.0), [], 'json: axes.roll.gains.roll.rate.ki: must lie in 0 .. 1 1/rad: found'),
        (roll(kp=float('nan')), [], 'rate.kp: must be a finite number: found nan; design again'),
        (roll(kpp=1.0), [], 'rate.kpp: is no gain that a design changes'),
        (None, [], 'cannot be read'), ('{', [], 'is not JSON'),
        ('{"schema": "x/1"}', [], 'design/1 or quad_sysid/report/1: found x/1; give the file of'),
        (design({'roll': {'gains': None}, 'pitch': 1}), [], 'holds none'),
        (roll(kp=0.1), ONES, 'lack angle.kp'),
        (design({'roll': {'gains': GAINS, 'steps': 1.0}}), ONES,
         'axes.roll.steps: must be a list of objects: found 1.0; design again'),
        ('', ['--scale', 'roll=1'], '--scale yaw: is missing'),
        ('', [*ONES, '--scale', 'pitch=0.3'], '--scale: names an axis without gains'),
    ],
)
def test_wrong_files_and_options_are_one_line(file, content, arguments, words, refused, tmp_path):
    path = file if content == '' else tmp_path / 'other.json'
    if content:
        path.write_text(content)
    assert words in refused(main, 'export', path, '--to', 'px4', *arguments)


def test_a_gain_that_flew_is_exported_beyond_the_bounds(tmp_path, printed):
    path, gains = tmp_path / 'gains.json', GAINS | {'roll.rate.ki': 1.12}
    own = {name: value for name, value in gains.items() if name.startswith('roll')}
    path.write_text(design({'roll': {'gains': own, 'flown_gains': {'roll.rate.ki': 1.12}}}))
    assert 'MC_ROLLRATE_I\t1.12' in printed(main, 'export', path, '--to', 'px4', *ONES[:2])


def test_betaflight_gets_whole_numbers_step_by_step(tmp_path, printed, refused):
    unit = 57.29578 / 1000.0
    before, after = ({'roll.rate.kp': p * 0.032029 * unit, 'roll.rate.ki': 80 * 0.244381 * unit,
                      'roll.rate.kd': d * 0.000529 * unit} for p, d in ((45, 30), (60, 38)))
    path = tmp_path / 'gains.json'
    yaw = {'yaw.rate.kp': 45 * 0.032029 * unit, 'yaw.rate.ki': 80 * 2.5 * 0.244381 * unit}
    near = {name: 1.001 * value for name, value in before.items()}  # the same, once rounded
    path.write_text(design({'roll': {'gains': after, 'steps': [before, near, after]},
                            'yaw': {'gains': yaw}}))
    lines = printed(main, 'export', path, '--to', 'betaflight').splitlines()
    sets = [line for line in lines if not line.startswith('#')]
    same = ['set p_yaw = 45', 'set i_yaw = 80', 'save']
    assert sets == ['set simplified_pids_mode = OFF', 'set p_roll = 45', 'set i_roll = 80',
                    'set d_roll = 30', *same, 'set simplified_pids_mode = OFF',
                    'set p_roll = 60', 'set i_roll = 80', 'set d_roll = 38', *same]
    assert any('from 45 (+15)' in line for line in lines)
    of_angle = {'roll.angle.kp': 5.0, 'roll.rate.d_filter_hz': 60.0}
    path.write_text(design({'roll': {'gains': after | of_angle, 'steps': [
        before | {'roll.rate.d_filter_hz': 40.0}, after | of_angle]}}))
    told = printed(main, 'export', path, '--to', 'betaflight')
    assert 'Not set: roll.angle.kp 5 1/s is 50 of the P of the level mode' in told
    assert told.index('# with roll.rate.d_filter_hz 40') < told.index('d_roll = 30') < told.index(
        '# with roll.rate.d_filter_hz 60') < told.index('d_roll = 38')
    had = before | {'roll.rate.d_filter_hz': 120.0, 'roll.rate.tpa_kd': 0.8}
    path.write_text(design({'roll': {'gains': after | of_angle, 'flown_gains': had}}))
    told = printed(main, 'export', path, '--to', 'betaflight')
    assert 'from 45 (+15)' in told
    assert 'set d_roll = 48' in told  # 38 / 0.8
    assert "the aircraft's low-passes together at 120 Hz: scale their cut-offs by 0.5" in told
    for tpa, words in (('x', 'axes.roll.flown_gains.roll.rate.tpa_kp: must be a finite number'),
                       (0.0, 'roll.rate.kp: must be 0 to 250 in the unit of the firmware')):
        path.write_text(design({'roll': {'gains': after | of_angle, 'flown_gains': {
            'roll.rate.tpa_kp': tpa, 'roll.rate.d_filter_hz': 0.0}}}))
        assert words in refused(main, 'export', path, '--to', 'betaflight')
    path.write_text(design({'roll': {'gains': {'roll.lqr.k_rate': 0.2}}}))
    assert 'holds no P, I, D' in refused(main, 'export', path, '--to', 'betaflight')
    path.write_text(design({'roll': {'gains': after, 'steps': [before, near, after]},
                            'yaw': {'gains': yaw}}))
    inav = 'export', path, '--to', 'inav'
    assert 'set mc_p_roll = 60' in printed(main, *inav)  # 1/31 beside 0.032029
    path.write_text(path.read_text().replace('"gains"', '"flown_gains": {"motors.range_us": 850}, '
                                             '"gains"', 1))
    assert 'set mc_p_roll = 51' in printed(main, *inav)  # of 850 µs for all of the range
    assert 'set p_roll = 60' in printed(main, 'export', path, '--to', 'betaflight')
    path.write_text(path.read_text().replace('motors.range_us": 850', 'yaw.rate.ki_factor": 1.0'))
    assert 'set i_yaw = 200' in printed(main, 'export', path, '--to', 'betaflight')
    assert '--scale: is not needed for inav' in refused(main, *inav, '--scale', 'roll=1')
