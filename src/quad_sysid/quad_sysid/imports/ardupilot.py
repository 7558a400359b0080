"""An ArduPilot dataflash log (.bin, or its text .log, read by dataflash.py) → ForeignLog.

The input is the motors' pulses (RCOU) where they were logged about as fast as the rates, else the
controller's outputs (RATE.ROut, …). Source of names and units: ArduPilot's list of onboard log
messages.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from quad_sysid.autopilot_table import ARDUPILOT, Units, ardupilot_units
from quad_sysid.contract import AXES, FloatArray
from quad_sysid.craft import Craft, ardupilot_channels, ardupilot_range_us, of_ardupilot
from quad_sysid.errors import BadInputError
from quad_sysid.files import readable
from quad_sysid.imports.clock import Stream
from quad_sysid.imports.dataflash import is_binary, read_binary, read_text
from quad_sysid.imports.experiments import PAUSE_S
from quad_sysid.imports.log import (
    DEGREE,
    DEMAND_ONLY,
    RPM,
    Experiment,
    ForeignLog,
    Reading,
    Signal,
    changes_of,
    per_torque,
    within,
)
from quad_sysid.imports.mixers import MIRROR, angles_from_ned, enu, mirrored
from quad_sysid.imports.table import Table, head_of, text_lines

FIRST_INSTANCE = ('IMU', 'BAT', 'XKF1')
INSTANCE = ('I', 'Instance', 'Inst', 'C')
OLD_CHANNEL = re.compile(r'^Ch(an)?(?=\d)')
"""How RCOU's C1, C2, … began before 2015."""
ARMED, DISARMED = 10, 11
"""Id of EV."""
OF_RATES = ('RATE.RDes', 'RATE.R', 'RATE.PDes', 'RATE.P', 'RATE.YDes', 'RATE.Y')
MAX_PULSE = 3000.0
"""µs. No speed controller is sent a longer one."""
MIN_MESSAGES = 10
"""Messages of CTUN that say how it climbs."""
LEAST_TURN = 0.1
"""Least size of the gyro, deg/s, beside which RATE is judged: at rest there is noise only."""
HUNDREDTHS = (30.0, 300.0)
"""Ratio of RATE in hundredths of a degree to the gyro in degrees."""
FIRST_WEEK = 1500.0
"""Of a date: before a fix receivers count from 1980 or 1999."""
GPS_EPOCH_S, WEEK_S = 315_964_800.0 - 18.0, 604_800.0
"""Begin of GPS time in UTC, s, by the leap seconds since 2017; length of its weeks."""
AS_FAST = 0.9
"""Share of the gyro's rate from which on RATE, which the controller saw, is preferred."""
FASTER = ("set bit 0 (fast attitude) of LOG_BITMASK: RATE is then logged at the loop's rate, not "
          'at 10 Hz; LOG_FILE_RATEMAX 0')


def _mirrored_degrees(values: FloatArray) -> FloatArray:
    return mirrored(values * DEGREE)


def _ned_degrees(values: FloatArray) -> FloatArray:
    return angles_from_ned(values * DEGREE)


CONTROL_RATES = Signal('rates', within('RATE', 'R', 'P', 'Y'), 'deg/s',
                       'to rad/s, FRD to FLU: pitch and yaw turned', _mirrored_degrees)
GYRO = Signal('rates', within('IMU', 'GyrX', 'GyrY', 'GyrZ'), 'rad/s',
              'FRD to FLU: pitch and yaw turned', mirrored)
