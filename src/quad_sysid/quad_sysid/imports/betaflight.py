"""A blackbox log → ForeignLog: Betaflight, INAV, Rotorflight, INDIflight, encoded or as a table.

A table is what blackbox_decode or the Blackbox Explorer writes; an encoded file (.bbl, .bfl, .txt)
is read by orangebox (GPL-3, an optional extra, loaded here alone). Betaflight's body frame is
ours: x forward, y left, z up; nose down is positive pitch. INDIflight's sensors had that frame at
first, later forward, right, down; its quaternions always have the latter.
"""

from __future__ import annotations

import csv
import logging
import re
import struct
from array import array
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime, timezone
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import bilinear, lfilter

from quad_sysid.bags.reader import PLAUSIBLE_PACK_V
from quad_sysid.contract import AXES, FloatArray
from quad_sysid.craft import BETAFLIGHT, Craft, of_betaflight
from quad_sysid.errors import BadInputError
from quad_sysid.files import read_by_library
from quad_sysid.imports.betaflight_gains import (
    PIDSUM,
    Adjustment,
    changes,
    number,
    numbers,
    tuning,
)
from quad_sysid.imports.clock import Stream
from quad_sysid.imports.experiments import apart
from quad_sysid.imports.log import DEGREE, RPM, Experiment, ForeignLog, Mapped, Reading, Signal
from quad_sysid.imports.mixers import MIRROR, ned_angles
from quad_sysid.imports.table import Table, head_of, read_csv, text_lines
from quad_sysid.imports.units import header_unit, unit_of
from quad_sysid.motion import GRAVITY

POLES = 14.0
"""Magnets of a motor where the header does not say them (motor_poles)."""
PULSE_US = (1000.0, 2000.0)
"""Pulses of no and of full throttle, µs."""
IN_THE_AIR = 0.25  # of the throttle stick: below it an aircraft stands or falls
MIN_ROWS = 200
"""Least number of frames of a flight."""
UNIT_AS_INTEGER = 8127.0
"""INDIflight's 1.0 of a command or a quaternion, (127 << 6) - 1."""
FIELDS = frozenset({
    'time', 'gyroADC', 'motor', 'setpoint', 'axisRate', 'accSmooth', 'vbatLatest', 'vbat',
    'attitude', 'roll', 'pitch', 'heading', 'u', 'quat', 'gyroSp', 'debug', 'eRPM', 'erpm',
    'gyroUnfilt', 'axisD', 'rcCommand',
})
FILTERS = (
    'gyro_lpf1_static_hz', 'gyro_lpf2_static_hz', 'gyro_lowpass_hz', 'gyro_lowpass2_hz',
    'gyro_lpf_hz', 'dterm_lpf1_static_hz', 'dterm_lowpass_hz', 'dterm_lpf_hz',
    'rpm_filter_harmonics', 'rollPID', 'pitchPID', 'yawPID', 'feedforward_weight', 'ff_weight',
    'tpa_rate',
)
"""Header fields of gains and filters that the bag's notes keep."""
ENCODED = re.compile(rb'^H Product:Blackbox', re.MULTILINE)
"""How an encoded log begins; a board may have written other things before it."""
INTRA = 'I'
"""Type of a frame that holds whole values, not differences."""
PHASE = 5000.0
"""Betaflight's debug[0] per radian of the chirp's phase, in debug mode CHIRP."""
CHIRP_HZ, SMOOTH_S = 1.0, 0.1
"""Below this frequency the chirp's size falls with it; over so much time the phase is followed."""
FINE = 10.0
"""Factor of rates, set-points and sticks with blackbox_high_resolution (4.4 and later)."""
FINE_STICK = 2500.0
"""Throttle stick, µs, above which they are so: blackbox_decode leaves the header out."""
BITS = 1_000_000
"""A larger gyro_scale is the bits of a float."""
FASTER = 'set blackbox_sample_rate (before 4.3 blackbox_p_ratio) to log 500 Hz or more'
NO_GAINS = (
    "the controller's gains in a header of Betaflight or INAV: no closed loop, no gain design "
    '(blackbox_decode --simulate-imu adds angles)'
)
AS_FLOAT = 0x80
"""Bit of an adjustment's number that a float follows."""


