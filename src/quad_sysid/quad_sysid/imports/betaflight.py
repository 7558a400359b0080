"""A blackbox log → ForeignLog: Betaflight, INAV, Rotorflight, INDIflight, encoded or as a table.

A table is what blackbox_decode or the Blackbox Explorer writes; an encoded file (.bbl, .bfl, .txt)
is read by orangebox (GPL-3, an optional extra, loaded here alone). Betaflight's body frame is
ours: x forward, y left, z up; nose down is positive pitch. INDIflight's sensors had that frame at
first, later forward, right, down; its quaternions always have the latter.
"""

from __future__ import annotations

import csv
import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.files import read_by_library
from quad_sysid.imports.clock import unroll
from quad_sysid.imports.frames import MIRROR, mixer_at_places, ned_angles
from quad_sysid.imports.log import ForeignLog, Mapped, Stream
from quad_sysid.imports.mixers import Mixer
from quad_sysid.imports.table import read_csv, text_lines

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
FEWEST = 200
"""Least number of frames of a flight."""
UNIT_AS_INTEGER = 8127.0
"""INDIflight's 1.0 of a command or a quaternion, (127 << 6) - 1."""
WANTED = frozenset({
    'time', 'gyroADC', 'motor', 'setpoint', 'axisRate', 'accSmooth', 'vbatLatest', 'vbat',
    'attitude', 'roll', 'pitch', 'heading', 'u', 'quat', 'gyroSp',
})
FILTERS = (
    'gyro_lpf1_static_hz', 'gyro_lpf2_static_hz', 'gyro_lowpass_hz', 'gyro_lowpass2_hz',
    'gyro_lpf_hz', 'dterm_lpf1_static_hz', 'dterm_lowpass_hz', 'dterm_lpf_hz',
    'rpm_filter_harmonics', 'rollPID', 'pitchPID', 'yawPID', 'feedforward_weight', 'ff_weight',
    'tpa_rate',
)
"""Header fields of gains and filters that the bag's notes keep."""
FASTER = 'set blackbox_sample_rate (before 4.3 blackbox_p_ratio) to log 500 Hz or more'


@dataclass(frozen=True)
class _Table:
    """Columns by name without unit, their units, and the header."""

    source: str
    columns: dict[str, FloatArray]
    units: dict[str, str]
    header: dict[str, str]

    def several(self, name: str, count: int) -> FloatArray | None:
        """(n, count) of `name[0]`, `name[1]`, …; None where one is missing."""
        names = [f'{name}[{i}]' for i in range(count)]
        if not names or any(one not in self.columns for one in names):
            return None
        return np.column_stack([self.columns[one] for one in names])


def read(path: Path, log: int = 1) -> ForeignLog:
    """Read a table, or one log (counted from 1) of an encoded file.

    Raises BadInputError naming file, line and column.
    """
    table = _decoded(path, log) if _is_encoded(path) else _read(path)
    indi = 'indiflight' in ' '.join(table.header.values()).lower() or 'u[0]' in table.columns
    if 'time' not in table.columns:
        raise BadInputError(table.source, 'lacks the column time',
                            remedy='decode the log again with blackbox_decode')
    factor = 1.0 if table.units.get('time') == 's' else 1e-6
    unrolled = unroll(
        table.columns['time'] * factor, np.column_stack(list(table.columns.values())),
        f'{table.source}, column time',
    )
    time_s, keep = unrolled.time_s - unrolled.time_s[0] + 1.0, unrolled.rows
    mapped: list[Mapped] = []
    rate = 1.0 / float(np.median(np.diff(time_s)))
    turned = indi and _points_down(table)
    frame = MIRROR if turned else np.ones(3)
    how = 'pitch and yaw turned' if turned else 'the frame is ours'

    def stream(values: FloatArray | None) -> Stream | None:
        if values is None:
            return None
        rows = values[keep]
        known = np.isfinite(rows).all(axis=1)
        return Stream(time_s[known], rows[known]) if known.sum() > 1 else None

    gyro = table.several('gyroADC', 3)
    if gyro is None:
        raise BadInputError(str(path), 'lacks the columns gyroADC[0..2]',
                            remedy='log the gyro (blackbox_disable_gyro = OFF)')
    unit = table.units.get('gyroADC[0]', '')
    factor = _rate_unit(table, unit)
    mapped.append(Mapped('gyroADC[0..2]', unit or 'deg/s', '/imu/data angular_velocity',
                         f'times {factor:.6g}; {how}', rate))
    motors, mixer, told = _motors(table, indi=indi)
    mapped.append(Mapped(*told, rate))
    setpoint = next((found for name in ('setpoint', 'axisRate', 'gyroSp')
                     if (found := table.several(name, 3)) is not None), None)
    if setpoint is not None:
        mapped.append(Mapped('setpoint[0..2]', 'deg/s', '/setpoint/rates',
                             f'times {factor:.6g}; {how}', rate))
        setpoint = setpoint * factor * frame
    acceleration, by = _acceleration(table)
    if acceleration is not None:
        acceleration = acceleration * frame
        mapped.append(Mapped('accSmooth[0..2]', 'raw', '/imu/data linear_acceleration', by, rate))
    angles = _angles(table, mapped, rate)
    volts = _volts(table, mapped, rate)
    header = ', '.join(f'{name} {table.header[name]}' for name in FILTERS if name in table.header)
    if header:
        mapped.append(Mapped('header', '-', 'note', header))
    return ForeignLog(
        source=str(path), kind='a blackbox log', rates=stream(gyro * factor * frame),
        motors=stream(motors), mixer=mixer, mapped=tuple(mapped), clock=unrolled.told,
        rate_setpoint=stream(setpoint), acceleration=stream(acceleration), angles=stream(angles),
        battery=stream(None if volts is None else volts[:, None]), faster=FASTER,
        missing=_missing(angles, volts),
    )


