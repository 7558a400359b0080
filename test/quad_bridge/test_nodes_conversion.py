"""Signs and units from the wire to ROS: FRD/NED to FLU/ENU, gauss, hPa, µs."""

import base64
import json
import math
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import pytest
from flight_controller import STILL
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from quad_bridge.wire import frames as f

pytest.importorskip('sensor_msgs.msg', reason='needs the ROS 2 message packages')
from quad_bridge.nodes import conversion

STORE = get_typestore(Stores.ROS2_JAZZY)


def filled(**changes):
    cycle, messages = replace(STILL, **changes), conversion.CycleMessages()
    # of another cycle first: nothing of it may remain
    messages.packed(replace(STILL, gyro=(9.0,) * 3, motors=(0.9,) * 4), 7)
    made = messages.packed(cycle, 1_500_000_000)
    vectors = 3 * ('geometry_msgs/msg/Vector3Stamped',)
    kinds = ('sensor_msgs/msg/Imu', 'sensor_msgs/msg/JointState',
             'geometry_msgs/msg/WrenchStamped', *vectors)
    raws = (*made, messages.applied(cycle, 1_500_000_000))
    names = ('imu', 'motors', 'wrench', 'attitude_setpoint', 'rate_setpoint', 'excitation')
    found = [STORE.deserialize_cdr(raw, kind) for raw, kind in zip(raws, kinds, strict=True)]
    return SimpleNamespace(**dict(zip(names, found, strict=True)), raws=raws, kinds=kinds)


BY_RCLPY = """
import base64, importlib, json, sys
from rclpy.serialization import deserialize_message, serialize_message
for kind, raw in json.load(sys.stdin):
    package, _, name = kind.split('/')
    own = getattr(importlib.import_module(package + '.msg'), name)
    again = serialize_message(deserialize_message(base64.b64decode(raw), own))
    print(base64.b64encode(again).decode())
"""


def test_rclpy_and_rosbags_read_the_same_to_the_last_bit():
    m = filled(gyro=(0.1, -0.2, 0.3), motors=(0.1, 0.2, 0.3, 0.4))
    asked = [(kind, base64.b64encode(bytes(raw)).decode())
             for kind, raw in zip(m.kinds, m.raws, strict=True)]
    said = subprocess.run([sys.executable, '-c', BY_RCLPY], input=json.dumps(asked), text=True,
                          capture_output=True, check=True).stdout.split()
    for kind, raw, by_rclpy in zip(m.kinds, m.raws, said, strict=True):
        again = STORE.deserialize_cdr(base64.b64decode(by_rclpy)[: len(raw)], kind)
        own = STORE.deserialize_cdr(raw, kind)
        assert STORE.serialize_cdr(again, kind) == STORE.serialize_cdr(own, kind), kind


def vector(v):
    return (v.x, v.y, v.z)


def rotation(q):
    """Matrix of a quaternion x y z w, body to earth."""
    return Rotation.from_quat(q).as_matrix()


def test_at_rest_the_acceleration_is_up_and_all_messages_carry_the_same_stamp_and_frame():
    m = filled()
    assert vector(m.imu.linear_acceleration) == (0.0, 0.0, 9.81)
    kept = [m.imu, m.motors, m.wrench, m.attitude_setpoint, m.rate_setpoint, m.excitation]
    stamps = {(x.header.stamp.sec, x.header.stamp.nanosec, x.header.frame_id) for x in kept}
    assert stamps == {(1, 500_000_000, 'base_link')}


def test_rates_setpoints_torques_and_excitation_turn_y_and_z():
    m = filled(
        gyro=(1.0, 2.0, 3.0),
        rate_setpoint=(4.0, 5.0, 6.0),
        control=(0.5, 0.1, 0.2, 0.3),
        excitation=(7.0, 8.0, 9.0),
    )
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


@pytest.mark.parametrize(
    ('pulses', 'failsafe', 'axes', 'button'),
    [
        ((1000, 1500, 1000, 2000, 1750, 1500, 1500, 1500, 0), False, [-1, 0, 0, 1, 0.5], 0),
        ((1000, 1500, 1000, 2000, 1750, 1500, 1500, 1500, 0), True, [-1, 0, 0, 1, 0.5], 1),
        ((), False, [], 1),  # a stick without a pulse is a failsafe
    ],
)
def test_receiver_pulses_become_axes_and_failsafe_a_button(pulses, failsafe, axes, button):
    joy = conversion.rc_message(f.RcChannels(0, pulses), 0, failsafe=failsafe)
    assert list(joy.axes[: len(axes)]) == axes
    assert math.isnan(joy.axes[8])
    assert (len(joy.axes), list(joy.buttons)) == (9, [button])


def test_slow_sensors_and_battery_in_si_and_nan_or_none_where_not_measured():
    sensors = f.SlowSensors(0, (0.2, 0.1, 0.4), 1013.25)
    field = conversion.mag_message(sensors, 0).magnetic_field
    assert vector(field) == pytest.approx((2e-5, -1e-5, -4e-5))
    assert conversion.baro_message(sensors, 0).fluid_pressure == pytest.approx(101325.0)
    assert conversion.mag_message(f.SlowSensors(0), 0) is None
    assert conversion.baro_message(f.SlowSensors(0), 0) is None
    assert conversion.battery_message(f.Battery(11.1), 0).voltage == pytest.approx(11.1)
    message = conversion.battery_message(f.Battery(math.nan), 0)
    assert math.isnan(message.voltage)
    assert not message.present