SIGNALS = (
    Signal('angles', within('ATT', 'Roll', 'Pitch', 'Yaw'), 'deg',
           'to rad, FRD in NED to FLU in ENU', _ned_degrees),
    Signal('attitude_setpoint', within('ATT', 'DesRoll', 'DesPitch', 'DesYaw'), 'deg',
           'to rad, FRD in NED to FLU in ENU', _ned_degrees),
    Signal('rate_setpoint', within('RATE', 'RDes', 'PDes', 'YDes'), 'deg/s',
           'to rad/s, pitch and yaw turned', _mirrored_degrees),
    Signal('acceleration', within('IMU', 'AccX', 'AccY', 'AccZ'), 'm/s²', 'y and z turned',
           mirrored),
    *(signal for name in ('XKF1', 'NKF1') for signal in (
        Signal('velocity', within(name, 'VN', 'VE', 'VD'), 'm/s', 'NED to ENU', enu),
        Signal('position', within(name, 'PN', 'PE', 'PD'), 'm', 'NED to ENU', enu))),
    Signal('battery', within('BAT', 'Volt'), 'V', 'as it is'),
)
OUTPUTS = Signal('control', within('RATE', 'AOut', 'ROut', 'POut', 'YOut'), '-1..1',
                 'as they are, pitch and yaw turned; U is in the unit of these outputs',
                 lambda values: values * [1.0, *MIRROR])
MESSAGES = ('RATE', 'ATT', 'IMU', 'XKF1', 'NKF1', 'CTUN', 'BAT', 'RCOU', 'ESC', 'EV', 'SIDD',
            'SIDS', 'GPS')
NO_GAINS = ("ArduPilot's gains are not carried over: {}, so nobody knows what its outputs do to "
            'the motors')
AT_HOVER = ("ArduPilot's gains are stated for the thrust of hover: between its outputs and the "
            'pulses stands a thrust curve (MOT_THST_EXPO, MOT_THST_HOVER)')
INJECTED: Mapping[int, tuple[str, str, float]] = {
    **{first + i: (AXES[i], 'attitude', DEGREE) for first in (1, 4) for i in (0, 1)},
    **{7 + i: (axis, 'rate', DEGREE) for i, axis in enumerate(AXES)},
    **{10 + i: (axis, 'control', 1.0) for i, axis in enumerate(AXES)},
}
"""By SID_AXIS: the axis, the place and the factor to its unit. Others move no single axis (thrust,
position), or are added to the rate that the pilot asks of the heading (3, 6): no place of ours."""
OF_CHIRP = {'Mag': 'magnitude', 'FSt': 'start_hz', 'FSp': 'stop_hz', 'TR': 'length_s'}
"""What SIDS says of the chirp, and how a segment calls it."""


def read(path: Path) -> ForeignLog:
    """Read a dataflash log; raises BadInputError where it is none or lacks rates or commands."""
    table = _load(path)
    estimate, gyro = (table.stream(*signal.columns) for signal in (CONTROL_RATES, GYRO))
    first = estimate is not None and (gyro is None or estimate.rate_hz >= AS_FAST * gyro.rate_hz)
    reading = Reading(table)
    reading.take(CONTROL_RATES if first else GYRO, *SIGNALS)
    if 'rates' not in reading.streams:
        raise BadInputError(table.source, 'holds no RATE and no IMU messages',
                            table.messages or 'no message of use',
                            'copy the log whole, or set LOG_BITMASK to log fast attitude (bit 0) '
                            'and log again')
    _climb(reading)
    crafts, units, warnings = _input(reading)

    def gains(parameters: Mapping[str, float]) -> dict[str, float]:
        return {} if units is None else ARDUPILOT.gains(parameters, units)

    return reading.log('an ArduPilot log', SIGNALS, crafts=crafts, armed=_armed(table),
                       gains=gains(table.header), faster=FASTER, warnings=tuple(warnings),
                       gain_changes=changes_of(
                           table, ARDUPILOT.logged if units else (), gains),
                       loop_s=_loop_s(table.header), utc_s=_utc_s(table),
                       experiments=tuple(_experiments(table)))


def _loop_s(parameters: Mapping[str, float]) -> float | None:
    """The controller's cycle, s; None where it is not stated, or of a thread of its own."""
    hz = parameters.get('SCHED_LOOP_RATE', 0.0)
    return 1.0 / hz if hz > 0.0 and not parameters.get('FSTRATE_ENABLE') else None


