"""A Betaflight blackbox table (CSV of blackbox_decode or the Blackbox Explorer) → ForeignLog.

Betaflight's body frame is ours: x forward, y left, z up; nose down is positive pitch. Its rate
loop has feed-forward and gains that change with the throttle, so no gains are carried over.
"""

from __future__ import annotations

import csv
import gzip
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.imports.frames import control_at_places
from quad_sysid.imports.log import ForeignLog, Mapped, Stream

MOTOR_ORDER = (2, 0, 1, 3)
"""Motor at rear left, rear right, front right, front left in Quad X (1 rear right, 2 front right,
3 rear left, 4 front left); the rear left one turns counter-clockwise unless the yaw motors are
reversed (propellers out)."""
DEGREE = np.pi / 180.0
DSHOT = (48.0, 2047.0)
PULSE_US = (1000.0, 2000.0)
MOST_VOLTS = 100.0
"""A larger battery value is in hundredths of a volt."""
ONE_G = 9.80665


@dataclass(frozen=True)
class _Table:
    """Columns by bare name, the unit that stands behind it, and the explorer's header."""

    source: str
    columns: dict[str, FloatArray]
    units: dict[str, str]
    header: dict[str, str]

    def triple(self, name: str) -> FloatArray | None:
        """(n, 3) of `name[0]`, `name[1]`, `name[2]`; None where one is missing."""
        names = [f'{name}[{i}]' for i in range(3)]
        if any(one not in self.columns for one in names):
            return None
        return np.column_stack([self.columns[one] for one in names])


def read(path: Path) -> ForeignLog:
    """Read the table; raises BadInputError naming file, line and column."""
    table = _read(path)
    time_s, keep = _time(table)
    mapped: list[Mapped] = []
    rate = 1.0 / float(np.median(np.diff(time_s)))

    def stream(values: FloatArray) -> Stream:
        return Stream(time_s, values[keep])

    gyro = table.triple('gyroADC')
    if gyro is None:
        raise BadInputError(str(path), 'lacks the columns gyroADC[0..2]',
                            remedy='log the gyro (blackbox_disable_gyro = OFF)')
    unit = table.units.get('gyroADC[0]', '')
    factor = 1.0 if unit == 'rad/s' else DEGREE
    mapped.append(Mapped('gyroADC[0..2]', unit or 'deg/s', '/imu/data angular_velocity',
                         f'times {factor:.6g}; the frame is ours', rate))
    control, how = _control(table)
    mapped.append(Mapped('motor[0..3]', 'raw', '/control/wrench', how, rate))
    setpoint = table.triple('setpoint')
    if setpoint is not None:
        mapped.append(Mapped('setpoint[0..2]', 'deg/s', '/setpoint/rates',
                             f'times {DEGREE:.6g}', rate))
    acceleration, by = _acceleration(table)
    if acceleration is not None:
        mapped.append(Mapped('accSmooth[0..2]', 'raw', '/imu/data linear_acceleration', by, rate))
    angles = _angles(table, mapped, rate)
    volts = _volts(table, mapped, rate)
    return ForeignLog(
        source=str(path), kind='Betaflight', rates=stream(gyro * factor),
        control=stream(control), mapped=tuple(mapped),
        rate_setpoint=None if setpoint is None else stream(setpoint * DEGREE),
        acceleration=None if acceleration is None else stream(acceleration),
        angles=None if angles is None else stream(angles),
        battery=None if volts is None else stream(volts[:, None]),
        missing=_missing(angles, volts),
    )


def _read(path: Path) -> _Table:
    try:
        with path.open('rb') as probe:
            packed = probe.read(2) == b'\x1f\x8b'
        with (gzip.open if packed else open)(path, 'rt', encoding='utf-8-sig') as stream:
            return _parse(list(csv.reader(stream)), str(path))
    except UnicodeDecodeError as error:
        raise BadInputError(str(path), 'is no text file') from error
    except (OSError, EOFError) as error:
        raise BadInputError(str(path), f'cannot be read ({error})') from error


def _parse(rows: Sequence[Sequence[str]], source: str) -> _Table:
    start = next(i for i, row in enumerate(rows) if row and row[0].strip() == 'loopIteration')
    header = {row[0]: row[1] for row in rows[:start] if len(row) == 2}
    names, units = [], {}
    for cell in rows[start]:
        name, _, unit = cell.strip().partition(' (')
        names.append(name)
        units[name] = unit.rstrip(')')
    wanted = {
        i: name for i, name in enumerate(names)
        if name.partition('[')[0] in {
            'time', 'gyroADC', 'motor', 'setpoint', 'accSmooth', 'vbatLatest', 'attitude', 'roll',
            'pitch', 'heading',
        }
    }
    body = [row for row in rows[start + 1:] if len(row) == len(names)]
    if not body:
        raise BadInputError(source, 'has a header but no rows')
    columns = {name: _numbers(body, i, f'{source}, column {name}') for i, name in wanted.items()}
    return _Table(source, columns, units, header)


def _numbers(rows: Sequence[Sequence[str]], column: int, where: str) -> FloatArray:
    try:
        return np.array([float(row[column] or 'nan') for row in rows])
    except ValueError as error:
        raise BadInputError(where, 'needs numbers', str(error)) from error


