"""Foreign tables become bags of the contract; what is wrong is told with file, line and column."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from quad_sysid.bags import ImportOptions, import_csv, parse_units, read_bag
from quad_sysid.bags.csv_table import read_table
from quad_sysid.bags.mixers import mixer_of
from quad_sysid.bags.units import UNITS, unit_of
from quad_sysid.contract import control_from_motors, motors_from_wrench
from quad_sysid.errors import BadInputError

SHARED = Path(__file__).resolve().parents[2] / '../shared/data'
N = 500
DT = 0.004


def columns() -> dict[str, np.ndarray]:
    time = DT * np.arange(N)
    wrench = np.column_stack(
        (np.full(N, 0.5), 0.1 * np.sin(9 * time), 0.1 * np.cos(7 * time), 0.05 * np.sin(5 * time))
    )
    motors = motors_from_wrench(wrench)
    return {
        't': time, 'u': 0.2 * np.sin(2 * np.pi * time), 'angle': 0.3 * np.sin(6 * time),
        'rate': 1.8 * np.cos(6 * time), 'ref': 0.25 * np.sin(6 * time),
        'bat': 11.5 - 0.1 * time,
        **{f'm{i + 1}': motors[:, i] for i in range(4)},
    }


def write(path: Path, table: dict[str, np.ndarray], delimiter: str = ',') -> Path:
    lines = [delimiter.join(table)]
    lines += [
        delimiter.join(f'{value:.12g}' for value in row)
        for row in np.column_stack(list(table.values()))
    ]
    text = '\n'.join(lines) + '\n'
    if path.suffix == '.gz':
        path.write_bytes(gzip.compress(text.encode()))
    else:
        path.write_text(text)
    return path


@pytest.fixture
def options(tmp_path):
    file = write(tmp_path / 'flight.csv', columns())
    return ImportOptions(
        file=file, axis='pitch', time='t', out=tmp_path / 'bag', control='u', rate='rate',
        angle='angle', reference='ref', battery='bat',
    )


def test_a_table_comes_back_from_its_bag(options):
    assert import_csv(options) == options.out
    record, want = read_bag(options.out), columns()
    assert record.dt == DT
    assert record.n == N
    np.testing.assert_allclose(record.control[:, 2], want['u'], atol=1e-9)
    np.testing.assert_allclose(record.control[:, 0], 0.5, atol=1e-15)
    np.testing.assert_allclose(record.rates[:, 1], want['rate'], atol=1e-9)
    np.testing.assert_array_equal(record.rates[:, 0], 0.0)
    np.testing.assert_allclose(record.angles[:, 1], want['angle'], atol=1e-9)
    np.testing.assert_allclose(record.attitude_setpoint[:, 1], want['ref'], atol=1e-9)
    np.testing.assert_allclose(record.battery_v[:475], want['bat'][:475], atol=1e-5)
    assert record.segments == ()
    assert record.motors is None
    assert any('import: flight.csv' in line for line in record.warnings)
    with pytest.raises(BadInputError, match='not overwritten'):
        import_csv(options)


@pytest.mark.parametrize('kind', ['semicolon', 'tab', 'gzip', 'comments'])
def test_other_forms_of_the_table(options, tmp_path, kind):
    file = tmp_path / ('table.csv.gz' if kind == 'gzip' else 'table.txt')
    write(file, columns(), {'semicolon': ';', 'tab': '\t'}.get(kind, ','))
    if kind == 'comments':
        file.write_text('\ufeff# made by hand\n\n' + file.read_text())
    import_csv(replace(options, file=file))
    np.testing.assert_allclose(read_bag(options.out).rates[:, 1], columns()['rate'], atol=1e-9)


def test_motors_and_units(options, tmp_path):
    table = columns()
    table['t'] = 1e3 * table['t']
    table['rate'] = np.degrees(table['rate'])
    table['bat'] = 1e3 * table['bat']
    for i in range(1, 5):
        table[f'm{i}'] = 1000 + 1000 * table[f'm{i}']
    file = write(tmp_path / 'units.csv', table)
    units = {f'm{i}': 'pulse_us' for i in range(1, 5)}
    units |= {'t': 'ms', 'rate': 'deg/s', 'bat': 'mV', 'ref': '1:0.5'}
    import_csv(
        replace(
            options, file=file, control=None, motors=('m1', 'm2', 'm3', 'm4'), units=units,
            reference_is='rate',
        )
    )
    record, want = read_bag(options.out), columns()
    motors = np.column_stack([want[f'm{i}'] for i in range(1, 5)])
    np.testing.assert_allclose(record.motors, motors, atol=1e-9)
    np.testing.assert_allclose(record.control, control_from_motors(motors), atol=1e-9)
    np.testing.assert_allclose(record.rates[:, 1], want['rate'], atol=1e-9)
    np.testing.assert_allclose(record.rate_setpoint[:, 1], want['ref'] + 0.5, atol=1e-9)
    assert record.attitude_setpoint is None
    assert record.battery_v[0] == pytest.approx(11.5, abs=1e-3)


def test_a_rate_is_made_of_an_angle_without_phase_shift(options):
    import_csv(replace(options, rate=None))
    record, want = read_bag(options.out), columns()
    np.testing.assert_allclose(record.rates[:, 1], want['rate'], atol=2e-3)
    assert any('Savitzky-Golay' in line for line in record.warnings)


def test_missing_rows_stay_gaps(options, tmp_path):
    table = {name: np.delete(values, [100, 101]) for name, values in columns().items()}
    file = write(tmp_path / 'gap.csv', table)
    import_csv(replace(options, file=file, rate=None))
    record = read_bag(options.out)
    assert record.n == N
    assert np.flatnonzero(np.isnan(record.rates[:, 1])).tolist() == [100, 101]


def test_small_jitter_is_kept_more_is_interpolated_much_is_refused(
    options, refused, tmp_path
):
    rng = np.random.default_rng(2)
    for number, (share, ok) in enumerate([(0.05, True), (0.3, True), (0.95, False)]):
        table = columns()
        table['t'] = table['t'] + DT * share * rng.uniform(-0.5, 0.5, N)
        table['rate'] = 1.8 * np.cos(6 * table['t'])
        file = write(tmp_path / f'jitter{number}.csv', table)
        chosen = replace(options, file=file, out=tmp_path / f'bag{number}')
        if not ok:
            line = refused(chosen)
            assert 'uneven' in line or 'crowd' in line
            continue
        import_csv(chosen)
        record = read_bag(chosen.out)
        assert record.n in (N - 1, N)
        error = np.abs(record.rates[5:-5, 1] - columns()['rate'][5 : record.n - 5])
        assert np.nanmax(error) < 6 * 1.8 * DT * 0.5 * share + 0.01
        told = any('interpolated' in line for line in record.warnings)
        assert told is (share == 0.3)


@pytest.fixture
def refused(refusal) -> Callable[[ImportOptions], str]:
    """The one line with which an import is refused, which leaves no bag behind."""

    def line_of(options: ImportOptions) -> str:
        line = refusal(import_csv, options)
        assert not options.out.exists()
        return line

    return line_of


@pytest.mark.parametrize(
    ('change', 'words'),
    [
        ({'time': 'time'}, 'no column time in line 1'),
        ({'control': None}, '--control and --motors'),
        ({'control': None, 'motors': ('m1', 'm2')}, 'four columns'),
        ({'rate': None, 'angle': None}, '--rate or --angle'),
        ({'axis': 'nose'}, '--axis'),
        ({'reference_is': 'speed'}, '--reference-is'),
        ({'rate': 'u'}, 'named twice'),
        ({'units': {'rate': 'furlong'}}, "'furlong'"),
        ({'units': {'speed': 'm/s'}}, 'speed'),
        ({'units': {'u': '3'}}, 'column u'),
        ({'units': {'angle': '20'}}, 'column angle'),
        ({'control': None, 'motors': ('m1', 'm2', 'm3', 'm4'), 'mixer': 'round'}, '--mixer round'),
        ({'control': None, 'motors': ('m1', 'm2', 'm3', 'm4'), 'units': {'m1': '4'}}, 'column m1'),
        ({'file': Path('absent.csv')}, 'absent.csv: cannot be read'),
    ],
)
def test_wrong_options_end_in_one_line(options, refused, change, words):
    assert words in refused(replace(options, **change))


BROKEN = gzip.compress(b't,u,rate\n' + b'0.125,0.5,1.75\n' * 2000, mtime=0)[:60]


@pytest.mark.parametrize(
    ('text', 'words'),
    [
        ('', 'is empty'),
        ('t,u,rate\n', 'no rows'),
        ('t,u\n0,1\n', 'no column rate in line 1'),
        ('t,u,rate\n0,0,1\n0.1,much,1\n', "line 3, column u: needs a finite number: found 'much'"),
        ('t,u,rate\n0,0,1\n0.1,0,\n', "line 3, column rate: needs a finite number: found ''"),
        ('t,u,rate\n0,0,1\n0.1,0\n', 'line 3, column rate'),
        ('t,u,rate\n0,0,nan\n', 'line 2, column rate'),
        ('t,u,rate\n0,0,inf\n', 'line 2, column rate'),
        ('t,u,rate\n0,0,1\n0.1,0,1\n0.1,0,1\n', 'line 4, column t: time does not increase'),
        ('t,u,rate\n0,0,1\n0.2,0,1\n0.1,0,1\n', 'line 4, column t: time does not increase'),
        ('t,u,rate\n0,0,1\n0.2,0,1\n', 'too few'),
        pytest.param(np.random.default_rng(0).bytes(1000), '', id='noise'),
        pytest.param(BROKEN, '', id='broken gzip'),
    ],
)
def test_wrong_tables_end_in_one_line(tmp_path, refused, text, words):
    file = tmp_path / ('bad.csv.gz' if text == BROKEN else 'bad.csv')
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    line = refused(ImportOptions(file, 'roll', 't', tmp_path / 'out', control='u', rate='rate'))
    assert 'bad.csv' in line
    assert words in line


def test_quoted_headers_and_unit_options():
    table = read_table(['"time (s)", x\n', '1,2\n', '2,"3"\n'], 'f', ['time (s)', 'x'])
    assert table.columns['x'].tolist() == [2.0, 3.0]
    assert table.lines == (2, 3)
    assert parse_units(['a=deg', 'b=c=2:1']) == {'a': 'deg', 'b=c': '2:1'}
    with pytest.raises(BadInputError, match='--unit'):
        parse_units(['deg'])
    assert unit_of('control', 'V', 'u')(np.array([-10.0, 10.0])).tolist() == [-0.5, 0.5]
    assert unit_of('motor', 'pwm16', 'm')(np.array([65535.0])).tolist() == [1.0]
    assert unit_of('motor', 'pulse_us', 'm')(np.array([1000.0, 2000.0])).tolist() == [0.0, 1.0]
    assert all(table for table in UNITS.values())


def test_mixers(tmp_path):
    names = ('a', 'b', 'c', 'd')
    plus = mixer_of('plus', names)
    level = plus.matrix @ np.array([0.5, 0.5, 0.5, 0.5])
    np.testing.assert_allclose(level, [0.5, 0, 0, 0])
    assert (plus.matrix @ np.array([0.5, 0.4, 0.5, 0.6]))[1] > 0.0
    file = tmp_path / 'mixer.yaml'
    file.write_text('columns: {motor_1: c, motor_2: b, motor_3: a, motor_4: d}\n')
    ordered = mixer_of(str(file), names)
    assert ordered.order == (2, 1, 0, 3)
    motors = np.array([0.1, 0.2, 0.3, 0.4])
    np.testing.assert_allclose(
        ordered.matrix @ motors, control_from_motors(motors[[2, 1, 0, 3]][None])[0], atol=1e-15
    )
    table = tmp_path / 'mixer.csv'
    table.write_text('motor_1,c\nmotor_2,b\nmotor_3,a\nmotor_4,d\n')
    assert mixer_of(str(table), names).order == ordered.order
    for text, words in (
        ('[1, 2]', 'columns and matrix'), ('matrix: [[1, 2]]', '4 rows'),
        ('columns: {motor_1: c}', 'motor_2'), ('colums: {}', 'colums'), ('{', 'YAML'),
        ('[' * 5000, 'is not YAML'), ('columns: ' + '9' * 5000, 'is not YAML'),
        ('columns: {motor_1: x, motor_2: b, motor_3: a, motor_4: d}', '--motors'),
    ):
        file.write_text(text)
        with pytest.raises(BadInputError, match=words):
            mixer_of(str(file), names)


# ---- real recordings --------------------------------------------------------------------------


@pytest.mark.parametrize('name', ['DATA_EMPS', 'DATA_EMPS_PULSES'])
def test_emps_becomes_a_bag(tmp_path, name):
    file = SHARED / f'emps/{name}.csv'
    if not file.exists():
        pytest.skip('the measured data are not beside this checkout')
    raw = np.loadtxt(file, delimiter=',', skiprows=1)
    import_csv(
        ImportOptions(
            file, 'roll', 't', tmp_path / 'bag', control='vir', angle='qm', reference='qg',
            units={'vir': 'V', 'qm': 'm', 'qg': 'm'},
        )
    )
    record = read_bag(tmp_path / 'bag')
    assert record.dt == 0.001
    assert record.n == 24_841
    np.testing.assert_allclose(record.control[:, 1], 0.05 * raw[:, 1], atol=1e-9)
    np.testing.assert_allclose(record.angles[:, 0], raw[:, 2], atol=1e-12)
    np.testing.assert_allclose(record.attitude_setpoint[:, 0], raw[:, 3], atol=1e-12)
    moved = np.cumsum(record.rates[:, 0]) * record.dt
    assert np.abs(moved - raw[:, 2]).max() < 2e-4
    assert np.isfinite(record.rates).all()


@pytest.mark.parametrize('axis', ['roll', 'pitch', 'yaw'])
def test_nanobench_becomes_a_bag_with_the_signs_of_the_contract(tmp_path, axis):
    file = SHARED / 'nanobench/B10_lissajous_fast_rep1.csv.gz'
    if not file.exists():
        pytest.skip('the measured data are not beside this checkout')
    k = ('roll', 'pitch', 'yaw').index(axis)
    motors = tuple(f'motor_motor_m{i}' for i in range(1, 5))
    import_csv(
        ImportOptions(
            file, axis, 't', tmp_path / 'bag', motors=motors,
            mixer='crazyflie', rate=f'imu_gyro_{"xyz"[k]}', angle=axis,
            battery='pwr_pm_vbat', units=dict.fromkeys(motors, 'pwm16'),
        )
    )
    record = read_bag(tmp_path / 'bag')
    assert record.dt == 0.01
    assert record.n == 4222
    assert 3.0 < np.nanmean(record.battery_v) < 4.3
    delay = 4
    acceleration = np.gradient(record.rates[:, k], record.dt)[300 + delay : -300]
    command = record.control[300 : -300 - delay, k + 1]
    good = np.isfinite(acceleration) & np.isfinite(command)
    assert good.mean() > 0.99
    assert np.corrcoef(command[good], acceleration[good])[0, 1] > 0.1
    turned = np.gradient(record.angles[:, k], record.dt)
    good = np.isfinite(turned) & np.isfinite(record.rates[:, k])
    assert np.corrcoef(turned[good], record.rates[good, k])[0, 1] > 0.4


def test_an_advised_unit_can_be_typed_as_it_stands(tmp_path, refused):
    """Headers have blanks and brackets, which a shell would take apart."""
    table = columns()
    told = write(tmp_path / 'a.csv', {'Time [s]': table['t'], 'cmd roll': 1000.0 * table['u'],
                                      'Angle (roll)': np.degrees(table['angle'])})
    base = ImportOptions(file=told, axis='roll', time='Time [s]', out=tmp_path / 'bag',
                         control='cmd roll', angle='Angle (roll)')
    assert "--unit 'cmd roll=0.0025'" in refused(base)
    scaled = replace(base, units=parse_units(['cmd roll=0.001']))
    assert "--unit 'Angle (roll)=deg'" in refused(scaled)
