"""Signs and units from the wire to ROS: FRD/NED to FLU/ENU, gauss, hPa, µs."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
from flight_controller import STILL
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from quad_bridge.link.autopilot import Inertial
from quad_bridge.motor_outputs import MotorOutputs
from quad_bridge.status import WARN, Status
from quad_bridge.wire import frames as f
from quad_bridge.wire.axes import quaternion, upwards

pytest.importorskip('sensor_msgs.msg', reason='needs the ROS 2 message packages')
from quad_bridge.nodes import conversion
from quad_bridge.nodes.diagnostics import Changes
from quad_bridge.nodes.fence import LogLimiter

STORE = get_typestore(Stores.ROS2_JAZZY)
VECTOR = 'geometry_msgs/msg/Vector3Stamped'
KINDS = ('sensor_msgs/msg/Imu', 'sensor_msgs/msg/JointState',
         'geometry_msgs/msg/WrenchStamped', VECTOR, VECTOR, VECTOR)


def filled(**changes):
    cycle, messages = replace(STILL, **changes), conversion.Messages()
    # of another cycle first: nothing of it may remain
    messages.packed(replace(STILL, gyro=(9.0,) * 3, motors=(0.9,) * 4), 7)
    raws = (*messages.packed(cycle, 1_500_000_000), messages.applied(cycle, 1_500_000_000))
    names = ('imu', 'motors', 'wrench', 'attitude_setpoint', 'rate_setpoint', 'excitation')
    return SimpleNamespace(raws=raws, **{
        name: STORE.deserialize_cdr(raw, kind)
        for name, raw, kind in zip(names, raws, KINDS, strict=True)
    })  # fmt: skip


def of_others():
    """A message of each kind that is not a cycle's, and its type."""
    made, six = conversion.Messages(), MotorOutputs(channels=(5, 4, 3, 2, 1, 0))
    sensors = f.SlowSensors(0, (0.2, 0.1, 0.4), 1013.25)
    pulses, kind = f.Outputs(0, 0, (1100, 1200, 1300, 1400)), 'sensor_msgs/msg/'
    return [
        (kind + 'Imu', made.inertial(Inertial(0, (0.1, 0.2, 0.3), None, (0.1, 0.2, 0.3)), 3)),
        (kind + 'Imu', made.inertial(Inertial(0, None, (0.1, 0.2, 0.3), None), 4)),
        (kind + 'JointState', made.outputs(pulses, MotorOutputs(), 5)),
        (kind + 'JointState', made.rotors(f.RotorSpeeds(0, (900.0, math.nan, 3.0)), six, 6)),
        (kind + 'Joy', made.sticks(f.RcChannels(0, (1000, 1500)), 7, failsafe=True)),
        (kind + 'BatteryState', made.battery(f.Battery(11.1, 2.0, 0.5), 8)),
        (kind + 'BatteryState', made.battery(f.Battery(math.nan), 9)),
        (kind + 'MagneticField', made.mag(sensors, 10)),
        (kind + 'FluidPressure', made.baro(sensors, 11)),
    ]


def test_all_is_packed_as_rosbags_serialises_it_to_the_byte():
    cycle = filled(gyro=(0.1, -0.2, 0.3), motors=(0.1, 0.2, 0.3, 0.4), accel=(1e-9, 0.0, -0.0))
    for kind, raw in [*zip(KINDS, cycle.raws, strict=True), *of_others()]:
        assert STORE.serialize_cdr(STORE.deserialize_cdr(raw, kind), kind) == raw, kind


def vector(v):
    return (v.x, v.y, v.z)


def rotation(q):
    """Matrix of a quaternion x y z w, body to earth."""
    return Rotation.from_quat(q).as_matrix()


def test_vectors_turn_y_and_z_and_all_messages_carry_the_same_stamp_and_frame():
    m = filled(
        gyro=(1.0, 2.0, 3.0), rate_setpoint=(4.0, 5.0, 6.0), control=(0.5, 0.1, 0.2, 0.3),
        excitation=(7.0, 8.0, 9.0))
    kept = [m.imu, m.motors, m.wrench, m.attitude_setpoint, m.rate_setpoint, m.excitation]
    stamps = {(x.header.stamp.sec, x.header.stamp.nanosec, x.header.frame_id) for x in kept}
    assert stamps == {(1, 500_000_000, 'base_link')}
    assert conversion.age_s(m.imu.header.stamp, 0) == math.inf  # before time begins
    assert vector(m.imu.linear_acceleration) == (0.0, 0.0, 9.81)  # at rest it is up
    assert vector(m.imu.angular_velocity) == (1.0, -2.0, -3.0)
    assert vector(m.rate_setpoint.vector) == (4.0, -5.0, -6.0)
    assert m.wrench.wrench.force.z == 0.5
    assert vector(m.wrench.wrench.torque) == (0.1, -0.2, -0.3)
    assert vector(m.excitation.vector) == (7.0, -8.0, -9.0)
    assert list(m.motors.effort) == [0.5] * 4
    assert list(m.motors.name) == ['motor_1', 'motor_2', 'motor_3', 'motor_4']


