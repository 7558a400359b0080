"""What the bridge makes of other autopilots, as they were seen (test/autopilots.py)."""

import math
from dataclasses import replace
from itertools import pairwise

import pytest
from autopilots import ALL, ARDUPILOT, BETAFLIGHT, GRAVITY, PX4, Autopilot, mav
from flight_controller import HOST0_NS, FlightController, Line, Port, Pty

from quad_bridge.craft import LAYOUTS, from_urdf
from quad_bridge.link.autopilot import Autopilot as TheirTopics
from quad_bridge.link.autopilot import Inertial
from quad_bridge.link.report import clock_status
from quad_bridge.motor_outputs import motor_outputs
from quad_bridge.wire import frames as f

OURS = ['/control/wrench', '/setpoint/attitude', '/setpoint/rates', '/excitation/applied']


def flown(peer, seconds=4.0):
    line = Line(peer)
    line.fly(seconds)
    return line


def sources(line):
    """Topic to the messages that fed it in the last second."""
    late = [item for item in line.out if item.stamp_ns > line.now_ns - 1_000_000_000]
    return {topic: {getattr(i.frame, 'name', '') for i in late if i.topic == topic}
            for topic in {item.topic for item in late}}  # fmt: skip


def inertial(line):
    return [item.frame for item in line.out if isinstance(item.frame, Inertial)]


def late_rate_hz(line, topic):
    begin_ns = line.now_ns - 2_000_000_000
    return sum(i.topic == topic and i.stamp_ns > begin_ns for i in line.out) / 2.0


def stamps_are_true(line, off_ms=1.0):
    """Every topic's stamps rise, and are the time at which the message was made."""
    for topic in {item.topic for item in line.out}:
        stamps = [item.stamp_ns for item in line.out if item.topic == topic]
        assert all(b > a for a, b in pairwise(stamps)), topic
        assert min(stamps) > HOST0_NS, topic
        assert max(stamps) <= line.now_ns + 1e6 * off_ms, topic
    boot_ms = 1e-3 * line.controller.boot_us
    for item in line.out:
        if (time_ms := getattr(item.frame, 'time_ms', None)) is not None:
            true_ms = 1e-6 * HOST0_NS + (time_ms - boot_ms + 2**31) % 2**32 - 2**31
            assert abs(1e-6 * item.stamp_ns - true_ms) < off_ms + 1.0, item.topic


def throttle_first(kind, prefix):
    """An autopilot whose receiver sends throttle, roll, pitch, yaw."""
    channels = {'ROLL': 2, 'PITCH': 3, 'THROTTLE': 1, 'YAW': 4}
    maps = {prefix + stick: channel for stick, channel in channels.items()}
    return replace(kind, sticks=(2, 0, 1, 3), parameters={**kind.parameters, **maps})


def test_px4_is_raised_from_the_rates_at_which_its_streams_came():
    line = flown(Autopilot(throttle_first(PX4, 'RC_MAP_')))
    asked = {name: rates[0] for name, rates in line.controller.asked.items()}
    assert {name: asked[name] for name in ('HIGHRES_IMU', 'ATTITUDE', 'RC_CHANNELS')} == {
        'HIGHRES_IMU': 250.0, 'ATTITUDE': 250.0, 'RC_CHANNELS': 50.0,
    }  # fmt: skip
    assert late_rate_hz(line, '/imu/data') == pytest.approx(250.0, abs=2)
    assert late_rate_hz(line, '/rc/in') == pytest.approx(50.0, abs=1)
    sticks = [i.frame.channels[:4] for i in line.out if i.topic == '/rc/in']
    assert sticks[-1] == (1500, 1600, 1200, 1450)
    assert line.link.name == 'PX4'
    assert line.link.autopilot.missing(line.now_ns) == OURS
    last = inertial(line)[-1]
    assert last.accel == pytest.approx((0.0, 0.0, -GRAVITY), abs=1e-5)
    assert last.gyro[1:] == pytest.approx((-0.25, 0.125))
    assert last.attitude[1:] == pytest.approx((0.2, 0.3))
    airs = [i.frame.pressure_hpa for i in line.out if i.topic == '/baro']
    assert airs[-1] == pytest.approx(1000.0)  # 1.16 sends Pa
    stamps_are_true(line)


