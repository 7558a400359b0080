"""ArduPilot's dataflash logs → columns: binary (.bin), or the text that ground stations make.

A binary log is read message by message wherever whole ones stand, so that a burst of garbage costs
only what it overwrote. Source of the format: ArduPilot's FMT message, by which a log describes
itself. The meaning of the messages is ardupilot.py's.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from quad_sysid.contract import FloatArray
from quad_sysid.imports.clock import PAUSE_S
from quad_sysid.imports.table import Change

MAGIC = b'\xa3\x95'
FMT, FMT_LENGTH = 128, 89
FORMATS: Mapping[str, tuple[str, float]] = {
    'b': ('i1', 1.0), 'B': ('u1', 1.0), 'h': ('<i2', 1.0), 'H': ('<u2', 1.0), 'i': ('<i4', 1.0),
    'I': ('<u4', 1.0), 'f': ('<f4', 1.0), 'd': ('<f8', 1.0), 'g': ('<f2', 1.0), 'q': ('<i8', 1.0),
    'Q': ('<u8', 1.0), 'c': ('<i2', 0.01), 'C': ('<u2', 0.01), 'e': ('<i4', 0.01),
    'E': ('<u4', 0.01), 'L': ('<i4', 1e-7), 'M': ('u1', 1.0), 'n': ('S4', 0.0), 'N': ('S16', 0.0),
    'Z': ('S64', 0.0), 'a': ('V64', 0.0),
}
"""By the letter of a field's format: its type, and the factor of its numbers (0: no number)."""
TIMES = {'TimeUS': 1e-6, 'TimeMS': 1e-3}
"""Fields with the time, s of each unit; before 2015 it was in ms."""
BLOCK = 1 << 24
"""Bytes that are searched for messages at once."""
LARGEST = 1e6
"""Largest number in a message that is believed although no message begins right behind it."""
NEAR_S = 10.0
"""Largest difference of such a message's time from its neighbours'."""
RESTART_S, ENOUGH = 1.0, 20
"""The clock has begun anew where so many messages of a kind are so much earlier than as many of
them before; fewer are wrong stamps."""
TEXT_FMT = re.compile(r'^\s*FMT, ?(\d+), ?(\d+), ?(\w+), ?(\w+), ?(.*?)\s*$')
"""A line of a text log that describes a message."""

Columns = dict[str, FloatArray]


@dataclass(frozen=True)
class Kind:
    """A message as its FMT describes it."""

    number: int
    length: int
    """Bytes of a message, with its header of three."""
    name: str
    dtype: np.dtype[np.void]
    factors: tuple[float, ...]


@dataclass
class Log:
    """The wanted messages of a log: columns `KIND.field`, their times in s, parameters."""

    columns: Columns = field(default_factory=dict)
    times: Columns = field(default_factory=dict)
    parameters: dict[str, float] = field(default_factory=dict)
    """As they were at the end."""
    changed: list[Change] = field(default_factory=list)
    """Parameters that were set again, to another value."""
    initial: dict[str, float] = field(default_factory=dict)
    """As those that changed were before."""
    skipped: int = 0
    """Bytes in which no whole message stands."""
    bursts: int = 0
    """Places at which bytes were skipped."""
    restarts: int = 0
    """How often the clock begins anew: another flight, after a reboot, in the same file."""
    in_ms: bool = False
    """Whether the times are those of a log before 2015."""

    def set(self, name: str, value: float, time_s: float) -> None:
        """Take a parameter's value; each begins with what is logged first."""
        before = self.parameters.get(name, value)
        if before != value:
            self.initial.setdefault(name, before)
            self.changed.append(Change(time_s, name, value))
        self.parameters[name] = value


