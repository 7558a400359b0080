"""Files → columns: CSV, Crazyflie SD card, messages of ROS 1 and other bags.

The meaning of a column is not known here. Errors in a text name the line.
"""

from __future__ import annotations

import csv
import gzip
import math
import struct
from codecs import getincrementaldecoder
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from quad_sysid.bags import read_bag
from quad_sysid.bags.orientation import euler_from_quaternion
from quad_sysid.bags.stored.records import MAGIC
from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.files import read_by_library, readable
from quad_sysid.imports.clock import draw, unroll
from quad_sysid.imports.log import Stream
from quad_sysid.imports.units import Unit

HEAD = 65536
"""Number of bytes by which a format is recognised."""
DELIMITERS = (',', ';', '\t')
MOST_NUMBERS = 64
"""Longest array in a message that becomes columns; a longer one is an image or a cloud."""
SD_MAGIC = 0xBC
SD_REGULAR = 'fixedFrequency'
"""Event of a Crazyflie's log with variables sampled at a fixed rate."""
SD_TYPES = frozenset('BbHhIiQqefd?')


@dataclass(frozen=True)
class Table:
    """Columns by name, as in the file; NaN where a row has no number."""

    source: str
    columns: Mapping[str, FloatArray]
    times: Mapping[str, FloatArray] = field(default_factory=dict)
    """Times, s, of columns with their own (messages); a CSV has a column for it."""
    lines: tuple[int, ...] = ()
    """Line number of each row of a text, counted from 1."""
    header: Mapping[str, Any] = field(default_factory=dict)
    """The log's parameters, as it names them."""
    told: tuple[str, ...] = ()
    """What was repaired, or could not be read."""

    @property
    def messages(self) -> str:
        """Names of the messages with columns, for an error."""
        return ', '.join(sorted({name.partition('.')[0] for name in self.columns}))

    def on_clock(self, name: str, unit: Unit) -> Table:
        """The other columns at the times in the column `name`.

        Raises BadInputError where the time does not advance.
        """
        others = {n: values for n, values in self.columns.items() if n != name}
        found = unroll(unit(self.columns[name]), np.column_stack(list(others.values())),
                       f'{self.source}, column {name}')
        columns = {n: values[found.rows] for n, values in others.items()}
        return replace(self, columns=columns, times=dict.fromkeys(columns, found.time_s),
                       told=(*self.told, *found.told))

    def stream(self, *names: str) -> Stream | None:
        """(n, k) where all of the columns have a number; None where one is missing or empty.

        Columns at other times than the first are interpolated at its.
        """
        if not names or any(name not in self.columns for name in names):
            return None
        alone = [self._in_order(name) for name in names]
        times = alone[0].time_s
        values = np.column_stack([_at(one, times) for one in alone])
        known = np.isfinite(values).all(axis=1)
        return Stream(times[known], values[known]) if known.sum() > 1 else None

    def _in_order(self, name: str) -> Stream:
        times = self.times[name]
        order = np.argsort(times, kind='stable')
        order = order[np.diff(times[order], prepend=-np.inf) > 0.0]
        return Stream(times[order], self.columns[name][order][:, None])

    def complain(self, row: int, column: str, what: str, remedy: str) -> BadInputError:
        """An error that names file, line and column."""
        line = f', line {self.lines[row]}' if self.lines else ''
        return BadInputError(
            f'{self.source}{line}, column {column}', what,
            f'{self.columns[column][row]:.10g}', remedy,
        )


def _at(one: Stream, times: FloatArray) -> FloatArray:
    """(n, 1) at these times, interpolated where they are not its own; NaN in gaps."""
    if np.array_equal(one.time_s, times):
        return one.values
    known = np.isfinite(one.values[:, 0])
    one = Stream(one.time_s[known], one.values[known])
    return draw(one, times, 3.0 / (one.rate_hz or np.inf))