def _utc_s(table: Table) -> float | None:
    """Time 0 in UTC, s, by the GPS; None without a fix."""
    gps = table.stream('GPS.GWk', 'GPS.GMS')
    if gps is None or not (fixed := gps.values[:, 0] > FIRST_WEEK).any():
        return None
    week, ms = gps.values[fixed].T
    return float(np.median(GPS_EPOCH_S + WEEK_S * week + 1e-3 * ms - gps.time_s[fixed]))


def _climb(reading: Reading) -> None:
    """Take the vertical speed and the altitude of CTUN where no estimate of the place was logged.

    CRt is in cm/s, in some versions in m/s: the slope of the altitude says which.
    """
    logged = reading.table.stream('CTUN.CRt', 'CTUN.Alt')
    if logged is None or 'velocity' in reading.streams or len(logged.time_s) < MIN_MESSAGES:
        return
    rate, height = logged.values.T
    slope = np.gradient(height, logged.time_s)
    off = [np.nansum((factor * rate - slope) ** 2) for factor in (0.01, 1.0)]
    factor, unit = (0.01, 'cm/s') if off[0] <= off[1] else (1.0, 'm/s')
    for role, name, values, of, how in (
        ('velocity', 'CRt', factor * rate, unit, 'the vertical speed alone, by its altitude'),
        ('position', 'Alt', height, 'm', 'the altitude alone'),
    ):
        up = np.column_stack([np.full((rate.size, 2), np.nan), values])
        reading.streams.pop(role, None)
        reading.put(Signal(role, (f'CTUN.{name}',), of, how), Stream(logged.time_s, up))


def _experiments(table: Table) -> Iterator[Experiment]:
    """What SYSTEM ID mode injected (SIDD), each time as its settings (SIDS) say.

    The mode goes on, and logs zeros, when its chirp has ended: that excites nothing any more.
    """
    added, axes = table.stream('SIDD.Targ'), table.columns.get('SIDS.Ax', np.zeros(0))
    if added is None or not axes.size:
        return
    settings = table.times['SIDS.Ax']
    parts = np.flatnonzero(np.diff(added.time_s) > PAUSE_S) + 1
    parts = np.union1d(parts, np.searchsorted(added.time_s, settings))
    for part in np.split(np.arange(added.time_s.size), parts[(parts > 0)]):
        on = part[np.flatnonzero(added.values[part])]
        if on.size < 2:
            continue
        rows = np.arange(on[0], on[-1] + 1)
        index = max(int(np.searchsorted(settings, added.time_s[rows[0]], side='right')) - 1, 0)
        if int(axes[index]) not in INJECTED:
            continue
        axis, injection, factor = INJECTED[int(axes[index])]
        values = factor * MIRROR[AXES.index(axis)] * added.values[rows]
        chirp = {name: float(table.columns[f'SIDS.{own}'][index]) for own, name in OF_CHIRP.items()
                 if f'SIDS.{own}' in table.columns}
        yield Experiment(axis, 'chirp', injection, Stream(added.time_s[rows], values), chirp)


def _armed(table: Table) -> Stream | None:
    """From each event on; before the first, what it ends."""
    events = table.columns.get('EV.Id', np.zeros(0))
    chosen = np.isin(events, (ARMED, DISARMED))
    if not chosen.any():
        return None
    state = events[chosen, None] == ARMED
    return Stream(np.r_[0.0, table.times['EV.Id'][chosen]], 1.0 * np.vstack([~state[:1], state]))


