"""Frames to ROS messages: FRD/NED to FLU/ENU, wire units to SI. No node, no publishing.

The messages of a control cycle are made as bytes: each is serialised once, by rclpy, and stamp and
numbers are written into a copy of that. It takes a fifth of the time.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from typing import Any

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Vector3Stamped, WrenchStamped
from rcl_interfaces.msg import Parameter, ParameterEvent, ParameterType, ParameterValue
from rclpy.serialization import serialize_message
from sensor_msgs.msg import BatteryState, FluidPressure, Imu, JointState, Joy, MagneticField

from quad_bridge.link.autopilot import Inertial
from quad_bridge.motor_outputs import MotorOutputs
from quad_bridge.wire import frames as f
from quad_bridge.wire.axes import flip_attitude, flip_body, flip_control, quaternion

FRAME_ID = 'base_link'
MOTORS = ('motor_1', 'motor_2', 'motor_3', 'motor_4')
TESLA_PER_GAUSS = 1e-4
PASCAL_PER_HPA = 100.0
RAD_S_PER_RPM = math.tau / 60.0
RC_CHANNELS, THROTTLE, STICKS = 9, 2, 4


def _stamped(message: Any, stamp_ns: int) -> Any:
    message.header.frame_id = FRAME_ID
    message.header.stamp = time_message(stamp_ns)
    return message


def _set(vector: Any, values: tuple[float, float, float]) -> None:
    vector.x, vector.y, vector.z = values


class _Template:
    """One message as bytes; `groups` are its numbers that change, as they lie together."""

    def __init__(self, message: Any, groups: tuple[tuple[float, ...], ...]) -> None:
        """`message` holds these numbers, each of them only there."""
        self._raw = bytearray(serialize_message(_stamped(message, 0)))
        self._places, end = [], 0
        for group in groups:
            packer = struct.Struct(f'<{len(group)}d')
            place = self._raw.find(packer.pack(*group))
            self._places.append((packer.pack_into, place))
            end = place + packer.size
        if len(self._raw) - end <= _SPARE:
            del self._raw[end:]

    def pack(self, stamp_ns: int, *groups: tuple[float, ...]) -> bytes:
        raw = self._raw
        _STAMP.pack_into(raw, 4, *divmod(stamp_ns, 1_000_000_000))
        for (pack_into, place), group in zip(self._places, groups, strict=True):
            pack_into(raw, place, *group)
        return bytes(raw)


_STAMP = struct.Struct('<iI')
_SPARE = 8  # bytes that rclpy may leave behind the last number: it estimates the size
_THREE, _FOUR = (1.25, 2.25, 3.25), (4.25, 5.25, 6.25, 7.25)
_MORE, _LAST = (8.25, 9.25, 10.25), (11.25, 12.25, 13.25)


class CycleMessages:
    """The messages of one control cycle, all with the same stamp, serialised (CDR)."""

    def __init__(self) -> None:
        imu, wrench, vector = Imu(), WrenchStamped(), Vector3Stamped()
        q = imu.orientation
        q.x, q.y, q.z, q.w = _FOUR
        _set(imu.angular_velocity, _MORE)
        _set(imu.linear_acceleration, _LAST)
        _set(wrench.wrench.force, _MORE)
        _set(wrench.wrench.torque, _LAST)
        _set(vector.vector, _THREE)
        self._imu = _Template(imu, (_FOUR, _MORE, _LAST))
        self._motors = _Template(JointState(name=list(MOTORS), effort=list(_FOUR)), (_FOUR,))
        self._wrench = _Template(wrench, (_MORE, _LAST))
        self._vector = _Template(vector, (_THREE,))

    def packed(
        self, cycle: f.Cycle, stamp_ns: int, gyro_bias: f.Vector3 = (0.0, 0.0, 0.0)
    ) -> tuple[bytes, bytes, bytes, bytes, bytes]:
        """Imu, motors, wrench, set-points of attitude and rates of one cycle.

        `gyro_bias` (rad/s, FLU) is subtracted from the rates.
        """
        u1, u2, u3, u4 = flip_control(cycle.control)
        (p, q, r), (x, y, z) = flip_body(cycle.gyro), gyro_bias
        attitude = quaternion(flip_attitude(cycle.attitude))
        imu = self._imu.pack(stamp_ns, attitude, (p - x, q - y, r - z), flip_body(cycle.accel))
        return (
            imu,
            self._motors.pack(stamp_ns, cycle.motors),
            self._wrench.pack(stamp_ns, (0.0, 0.0, u1), (u2, u3, u4)),
            self._vector.pack(stamp_ns, flip_attitude(cycle.attitude_setpoint)),
            self._vector.pack(stamp_ns, flip_body(cycle.rate_setpoint)),
        )

    def applied(self, cycle: f.Cycle, stamp_ns: int) -> bytes:
        """The excitation that the STM32 says it added."""
        return self._vector.pack(stamp_ns, flip_body(cycle.excitation))


def time_message(stamp_ns: int) -> Time:
    """A stamp as a message."""
    sec, nanosec = divmod(stamp_ns, 1_000_000_000)
    return Time(sec=sec, nanosec=nanosec)


def inertial_message(inertial: Inertial, stamp_ns: int) -> Imu:
    """Another autopilot's data; -1 in a covariance marks what is unknown (sensor_msgs)."""
    message = _stamped(Imu(), stamp_ns)
    if inertial.gyro is None:
        message.angular_velocity_covariance[0] = -1.0
    else:
        _set(message.angular_velocity, flip_body(inertial.gyro))
    if inertial.accel is None:
        message.linear_acceleration_covariance[0] = -1.0
    else:
        _set(message.linear_acceleration, flip_body(inertial.accel))
    if inertial.attitude is None:
        message.orientation_covariance[0] = -1.0
    else:
        q = message.orientation
        q.x, q.y, q.z, q.w = quaternion(flip_attitude(inertial.attitude))
    return message