def open_table(path: Path, wanted: Sequence[str] | None = None) -> Table:
    """Read a file as columns: `wanted`, or (None) all that contain a number.

    Raises BadInputError for a file that cannot be read, a missing column, and a text where a
    number should be.
    """
    head = head_of(path)
    if head[:1] == bytes([SD_MAGIC]):
        table = sd_card(path.read_bytes(), str(path))
    elif head.startswith(b'#ROSBAG') or path.is_dir():
        table = _messages(path, wanted)
    elif head.startswith(MAGIC):
        raise BadInputError(str(path), 'is a file of a bag', remedy='give the folder it lies in')
    elif head.lstrip()[:1] in (b'{', b'['):
        raise BadInputError(str(path), 'is JSON, not a table', remedy='give a CSV file')
    else:
        with text_lines(path) as lines:
            return read_csv(lines, str(path), wanted)
    if wanted is None:
        return replace(table, columns={name: values for name, values in table.columns.items()
                                       if np.isfinite(values).any()})
    absent = [name for name in wanted if name not in table.columns]
    if absent:
        raise _absent(str(path), absent, list(table.columns))
    return table


def is_ours(path: Path) -> bool:
    """Whether it is a bag that can be identified as it is."""
    try:
        read_bag(path)
    except BadInputError:
        return False
    return True


def _absent(source: str, absent: Sequence[str], known: Sequence[str]) -> BadInputError:
    return BadInputError(source, f'no column {", ".join(absent)}', ', '.join(known),
                         'name a column of the file')


def head_of(path: Path) -> bytes:
    """The first bytes of a file, unpacked; none of a folder. Raises BadInputError."""
    if path.is_dir():
        return b''
    with _readable(path), _opener(path)(path, 'rb') as stream:
        return bytes(stream.read(HEAD))


@contextmanager
def text_lines(file: Path) -> Iterator[Iterator[str]]:
    """Lines of a text file in UTF-8 or Latin-1, gzipped or not.

    Raises BadInputError for another file.
    """
    head = head_of(file)
    try:
        getincrementaldecoder('utf-8')().decode(head)
        encoding = 'utf-8-sig'
    except UnicodeDecodeError:
        encoding = 'ascii' if b'\0' in head else 'latin-1'
    with _readable(file), _opener(file)(file, 'rt', encoding=encoding) as stream:
        yield iter(stream)


def _opener(file: Path) -> Callable[..., Any]:
    with file.open('rb') as probe:
        return gzip.open if probe.read(2) == b'\x1f\x8b' else open


@contextmanager
def _readable(file: Path) -> Iterator[None]:
    """Say in one line why a file cannot be read as text."""
    try:
        with readable(file):
            yield
    except (UnicodeDecodeError, csv.Error) as error:
        raise BadInputError(
            str(file), 'is neither a text file nor a log of PX4, ArduPilot or Betaflight',
            remedy='copy it anew, or give a CSV file, plain or gzipped'
        ) from error


def read_csv(
    lines: Iterable[str], source: str, wanted: Sequence[str] | None = None, first: int = 1
) -> Table:
    """Columns of a text with a header line; `#` starts a comment line, an empty cell is missing.

    Cells are separated by commas, tabs, semicolons (numbers may then have decimal commas) or
    spaces. A last line without its end was cut off and is left out. `first` is the number of the
    first line.

    Raises BadInputError for a missing column, text where a number should be, and a column without
    any number.
    """
    text = _Lines(lines, first)
    numbered = iter(text)
    head = next(numbered, None)
    if head is None:
        raise BadInputError(source, 'is empty', remedy='give a CSV file with a header line')
    split = _splitter(head[1])
    names, places = _header(split(head[1]), f'{source}, line {head[0]}', wanted)
    rows: list[list[float]] = []
    kept: list[int] = []
    whole = 0
    for number, line in numbered:
        cells = split(line)
        whole += _as_wide(cells, len(places))
        if wanted is None:
            rows.append([_maybe_number(cells, place) for place in places])
        else:
            rows.append(_numbers(cells, places, names, source, number))
        kept.append(number)
    if not rows:
        raise BadInputError(source, 'has a header but no rows', remedy='give recorded data')
    array = np.array(rows)
    if wanted is None:
        _check_table(array, whole, source)
    columns = {name: array[:, i].copy() for i, name in enumerate(names)}
    for name in wanted or ():
        if not np.isfinite(columns[name]).any():
            raise BadInputError(f'{source}, line {kept[0]}, column {name}', 'holds no number')
    return Table(source, {n: c for n, c in columns.items() if np.isfinite(c).any()},
                 lines=tuple(kept), told=text.told)


def _as_wide(cells: Sequence[str], width: int) -> bool:
    """Whether a row has one cell for each of the header's; an empty one may end it."""
    return len(cells) == width or (len(cells) == width + 1 and not cells[-1].strip())


