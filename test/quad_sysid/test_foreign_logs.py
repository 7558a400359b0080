"""Logs of PX4, ArduPilot and Betaflight come back as what was flown, in our frames and units.

The logs are encoded here by hand, with each firmware's own motor places and senses written out, so
that nothing of the import's tables is used to make them.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from autopilot_logs import dataflash, quaternions, text_table, ulog

from quad_sysid.bags import read_bag
from quad_sysid.cli import main
from quad_sysid.imports import ardupilot, betaflight
from quad_sysid.imports.cli import table
from quad_sysid.imports.clock import Stream
from quad_sysid.imports.formats import format_of, read_log
from quad_sysid.imports.to_bag import import_log
from quad_sysid.loop.cascade import CascadeGains

SAMPLE = Path(__file__).resolve().parents[2] / '../shared/data/px4/sample_log_small.ulg'
DT_US = 4000
N = 1500


class Flight:
    """What happened, in our frames: FLU body rates, ENU angles, U1..U4; motors by their place."""

    def __init__(self) -> None:
        t = 1e-6 * DT_US * np.arange(N)
        self.rates = np.column_stack([np.sin(3 * t), 0.7 * np.cos(2 * t), 0.4 * np.sin(t)])
        self.angles = np.column_stack([0.3 * np.sin(t), 0.2 * np.cos(t), 0.5 + 0.1 * t])
        u1, u2, u3, u4 = self.control = np.stack([
            0.5 + 0.05 * np.sin(t), 0.08 * np.sin(5 * t), 0.06 * np.cos(4 * t),
            0.03 * np.sin(2 * t),
        ])
        self.control, self.volts = self.control.T, 12.0 - 0.01 * t
        # left up: positive roll; rear up: positive pitch (nose down); front right and rear left
        # turn counter-clockwise, more of the others turns the body so: positive yaw
        self.thrusts = {
            'front right': u1 - u2 - u3 - u4, 'rear left': u1 + u2 + u3 - u4,
            'front left': u1 + u2 - u3 + u4, 'rear right': u1 - u2 + u3 + u4,
        }


@pytest.fixture(scope='module')
def flight():
    return Flight()


def quaternion_ned(angles: np.ndarray) -> np.ndarray:
    """w x y z of the FRD body in NED."""
    return quaternions(np.array([0.0, 0.0, 0.5 * np.pi]) + angles * FRD)


FRD = np.array([1.0, -1.0, -1.0])
"""From our body axes to PX4's and ArduPilot's, and back."""
PX4 = 'front right', 'rear left', 'front left', 'rear right'
"""And ArduPilot."""
BETAFLIGHT = 'rear right', 'front right', 'rear left', 'front left'


def px4_topics(flight: Flight) -> dict:
    stamps = 2_000_000 + DT_US * np.arange(N)
    return {
        'vehicle_angular_velocity': {'timestamp': stamps, 'xyz': flight.rates * FRD},
        'vehicle_attitude': {'timestamp': stamps, 'q': quaternion_ned(flight.angles)},
        'actuator_motors': {
            'timestamp': stamps, 'control': np.column_stack([flight.thrusts[p] for p in PX4]),
        },
        'battery_status': {'timestamp': stamps, 'voltage_v': flight.volts},
    }


def by_torque(flight: Flight, topics: dict, per_axis=1.0) -> None:
    """Add the set-points of torque and thrust, of which PX4 makes its motors' commands."""
    stamps = topics['vehicle_attitude']['timestamp']
    for name, xyz in (('torque', FRD * flight.control[:, 1:] / per_axis),
                      ('thrust', flight.control[:, :1] * [0.0, 0.0, -1.0])):
        topics[f'vehicle_{name}_setpoint'] = {'timestamp': stamps, 'xyz': xyz}


def imported(path: Path, out: Path):
    """The bag's record, and what was warned of and found missing on the way."""
    done = import_log(read_log(path, format_of(path)), out)
    assert max(map(len, table(done)[1:])) <= 80
    return read_bag(done.path), ' '.join((*done.notes, *done.warnings, *done.log.missing))


def check_motion(record, flight: Flight, angles: float = 0.0) -> None:
    """Rates and commands as flown; with a tolerance, rad, the orientation too."""
    n = min(record.n, N)
    np.testing.assert_allclose(record.rates[:n], flight.rates[:n], atol=1e-5)
    np.testing.assert_allclose(record.control[:n], flight.control[:n], atol=1e-5)
    if angles:
        turned = np.mod(record.angles - flight.angles + np.pi, 2 * np.pi) - np.pi
        np.testing.assert_allclose(turned, 0.0, atol=angles)


@pytest.fixture
def px4(flight, tmp_path):
    """A function that imports a log of PX4: its topics changed, some rows dropped."""
    pytest.importorskip('pyulog')

    def record(parameters: dict, change=lambda _: None, drop=()):
        topics = px4_topics(flight)
        change(topics)
        return imported(ulog(tmp_path / 'log.ulg', topics, parameters, drop), tmp_path / 'bag')

    return record


