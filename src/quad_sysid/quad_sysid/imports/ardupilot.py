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
from quad_sysid.craft import Craft, ardupilot_channels, of_ardupilot
from quad_sysid.errors import BadInputError
from quad_sysid.files import read_by_library
from quad_sysid.imports.log import (
    ASKED_FOR,
    DEGREE,
    RPM,
    ForeignLog,
    Reading,
    Stream,
    Wanted,
    gains_of,
)
from quad_sysid.imports.mixers import MIRROR, angles_from_ned, mirrored
from quad_sysid.imports.table import Table

FIRST_INSTANCE = ('IMU', 'BAT')
INSTANCE = ('I', 'Instance', 'Inst')
QUAD = 4
"""Number of motors where the parameters do not say it."""
ARMED, DISARMED = 10, 11
"""Id of EV."""
AS_FAST = 0.9
"""Share of the gyro's rate from which on RATE, which the controller saw, is preferred."""
FASTER = ("set bit 0 (fast attitude) of LOG_BITMASK: RATE is then logged at the loop's rate, not "
          'at 10 Hz; LOG_FILE_RATEMAX 0')


def _mirrored_degrees(values: FloatArray) -> FloatArray:
    return mirrored(values * DEGREE)


def _ned_degrees(values: FloatArray) -> FloatArray:
    return angles_from_ned(values * DEGREE)


def _of(message: str, *fields: str) -> tuple[str, ...]:
    return tuple(f'{message}.{field}' for field in fields)


SEEN = Wanted('rates', _of('RATE', 'R', 'P', 'Y'), 'deg/s',
              'to rad/s, FRD to FLU: pitch and yaw turned', _mirrored_degrees)
GYRO = Wanted('rates', _of('IMU', 'GyrX', 'GyrY', 'GyrZ'), 'rad/s',
              'FRD to FLU: pitch and yaw turned', mirrored)
WANTED = (
    Wanted('angles', _of('ATT', 'Roll', 'Pitch', 'Yaw'), 'deg',
           'to rad, FRD in NED to FLU in ENU', _ned_degrees),
    Wanted('attitude_setpoint', _of('ATT', 'DesRoll', 'DesPitch', 'DesYaw'), 'deg',
           'to rad, FRD in NED to FLU in ENU', _ned_degrees),
    Wanted('rate_setpoint', _of('RATE', 'RDes', 'PDes', 'YDes'), 'deg/s',
           'to rad/s, pitch and yaw turned', _mirrored_degrees),
    Wanted('acceleration', _of('IMU', 'AccX', 'AccY', 'AccZ'), 'm/s²', 'y and z turned',
           mirrored),
    Wanted('battery', _of('BAT', 'Volt'), 'V', 'as it is'),
)
OUTPUTS = Wanted('control', _of('RATE', 'AOut', 'ROut', 'POut', 'YOut'), '-1..1',
                 'as they are, pitch and yaw turned; U is in the unit of these outputs',
                 lambda values: values * [1.0, *MIRROR])
MESSAGES = ('RATE', 'ATT', 'IMU', 'BAT', 'RCOU', 'ESC', 'EV')


def read(path: Path) -> ForeignLog:
    """Read a dataflash log; raises BadInputError where it is none or lacks rates or commands."""
    table = _load(path)
    seen, gyro = (table.stream(*one.columns) for one in (SEEN, GYRO))
    first = seen is not None and (gyro is None or seen.rate_hz >= AS_FAST * gyro.rate_hz)
    reading = Reading(table)
    reading.take(SEEN if first else GYRO, *WANTED)
    if 'rates' not in reading.streams:
        raise BadInputError(
            table.source, 'holds no RATE and no IMU messages',
            table.messages or 'no message of use',
            'set LOG_BITMASK to log fast attitude (bit 0) and log again',
        )
    crafts, gains, warnings = _input(reading)
    return reading.log('an ArduPilot log', WANTED, crafts=crafts, armed=_armed(table),
                       gains=gains, faster=FASTER, warnings=tuple(warnings))


