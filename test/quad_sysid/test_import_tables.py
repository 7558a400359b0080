"""Foreign tables become bags of the contract; what is wrong is one line with what helps."""

import gzip
import re
import shlex
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from autopilot_logs import text_table

from quad_sysid.bags import read_bag
from quad_sysid.cli import main
from quad_sysid.contract import MIXER_INVERSE, control_from_motors, motors_from_wrench
from quad_sysid.craft import LAYOUTS, Craft
from quad_sysid.imports.columns import (
    OPTIONS,
    ColumnOptions,
    _check_speeds,
    parse_units,
    read_columns,
)
from quad_sysid.imports.guess import guess
from quad_sysid.imports.log import Stream
from quad_sysid.imports.mixers import mixer_of
from quad_sysid.imports.table import open_table
from quad_sysid.imports.to_bag import import_log
from quad_sysid.imports.units import unit_of

N, DT = 1600, 0.004
DEG = np.pi / 180.0
MOTORS = ('m1', 'm2', 'm3', 'm4')


def columns() -> dict[str, np.ndarray]:
    """Noisy rates (biased) and angles of an excited flight, SI; motors by the contract's mixer."""
    rng = np.random.default_rng(1)
    t = DT * np.arange(N)
    wrench = np.column_stack(
        (np.full(N, 0.5), 0.1 * np.sin(9 * t), 0.1 * np.cos(7 * t), 0.05 * np.sin(5 * t))
    )
    motors = motors_from_wrench(wrench)
    rate = 0.75 * np.cos(5.0 * t) + 0.85 * np.cos(17.0 * t)
    return {
        't': t, 'u': 0.1 * np.sin(5.0 * t),
        'angle': 0.15 * np.sin(5 * t) + 0.05 * np.sin(17 * t) + 0.003 * rng.standard_normal(N),
        'rate': rate + 0.1 + 0.1 * rng.standard_normal(N),
        'ref': 0.15 * np.sin(5.0 * t + 0.3), 'wanted': np.cos(5.0 * t), 'bat': 11.5 - 0.1 * t,
        **{name: motors[:, i] for i, name in enumerate(MOTORS)},
    }


def imported(options: ColumnOptions, out: Path):
    return import_log(read_columns(options), out)


def test_the_proposed_command_writes_where_the_bag_was_wanted(tmp_path, capsys):
    table = {'t': columns()['t'], 'gyro_x': columns()['rate'], 'cmd_roll': columns()['u']}
    file = text_table(tmp_path / 'flight.csv', table)
    assert main(['import', str(file), '--out', str(tmp_path / 'mine')]) == 2
    (proposed,) = re.findall(r'^quad-sysid import .*', capsys.readouterr().out, re.MULTILINE)
    assert shlex.split(proposed)[-2:] == ['--out', str(tmp_path / 'mine')]


@pytest.fixture
def options(tmp_path: Path) -> ColumnOptions:
    return ColumnOptions(
        file=text_table(tmp_path / 'flight.csv', columns()), axes=('pitch',), time='t',
        control=('u',), rate=('rate',), angle=('angle',), reference=('ref',),
        rate_reference=('wanted',), battery='bat',
    )


def test_a_table_comes_back_from_its_bag(options, tmp_path, refusal):
    out = tmp_path / 'bag'
    assert imported(options, out).path == out
    record, want = read_bag(out), columns()
    assert (record.dt, record.n) == (DT, N)
    np.testing.assert_allclose(record.control[:, 2], want['u'], atol=1e-9)
    np.testing.assert_allclose(record.control[:, 0], 0.5, atol=1e-15)
    np.testing.assert_allclose(record.rates[:, 1], want['rate'], atol=1e-9)
    np.testing.assert_array_equal(record.rates[:, 0], 0.0)
    np.testing.assert_allclose(record.angles[:, 1], want['angle'], atol=1e-9)
    np.testing.assert_allclose(record.attitude_setpoint[:, 1], want['ref'], atol=1e-9)
    np.testing.assert_allclose(record.rate_setpoint[:, 1], want['wanted'], atol=1e-9)
    np.testing.assert_allclose(record.battery_v[:1500], want['bat'][:1500], atol=1e-2)
    assert record.motors is None
    assert any('import: flight.csv' in line for line in record.warnings)
    assert not [line for line in record.warnings if line.startswith('import check')]
    assert 'not overwritten' in refusal(imported, options, out)