def read(path: Path, log: int = 1) -> ForeignLog:
    """Read a table, or one log (counted from 1) of an encoded file.

    Raises BadInputError naming file, line and column.
    """
    encoded = ENCODED.search(head_of(path)) is not None
    table, units, adjusted = _decoded(path, log) if encoded else (*_read(path), [])
    for name in ('time', *_several('gyroADC', 3)):
        if name not in table.columns:
            raise BadInputError(table.source, f'lacks the column {name}', remedy=(
                'decode the log again with blackbox_decode' if name == 'time' else
                'log the gyro (blackbox_disable_gyro = OFF)'))
    clock_unit = unit_of('time', 's' if units.get('time') == 's' else 'us', 'time')
    first_us = float(table.columns['time'][0])
    table = table.on_clock('time', clock_unit)
    first_s = float(table.times['gyroADC[0]'][0])
    indi = 'indiflight' in ' '.join(map(str, table.header.values())).lower() or \
        'u[0]' in table.columns
    signals = _signals(table, units, indi=indi)
    motors, crafts = _motors(table, indi=indi)
    reading = Reading(table)
    reading.take(*signals, motors, *_speeds(table, units, len(motors.columns)))
    filters = ', '.join(f'{name} {table.header[name]}' for name in FILTERS if name in table.header)
    reading.mapped += [Mapped('header', '-', 'note', filters)] if filters else []
    header = {str(name): str(value) for name, value in table.header.items()}
    throttle, span = _usual_throttle(table), _span_us(table)
    begin_s = first_s - 1e-6 * first_us  # of the clock of the changes
    adjusted = [replace(change, time_s=change.time_s + begin_s) for change in adjusted]
    gains = tuning(header, throttle, span)
    reading.mapped += [Mapped('header.rollPID, …', '-', '/gains/active', gains.how)] * bool(
        gains.gains)
    return reading.log('a blackbox log', signals, crafts=crafts, faster=FASTER, gains=gains.gains,
                       loop_s=_loop_s(header),
                       utc_s=_utc_s(header, first_s),
                       gain_changes=changes(header, adjusted, throttle, span),
                       no_gains=NO_GAINS, experiments=tuple(_chirps(reading)))


def _loop_s(header: Mapping[str, str]) -> float | None:
    """The controller's cycle, s; None where the header does not state it."""
    try:
        us = float(header['looptime']) * float(header.get('pid_process_denom', 1))
    except (KeyError, ValueError):
        return None
    return 1e-6 * us if us > 0.0 else None


def _utc_s(header: Mapping[str, str], first_s: float) -> float | None:
    """Time 0 in UTC, s, by the header's start at `first_s`; None where the board had no clock."""
    try:
        start = datetime.fromisoformat(header.get('Log start datetime', ''))
        if start.tzinfo is None:
            start = start.replace(tzinfo=timezone.utc)
        return start.timestamp() - first_s
    except (ValueError, OverflowError, OSError):
        return None


def _usual_throttle(table: Table) -> float | None:
    """Median of the throttle stick above a quarter, 0..1; None where it is not logged."""
    stick = table.columns.get('rcCommand[3]')
    if stick is None:
        return None
    stick = stick / FINE if _is_fine(table) else stick
    share = (stick - PULSE_US[0]) / (PULSE_US[1] - PULSE_US[0])
    in_flight = share[(share > IN_THE_AIR) & (share <= 1.0)]
    return float(np.median(in_flight)) if in_flight.size else None


def _is_fine(table: Table) -> bool:
    """Whether rates, set-points and sticks are in tenths."""
    stick = table.columns.get('rcCommand[3]')
    return number(table.header, 'blackbox_high_resolution') == 1.0 or (
        stick is not None and float(np.nanmedian(stick)) > FINE_STICK)