def read_binary(data: NDArray[np.uint8], names: Collection[str]) -> Log:
    """The messages of these names, and the parameters, of a log's bytes."""
    kinds = _kinds(data)
    starts, numbers, skipped, bursts = _whole(data, kinds)
    log = Log(skipped=skipped, bursts=bursts)
    messages = {}
    for number, kind in kinds.items():
        if _is_used(kind.name, kind.dtype.names or (), names):
            offsets = starts[numbers == number]
            if len(offsets):
                messages[kind.name] = offsets, _unpacked(data, offsets, kind)
    clock = _clock({name: rows for name, (_, rows) in messages.items()})
    log.in_ms = clock == 'TimeMS'
    stamps = {name: TIMES[clock] * rows[clock].astype(float)
              for name, (_, rows) in messages.items() if clock in (rows.dtype.names or ())}
    stamps, log.restarts = _in_turn({name: messages[name][0] for name in stamps}, stamps)
    stamped = [(messages[name][0], times) for name, times in stamps.items()]
    places = np.concatenate([offsets for offsets, _ in stamped]) if stamped else np.zeros(0)
    order = np.argsort(places, kind='stable')
    stamps_s = np.concatenate([times for _, times in stamped])[order] if stamped else np.zeros(0)
    for name, (offsets, rows) in messages.items():
        times = stamps.get(name)
        if times is None:  # before 2015 events had none: that of the message before
            index = np.searchsorted(places[order], offsets) - 1
            times = stamps_s[np.maximum(index, 0)] if stamps_s.size else np.zeros(len(offsets))
        if name == 'PARM':
            _set(log, rows, times)
            continue
        kind = next(k for k in kinds.values() if k.name == name)
        for label, factor in zip(rows.dtype.names or (), kind.factors, strict=True):
            if factor:
                log.columns[f'{name}.{label}'] = factor * rows[label].astype(float)
                log.times[f'{name}.{label}'] = times
    return log


def _in_turn(
    places: Mapping[str, NDArray[np.int64]], times: Mapping[str, FloatArray]
) -> tuple[Columns, int]:
    """Times of all messages, each flight after a restart behind the one before; how many restarts.

    `places` and `times` by kind: where in the file each message stands, and its own time, s.
    """
    ends = restarts(places, times)
    if not ends:
        return dict(times), 0
    flight = {name: np.searchsorted(ends, at, side='left') for name, at in places.items()}
    out, end_s = {name: np.array(own) for name, own in times.items()}, 0.0
    for k in range(len(ends) + 1):
        some = [own[flight[name] == k] for name, own in times.items()]
        own_s = np.concatenate([part[_near(part)] for part in some])
        shift_s = end_s + PAUSE_S - float(own_s.min(initial=np.inf)) if k else 0.0
        for name, moved in out.items():
            moved[flight[name] == k] += shift_s
        end_s = float(own_s.max(initial=-np.inf)) + shift_s
    return out, len(ends)


def _near(times: FloatArray) -> NDArray[np.intp]:
    """Which of a kind's times, s, are not far from those about them, as wrong stamps are."""
    from scipy.ndimage import median_filter  # slow to import, and few logs need it

    rows = np.flatnonzero(np.isfinite(times))
    away = times[rows] - median_filter(times[rows], 2 * ENOUGH + 1)
    return np.asarray(rows[np.abs(away) < NEAR_S], dtype=np.intp)


def restarts(
    places: Mapping[str, NDArray[np.int64]], times: Mapping[str, FloatArray]
) -> list[int]:
    """Where the last message before each restart of the clock stands; a kind says it roughly."""
    spans = []
    for name, stamps in times.items():
        if not np.any(np.diff(stamps) < -RESTART_S):
            continue
        rows = _near(stamps)
        own, at = stamps[rows], places[name][rows]
        for i in np.flatnonzero(np.diff(own) < -RESTART_S) + 1:
            before, after = own[max(i - ENOUGH, 0) : i], own[i : i + ENOUGH]
            if min(len(before), len(after)) == ENOUGH and (
                    np.median(after) < np.median(before) - RESTART_S):
                spans.append((int(at[i - 1]), int(at[i])))
    out: list[tuple[int, int]] = []
    for last, first in sorted(spans, key=lambda span: span[1]):
        if out and last < out[-1][1]:  # the same one
            out[-1] = max(out[-1][0], last), out[-1][1]
        else:
            out.append((last, first))
    return [last for last, _ in out]


def _set(log: Log, rows: NDArray[np.void], times: NDArray[np.float64]) -> None:
    """Take parameters, unless a damaged description of their messages lacks a field."""
    if {'Name', 'Value'} <= {*(rows.dtype.names or ())}:
        for parameter, value, time_s in zip(rows['Name'], rows['Value'], times, strict=True):
            log.set(parameter.decode('latin-1'), float(value), float(time_s))


def _clock(messages: Mapping[str, NDArray[np.void]]) -> str:
    fields = {name for rows in messages.values() for name in rows.dtype.names or ()}
    return next((clock for clock in TIMES if clock in fields), 'TimeUS')


