"""A peer made of pymavlink's `common` dialect: what the bridge makes of standard messages."""

import math

import numpy as np
import pytest
from flight_controller import Line, Port, Pty
from pymavlink.dialects.v20 import common

from quad_bridge.link.autopilot import INTERVALS_US, SET_MESSAGE_INTERVAL, Inertial
from quad_bridge.link.machine import Link
from quad_bridge.wire import frames as f

HOST0_NS = 5_000_000_000
NAMES = {number: name for name, (number, _) in INTERVALS_US.items()}


class Autopilot:
    """Flies nothing, but talks: streams what was asked for, answers TIMESYNC, has 3 parameters."""

    def __init__(self, *, only=tuple(INTERVALS_US), sync=True, system_id=1):
        self.mav = common.MAVLink(None, srcSystem=system_id, srcComponent=1)
        self.ears = common.MAVLink(None)
        self.ears.robust_parsing = True
        self.only, self.sync, self.asked = only, sync, {}
        self.heard, self.step = [], 0

    def pack(self, message):
        self.mav.seq = (self.mav.seq + 1) % 256
        return bytes(message.pack(self.mav))

    def cycle(self):
        """Bytes of the coming step of 4 ms."""
        step, self.step, out = self.step, self.step + 1, b''
        now_us = 4000 * self.step
        if step % 250 == 0:
            out += self.pack(common.MAVLink_heartbeat_message(2, 3, 128, 0, 4, 3))
            health = (1, 1, 1, 100, 11_800, 250, 77, 0, 0, 0, 0, 0, 0)
            out += self.pack(common.MAVLink_sys_status_message(*health))
        for name, message in self.messages(now_us).items():
            if name in self.asked and step % max(self.asked[name] // 4000, 1) == 0:
                out += self.pack(message)
        return out

    def messages(self, now_us):
        ms = now_us // 1000
        return {
            'ATTITUDE': common.MAVLink_attitude_message(ms, 0.1, 0.2, 0.3, 0.5, -0.25, 0.125),
            'HIGHRES_IMU': common.MAVLink_highres_imu_message(
                now_us, 0.0, 0.0, -9.81, 0.5, -0.25, 0.125, 0.2, 0.1, -0.4, 1000.0, 0, 0, 20.0,
                0x0FFF,
            ),
            'SCALED_IMU': common.MAVLink_scaled_imu_message(
                ms, 0, 0, -1000, 500, -250, 125, 200, 100, -400
            ),
            'SERVO_OUTPUT_RAW': common.MAVLink_servo_output_raw_message(
                now_us % 2**32, 0, 1100, 1200, 1300, 1400, 0, 0, 0, 0
            ),
            'RC_CHANNELS': common.MAVLink_rc_channels_message(
                ms, 8, 1500, 1600, 1200, 1500, *([1000] * 4), *([65535] * 10), 255
            ),
            'SCALED_PRESSURE': common.MAVLink_scaled_pressure_message(ms, 990.0, 0.0, 2000),
            'BATTERY_STATUS': common.MAVLink_battery_status_message(
                0, 0, 0, 2000, [3900, 3900, 3900, *([65535] * 7)], 150, -1, -1, 80
            ),
        }  # fmt: skip

    def receive(self, data, now_ns):
        out = b''
        for message in self.ears.parse_buffer(data) or []:
            self.heard.append(message.get_type())
            if message.get_type() == 'TIMESYNC' and message.tc1 == 0 and self.sync:
                out += self.pack(common.MAVLink_timesync_message(now_ns, message.ts1))
            elif message.get_type() == 'COMMAND_LONG':
                assert message.command == SET_MESSAGE_INTERVAL
                name = NAMES[int(message.param1)]
                known = name in self.only
                if known:
                    self.asked[name] = int(message.param2)
                out += self.pack(common.MAVLink_command_ack_message(511, 0 if known else 3))
            elif message.get_type() == 'PARAM_REQUEST_LIST':
                for i, name in enumerate((b'MC_ROLL_P', b'MC_PITCH_P', b'MC_YAW_P')):
                    out += self.pack(common.MAVLink_param_value_message(name, 0.15, 9, 3, i))
        return out


def converse(peer, seconds):
    line = Line(peer, host0_ns=HOST0_NS)
    line.fly(seconds)
    return line.link, line.out


def kinds(out):
    return {type(item.frame).__name__ for item in out if item.stamp_ns is not None}


def test_streams_are_asked_for_and_become_what_the_topics_need():
    peer = Autopilot()
    link, out = converse(peer, 6.0)
    assert peer.asked == {name: us for name, (_, us) in INTERVALS_US.items()}
    assert kinds(out) == {'Inertial', 'Outputs', 'RcChannels', 'SlowSensors', 'Battery'}
    inertial = [item for item in out if isinstance(item.frame, Inertial)]
    assert len(inertial) > 900
    stamps = np.array([item.stamp_ns for item in inertial])
    assert np.diff(stamps).min() > 0
    true = HOST0_NS + 1000 * np.array([item.frame.time_us for item in inertial])
    assert np.abs(stamps - true).max() < 300_000
    last = inertial[-1].frame
    assert last.gyro == (0.5, -0.25, 0.125)
    assert last.accel == pytest.approx((0.0, 0.0, -9.81), abs=1e-6)
    assert last.attitude == pytest.approx((0.1, 0.2, 0.3), abs=1e-6)
    batteries = {item.frame.voltage_v for item in out if isinstance(item.frame, f.Battery)}
    # SYS_STATUS stands in only as long as no BATTERY_STATUS comes
    assert batteries <= {11.7, 11.8}
    assert out[-1].stamp_ns > 0
    late = [i.frame.voltage_v for i in out[-200:] if isinstance(i.frame, f.Battery)]
    assert set(late) == {11.7}
    missing = link.autopilot.missing(HOST0_NS + 6_000_000_000)
    assert missing == ['/control/wrench', '/setpoint/attitude', '/setpoint/rates',
                       '/excitation/applied']  # fmt: skip


@pytest.mark.parametrize(
    ('only', 'accel'), [(('SCALED_IMU', 'ATTITUDE'), (0.0, 0.0, -9.80665)), (('ATTITUDE',), None)]
)
def test_without_highres_imu_the_scaled_one_does_and_without_both_the_attitude(only, accel):
    _, out = converse(Autopilot(only=only), 4.0)
    last = [item.frame for item in out if isinstance(item.frame, Inertial)][-1]
    assert last.accel == (accel and pytest.approx(accel, abs=1e-6))
    assert last.gyro == pytest.approx((0.5, -0.25, 0.125))


def test_an_autopilot_that_answers_no_timesync_is_stamped_by_arrival():
    link, out = converse(Autopilot(sync=False), 12.0)
    assert link.clock.one_way
    inertial = [item for item in out if isinstance(item.frame, Inertial)]
    assert len(inertial) > 1000
    true = HOST0_NS + 1000 * np.array([item.frame.time_us for item in inertial])
    assert np.abs(np.array([item.stamp_ns for item in inertial]) - true).max() < 1_000_000


def test_its_parameters_are_let_alone_and_nothing_of_ours_is_sent_to_it():
    peer = Autopilot()
    converse(peer, 8.0)
    assert peer.heard.count('PARAM_REQUEST_LIST') <= 2
    # in the first second, before the bridge knows, it may have asked for our own set of gains
    ours = [name for name in peer.heard if name.startswith(('UNKNOWN', 'BAD'))]
    assert set(ours) <= {'UNKNOWN_24102'}
    assert len(ours) <= 5


def test_messages_that_do_not_come_are_asked_for_again():
    peer = Autopilot(only=('ATTITUDE',))
    link, _ = converse(peer, 12.0)
    assert peer.asked == {'ATTITUDE': 4000}
    assert link.autopilot.asked > 2 * (len(INTERVALS_US) - 1)
    assert '/motors/command' in link.autopilot.missing(HOST0_NS + 12_000_000_000)


def test_messages_in_ros_units_and_axes():
    pytest.importorskip('sensor_msgs.msg', reason='needs the ROS 2 message packages')
    from quad_bridge.nodes import conversion

    imu = conversion.inertial_message(
        Inertial(0, (0.5, -0.25, 0.125), (0.0, 0.0, -9.81), None), 7_000_000_001
    )
    assert imu.header.stamp.nanosec == 1
    rate = imu.angular_velocity
    assert (rate.x, rate.y, rate.z) == (0.5, 0.25, -0.125)
    assert imu.linear_acceleration.z == 9.81
    assert imu.orientation_covariance[0] == -1.0
    imu = conversion.inertial_message(Inertial(0, (0.0,) * 3, None, (0.0, 0.0, 0.0)), 1)
    assert imu.linear_acceleration_covariance[0] == -1.0
    # front right 0.1, rear left 0.2, front left 0.3, rear right 0.4 in the autopilots' order
    motors = conversion.outputs_message(f.Outputs(0, 0, (1100, 1200, 1300, 1400)), 1)
    assert list(motors.effort) == pytest.approx([0.2, 0.4, 0.1, 0.3])
    assert not math.isnan(sum(motors.effort))
    assert not Link().autopilot.outputs(f.Outputs(0, 1, (1100,) * 4), 0)  # no motors there


PUBLISHED = ('/imu/data', '/motors/command', '/rc/in', '/imu/mag', '/baro', '/battery')
REFUSED = 'refused: the aircraft has no QUAD_GAINS'
MISSING = 'without QUAD_CYCLE there is no /control/wrench'


def test_the_node_publishes_what_it_can_and_says_what_is_missing(tmp_path, probe, start):
    heard = {topic: probe.listen(topic) for topic in (*PUBLISHED, '/control/wrench')}
    with Port(Autopilot(), Pty(tmp_path / 'tty')):
        bridge = start('serial_bridge', port=tmp_path / 'tty', state_folder=tmp_path)
        probe.until(lambda: min(len(heard[topic]) for topic in PUBLISHED) > 5)
        probe.until(lambda: MISSING in probe.diagnostics('serial_bridge: link'))
        probe.until(lambda: probe.diagnostics('serial_bridge: gains') == REFUSED)
        assert bridge.end() == 0
    assert heard['/control/wrench'] == []
    assert heard['/imu/data'][-1].linear_acceleration.z == pytest.approx(9.81)
    assert heard['/motors/command'][-1].effort == pytest.approx([0.2, 0.4, 0.1, 0.3])