@pytest.mark.parametrize('kind', ['semicolon', 'tab', 'gzip', 'comments'])
def test_other_forms_of_the_table(options, tmp_path, kind):
    file = tmp_path / ('table.csv.gz' if kind == 'gzip' else 'table.txt')
    text_table(file, columns(), {'semicolon': ';', 'tab': '\t'}.get(kind, ','))
    if kind == 'comments':
        quoted = file.read_text().replace('rate', '"rate"')
        file.write_text('\ufeff# made by hand\n\n' + quoted)
    imported(replace(options, file=file), tmp_path / 'bag')
    np.testing.assert_allclose(read_bag(tmp_path / 'bag').rates[:, 1], columns()['rate'],
                               atol=1e-9)


@pytest.mark.parametrize('repeated', [True, False])
def test_a_rate_stands_in_several_rows_or_on_lines_between_them(options, tmp_path, repeated):
    table, step = columns(), 2 if repeated else 4
    for name in ('rate', 'angle'):
        new = table[name][::step]
        table[name] = new.repeat(step) if repeated else np.interp(
            table['t'], table['t'][::step], new)
    text_table(options.file, table)
    done = imported(options, tmp_path / 'bag')
    record, said = read_bag(tmp_path / 'bag'), ' '.join(done.warnings)
    assert ('(rows for each: rates 2, angles 2)' in said) is repeated
    assert ('the rates are straight lines between samples at some 62.5 Hz' in said) is not repeated
    if repeated:
        assert record.dt == 2 * DT
        np.testing.assert_allclose(record.rates[:, 1], table['rate'][::2], atol=1e-9)
        np.testing.assert_allclose(record.control[:, 2], table['u'].reshape(-1, 2).mean(axis=1),
                                   atol=1e-9)


@pytest.mark.parametrize(('role', 'unit', 'values', 'si'), [
    ('control', 'pulse_us', (1500.0, 2000.0), (0.0, 0.5)), ('control', 'V', (-10.0,), (-0.5,)),
    ('motor', 'dshot', (48.0, 2047.0), (0.0, 1.0)), ('motor', 'pulse_us', (1000.0,), (0.0,)),
    ('thrust', 'percent', (40.0,), (0.4,)), ('acceleration', 'mg', (1000.0,), (9.80665,)),
    ('battery', 'mV', (11100.0,), (11.1,)), ('place', 'mm', (250.0,), (0.25,)),
])
def test_units_are_what_they_are_called(role, unit, values, si):
    assert unit_of(role, unit, 'column')(np.array(values)) == pytest.approx(si)


