"""An ArduPilot dataflash log (.bin, or its text .log) → ForeignLog, by pymavlink's DFReader.

The input is the motors' pulses (RCOU) where they were logged about as fast as the rates, else the
controller's outputs (RATE.ROut, …). Source of names and units: ArduPilot's list of onboard log
messages.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from quad_sysid.contract import AXES, FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.files import read_by_library
from quad_sysid.imports.firmware import (
    ASKED_FOR,
    Content,
    Wanted,
    gains_of,
    missing,
    motors_fast,
)
from quad_sysid.imports.frames import MIRROR, angles_from_ned, mirrored, mixer_at_places
from quad_sysid.imports.log import ForeignLog, Given, Mapped, Stream

FIRST_INSTANCE = ('IMU', 'BAT')
INSTANCE = ('I', 'Instance', 'Inst')
MOTOR_ORDER = (1, 3, 0, 2)
"""Motor at rear left, rear right, front right, front left in Quad X (1 front right, 2 rear left,
3 front left, 4 rear right); the rear left one turns counter-clockwise."""
MOTOR_FUNCTIONS = (33, 34, 35, 36, 37, 38, 39, 40)
"""SERVOn_FUNCTION of motors 1..8."""
CHANNELS = 14
MOTORS_OF_FRAME = {1: 4, 2: 6, 3: 8, 4: 8, 5: 6}
"""By FRAME_CLASS: quad, hexa, octa, octaquad, Y6."""
QUAD, X_FRAME = 1, 1
"""FRAME_CLASS, FRAME_TYPE."""
ARMED, DISARMED = 10, 11
"""Id of EV."""
AS_FAST = 0.9
"""Share of the gyro's rate from which on RATE, which the controller saw, is preferred."""
FASTER = ("set bit 0 (fast attitude) of LOG_BITMASK: RATE is then logged at the loop's rate, not "
          'at 10 Hz; LOG_FILE_RATEMAX 0')
DEGREE = np.pi / 180.0


def _mirrored_degrees(values: FloatArray) -> FloatArray:
    return mirrored(values * DEGREE)


def _ned_degrees(values: FloatArray) -> FloatArray:
    return angles_from_ned(values * DEGREE)


SEEN = Wanted('rates', 'RATE', ('R', 'P', 'Y'), 'deg/s',
              'to rad/s, FRD to FLU: pitch and yaw turned', _mirrored_degrees)
GYRO = Wanted('rates', 'IMU', ('GyrX', 'GyrY', 'GyrZ'), 'rad/s',
              'FRD to FLU: pitch and yaw turned', mirrored)
WANTED = (
    Wanted('angles', 'ATT', ('Roll', 'Pitch', 'Yaw'), 'deg', 'to rad, FRD in NED to FLU in ENU',
           _ned_degrees),
    Wanted('attitude_setpoint', 'ATT', ('DesRoll', 'DesPitch', 'DesYaw'), 'deg',
           'to rad, FRD in NED to FLU in ENU', _ned_degrees),
    Wanted('rate_setpoint', 'RATE', ('RDes', 'PDes', 'YDes'), 'deg/s',
           'to rad/s, pitch and yaw turned', _mirrored_degrees),
    Wanted('acceleration', 'IMU', ('AccX', 'AccY', 'AccZ'), 'm/s²', 'y and z turned', mirrored),
    Wanted('battery', 'BAT', ('Volt',), 'V', 'as it is'),
)
OUTPUTS = ('AOut', 'ROut', 'POut', 'YOut')
MESSAGES = (*dict.fromkeys(one.message for one in (SEEN, *WANTED)), 'RCOU', 'EV')


def read(path: Path) -> ForeignLog:
    """Read a dataflash log; raises BadInputError where it is none or lacks rates or commands."""
    content = _load(path)
    seen, gyro = (content.stream(one.message, *one.fields) for one in (SEEN, GYRO))
    first = seen is not None and (gyro is None or seen.rate_hz >= AS_FAST * gyro.rate_hz)
    mapped: list[Mapped] = []
    streams = content.streams((SEEN if first else GYRO, *WANTED), mapped)
    if 'rates' not in streams:
        raise BadInputError(
            content.source, 'holds no RATE and no IMU messages',
            ', '.join(sorted(content.messages)) or 'no message of use',
            'set LOG_BITMASK to log fast attitude (bit 0) and log again',
        )
    given, gains, warnings = _input(content, streams['rates'], mapped)
    return ForeignLog(
        source=str(path), kind='an ArduPilot log', **streams, **given, armed=_armed(content),
        gains=gains, faster=FASTER, mapped=tuple(mapped), missing=missing(WANTED, streams, gains),
        warnings=(*_frame(content), *warnings),
    )


def _armed(content: Content) -> Stream | None:
    """From each event on; before the first, what it ends."""
    events = content.messages.get('EV')
    if events is None:
        return None
    chosen = np.isin(events['Id'], (ARMED, DISARMED))
    if not chosen.any():
        return None
    state = events['Id'][chosen, None] == ARMED
    return Stream(np.r_[0.0, events['timestamp'][chosen] * 1e-6],
                  1.0 * np.vstack([~state[:1], state]))