def test_ardupilots_false_compass_costs_the_compass_alone_and_another_message_has_it():
    line = flown(Autopilot(ARDUPILOT))
    assert late_rate_hz(line, '/imu/data') == pytest.approx(250.0, abs=2)
    assert all(frame.gyro and frame.accel for frame in inertial(line)[-100:])
    assert sources(line) == {
        '/imu/data': {''}, '/motors/command': {''}, '/imu/mag': {'SCALED_IMU'},
        '/baro': {'HIGHRES_IMU'}, '/rc/in': {'RC_CHANNELS'}, '/battery': {'BATTERY_STATUS'},
        '/motors/state': {'ESC_TELEMETRY_1_TO_4'},
    }  # fmt: skip
    mags = [i.frame.mag_gauss for i in line.out if i.topic == '/imu/mag']
    assert mags[-1] == pytest.approx((0.2, 0.1, -0.4))
    assert line.controller.asked['SCALED_IMU'] == [50.0]  # for the compass alone
    assert line.link.decoder.counts.implausible > 900
    stamps_are_true(line)


def test_betaflights_rates_of_exactly_zero_are_unknown_and_its_raw_channels_are_read():
    line = flown(Autopilot(BETAFLIGHT), 7.0)
    assert line.link.name == 'Betaflight'
    assert [frame.gyro for frame in inertial(line)[-20:]] == [None] * 20
    assert inertial(line)[-1].attitude[1:] == pytest.approx((0.2, 0.3))
    assert line.link.autopilot.without_rates
    assert sources(line)['/rc/in'] == {'RC_CHANNELS_RAW'}
    sticks = [i.frame.channels[:4] for i in line.out if i.topic == '/rc/in']
    assert set(sticks) == {(1500, 1600, 1200, 1450)}  # it sends yaw before throttle
    assert line.link.clock.one_way
    stamps_are_true(line)
    line = flown(Autopilot(BETAFLIGHT, rates=True, sticks=(0, 1, 2, 3)))
    assert None not in [frame.gyro for frame in inertial(line)]
    assert line.link.name == 'the autopilot'  # a generic one, whose channels are as usual
    sticks = [i.frame.channels[:4] for i in line.out if i.topic == '/rc/in']
    assert set(sticks) == {(1500, 1600, 1200, 1450)}


ONE_EACH = {
    '/imu/data': ('HIGHRES_IMU', 'SCALED_IMU', 'ATTITUDE'),
    '/imu/mag': ('HIGHRES_IMU', 'SCALED_IMU'), '/baro': ('HIGHRES_IMU', 'SCALED_PRESSURE'),
    '/rc/in': ('RC_CHANNELS', 'RC_CHANNELS_RAW', 'MANUAL_CONTROL'),
    '/battery': ('BATTERY_STATUS', 'SYS_STATUS')}


@pytest.mark.parametrize('without', [
    (), ('HIGHRES_IMU',), ('HIGHRES_IMU', 'SCALED_IMU'),
    ('RC_CHANNELS', 'RC_CHANNELS_RAW', 'BATTERY_STATUS'),
])  # fmt: skip
def test_each_topic_has_one_source_the_best_that_comes(without):
    only = tuple(name for name in ALL if name not in without)
    line = flown(Autopilot(throttle_first(ARDUPILOT, 'RCMAP_'), only=only, gauss=1.0,
                           unasked=dict.fromkeys(ALL, 50.0)))  # fmt: skip
    best = {topic: next((name for name in names if name in only), None)
            for topic, names in ONE_EACH.items()}  # fmt: skip
    late = sources(line)
    for topic in ('/imu/mag', '/baro', '/rc/in', '/battery'):
        assert late.get(topic, {None}) == {best[topic]}
    sticks = [i.frame.channels[:4] for i in line.out if i.topic == '/rc/in']
    assert sticks[-1] == (1500, 1600, 1200, 1450)
    last = inertial(line)[-1]
    assert (last.accel is None) == (best['/imu/data'] == 'ATTITUDE')
    assert last.gyro[1:] == pytest.approx((-0.25, 0.125))
    stamps_are_true(line)