def _load(path: Path) -> Table:
    with readable(path):
        binary = is_binary(head_of(path))
        if binary:
            log = read_binary(np.memmap(path, dtype=np.uint8, mode='r'), MESSAGES)
        else:
            with text_lines(path) as lines:
                log = read_text(lines, MESSAGES)
    columns, times = {}, {}
    for name, values in log.columns.items():
        kind, _, label = name.partition('.')
        first = next((log.columns[f'{kind}.{i}'] == 0.0 for i in INSTANCE
                      if kind in FIRST_INSTANCE and f'{kind}.{i}' in log.columns),
                     np.ones(len(values), dtype=bool))
        ours = f'{kind}.{OLD_CHANNEL.sub("C", label)}' if kind == 'RCOU' else name
        columns[ours], times[ours] = values[first], log.times[name][first]
        if ours.startswith('RCOU.C'):
            columns[ours] = np.where(columns[ours] > MAX_PULSE, np.nan, columns[ours])
    initial = {name: value for name, value in log.initial.items() if name in ARDUPILOT.logged}
    if 'RATE.R' in columns and (log.in_ms or _hundredths(columns)):
        for name in OF_RATES:
            columns[name] = columns.get(name, np.zeros(0)) * 0.01
    notes = []
    if log.restarts:
        notes.append(f'its clock begins anew {log.restarts} times: {log.restarts + 1} flights, '
                     'placed one behind the other')
    if log.skipped:
        notes.append(f'damaged: {log.skipped} {"bytes" if binary else "characters"} in '
                     f'{log.bursts} places belong to no whole message and are left out')
    return Table(str(path), columns, times, header={**log.parameters, **initial},
                 changed=tuple(log.changed), notes=tuple(notes))


def _hundredths(columns: Mapping[str, FloatArray]) -> bool:
    """Whether RATE is in hundredths of a degree a second, as in Copter 3.3, by the gyro's size."""
    if 'IMU.GyrX' not in columns:
        return False
    rate, gyro = (float(np.nanmedian(np.abs(x - np.nanmedian(x))))  # whatever damaged ones hold
                  for x in (columns['RATE.R'], columns['IMU.GyrX'] / DEGREE))
    low, high = HUNDREDTHS
    return low < rate / max(gyro, LEAST_TURN) < high


def _input(reading: Reading) -> tuple[tuple[Craft, ...], Units | None, list[str]]:
    """Take the commands: the craft of the motors, the gains' units if known, warnings."""
    table = reading.table
    craft = of_ardupilot(table.header)
    channels = ardupilot_channels(table.header, craft.count if isinstance(craft, Craft) else 0)
    pulses = within('RCOU', *(f'C{n}' for n in channels))
    if reading.motors_fast(table.stream(*pulses), table.stream(*OUTPUTS.columns)):
        low, high = ardupilot_range_us(table.header)
        how = f'in the places of {craft.name}' if isinstance(craft, Craft) else (
            f'{craft}: their places by what the motion shows')
        reading.take(Signal('motors', pulses, 'µs', f'(pulse - {low:g}) / {high - low:g}; {how}',
                            lambda v: np.clip((v - low) / (high - low), 0.0, 1.0)))
        _speeds(reading, channels)
        if not isinstance(craft, Craft):
            return (), None, [NO_GAINS.format(craft)]
        units = ardupilot_units(craft.mixer, table.header)
        return (craft,), units, [f'{AT_HOVER}; {per_torque(units)}']
    reading.take(OUTPUTS)
    if 'control' not in reading.streams:
        raise BadInputError(
            table.source, 'holds no RCOU and no RATE messages', table.messages,
            'copy the log whole, or set LOG_BITMASK to log fast attitude (bit 0) or RC output '
            '(bit 10) and log again',
        )
    return (), (1.0, 1.0, 1.0), [DEMAND_ONLY]


def _speeds(reading: Reading, channels: tuple[int, ...]) -> None:
    """Take the speeds that the speed controllers report; their instance is the output less 1."""
    table = reading.table
    which, rpm = table.columns.get('ESC.Instance'), table.columns.get('ESC.RPM')
    if which is None or rpm is None or not np.nanmax(rpm) > 0.0:
        return
    numbers = set(np.unique(which).astype(int).tolist())
    own = [n - 1 for n in channels] if numbers <= {n - 1 for n in channels} else \
        [*range(len(channels))]
    values = np.full((len(rpm), len(channels)), np.nan)
    for motor, instance in enumerate(own):
        mine = which == instance
        values[mine, motor] = rpm[mine] * RPM
    reading.put(Signal('speeds', ('ESC.RPM',), 'rpm', 'to rad/s'),
                Stream(table.times['ESC.RPM'], values))
