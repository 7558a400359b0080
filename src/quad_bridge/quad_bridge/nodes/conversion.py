"""Frames to ROS messages: FRD/NED to FLU/ENU, wire units to SI. No node, no publishing.

Streams are made as bytes: each kind of message is laid out once, in CDR, and filled by one call
of `struct`. It takes a twentieth of the time of rclpy's conversion.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from typing import Any

from builtin_interfaces.msg import Time
from rcl_interfaces.msg import Parameter, ParameterEvent, ParameterType, ParameterValue

from quad_bridge.link.autopilot import Inertial
from quad_bridge.motor_outputs import MotorOutputs
from quad_bridge.wire import frames as f
from quad_bridge.wire.axes import flip_attitude, flip_body, flip_control, quaternion

FRAME_ID = 'base_link'
TESLA_PER_GAUSS = 1e-4
PASCAL_PER_HPA = 100.0
RAD_S_PER_RPM = math.tau / 60.0
RC_CHANNELS, THROTTLE, STICKS = 9, 2, 4


class _Template:
    """One message with a header as bytes (CDR), of which stamp and numbers change.

    A field is a layout of such numbers, as `struct` has it, or what never changes: a layout with
    its numbers, or a text. What is empty or zero there is so many bytes `x`.
    """

    def __init__(self, *fields: str | tuple[str | int, ...] | bytes) -> None:
        self._layout, self._size = '<4siI', 8
        self._numbers = 0
        self._first: list[Any] = []  # what never changes, before the first number
        self._later: list[tuple[int, Any]] = []  # and behind it, with its place
        for field in (FRAME_ID.encode(), *fields):
            if isinstance(field, bytes):
                self._add('I', (len(field) + 1,))
                self._add(f'{len(field)}sx', (field,))
            elif isinstance(field, tuple):
                self._add(str(field[0]), field[1:])
            else:
                self._add(field, None)
        self._pack = struct.Struct(self._layout).pack

    def _add(self, code: str, constants: tuple[Any, ...] | None) -> None:
        """Add a layout behind what there is, as its numbers must be aligned."""
        gap = -self._size % _SIZES[code.lstrip('0123456789')[0]]
        size = struct.calcsize(f'<{code}')
        self._layout += f'{gap}x{code}'
        self._size += gap + size
        if constants is None:
            self._numbers += len(struct.unpack(f'<{code}', bytes(size)))
        elif not self._numbers:
            self._first += constants
        else:
            for constant in constants:
                self._later.append((self._numbers + len(self._later), constant))

    def pack(self, stamp: tuple[int, int], *numbers: float) -> bytes:
        """Give the message with this stamp (s, ns) and these numbers."""
        if self._later:
            values: list[Any] = [*numbers]
            for place, constant in self._later:
                values.insert(place, constant)
            numbers = tuple(values)
        return self._pack(_HEAD, *stamp, *self._first, *numbers)


_HEAD = b'\0\1\0\0'  # little endian
_SIZES = {'d': 8, 'f': 4, 'i': 4, 'I': 4, 'x': 4, 's': 1}
_SECOND = 1_000_000_000  # ns
_KNOWN, _UNKNOWN = 0.0, -1.0
"""First number of a covariance (REP-145): nobody knows it, or there is no measurement at all."""
_NO_TURN, _ZERO = (0.0, 0.0, 0.0, 1.0, _UNKNOWN), (0.0, 0.0, 0.0, _UNKNOWN)


def _joints(field: str, count: int) -> _Template:
    """A JointState with the `velocity` or the `effort` of so many motors."""
    names = [f'motor_{k}'.encode() for k in range(1, count + 1)]
    before, behind = (1, 1) if field == 'velocity' else (2, 0)  # empty sequences beside it
    return _Template(('I', count), *names, (f'{4 * before}x',), ('I', count), f'{count}d',
                     (f'{4 * behind}x',))  # fmt: skip


class Messages:
    """The streams' messages, serialised; those of one control cycle have the same stamp."""

    def __init__(self) -> None:
        # orientation, rates, acceleration, each with the first number of its covariance
        self._imu = _Template('5d', ('64x',), '4d', ('64x',), '4d', ('64x',))
        self._wrench = _Template('6d')
        self._vector = _Template('3d')
        self._field = _Template('3d', ('72x',))
        self._pressure = _Template('d', ('8x',))
        self._sticks = _Template(('I', RC_CHANNELS), f'{RC_CHANNELS}f', ('I', 1), 'i')
        # voltage, temperature, current, three of charge, percentage; states; present; cells; texts
        self._battery = _Template('7f3B?', ('8x',), b'', b'')
        self._joints: dict[tuple[str, int], _Template] = {}

    def packed(
        self, cycle: f.Cycle, stamp_ns: int, gyro_bias: f.Vector3 = (0.0, 0.0, 0.0)
    ) -> tuple[bytes, bytes, bytes, bytes, bytes]:
        """Imu, motors, wrench, set-points of attitude and rates of one cycle.

        `gyro_bias` (rad/s, FLU) is subtracted from the rates.
        """
        stamp = divmod(stamp_ns, _SECOND)
        (p, q, r), (x, y, z) = flip_body(cycle.gyro), gyro_bias
        return (
            self._imu.pack(
                stamp, *quaternion(flip_attitude(cycle.attitude)), _KNOWN,
                p - x, q - y, r - z, _KNOWN, *flip_body(cycle.accel), _KNOWN,
            ),
            self._motors('effort', cycle.motors, stamp),
            self._wrench.pack(stamp, 0.0, 0.0, *flip_control(cycle.control)),
            self._vector.pack(stamp, *flip_attitude(cycle.attitude_setpoint)),
            self._vector.pack(stamp, *flip_body(cycle.rate_setpoint)),
        )  # fmt: skip

    def applied(self, cycle: f.Cycle, stamp_ns: int) -> bytes:
        """The excitation that the STM32 says it added."""
        return self._vector.pack(divmod(stamp_ns, _SECOND), *flip_body(cycle.excitation))

    def inertial(self, inertial: Inertial, stamp_ns: int) -> bytes:
        """Another autopilot's data; -1 in a covariance marks what is not measured."""
        gyro, accel, attitude = inertial.gyro, inertial.accel, inertial.attitude
        return self._imu.pack(
            divmod(stamp_ns, _SECOND),
            *(_NO_TURN if attitude is None else (*quaternion(flip_attitude(attitude)), _KNOWN)),
            *(_ZERO if gyro is None else (*flip_body(gyro), _KNOWN)),
            *(_ZERO if accel is None else (*flip_body(accel), _KNOWN)),
        )

    def outputs(self, outputs: f.Outputs, motors: MotorOutputs, stamp_ns: int) -> bytes:
        """Pulses of another autopilot as commands of the motors, 0..1."""
        return self._motors('effort', motors.efforts(outputs.pulses), divmod(stamp_ns, _SECOND))

    def rotors(self, speeds: f.RotorSpeeds, motors: MotorOutputs, stamp_ns: int) -> bytes:
        """Speeds of the rotors in rad/s, positive as they fly; NaN where one is not measured."""
        speed = [RAD_S_PER_RPM * rpm for rpm in motors.ordered(speeds.rpm)]
        return self._motors('velocity', speed, divmod(stamp_ns, _SECOND))

    def _motors(self, field: str, values: Sequence[float], stamp: tuple[int, int]) -> bytes:
        key = field, len(values)
        if key not in self._joints:
            self._joints[key] = _joints(*key)
        return self._joints[key].pack(stamp, *values)

    def sticks(self, rc: f.RcChannels, stamp_ns: int, *, failsafe: bool) -> bytes:
        """Nine axes, NaN where a channel has no pulse; `buttons[0]` 1 in failsafe.

        A stick without a pulse counts as failsafe too.
        """
        axes = [rc_axis(rc, i) for i in range(RC_CHANNELS)]
        lost = failsafe or any(math.isnan(v) for v in axes[:STICKS])
        return self._sticks.pack(divmod(stamp_ns, _SECOND), *axes, lost)

    def battery(self, battery: f.Battery, stamp_ns: int) -> bytes:
        """Voltage in V, discharge current negative as BatteryState has it; NaN: not measured."""
        volts, present = battery.voltage_v, math.isfinite(battery.voltage_v)
        unknown, stamp = math.nan, divmod(stamp_ns, _SECOND)
        return self._battery.pack(
            stamp, volts, unknown, -battery.current_a, unknown, unknown, unknown,
            battery.remaining, 0, 0, 0, present,
        )  # fmt: skip

    def mag(self, sensors: f.SlowSensors, stamp_ns: int) -> bytes | None:
        """Tesla, FLU; None where the magnetometer was not updated."""
        if sensors.mag_gauss is None:
            return None
        x, y, z = flip_body(sensors.mag_gauss)
        scale = TESLA_PER_GAUSS
        return self._field.pack(divmod(stamp_ns, _SECOND), x * scale, y * scale, z * scale)

    def baro(self, sensors: f.SlowSensors, stamp_ns: int) -> bytes | None:
        """Pascal; None where the barometer was not updated."""
        if sensors.pressure_hpa is None:
            return None
        pascal = PASCAL_PER_HPA * sensors.pressure_hpa
        return self._pressure.pack(divmod(stamp_ns, _SECOND), pascal)