def _load(path: Path) -> Content:
    rows: dict[str, list[dict[str, float]]] = {}
    parameters: dict[str, float] = {}
    with read_by_library(path, 'is not a whole dataflash log',
                         'download it anew from the aircraft'):
        from pymavlink.DFReader import DFReader_binary, DFReader_text

        with path.open('rb') as stream:
            binary = stream.read(3) == b'\xa3\x95\x80'
        log: Any = (DFReader_binary if binary else DFReader_text)(str(path))
        while (message := log.recv_match(type=[*MESSAGES, 'PARM'])) is not None:
            kind = message.get_type()
            if kind == 'PARM':
                parameters[str(message.Name)] = float(message.Value)
            elif kind not in FIRST_INSTANCE or not _instance(message):
                rows.setdefault(kind, []).append(message.to_dict())
        messages = {
            kind: {
                'timestamp' if name == 'TimeUS' else name:
                np.array([row.get(name, np.nan) for row in some], dtype=float)
                for name, value in some[0].items() if isinstance(value, int | float)
            }
            for kind, some in rows.items()
        }
    return Content(str(path), messages, parameters)


def _instance(message: Any) -> int:
    return int(next((getattr(message, n) for n in INSTANCE if hasattr(message, n)), 0))


def _input(
    content: Content, rates: Stream, mapped: list[Mapped]
) -> tuple[Given, dict[str, float], list[str]]:
    """What a ForeignLog takes of commands, the gains in their unit, warnings."""
    asked = content.stream('RATE', *OUTPUTS)
    channels = _channels(content)
    pulses = content.stream('RCOU', *channels)
    if pulses is not None and motors_fast(pulses, rates, asked):
        low = content.parameters.get('MOT_PWM_MIN', 0.0) or 1000.0
        high = content.parameters.get('MOT_PWM_MAX', 0.0) or 2000.0
        motors = Stream(pulses.time_s, np.clip((pulses.values - low) / (high - low), 0.0, 1.0))
        mixer, how = None, 'U by what the motion shows'
        if len(channels) == len(MOTOR_ORDER) and not _frame(content):
            mixer = mixer_at_places("ArduPilot's Quad X", MOTOR_ORDER, clockwise_rear_left=False)
            how = ('motors 2, 4, 1, 3 stand rear left, rear right, front right, front left; U by '
                   "the mixer's inverse, yaw by their sense of rotation")
        mapped.append(Mapped(f'RCOU.{", ".join(channels)}', 'µs', '/control/wrench',
                             f'(pulse - {low:g}) / {high - low:g}; {how}', pulses.rate_hz))
        return {'motors': motors, 'mixer': mixer}, {}, [
            ("ArduPilot's gains are not carried over: between its outputs and the pulses stands a "
            'thrust curve (MOT_THST_EXPO)')
        ]
    if asked is None:
        raise BadInputError(
            content.source, 'holds no RCOU and no RATE messages',
            ', '.join(sorted(content.messages)),
            'set LOG_BITMASK to log fast attitude (bit 0) or RC output (bit 10) and log again',
        )
    mapped.append(Mapped(
        f'RATE.{", ".join(OUTPUTS)}', '-1..1', '/control/wrench',
        'as they are, pitch and yaw turned; U is in the unit of these outputs', asked.rate_hz,
    ))
    return {'control': Stream(asked.time_s, asked.values * [1.0, *MIRROR])}, \
        _gains(content), [ASKED_FOR]


def _channels(content: Content) -> tuple[str, ...]:
    """RCOU columns of the motors, by SERVOn_FUNCTION where the log says it."""
    count = MOTORS_OF_FRAME.get(int(content.parameters.get('FRAME_CLASS', QUAD)), 4)
    found = {content.parameters.get(f'SERVO{n}_FUNCTION'): f'C{n}' for n in range(1, CHANNELS + 1)}
    motors = [found.get(function) for function in MOTOR_FUNCTIONS[:count]]
    named = tuple(channel for channel in motors if channel is not None)
    return named if len(named) == count else tuple(f'C{i + 1}' for i in range(count))


def _gains(content: Content) -> dict[str, float]:
    """The contract's names. ArduPilot differentiates the error, ours the rate: D is alike."""
    return gains_of(content.parameters, {
        axis: (1.0, (
            ('angle.kp', f'ATC_ANG_{name}_P', 1.0), ('rate.kp', f'ATC_RAT_{name}_P', 1.0),
            ('rate.ki', f'ATC_RAT_{name}_I', 1.0), ('rate.kd', f'ATC_RAT_{name}_D', 1.0),
            ('rate.integrator_limit', f'ATC_RAT_{name}_IMAX', 1.0),
            ('rate.d_filter_hz', f'ATC_RAT_{name}_FLTD', 1.0),
            ('angle.rate_limit', f'ATC_RATE_{name[0]}_MAX', DEGREE),
        ))
        for axis, name in zip(AXES, ('RLL', 'PIT', 'YAW'), strict=True)
    })


def _frame(content: Content) -> tuple[str, ...]:
    kind = content.parameters.get('FRAME_CLASS'), content.parameters.get('FRAME_TYPE')
    if kind[0] is None or (kind[0], kind[1]) == (QUAD, X_FRAME):
        return ()
    return ((f'FRAME_CLASS {kind[0]:g}, FRAME_TYPE {kind[1] or 0:g} is not a quadrotor in X '
            f'({QUAD}, {X_FRAME}): its motors stand elsewhere; be careful'),)
