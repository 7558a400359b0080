"""Foreign tables become bags of the contract; what is wrong is told with file, line and column.

A unit or a sign that the table itself contradicts is refused with what helps; twins that fit pass.
"""

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
from quad_sysid.bags.units import unit_of
from quad_sysid.cli import main
from quad_sysid.contract import control_from_motors, motors_from_wrench
from quad_sysid.errors import BadInputError

SHARED = Path(__file__).resolve().parents[2] / '../shared/data'
N = 500
DT = 0.004


def columns() -> dict[str, np.ndarray]:
    t = DT * np.arange(N)
    motors = motors_from_wrench(np.column_stack(
        (np.full(N, 0.5), 0.1 * np.sin(9 * t), 0.1 * np.cos(7 * t), 0.05 * np.sin(5 * t))
    ))
    return {
        't': t, 'u': 0.2 * np.sin(2 * np.pi * t), 'angle': 0.3 * np.sin(6 * t),
        'rate': 1.8 * np.cos(6 * t), 'ref': 0.25 * np.sin(6 * t), 'bat': 11.5 - 0.1 * t,
        **{f'm{i + 1}': motors[:, i] for i in range(4)},
    }


def write(path: Path, table: dict[str, np.ndarray], delimiter: str = ',') -> Path:
    rows = zip(*table.values(), strict=True)
    lines = [delimiter.join(table), *(delimiter.join(f'{v:.12g}' for v in row) for row in rows)]
    text = ('\n'.join(lines) + '\n').encode()
    path.write_bytes(gzip.compress(text) if path.suffix == '.gz' else text)
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
    assert (record.dt, record.n, record.segments, record.motors) == (DT, N, (), None)
    for got, wanted in (
        (record.control[:, 2], want['u']), (record.control[:, 0], 0.5 + 0.0 * want['u']),
        (record.rates[:, 1], want['rate']), (record.rates[:, 0], 0.0 * want['rate']),
        (record.angles[:, 1], want['angle']), (record.attitude_setpoint[:, 1], want['ref']),
    ):
        np.testing.assert_allclose(got, wanted, atol=1e-9)
    np.testing.assert_allclose(record.battery_v[:475], want['bat'][:475], atol=1e-5)
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
    table, want = columns(), columns()
    names = tuple(f'm{i}' for i in range(1, 5))
    for name, scale in (('t', 1e3), ('rate', 180.0 / np.pi), ('bat', 1e3)):
        table[name] = scale * table[name]
    table |= {name: 1000 + 1000 * table[name] for name in names}
    units = dict.fromkeys(names, 'pulse_us')
    units |= {'t': 'ms', 'rate': 'deg/s', 'bat': 'mV', 'ref': '1:0.5'}
    import_csv(replace(options, file=write(tmp_path / 'units.csv', table), control=None,
                       motors=names, units=units, reference_is='rate'))
    record = read_bag(options.out)
    motors = np.column_stack([want[name] for name in names])
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


@pytest.mark.parametrize('share', [0.05, 0.3, 0.95])
def test_small_jitter_is_kept_more_is_interpolated_much_is_refused(
    options, refused, tmp_path, share
):
    table = columns()
    table['t'] = table['t'] + DT * share * np.random.default_rng(2).uniform(-0.5, 0.5, N)
    table['rate'] = 1.8 * np.cos(6 * table['t'])
    chosen = replace(options, file=write(tmp_path / 'jitter.csv', table))
    if share > 0.9:
        assert 'uneven' in (line := refused(chosen)) or 'crowd' in line
        return
    import_csv(chosen)
    record = read_bag(chosen.out)
    assert record.n in (N - 1, N)
    error = np.abs(record.rates[5:-5, 1] - columns()['rate'][5 : record.n - 5])
    assert np.nanmax(error) < 6 * 1.8 * DT * 0.5 * share + 0.01
    assert any('interpolated' in line for line in record.warnings) is (share == 0.3)


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


def test_quoted_headers_and_unit_options(refusal):
    table = read_table(['"time (s)", x\n', '1,2\n', '2,"3"\n'], 'f', ['time (s)', 'x'])
    assert table.columns['x'].tolist() == [2.0, 3.0]
    assert table.lines == (2, 3)
    assert parse_units(['a=deg', 'b=c=2:1']) == {'a': 'deg', 'b=c': '2:1'}
    assert '--unit' in refusal(parse_units, ['deg'])
    for kind, unit, given, got in (
        ('control', 'V', [-10.0, 10.0], [-0.5, 0.5]), ('motor', 'pwm16', [65535.0], [1.0]),
        ('motor', 'pulse_us', [1000.0, 2000.0], [0.0, 1.0]),
    ):
        assert unit_of(kind, unit, 'x')(np.array(given)).tolist() == got