def test_of_several_batteries_the_one_with_the_lowest_number_counts():
    topics = TheirTopics()
    numbers = (1, 0, 1, 0)
    counted = [topics.battery(f.Battery(12.0, number=number), 0) for number in numbers]
    assert counted == [True, True, False, True]


def test_old_angles_are_not_given_to_rates_without_any():
    topics, rates = TheirTopics(), f.SlowSensors(0, gyro=(0.1, 0.0, 0.0))
    topics.inertial(f.Attitude(0, (0.1, 0.0, 0.0), rates.gyro), 0)
    given = [topics.inertial(rates, now_ns).attitude for now_ns in (250_000_000, 350_000_000)]
    assert given == [(0.1, 0.0, 0.0), None]


US_WRAPS, MS_WRAPS = 2**32, 1000 * 2**32
"""Counters of 32 bits: after 71.6 minutes and 49.7 days."""


@pytest.mark.parametrize(('kind', 'boot_us'), [
    (PX4, US_WRAPS - 3_000_000), (PX4, MS_WRAPS - 3_000_000), (PX4, MS_WRAPS + 7_000_000),
    (ARDUPILOT, 40 * 60_000_000), (ARDUPILOT, MS_WRAPS - 3_000_000),
    (BETAFLIGHT, US_WRAPS - 3_000_000), (BETAFLIGHT, US_WRAPS + 7_000_000),
])  # fmt: skip
def test_no_stamp_of_any_topic_jumps_where_a_counter_wraps(kind, boot_us):
    line = flown(Autopilot(kind, boot_us=boot_us, timesync_s=0.0002), 5.0)
    stamps_are_true(line)
    assert line.link.stamping.false_times == 0
    topic, least_hz = ('/imu/data', 9.0) if kind is BETAFLIGHT else ('/motors/command', 240.0)
    assert late_rate_hz(line, topic) >= least_hz


@pytest.mark.parametrize(('taken_s', 'words', 'one_way'), [
    (0.004, 'converged', False),
    (0.040, 'TIMESYNC takes 40 ms there and back, more than 10: stamps are times of arriv', True),
    (None, 'no answer to TIMESYNC: stamps are times of arrival', True),
])  # fmt: skip
def test_slow_answers_to_timesync_are_told_as_that(taken_s, words, one_way):
    only = ('HIGHRES_IMU', 'ATTITUDE')
    line = flown(Autopilot(ARDUPILOT, timesync_s=taken_s, only=only), 6.0)
    told = clock_status(line.link, 0, unset=False, now_s=1e-9 * line.now_ns)
    assert words in told.message
    assert line.link.clock.one_way == one_way
    stamps_are_true(line, off_ms=2.5)


def test_streams_that_give_way_to_its_log_are_not_asked_for_and_nobody_is_blamed():
    line = flown(Autopilot(ARDUPILOT), 4.0)
    autopilot = line.link.autopilot
    asked, line.controller.share = line.controller.heard.count('COMMAND_LONG'), 0.25
    autopilot.log_comes(now=True)
    line.fly(4.0)
    assert line.controller.heard.count('COMMAND_LONG') == asked
    assert not autopilot.slow_ones(line.now_ns)
    line.controller.share = 1.0
    autopilot.log_comes(now=False)
    line.fly(4.0)
    assert late_rate_hz(line, '/imu/data') == pytest.approx(250.0, abs=2)
    assert not autopilot.lowered