def _span_us(table: Table) -> float:
    """The motors' range by the header, µs."""
    low, high, *_ = *numbers(table.header, 'motorOutput'), 0.0, 0.0
    return high - low if 0.0 < high - low <= PIDSUM else PIDSUM


def _chirps(reading: Reading) -> Iterator[Experiment]:
    """The chirps of Betaflight's mode CHIRP, which its debug mode of that name logs.

    The log holds the chirp's phase, and not its axis: the one whose rate follows it.
    """
    table = reading.table
    phase, rates = table.stream('debug[0]'), reading.streams.get('rates')
    fields = {name.lower(): str(value) for name, value in table.header.items()}
    if phase is None or rates is None or not (
            any(name.startswith('chirp_amplitude') for name in fields) and _is_phase(phase)):
        return
    on = np.flatnonzero(phase.values[:, 0] > 0.0)
    for rows in apart(on, phase.time_s):
        if rows.size < MIN_ROWS:
            continue
        times, angle = phase.time_s[rows], phase.values[rows, 0] / PHASE
        wave = np.column_stack([np.sin(angle), np.cos(angle)])
        followed = []
        for i in range(len(AXES)):
            rate = np.interp(times, rates.time_s, rates.values[:, i])
            residual = rate - rate.mean() - wave @ np.linalg.lstsq(wave, rate - rate.mean(),
                                                                   rcond=None)[0]
            followed.append(1.0 - float(residual @ residual) / max(float(np.sum(
                (rate - rate.mean()) ** 2)), 1e-12))
        axis = AXES[int(np.argmax(followed))]
        size = DEGREE * number(fields, f'chirp_amplitude_{axis}')
        if size > 0.0:
            added = size * _shaped(times, angle, fields)
            yield Experiment(axis, 'chirp', 'rate', Stream(times, added[:, None]))


def _shaped(times: FloatArray, angle: FloatArray, fields: Mapping[str, str]) -> FloatArray:
    """(n,) a chirp of amplitude 1 as the controller adds it to the set-point, by its phase, rad.

    The cosine, smaller below CHIRP_HZ, behind a lead-lag of first order (chirp.c, pid_init.c).
    """
    dt = float(np.median(np.diff(times)))
    near = max(round(SMOOTH_S / dt), 1)
    unwrapped = np.unwrap(angle)
    rows = np.arange(unwrapped.size)
    ahead, behind = np.minimum(rows + near, unwrapped.size - 1), np.maximum(rows - near, 0)
    hertz = (unwrapped[ahead] - unwrapped[behind]) / (times[ahead] - times[behind]) / (2.0 * np.pi)
    hertz = np.maximum.accumulate(np.abs(hertz))  # it rises, also where the log is too slow for it
    wave = np.cos(angle) * np.minimum(hertz / CHIRP_HZ, 1.0)
    lag, lead = (number(fields, f'chirp_{name}_freq_hz') for name in ('lag', 'lead'))
    if lag > 0.0 and lead > 0.0:
        s = 1.0 / (2.0 * np.pi)
        wave = lfilter(*bilinear([s / lead, 1.0], [s / lag, 1.0], 1.0 / dt), wave)
    return np.asarray(wave)


def _is_phase(phase: Stream) -> bool:
    values = phase.values[:, 0]
    return bool(values.min() >= 0.0 and values.max() <= 2.0 * np.pi * PHASE + 1.0
                and values.max() > np.pi * PHASE)


def _several(name: str, count: int) -> tuple[str, ...]:
    return tuple(f'{name}[{i}]' for i in range(count))