def test_px4_rotors_stand_and_turn_as_its_parameters_say(flight, px4):
    """Speeds come from four speed controllers that drive the motors 2, 1, 4, 3."""
    rotors = {'CA_ROTOR_COUNT': 4}
    for i, (x, right, km) in enumerate(((0.2, 0.3, 0.05), (-0.2, -0.25, 0.05),
                                        (0.2, -0.3, -0.05), (-0.2, 0.25, -0.05))):
        rotors |= {f'CA_ROTOR{i}_PX': x, f'CA_ROTOR{i}_PY': right, f'CA_ROTOR{i}_KM': km}

    def with_speeds(topics):
        control, stamps = (topics['actuator_motors'][k] for k in ('control', 'timestamp'))
        topics['esc_status'] = {'timestamp': stamps} | {
            f'esc[{i}].{name}': value for i, motor in enumerate((1, 0, 3, 2)) for name, value in (
                ('esc_rpm', -3000.0 * control[:, motor]),
                ('actuator_function', np.full(N, 101.0 + motor)))}

    record, notes = px4(rotors, with_speeds)
    assert record.craft.places == PX4
    assert [m.spin for m in record.craft.motors] == [1, 1, -1, -1]
    assert record.craft.motors[1].y == pytest.approx(0.25)
    motors = np.column_stack([flight.thrusts[place] for place in record.craft.places])
    np.testing.assert_allclose(record.motors, motors, atol=1e-6)
    np.testing.assert_allclose(record.speeds, 100.0 * np.pi * motors, rtol=1e-5)
    assert 'CA_ROTOR' in notes