def test_facing_north_is_a_yaw_of_ninety_degrees_from_east():
    m = filled(attitude_setpoint=(0.1, 0.2, 0.0))
    assert vector(m.attitude_setpoint.vector) == pytest.approx((0.1, -0.2, math.pi / 2))
    q = m.imu.orientation
    forward = rotation((q.x, q.y, q.z, q.w))[:, 0]
    assert forward == pytest.approx([0.0, 1.0, 0.0], abs=1e-12)  # ENU: north is y


def test_the_force_along_the_vertical_is_the_weight_however_it_leans():
    for rpy in ((0.5, 0.0, 1.0), (-0.4, 0.3, 2.0), (0.0, -0.6, 0.0)):
        force = rotation(quaternion(rpy)).T @ [0.0, 0.0, -9.81]  # FRD against NED
        assert upwards(tuple(force), rpy) == pytest.approx(9.81)


@pytest.mark.parametrize(
    ('pulses', 'failsafe', 'axes', 'button'),
    [
        ((1000, 1500, 1000, 2000, 1750, 1500, 1500, 1500, 0), False, [-1, 0, 0, 1, 0.5], 0),
        ((1000, 1500, 1000, 2000, 1750, 1500, 1500, 1500, 0), True, [-1, 0, 0, 1, 0.5], 1),
        ((), False, [], 1),  # a stick without a pulse is a failsafe
    ],
)
def test_receiver_pulses_become_axes_and_failsafe_a_button(pulses, failsafe, axes, button):
    raw = conversion.Messages().sticks(f.RcChannels(0, pulses), 0, failsafe=failsafe)
    joy = STORE.deserialize_cdr(raw, 'sensor_msgs/msg/Joy')
    assert list(joy.axes[: len(axes)]) == axes
    assert math.isnan(joy.axes[8])
    assert (len(joy.axes), list(joy.buttons)) == (9, [button])


def test_what_others_send_in_si_and_nan_minus_one_or_none_where_not_measured():
    both, still, outputs, speeds, _, battery, empty, mag, baro = (
        STORE.deserialize_cdr(raw, kind) for kind, raw in of_others()
    )
    known = [(m.orientation_covariance[0], m.angular_velocity_covariance[0],
              m.linear_acceleration_covariance[0]) for m in (both, still)]  # fmt: skip
    assert known == [(0.0, 0.0, -1.0), (-1.0, -1.0, 0.0)]  # REP-145
    assert vector(both.angular_velocity) == (0.1, -0.2, -0.3)
    assert vector(still.linear_acceleration) == (0.1, -0.2, -0.3)
    # front right 0.1, rear left 0.2, front left 0.3, rear right 0.4 in the autopilots' order
    assert list(outputs.effort) == pytest.approx([0.2, 0.4, 0.1, 0.3])
    assert list(speeds.name)[4:] == ['motor_5', 'motor_6']
    assert list(speeds.velocity)[3:] == pytest.approx(
        [0.1 * math.pi, math.nan, 30.0 * math.pi], nan_ok=True
    )
    assert vector(mag.magnetic_field) == pytest.approx((2e-5, -1e-5, -4e-5))
    assert baro.fluid_pressure == pytest.approx(101325.0)
    assert (battery.voltage, battery.current, battery.present) == (pytest.approx(11.1), -2.0, True)
    assert math.isnan(empty.voltage)
    assert not empty.present
    assert conversion.Messages().mag(f.SlowSensors(0), 0) is None
    assert conversion.Messages().baro(f.SlowSensors(0), 0) is None


def test_a_state_that_lasts_is_logged_as_it_begins():
    changes, logged = Changes(LogLimiter()), []
    for second in range(5):
        words = f'no answer for {second} s' if second < 4 else 'converged'
        logged += changes.new([Status('clock', WARN, words, {})], float(second))
    assert [entry.message for entry in logged] == ['no answer for 0 s', 'converged']