def test_mixers(tmp_path, refusal):
    names, file = ('a', 'b', 'c', 'd'), tmp_path / 'mixer.yaml'
    plus = mixer_of('plus', names)
    np.testing.assert_allclose(plus.matrix @ np.full(4, 0.5), [0.5, 0, 0, 0])
    assert (plus.matrix @ np.array([0.5, 0.4, 0.5, 0.6]))[1] > 0.0
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
        assert words in refusal(mixer_of, str(file), names)


# ---- real recordings --------------------------------------------------------------------------


@pytest.mark.parametrize('name', ['DATA_EMPS', 'DATA_EMPS_PULSES'])
def test_emps_becomes_a_bag(tmp_path, name):
    file = SHARED / f'emps/{name}.csv'
    if not file.exists():
        pytest.skip('the measured data are not beside this checkout')
    raw = np.loadtxt(file, delimiter=',', skiprows=1)
    import_csv(ImportOptions(
        file, 'roll', 't', tmp_path / 'bag', control='vir', angle='qm', reference='qg',
        units={'vir': 'V', 'qm': 'm', 'qg': 'm'},
    ))
    record = read_bag(tmp_path / 'bag')
    assert (record.dt, record.n) == (0.001, 24_841)
    np.testing.assert_allclose(record.control[:, 1], 0.05 * raw[:, 1], atol=1e-9)
    np.testing.assert_allclose(record.angles[:, 0], raw[:, 2], atol=1e-12)
    np.testing.assert_allclose(record.attitude_setpoint[:, 0], raw[:, 3], atol=1e-12)
    moved = np.cumsum(record.rates[:, 0]) * record.dt
    assert np.abs(moved - raw[:, 2]).max() < 2e-4


@pytest.mark.parametrize(('k', 'axis'), enumerate(('roll', 'pitch', 'yaw')))
def test_nanobench_becomes_a_bag_with_the_signs_of_the_contract(tmp_path, k, axis):
    file = SHARED / 'nanobench/B10_lissajous_fast_rep1.csv.gz'
    if not file.exists():
        pytest.skip('the measured data are not beside this checkout')
    motors = tuple(f'motor_motor_m{i}' for i in range(1, 5))
    import_csv(ImportOptions(
        file, axis, 't', tmp_path / 'bag', motors=motors, mixer='crazyflie',
        rate=f'imu_gyro_{"xyz"[k]}', angle=axis, battery='pwr_pm_vbat',
        units=dict.fromkeys(motors, 'pwm16'),
    ))
    record, delay = read_bag(tmp_path / 'bag'), 4
    assert (record.dt, record.n) == (0.01, 4222)
    assert 3.0 < np.nanmean(record.battery_v) < 4.3
    acceleration = np.gradient(record.rates[:, k], record.dt)[300 + delay : -300]
    turned = np.gradient(record.angles[:, k], record.dt)
    for one, other, least in (
        (record.control[300 : -300 - delay, k + 1], acceleration, 0.1),
        (turned, record.rates[:, k], 0.4),
    ):
        good = np.isfinite(one) & np.isfinite(other)
        assert good.mean() > 0.99
        assert np.corrcoef(one[good], other[good])[0, 1] > least


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


# ---- units that the table contradicts ---------------------------------------------------------


LONG, DEG = 1600, np.pi / 180.0


def flight() -> dict[str, np.ndarray]:
    """Noisy rates (biased) and angles of an excited flight, SI."""
    rng, t = np.random.default_rng(1), DT * np.arange(LONG)
    angle = 0.15 * np.sin(5.0 * t) + 0.05 * np.sin(17.0 * t)
    rate = 0.75 * np.cos(5.0 * t) + 0.85 * np.cos(17.0 * t)
    return {
        't': t, 'u': 0.1 * np.sin(5.0 * t), 'angle': angle + 0.003 * rng.standard_normal(LONG),
        'rate': rate + 0.1 + 0.1 * rng.standard_normal(LONG),
        'ref': 0.15 * np.sin(5.0 * t + 0.3),
    }


def asked(folder: Path, scale: dict[str, float], units: list[str] = (), **names: str | None):
    """Options for that flight with its columns times `scale`."""
    table = {name: values * scale.get(name, 1.0) for name, values in flight().items()}
    columns = {'control': 'u', 'rate': 'rate', 'angle': 'angle', 'reference': 'ref', **names}
    return ImportOptions(write(folder / 'log.csv', table), 'roll', 't', folder / 'bag',
                         units=parse_units(list(units)), **columns)


def checks(options: ImportOptions) -> list[str]:
    return [w for w in read_bag(import_csv(options)).warnings if w.startswith('import check')]


