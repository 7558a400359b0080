"""An ArduPilot dataflash log (.bin, or its text .log) → ForeignLog, by pymavlink's DFReader.

Frames: FRD in NED, degrees. The input is the motors' pulses (RCOU) where they were logged about
as fast as the rates, else the controller's outputs (RATE.ROut, …). Source of names and units:
ArduPilot's list of onboard log messages.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from quad_sysid.errors import BadInputError
from quad_sysid.imports.frames import MIRROR, angles_from_ned, mixer_at_places
from quad_sysid.imports.log import ForeignLog, Given, Mapped, Stream

FIELDS: Mapping[str, tuple[str, ...]] = {
    'RATE': ('RDes', 'R', 'ROut', 'PDes', 'P', 'POut', 'YDes', 'Y', 'YOut', 'AOut'),
    'IMU': ('GyrX', 'GyrY', 'GyrZ', 'AccX', 'AccY', 'AccZ'),
    'ATT': ('DesRoll', 'Roll', 'DesPitch', 'Pitch', 'DesYaw', 'Yaw'),
    'RCOU': tuple(f'C{i}' for i in range(1, 15)),
    'BAT': ('Volt',),
    'EV': ('Id',),
}
FIRST_INSTANCE = ('IMU', 'BAT')
INSTANCE = ('I', 'Instance', 'Inst')
MOTOR_ORDER = (1, 3, 0, 2)
"""Motor at rear left, rear right, front right, front left in Quad X (1 front right, 2 rear left,
3 front left, 4 rear right); the rear left one turns counter-clockwise."""
MOTOR_FUNCTIONS = (33, 34, 35, 36, 37, 38, 39, 40)
"""SERVOn_FUNCTION of motors 1..8."""
MOTORS_OF_FRAME = {1: 4, 2: 6, 3: 8, 4: 8, 5: 6}
"""By FRAME_CLASS: quad, hexa, octa, octaquad, Y6."""
QUAD, X_FRAME = 1, 1
"""FRAME_CLASS, FRAME_TYPE."""
ARMED, DISARMED = 10, 11
"""Id of EV."""
FAST_ENOUGH = 0.5
FASTER = (
    "set bit 0 (fast attitude) of LOG_BITMASK: RATE is then logged at the l"
    "oop's rate, not at 10 Hz; LOG_FILE_RATEMAX 0"
)
DEGREE = np.pi / 180.0


@dataclass
class _Content:
    """Columns of the messages of interest, by message."""

    source: str
    rows: dict[str, list[list[float]]] = field(default_factory=dict)
    parameters: dict[str, float] = field(default_factory=dict)

    def stream(self, message: str, *names: str) -> Stream | None:
        """Columns (n, w) over time; None where the message or all of a column is missing."""
        rows = self.rows.get(message)
        if not rows or len(rows) < 2:
            return None
        table = np.array(rows, dtype=float)
        columns = [1 + FIELDS[message].index(name) for name in names]
        values = table[:, columns]
        if np.isnan(values).all(axis=0).any():
            return None
        order = np.argsort(table[:, 0], kind='stable')
        fresh = np.concatenate(([True], np.diff(table[order, 0]) > 0))
        order = order[fresh]
        return Stream(table[order, 0] * 1e-6, values[order])


def read(path: Path) -> ForeignLog:
    """Read a dataflash log; raises BadInputError where it is none or lacks rates or commands."""
    content = _load(path)
    mapped: list[Mapped] = []
    rates = _rates(content, mapped)
    given, gains, warnings = _input(content, rates, mapped)
    angles = content.stream('ATT', 'Roll', 'Pitch', 'Yaw')
    attitude = content.stream('ATT', 'DesRoll', 'DesPitch', 'DesYaw')
    wanted = content.stream('RATE', 'RDes', 'PDes', 'YDes')
    acceleration = content.stream('IMU', 'AccX', 'AccY', 'AccZ')
    battery = content.stream('BAT', 'Volt')
    for found, source, unit, topic, how in (
        (angles, 'ATT.Roll, Pitch, Yaw', 'deg', '/imu/data orientation',
         'to rad, FRD in NED to FLU in ENU'),
        (attitude, 'ATT.DesRoll, …', 'deg', '/setpoint/attitude',
         'to rad, FRD in NED to FLU in ENU'),
        (wanted, 'RATE.RDes, PDes, YDes', 'deg/s', '/setpoint/rates',
         'to rad/s, pitch and yaw turned'),
        (acceleration, 'IMU.AccX, AccY, AccZ', 'm/s²', '/imu/data linear_acceleration',
         'y and z turned'),
        (battery, 'BAT.Volt', 'V', '/battery', 'as it is'),
    ):
        if found is not None:
            mapped.append(Mapped(source, unit, topic, how, found.rate_hz))
    return ForeignLog(
        source=str(path), kind='an ArduPilot log', rates=rates, **given,
        angles=_degrees(angles, turned=True), attitude_setpoint=_degrees(attitude, turned=True),
        rate_setpoint=_degrees(wanted),
        acceleration=None if acceleration is None else
        Stream(acceleration.time_s, acceleration.values * MIRROR),
        armed=_armed(content), battery=battery, gains=gains, faster=FASTER,
        mapped=tuple(mapped), missing=_missing(angles, wanted, battery, gains),
        warnings=(*_frame(content), *warnings),
    )


def _degrees(stream: Stream | None, *, turned: bool = False) -> Stream | None:
    """Angles of NED, or rates of FRD, in degrees → ours in rad."""
    if stream is None:
        return None
    values = stream.values * DEGREE
    if not turned:
        return Stream(stream.time_s, values * MIRROR)
    return Stream(stream.time_s, angles_from_ned(values))


def _armed(content: _Content) -> Stream | None:
    """From each event on; before the first, what it ends."""
    events = np.array(content.rows.get('EV', ()), dtype=float).reshape(-1, 2)
    events = events[np.isin(events[:, 1], (ARMED, DISARMED))]
    if not len(events):
        return None
    state = events[:, 1:] == ARMED
    return Stream(np.r_[0.0, events[:, 0] * 1e-6], 1.0 * np.vstack([~state[:1], state]))


def _load(path: Path) -> _Content:
    try:
        from pymavlink.DFReader import DFReader_binary, DFReader_text
    except ImportError as error:
        raise BadInputError(str(path), 'needs the package pymavlink to be read',
                            remedy='pip install pymavlink') from error
    content = _Content(str(path))
    try:
        with path.open('rb') as stream:
            binary = stream.read(3) == b'\xa3\x95\x80'
        log: Any = (DFReader_binary if binary else DFReader_text)(str(path))
        while (message := log.recv_match(type=[*FIELDS, 'PARM'])) is not None:
            _take(content, message)
    except Exception as error:  # DFReader raises whatever a damaged file makes it meet
        raise BadInputError(
            str(path), f'is not a whole dataflash log ({type(error).__name__}: {error})',
            remedy='download it anew from the aircraft',
        ) from error
    return content


def _take(content: _Content, message: Any) -> None:
    kind = message.get_type()
    if kind == 'PARM':
        content.parameters[str(message.Name)] = float(message.Value)
        return
    if kind in FIRST_INSTANCE:
        instance = next((getattr(message, n) for n in INSTANCE if hasattr(message, n)), 0)
        if int(instance) != 0:
            return
    values = [float(getattr(message, name, np.nan)) for name in FIELDS[kind]]
    content.rows.setdefault(kind, []).append([float(message.TimeUS), *values])


def _rates(content: _Content, mapped: list[Mapped]) -> Stream:
    """The faster of RATE (what the controller saw, filtered) and the first gyro."""
    seen = content.stream('RATE', 'R', 'P', 'Y')
    gyro = content.stream('IMU', 'GyrX', 'GyrY', 'GyrZ')
    if seen is not None and (gyro is None or seen.rate_hz >= 0.9 * gyro.rate_hz):
        mapped.append(Mapped('RATE.R, P, Y', 'deg/s', '/imu/data angular_velocity',
                             'to rad/s, FRD to FLU: pitch and yaw turned', seen.rate_hz))
        return Stream(seen.time_s, seen.values * DEGREE * MIRROR)
    if gyro is not None:
        mapped.append(Mapped('IMU.GyrX, GyrY, GyrZ', 'rad/s', '/imu/data angular_velocity',
                             'FRD to FLU: pitch and yaw turned', gyro.rate_hz))
        return Stream(gyro.time_s, gyro.values * MIRROR)
    raise BadInputError(
        content.source, 'holds no RATE and no IMU messages',
        ', '.join(sorted(content.rows)) or 'no message of use',
        'set LOG_BITMASK to log fast attitude (bit 0) and log again',
    )


def _input(
    content: _Content, rates: Stream, mapped: list[Mapped]
) -> tuple[Given, dict[str, float], list[str]]:
    """What a ForeignLog takes of commands, the gains in their unit, warnings."""
    outputs = content.stream('RATE', 'AOut', 'ROut', 'POut', 'YOut')
    asked = None if outputs is None else Stream(
        outputs.time_s, outputs.values * np.concatenate(([1.0], MIRROR))
    )
    pulses = content.stream('RCOU', *_channels(content))
    fast = pulses is not None and pulses.rate_hz >= FAST_ENOUGH * rates.rate_hz
    if pulses is not None and (fast or asked is None):
        low = content.parameters.get('MOT_PWM_MIN', 0.0) or 1000.0
        high = content.parameters.get('MOT_PWM_MAX', 0.0) or 2000.0
        motors = np.clip((pulses.values - low) / (high - low), 0.0, 1.0)
        given: Given = {'motors': Stream(pulses.time_s, motors), 'mixer': None}
        how = 'U by what the motion shows'
        if motors.shape[1] == len(MOTOR_ORDER) and not _frame(content):
            given['mixer'] = mixer_at_places("ArduPilot's Quad X", MOTOR_ORDER,
                                             clockwise_rear_left=False)
            how = ('motors 2, 4, 1, 3 stand rear left, rear right, front right, front left; U by '
                   "the mixer's inverse, yaw by their sense of rotation")
        mapped.append(Mapped(f'RCOU.{", ".join(_channels(content))}', 'µs', '/control/wrench',
                             f'(pulse - {low:g}) / {high - low:g}; {how}', pulses.rate_hz))
        return given, {}, [
            ("ArduPilot's gains are not carried over: between its outputs and the pulses stands a "
            'thrust curve (MOT_THST_EXPO)')
        ]
    if asked is not None:
        mapped.append(Mapped(
            'RATE.AOut, ROut, POut, YOut', '-1..1', '/control/wrench',
            'as they are, pitch and yaw turned; U is in the unit of these outputs',
            asked.rate_hz,
        ))
        return {'control': asked}, _gains(content.parameters), [
            'the input is what the controller asked for: limits of the motors are not in it'
        ]
    raise BadInputError(
        content.source, 'holds no RCOU and no RATE messages', ', '.join(sorted(content.rows)),
        'set LOG_BITMASK to log fast attitude (bit 0) or RC output (bit 10) and log again',
    )


def _channels(content: _Content) -> tuple[str, ...]:
    """RCOU columns of the motors, by SERVOn_FUNCTION where the log says it."""
    count = MOTORS_OF_FRAME.get(int(content.parameters.get('FRAME_CLASS', QUAD)), 4)
    found = {
        int(value): name.removeprefix('SERVO').removesuffix('_FUNCTION')
        for name, value in content.parameters.items()
        if name.startswith('SERVO') and name.endswith('_FUNCTION')
    }
    motors = [found.get(function) for function in MOTOR_FUNCTIONS[:count]]
    if any(channel is None or int(channel) > 14 for channel in motors):
        return tuple(f'C{i + 1}' for i in range(count))
    return tuple(f'C{channel}' for channel in motors)


def _gains(known: Mapping[str, float]) -> dict[str, float]:
    """The contract's names. ArduPilot differentiates the error, ours the rate: D is alike."""
    out: dict[str, float] = {}
    for axis, name in (('roll', 'RLL'), ('pitch', 'PIT'), ('yaw', 'YAW')):
        for ours, theirs in (
            ('angle.kp', f'ATC_ANG_{name}_P'), ('rate.kp', f'ATC_RAT_{name}_P'),
            ('rate.ki', f'ATC_RAT_{name}_I'), ('rate.kd', f'ATC_RAT_{name}_D'),
            ('rate.integrator_limit', f'ATC_RAT_{name}_IMAX'),
            ('rate.d_filter_hz', f'ATC_RAT_{name}_FLTD'),
        ):
            if theirs in known and (known[theirs] > 0.0 or not ours.endswith(('limit', '_hz'))):
                out[f'{axis}.{ours}'] = float(known[theirs])
        limit = known.get(f'ATC_RATE_{name[0]}_MAX', 0.0)
        if limit > 0.0:
            out[f'{axis}.angle.rate_limit'] = limit * DEGREE
        if f'{axis}.rate.kp' in out:
            out[f'{axis}.rate.output_limit'] = 1.0
    return out


def _missing(
    angles: Stream | None, wanted: Stream | None, battery: Stream | None,
    gains: Mapping[str, float],
) -> tuple[str, ...]:
    lacks = (
        (angles, 'ATT: no effects of the angle, no closed loop'),
        (wanted, 'RATE: no rate reference'),
        (battery, 'BAT: battery sag cannot be told'),
        (gains or None, "the controller's gains: no closed loop, no gain design"),
    )
    return tuple(text for found, text in lacks if found is None)


def _frame(content: _Content) -> tuple[str, ...]:
    kind = content.parameters.get('FRAME_CLASS'), content.parameters.get('FRAME_TYPE')
    if kind[0] is None or (kind[0], kind[1]) == (QUAD, X_FRAME):
        return ()
    return ((f'FRAME_CLASS {kind[0]:g}, FRAME_TYPE {kind[1] or 0:g} is not a quadrotor in X '
            f'({QUAD}, {X_FRAME}): its motors stand elsewhere; be careful'),)
