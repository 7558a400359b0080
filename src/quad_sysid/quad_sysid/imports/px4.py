"""A PX4 ULog → ForeignLog, by pyulog. Topics and parameters of PX4 1.9 to 1.16.

Frames: FRD in NED. The input is the motors' commands where they were logged about as fast as the
gyro, else the controller's torque and thrust. Source of names: PX4's uORB message definitions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.imports.frames import (
    MIRROR,
    angles_from_ned,
    euler_from_quaternion,
    mixer_at_places,
    order_by_places,
)
from quad_sysid.imports.log import ForeignLog, Given, Mapped, Stream
from quad_sysid.imports.mixers import Mixer

TOPICS = (
    'vehicle_angular_velocity', 'sensor_combined', 'vehicle_attitude', 'vehicle_acceleration',
    'actuator_motors', 'vehicle_torque_setpoint', 'vehicle_thrust_setpoint',
    'actuator_controls_0', 'vehicle_attitude_setpoint', 'vehicle_rates_setpoint',
    'battery_status', 'actuator_armed', 'vehicle_status',
)
MOTOR_ORDER = (1, 3, 0, 2)
"""Motor at rear left, rear right, front right, front left in PX4's Quad X (1 front right, 2 rear
left, 3 front left, 4 rear right)."""
FAST_ENOUGH = 0.5
"""Share of the gyro's rate at which motors must be logged to be taken as the input."""
ARMED = 2
"""arming_state of vehicle_status."""
QUADROTOR = 2
"""MAV_TYPE."""
LINEAR = 0.98
"""R² of motors over torque set-point from which PX4's gains can be stated in our unit."""
FASTER = 'set SDLOG_PROFILE to high rate (bit 2) or system identification (bit 3)'
SINCE_BOOT = 1e-6
"""Timestamps are µs."""


@dataclass(frozen=True)
class _Content:
    """Topics of the first instance, with parameters, as pyulog gives them."""

    source: str
    topics: Mapping[str, Mapping[str, FloatArray]]
    parameters: Mapping[str, float]

    def stream(self, topic: str, *fields: str) -> Stream | None:
        """Fields (n, w) at the time the sample was taken; None where a field is missing."""
        data = self.topics.get(topic)
        if data is None or any(name not in data for name in fields):
            return None
        stamps = np.asarray(data.get('timestamp_sample', data['timestamp']), dtype=float)
        if not (stamps > 0).all():
            stamps = np.asarray(data['timestamp'], dtype=float)
        values = np.column_stack([np.asarray(data[name], dtype=float) for name in fields])
        order = np.argsort(stamps, kind='stable')
        fresh = np.concatenate(([True], np.diff(stamps[order]) > 0))
        order = order[fresh]
        return Stream(stamps[order] * SINCE_BOOT, values[order])


def read(path: Path) -> ForeignLog:
    """Read a .ulg file; raises BadInputError where it is damaged or lacks rates or commands."""
    content = _load(path)
    mapped: list[Mapped] = []
    rates = _rates(content, mapped)
    given, gains, warnings = _input(content, rates, mapped)
    angles = content.stream('vehicle_attitude', *(f'q[{i}]' for i in range(4)))
    if angles is not None:
        mapped.append(Mapped('vehicle_attitude.q', '1', '/imu/data orientation',
                             'FRD in NED to FLU in ENU', angles.rate_hz))
        angles = Stream(angles.time_s, angles_from_ned(euler_from_quaternion(angles.values)))
    acceleration = content.stream('vehicle_acceleration', 'xyz[0]', 'xyz[1]', 'xyz[2]')
    name = 'vehicle_acceleration'
    if acceleration is None:
        name = 'sensor_combined'
        acceleration = content.stream(name, *(f'accelerometer_m_s2[{i}]' for i in range(3)))
    if acceleration is not None:
        mapped.append(Mapped(f'{name}', 'm/s²', '/imu/data linear_acceleration',
                             'y and z turned', acceleration.rate_hz))
        acceleration = Stream(acceleration.time_s, acceleration.values * MIRROR)
    battery = content.stream('battery_status', 'voltage_v')
    if battery is not None:
        mapped.append(Mapped('battery_status.voltage_v', 'V', '/battery', 'as it is',
                             battery.rate_hz))
    attitude = _attitude_setpoint(content, mapped)
    rate_setpoint = content.stream('vehicle_rates_setpoint', 'roll', 'pitch', 'yaw')
    if rate_setpoint is not None:
        mapped.append(Mapped('vehicle_rates_setpoint', 'rad/s', '/setpoint/rates',
                             'pitch and yaw turned', rate_setpoint.rate_hz))
        rate_setpoint = Stream(rate_setpoint.time_s, rate_setpoint.values * MIRROR)
    return ForeignLog(
        source=str(path), kind='a PX4 log', rates=rates, **given, angles=angles,
        acceleration=acceleration, attitude_setpoint=attitude, rate_setpoint=rate_setpoint,
        armed=_armed(content), battery=battery, gains=gains, faster=FASTER, mapped=tuple(mapped),
        missing=_missing(angles, attitude, rate_setpoint, battery, gains),
        warnings=(*_frame(content), *warnings),
    )