@pytest.mark.parametrize(
    ('scale', 'units', 'advice'),
    [
        ({'rate': 1 / DEG}, [], '--unit rate=deg/s'),
        ({}, ['rate=deg/s'], '--unit rate=rad/s'),
        ({'angle': 1 / DEG}, ['angle=rad'], '--unit angle=deg'),
        ({}, ['angle=deg', 'rate=rad/s', 'ref=deg'], '--unit angle=rad'),
        ({'ref': 1 / DEG}, [], '--unit ref=deg'), ({}, ['ref=deg'], '--unit ref=rad'),
        ({'angle': 0.05 / DEG, 'rate': 0.05, 'ref': 0.05}, [], '--unit angle=deg'),
        ({'rate': -1.0}, [], '--unit rate=-1, or --unit angle=-1'),
        ({'angle': -1.0, 'ref': -1.0}, [], '--unit rate=-1, or --unit angle=-1'),
        ({'rate': -1 / DEG}, ['rate=deg/s'], '--unit rate=-0.0174533, or'),
        ({'rate': -1 / DEG}, [], '--unit rate=-0.0174533'),
        ({'t': 1e3}, [], '--unit t=ms (250 Hz), or --unit t=s'),
        ({'t': 1e6}, [], '--unit t=us (250 Hz)'), ({'t': 1e9}, [], '--unit t=ns (250 Hz)'),
        ({'t': 1e-3}, [], '--unit t=FACTOR'), ({'rate': 100.0 / DEG}, [], '--unit rate=deg/s'),
    ],
)
def test_what_cannot_be_is_refused_with_what_helps(tmp_path, refused, scale, units, advice):
    alone = {'angle': None, 'reference': None} if scale.get('rate') == 100.0 / DEG else {}
    line = refused(asked(tmp_path, scale, units, **alone))
    assert advice in line
    assert 'log.csv, column ' in line


@pytest.mark.parametrize(
    ('scale', 'units'),
    [
        ({}, []), ({'rate': 1 / DEG}, ['rate=deg/s']), ({'rate': -1 / DEG}, ['rate=-0.0174533']),
        ({'angle': 1 / DEG}, ['angle=deg']), ({'rate': -1.0, 'angle': -1.0, 'ref': -1.0}, []),
        ({'t': 1e3}, ['t=ms']), ({'t': 1e6}, ['t=us']),
    ],
)
def test_what_was_advised_mends_it(tmp_path, scale, units):
    options = asked(tmp_path, scale, units)
    assert checks(options) == []
    sign = -1.0 if scale.get('rate') == -1.0 else 1.0
    rates = read_bag(options.out).rates[:, 0]
    np.testing.assert_allclose(rates, sign * flight()['rate'], atol=2e-5)


@pytest.mark.parametrize('factor', [0.7, 1.4, 3.0, 1 / 1.1])
def test_another_factor_is_told_and_one_within_a_fifth_is_not(tmp_path, factor):
    told = checks(asked(tmp_path, {'rate': 1.0 / factor}))
    if 0.8 < factor < 1.2:
        assert told == []
    else:  # to the noise of angle and rate
        assert float(told[0].rpartition('--unit rate=')[2]) == pytest.approx(factor, rel=0.05)


def test_what_cannot_be_checked_is_told(tmp_path):
    """A rate without an angle in both units; a unit of time that was named holds."""
    rms, alone = np.std(flight()['rate']), {'angle': None, 'reference': None}
    (told,) = checks(asked(tmp_path, {}, **alone))
    assert f'{rms:.3g} rad/s, {rms / DEG:.3g} deg/s' in told
    slow = replace(asked(tmp_path, {'t': 50.0}, ['t=s'], **alone), out=tmp_path / 'slow')
    assert '5 Hz in s' in checks(slow)[0]


def test_an_angle_that_wraps_is_not_held_against_its_jumps(tmp_path):
    t = DT * np.arange(LONG)
    table = {'t': t, 'u': 0.0 * t, 'r': 2.0 + np.sin(3.0 * t),
             'a': np.angle(np.exp(1j * (2.0 * t - np.cos(3.0 * t) / 3.0)))}
    assert checks(ImportOptions(write(tmp_path / 'log.csv', table), 'yaw', 't', tmp_path / 'bag',
                                control='u', rate='r', angle='a')) == []


def test_the_command_says_what_comes_next(tmp_path, capsys):
    file = asked(tmp_path, {}).file
    words = f'import {file} --axis roll --time t --control u --rate rate --out {tmp_path}/again'
    assert main(words.split()) == 0
    printed = capsys.readouterr().out
    assert f'next: quad-sysid inspect {tmp_path / "again"}' in printed
    assert 'import check: the unit of rate could not be checked' in printed