def _check_table(rows: FloatArray, whole: int, source: str) -> None:
    """Raise BadInputError for a text that is no table: few rows (n, k) are as wide as its header.

    `whole` of them are; a row without any number is none of a recording either.
    """
    n = len(rows)
    numbers = int(np.isfinite(rows).any(axis=1).sum())
    if 2 * whole <= n:
        raise BadInputError(source, "is not a table: most lines have not the header's columns",
                            f'{whole} of {n} lines with {rows.shape[1]}', 'give a CSV file')
    if 2 * numbers <= n:
        raise BadInputError(source, 'is not a table of numbers: most lines hold none',
                            f'{numbers} of {n} lines with a number', 'give a CSV file')


@dataclass
class _Lines:
    """Lines with their numbers, without comments and without a last one that was cut off."""

    lines: Iterable[str]
    first: int
    told: tuple[str, ...] = ()

    def __iter__(self) -> Iterator[tuple[int, str]]:
        for number, line in enumerate(self.lines, self.first):
            if not line.endswith('\n'):
                said = 'has no end: it may be cut off and is left out'
                self.told = (f'line {number}, the last, {said}',)
            elif line.strip() and not line.startswith('#'):
                yield number, line


def _header(
    cells: Sequence[str], where: str, wanted: Sequence[str] | None
) -> tuple[Sequence[str], list[int]]:
    """The columns to be read, and their places in a row."""
    header = [name.strip() for name in cells]
    if not any(math.isnan(_maybe_number(header, place)) for place in range(len(header))):
        raise BadInputError(where, "holds numbers, not the columns' names",
                            remedy='put a header line before it')
    names = header if wanted is None else wanted
    absent = [name for name in names if name not in header]
    if absent:
        raise _absent(where, absent, header)
    twice = [name for name in dict.fromkeys(names) if header.count(name) > 1]
    if twice and wanted is not None:
        raise BadInputError(where, f'several columns {", ".join(twice)}',
                            remedy='give each column a name of its own')
    return names, [header.index(name) for name in names]


def _splitter(head: str) -> Callable[[str], list[str]]:
    """What separates the cells of a line, by the header."""
    delimiter = max(DELIMITERS, key=head.count)
    if delimiter not in head:
        return str.split

    def split(line: str) -> list[str]:
        cells = next(csv.reader([line], delimiter=delimiter))
        return [cell.replace(',', '.') for cell in cells] if delimiter == ';' else cells

    return split


def _maybe_number(cells: Sequence[str], place: int) -> float:
    try:
        return float(cells[place])
    except (ValueError, IndexError):
        return math.nan


def _numbers(
    cells: Sequence[str], places: Sequence[int], wanted: Sequence[str], source: str, number: int
) -> list[float]:
    """Numbers at `places` of one row; NaN for an empty cell."""
    out = []
    for place, name in zip(places, wanted, strict=True):
        text = cells[place].strip() if place < len(cells) else ''
        try:
            value = float(text or 'nan')
        except ValueError as error:
            raise BadInputError(
                f'{source}, line {number}, column {name}', 'needs a number or nothing',
                repr(text), 'mend the row, or leave it out (a gap is allowed)',
            ) from error
        out.append(value if math.isfinite(value) else math.nan)
    return out


def sd_card(data: bytes, source: str) -> Table:
    """A log of the Crazyflie's SD-card deck, versions 1 and 2 (crazyflie-firmware, usddeck).

    Raises BadInputError for a damaged file or another version. A wrong checksum is accepted, since
    a log that was cut off has one.
    """
    version = int.from_bytes(data[1:3], 'little')
    if version not in (1, 2):
        raise BadInputError(source, 'is an SD-card log of an unknown version', version,
                            "convert it to CSV with the Crazyflie's own tool and import that")
    try:
        events, at = _sd_events(data, source)
    except (struct.error, IndexError, ValueError, UnicodeDecodeError) as error:
        raise BadInputError(source, 'is not a whole log of a Crazyflie SD card',
                            remedy='copy it anew from the card') from error
    stamp = struct.Struct('<HI' if version == 1 else '<HQ')
    tick = 1e-3 if version == 1 else 1e-6
    rows: dict[int, list[tuple[Any, ...]]] = {number: [] for number in events}
    while at + stamp.size <= len(data) - 4:
        number, ticks = stamp.unpack_from(data, at)
        at += stamp.size
        if number not in events or at + events[number][1].size > len(data):
            break
        rows[number].append((ticks * tick, *events[number][1].unpack_from(data, at)))
        at += events[number][1].size
    columns: dict[str, FloatArray] = {}
    times: dict[str, FloatArray] = {}
    for number, (names, _) in events.items():
        if len(rows[number]) > 1:
            values = np.array(rows[number], dtype=float)
            columns |= {name: values[:, i].copy() for i, name in enumerate(names, 1)}
            times |= dict.fromkeys(names, values[:, 0].copy())
    if not columns:
        raise BadInputError(source, 'holds no samples',
                            remedy='check that it was copied whole, else record again')
    return Table(source, columns, times)