def _load(path: Path) -> _Content:
    try:
        from pyulog import ULog
    except ImportError as error:
        raise BadInputError(str(path), 'needs the package pyulog to be read',
                            remedy='pip install pyulog') from error
    try:
        log: Any = ULog(str(path), list(TOPICS), disable_str_exceptions=True)
    except Exception as error:  # pyulog raises whatever a damaged file makes it meet
        raise BadInputError(str(path), f'is not a whole ULog ({type(error).__name__}: {error})',
                            remedy='copy it anew from the aircraft') from error
    topics: dict[str, Mapping[str, FloatArray]] = {}
    for data in log.data_list:
        if data.name not in topics and len(data.data.get('timestamp', ())) > 1:
            topics[data.name] = data.data
    parameters = {
        str(name): float(value) for name, value in log.initial_parameters.items()
        if isinstance(value, int | float)
    }
    return _Content(str(path), topics, parameters)


def _armed(content: _Content) -> Stream | None:
    said = content.stream('actuator_armed', 'armed')
    if said is not None:
        return said
    state = content.stream('vehicle_status', 'arming_state')
    return None if state is None else Stream(state.time_s, 1.0 * (state.values == ARMED))


def _rates(content: _Content, mapped: list[Mapped]) -> Stream:
    cut = content.parameters.get('IMU_GYRO_CUTOFF')
    for topic, fields in (
        ('vehicle_angular_velocity', ('xyz[0]', 'xyz[1]', 'xyz[2]')),
        ('sensor_combined', ('gyro_rad[0]', 'gyro_rad[1]', 'gyro_rad[2]')),
    ):
        found = content.stream(topic, *fields)
        if found is not None:
            behind = f', behind a filter of {cut:g} Hz' if cut and topic[0] == 'v' else ''
            mapped.append(Mapped(topic, 'rad/s', '/imu/data angular_velocity',
                                 f'FRD to FLU: pitch and yaw turned{behind}', found.rate_hz))
            return Stream(found.time_s, found.values * MIRROR)
    raise BadInputError(
        content.source, 'holds no vehicle_angular_velocity and no sensor_combined',
        ', '.join(sorted(content.topics)) or 'no topic of use',
        'set SDLOG_PROFILE to high rate or system identification and log again',
    )


def _input(
    content: _Content, rates: Stream, mapped: list[Mapped]
) -> tuple[Given, dict[str, float], list[str]]:
    """What a ForeignLog takes of commands, the gains in their unit, warnings."""
    torque = _torque(content)
    count = int(content.parameters.get('CA_ROTOR_COUNT', 0)) or len(MOTOR_ORDER)
    motors = content.stream('actuator_motors', *(f'control[{i}]' for i in range(count)))
    fast = motors is not None and motors.rate_hz >= FAST_ENOUGH * rates.rate_hz
    if motors is not None and (fast or torque is None):
        mixer, how = _mixer(content, count)
        mapped.append(Mapped('actuator_motors.control', '0..1', '/control/wrench', how,
                             motors.rate_hz))
        scale = None if torque is None or mixer is None else _scale(
            Stream(motors.time_s, motors.values @ mixer.matrix.T), torque
        )
        warnings = [] if scale else [
            ("PX4's gains are not carried over: its torque set-point was not logged beside the "
            'motors, or does not follow from them')
        ]
        given: Given = {'motors': motors, 'mixer': mixer}
        return given, _gains(content, scale) if scale else {}, warnings
    if torque is not None:
        name = 'actuator_controls_0' if 'actuator_controls_0' in content.topics else \
            'vehicle_torque_setpoint and vehicle_thrust_setpoint'
        mapped.append(Mapped(
            name, '-1..1', '/control/wrench',
            "as it is, pitch and yaw turned; U is in the unit of PX4's torque set-point",
            torque.rate_hz,
        ))
        return {'control': torque}, _gains(content, (1.0, 1.0, 1.0)), [
            'the input is what the controller asked for: limits of the motors are not in it'
        ]
    raise BadInputError(
        content.source, 'holds no actuator_motors, vehicle_torque_setpoint or '
        'actuator_controls_0', ', '.join(sorted(content.topics)),
        'set SDLOG_PROFILE to high rate or system identification and log again',
    )


def _torque(content: _Content) -> Stream | None:
    """U1..U4 in PX4's own normalised unit, FLU."""
    old = content.stream('actuator_controls_0', *(f'control[{i}]' for i in (3, 0, 1, 2)))
    if old is not None:
        return Stream(old.time_s, old.values * np.concatenate(([1.0], MIRROR)))
    torque = content.stream('vehicle_torque_setpoint', 'xyz[0]', 'xyz[1]', 'xyz[2]')
    thrust = content.stream('vehicle_thrust_setpoint', 'xyz[2]')
    if torque is None or thrust is None:
        return None
    up = -np.interp(torque.time_s, thrust.time_s, thrust.values[:, 0])
    return Stream(torque.time_s, np.column_stack([up, torque.values * MIRROR]))