def _armed(table: Table) -> Stream | None:
    """From each event on; before the first, what it ends."""
    events = table.columns.get('EV.Id', np.zeros(0))
    chosen = np.isin(events, (ARMED, DISARMED))
    if not chosen.any():
        return None
    state = events[chosen, None] == ARMED
    return Stream(np.r_[0.0, table.times['EV.Id'][chosen]], 1.0 * np.vstack([~state[:1], state]))


def _load(path: Path) -> Table:
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
        columns = {
            f'{kind}.{name}': np.array([row.get(name, np.nan) for row in some], dtype=float)
            for kind, some in rows.items() for name, value in some[0].items()
            if isinstance(value, int | float)
        }
    times = {name: columns[f'{name.partition(".")[0]}.TimeUS'] * 1e-6 for name in columns}
    return Table(str(path), columns, times, header=parameters)


def _instance(message: Any) -> int:
    return int(next((getattr(message, n) for n in INSTANCE if hasattr(message, n)), 0))


def _input(reading: Reading) -> tuple[tuple[Craft, ...], dict[str, float], list[str]]:
    """Take the commands: the craft of the motors, the gains in their unit, warnings."""
    table = reading.table
    craft = of_ardupilot(table.header)
    count = craft.count if isinstance(craft, Craft) else QUAD
    channels = ardupilot_channels(table.header, count)
    pulses = _of('RCOU', *(f'C{n}' for n in channels))
    if reading.motors_fast(table.stream(*pulses), table.stream(*OUTPUTS.columns)):
        low = table.header.get('MOT_PWM_MIN', 0.0) or 1000.0
        high = table.header.get('MOT_PWM_MAX', 0.0) or 2000.0
        how = f'in the places of {craft.name}' if isinstance(craft, Craft) else (
            f'{craft}: their places by what the motion shows')
        reading.take(Wanted('motors', pulses, 'µs', f'(pulse - {low:g}) / {high - low:g}; {how}',
                            lambda v: np.clip((v - low) / (high - low), 0.0, 1.0)))
        _speeds(reading, channels)
        return (craft,) if isinstance(craft, Craft) else (), {}, [
            ("ArduPilot's gains are not carried over: between its outputs and the pulses stands a "
            'thrust curve (MOT_THST_EXPO)')
        ]
    reading.take(OUTPUTS)
    if 'control' not in reading.streams:
        raise BadInputError(
            table.source, 'holds no RCOU and no RATE messages', table.messages,
            'set LOG_BITMASK to log fast attitude (bit 0) or RC output (bit 10) and log again',
        )
    return (), _gains(table), [ASKED_FOR]


def _speeds(reading: Reading, channels: tuple[int, ...]) -> None:
    """Take the speeds that the speed controllers report; their instance is the output less 1."""
    table = reading.table
    which, rpm = table.columns.get('ESC.Instance'), table.columns.get('ESC.RPM')
    if which is None or rpm is None or not np.nanmax(rpm) > 0.0:
        return
    known = set(np.unique(which).astype(int).tolist())
    own = [n - 1 for n in channels] if known <= {n - 1 for n in channels} else \
        [*range(len(channels))]
    values = np.full((len(rpm), len(channels)), np.nan)
    for motor, instance in enumerate(own):
        mine = which == instance
        values[mine, motor] = rpm[mine] * RPM
    reading.put(Wanted('speeds', ('ESC.RPM',), 'rpm', 'to rad/s'),
                Stream(table.times['ESC.RPM'], values))


def _gains(table: Table) -> dict[str, float]:
    """The contract's names. ArduPilot differentiates the error, ours the rate: D is alike."""
    return gains_of(table.header, {
        axis: (1.0, (
            ('angle.kp', f'ATC_ANG_{name}_P', 1.0), ('rate.kp', f'ATC_RAT_{name}_P', 1.0),
            ('rate.ki', f'ATC_RAT_{name}_I', 1.0), ('rate.kd', f'ATC_RAT_{name}_D', 1.0),
            ('rate.integrator_limit', f'ATC_RAT_{name}_IMAX', 1.0),
            ('rate.d_filter_hz', f'ATC_RAT_{name}_FLTD', 1.0),
            ('angle.rate_limit', f'ATC_RATE_{name[0]}_MAX', DEGREE),
        ))
        for axis, name in zip(AXES, ('RLL', 'PIT', 'YAW'), strict=True)
    })