def outputs_message(outputs: f.Outputs, motors: MotorOutputs, stamp_ns: int) -> JointState:
    """Pulses of another autopilot as commands of the motors, 0..1."""
    message = _stamped(JointState(name=_names(len(motors.channels))), stamp_ns)
    message.effort = motors.efforts(outputs.pulses)
    return message


def rotors_message(speeds: f.RotorSpeeds, motors: MotorOutputs, stamp_ns: int) -> JointState:
    """Speeds of the rotors in rad/s, positive as they fly; NaN where one is not measured."""
    message = _stamped(JointState(name=_names(len(motors.channels))), stamp_ns)
    message.velocity = [RAD_S_PER_RPM * rpm for rpm in motors.ordered(speeds.rpm)]
    return message


def _names(count: int) -> list[str]:
    return [f'motor_{k}' for k in range(1, count + 1)]


def rc_message(rc: f.RcChannels, stamp_ns: int, *, failsafe: bool) -> Joy:
    """Nine axes, NaN where a channel has no pulse; `buttons[0]` 1 in failsafe.

    A stick without a pulse counts as failsafe too.
    """
    message = _stamped(Joy(), stamp_ns)
    message.axes = [rc_axis(rc, i) for i in range(RC_CHANNELS)]
    lost = failsafe or any(math.isnan(v) for v in message.axes[:STICKS])
    message.buttons = [int(lost)]
    return message


def rc_axis(rc: f.RcChannels, index: int) -> float:
    """A channel as `/rc/in` has it: -1..1, throttle 0..1, NaN without a pulse."""
    pulse_us = rc.channels[index] if index < len(rc.channels) else 0
    if pulse_us in {0, 0xFFFF}:
        return math.nan
    if index == THROTTLE:
        return (pulse_us - 1000) / 1000.0
    return (pulse_us - 1500) / 500.0


def battery_message(battery: f.Battery, stamp_ns: int) -> BatteryState:
    """Pack voltage in V, discharge current negative as BatteryState has it; NaN: not measured."""
    message = _stamped(BatteryState(), stamp_ns)
    message.voltage = battery.voltage_v
    message.current = -battery.current_a
    message.percentage = battery.remaining
    for name in ('temperature', 'charge', 'capacity', 'design_capacity'):
        setattr(message, name, math.nan)
    message.present = math.isfinite(battery.voltage_v)
    return message


def mag_message(sensors: f.SlowSensors, stamp_ns: int) -> MagneticField | None:
    """Tesla, FLU; None where the magnetometer was not updated."""
    if sensors.mag_gauss is None:
        return None
    message = _stamped(MagneticField(), stamp_ns)
    x, y, z = flip_body(sensors.mag_gauss)
    scale = TESLA_PER_GAUSS
    _set(message.magnetic_field, (x * scale, y * scale, z * scale))
    return message


def baro_message(sensors: f.SlowSensors, stamp_ns: int) -> FluidPressure | None:
    """Pascal; None where the barometer was not updated."""
    if sensors.pressure_hpa is None:
        return None
    message = _stamped(FluidPressure(), stamp_ns)
    message.fluid_pressure = PASCAL_PER_HPA * sensors.pressure_hpa
    return message


def event_message(
    values: Mapping[str, bool | float | str], node: str, stamp_ns: int
) -> ParameterEvent:
    """Values as `changed_parameters`, each of its own type: /gains/active, /logger/bag."""
    changed = [Parameter(name=name, value=_parameter_value(v)) for name, v in values.items()]
    return ParameterEvent(node=node, stamp=time_message(stamp_ns), changed_parameters=changed)


def _parameter_value(value: bool | float | str) -> ParameterValue:
    kinds = ((str, 'string'), (bool, 'bool'), (int, 'integer'))
    name = next((name for kind, name in kinds if isinstance(value, kind)), 'double')
    code = getattr(ParameterType, f'PARAMETER_{name.upper()}')
    return ParameterValue(type=code, **{f'{name}_value': value})


def parameters(event: ParameterEvent) -> dict[str, object]:
    """`changed_parameters` as a plain mapping."""
    return values_of(event.changed_parameters)


def age_s(stamp: Time, now_ns: int) -> float:
    """How long ago a message was stamped; negative: that is still to come."""
    return 1e-9 * float(now_ns - stamp.sec * 1_000_000_000 - stamp.nanosec)


def values_of(given: Sequence[Parameter]) -> dict[str, object]:
    """Parameters as a plain mapping; what is not set is None, arrays are tuples."""
    found: dict[str, object] = {}
    for parameter in given:
        field = _FIELDS.get(parameter.value.type, '')
        value: Any = getattr(parameter.value, field, None)
        found[parameter.name] = tuple(value) if field.endswith('array_value') else value
    return found


_FIELDS = {
    getattr(ParameterType, f'PARAMETER_{name.upper()}'): f'{name}_value'
    for one in ('bool', 'integer', 'double', 'string', 'byte')
    for name in (one, f'{one}_array')
    if name != 'byte'
}
"""Type of a parameter to the field that holds its value."""