def test_a_unit_that_nobody_knows_is_asked_for(options, tmp_path, refused, printed, capsys):
    fast = columns()['rate'] * 30.0 / np.pi
    file = text_table(tmp_path / 'a.csv', columns() | {
        'gx [rpm]': 0.5 * fast, 'rate [rpm]': fast, 'gy [rpm]': fast, 'gz [rpm]': 0.3 * fast})
    unknown = replace(options, file=file, rate=('rate [rpm]',))
    assert "'rpm'; use rad/s, deg/s, m/s, mm/s, a factor" in refused(unknown)
    found = read_columns(replace(unknown, units={'rate [rpm]': str(np.pi / 30.0)}))
    np.testing.assert_allclose(found.rates.values[:, 1], columns()['rate'], atol=1e-9)
    assert "--unit 'gy [rpm]=rad/s'" in printed(main, 'import', file)
    assert main(['import', str(file), '--out', str(tmp_path / 'other')]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_a_commanded_angle_is_a_reference_and_no_control(tmp_path):
    own = columns()
    file = text_table(tmp_path / 'a.csv', {
        't': own['t'], 'gyro x (deg/s)': own['rate'] / DEG, 'phi cmd (deg)': own['rate']})
    found = guess(open_table(file), 't').columns
    assert found['reference'] == ('phi cmd (deg)', '', '')
    assert 'control' not in found
    text_table(file, {'t': own['t'], 'gyro x (deg/s)': own['rate'], 'roll (%)': own['u']})
    assert guess(open_table(file), 't').columns['control'] == ('roll (%)', '', '')


@pytest.mark.parametrize('heads', [
    ('Gyro X (deg/s)', 'Gyro Y', 'Gyro Z'), ('gyro_x_dps', 'gyro_y_dps', 'gyro_z_dps'),
])
def test_the_quiet_axes_of_a_sensor_have_the_unit_of_the_excited_one(
    tmp_path, monkeypatch, heads, printed
):
    """As on a rig where roll alone is free; a typed command needs no --unit for such names."""
    assert unit_of('rate', None, heads[0]).name == 'deg/s'
    monkeypatch.chdir(tmp_path)
    table, quiet = columns(), 0.02 * np.random.default_rng(5).standard_normal((4, N))
    rates, angles = (np.stack([table[name], *quiet[i : i + 2]])
                     for name, i in (('rate', 0), ('angle', 2)))
    text_table(tmp_path / 'own.csv', {
        't': table['t'], **{name: table[name] for name in MOTORS},
        **dict(zip((*heads, 'roll', 'pitch', 'yaw'), [*rates / DEG, *angles / DEG], strict=True))})
    (line,) = [x for x in printed(main, 'import', 'own.csv').splitlines() if x.startswith('quad')]
    words = shlex.split(line)[1:]
    words[words.index('--mixer') + 1] = 'x'  # no motor turned anything
    assert main(words) == 0
    record = read_bag(tmp_path / 'own_bag')
    np.testing.assert_allclose(record.rates, rates.T, atol=1e-6)
    np.testing.assert_allclose(record.angles, angles.T, atol=1e-6)


@pytest.mark.parametrize(('unit', 'turned'), [
    ('1', '-1'), ('0.05', '-0.05'), ('pulse_us', '-0.001:1.5'),
])
def test_a_command_of_the_wrong_sign_is_told_and_what_is_advised_mends_it(
    options, tmp_path, unit, turned
):
    rng = np.random.default_rng(3)
    command = np.repeat(rng.choice([-0.1, 0.1], N // 25), 25)
    given = unit_of('control', unit, 'u')
    rate = np.cumsum(40.0 * DT * np.roll(command, 3)) + 0.01 * rng.standard_normal(N)
    table = columns() | {'u': (-command - given.offset) / given.factor, 'rate': rate}
    wrong = replace(options, file=text_table(tmp_path / 'a.csv', table), angle=(), reference=(),
                    rate_reference=(), battery=None, units={'u': unit})
    (line,) = [one for one in imported(wrong, tmp_path / 'wrong').warnings if 'opposite' in one]
    assert line.startswith('pitch: command and rate have opposite signs')
    assert line.endswith(f'--unit u={turned}')
    right = imported(replace(wrong, units={'u': turned}), tmp_path / 'right')
    assert not [one for one in right.warnings if 'opposite' in one]
    np.testing.assert_allclose(right.record.control[:, 2], command, atol=1e-9)


def test_commands_of_all_axes_and_thrust(options, tmp_path):
    table = columns()
    wrench = control_from_motors(np.column_stack([table[m] for m in MOTORS]))
    file = text_table(tmp_path / 'wrench.csv', {
        **table, **{f'u{i + 1}': wrench[:, i] for i in range(4)}, 'p': table['rate'],
        'r': table['rate'],
    })
    imported(replace(
        options, file=file, axes=('roll', 'yaw'), control=('u2', 'u4'), thrust='u1',
        rate=('p', 'r'), angle=(), reference=(), rate_reference=(),
    ), tmp_path / 'bag')
    record = read_bag(tmp_path / 'bag')
    np.testing.assert_allclose(record.control[:, [0, 1, 3]], wrench[:, [0, 1, 3]], atol=1e-9)
    assert np.abs(record.control[:, 2]).max() < 1e-12
    assert not record.rates[:, 1].any()


@pytest.mark.parametrize(('angle', 'words'), [
    ((), 'speed and position are left out'), (('angle',), 'the heading is not known'),
])
def test_a_speed_over_the_ground_needs_the_attitude(options, tmp_path, angle, words):
    imported(replace(options, angle=angle, reference=(), rate_reference=(),
                     velocity=MOTORS[:3]), tmp_path / 'bag')
    record = read_bag(tmp_path / 'bag')
    assert (record.velocity is None) == (not angle)
    assert any(words in line for line in record.warnings)


@pytest.mark.parametrize('option', ['velocity', 'position'])
def test_a_speed_that_nothing_flies_is_refused_and_what_is_advised_mends_it(
    options, tmp_path, refused, option
):
    up = 900.0 * columns()['rate']
    table = {**columns(), **dict.fromkeys('xy', np.zeros(N)),
             'z': up if option == 'velocity' else np.cumsum(up) * DT}
    high = replace(options, file=text_table(tmp_path / 'mm.csv', table), **{option: (*'xyz',)})
    error = refused(high)
    assert 'column z: is faster than 100 m/s' in error
    (advice,) = re.findall(r'--unit (z=mm\S*),', error)
    imported(replace(high, units=parse_units([advice])), tmp_path / 'bag')
    assert 1.0 < np.abs(read_bag(tmp_path / 'bag').velocity[:, 2]).max() < 3.0


@pytest.mark.parametrize('dt', [0.01, 1.0])
def test_the_speed_of_a_position_is_that_of_its_own_clock(dt):
    flown = Stream(dt * np.arange(40), 40.0 * dt * np.arange(40.0)[:, None] * np.ones(3))
    units = {name: unit_of(OPTIONS['position'].role, None, name) for name in 'xyz'}
    _check_speeds(ColumnOptions(Path('slow.csv'), ('roll',), position=(*'xyz',)), units,
                  {'velocity': None, 'position': flown})


def test_a_rate_is_made_of_a_heading_that_wraps_without_phase_shift(tmp_path):
    t = DT * np.arange(N)
    heading = 3.0 + 1.5 * np.sin(2.0 * t)
    table = {'t': t, 'u': 0.1 * np.cos(2.0 * t),
             'a': np.mod(heading / DEG, 360.0), 'r': (heading / DEG + 170.0) % 360.0 - 180.0}
    file = text_table(tmp_path / 'yaw.csv', table)
    options = ColumnOptions(file, ('yaw',), 't', control=('u',), angle=('a',), reference=('r',),
                            units={'a': 'deg', 'r': 'deg'})
    imported(options, tmp_path / 'bag')
    record = read_bag(tmp_path / 'bag')
    np.testing.assert_allclose(record.rates[:, 2], 3.0 * np.cos(2.0 * t), atol=2e-3)
    assert any('Savitzky-Golay' in line for line in record.warnings)
    np.testing.assert_allclose(record.attitude_setpoint[:, 2] - record.angles[:, 2], -10.0 * DEG,
                               atol=1e-6)


def sd_card(version: int, cut: int = 0) -> bytes:
    """A log of a Crazyflie's SD card: rates and motors at 250 Hz, the battery as an event."""
    table = columns()
    out = b'\xbc' + struct.pack('<HH', version, 2)
    out += struct.pack('<H', 0) + b'fixedFrequency\0' + struct.pack('<H', 2)
    out += b'gyro.x(f)\0motor.m1(H)\0'
    out += struct.pack('<H', 7) + b'power\0' + struct.pack('<H', 1) + b'vbat(f)\0'
    for k, t in enumerate(table['t']):
        stamp = struct.pack('<HI', 0, 100 + round(1e3 * t)) if version == 1 else \
            struct.pack('<HQ', 0, 100_000 + round(1e6 * t))
        out += stamp + struct.pack('<fH', table['rate'][k] / DEG, round(65535 * table['m1'][k]))
        if k % 100 == 0:
            out += struct.pack('<H', 7) + stamp[2:] + struct.pack('<f', table['bat'][k])
    return out[: len(out) - cut] + b'\0\0\0\0'


@pytest.mark.parametrize(('version', 'cut'), [(1, 0), (2, 0), (2, 5)])
def test_a_crazyflies_sd_card(tmp_path, version, cut):
    file = tmp_path / 'log00'
    file.write_bytes(sd_card(version, cut))
    table = open_table(file)
    assert set(table.columns) == {'gyro.x', 'motor.m1', 'power.vbat'}
    assert len(table.columns['gyro.x']) == N - bool(cut)
    imported(ColumnOptions(
        file=file, axes=('roll',), control=('motor.m1',), rate=('gyro.x',), battery='power.vbat',
        units={'motor.m1': f'{1 / 65535}:-0.5', 'gyro.x': 'deg/s'},
    ), tmp_path / 'bag')
    record = read_bag(tmp_path / 'bag')
    assert record.dt == DT
    n = min(record.n, N - 1)
    np.testing.assert_allclose(record.rates[:n, 0], columns()['rate'][:n], atol=1e-6)


@pytest.mark.parametrize(('late_ns', 'behind_ns', 'set_back_ns', 'off'), [
    (3_000_000, 0, 0, ''), (1_000_000, 250_000_000, 0, '0.251'),
    (1_000_000, 0, 500_000_000, '0.001 to 0.501')])
def test_a_bag_of_ros_1(tmp_path, late_ns, behind_ns, set_back_ns, off):
    """Also where stamps come from another clock than the times of messages without a stamp.

    It may be set back in flight.
    """
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    from quad_sysid.imports import mavros

    store, table = get_typestore(Stores.ROS1_NOETIC), columns()
    store.register(get_types_from_msg('std_msgs/Header header\nuint16[] channels',
                                      'mavros_msgs/msg/RCOut'))
    of = {name.rpartition('/')[2]: made for name, made in store.types.items()}
    time = store.types['builtin_interfaces/msg/Time']
    nine, upright = np.zeros(9), of['Quaternion'](0.0, 0.0, 0.0, 1.0)
    with Writer(tmp_path / 'flight.bag') as writer:
        imu = writer.add_connection('/mavros/imu/data', 'sensor_msgs/msg/Imu', typestore=store)
        out = writer.add_connection('/mavros/rc/out', 'mavros_msgs/msg/RCOut', typestore=store)
        command = writer.add_connection('/cmd', 'geometry_msgs/msg/Vector3', typestore=store)
        for k, t in enumerate(table['t']):
            ns = 10**18 + round(1e9 * t)
            rate, u, felt = (of['Vector3'](*v) for v in (
                (table['rate'][k], 0.0, 0.0), (table['u'][k], 0.0, 0.0), (0.0, 0.0, 9.81)))
            stamp = ns - behind_ns - (k >= N // 2) * set_back_ns
            head = of['Header'](k, time(*divmod(stamp, 10**9)), '')
            message = of['Imu'](head, upright, nine, rate, nine, felt, nine)
            pulses = of['RCOut'](head, np.array([1500 + k % 9] * 4 + [0] * 4, np.uint16))
            for topic, late, one in ((imu, late_ns, message), (command, 0, u), (out, 0, pulses)):
                writer.write(topic, ns + late, store.serialize_ros1(one, topic.msgtype))
    opened = open_table(tmp_path / 'flight.bag')
    assert '/mavros/imu/data.orientation.pitch' in opened.columns
    notes = [note.partition(' s off')[0] for note in opened.notes if '/imu' in note]
    assert notes == [f'/mavros/imu/data: its stamps are {off}'] * bool(off)
    imported(ColumnOptions(
        file=tmp_path / 'flight.bag', axes=('roll',), control=('/cmd.x',),
        rate=('/mavros/imu/data.angular_velocity.x',),
    ), tmp_path / 'bag')
    record = read_bag(tmp_path / 'bag')
    np.testing.assert_allclose(record.rates[:, 0], table['rate'], atol=1e-9)
    np.testing.assert_allclose(record.control[:, 1], table['u'], atol=1e-9)
    log = mavros.read(tmp_path / 'flight.bag')
    np.testing.assert_allclose(log.rates.values[:, 0], table['rate'], atol=1e-9)
    assert {*log.motors.values[:9].mean(axis=1).round(3)} == {x / 1000 for x in range(500, 509)}


@pytest.fixture
def refused(refusal, tmp_path) -> Callable[[ColumnOptions], str]:
    """The one line with which an import is refused, which leaves no bag behind."""

    def line_of(options: ColumnOptions) -> str:
        line = refusal(imported, options, tmp_path / 'refused')
        assert not (tmp_path / 'refused').exists()
        return line

    return line_of


FOUR = {'control': (), 'motors': MOTORS}
STILL = {**FOUR, 'rate': ('bat',), 'angle': (), 'battery': None}


@pytest.mark.parametrize(
    ('change', 'words'),
    [
        ({'time': None}, 'needs --time'),
        ({**FOUR, 'motors': ('m1', 'm2')}, '--mixer x: is one of 4 motors'),
        ({'rate': (), 'angle': ()}, '--rate or --angle'),
        ({'rate': ('rate', 'm1')}, 'a column for each of pitch'),
        ({'rate': ('u',)}, 'named twice'), ({'units': {'rate': 'furlong'}}, "'furlong'"),
        ({'units': {'u': '9'}}, 'column u'),
        ({**STILL, 'mixer': 'auto'}, 'does not show what the motors do'),
        ({**FOUR, 'units': {'m1': '4'}}, 'column m1'),
        ({'gains': {'pitch.rate.kq': '1'}}, 'of pitch: found 1; did you mean pitch.rate.k'),
        ({'gains': {'yaw.rate.kp': '1'}}, 'of pitch: found 1; leave it out, or add its axis'),
        ({'file': Path('absent.csv')}, 'absent.csv: cannot be read')],
)
def test_wrong_options_end_in_one_line(options, refused, change, words):
    assert words in refused(replace(options, **change))


BROKEN = gzip.compress(b't,u,rate\n' + b'0.125,0.5,1.75\n' * 2000, mtime=0)[:60]


@pytest.mark.parametrize(
    ('text', 'words'),
    [
        ('', 'is empty'),
        ('t,u,rate,rate\n0,0,1,2\n', 'line 1: several columns rate'),
        ('t,u,rate\n0,0,1\n0.1,much,1\n', "line 3, column u: needs a number or nothing: found 'm"),
        ('t;u;rate\n0;0;1.234,5\n', "needs a number or nothing: found '1.234.5'"),
        ('0,0,1\n0.1,0,1\n', "line 1: holds numbers, not the columns' names"),
        ('t,u,rate\n0,0,1\n0,0,2\n', 'column t: does not increase'),
        ('t,u,rate\n0,0,1\n0.2,0,1\n', 'too few'),
        (b'\xbc\x07\x00\x01\x00', 'unknown version'),
        (b'\xbc\x01\x00\x01\x00\x00', 'is not a whole log of a Crazyflie SD card'),
        (b'#ROSBAG V2.0\n and noise', 'is not a whole bag'),
        ('{"t": [0, 1]}\n', 'is JSON, not a table; give a CSV file'),
        pytest.param(np.random.default_rng(0).bytes(1000), 'nor a log of PX4, ArduPilot',
                     id='noise'),
        pytest.param(BROKEN, '', id='broken gzip'),
    ],
)
def test_wrong_tables_end_in_one_line(tmp_path, refused, text, words):
    file = tmp_path / ('bad.csv.gz' if text == BROKEN else 'bad.csv')
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    line = refused(ColumnOptions(file, ('roll',), 't', control=('u',), rate=('rate',)))
    assert 'bad.csv' in line
    assert words in line


def scaled(
    folder: Path, scale: Mapping[str, float], units: Sequence[str] = (), **names: tuple[str, ...]
):
    """The import of a flight whose columns stand times `scale`."""
    table = {name: values * scale.get(name, 1.0) for name, values in columns().items()}
    chosen = {'control': ('u',), 'rate': ('rate',), 'angle': ('angle',), 'reference': ('ref',),
              **names}
    return imported(ColumnOptions(
        file=text_table(folder / 'log.csv', table), axes=('roll',), time='t',
        units=parse_units(list(units)), **chosen,
    ), folder / 'bag')


ALONE = {'angle': (), 'reference': ()}


@pytest.mark.parametrize(
    ('scale', 'units', 'names', 'advice'),
    [
        ({'rate': 1 / DEG}, [], {}, '--unit rate=deg/s'),
        ({}, ['rate=deg/s'], {}, '--unit rate=rad/s'),
        ({'angle': 1 / DEG}, ['angle=rad'], {}, '--unit angle=deg'),
        ({}, ['angle=deg', 'rate=rad/s', 'ref=deg'], {}, '--unit angle=rad'),
        ({}, ['ref=deg'], {}, '--unit ref=rad'),
        ({'rate': 1 / DEG}, ['rate=rad/s', 'angle=deg', 'ref=deg'], {},
         '--unit rate=deg/s --unit angle=rad'),
        ({'rate': 1 / 30}, [], {'reference': ('ref',)}, '--unit rate=29.'),
        ({'angle': 0.05 / DEG, 'rate': 0.05, 'ref': 0.05}, [], {}, '--unit angle=deg'),
        ({'rate': -1.0}, [], {}, '--unit rate=-1, or --unit angle=-1'),
        ({'angle': -1.0, 'ref': -1.0}, [], {}, '--unit rate=-1, or --unit angle=-1'),
        ({'rate': -1 / DEG}, ['rate=deg/s'], {}, '--unit rate=-0.0174533, or'),
        ({'t': 1e3}, [], {}, '--unit t=ms (250 Hz), or --unit t=s'),
        ({'t': 1e-3}, [], {}, '--unit t=FACTOR'),
        ({}, ['t=us'], {}, '--unit t=s (250 Hz)'),
        ({'rate': 100.0 / DEG}, [], ALONE, '--unit rate=deg/s'),
    ],
)
def test_a_unit_that_is_contradicted_is_refused_and_what_is_advised_mends_it(
    tmp_path, refusal, scale, units, names, advice
):
    line = refusal(scaled, tmp_path, scale, units, **names)
    assert advice in line
    assert 'log.csv, column ' in line
    assert not (tmp_path / 'bag').exists()
    column, unit = re.search(r'--unit (\w+)=([^,;) ]+)', advice).groups()
    if unit != 'FACTOR' and not names and len(units) < 2:
        others = [given for given in units if not given.startswith(f'{column}=')]
        done = scaled(tmp_path, scale, [*others, f'{column}={unit}'])
        assert done.log.checks == ()
        size = 0.05 if scale.get('rate') == 0.05 else 1.0
        rates = np.abs(read_bag(done.path).rates[:, 0])
        np.testing.assert_allclose(rates, size * np.abs(columns()['rate']), rtol=1e-5, atol=2e-5)


@pytest.mark.parametrize(
    ('scale', 'units', 'names', 'words'),
    [
        ({'rate': 1.0 / 0.7}, [], {}, '--unit rate=0.69'),
        ({'rate': 1.0 / 3.0}, [], {}, '--unit rate=2.9'),
        ({}, ['rate=deg/s', 'angle=deg', 'ref=deg'], {},
         'deg only, and the rate agrees: if both are in radians, --unit rate=rad/s --unit an'),
        ({'angle': 2.0 / 0.15, 'rate': 2.0 / 0.15, 'ref': 2.0 / 0.15}, [], {}, 'in degrees, --un'),
        ({}, [], ALONE, 'rad/s, '), ({}, ['rate=deg/s'], ALONE, 'its RMS is 0.0143 rad/s'),
        ({'t': 50.0}, ['t=s'], ALONE, '5 Hz in s'),
        ({'t': 1e3, 'rate': 1e-3}, [], ALONE, '0.25 Hz in s'),
    ],
)
def test_what_is_odd_is_told(tmp_path, scale, units, names, words):
    """The last case is a slow rig sampled every 4 s: it turns little between two samples."""
    done = scaled(tmp_path, scale, units, **names)
    assert words in '; '.join(done.log.checks)
    assert any(words in line for line in read_bag(done.path).warnings)


@pytest.mark.parametrize(
    ('names', 'columns_of', 'advice'),
    [
        (MOTORS, lambda x: 1000.0 + 1000.0 * x, 'pulse_us'),
        (MOTORS, lambda x: 48.0 + 1200.0 * x, 'dshot'), (MOTORS, lambda x: 100.0 * x, 'percent'),
        (MOTORS, lambda x: 65535.0 * x, 'pwm16'), (MOTORS, lambda x: 30000.0 * (x - 0.5), None),
        (('u',), lambda x: 1500.0 + 1000.0 * x, 'pulse_us'), (('u',), lambda x: 1850.0 * x, None),
        (('u',), lambda x: 20.0 * (x - x.min()), None)],
)
def test_the_unit_of_a_command_that_is_advised_is_accepted(
    tmp_path, refusal, names, columns_of, advice
):
    table = columns()
    table |= {name: columns_of(table[name]) for name in names}
    which = {'motors': names} if names == MOTORS else {'control': names}
    options = ColumnOptions(text_table(tmp_path / 'log.csv', table), ('roll',), 't',
                            rate=('rate',), **which)
    units: dict[str, str] = {}
    for _ in names:
        line = refusal(read_columns, replace(options, units=dict(units)))
        name, unit = re.search(r'such as --unit (\w+)=(\S+)', line).groups()
        assert advice in (None, unit)
        units[name] = unit
    assert read_columns(replace(options, units=units)).rates is not None


def test_mixers(tmp_path, refusal):
    names = ('a', 'b', 'c', 'd')
    plus = mixer_of('plus', names)
    assert plus.places == ('front', 'right', 'rear', 'left')
    file = tmp_path / 'mixer.yaml'
    file.write_text(f'matrix: {MIXER_INVERSE[:, [2, 1, 0, 3]].tolist()}')
    assert mixer_of(str(file), names).places == (
        'front right', 'rear right', 'rear left', 'front left')
    file.write_text(f'matrix: {(MIXER_INVERSE * [1, 1, 1, 2]).tolist()}')
    assert not isinstance(mixer_of(str(file), names), Craft)  # no places and spins give that
    file.write_text(LAYOUTS['ardupilot_quad_h'].to_urdf())
    assert mixer_of(str(file), names).signs == LAYOUTS['ardupilot_quad_h'].signs
    for text, words in (
        ('[1, 2]', 'matrix of numbers'), ('matrix: [[1, 2]]', '4 rows'), ('{', 'is not YAML'),
        ('matrix: [[1], [2], [3], [4]]', 'one of 1 motors'), ('colums: {}', 'is not YAML with'),
        ('[' * 5000, 'is not YAML'), ('matrix: [[.nan], [1], [1], [1]]', 'finite'),
    ):
        file.write_text(text)
        assert words in refusal(mixer_of, str(file), names)


def test_an_advised_unit_can_be_typed_as_it_stands(tmp_path, refused):
    """Headers have blanks and brackets, which a shell would take apart."""
    table = columns()
    file = text_table(tmp_path / 'a.csv', {'Time [s]': table['t'], 'cmd roll': 1000.0 * table['u'],
                                      'Angle (roll)': 20.0 * table['angle']})
    base = ColumnOptions(file=file, axes=('roll',), time='Time [s]', control=('cmd roll',),
                         angle=('Angle (roll)',))
    assert "'roll'; use rad, deg, m, mm, a factor" in refused(base)
    named = parse_units(['Angle (roll)=rad'])
    base = replace(base, units=named)
    assert "--unit 'cmd roll=0.005'" in refused(base)
    mended = replace(base, units={**named, **parse_units(['cmd roll=0.001'])})
    assert "--unit 'Angle (roll)=deg'" in refused(mended)
