"""Files → columns: a text (CSV), a Crazyflie's SD card, a MATLAB file, messages of a bag.

The meaning of a column is not known here; quaternions become angles as well.
"""

from __future__ import annotations

import bz2
import csv
import gzip
import lzma
import re
import shutil
import tempfile
from codecs import getincrementaldecoder
from collections import Counter
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
from quad_sysid.imports.clock import Stream, draw, unroll
from quad_sysid.imports.crazyflie_sd import SD_MAGIC, sd_card
from quad_sysid.imports.delimited import no_column, read_text_table
from quad_sysid.imports.rosbag import MAX_NUMBERS, read_messages
from quad_sysid.imports.units import Unit

LEAST = 20
"""Least length of a vector that is a recording."""
SQLITE = b'SQLite format 3'
OPENERS: Mapping[bytes, Callable[..., Any]] = {
    b'\x1f\x8b': gzip.open, b'\xfd7zXZ\0': lzma.open, b'BZh': bz2.open,
}
"""By the first bytes of a packed file: what opens it unpacked."""
OTHERS: Mapping[bytes, tuple[str, str]] = {
    b'PK\x03\x04': ('is an archive (.zip, .xlsx, …)', 'unpack it and import what it holds'),
    b'7z\xbc\xaf': ('is an archive (.7z)', 'unpack it and import what it holds'),
    b'Rar!': ('is an archive (.rar)', 'unpack it and import what it holds'),
    b'(\xb5/\xfd': ('is packed by zstd', 'unpack it (zstd -d) and import what it holds'),
    b'\x89HDF\r\n': ('is HDF5, which is not read', 'export its columns as CSV'),
    b'MATLAB 7.3': ('is a MATLAB file of version 7.3 (HDF5)', 'save it again with -v7'),
    b'PAR1': ('is Parquet, which is not read', 'export its columns as CSV'),
    b'\x93NUMPY': ('is an array of numpy without names of columns', 'export it as CSV'),
    b'\x80\x04\x95': ('is a pickle, which is not read', 'export its columns as CSV'),
    b'%PDF': ('is a PDF', 'give the log itself'),
    b'<!DOCTYPE': ('is a web page, not a log', 'download the file itself'),
    b'<html': ('is a web page, not a log', 'download the file itself'),
    b'version https://git-lfs': ('is a pointer to a file in Git LFS', 'fetch it (git lfs pull)'),
}
"""By the first bytes of a file that is no table: what it is, and what helps."""
TLOG_S = (9e8, 4.5e9)
"""Times, s since 1970, with which telemetry begins."""
QUATERNION = re.compile(
    r'^(?P<stem>.*?)(?P<open>[\[(]?)(?P<part>[wxyz]|[0-4])(?P<close>[\])]?(?: \[[^\]]*\])?)$',
    re.IGNORECASE)
"""The parts of a quaternion by their names: w, x, y, z or four numbers, the scalar first."""
NAMED_QUATERNION = re.compile(r'(?<![a-z])(q|quaternion)(?![a-z])|quat|orientation',
                              re.IGNORECASE)
EULER = ('roll', 'pitch', 'yaw')


@dataclass(frozen=True)
class Change:
    """A parameter that was set while the log was written."""

    time_s: float
    name: str
    value: float


@dataclass(frozen=True)
class Table:
    """Columns by name, as in the file; NaN where a row has no number."""

    source: str
    columns: Mapping[str, FloatArray]
    times: Mapping[str, FloatArray] = field(default_factory=dict)
    """Times, s, of columns with their own (messages); a CSV has a column for it."""
    lines: Sequence[int] | np.ndarray = ()
    """Line number of each row of a text, counted from 1."""
    header: Mapping[str, Any] = field(default_factory=dict)
    """The log's parameters, as it names them; of those that `changed`, as they began."""
    changed: tuple[Change, ...] = ()
    notes: tuple[str, ...] = ()
    """Repairs, and parts that could not be read, in words."""
    aliases: Mapping[str, str] = field(default_factory=dict)
    """Other names of columns, by which a user may ask for them."""

    @property
    def messages(self) -> str:
        """Names of the messages with columns, and what could not be read, for an error."""
        names = ', '.join(sorted({name.partition('.')[0] for name in self.columns}))
        return '; '.join([*filter(None, [names]), *self.notes])

    def on_clock(self, name: str, unit: Unit) -> Table:
        """The other columns at the times in the column `name`.

        Raises BadInputError where the time does not advance.
        """
        remaining = {n: values for n, values in self.columns.items() if n != name}
        unrolled = unroll(unit(self.columns[name]), list(remaining.values()),
                          f'{self.source}, column {name}')
        columns = {n: values[unrolled.rows] for n, values in remaining.items()}
        return replace(self, columns=columns, times=dict.fromkeys(columns, unrolled.time_s),
                       notes=(*self.notes, *unrolled.notes))

    def at_rate(self, rate_hz: float) -> Table:
        """All columns with rows that come at this rate, Hz, from one second on."""
        n = len(next(iter(self.columns.values())))
        times = 1.0 + np.arange(n) / rate_hz
        return replace(self, times=dict.fromkeys(self.columns, times),
                       notes=(*self.notes, f'rows at {rate_hz:g} Hz, as --sample-rate says'))

    def stream(self, *names: str) -> Stream | None:
        """(n, k) where all of the columns have a number; None where one is missing or empty.

        Columns at other times than the first are interpolated at its.
        """
        if not names or any(name not in self.columns for name in names):
            return None
        alone = [self._in_order(name) for name in names]
        times = alone[0].time_s
        values = np.column_stack([_at(stream, times) for stream in alone])
        is_finite = np.isfinite(values).all(axis=1)
        if is_finite.all():
            return Stream(times, values) if len(times) > 1 else None
        return Stream(times[is_finite], values[is_finite]) if is_finite.sum() > 1 else None

    def _in_order(self, name: str) -> Stream:
        times = self.times[name]
        order = np.argsort(times, kind='stable')
        order = order[np.diff(times[order], prepend=-np.inf) > 0.0]
        return Stream(times[order], self.columns[name][order][:, None])

    def complain(self, row: int, column: str, what: str, remedy: str) -> BadInputError:
        """An error that names file, line and column."""
        line = f', line {self.lines[row]}' if len(self.lines) else ''
        return BadInputError(f'{self.source}{line}, column {column}', what,
                             f'{self.columns[column][row]:.10g}', remedy)