def _kinds(data: NDArray[np.uint8]) -> dict[int, Kind]:
    """Every message that a whole FMT describes, by its number."""
    out = {}
    for offset in _headers(data, {FMT}):
        if offset + FMT_LENGTH > len(data):
            continue
        raw = data[offset : offset + FMT_LENGTH].tobytes()
        number, length = raw[3], raw[4]
        name, form, labels = (raw[a:b].rstrip(b'\0') for a, b in ((5, 9), (9, 25), (25, 89)))
        try:
            kind = _kind(number, length, name.decode('ascii'), form.decode('ascii'),
                         labels.decode('ascii').split(','))
        except (UnicodeDecodeError, KeyError, ValueError):
            continue
        if kind.length == 3 + kind.dtype.itemsize:
            out[number] = kind
    return out


def _kind(number: int, length: int, name: str, form: str, labels: Sequence[str]) -> Kind:
    labels = [label.strip() or f'field{i}' for i, label in enumerate(labels)]
    labels += [f'field{i}' for i in range(len(labels), len(form))]
    fields = [(label, FORMATS[letter][0])
              for label, letter in zip(labels, form, strict=False)]
    return Kind(number, length, name, np.dtype(fields), tuple(FORMATS[c][1] for c in form))


def _headers(data: NDArray[np.uint8], numbers: Collection[int]) -> NDArray[np.int64]:
    """Offsets at which a message of these numbers may begin."""
    is_kind = np.zeros(256, dtype=bool)
    is_kind[list(numbers)] = True
    out = []
    for low in range(0, len(data), BLOCK):
        part = data[low : low + BLOCK + 2]
        hit = (part[:-2] == MAGIC[0]) & (part[1:-1] == MAGIC[1]) & is_kind[part[2:]]
        out.append(np.flatnonzero(hit) + low)
    return np.concatenate(out) if out else np.zeros(0, dtype=np.int64)


def _whole(
    data: NDArray[np.uint8], kinds: Mapping[int, Kind]
) -> tuple[NDArray[np.int64], NDArray[np.uint8], int, int]:
    """Offset and number of each whole message, bytes that belong to none, and in how many places.

    A message is whole where another begins right behind it. The last one before a burst is kept
    too, if it holds no other's beginning and nothing that cannot be.
    """
    lengths = np.zeros(256, dtype=np.int64)
    for number, kind in kinds.items():
        lengths[number] = kind.length
    begins = _headers(data, range(256))  # also of messages whose description is lost
    offsets = begins[lengths[data[begins + 2]] > 0]
    end = offsets + lengths[data[offsets + 2]]
    inside = end <= len(data)
    offsets, end = offsets[inside], end[inside]
    is_whole = np.isin(end, begins) | (end == len(data))
    valid: list[NDArray[np.int64]] = []
    runs = np.flatnonzero(np.diff(is_whole.astype(np.int8), prepend=0, append=0))
    behind = 0
    for a, b in runs.reshape(-1, 2):  # all of these are followed by a message
        starts = offsets[a:b]
        if (starts[1:] < end[a : b - 1]).any() or starts[0] < behind:
            starts = _not_nested(starts, end[a:b], behind)
        if len(starts):
            valid.append(starts)
            behind = int(starts[-1] + lengths[data[starts[-1] + 2]])
    valid_starts = np.concatenate(valid) if valid else np.zeros(0, dtype=np.int64)
    more = [i for i in np.flatnonzero(~is_whole)
            if _plausible(data, int(offsets[i]), offsets, valid_starts, kinds)]
    valid_starts = np.sort(np.concatenate([valid_starts, offsets[more]]).astype(np.int64))
    numbers = data[valid_starts + 2]
    ends = valid_starts + lengths[numbers]
    gaps = np.diff(np.r_[0, np.column_stack([valid_starts, ends]).ravel(), len(data)])[::2]
    return valid_starts, numbers, int(gaps.sum()), int(np.count_nonzero(gaps))


def _not_nested(
    starts: NDArray[np.int64], ends: NDArray[np.int64], behind: int
) -> NDArray[np.int64]:
    """Those that do not begin inside an earlier one."""
    out = []
    for start, end in zip(starts.tolist(), ends.tolist(), strict=True):
        if start >= behind:
            out.append(start)
            behind = end
    return np.array(out, dtype=np.int64)