def _sd_events(
    data: bytes, source: str
) -> tuple[dict[int, tuple[list[str], struct.Struct]], int]:
    """Names and binary layout of each event by its number, and the offset of the samples."""
    (kinds,) = struct.unpack_from('<H', data, 3)
    at = 5
    events: dict[int, tuple[list[str], struct.Struct]] = {}
    for _ in range(kinds):
        (number,) = struct.unpack_from('<H', data, at)
        event, at = _text(data, at + 2)
        (count,) = struct.unpack_from('<H', data, at)
        at += 2
        names, form = [], '<'
        for _ in range(count):
            name, at = _text(data, at)
            names.append(name[:-3] if event == SD_REGULAR else f'{event}.{name[:-3]}')
            form += name[-2]
        if not set(form[1:]) <= SD_TYPES:
            raise BadInputError(source, 'contains an unknown data type', form)
        events[number] = (names, struct.Struct(form))
    return events, at


def _text(data: bytes, at: int) -> tuple[str, int]:
    end = data.index(b'\0', at)
    return data[at:end].decode(), end + 1


def _messages(path: Path, wanted: Sequence[str] | None) -> Table:
    """Every number of every message: `/topic.field.x`, quaternions as roll, pitch, yaw as well."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    rows: dict[str, list[dict[str, float]]] = {}
    stamps: dict[str, list[float]] = {}
    with (read_by_library(path, 'is not a whole bag', 'mend it, such as with rosbag reindex'),
          AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader):
        asked = [
            c for c in reader.connections
            if wanted is None or any(name.startswith(f'{c.topic}.') for name in wanted)
        ]
        for connection, received, raw in reader.messages(connections=asked):
            message: Any = reader.deserialize(raw, connection.msgtype)
            header = getattr(message, 'header', None)
            stamp = 0.0 if header is None else header.stamp.sec + 1e-9 * header.stamp.nanosec
            stamps.setdefault(connection.topic, []).append(stamp or 1e-9 * received)
            rows.setdefault(connection.topic, []).append(
                dict(_leaves(message, connection.topic))
            )
    columns: dict[str, FloatArray] = {}
    times: dict[str, FloatArray] = {}
    for topic, items in rows.items():
        names = list(items[0])
        found = {n: np.array([item.get(n, math.nan) for item in items]) for n in names}
        for name in names:
            stem = name.removesuffix('.w')
            parts = [f'{stem}.{p}' for p in 'xyzw']
            if name.endswith('.w') and all(p in found for p in parts):
                euler = euler_from_quaternion(np.column_stack([found[p] for p in parts]))
                found |= {f'{stem}.{a}': euler[:, i]
                          for i, a in enumerate(('roll', 'pitch', 'yaw'))}
        columns |= found
        times |= dict.fromkeys(found, np.array(stamps[topic]))
    return Table(str(path), columns, times)


def _leaves(message: Any, name: str) -> Iterator[tuple[str, float]]:
    """Numbers of a message with their names."""
    if isinstance(message, bool | int | float | np.number):
        yield name, float(message)
    elif isinstance(message, np.ndarray | list | tuple):
        if len(message) <= MOST_NUMBERS:
            for i, value in enumerate(message):
                yield from _leaves(value, f'{name}[{i}]')
    elif hasattr(message, '__dataclass_fields__'):
        for key in message.__dataclass_fields__:
            if key not in ('header', '__msgtype__'):
                yield from _leaves(getattr(message, key), f'{name}.{key}')