def time_message(stamp_ns: int) -> Time:
    """A stamp as a message."""
    sec, nanosec = divmod(stamp_ns, _SECOND)
    return Time(sec=sec, nanosec=nanosec)


def rc_axis(rc: f.RcChannels, index: int) -> float:
    """A channel as `/rc/in` has it: -1..1, throttle 0..1, NaN without a pulse."""
    pulse_us = rc.channels[index] if index < len(rc.channels) else 0
    if pulse_us in {0, 0xFFFF}:
        return math.nan
    if index == THROTTLE:
        return (pulse_us - 1000) / 1000.0
    return (pulse_us - 1500) / 500.0


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


def age_s(stamp: Time, now_ns: int) -> float:
    """Age of a message by its stamp, s, negative for one in the future; inf before time begins."""
    return 1e-9 * float(now_ns - stamp.sec * _SECOND - stamp.nanosec) if now_ns else math.inf


def values_of(parameters: Sequence[Parameter]) -> dict[str, object]:
    """Parameters as a plain mapping; what is not set is None, arrays are tuples."""
    values: dict[str, object] = {}
    for parameter in parameters:
        field = _FIELDS.get(parameter.value.type, '')
        value: Any = getattr(parameter.value, field, None)
        values[parameter.name] = tuple(value) if field.endswith('array_value') else value
    return values


_FIELDS = {
    getattr(ParameterType, f'PARAMETER_{name.upper()}'): f'{name}_value'
    for kind in ('bool', 'integer', 'double', 'string', 'byte')
    for name in (kind, f'{kind}_array')
    if name != 'byte'
}
"""Type of a parameter to the field that holds its value."""