def _plausible(
    data: NDArray[np.uint8], start: int, offsets: NDArray[np.int64], valid: NDArray[np.int64],
    kinds: Mapping[int, Kind],
) -> bool:
    """Whether a message that no other follows can be believed."""
    kind = kinds[int(data[start + 2])]
    stop = start + kind.length
    if np.searchsorted(offsets, stop) - np.searchsorted(offsets, start) > 1:
        return False
    place = int(np.searchsorted(valid, start))
    if place and valid[place - 1] + kinds[int(data[valid[place - 1] + 2])].length > start:
        return False
    row = _unpacked(data, np.array([start]), kind)[0]
    numbers = [float(row[name]) for name, factor in
               zip(kind.dtype.names or (), kind.factors, strict=True)
               if factor and kind.dtype[name].kind == 'f']
    clock = next((name for name in TIMES if name in (kind.dtype.names or ())), None)
    same = valid[max(0, place - 50) : place + 50]
    same = same[data[same + 2] == kind.number]
    if clock is None or not len(same) or not all(abs(x) < LARGEST for x in numbers):
        return False
    near = _unpacked(data, same, kind)[clock].astype(float)
    return bool(np.min(np.abs(near - float(row[clock]))) * TIMES[clock] < NEAR_S)


def _unpacked(data: NDArray[np.uint8], starts: NDArray[np.int64], kind: Kind) -> NDArray[np.void]:
    """(m,) the messages that begin at these offsets."""
    size = kind.dtype.itemsize
    out = np.empty((len(starts), size), dtype=np.uint8)
    for low in range(0, len(starts), 1 << 16):
        part = starts[low : low + (1 << 16)]
        out[low : low + len(part)] = data[part[:, None] + 3 + np.arange(size)]
    return out.reshape(-1).view(kind.dtype)


def read_text(lines: Iterable[str], kinds: Collection[str]) -> Log:
    """Read a text log: lines of names and numbers, described by its FMT lines."""
    log, labels = Log(), {}
    rows: dict[str, list[list[float]]] = {}
    clocks: dict[str, list[float]] = {}
    places: dict[str, list[int]] = {}
    parameters: list[tuple[str, float]] = []
    now = 0.0
    for number, line in enumerate(lines):
        definition = TEXT_FMT.match(line)
        if definition:
            labels[definition[3]] = [label.strip() for label in definition[5].split(',')]
            continue
        name, _, values = line.partition(',')
        name = name.strip()
        if name not in labels or not _is_used(name, labels[name], kinds):
            continue
        cells = [cell.strip() for cell in values.split(',')]
        names = labels[name]
        if len(cells) < len(names):
            log.skipped += len(line)
            log.bursts += 1
            continue
        clock = next((c for c in TIMES if c in names), None)
        numbers = [_number(cell) for cell in cells[: len(names)]]
        if clock is not None:
            now = TIMES[clock] * numbers[names.index(clock)]
            log.in_ms |= clock == 'TimeMS'
        if name == 'PARM':
            row = dict(zip(names, cells, strict=False))
            parameters.append((row.get('Name', ''), _number(row.get('Value', ''))))
        else:
            rows.setdefault(name, []).append(numbers)
        clocks.setdefault(name, []).append(now)
        places.setdefault(name, []).append(number)
    stamps, log.restarts = _in_turn(
        {name: np.array(some) for name, some in places.items()},
        {name: np.array(some) for name, some in clocks.items()})
    for (parameter, value), time_s in zip(parameters, stamps.get('PARM', ()), strict=True):
        log.set(parameter, value, float(time_s))
    for name, some in rows.items():
        columns = {f'{name}.{label}': values.copy() for label, values in zip(
            labels[name], np.array(some).T, strict=False) if np.isfinite(values).any()}
        log.columns |= columns
        log.times |= dict.fromkeys(columns, stamps[name])
    return log


def _is_used(name: str, labels: Sequence[str], kinds: Collection[str]) -> bool:
    """Whether a message is read; a GPS before 2015 has the time of the week for its own."""
    return name == 'PARM' or (name in kinds and not (name == 'GPS' and 'TimeMS' in labels))


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return np.nan


def is_text(head: bytes) -> bool:
    """Whether the first bytes of a text describe messages of ArduPilot."""
    text = head[:4096].decode('latin-1')
    return any(TEXT_FMT.match(line) for line in text.splitlines())


def is_binary(head: bytes) -> bool:
    """Whether the first bytes hold a message that describes messages."""
    return 0 <= head.find(MAGIC + bytes([FMT])) < 4096
