"""Logs as they are found: each has one fault, and comes back as what was flown.

The table FOUND reads small inputs beside the checkout (`shared/data/logs`), of which the README
there says what is right; MADE writes more of them. A table is imported by the very command that
its listing prints.
"""

import csv
import io
import shlex
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from autopilot_logs import dataflash, quaternions
from flown_craft import DT, Airframe, X, fly

from quad_sysid.bags import read_bag
from quad_sysid.cli import main
from quad_sysid.foresight import drawn_hz
from quad_sysid.imports.dataflash import read_binary
from quad_sysid.imports.table import open_table

LOGS = Path(__file__).resolve().parents[2] / '../shared/data/logs'
BESIDE = pytest.mark.skipif(not LOGS.is_dir(), reason='no shared/data/logs beside the checkout')
N = 3000
MIX = np.array([[1, 1, 1, 1], [1, -1, 1, -1], [1, -1, -1, 1], [1, 1, -1, -1]], dtype=float)
"""Motors rear left, rear right, front right, front left from U1..U4."""
FRD = np.array([1.0, -1.0, -1.0])


MOTORS, RATES, ANGLES = ('m1', 'm2', 'm3', 'm4'), ('gx', 'gy', 'gz'), ('roll', 'pitch', 'yaw')
FLIGHT = fly(Airframe(X, rate_noise=0.005), 7, DT * N)
FLOWN = {'t': DT * np.arange(N)} | dict(zip(
    (*MOTORS, *RATES, *ANGLES),
    np.hstack([FLIGHT[name] for name in ('motors', 'rates', 'angles')]).T, strict=True))
"""Twelve seconds of a quadrotor whose three axes are excited: columns by name, FLU."""
PLAIN = ('t', *MOTORS, *RATES)


def text_of(columns: dict[str, np.ndarray], *, names: bool = True) -> str:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator='\n')
    if names:
        writer.writerow(columns)
    cells = [values if values.dtype.kind == 'U' else [f'{x:.9g}' for x in values]
             for values in map(np.asarray, columns.values())]
    writer.writerows(zip(*cells, strict=True))
    return out.getvalue()


def some(*names: str, **changed: np.ndarray) -> dict[str, np.ndarray]:
    return {name: changed.get(name, FLOWN.get(name)) for name in (*names, *(
        n for n in changed if n not in names))}


def with_units_row() -> str:
    header, _, rows = text_of({**some(*PLAIN), **{
        name: np.degrees(FLOWN[name]) for name in RATES}}).partition('\n')
    return f'a log of somebody\n\n{header}\ns,-,-,-,-,deg/s,deg/s,deg/s\n{rows}'


def commented_header() -> str:
    return '# made by a script\n# ' + ' '.join(PLAIN) + '\n' + '\n'.join(
        ' '.join(row) for row in csv.reader(text_of(some(*PLAIN), names=False).splitlines())
    ) + '\n'


def in_frd(*, told_by_gravity: bool) -> str:
    turned = {name: sign * FLOWN[name] for name, sign in zip(
        (*RATES, *ANGLES), (*FRD, *FRD), strict=True)}
    noise = np.random.default_rng(1)
    gravity = {name: mean + 0.1 * noise.standard_normal(N)
               for name, mean in (('ax', 0.0), ('ay', 0.0), ('az', -9.8))}
    return text_of({**some(*PLAIN), **turned, **(gravity if told_by_gravity else {})})


def one_infinite() -> str:
    lines = text_of(some(*PLAIN)).splitlines()
    lines[1500] = f'{lines[1500].rpartition(",")[0]},inf'
    return '\n'.join(lines) + '\n'


SLOW_CLOCK = np.floor(FLOWN['t'] * 5.0) / 5.0
DATES = np.array([f'2026-03-29 23:59:{55 + t:09.6f}' if t < 5 else
                  f'2026-03-30 00:00:{t - 5:09.6f}' for t in FLOWN['t']])


@dataclass(frozen=True)
class Made:
    text: Callable[[], str]
    words: tuple[str, ...] = ()
    """What the listing or the import says."""
    options: tuple[str, ...] = ()
    """What the user adds."""
    angles: bool = False
    """Whether the angles come back too."""
    lost: tuple[int, ...] = ()
    """Rows that are gaps."""