def test_an_autopilot_that_restarts_is_raised_again_and_nobody_is_blamed():
    line = flown(Autopilot(PX4, boot_us=60_000_000), 3.0)
    line.controller = Autopilot(PX4, boot_us=-3_000_000)
    line.controller.step = 750  # its time is 0 again
    line.fly(5.0)
    assert late_rate_hz(line, '/imu/data') == pytest.approx(250.0, abs=2)
    assert not line.link.autopilot.lowered
    for topic in {item.topic for item in line.out}:
        stamps = [item.stamp_ns for item in line.out if item.topic == topic]
        assert all(b > a for a, b in pairwise(stamps)), topic
        assert max(stamps) <= line.now_ns + 1_000_000
    first = next(i for i in line.out if i.stamp_ns > HOST0_NS + 3_500_000_000)
    assert first.stamp_ns < HOST0_NS + 5_000_000_000  # it was not silent for long


OLD = replace(ARDUPILOT, parameters={  # as up to Copter 4.0, with the throttle on channel 1
    **ARDUPILOT.parameters, 'MOT_PWM_MIN': 0, 'MOT_PWM_MAX': 0, 'RCMAP_ROLL': 3,
    'RCMAP_THROTTLE': 1, 'RC1_MIN': 1050, 'RC1_MAX': 1550, 'RC3_MIN': 1, 'RC3_MAX': 2})


@pytest.mark.parametrize('kind', [PX4, ARDUPILOT, OLD], ids=['PX4', 'ArduPilot', 'Copter 3'])
def test_the_craft_is_read_from_the_autopilots_parameters(kind):
    line = flown(Autopilot(kind), 2.0)
    peer, parameters = line.described
    true = {name: value for name, value in kind.parameters.items() if name in parameters}
    assert parameters == pytest.approx(true, rel=1e-6)
    assert len(parameters) >= 17
    motors = motor_outputs(peer.autopilot, line.link.name, parameters)
    layout = LAYOUTS['px4_quad_x' if kind is PX4 else 'ardupilot_quad_plus']
    assert motors.craft.signs == layout.signs
    efforts = [0.1, 0.3, 0.5, 0.7] if kind is OLD else [0.1, 0.2, 0.3, 0.4]
    assert motors.efforts((1100, 1200, 1300, 1400)) == pytest.approx(efforts)
    assert from_urdf(motors.craft.to_urdf()).signs == layout.signs
    assert 'PARAM_REQUEST_LIST' not in line.controller.heard  # a thousand, of which few are needed


def test_outputs_in_another_order_are_followed():
    functions = {'SERVO1_FUNCTION': 0} | {f'SERVO{k}_FUNCTION': 38 - k for k in range(2, 6)}
    told = {'FRAME_CLASS': 1, 'FRAME_TYPE': 1, **functions}
    assert motor_outputs(3, 'ArduPilot', told).channels == (4, 3, 2, 1)
    rows = {f'CA_ROTOR{k}_{part}': value for k, row in enumerate(((1, 0, 1), (-1, 0, -1)))
            for part, value in zip(('PX', 'PY', 'KM'), row, strict=True)}  # fmt: skip
    told = {'CA_ROTOR_COUNT': 2, **rows, 'PWM_MAIN_FUNC3': 102, 'PWM_MAIN_FUNC6': 101}
    assert motor_outputs(12, 'PX4', told).channels == (5, 2)


def test_who_does_not_tell_is_taken_for_an_x_frame_and_that_is_said():
    line = flown(FlightController(), 1.0)  # another one was on the port before
    line.opened()
    line.controller = Autopilot(PX4, parameters={})
    line.controller.step = line.steps
    line.fly(6.0)
    peer, parameters = line.described
    motors = motor_outputs(peer.autopilot, line.link.name, parameters)
    assert (motors.craft, motors.channels) == (None, (1, 3, 0, 2))
    assert 'PX4 has no CA_ROTOR_COUNT: its motors are taken for an X frame' in motors.words
    assert late_rate_hz(line, '/motors/command') == pytest.approx(250.0, abs=2)
    given = motor_outputs(peer.autopilot, 'PX4', {}, LAYOUTS['ardupilot_hexa_x'])
    assert (given.craft.count, given.channels) == (6, (0, 1, 2, 3, 4, 5))