def _signals(table: Table, units: dict[str, str], *, indi: bool) -> tuple[Signal, ...]:
    """The channels of a log besides the motors, by its header's units and scales."""
    columns, gyro = table.columns, units.get('gyroADC[0]', '')
    # whether the sensors' z axis points down, by the specific force in flight
    is_frd = indi and bool(np.nanmean(columns.get('accSmooth[2]', np.zeros(1))) <= 0.0)
    frame = MIRROR if is_frd else np.ones(3)
    scale = _rate_unit(table, gyro)
    how = f'times {scale:.6g}; ' + ('pitch and yaw turned' if is_frd else 'the frame is ours')

    def volts(values: FloatArray) -> FloatArray:
        too_high = float(np.median(values)) > PLAUSIBLE_PACK_V[1]
        hundredths = units.get('vbatLatest') != 'V' and too_high
        return values * (1e-3 if units.get('vbatLatest') == 'mV' else
                         0.01 if hundredths else 1.0)

    largest = np.nanmax(np.abs(columns.get('roll', np.zeros(1))))
    degrees = units.get('roll') == 'deg' or (not units.get('roll') and largest > np.pi)
    out = [
        Signal('rates', _several('gyroADC', 3), gyro or 'deg/s', how, lambda v: v * scale * frame),
        *(Signal('rate_setpoint', _several(name, 3), 'deg/s', how, lambda v: v * scale * frame)
          for name in ('setpoint', 'axisRate', 'gyroSp')),
        Signal('angles', _several('quat', 4), 'raw', 'FRD in NED to FLU in ENU',
               lambda v: ned_angles(v / UNIT_AS_INTEGER)),
        _angles(('roll', 'pitch', 'heading'), *(('deg', DEGREE) if degrees else ('rad', 1.0))),
        _angles(_several('attitude', 3), '0.1 deg', 0.1 * DEGREE),
        Signal('rates_before', _several('gyroUnfilt', 3), gyro or 'deg/s',
               f'times {scale:.6g}, before the filters', lambda v: v * scale * frame),
        *(Signal('d_term', _several('axisD', count), 'raw', 'times 0.001, the D part',
                 lambda v: v / PIDSUM) for count in (3, 2)),
        *(Signal('battery', (name,), units.get(name) or 'raw', 'to V', volts)
          for name in ('vbatLatest', 'vbat')),
    ]
    unit = units.get('accSmooth[0]', '')
    own = numbers(table.header, 'acc_1G') or [2048.0]  # 0: a board without an accelerometer
    counts = {'m/s2': GRAVITY, 'm/s/s': GRAVITY, 'g': 1.0}.get(unit) or own[0]
    if counts > 0.0:
        out.append(Signal('acceleration', _several('accSmooth', 3), unit or 'raw',
                          f'{counts:g} are {GRAVITY} m/s²',
                          lambda v: v * (GRAVITY / counts) * frame))
    return tuple(out)


def _decoded(path: Path, log: int) -> tuple[Table, dict[str, str], list[Adjustment]]:
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
        what = f'must be 1 to {count}' if count > 1 else 'the file holds one log'
        raise BadInputError(f'{path}: --log', what, log, '' if count > 1 else 'leave it out')
    with read_by_library(path, f'log {log} of {count} cannot be decoded', remedy):
        parser: Any = Parser.load(str(path), log, allow_invalid_header=True)
        names = list(parser.field_names)
        places = [i for i, name in enumerate(names) if name.partition('[')[0] in FIELDS]
        with _events() as events:
            rows, faults = _frames(parser, places, len(names), events)
    if len(rows) < MIN_ROWS:
        what = 'holds no frames' if not len(rows) else 'holds too few frames'
        raise BadInputError(
            str(path), f'log {log} of {count} {what}', None if not len(rows) else len(rows),
            f'choose another of {count} with --log' if count > 1 else
            f'damaged in {faults} places, or in its header: copy it again' if faults else
            'was it armed, and the medium not full?')
    header = {str(k): _plain(v) for k, v in parser.headers.items()}
    columns = {names[i]: rows[:, k].copy() for k, i in enumerate(places)}
    notes = tuple(
        [f'damaged in {faults} places: what cannot be read there is left out'] * bool(faults)
        + [f'log {log} of {count} in the file: --log reads another'] * (count > 1))
    times = columns.get('time', np.zeros(len(rows)))
    adjusted = [Adjustment(1e-6 * float(times[min(row, len(times) - 1)]), function, value)
                for row, function, value in events.changes]
    return (Table(f'{path}, log {log} of {count}', columns, header=header, notes=notes), {},
            adjusted)