MADE = {
    'a row of units': Made(with_units_row, ('holds units', 'before the header, left out: 1')),
    'header in a comment': Made(commented_header),
    'degrees, milliseconds, pulses': Made(lambda: text_of({
        'timestamp': 5e4 + 1e3 * FLOWN['t'],
        **{f'gyro.{a}': np.degrees(FLOWN[f'g{a}']) for a in 'xyz'},
        **{a: np.degrees(FLOWN[a]) for a in ANGLES}, 'altitude': 0.1 * FLOWN['t'],
        **{f'motor[{i}]': 1000.0 + 1000.0 * FLOWN[m] for i, m in enumerate(MOTORS)}}),
        angles=True),
    'dates': Made(lambda: text_of({'Date and time': DATES, **some(*PLAIN[1:])})),
    'a slow clock': Made(lambda: text_of({'gps_time': SLOW_CLOCK, **some(*PLAIN)}),
                         ('--time t ',)),
    'several times': Made(lambda: text_of(
        {'time_gps': SLOW_CLOCK, 'timestamp_us': np.rint(1e6 * FLOWN['t']), **some(*PLAIN[1:])})),
    'one infinite value': Made(one_infinite, lost=(1499,)),
    'quaternions': Made(lambda: text_of({**some(*PLAIN), **dict(zip(
        ('qw', 'qx', 'qy', 'qz'), quaternions(FLIGHT['angles']).T, strict=True))}),
        ('attitude.roll',), angles=True),
    'forward, right, down': Made(lambda: in_frd(told_by_gravity=True),
                                 ('forward, right, down', '-9.8 m/s²'), angles=True),
    'the same, as the user says': Made(
        lambda: in_frd(told_by_gravity=False), ('as --frame says',), ('--frame', 'frd'),
        angles=True),
    'pulses of 900 µs': Made(lambda: text_of({**some(*PLAIN), **{
        m: np.where(FLOWN['t'] < 0.2, 900.0, 1000.0 + 1000.0 * FLOWN[m]) for m in MOTORS}}),
        ('limited to it',)),
    'no time': Made(lambda: text_of(some(*PLAIN[1:])), ('--sample-rate',),
                    ('--axis', 'all', '--motors', ','.join(MOTORS), '--mixer', 'auto', '--rate',
                     ','.join(RATES), '--sample-rate', '250', '--out', 'log_bag')),
}


def listed(file: Path, printed: Callable[..., str]) -> tuple[str, list[str]]:
    """What the listing says, and the words of the first command that it prints."""
    out = printed(main, 'import', file)
    assert 'refuses it' not in out
    lines = [line for line in out.splitlines() if line.startswith('quad-sysid')]
    return out, shlex.split(lines[0])[1:] if lines else ['import', str(file)]


def check(record, rates: np.ndarray, control: np.ndarray, lost=()) -> None:
    """Rates (n, 3) rad/s and U2..U4 (n, 3) as they were flown."""
    n = len(rates)
    known = np.setdiff1d(np.arange(n), lost)
    np.testing.assert_allclose(record.rates[known], rates[known], atol=2e-4)
    np.testing.assert_allclose(record.control[known, 1:], control[known], atol=1e-4)
    assert np.isnan(record.rates[list(lost)]).all()


@pytest.mark.parametrize('name', MADE)
def test_a_table_comes_back_as_flown_by_the_command_that_is_printed(
    name, tmp_path, monkeypatch, printed
):
    case = MADE[name]
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'log.csv').write_text(case.text())
    out, words = listed(tmp_path / 'log.csv', printed)
    out += printed(main, *words, *case.options)
    said = ' '.join(out.split())
    assert [word for word in case.words if word not in said] == []
    record = read_bag(tmp_path / 'log_bag')
    stopped = '900' in name and FLOWN['t'][:, None] < 0.2
    motors = np.where(stopped, 0.0, FLIGHT['motors'])
    check(record, FLIGHT['rates'], motors @ MIX[:, 1:] / 4.0, case.lost)
    np.testing.assert_allclose(record.motors, motors, atol=1e-6)
    assert record.dt == pytest.approx(DT)
    if case.angles:
        turned = np.mod(record.angles - FLIGHT['angles'] + np.pi, 2 * np.pi) - np.pi
        assert np.abs(turned).max() < 1e-3