def _mixer(content: _Content, count: int) -> tuple[Mixer | None, str]:
    """What the motors do by the log's parameters; None where only the motion can say it."""
    known = content.parameters
    places = None
    if 'CA_ROTOR0_PX' in known and count == len(MOTOR_ORDER):
        places = order_by_places(
            np.array([known[f'CA_ROTOR{i}_PX'] for i in range(count)]),
            np.array([known[f'CA_ROTOR{i}_PY'] for i in range(count)]),
        )
    if count != len(MOTOR_ORDER) or ('CA_ROTOR0_PX' in known and places is None):
        return None, f'{count} motors that are no X frame: U by what the motion shows'
    order = places or MOTOR_ORDER
    clockwise = known.get(f'CA_ROTOR{order[0]}_KM', 0.05) < 0.0
    where = 'CA_ROTOR parameters' if places else "PX4's Quad X"
    return mixer_at_places(where, order, clockwise_rear_left=clockwise), (
        f'motors {", ".join(str(i + 1) for i in order)} of {where} stand rear left, rear right, '
        f"front right, front left; U by the mixer's inverse, yaw by their sense of rotation"
    )


def _scale(control: Stream, torque: Stream) -> tuple[float, float, float] | None:
    """U2..U4 per PX4's torque, from the log itself; None where they are not proportional."""
    at = np.clip(np.searchsorted(torque.time_s, control.time_s), 0, len(torque.time_s) - 1)
    found = []
    for column in (1, 2, 3):
        x, y = torque.values[at, column], control.values[:, column]
        good = np.isfinite(x) & np.isfinite(y)
        x, y = x[good], y[good]
        power = float(x @ x)
        if not power:
            return None
        slope = float(x @ y) / power
        left = float(np.sum((y - slope * x) ** 2))
        total = float(np.sum(y**2))
        if total <= 0.0 or 1.0 - left / total < LINEAR:
            return None
        found.append(slope)
    return found[0], found[1], found[2]


def _gains(content: _Content, scale: tuple[float, float, float]) -> dict[str, float]:
    """The contract's names; PX4's rate loop has their form: K (P e + I ∫e - D d(rate)/dt)."""
    known = content.parameters
    out: dict[str, float] = {}
    for axis, name, unit in zip(('roll', 'pitch', 'yaw'), ('ROLL', 'PITCH', 'YAW'), scale,
                                strict=True):
        factor = unit * known.get(f'MC_{name}RATE_K', 1.0)
        for ours, theirs, by in (
            ('angle.kp', f'MC_{name}_P', 1.0), ('rate.kp', f'MC_{name}RATE_P', factor),
            ('rate.ki', f'MC_{name}RATE_I', factor), ('rate.kd', f'MC_{name}RATE_D', factor),
            ('angle.rate_limit', f'MC_{name}RATE_MAX', np.pi / 180.0),
            ('rate.integrator_limit', f'MC_{name[0]}R_INT_LIM', unit),
            ('rate.d_filter_hz', 'IMU_DGYRO_CUTOFF', 1.0),
        ):
            if theirs in known and (known[theirs] > 0.0 or not ours.endswith(('limit', '_hz'))):
                out[f'{axis}.{ours}'] = float(known[theirs] * by)
        if f'{axis}.rate.kp' in out:
            out[f'{axis}.rate.output_limit'] = float(unit)
    cut = known.get('IMU_GYRO_CUTOFF')
    if cut and 'vehicle_angular_velocity' in content.topics:
        out['sensor.gyro_filter_hz'] = float(cut)
    return out


def _attitude_setpoint(content: _Content, mapped: list[Mapped]) -> Stream | None:
    topic = 'vehicle_attitude_setpoint'
    found = content.stream(topic, *(f'q_d[{i}]' for i in range(4)))
    if found is None or not (np.abs(found.values).sum(axis=1) > 0.5).all():
        return None
    mapped.append(Mapped(f'{topic}.q_d', '1', '/setpoint/attitude', 'FRD in NED to FLU in ENU',
                         found.rate_hz))
    return Stream(found.time_s, angles_from_ned(euler_from_quaternion(found.values)))


def _missing(
    angles: Stream | None, attitude: Stream | None, rates: Stream | None, battery: Stream | None,
    gains: Mapping[str, float],
) -> tuple[str, ...]:
    lacks = (
        (angles, 'vehicle_attitude: no effects of the angle, no closed loop'),
        (attitude, 'vehicle_attitude_setpoint: no indirect approach, no closed loop'),
        (rates, 'vehicle_rates_setpoint: the pictures lack the rate reference'),
        (battery, 'battery_status: battery sag cannot be told'),
        (gains or None, "the controller's gains: no closed loop, no gain design"),
    )
    return tuple(text for found, text in lacks if found is None)


def _frame(content: _Content) -> tuple[str, ...]:
    kind = content.parameters.get('MAV_TYPE')
    if kind is None or int(kind) == QUADROTOR:
        return ()
    return ((f'MAV_TYPE is {int(kind)}, not {QUADROTOR} (quadrotor): the model is one of a '
            'quadrotor in X; be careful'),)