def _at(stream: Stream, times: FloatArray) -> FloatArray:
    """(n, 1) at these times, interpolated where they are not its own; NaN in gaps."""
    if np.array_equal(stream.time_s, times):
        return stream.values
    is_finite = np.isfinite(stream.values[:, 0])
    stream = Stream(stream.time_s[is_finite], stream.values[is_finite])
    return draw(stream, times, 3.0 / (stream.rate_hz or np.inf))


def open_table(
    path: Path, names: Sequence[str] | None = None, messages: Path | None = None
) -> Table:
    """Read the columns `names` of a file, or (None) all that contain a number.

    `messages` is a folder of .msg files, for a bag without definitions. Raises BadInputError for
    a file that cannot be read, a missing column, and a text where a number should be.
    """
    head = head_of(path)
    text = False
    if head[:1] == bytes([SD_MAGIC]):
        table = Table(str(path), *sd_card(path.read_bytes(), str(path)))
    elif is_bag(path, head):
        columns, times, notes = read_messages(path, names, messages)
        table = Table(str(path), columns, times, notes=notes)
    elif head.startswith(b'MATLAB 5'):
        columns, notes = read_mat(path)
        table = Table(str(path), columns, notes=notes)
    else:
        refuse_others(path, head)
        text = True
        derived = names is not None and any(name.endswith(EULER) for name in names)
        with text_lines(path) as lines:
            table = read_csv(lines, str(path), None if derived else names)
        if names is not None and not derived:
            return table
    table = with_angles(table)
    if names is None:
        return table if text else replace(table, columns={
            name: values for name, values in table.columns.items() if np.isfinite(values).any()})
    named = [table.aliases.get(name, name) for name in names]
    absent = [name for name, own in zip(names, named, strict=True) if own not in table.columns]
    if absent:
        raise no_column(str(path), absent, list(table.columns))
    return replace(table, columns={name: table.columns[name] for name in dict.fromkeys(named)})


def is_bag(path: Path, head: bytes) -> bool:
    """Whether a path is a bag, or a file of one."""
    return path.is_dir() or head.startswith((b'#ROSBAG', MAGIC, SQLITE))


def refuse_others(path: Path, head: bytes) -> None:
    """Raise BadInputError for a file of a known kind that is not read, with what helps."""
    for first, (what, remedy) in OTHERS.items():
        if head.startswith(first):
            raise BadInputError(str(path), what, remedy=remedy)
    if (head[:1] == b'\0' and head[8:9] in (b'\xfe', b'\xfd')
            and TLOG_S[0] < 1e-6 * int.from_bytes(head[:8], 'big') < TLOG_S[1]):
        raise BadInputError(str(path), 'is telemetry that a ground station received (.tlog)',
                            remedy="import the autopilot's own log, which has the rates at speed")
    if head[257:262] == b'ustar':
        raise BadInputError(str(path), 'is an archive (.tar)',
                            remedy='unpack it and import what it holds')
    if head.lstrip()[:1] in (b'{', b'['):
        raise BadInputError(str(path), 'is JSON, not a table', remedy='give a CSV file')