def test_a_mat_file_comes_back_as_flown(tmp_path, monkeypatch, printed):
    from scipy.io import savemat
    monkeypatch.chdir(tmp_path)
    savemat('log.mat', {'log': {'t': FLOWN['t'], 'gyro': FLIGHT['rates'], **some(*MOTORS)},
                        'note': 'a flight'})
    _, words = listed(tmp_path / 'log.mat', printed)
    assert main(words) == 0
    check(read_bag(tmp_path / 'log_bag'), FLIGHT['rates'], FLIGHT['motors'] @ MIX[:, 1:] / 4.0)


@pytest.mark.parametrize('cell', [9961.0, -0.7])
def test_one_damaged_cell_says_no_unit_and_its_line_is_named(tmp_path, printed, cell):
    torques = FLIGHT['motors'] @ MIX[:, 1:] / 4.0
    torques[1498, 2] = cell
    (tmp_path / 'log.csv').write_text(text_of({**some('t', *RATES), **{
        f'torque_{axis}': u for axis, u in zip(ANGLES, torques.T, strict=True)}}))
    said = ' '.join(printed(main, 'import', tmp_path / 'log.csv').split())
    assert '--unit' not in said
    assert 'line 1500, column torque_yaw' in said
    assert 'mend the row or leave it out' in said


@pytest.mark.parametrize(('first', 'words'), [
    (b'PK\x03\x04', 'is an archive (.zip, .xlsx, …); unpack it'),
    (b'MATLAB 7.3 MAT-file', 'save it again with -v7'), (b'\x89HDF\r\n\x1a\n', 'is HDF5'),
    (b'version https://git-lfs.github.com/spec/v1\n', 'git lfs pull'),
    (b'<!DOCTYPE html>\n', 'download the file itself')])
def test_what_is_no_table_is_called_by_its_name(tmp_path, refusal, first, words):
    file = tmp_path / 'log.csv'
    file.write_bytes(first + b'\n1,2,3\n' * 50)
    assert words in refusal(open_table, file)


@pytest.mark.parametrize('day', ['2026-02-30', '2026-13-14', '31/02/2026'])
def test_a_day_that_there_is_not_is_a_gap(tmp_path, day):
    days = ['2026-02-10'] * 60
    days[5] = day
    file = tmp_path / 'log.csv'
    file.write_text('time,p\n' + ''.join(f'{d} 00:00:{k:02d},0.1\n' for k, d in enumerate(days)))
    times = open_table(file).columns['time']
    assert np.flatnonzero(np.isnan(times)).tolist() == [5]
    assert np.diff(times[6:]).tolist() == [1.0] * 53


@pytest.mark.parametrize('field', [b'Name', b'Value'])
def test_a_damaged_description_of_parameters_costs_the_parameters_alone(tmp_path, field):
    rows = np.column_stack([np.arange(1, 9), np.full(8, 12.0)])
    file = dataflash(tmp_path / 'log.bin', {'BAT': (('TimeUS', 'Volt'), rows)}, {'FRAME_TYPE': 1})
    raw = file.read_bytes()
    assert read_binary(np.frombuffer(raw, np.uint8), ['BAT']).parameters == {'FRAME_TYPE': 1.0}
    labels = b'TimeUS,Name,Value'
    damaged = raw.replace(labels, labels.replace(field, b'#' + field[1:]))
    log = read_binary(np.frombuffer(damaged, np.uint8), ['BAT'])
    assert (log.parameters, log.columns['BAT.Volt'].tolist()) == ({}, [12.0] * 8)
    other = b'\xa3\x95\xc8 of a kind whose description is lost'
    end = len(raw) - 8 * 15  # of what describes
    raw = raw[:end] + b''.join(raw[i : i + 15] + other for i in range(end, len(raw), 15))
    assert read_binary(np.frombuffer(raw, np.uint8), ['BAT']).columns['BAT.Volt'].size == 8


@dataclass(frozen=True)
class Found:
    words: tuple[str, ...] = ()
    lost: int = 0
    """Rows that are gaps."""
    yaw: bool = True
    """Whether the yaw of its motors is the contract's."""
    rates: bool = True
    """Whether it holds rates."""


FOUND = {
    'gaps_16ms_every_240ms.csv': Found(('124 short gaps of up to 16 ms', 'faster medium'), 496),
    'ardupilot_damaged.bin': Found(('damaged:', 'no gyro measures such rates'), 66, yaw=False),
    'ardupilot_timems.bin': Found(yaw=False), 'px4_frd_mcap': Found(('FRD to FLU',), yaw=False),
    'controller_names_pose.csv': Found(rates=False), 'torque_roll_names.csv': Found(),
    'header_with_commas.csv': Found(), 'same_names.csv': Found(('3 columns are called gyro',)),
    'motors_signed_by_spin.csv': Found(('motor2, motor4 are negative',))}