class _Events:
    """Adjustments in flight, which orangebox skips: (row, number, value) each."""

    def __init__(self) -> None:
        self.rows = 0
        self.changes: list[tuple[int, int, float]] = []

    def __call__(self, reader: Iterator[int]) -> None:
        """Read one: its number, then a float or a number with a sign in the last bit."""
        function = next(reader)
        if function & AS_FLOAT:
            value = struct.unpack('<f', bytes(next(reader) for _ in range(4)))[0]
        else:
            bits, more = 0x7F, 0x80  # of a byte: its part of the number, and that more follow
            raw = shift = 0
            while True:
                byte = next(reader)
                raw |= (byte & bits) << shift
                shift += 7
                if not byte & more or shift > 28:
                    break
            value = float((raw >> 1) ^ -(raw & 1))
        self.changes.append((self.rows, function & ~AS_FLOAT, float(value)))


@contextmanager
def _events() -> Iterator[_Events]:
    """Let orangebox hand over adjustments while a log is read."""
    from orangebox.events import event_map
    from orangebox.types import EventType

    events, kind = _Events(), EventType.INFLIGHT_ADJUSTMENT
    previous = event_map[kind]
    event_map[kind] = events
    try:
        yield events
    finally:
        event_map[kind] = previous


def _frames(parser: Any, places: Sequence[int], width: int,
            events: _Events) -> tuple[FloatArray, int]:
    """(n, k) the wanted fields, and the number of damaged places.

    Behind one, frames count from the next that does not build on those before.
    """
    values, faults, waiting, place, invalid = array('d'), 0, False, -1, 0
    while parser.reader.tell() > place:  # behind a fault it reads on where it stands
        place = parser.reader.tell()
        try:
            for frame in parser.frames():
                before, invalid = invalid, parser._ctx.invalid_frame_count  # noqa: SLF001
                if invalid > before:  # it skipped bytes
                    faults, waiting = faults + 1, True
                waiting &= frame.type.value != INTRA
                data = frame.data
                if len(data) >= width - 1 and not waiting:
                    events.rows += 1
                    values.extend(
                        _number(data[i]) if i < len(data) else np.nan for i in places)
            break
        except StopIteration:
            break
        except (RuntimeError, IndexError, TypeError, ValueError) as error:
            if isinstance(error.__cause__, StopIteration):  # the end of the file
                break
            faults, waiting = faults + 1, True
    return np.frombuffer(values, dtype=np.float64).reshape(-1, max(len(places), 1)), faults


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else np.nan


def _plain(value: object) -> str:
    return ','.join(map(str, value)) if isinstance(value, list | tuple) else str(value)


def _rate_unit(table: Table, unit: str) -> float:
    """rad/s per unit of gyroADC: degrees, tenths of them, or counts times the header's scale."""
    if unit == 'rad/s':
        return 1.0
    if _is_fine(table) and not unit:
        return DEGREE / FINE
    scale = table.header.get('gyro_scale', '').strip()
    try:
        bits = int(scale, 0)
        value = float(np.uint32(bits).view(np.float32)) if BITS < bits < 2**32 else float(bits)
    except ValueError:
        value = number(table.header, 'gyro_scale')
    return DEGREE * (value if 1e-3 < value < 1.0 else 1.0)


def _read(path: Path) -> tuple[Table, dict[str, str]]:
    """The wanted columns of a text, named without their units, and the units."""
    header: dict[str, str] = {}
    with text_lines(path) as lines:
        rows = ((n, line, next(csv.reader([line]))) for n, line in enumerate(lines, 1))
        for number, line, row in rows:
            cells = [cell.strip() for cell in row]
            if cells[:1] == ['loopIteration']:
                bare = {cell: cell.partition(' (')[0] for cell in cells}
                bare = {cell: name for cell, name in bare.items()
                        if name.partition('[')[0] in FIELDS}
                read = read_csv(chain([line], lines), str(path), list(bare), number)
                break
            if len(cells) == 2:
                header[cells[0]] = cells[1]
    units = {name: header_unit(cell) or '' for cell, name in bare.items()}
    columns = {bare[cell]: values for cell, values in read.columns.items()}
    return Table(str(path), columns, header=header, notes=read.notes), units