def with_angles(table: Table) -> Table:
    """The table with roll, pitch and yaw, rad, of each quaternion beside it."""
    groups: dict[tuple[str, str, str], dict[str, str]] = {}
    for name in table.columns:
        match = QUATERNION.match(name)
        if match:
            groups.setdefault((match['stem'], match['open'], match['close']), {})[
                match['part'].lower()] = name
    columns, times = dict(table.columns), dict(table.times)
    for (stem, _, _), parts in groups.items():
        numbered = [p for p in '01234' if p in parts]
        order = [*'xyzw'] if {*'xyzw'} <= parts.keys() else [
            *numbered[1:], *numbered[:1]] if numbered in ([*'0123'], [*'1234']) else []
        if not order or (numbered and not NAMED_QUATERNION.search(stem)):
            continue
        values = np.column_stack([table.columns[parts[p]] for p in order])
        is_finite = np.isfinite(values).all(axis=1)
        norm = np.linalg.norm(values[is_finite], axis=1)
        # nine in ten of the norms must be within 0.02 of 1
        if not is_finite.any() or np.mean(np.abs(norm - 1.0) < 0.02) < 0.9:
            continue
        euler = np.full((len(values), 3), np.nan)
        euler[is_finite] = euler_from_quaternion(values[is_finite])
        prefix = stem.rstrip('._ ')
        prefix = prefix if prefix.lower() not in ('', 'q', 'quat') else 'attitude'
        for i, axis in enumerate(EULER):
            columns.setdefault(f'{prefix}.{axis}', euler[:, i])
            if parts[order[0]] in times:
                times.setdefault(f'{prefix}.{axis}', times[parts[order[0]]])
    return replace(table, columns=columns, times=times)


def is_ours(path: Path) -> bool:
    """Whether it is a bag that can be identified as it is."""
    try:
        read_bag(path)
    except BadInputError:
        return False
    return True


def head_of(path: Path) -> bytes:
    """The first bytes of a file, unpacked; none of a folder. Raises BadInputError."""
    if path.is_dir():
        return b''
    with _readable(path), _opener(path)(path, 'rb') as stream:
        return bytes(stream.read(65536))


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
        first = probe.read(8)
    return next((opener for magic, opener in OPENERS.items() if first.startswith(magic)), open)


@contextmanager
def plain(path: Path) -> Iterator[Path]:
    """The file, or an unpacked copy of a packed one while it is read."""
    if path.is_dir() or (opener := _opener(path)) is open:
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / path.stem
        with _readable(path), opener(path, 'rb') as compressed, copy.open('wb') as out:
            shutil.copyfileobj(compressed, out)
        yield copy


@contextmanager
def _readable(file: Path) -> Iterator[None]:
    """Say in one line why a file cannot be read as text."""
    try:
        with readable(file):
            yield
    except (UnicodeDecodeError, csv.Error, lzma.LZMAError) as error:
        raise BadInputError(
            str(file), 'is neither a text file nor a log of PX4, ArduPilot or Betaflight',
            remedy='copy it again, or give a CSV file, plain or gzipped'
        ) from error


def read_csv(
    lines: Iterable[str], source: str, names: Sequence[str] | None = None, first: int = 1
) -> Table:
    """The table of a text, see delimited.py."""
    columns, rows, notes, aliases = read_text_table(lines, source, names, first)
    return Table(source, columns, lines=rows, notes=notes, aliases=aliases)


def read_mat(path: Path) -> tuple[dict[str, FloatArray], tuple[str, ...]]:
    """Columns of a file up to version 7, and what was left out.

    Columns are vectors and matrices of one length. A structure's fields are named
    `structure.field`. Version 7.3 is HDF5, which is another format. Raises BadInputError.
    """
    with read_by_library(path, 'cannot be read as a MATLAB file', 'save it again with -v7'):
        from scipy.io import loadmat

        content = loadmat(str(path), squeeze_me=True, struct_as_record=False)
    vectors: dict[str, FloatArray] = {}
    for name, value in content.items():
        if not name.startswith('__'):
            vectors |= dict(_vectors(name, value))
    sizes = Counter(len(values) for values in vectors.values() if len(values) >= LEAST)
    if not sizes:
        raise BadInputError(str(path), 'holds no vectors of numbers', ', '.join(
            name for name in content if not name.startswith('__')) or 'nothing',
            'save the columns as vectors of one length')
    length, _ = max(sizes.items(), key=lambda item: (item[1], item[0]))
    columns = {name: values for name, values in vectors.items() if len(values) == length}
    shorter = [name for name, values in vectors.items()
               if LEAST <= len(values) != length]
    notes = (f'{len(shorter)} vectors of another length than {length} left out: '
             + ', '.join(shorter[:5]),) if shorter else ()
    return columns, notes


def _vectors(name: str, value: Any) -> Iterator[tuple[str, FloatArray]]:
    if hasattr(value, '_fieldnames'):
        for key in vars(value)['_fieldnames']:
            yield from _vectors(f'{name}.{key}', getattr(value, key))
        return
    if not isinstance(value, np.ndarray):
        return
    if value.dtype == object:
        for i, cell in enumerate(value.ravel()[:MAX_NUMBERS]):
            yield from _vectors(f'{name}[{i}]', cell)
        return
    if value.dtype.kind not in 'biuf':
        return
    array = np.asarray(value, dtype=np.float64)
    array[~np.isfinite(array)] = np.nan
    if array.ndim == 1 and len(array) >= LEAST:
        yield name, array
    elif array.ndim > 1 and max(array.shape) >= LEAST:
        long = int(np.argmax(array.shape))
        flat = np.moveaxis(array, long, 0).reshape(array.shape[long], -1)
        if flat.shape[1] <= MAX_NUMBERS:
            yield from ((f'{name}[{i}]', flat[:, i].copy()) for i in range(flat.shape[1]))