def test_px4_gains_in_our_unit_where_torque_was_logged_too(flight, px4, tmp_path, refusal):
    def with_torque(topics):
        by_torque(flight, topics, [0.25, 0.25, 0.125])
        topics['actuator_motors']['control'][: N // 6] = 0.0  # on the ground, where torque goes on

    record, _ = px4({'MC_ROLL_P': 6.5, 'MC_ROLLRATE_P': 0.15, 'MC_ROLLRATE_K': 2.0,
                     'MC_YAWRATE_P': 0.2, 'MC_ROLLRATE_MAX': 180.0}, with_torque)
    gains = record.gains_at(0.0)
    for name, value in (('roll.angle.kp', 6.5), ('roll.rate.kp', 0.15 * 2.0 * 0.25),
                        ('yaw.rate.kp', 0.2 * 0.125), ('roll.angle.rate_limit', np.pi)):
        assert gains[name] == pytest.approx(value, rel=1e-4)
    cut = tmp_path / 'cut.ulg'
    cut.write_bytes((tmp_path / 'log.ulg').read_bytes()[:-1])
    words = [' '.join(' '.join(table(import_log(read_log(path, format_of(path)), out))).split())
             for path, out in ((tmp_path / 'log.ulg', tmp_path / 'b'), (cut, tmp_path / 'c'))]
    assert all('roll=0.25, pitch=0.25, yaw=0.125' in text for text in words)
    assert ['ends within a message' in text for text in words] == [False, True]
    never = Stream(np.zeros(1), np.zeros((1, 1)))
    never_armed = replace(read_log(cut, format_of(cut)), armed=never)
    assert 'never change; the log ends within a message' in refusal(
        import_log, never_armed, tmp_path / 'd')


def test_px4_torque_and_thrust_stand_for_motors_that_were_not_logged(flight, px4):
    def instead(topics):
        del topics['actuator_motors']
        by_torque(flight, topics)

    record, notes = px4({'MAV_TYPE': 2, 'IMU_GYRO_CUTOFF': 40.0}, instead)
    assert record.dt == pytest.approx(1e-6 * DT_US)
    check_motion(record, flight, angles=1e-5)
    assert record.battery_v[0] == pytest.approx(12.0, abs=1e-3)
    assert 'vehicle_attitude_setpoint' in notes
    assert record.gains_at(0.0) == {'sensor.gyro_filter_hz': 40.0}


def test_of_a_log_with_a_reboot_and_damaged_numbers_what_was_flown_before_is_read(flight, px4):
    def harm(topics):
        topics['actuator_motors']['control'][700, 1] = 1e30
        topics['vehicle_angular_velocity']['xyz'][800, 2] = -1e20
        for columns in topics.values():
            for name, values in columns.items():
                again = values if name == 'timestamp' else values[::-1]
                columns[name] = np.concatenate([values, again])

    record, notes = px4({}, harm)
    assert 'begins anew 1 times' in notes
    assert '1 of 1500 actuator_motors.control left out: no controller commands so much' in notes
    assert '1 of 1500 vehicle_angular_velocity.xyz left out: no gyro' in notes
    assert np.flatnonzero(np.isnan(record.rates[:, 0])).tolist() == [800]
    np.testing.assert_allclose(record.control, flight.control, atol=2e-3)


def ardupilot_messages(flight: Flight) -> dict:
    stamps = 3_000_000 + DT_US * np.arange(N)
    pulses = [1000.0 + 1000.0 * flight.thrusts[place] for place in PX4]
    roll, pitch, yaw = np.degrees(flight.angles * [1.0, -1.0, -1.0]).T
    p, q, r = np.degrees(flight.rates * FRD).T
    u1, u2, u3, u4 = flight.control.T
    heading = np.mod(90.0 + yaw, 360.0)
    return {
        name: (('TimeUS', *labels.split()), np.column_stack([stamps, *columns])[::step])
        for name, labels, columns, step in (
            ('RATE', 'RDes R ROut PDes P POut YDes Y YOut AOut',
             (p, p, u2, q, q, -u3, r, r, -u4, u1), 1),
            ('ATT', 'DesRoll Roll DesPitch Pitch DesYaw Yaw',
             (roll, roll, pitch, pitch, heading, heading), 1),
            ('RCOU', 'C1 C2 C3 C4', pulses, 1), ('BAT', 'Volt', (flight.volts,), 25),
        )
    }


@pytest.mark.parametrize('text', [False, True])
def test_two_flights_with_a_reboot_between_them_in_one_log_follow_each_other(
        flight, tmp_path, text):
    """Their clocks overlap: sorted by time, every other sample would be of the other flight."""
    messages, content = ardupilot_messages(flight), b''
    messages['BAT'][1][2, 0] = 1e12  # µs: a wrong stamp moves no flight
    for kp, turned in ((0.135, 1.0), (0.2, -1.0)):
        labels, rows = messages['RATE']
        mine = {**messages, 'RATE': (labels, np.column_stack([rows[:, :1], turned * rows[:, 1:]]))}
        parameters = {'FRAME_CLASS': 1, 'FRAME_TYPE': 1, 'ATC_RAT_RLL_P': kp,
                      **{f'OTHER_{k}': 1.0 for k in range(30)}}
        if text:
            lines = ['ArduCopter V4.5.1 (0ef2c1a7)', 'FMT, 1, 1, PARM, QNf, TimeUS,Name,Value', *(
                f'PARM, 1, {name}, {value}' for name, value in parameters.items())]
            for name, (labels, rows) in mine.items():
                lines += [f'FMT, 1, 1, {name}, Q, {",".join(labels)}', *(
                    ', '.join([name, *map(repr, row)]) for row in rows.tolist())]
            content += '\n'.join([*lines, '']).encode()
        else:
            content += dataflash(tmp_path / 'one.bin', mine, parameters).read_bytes()
    path = tmp_path / ('log.log' if text else 'log.bin')
    path.write_bytes(content)
    record, notes = imported(path, tmp_path / 'bag')
    assert 'its clock begins anew 1 times: 2 flights' in notes
    assert record.n == pytest.approx(2 * N + 1250, abs=2)  # 2 s, and 3 s from boot to flight
    np.testing.assert_allclose(record.rates[:N], flight.rates, atol=1e-4)
    np.testing.assert_allclose(record.rates[-N:], -flight.rates, atol=1e-4)
    np.testing.assert_allclose(record.control[:N], flight.control, atol=1e-4)
    gains = [record.gains_at(t)['roll.rate.kp'] for t in (0.0, record.n * record.dt)]
    assert gains[1] / gains[0] == pytest.approx(0.2 / 0.135)


def test_ardupilot_pulses(flight, tmp_path):
    messages = ardupilot_messages(flight)
    stamps = messages['RCOU'][1][:, 0]
    messages['ESC'] = ('TimeUS', 'Instance', 'RPM'), np.concatenate([
        np.column_stack([stamps, np.full(N, float(i)), 60.0 * messages['RCOU'][1][:, 1 + i]])
        for i in range(4)])[np.argsort(np.tile(stamps, 4), kind='stable')]
    height = 3.0 + np.sin(1e-6 * (stamps - stamps[0]))
    rate = np.cos(1e-6 * (stamps - stamps[0]))
    messages['CTUN'] = ('TimeUS', 'ThO', 'Alt', 'CRt'), np.column_stack(
        [stamps, 0.4 + 0.0 * rate, height, np.rint(100.0 * rate)])[::5]
    for k in range(1, 5):  # as up to Copter 4.0, where MOT_PWM_MIN and MAX are 0
        messages['RCOU'][1][:, k] = 1100.0 + 0.8 * (messages['RCOU'][1][:, k] - 1000.0)
    path = dataflash(tmp_path / 'log.bin', messages,
                     {'FRAME_CLASS': 1, 'FRAME_TYPE': 1, 'ATC_RAT_RLL_P': 0.135,
                      'MOT_PWM_MIN': 0, 'MOT_PWM_MAX': 0, 'RC3_MIN': 1100, 'RC3_MAX': 1900,
                      'MOT_THST_EXPO': 0.0, 'MOT_SPIN_MIN': 0.1, 'MOT_SPIN_MAX': 0.9})
    record, notes = imported(path, tmp_path / 'bag')
    check_motion(record, flight, angles=1e-4)
    assert record.craft.places == PX4
    np.testing.assert_allclose(record.speeds, 2.0 * np.pi * (1000.0 + 1000.0 * record.motors),
                               rtol=1e-5)
    np.testing.assert_allclose(record.rate_setpoint, flight.rates, atol=1e-5)
    np.testing.assert_allclose(record.attitude_setpoint[:, :2], flight.angles[:, :2], atol=1e-5)
    # the largest factor of an axis is 0.5 there and 1 here; the pulses use 0.8 of their range
    assert record.gains_at(0.0)['roll.rate.kp'] == pytest.approx(0.135 * 0.5 * 0.8)
    assert 'thrust curve' in notes
    seen = np.isfinite(record.velocity[:, 2])
    assert seen.mean() == pytest.approx(0.2, abs=0.02)
    assert record.velocity[seen, 2] == pytest.approx(rate[seen], abs=0.01)
    assert record.altitude[seen] == pytest.approx(height[seen], abs=1e-3)
    assert not np.isfinite(record.velocity[:, :2]).any()


@pytest.mark.parametrize(('loop_hz', 'later'), [(500.0, 0.25), (250.0, 0.0)])
def test_commands_of_cycles_that_are_not_in_the_log_lie_between(flight, tmp_path, loop_hz, later):
    """Of a controller of 500 Hz the log has every second command, of one of 250 Hz each."""
    messages = ardupilot_messages(flight)
    del messages['RCOU']
    path = dataflash(tmp_path / 'log.bin', messages, {'SCHED_LOOP_RATE': loop_hz})
    record, notes = imported(path, tmp_path / 'bag')
    mean = (1.0 - later) * flight.control[:-1] + later * flight.control[1:]
    np.testing.assert_allclose(record.control[: N - 1], mean, atol=1e-5)
    assert ('commands on straight lines' in notes) is (later > 0.0)


@pytest.mark.parametrize(('topic', 'field', 'values'), [
    ('actuator_armed', 'armed', (0.0, 1.0)), ('vehicle_status', 'arming_state', (1.0, 2.0)),
    ('EV', 'Id', (11.0, 10.0)),
])
def test_while_disarmed_the_motors_stand_whatever_was_asked_for(
    flight, tmp_path, topic, field, values
):
    stamps = 3_000_000 + DT_US * np.array([0, N // 2])
    if topic == 'EV':
        messages = ardupilot_messages(flight)
        messages['EV'] = (('TimeUS', field), np.column_stack([stamps, values]))
        path = dataflash(tmp_path / 'log', messages, {'FRAME_CLASS': 1, 'FRAME_TYPE': 1})
    else:
        pytest.importorskip('pyulog')
        topics = px4_topics(flight) | {topic: {'timestamp': stamps, field: np.array(values)}}
        path = ulog(tmp_path / 'log', {name: {**columns, 'timestamp': columns['timestamp'] + (
            0 if name == topic else 1_000_000)} for name, columns in topics.items()}, {})
    record, notes = imported(path, tmp_path / 'bag')
    assert 'disarmed for 3 s of 6 s' in notes
    assert not record.control[: N // 2].any()
    np.testing.assert_allclose(record.control[N // 2 :], flight.control[N // 2 :], atol=1e-5)


@pytest.mark.parametrize('firmware', ['ArduPilot', 'PX4'])
def test_experiments_of_the_firmware_become_segments(flight, tmp_path, firmware):
    t = 1e-6 * DT_US * np.arange(N)
    on = (t >= 0.2) & (t < 5.8)
    if firmware == 'ArduPilot':
        messages, added, axis = ardupilot_messages(flight), 0.06 * np.sin(9.0 * t), 1
        stamps = messages['RATE'][1][on, 0]
        messages['SIDS'] = ('TimeUS', 'Ax', 'Mag'), np.array([[stamps[0], 11.0, 0.06]])
        injected = np.where(t < 5.8, added, 0.0)  # the mode goes on when its chirp has ended
        messages['SIDD'] = ('TimeUS', 'Time', 'Targ'), np.column_stack(
            [messages['RATE'][1][t >= 0.2, 0], t[t >= 0.2], -injected[t >= 0.2]])
        for _, rows in messages.values():  # of a clock that is fast by 0.01 %
            rows[:, 0] = np.rint(1.0001 * rows[:, 0])
        path = dataflash(tmp_path / 'log', messages, {'FRAME_CLASS': 1, 'FRAME_TYPE': 1})
        said = 'chirp', 'pitch', 'control'
    else:
        pytest.importorskip('pyulog')
        added, axis, topics = 0.5 * np.sign(np.sin(7.0 * t)), 0, px4_topics(flight)
        topics['autotune_attitude_control_status'] = {
            'timestamp': topics['vehicle_attitude']['timestamp'],
            'rate_sp': np.column_stack([np.where(on, added, 0.0), np.zeros((N, 2))])}
        path = ulog(tmp_path / 'log', topics, {})
        said = 'square', 'roll', 'rate'
    record, notes = imported(path, tmp_path / 'bag')
    used = [s for s in record.segments if s.role != 'idle']
    assert [s.role for s in used] == ['train', 'validation']
    assert {(s.signal, s.axis, s.injection) for s in used} == {said}
    assert (used[0].start_s, used[1].end_s) == (pytest.approx(0.2, abs=0.01),
                                                pytest.approx(5.8, abs=0.01))
    np.testing.assert_allclose(record.excitation[100:1400, axis], added[100:1400], atol=1e-6)
    assert 'the log holds experiments' in notes


@pytest.mark.parametrize('firmware', ['ArduPilot', 'PX4'])
def test_gains_that_are_set_in_flight_hold_from_then_on(flight, tmp_path, firmware):
    """At a third of the flight; what is set before it begins is not in it.

    There the filter of D, which had another name in earlier releases, is switched off.
    """
    if firmware == 'ArduPilot':
        messages, name, cut_off = ardupilot_messages(flight), 'ATC_RAT_RLL_P', 'ATC_RAT_RLL_FILT'
        del messages['RCOU']
        third = 3_000_000 + DT_US * N // 3
        path = dataflash(tmp_path / 'log.bin', messages,
                         {name: 0.1, 'ATC_RAT_PIT_P': 0.3, cut_off: 20.0},
                         [(2_000_000, name, 0.2), (third, name, 0.4), (third, cut_off, 0.0),
                          (2_900_000_000, 'ATC_RAT_PIT_P', 0.3)])
    else:
        pytest.importorskip('pyulog')
        topics, name, cut_off = px4_topics(flight), 'MC_ROLLRATE_P', 'MC_DTERM_CUTOFF'
        del topics['actuator_motors']
        by_torque(flight, topics)
        path = ulog(tmp_path / 'log.ulg', topics,
                    {name: 0.2, 'MC_PITCHRATE_P': 0.3, cut_off: 20.0, 'MC_ROLLRATE_FF': 0.0},
                    later=[(N // 3, name, 0.4), (N // 3, cut_off, 0.0)])
    record, _ = imported(path, tmp_path / 'bag')
    assert [change.time_s for change in record.gains] == [0.0, pytest.approx(2.0, abs=0.02)]
    assert [[change.values[f'{axis}.rate.kp'] for axis in ('roll', 'pitch')]
            for change in record.gains] == [pytest.approx([0.2, 0.3]), pytest.approx([0.4, 0.3])]
    filters = [CascadeGains.from_mapping(record.gains_at(time_s), 'roll').d_filter_hz
               for time_s in (0.0, 5.0)]
    assert filters[0] == pytest.approx(20.0)
    assert filters[1] > 1e5


@pytest.mark.parametrize('hundredths', [1.0, 100.0])
def test_copter_3_3_logs_rates_in_hundredths_of_a_degree(flight, tmp_path, hundredths):
    """By the size of the gyro, and not by that of one damaged message."""
    messages = ardupilot_messages(flight)
    labels, rows = messages['RATE']
    scaled = rows * [1.0, *(1.0 if name.endswith('Out') else hundredths for name in labels[1:])]
    scaled[-20, labels.index('R')] = 3e6
    messages['RATE'] = labels, scaled
    messages['IMU'] = ('TimeUS', 'GyrX', 'GyrY', 'GyrZ'), np.column_stack(
        [rows[:, 0], flight.rates * FRD])[::10]
    record, _ = imported(dataflash(tmp_path / 'log.bin', messages, {}), tmp_path / 'bag')
    np.testing.assert_allclose(record.rates[: N - 50], flight.rates[: N - 50], atol=1e-5)


def test_a_log_has_the_date_of_its_gps_or_its_header(flight, tmp_path):
    week = 2400
    begun_s = 315_964_800 + 604_800 * week - 18  # GPS time is ahead by the leap seconds
    messages = ardupilot_messages(flight)
    messages['GPS'] = ('TimeUS', 'GWk', 'GMS'), np.array([
        [3_000_000, 0, 0], [3_100_000, 1023, 0], [3_200_000, 1023, 0],
        [5_000_000, week, 2000], [6_000_000, week, 3000]])
    found, _ = imported(dataflash(tmp_path / 'log.bin', messages, {}), tmp_path / 'ardupilot')
    assert 1e-9 * found.t0_ns == pytest.approx(begun_s, abs=0.01)
    date = '"Log start datetime","2026-01-04T00:00:07.000+00:00"'
    for name, text, start_s in (('dated', date, 1_767_484_807.0),
                                ('no clock', date.replace('2026', '0000'), 1.0)):
        path = blackbox(tmp_path / f'{name}.csv', flight, (text,))
        assert 1e-9 * imported(path, tmp_path / name)[0].t0_ns == pytest.approx(start_s, abs=0.01)
    pytest.importorskip('pyulog')
    topics = px4_topics(flight)
    topics['vehicle_gps_position'] = {'timestamp': np.array([4_000_000, 5_000_000]),
                                      'time_utc_usec': np.array([0.0, 1.75 * 2.0**50])}
    found, _ = imported(ulog(tmp_path / 'log.ulg', topics, {}), tmp_path / 'px4')
    assert 1e-9 * found.t0_ns == pytest.approx(1.75e-6 * 2.0**50 - 3.0, abs=0.01)


def blackbox(path: Path, flight: Flight, header: tuple[str, ...] = ()) -> Path:
    names = ['loopIteration', 'time (us)', *(f'setpoint[{i}]' for i in range(3)),
             *(f'gyroADC[{i}]' for i in range(3)), *(f'motor[{i}]' for i in range(4)),
             'vbatLatest (V)', 'flightModeFlags (flags)']
    rates = np.degrees(flight.rates).T
    columns = [np.arange(N), 5_000_000 + DT_US * np.arange(N), *rates, *rates,
               *(1000.0 + 1000.0 * flight.thrusts[place] for place in BETAFLIGHT), flight.volts]
    rows = [', '.join([f'{v:.9g}' for v in row] + ['ARM']) for row in zip(*columns, strict=True)]
    path.write_text('\n'.join([*header, ', '.join(names), *rows]) + '\n')
    return path


@pytest.mark.parametrize('reversed_yaw', [False, True])
def test_betaflight(flight, tmp_path, reversed_yaw):
    header = ('"yaw_motors_reversed","1"',) if reversed_yaw else ()
    record, _ = imported(blackbox(tmp_path / 'LOG.csv', flight, header), tmp_path / 'bag')
    sign = [1.0, 1.0, 1.0, -1.0 if reversed_yaw else 1.0]
    np.testing.assert_allclose(record.control, flight.control * sign, atol=1e-6)
    assert record.craft.places == BETAFLIGHT
    motors = np.column_stack([flight.thrusts[place] for place in BETAFLIGHT])
    np.testing.assert_allclose(record.motors, motors, atol=1e-6)
    for rates in (record.rates, record.rate_setpoint):
        np.testing.assert_allclose(rates, flight.rates, atol=1e-5)
    assert record.battery_v[0] == pytest.approx(12.0, abs=1e-3)
    assert record.angles is None


def varied(value: int) -> bytes:
    """Seven bits a byte, the least first."""
    out = []
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])


def encoded(columns: dict[str, np.ndarray], header: dict[str, str], event: bytes = b'') -> bytes:
    """A blackbox file of whole frames, every field a signed number of seven bits a byte.

    event: stands half-way.
    """
    names = ['loopIteration', 'time', *columns]
    lines = ['Product:Blackbox flight data recorder by Nicholas Sherlock', 'Data version:2',
             'I interval:1', 'P interval:1/1', f'Field I name:{",".join(names)}',
             f'Field I signed:{",".join("1" for _ in names)}',
             f'Field I predictor:{",".join("0" for _ in names)}',
             f'Field I encoding:{",".join("0" for _ in names)}',
             *(f'{key}:{value}' for key, value in header.items())]
    out = ''.join(f'H {line}\n' for line in lines).encode()
    rows = np.column_stack([np.arange(N), 5_000_000 + DT_US * np.arange(N), *columns.values()])
    for k, row in enumerate(np.rint(rows).astype(int).tolist()):
        out += event if k == N // 2 else b''
        out += b'I' + b''.join(varied(2 * v if v >= 0 else -2 * v - 1) for v in row)
    return out + b'E\xffEnd of log\0'


@pytest.mark.parametrize(('cycle', 'stated', 'seconds'), [
    (ardupilot._loop_s, {'SCHED_LOOP_RATE': 400.0, 'FSTRATE_ENABLE': 0.0}, 0.0025),
    (ardupilot._loop_s, {'SCHED_LOOP_RATE': 400.0, 'FSTRATE_ENABLE': 1.0}, None),
    (ardupilot._loop_s, {}, None),
    (betaflight._loop_s, {'looptime': '125', 'pid_process_denom': '2'}, 0.00025),
    (betaflight._loop_s, {'looptime': '500'}, 0.0005),
    (betaflight._loop_s, {'looptime': 'fast'}, None), (betaflight._loop_s, {}, None),
])
def test_the_controllers_cycle_is_what_the_log_states(cycle, stated, seconds):
    assert cycle(stated) == seconds


def test_encoded_blackbox_files_hold_several_logs(flight, tmp_path, printed, refused):
    pytest.importorskip('orangebox')
    columns = {
        **{f'gyroADC[{i}]': np.degrees(flight.rates[:, i]) for i in range(3)},
        **{f'motor[{i}]': 48.0 + 1999.0 * flight.thrusts[p] for i, p in enumerate(BETAFLIGHT)},
        **{f'eRPM[{i}]': 100.0 + i + 50.0 * flight.thrusts[p] for i, p in enumerate(BETAFLIGHT)},
        'vbatLatest': 100.0 * flight.volts,
        **{f'attitude[{i}]': np.degrees(10.0 * x) for i, x in enumerate(
            (flight.angles * [1.0, 1.0, -1.0] + [0.0, 0.0, 0.5 * np.pi]).T)},
    }
    header = {'motorOutput': '48,2047', 'motor_poles': '12', 'gyro_scale': '0x3f800000',
              'rollPID': '45,80,40', 'acc_1G': 'abc'}
    still = {name: 0.0 * values for name, values in columns.items()}
    path = tmp_path / 'LOG00001.BBL'
    path.write_bytes(encoded(still, header) + encoded(columns, header))
    said = printed(main, 'import', path, '--log', 2, '--out', tmp_path / 'bag')
    assert 'rollPID 45,80,40' in ' '.join(said.split())
    record = read_bag(tmp_path / 'bag')
    n = record.n
    assert n > 0.99 * N
    np.testing.assert_allclose(record.rates, flight.rates[:n], atol=np.radians(0.51))
    np.testing.assert_allclose(record.control, flight.control[:n], atol=1e-3)
    np.testing.assert_allclose(record.angles, flight.angles[:n], atol=np.radians(0.06))
    assert record.battery_v[0] == pytest.approx(12.0, abs=0.02)
    turns = 100.0 + np.arange(4) + 50.0 * record.motors
    np.testing.assert_allclose(record.speeds, turns * 100.0 / 6.0 * np.pi / 30.0, rtol=0.01)
    assert 'must be 1 to 2' in refused(main, 'import', path, '--log', 3, '--out', tmp_path / 'b')
    assert 'needs no column names: found --frame' in refused(
        main, 'import', path, '--frame', 'frd', '--out', tmp_path / 'b')
    assert '--log: a bag holds one log: found 2; leave it out' in refused(
        main, 'look', tmp_path / 'bag', '--log', 2)
    assert f'quad-sysid import {path} --out' in printed(main, 'import', path)
    assert 'commands that never change' in refused(main, 'import', path, '--out', tmp_path / 'b')
    whole = encoded(columns, header)
    path.write_bytes(whole.replace(b'Field I predictor', b'Field I pr\1dictor'))
    assert 'in its header: copy it again' in refused(main, 'inspect', path)
    path.write_bytes(whole.replace(b'\xffEnd of log\0', b'\xff\1End of log\0'))
    assert main(['import', str(path), '--out', str(tmp_path / 'inav')]) == 0  # as INAV ends a log
    assert '--log: the file holds one log: found 2; leave it out' in refused(
        main, 'import', path, '--log', 2, '--out', tmp_path / 'b')


@pytest.mark.skipif(not SAMPLE.exists(), reason='no folder shared/data beside the checkout')
def test_frames_behind_damage_wait_for_one_that_builds_on_none(tmp_path):
    pytest.importorskip('orangebox')
    raw = (SAMPLE.parents[1] / 'autopilots/bf_sitl_quad.BFL').read_bytes()[:100_000]
    read = []
    for content in (raw, raw[:50_000] + bytes(400) + raw[50_400:]):
        (tmp_path / 'log').write_bytes(content)
        rates = betaflight.read(tmp_path / 'log').rates
        read.append({*map(tuple, np.column_stack([rates.time_s, rates.values]).tolist())})
    assert 0 < len(read[0] - read[1]) < 100
    assert read[1] < read[0]


def test_a_gain_that_a_knob_turns_has_the_time_of_the_log(flight, tmp_path):
    """Which begins at one second; the board had run for five when this one began."""
    pytest.importorskip('orangebox')
    columns = {
        **{f'gyroADC[{i}]': np.degrees(flight.rates[:, i]) for i in range(3)},
        **{f'motor[{i}]': 48.0 + 1999.0 * flight.thrusts[p] for i, p in enumerate(BETAFLIGHT)}}
    header = {'Firmware revision': 'Betaflight 4.5.1', 'motorOutput': '48,2047',
              **{f'{axis}PID': '45,80,40' for axis in ('roll', 'pitch', 'yaw')}}
    path = tmp_path / 'LOG00001.BBL'
    path.write_bytes(encoded(columns, header, b'E\x0d\x12' + varied(2 * 90)))  # P of roll is 90
    record, _ = imported(path, tmp_path / 'bag')
    before, after = record.gains
    assert (before.time_s, after.time_s) == (0.0, pytest.approx(1e-6 * DT_US * N / 2, abs=0.02))
    assert after.values['roll.rate.kp'] == pytest.approx(2.0 * before.values['roll.rate.kp'])
    assert after.values['yaw.rate.kp'] == pytest.approx(before.values['yaw.rate.kp'])


def test_the_chirp_of_betaflight_is_what_its_controller_adds(tmp_path):
    """Cosine, less below 1 Hz, and a lead-lag from 3 to 30 Hz: here by its gain and phase."""
    t, rng = np.arange(0.0, 22.0, 1e-3), np.random.default_rng(1)
    steep = np.log(20.0 / 0.5) / 20.0
    hertz = 0.5 * np.exp(steep * t)
    phase = np.mod(2.0 * np.pi * (hertz - 0.5) / steep, 2.0 * np.pi)
    lead_lag = (1.0 + 1j * hertz / 30.0) / (1.0 + 1j * hertz / 3.0)
    added = np.radians(230.0) * np.abs(lead_lag) * np.cos(phase + np.angle(lead_lag))
    added *= np.minimum(hertz, 1.0)
    header = {'Firmware revision': 'Betaflight 2025.12.0', 'chirp_amplitude_pitch': 230,
              'chirp_lag_freq_hz': 3, 'chirp_lead_freq_hz': 30}
    columns = {'loopIteration': np.arange(t.size), 'time': 1e6 * t,
               **{f'gyroADC[{i}]': rng.normal(0.0, 1.0, t.size) for i in (0, 2)},
               'gyroADC[1]': np.degrees(added), 'debug[0]': np.rint(5000.0 * phase),
               **{f'motor[{i}]': rng.uniform(1400.0, 1600.0, t.size) for i in range(4)}}
    above = ''.join(f'"{name}","{value}"\n' for name, value in header.items())
    path = text_table(tmp_path / 'LOG.csv', columns, above=above)
    (chirp,) = read_log(path, format_of(path)).experiments
    assert (chirp.axis, chirp.signal, chirp.injection) == ('pitch', 'chirp', 'rate')
    n = chirp.added.time_s.size
    np.testing.assert_allclose(chirp.added.values[500:, 0], added[t.size - n :][500:],
                               atol=0.02 * np.radians(230.0))


def test_high_resolution_is_seen_without_a_header(flight, tmp_path):
    """blackbox_decode writes tenths of degrees and of sticks, and leaves the header out."""
    path = text_table(tmp_path / 'LOG.csv', {
        'loopIteration': np.arange(N), 'time': DT_US * np.arange(N),
        **{f'gyroADC[{i}]': 10.0 * np.degrees(flight.rates[:, i]) for i in range(3)},
        **{f'motor[{i}]': 1000.0 + 1000.0 * flight.thrusts[p] for i, p in enumerate(BETAFLIGHT)},
        'rcCommand[3]': np.full(N, 14_000.0)})
    log = read_log(path, format_of(path))
    np.testing.assert_allclose(log.rates.values, flight.rates, atol=1e-6)


@pytest.mark.parametrize(('scale', 'rad_s'), [
    ('0x3d79c190', np.radians(0.06097561)), (str(0x3D79C190), np.radians(0.06097561)),
    ('0.0609756', np.radians(0.0609756)), ('1', np.radians(1.0)), ('?', np.radians(1.0)),
])
def test_the_scale_of_the_gyro_is_a_number_or_the_bits_of_one(scale, rad_s):
    table = betaflight.Table('LOG', {}, header={'gyro_scale': scale})
    assert betaflight._rate_unit(table, '') == pytest.approx(rad_s, rel=1e-5)


@pytest.mark.parametrize('down', [True, False])
def test_indiflight_says_its_frame_by_gravity_and_names_no_layout(flight, tmp_path, down):
    """Its sensors' z axis points down, in its first versions up; half of its slots are empty."""
    turned = FRD if down else np.ones(3)
    path = text_table(tmp_path / 'LOG.csv', {
        'loopIteration': np.arange(N), 'time': DT_US * np.arange(N),
        **{f'gyroADC[{i}]': np.degrees(flight.rates * turned)[:, i] for i in range(3)},
        **{f'accSmooth[{i}]': np.full(N, 2048.0 * turned[2] * (i == 2)) for i in range(3)},
        **{f'quat[{i}]': 8127.0 * quaternion_ned(flight.angles)[:, i] for i in range(4)},
        **{f'u[{i}]': 8127.0 * thrust for i, thrust in enumerate(flight.thrusts.values())},
        **{f'u[{i}]': np.zeros(N) for i in range(4, 8)},
    })
    log = read_log(path, format_of(path))
    np.testing.assert_allclose(log.rates.values, flight.rates, atol=1e-6)
    np.testing.assert_allclose(log.acceleration.values, [[0.0, 0.0, 9.80665]] * N, atol=1e-4)
    np.testing.assert_allclose(log.motors.values, np.column_stack([*flight.thrusts.values()]),
                               atol=1e-6)
    angles = np.mod(log.angles.values - flight.angles + np.pi, 2 * np.pi) - np.pi
    np.testing.assert_allclose(angles, 0.0, atol=1e-6)
    assert log.crafts == ()


@pytest.mark.skipif(not SAMPLE.exists(), reason='no folder shared/data beside the checkout')
def test_a_real_px4_log_through_the_command(tmp_path, printed, refused):
    pytest.importorskip('pyulog')
    error = refused(main, 'import', SAMPLE, '--out', tmp_path / 'bag', '--mixer', 'x')
    assert 'holds no motor commands' in error
    out = ' '.join(printed(main, 'import', SAMPLE, '--out', tmp_path / 'bag').split())
    assert 'MAV_TYPE is 22, no multirotor' in out
    assert 'the angles are left out, and speed and position with them' in out
    record = read_bag(tmp_path / 'bag')
    assert record.dt == pytest.approx(1 / 284.7, rel=0.03)
    # at rest on the ground: gravity stands upwards, within the tilt of some degrees
    assert np.nanmedian(record.acceleration[:, 2]) == pytest.approx(9.81, abs=0.3)
    assert abs(np.nanmedian(record.rates)) < 0.01


@pytest.mark.parametrize(
    ('name', 'content', 'words'),
    [
        ('LOG00001.BFL', b'H Product:Blackbox flight data recorder\n', 'holds no frames'),
        ('plain.csv', b't,u\n0,1\n', 'columns need names'),
        ('log.csv', b'', 'log.csv, line 2, column vbatLatest (V): needs a number'),
        *(('log', magic + np.random.default_rng(1).bytes(400), '')
          for magic in (b'ULog\x01\x12\x35', b'\xa3\x95\x80')),
    ],
)
def test_what_cannot_be_imported_is_one_line(flight, tmp_path, refused, name, content, words):
    pytest.importorskip('pyulog')
    path = tmp_path / name
    if content:
        path.write_bytes(content)
    else:
        path.write_text(blackbox(path, flight).read_text().replace('12, ARM', 'much, ARM', 1))
    assert words in refused(main, 'import', path, '--out', tmp_path / 'bag')
    assert not (tmp_path / 'bag').exists()