def _time(table: _Table) -> tuple[FloatArray, np.ndarray]:
    """Time in s of the rows that go on in time, and which those are."""
    if 'time' not in table.columns:
        raise BadInputError(table.source, 'lacks the column time')
    factor = 1.0 if table.units.get('time') == 's' else 1e-6
    time_s = table.columns['time'] * factor
    keep = np.concatenate(([True], np.diff(np.maximum.accumulate(time_s)) > 0))
    if keep.sum() < 3:
        raise BadInputError(f'{table.source}, column time', 'does not increase')
    return time_s[keep] - time_s[0] + 1.0, keep


def _control(table: _Table) -> tuple[FloatArray, str]:
    names = [f'motor[{i}]' for i in range(4)]
    if any(name not in table.columns for name in names) or 'motor[4]' in table.columns:
        raise BadInputError(table.source, 'needs the columns motor[0..3] of a quadrotor')
    raw = np.column_stack([table.columns[name] for name in names])
    low, high, why = _motor_range(table, raw)
    motors = np.clip((raw - low) / (high - low), 0.0, 1.0)
    reversed_yaw = table.header.get('yaw_motors_reversed', '0').strip() == '1'
    control = control_at_places(motors[:, list(MOTOR_ORDER)], clockwise_rear_left=reversed_yaw)
    turn = 'propellers out' if reversed_yaw else 'propellers in'
    return control, (
        f'(motor - {low:g}) / {high - low:g} ({why}); motors 3, 1, 2, 4 stand rear left, rear '
        f"right, front right, front left; U by the mixer's inverse, yaw for {turn}"
    )


def _motor_range(table: _Table, raw: FloatArray) -> tuple[float, float, str]:
    parts = table.header.get('motorOutput', '').split(',')
    if len(parts) == 2:
        return float(parts[0]), float(parts[1]), 'motorOutput of the header'
    if np.nanmin(raw) < PULSE_US[0] - 1.0 or np.nanmax(raw) > PULSE_US[1] + 1.0:
        return *DSHOT, 'DShot, told by the values'
    return *PULSE_US, 'pulses of 1000 to 2000 µs, told by the values'


def _acceleration(table: _Table) -> tuple[FloatArray | None, str]:
    raw = table.triple('accSmooth')
    if raw is None:
        return None, ''
    unit = table.units.get('accSmooth[0]', '')
    if unit in ('m/s2', 'm/s/s'):
        return raw, 'as it is'
    if unit == 'g':
        return raw * ONE_G, f'times {ONE_G}'
    counts = float(table.header.get('acc_1G', '2048') or 2048)
    return raw * (ONE_G / counts), f'{counts:g} counts are {ONE_G} m/s²'


def _angles(table: _Table, mapped: list[Mapped], rate: float) -> FloatArray | None:
    """Roll, pitch, yaw, rad: as blackbox_decode simulates or Betaflight logs them."""
    columns = table.columns
    if all(name in columns for name in ('roll', 'pitch', 'heading')):
        factor = DEGREE if _in_degrees(table) else 1.0
        raw = np.column_stack([columns['roll'], columns['pitch'], -columns['heading']]) * factor
        source, unit = 'roll, pitch, heading', 'deg' if factor != 1.0 else 'rad'
    else:
        logged = table.triple('attitude')
        if logged is None:
            return None
        raw = logged * (0.1 * DEGREE) * np.array([1.0, 1.0, -1.0])
        source, unit = 'attitude[0..2]', '0.1 deg'
    mapped.append(Mapped(source, unit, '/imu/data orientation',
                         'to rad; heading clockwise from north to yaw from east', rate))
    raw[:, 2] = np.unwrap(raw[:, 2] + 0.5 * np.pi)
    return np.asarray(raw)


def _in_degrees(table: _Table) -> bool:
    unit = table.units.get('roll', '')
    return unit == 'deg' or (not unit and bool(np.nanmax(np.abs(table.columns['roll'])) > np.pi))


def _volts(table: _Table, mapped: list[Mapped], rate: float) -> FloatArray | None:
    raw = table.columns.get('vbatLatest')
    if raw is None or not np.isfinite(raw).any():
        return None
    factor = 1.0
    unit = table.units.get('vbatLatest', '')
    if unit == 'mV':
        factor = 1e-3
    elif unit != 'V' and float(np.nanmedian(raw)) > MOST_VOLTS:
        factor = 0.01
    mapped.append(Mapped('vbatLatest', unit or 'raw', '/battery', f'times {factor:g}', rate))
    return raw * factor


def _missing(angles: FloatArray | None, volts: FloatArray | None) -> tuple[str, ...]:
    lacks = (
        (angles, 'angles (blackbox_decode --simulate-imu gives them): no effects of the angle'),
        (volts, 'vbatLatest: battery sag cannot be told'),
    )
    return (
        *(text for found, text in lacks if found is None),
        ("attitude set-point and gains of our form: Betaflight's loop has feed-forward and gains "
        'that follow the throttle; no closed loop, no gain design'),
        ('segments: the log names none; the first 60 % trains, the rest validates, or --train A:B '
        '--validate C:D'),
    )