# Other programs on the same line (docs/beside.md).


class Shared(Line):
    """A router joins all: what the autopilot sends all hear, what a party says all others hear."""

    def __init__(self, peer, *sender):
        self.party, self.party_heard = mav.MAVLink(None, *sender), []
        self.party.robust_parsing = True
        super().__init__(peer)

    def hear(self, data, late_ns=0):
        self.party_heard += self.party.parse_buffer(data) or []
        super().hear(data, late_ns)

    def fly_beside(self, seconds, every_s, *messages):
        for _ in range(round(seconds / every_s)):
            data = b''.join(bytes(message.pack(self.party)) for message in messages)
            self.hear(data)
            self.hear(self.controller.receive(data, self.since_ns))
            self.fly(every_s)


GROUND_STATION = mav.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)
MAVROS = mav.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3)


@pytest.mark.parametrize(
    ('sender', 'beat'), [((255, 190), GROUND_STATION), ((1, 240), MAVROS), ((1, 191), MAVROS)],
    ids=['ground station', 'mavros', 'a second bridge'])
def test_a_program_beside_is_not_taken_for_the_aircraft(sender, beat):
    line = Shared(Autopilot(PX4), *sender)
    read = mav.MAVLink_param_request_read_message(1, 1, b'CA_ROTOR_COUNT', -1)
    line.fly_beside(4.0, 0.5, beat, mav.MAVLink_timesync_message(0, 123), read)
    link = line.link
    assert (link.peer.system, link.peer.component) == (1, 1)
    assert link.decoder.counts.foreign >= 16
    assert link.name == 'PX4'
    assert line.described.parameters['CA_ROTOR_COUNT'] == 4
    stamps_are_true(line)
    # and the autopilot's answers reach the other one
    assert {'TIMESYNC', 'PARAM_VALUE'} <= {m.get_type() for m in line.party_heard}


PUBLISHED = ('/imu/data', '/motors/command', '/motors/state', '/rc/in', '/imu/mag', '/baro',
             '/battery', '/robot_description')  # fmt: skip
REFUSED = ('refused: ArduPilot: the parameter gains is off: read docs/ardupilot.md, then start '
           'the bridge with gains:=allow')
MISSING = 'ArduPilot sends standard MAVLink messages only: without QUAD_CYCLE there is no'


def test_the_node_publishes_what_it_can_and_says_what_is_missing(tmp_path, probe, start):
    heard = {topic: probe.listen(topic) for topic in (*PUBLISHED, '/control/wrench')}
    with Port(Autopilot(ARDUPILOT), Pty(tmp_path / 'tty')):
        bridge = start('serial_bridge', port=tmp_path / 'tty', state_folder=tmp_path)
        probe.until(lambda: min(len(heard[topic]) for topic in PUBLISHED) > 0)
        probe.until(lambda: MISSING in probe.diagnostics('serial_bridge: link'))
        probe.until(lambda: probe.diagnostics('serial_bridge: gains') == REFUSED)
        answer = probe.call('/serial_bridge/check_polarity')
        assert answer.message.startswith('ArduPilot takes no test pulses')
        later = LAYOUTS['ardupilot_hexa_x'].to_urdf()
        probe.deliver('/robot_description', {'data': later})
        probe.until(lambda: len(heard['/motors/command'][-1].effort) == 6)
        assert bridge.end() == 0
    assert heard['/control/wrench'] == []
    assert heard['/imu/data'][-1].linear_acceleration.z == pytest.approx(9.81, abs=0.01)
    assert heard['/motors/command'][-1].effort == pytest.approx([0.1, 0.2, 0.3, 0.4, 0.0, 0.0])
    assert heard['/motors/state'][-1].velocity[0] == pytest.approx(200 * math.pi)
    craft = from_urdf(heard['/robot_description'][0].data)
    assert craft.places == ('right', 'left', 'front', 'rear')