def _speeds(table: Table, units: dict[str, str], count: int) -> list[Signal]:
    """Rotor speeds: electrical turns in hundreds a minute, a pole pair for each of the rotor."""
    poles = number(table.header, 'motor_poles') or POLES
    factor, how = 100.0 * RPM / (0.5 * poles), f'of {poles:g} poles, to rad/s'
    if units.get('eRPM[0]') == 'rpm':
        factor, how = RPM, 'to rad/s'
    return [Signal('speeds', _several(name, count), units.get(f'{name}[0]') or '100 eRPM', how,
                   lambda values: values * factor) for name in ('eRPM', 'erpm')]


def _motors(table: Table, *, indi: bool) -> tuple[Signal, tuple[Craft, ...]]:
    """Motor commands (n, k) 0..1, and the crafts that the header leaves open."""
    name = 'u' if 'u[0]' in table.columns else 'motor'
    slots = [slot for slot in _several(name, 8) if slot in table.columns]
    used = [slot for slot in slots if name == 'motor' or np.nanmax(table.columns[slot]) > 0.0]
    count = len(used)
    columns = _several(name, count)
    if count < 2 or not set(columns) <= set(slots):
        raise BadInputError(table.source, 'needs the columns motor[0], motor[1], …')
    if name == 'u':
        low, high, why = 0.0, UNIT_AS_INTEGER, 'the largest number'
    else:
        low, high, why = _motor_range(table, np.array([table.columns[name] for name in columns]))
    crafts = () if indi else _crafts(table, count)
    how = f'({name} - {low:g}) / {high - low:g} ({why}); in the places of ' + (
        crafts[0].name if len(crafts) == 1 else 'what the motion shows' if not crafts else
        f"Betaflight's {count} motors that the motion fits best (the header does not say)")
    return Signal('motors', columns, 'raw', how,
                  lambda v: np.clip((v - low) / (high - low), 0.0, 1.0)), crafts


def _crafts(table: Table, count: int) -> tuple[Craft, ...]:
    """The crafts of as many motors that the header leaves open.

    It names the sense of the propellers, which recent versions leave out, and no mixer: four
    motors are taken for a Quad X.
    """
    reversed_yaw = table.header.get('yaw_motors_reversed', '').strip()
    mixers = [m for m, motors in BETAFLIGHT.items() if len(motors) == count]
    mixers = ['QUADX'] if count == 4 else mixers
    crafts = (of_betaflight({'mixer': mixer, 'yaw_motors_reversed': out})
              for mixer in mixers for out in ((reversed_yaw,) if reversed_yaw else ('0', '1')))
    return tuple(craft for craft in crafts if isinstance(craft, Craft))


def _motor_range(table: Table, raw: FloatArray) -> tuple[float, float, str]:
    parts = numbers(table.header, 'motorOutput')
    if len(parts) == 2 and parts[1] > parts[0]:
        return parts[0], parts[1], 'motorOutput of the header'
    if 'maxthrottle' in table.header:
        return *PULSE_US, 'pulses of 1000 to 2000 µs, as maxthrottle of the header'
    if np.nanmin(raw) < PULSE_US[0] - 1.0 or np.nanmax(raw) > PULSE_US[1] + 1.0:
        return 48.0, 2047.0, 'DShot, judging by the values'
    return *PULSE_US, 'pulses of 1000 to 2000 µs, judging by the values'


def _angles(columns: tuple[str, ...], unit: str, factor: float) -> Signal:
    """Roll, pitch and the heading, as blackbox_decode simulates or Betaflight logs them."""

    def convert(values: FloatArray) -> FloatArray:
        raw = values * [1.0, 1.0, -1.0] * factor
        raw[:, 2] = np.unwrap(raw[:, 2] + 0.5 * np.pi)
        return np.asarray(raw)

    return Signal('angles', columns, unit,
                  'to rad; heading clockwise from north to yaw from east', convert)
