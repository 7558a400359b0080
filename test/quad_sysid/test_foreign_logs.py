"""Logs of PX4, ArduPilot and Betaflight come back as what was flown, in our frames and units.

The logs are encoded here by hand, with each firmware's own motor places and senses written out, so
that nothing of the import's tables is used to make them.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from quad_sysid.bags import read_bag
from quad_sysid.cli import main
from quad_sysid.errors import BadInputError
from quad_sysid.imports.kinds import kind_of, read_log
from quad_sysid.imports.to_bag import import_log
from quad_sysid.imports.words import table

SAMPLE = Path(__file__).resolve().parents[2] / '../shared/data/px4/sample_log_small.ulg'
DT_US = 4000
N = 1500


class Flight:
    """What happened, in our frames: FLU body rates, ENU angles, U1..U4."""

    def __init__(self) -> None:
        t = 1e-6 * DT_US * np.arange(N)
        self.t = t
        self.rates = np.column_stack([np.sin(3 * t), 0.7 * np.cos(2 * t), 0.4 * np.sin(t)])
        self.angles = np.column_stack([0.3 * np.sin(t), 0.2 * np.cos(t), 0.5 + 0.1 * t])
        self.control = np.column_stack([
            0.5 + 0.05 * np.sin(t), 0.08 * np.sin(5 * t), 0.06 * np.cos(4 * t),
            0.03 * np.sin(2 * t),
        ])
        self.volts = 12.0 - 0.01 * t

    def thrusts(self) -> dict[str, np.ndarray]:
        """Motor commands by place, where front right and rear left turn counter-clockwise."""
        u1, u2, u3, u4 = self.control.T
        # left up: positive roll; rear up: positive pitch (nose down);
        # more of the clockwise motors: body counter-clockwise, positive yaw
        return {
            'front right': u1 - u2 - u3 - u4, 'rear left': u1 + u2 + u3 - u4,
            'front left': u1 + u2 - u3 + u4, 'rear right': u1 - u2 + u3 + u4,
        }


@pytest.fixture(scope='module')
def flight():
    return Flight()


def quaternion_ned(angles: np.ndarray) -> np.ndarray:
    """w x y z of the FRD body in NED, by multiplying the three turns."""
    roll, pitch, yaw = angles[:, 0], -angles[:, 1], 0.5 * np.pi - angles[:, 2]

    def turn(axis, angle):
        q = np.zeros((len(angle), 4))
        q[:, 0], q[:, axis] = np.cos(0.5 * angle), np.sin(0.5 * angle)
        return q

    def product(a, b):
        w = a[:, 0] * b[:, 0] - (a[:, 1:] * b[:, 1:]).sum(axis=1)
        v = a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:] + np.cross(a[:, 1:], b[:, 1:])
        return np.column_stack([w, v])

    return product(product(turn(3, yaw), turn(2, pitch)), turn(1, roll))


def ulog(path: Path, topics: dict, parameters: dict, drop=()) -> Path:
    """Topics {name: {field: values}}, floats or arrays of them, all but the first, timestamp."""
    out = [b'ULog\x01\x12\x35\x01' + struct.pack('<Q', 1)]

    def add(kind: bytes, body: bytes) -> None:
        out.append(struct.pack('<Hc', len(body), kind) + body)

    for name, columns in topics.items():
        fields = ''.join(
            f'float{f"[{v.shape[1]}]" if v.ndim > 1 else ""} {f};'
            for f, v in columns.items() if f != 'timestamp'
        )
        add(b'F', f'{name}:uint64_t timestamp;{fields}'.encode())
    for name, value in parameters.items():
        key = f'{"int32_t" if isinstance(value, int) else "float"} {name}'.encode()
        form = '<i' if isinstance(value, int) else '<f'
        add(b'P', bytes([len(key)]) + key + struct.pack(form, value))
    for i, name in enumerate(topics):
        add(b'A', struct.pack('<BH', 0, i) + name.encode())
    for i, columns in enumerate(topics.values()):
        stamps = columns['timestamp']
        values = np.column_stack([v for f, v in columns.items() if f != 'timestamp'])
        for k, stamp in enumerate(stamps):
            if k not in drop:
                body = struct.pack('<HQ', i, int(stamp)) + values[k].astype('<f4').tobytes()
                add(b'D', body)
    path.write_bytes(b''.join(out))
    return path


FRD = np.array([1.0, -1.0, -1.0])
"""From our body axes to PX4's and ArduPilot's, and back."""


def px4_topics(flight: Flight) -> dict:
    stamps = 2_000_000 + DT_US * np.arange(N)
    by_place = flight.thrusts()
    places = ('front right', 'rear left', 'front left', 'rear right')
    return {
        'vehicle_angular_velocity': {'timestamp': stamps, 'xyz': flight.rates * FRD},
        'vehicle_attitude': {'timestamp': stamps, 'q': quaternion_ned(flight.angles)},
        'actuator_motors': {
            'timestamp': stamps, 'control': np.column_stack([by_place[p] for p in places]),
        },
        'battery_status': {'timestamp': stamps, 'voltage_v': flight.volts},
    }


def imported(path: Path, out: Path):
    done = import_log(read_log(path, kind_of(path)), out)
    return done, read_bag(done.path)


def check_motion(record, flight: Flight, tolerance: float = 1e-5, skip: int = 0) -> None:
    n = min(record.n, N)
    np.testing.assert_allclose(record.rates[skip:n], flight.rates[skip:n], atol=tolerance)
    np.testing.assert_allclose(record.control[skip:n], flight.control[skip:n], atol=tolerance)


def write_px4(path: Path, flight: Flight, parameters: dict, change=None, drop=()) -> Path:
    topics = px4_topics(flight)
    if change:
        change(topics)
    return ulog(path, topics, parameters, drop)


def test_px4_motors_angles_and_battery(flight, tmp_path):
    pytest.importorskip('pyulog')
    path = write_px4(tmp_path / 'log.ulg', flight, {'MAV_TYPE': 2, 'IMU_GYRO_CUTOFF': 40.0})
    done, record = imported(path, tmp_path / 'bag')
    assert record.dt == pytest.approx(1e-6 * DT_US)
    check_motion(record, flight)
    turned = np.mod(record.angles - flight.angles + np.pi, 2 * np.pi) - np.pi
    np.testing.assert_allclose(turned, 0.0, atol=1e-5)
    assert record.battery_v[0] == pytest.approx(12.0, abs=1e-3)
    assert 'vehicle_attitude_setpoint' in ' '.join(done.log.missing)
    assert record.gains == ()
    assert max(map(len, table(done)[1:])) <= 80


def test_px4_gains_in_our_unit_where_torque_was_logged_too(flight, tmp_path):
    pytest.importorskip('pyulog')

    def with_torque(topics):
        stamps = topics['vehicle_attitude']['timestamp']
        topics['vehicle_torque_setpoint'] = {
            'timestamp': stamps, 'xyz': FRD * flight.control[:, 1:] / [0.25, 0.25, 0.125],
        }
        topics['vehicle_thrust_setpoint'] = {
            'timestamp': stamps, 'xyz': flight.control[:, :1] * [0.0, 0.0, -1.0],
        }

    parameters = {'MC_ROLL_P': 6.5, 'MC_ROLLRATE_P': 0.15, 'MC_ROLLRATE_K': 2.0,
                  'MC_YAWRATE_P': 0.2, 'MC_ROLLRATE_MAX': 180.0}
    path = write_px4(tmp_path / 'log.ulg', flight, parameters, with_torque)
    _, record = imported(path, tmp_path / 'bag')
    gains = record.gains_at(0.0)
    assert gains['roll.angle.kp'] == pytest.approx(6.5)
    assert gains['roll.rate.kp'] == pytest.approx(0.15 * 2.0 * 0.25, rel=1e-4)
    assert gains['yaw.rate.kp'] == pytest.approx(0.2 * 0.125, rel=1e-4)
    assert gains['roll.angle.rate_limit'] == pytest.approx(np.pi)


def test_px4_torque_alone_is_the_input_in_its_own_unit(flight, tmp_path):
    pytest.importorskip('pyulog')

    def without_motors(topics):
        del topics['actuator_motors']
        topics['actuator_controls_0'] = {
            'timestamp': topics['vehicle_attitude']['timestamp'],
            'control': np.column_stack([flight.control[:, 1:] * FRD, flight.control[:, 0]]),
        }

    path = write_px4(tmp_path / 'log.ulg', flight, {'MC_PITCHRATE_P': 0.1}, without_motors)
    done, record = imported(path, tmp_path / 'bag')
    check_motion(record, flight)
    assert record.gains_at(0.0)['pitch.rate.kp'] == pytest.approx(0.1)
    assert 'asked for' in ' '.join(done.warnings)


def test_dropped_samples_are_drawn_on_a_coarser_grid(flight, tmp_path):
    pytest.importorskip('pyulog')
    # one sample in three is missing, as a logger that cannot follow leaves them
    path = write_px4(tmp_path / 'log.ulg', flight, {}, drop=set(range(2, N, 3)))
    done, record = imported(path, tmp_path / 'bag')
    assert record.dt == pytest.approx(2e-6 * DT_US)
    assert 'come unevenly' in ' '.join(done.warnings)
    np.testing.assert_allclose(record.rates[:700], flight.rates[:1400:2], atol=1e-4)
    mean = flight.control.reshape(-1, 2, 4).mean(axis=1)
    np.testing.assert_allclose(record.control[:700], mean[:700], atol=5e-3)


def dataflash(path: Path, messages: dict, parameters: dict) -> Path:
    """Messages {name: (labels, rows)}; the first label is TimeUS."""
    out = []

    def fmt(number, name, form, labels, length):
        out.append(struct.pack('<3BBB4s16s64s', 0xA3, 0x95, 128, number, length, name.encode(),
                               form.encode(), ','.join(labels).encode()))

    fmt(128, 'FMT', 'BBnNZ', ('Type', 'Length', 'Name', 'Format', 'Columns'), 89)
    fmt(129, 'PARM', 'QNf', ('TimeUS', 'Name', 'Value'), 3 + 8 + 16 + 4)
    for name, value in parameters.items():
        out.append(struct.pack('<3BQ16sf', 0xA3, 0x95, 129, 1, name.encode(), value))
    for number, (name, (labels, rows)) in enumerate(messages.items(), 130):
        fmt(number, name, 'Q' + 'f' * (len(labels) - 1), labels, 11 + 4 * (len(labels) - 1))
        form = f'<3BQ{len(labels) - 1}f'
        out += [struct.pack(form, 0xA3, 0x95, number, int(row[0]), *row[1:]) for row in rows]
    path.write_bytes(b''.join(out))
    return path


def ardupilot_messages(flight: Flight) -> dict:
    stamps = 3_000_000 + DT_US * np.arange(N)
    by_place = flight.thrusts()
    deg = np.degrees
    pulse = {place: 1000.0 + 1000.0 * value for place, value in by_place.items()}
    roll, pitch, yaw = deg(flight.angles[:, 0]), -deg(flight.angles[:, 1]), \
        np.mod(90.0 - deg(flight.angles[:, 2]), 360.0)
    p, q, r = deg(flight.rates * FRD).T
    return {
        'RATE': (
            ('TimeUS', 'RDes', 'R', 'ROut', 'PDes', 'P', 'POut', 'YDes', 'Y', 'YOut', 'AOut'),
            np.column_stack([
                stamps, p, p, flight.control[:, 1], q, q, -flight.control[:, 2], r, r,
                -flight.control[:, 3], flight.control[:, 0],
            ]),
        ),
        'ATT': (
            ('TimeUS', 'DesRoll', 'Roll', 'DesPitch', 'Pitch', 'DesYaw', 'Yaw'),
            np.column_stack([stamps, roll, roll, pitch, pitch, yaw, yaw]),
        ),
        'RCOU': (
            ('TimeUS', 'C1', 'C2', 'C3', 'C4'),
            np.column_stack([stamps, pulse['front right'], pulse['rear left'],
                             pulse['front left'], pulse['rear right']]),
        ),
        'BAT': (('TimeUS', 'Volt'), np.column_stack([stamps, flight.volts])[::25]),
    }


def test_ardupilot_pulses(flight, tmp_path):
    pytest.importorskip('pymavlink')
    path = dataflash(tmp_path / 'log.bin', ardupilot_messages(flight),
                     {'FRAME_CLASS': 1, 'FRAME_TYPE': 1, 'ATC_RAT_RLL_P': 0.135})
    done, record = imported(path, tmp_path / 'bag')
    check_motion(record, flight)
    turned = np.mod(record.angles - flight.angles + np.pi, 2 * np.pi) - np.pi
    np.testing.assert_allclose(turned, 0.0, atol=1e-4)
    np.testing.assert_allclose(record.rate_setpoint, flight.rates, atol=1e-5)
    np.testing.assert_allclose(record.attitude_setpoint[:, :2], flight.angles[:, :2], atol=1e-5)
    assert record.gains == ()
    assert 'thrust curve' in ' '.join(done.warnings)


def test_ardupilot_outputs_carry_the_gains(flight, tmp_path):
    pytest.importorskip('pymavlink')
    messages = ardupilot_messages(flight)
    del messages['RCOU']
    path = dataflash(tmp_path / 'log.bin', messages, {
        'ATC_RAT_RLL_P': 0.135, 'ATC_ANG_RLL_P': 4.5, 'ATC_RATE_R_MAX': 90.0, 'FRAME_CLASS': 2,
    })
    done, record = imported(path, tmp_path / 'bag')
    check_motion(record, flight)
    gains = record.gains_at(0.0)
    assert gains['roll.rate.kp'] == pytest.approx(0.135)
    assert gains['roll.angle.rate_limit'] == pytest.approx(np.pi / 2)
    assert 'no quadrotor in X' in ' '.join(done.warnings)


def blackbox(path: Path, flight: Flight, header: tuple[str, ...] = ()) -> Path:
    by_place = {k: 1000.0 + 1000.0 * v for k, v in flight.thrusts().items()}
    names = ['loopIteration', 'time (us)', 'setpoint[0]', 'setpoint[1]', 'setpoint[2]',
             'gyroADC[0]', 'gyroADC[1]', 'gyroADC[2]', 'motor[0]', 'motor[1]', 'motor[2]',
             'motor[3]', 'vbatLatest (V)', 'flightModeFlags (flags)']
    rates = np.degrees(flight.rates)
    columns = [np.arange(N), 5_000_000 + DT_US * np.arange(N), *rates.T, *rates.T,
               by_place['rear right'], by_place['front right'], by_place['rear left'],
               by_place['front left'], flight.volts]
    rows = [', '.join([f'{v:.9g}' for v in row] + ['ARM']) for row in zip(*columns, strict=True)]
    path.write_text('\n'.join([*header, ', '.join(names), *rows]) + '\n')
    return path


def test_betaflight(flight, tmp_path):
    done, record = imported(blackbox(tmp_path / 'LOG00001.01.csv', flight), tmp_path / 'bag')
    check_motion(record, flight)
    np.testing.assert_allclose(record.rate_setpoint, flight.rates, atol=1e-6)
    assert record.battery_v[0] == pytest.approx(12.0, abs=1e-3)
    assert record.angles is None
    assert 'feed-forward' in ' '.join(done.log.missing)


def test_betaflight_with_propellers_out_yaws_the_other_way(flight, tmp_path):
    path = blackbox(tmp_path / 'LOG.csv', flight, ('"yaw_motors_reversed","1"',))
    _, record = imported(path, tmp_path / 'bag')
    np.testing.assert_allclose(record.control[:, 3], -flight.control[:, 3], atol=1e-6)
    np.testing.assert_allclose(record.control[:, :3], flight.control[:, :3], atol=1e-6)


@pytest.mark.skipif(not SAMPLE.exists(), reason='no folder shared/data beside the checkout')
def test_a_real_px4_log_through_the_command(tmp_path, capsys):
    pytest.importorskip('pyulog')
    assert main(['import', str(SAMPLE), '--out', str(tmp_path / 'bag')]) == 0
    out = capsys.readouterr().out
    assert 'MAV_TYPE is 22' in out
    record = read_bag(tmp_path / 'bag')
    assert record.dt == pytest.approx(1 / 204.6, rel=1e-3)
    # at rest on the ground: gravity stands upwards, within the tilt of some degrees
    assert np.nanmedian(record.acceleration[:, 2]) == pytest.approx(9.81, abs=0.3)
    assert abs(np.nanmedian(record.rates)) < 0.01


def test_what_cannot_be_imported_is_one_line(flight, tmp_path, capsys):
    raw = tmp_path / 'LOG00001.BFL'
    raw.write_bytes(b'H Product:Blackbox flight data recorder\n')
    assert main(['import', str(raw), '--out', str(tmp_path / 'bag')]) == 2
    assert 'blackbox_decode' in capsys.readouterr().err
    log = blackbox(tmp_path / 'log.csv', flight)
    plain = tmp_path / 'plain.csv'
    plain.write_text('t,u\n0,1\n')
    assert main(['import', str(plain), '--out', str(tmp_path / 'bag')]) == 2
    assert '--axis' in capsys.readouterr().err
    broken = tmp_path / 'broken.csv'
    broken.write_text(log.read_text().replace('12, ARM', 'much, ARM', 1))
    with pytest.raises(BadInputError, match='needs numbers'):
        read_log(broken, kind_of(broken))
    assert not (tmp_path / 'bag').exists()


@pytest.mark.parametrize('magic', [b'ULog\x01\x12\x35', b'\xa3\x95\x80'])
def test_damaged_logs_are_one_line(tmp_path, magic, capsys):
    pytest.importorskip('pyulog')
    pytest.importorskip('pymavlink')
    path = tmp_path / 'log'
    path.write_bytes(magic + np.random.default_rng(1).bytes(400))
    assert main(['import', str(path), '--out', str(tmp_path / 'bag')]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