def _points_down(table: _Table) -> bool:
    """Whether the sensors' z axis points down, by the specific force in flight."""
    lift = table.columns.get('accSmooth[2]', np.zeros(1))
    return bool(np.nanmean(lift) <= 0.0)


def _is_encoded(path: Path) -> bool:
    with path.open('rb') as stream:
        return stream.read(2) == b'H '


def _decoded(path: Path, log: int) -> _Table:
    """One log of an encoded file, by orangebox."""
    try:
        from orangebox import Parser
    except ImportError as error:
        raise BadInputError(
            str(path), 'is encoded, which needs the package orangebox (GPL-3)',
            remedy='pip install "orangebox<0.5", or give the CSV of blackbox_decode',
        ) from error
    logging.getLogger('orangebox').setLevel(logging.CRITICAL)
    remedy = 'decode it with blackbox_decode and import its CSV'
    with read_by_library(path, 'cannot be decoded', remedy):
        count = int(Parser.load(str(path), 1, allow_invalid_header=True).reader.log_count)
    if not 1 <= log <= count:
        raise BadInputError(f'{path}: --log', f'must be 1 to {count}', log)
    with read_by_library(path, f'log {log} of {count} cannot be decoded', remedy):
        parser: Any = Parser.load(str(path), log, allow_invalid_header=True)
        names = list(parser.field_names)
        places = [i for i, name in enumerate(names) if name.partition('[')[0] in WANTED]
        rows = _frames(parser, places, len(names))
    if len(rows) < FEWEST:
        raise BadInputError(str(path), f'log {log} of {count} holds too few frames', len(rows),
                            f'choose another of {count} with --log')
    array = np.array(rows, dtype=float)
    header = {str(k): _plain(v) for k, v in parser.headers.items()}
    return _Table(f'{path}, log {log} of {count}',
                  {names[i]: array[:, k] for k, i in enumerate(places)}, {}, header)


def _frames(parser: Any, places: Sequence[int], width: int) -> list[list[float]]:
    """Rows of the wanted fields up to a damaged frame."""
    rows: list[list[float]] = []
    try:
        for frame in parser.frames():
            data = frame.data
            if len(data) >= width - 1:
                rows.append([_number(data[i]) if i < len(data) else np.nan for i in places])
    except (StopIteration, RuntimeError, IndexError, TypeError, ValueError):
        if not rows:
            raise
    return rows


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else np.nan


def _plain(value: object) -> str:
    return ','.join(map(str, value)) if isinstance(value, list | tuple) else str(value)


def _rate_unit(table: _Table, unit: str) -> float:
    """rad/s per unit of gyroADC: degrees, tenths of them, or counts times the header's scale."""
    if unit == 'rad/s':
        return 1.0
    if table.header.get('blackbox_high_resolution', '0').strip() == '1' and not unit:
        return 0.1 * DEGREE
    scale = table.header.get('gyro_scale', '').strip()
    try:
        value = float(scale) if not scale.startswith('0x') else float(
            np.array(int(scale, 16), dtype=np.uint32).view(np.float32)
        )
    except ValueError:
        value = 1.0
    return DEGREE * (value if 1e-3 < value < 1.0 else 1.0)


def _read(path: Path) -> _Table:
    header: dict[str, str] = {}
    with text_lines(path) as lines:
        rows = ((n, line, next(csv.reader([line]))) for n, line in enumerate(lines, 1))
        for number, line, row in rows:
            cells = [cell.strip() for cell in row]
            if cells[:1] == ['loopIteration']:
                wanted = {cell: cell.partition(' (') for cell in cells if _bare(cell) in WANTED}
                read = read_csv(chain([line], lines), str(path), list(wanted), number)
                break
            if len(cells) == 2:
                header[cells[0]] = cells[1]
    return _Table(
        str(path), {wanted[cell][0]: values for cell, values in read.columns.items()},
        {name: unit.rstrip(')') for name, _, unit in wanted.values()}, header,
    )