@pytest.mark.parametrize('name', FOUND)
@BESIDE
def test_a_log_that_was_found_comes_back_as_flown(name, tmp_path, monkeypatch, printed):
    case = FOUND[name]
    monkeypatch.chdir(tmp_path)
    _, words = listed(LOGS / name, printed)
    said = ' '.join(printed(main, *words).split())
    assert [word for word in case.words if word not in said] == []
    record = read_bag(tmp_path / words[words.index('--out') + 1])
    truth = np.genfromtxt(LOGS / 'torque_roll_names.csv', delimiter=',', names=True)
    every = round(record.dt / DT)
    n = min(record.n, len(truth[::every]))
    rates = np.column_stack([truth[a] for a in 'pqr'])[::every][:n]
    control = np.column_stack([truth[f'torque_{a}'] for a in ANGLES])[::every][:n]
    whole = np.isfinite(record.rates[:, 0])
    assert record.n - whole.sum() == case.lost
    # a few messages with garbage that looks like a rate, or a motor's pulse
    allowed = 0.01 if case.lost == 66 else 0.0
    scale = 1.2 if 'signed' in name else 1.0  # of 500 rad/s, the largest is 417
    for measured, true, tolerance in (
        (record.rates, rates, 2e-4 if case.rates else 0.05),
        (record.control[:, 1 : 4 if case.yaw else 3], scale * control[:, : 3 if case.yaw else 2],
         5e-4),
    ):
        wrong = np.abs(measured[:n][whole[:n]] - true[whole[:n]]) > tolerance
        assert wrong.any(axis=1).mean() <= allowed


@pytest.mark.parametrize(('name', 'words'), [
    ('blackbox_header_only.bbl', 'holds no frames'),
    ('px4_humble_db3', 'give a checkout of px4_msgs that fits: --messages FOLDER'),
])
@BESIDE
def test_a_log_that_holds_nothing_to_read_is_one_line(name, words, refused):
    assert words in refused(main, 'import', LOGS / name)


ANGULAR = 'uint64 timestamp\nuint64 timestamp_sample\nfloat32[3] xyz\nfloat32[3] xyz_derivative\n'
ACTUATOR = """uint64 timestamp
uint64 timestamp_sample
uint16 reversible_flags
uint8 ACTUATOR_FUNCTION_MOTOR1 = 101
uint8 NUM_CONTROLS = 12
float32[12] control
"""


@BESIDE
def test_a_bag_without_definitions_is_read_by_those_of_a_folder(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / 'checkout' / 'msg'
    folder.mkdir(parents=True)
    (folder / 'VehicleAngularVelocity.msg').write_text(ANGULAR)
    (folder / 'ActuatorMotors.msg').write_text(ACTUATOR)
    for name, more in (('px4_humble_db3', ('--messages', 'checkout')), ('px4_frd_mcap', ())):
        assert main(['import', str(LOGS / name), '--out', name, *more]) == 0
    capsys.readouterr()
    one, other = (read_bag(tmp_path / name) for name in ('px4_humble_db3', 'px4_frd_mcap'))
    np.testing.assert_array_equal(one.rates, other.rates)
    np.testing.assert_array_equal(one.control, other.control)


def test_interpolated_commands_are_known_and_held_or_true_ones_are_not():
    t = 0.01 * np.arange(3000)
    slow = np.cumsum(np.random.default_rng(3).standard_normal((301, 3)), axis=0)
    drawn = np.column_stack([np.interp(t, 0.1 * np.arange(301), x) for x in slow.T])
    assert drawn_hz(drawn, 0.01) == pytest.approx(10.0)
    held = slow[np.arange(3000) // 10]
    smooth = np.column_stack([np.sin(2.0 * t), np.cos(3.0 * t), np.sin(0.7 * t)])
    noisy = drawn + 0.01 * np.random.default_rng(4).standard_normal(drawn.shape)
    rounded = np.round(200.0 * smooth) / 200.0
    assert [drawn_hz(x, 0.01) for x in (held, smooth, noisy, rounded)] == [0.0] * 4
