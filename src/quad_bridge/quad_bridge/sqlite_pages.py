"""The pages of a sqlite3 file without its trees: what stands in the leaves of its tables.

For a file that SQLite refuses. A row counts only where its parts fill its cell to the byte; there
are no checksums. No SQL, no files (damaged_sqlite.py).
Source: the SQLite file format (big-endian; b-tree pages, cells, serial types).
"""

from __future__ import annotations

import mmap
import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

LEAF, INDEX_LEAF = 0x0D, 0x0A
USUAL_SIZE = 4096
"""Bytes of a page that SQLite takes unless told otherwise."""
_LEAF_HEAD = 8
_HEADER = 100
"""Bytes of the file's header, at the beginning of its first page."""
_WIDTHS = (0, 1, 2, 3, 4, 6, 8, 8, 0, 0)
"""Bytes of the serial types 0 to 9: null, integers, a float (7), the constants 0 and 1."""
_MOST_COLUMNS = 100

Value = int | float | str | bytes | None
_NONSENSE = (struct.error, IndexError, ValueError)


@dataclass(frozen=True)
class Row:
    """One row of any table."""

    number: int
    """Its rowid."""
    values: tuple[Value, ...]
    place: tuple[int, int]
    """Of its page in the file, of its cell in the page."""


@dataclass
class Pages:
    """A database file, or what is left of it; `damaged` is complete once `rows` has run."""

    data: bytes | mmap.mmap
    damaged: set[int] = field(default_factory=set)
    """Places (bytes) of pages that are all zeros, or of leaves with a row that is none."""
    indexed: int = 0
    """Highest row number that an index knows; complete once `rows` has run."""

    def __post_init__(self) -> None:
        """Look at the header, as far as there is one."""
        self.page_size = page_size(self.data)
        header = bytes(self.data[:_HEADER]).ljust(_HEADER, b'\0')
        (self.told,) = struct.unpack_from('>I', header, 28)
        """How many pages the file has by its header."""
        self._usable = self.page_size - (header[20] if header[20] <= 32 else 0)

    def rows(self) -> Iterator[Row]:
        """Rows of all tables, leaf by leaf in the order of the file."""
        self.damaged |= set(self.zeros())
        for start in self._places():
            if start in self.damaged:
                continue
            head = start + (_HEADER if start == 0 else 0)
            if self.data[head] == LEAF:
                yield from self._leaf(start, head)
            elif self.data[head] == INDEX_LEAF:
                self._index(start, head)

    def zeros(self) -> list[int]:
        """Places of pages that were never written."""
        size, nothing = self.page_size, bytes(self.page_size)
        return [start for start in self._places() if self.data[start : start + size] == nothing]

    def _places(self) -> range:
        """Beginnings of the file's whole pages, without those that were never used."""
        size, stop = self.page_size, len(self.data)
        if 0 < self.told * size < stop:
            stop = self.told * size
        return range(0, stop - size + 1, size)

    def values(self, place: tuple[int, int]) -> tuple[Value, ...]:
        """The row at `place` once more; ValueError where there is none."""
        try:
            return _values(self._cell(*place)[1])
        except _NONSENSE as error:
            raise ValueError(str(error)) from error

    def _index(self, start: int, head: int) -> None:
        """Note the highest row number of an index' leaf, where most numbers follow each other."""
        numbers = []
        for pointer in self._pointers(head):
            try:
                (offset,) = struct.unpack_from('>H', self.data, pointer)
                length, place = _varint(self.data, start + offset)
                *_, number = _values(self.data[place : place + length])
            except _NONSENSE:
                continue
            if isinstance(number, int):
                numbers.append(number)
        for shift, most in Counter(n - i for i, n in enumerate(numbers)).most_common(1):
            if 2 * most > len(numbers):
                self.indexed = max(self.indexed, shift + len(numbers) - 1)

    def _pointers(self, head: int) -> range:
        """Where the places of a page's cells stand."""
        (count,) = struct.unpack_from('>H', self.data, head + 3)
        begin = head + _LEAF_HEAD
        return range(begin, begin + 2 * min(count, (self.page_size - _LEAF_HEAD) // 2), 2)

    def _leaf(self, start: int, head: int) -> Iterator[Row]:
        rows: dict[int, Row] = {}
        for i, pointer in enumerate(self._pointers(head)):
            row = self._row(start, pointer)
            if row is None:
                self.damaged.add(start)
            else:
                rows[i] = row
        # rows are only added: where most numbers follow each other, another one is damaged
        for shift, most in Counter(row.number - i for i, row in rows.items()).most_common(1):
            if 2 * most > len(rows):
                rows = {i: replace(row, number=shift + i) for i, row in rows.items()}
        yield from rows.values()

    def _row(self, page: int, pointer: int) -> Row | None:
        """The row whose cell a leaf points at; None where there is none."""
        try:
            (offset,) = struct.unpack_from('>H', self.data, pointer)
            number, payload = self._cell(page, offset)
            return Row(number, _values(payload), (page, offset))
        except _NONSENSE:
            return None

    def _cell(self, page: int, offset: int) -> tuple[int, bytes]:
        """Rowid and content of one cell."""
        if not _LEAF_HEAD < offset < self.page_size:
            raise ValueError(offset)
        length, place = _varint(self.data, page + offset)
        number, place = _varint(self.data, place)
        payload = self._payload(place, length)
        if len(payload) != length:
            raise ValueError(length)
        return number, payload

    def _payload(self, place: int, length: int) -> bytes:
        """Content of a cell, with its overflow pages."""
        usable = self._usable
        if length <= usable - 35:
            return self.data[place : place + length]
        least = (usable - 12) * 32 // 255 - 23
        local = least + (length - least) % (usable - 4)
        local = local if local <= usable - 35 else least
        out = bytearray(self.data[place : place + local])
        (following,) = struct.unpack_from('>I', self.data, place + local)
        while following and len(out) < length:
            start = (following - 1) * self.page_size
            (following,) = struct.unpack_from('>I', self.data, start)
            part = self.data[start + 4 : start + min(usable, 4 + length - len(out))]
            if not any(part):  # never written
                return b''
            out += part
        return bytes(out)


def page_size(data: bytes | mmap.mmap) -> int:
    """Bytes of a page by the file's header; the usual ones where that is damaged."""
    if len(data) < _HEADER:
        return USUAL_SIZE
    (size,) = struct.unpack_from('>H', data, 16)
    size = 65536 if size == 1 else size
    return size if size >= 512 and not size & (size - 1) else USUAL_SIZE


def _values(payload: bytes) -> tuple[Value, ...]:
    """Columns of a row; ValueError where they do not fill it."""
    head, place = _varint(payload, 0)
    kinds = []
    while place < head:
        kind, place = _varint(payload, place)
        kinds.append(kind)
    if place != head or len(kinds) > _MOST_COLUMNS:
        raise ValueError(head)
    values: list[Value] = []
    for kind in kinds:
        width = (kind - 12) // 2 if kind >= len(_WIDTHS) else _WIDTHS[kind]
        part = payload[place : place + width]
        place += width
        if kind in {10, 11} or place > len(payload):
            raise ValueError(kind)
        values.append(_value(kind, part))
    if place != len(payload):
        raise ValueError(place)
    return tuple(values)


def _value(kind: int, part: bytes) -> Value:
    """One column by its serial type."""
    if kind == 0:
        return None
    if kind == 7:
        return float(struct.unpack('>d', part)[0])
    if kind in {8, 9}:
        return kind - 8
    if kind < 8:
        return int.from_bytes(part, 'big', signed=True)
    return part.decode(errors='replace') if kind % 2 else part


def _varint(data: bytes | mmap.mmap, place: int) -> tuple[int, int]:
    """Value and the place after it."""
    value = 0
    for i in range(8):
        byte = data[place + i]
        value = value << 7 | byte & 0x7F
        if byte < 0x80:
            return value, place + i + 1
    return value << 8 | data[place + 8], place + 9