def _bare(cell: str) -> str:
    """`gyroADC` of `gyroADC[0] (deg/s)`."""
    return cell.partition(' (')[0].partition('[')[0]


def _motors(
    table: _Table, *, indi: bool
) -> tuple[FloatArray, Mixer | None, tuple[str, str, str, str]]:
    """Motor commands (n, k) 0..1, their mixer, and its description."""
    name = 'u' if 'u[0]' in table.columns else 'motor'
    slots = [f'{name}[{i}]' for i in range(8) if f'{name}[{i}]' in table.columns]
    used = [slot for slot in slots if np.nanmax(table.columns[slot]) > 0.0]
    count = len(used if name == 'u' else slots)
    raw = table.several(name, count)
    if raw is None or count < 2:
        raise BadInputError(table.source, 'needs the columns motor[0], motor[1], …')
    if name == 'u':
        motors, how = np.clip(raw / UNIT_AS_INTEGER, 0.0, 1.0), f'over {UNIT_AS_INTEGER:g}'
    else:
        low, high, why = _motor_range(table, raw)
        motors = np.clip((raw - low) / (high - low), 0.0, 1.0)
        how = f'(motor - {low:g}) / {high - low:g} ({why})'
    if indi or count != len(MOTOR_ORDER):
        return motors, None, (f'{name}[0..{count - 1}]', 'raw', '/control/wrench',
                              f'{how}; U by what the motion shows')
    said = table.header.get('yaw_motors_reversed', '').strip()
    mixer = mixer_at_places("Betaflight's Quad X", MOTOR_ORDER, clockwise_rear_left=said == '1')
    mixer = replace(mixer, unsaid=() if said else ('yaw',))
    turn = 'propellers out' if said == '1' else 'propellers in'
    turn += '' if said else ', or as the motion shows (the header does not say)'
    return motors, mixer, (f'{name}[0..3]', 'raw', '/control/wrench', (
        f'{how}; motors 3, 1, 2, 4 stand rear left, rear right, front right, front left; U by the '
        f"mixer's inverse, yaw for {turn}"
    ))


def _motor_range(table: _Table, raw: FloatArray) -> tuple[float, float, str]:
    parts = table.header.get('motorOutput', '').split(',')
    if len(parts) == 2 and float(parts[1]) > float(parts[0]):
        return float(parts[0]), float(parts[1]), 'motorOutput of the header'
    if 'maxthrottle' in table.header:
        return *PULSE_US, 'pulses of 1000 to 2000 µs, as maxthrottle of the header'
    if np.nanmin(raw) < PULSE_US[0] - 1.0 or np.nanmax(raw) > PULSE_US[1] + 1.0:
        return *DSHOT, 'DShot, judging by the values'
    return *PULSE_US, 'pulses of 1000 to 2000 µs, judging by the values'


def _acceleration(table: _Table) -> tuple[FloatArray | None, str]:
    raw = table.several('accSmooth', 3)
    if raw is None:
        return None, ''
    unit = table.units.get('accSmooth[0]', '')
    if unit in ('m/s2', 'm/s/s'):
        return raw, 'as it is'
    if unit == 'g':
        return raw * ONE_G, f'times {ONE_G}'
    counts = float(table.header.get('acc_1G') or 2048)
    if counts <= 0.0:  # a board without an accelerometer
        return None, ''
    return raw * (ONE_G / counts), f'{counts:g} counts are {ONE_G} m/s²'


def _angles(table: _Table, mapped: list[Mapped], rate: float) -> FloatArray | None:
    """Roll, pitch, yaw, rad: as blackbox_decode simulates or Betaflight logs them."""
    columns = table.columns
    quaternion = table.several('quat', 4)
    if quaternion is not None:
        mapped.append(Mapped('quat[0..3]', 'raw', '/imu/data orientation',
                             'FRD in NED to FLU in ENU', rate))
        return ned_angles(quaternion / UNIT_AS_INTEGER)
    if all(name in columns for name in ('roll', 'pitch', 'heading')):
        factor = DEGREE if _in_degrees(table) else 1.0
        raw = np.column_stack([columns['roll'], columns['pitch'], -columns['heading']]) * factor
        source, unit = 'roll, pitch, heading', 'deg' if factor != 1.0 else 'rad'
    else:
        logged = table.several('attitude', 3)
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
    raw = table.columns.get('vbatLatest', table.columns.get('vbat'))
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
    )
