"""Reads what is whole in a sqlite3 bag file: by SQL, and where the tree is torn page by page.

The file itself is never opened for writing. A journal that a killed recorder has left is played
back on a copy. Source: the SQLite file format (big-endian; b-tree pages, cells, serial types).
"""

from __future__ import annotations

import mmap
import os
import shutil
import sqlite3
import struct
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from quad_bridge.damaged_mcap import Message, Topic

JOURNALS = ('-journal', '-wal')
JOURNAL_STARTS = (b'\xd9', b'\x37')
"""First byte of a rollback journal that is still to be played back, and of a write-ahead log."""
LEAF = 0x0D
FIRST_BYTES = 1 << 20
"""Of a file: in them stand the topics and their types."""
_COLUMNS = 4
"""Of the table `messages`: id, topic_id, timestamp, data; no other table has as many."""
_FIRST_BLOB = 12
"""Serial type of an empty blob; even ones above are blobs, 1 to 6 integers."""
_WIDTHS = (0, 1, 2, 3, 4, 6, 8, 8, 0, 0)


@dataclass
class DamagedSqlite:
    """One file; `messages` may be run once, the notes hold afterwards."""

    path: Path
    notes: list[str] = field(default_factory=list)
    complete: bool = True

    def messages(self) -> Iterator[Message]:
        """All whole messages, in the order of writing."""
        with _still(self.path) as plain:
            played = plain != self.path
            if played:
                self.notes.append(f'{self.path.name}: its last transaction was not finished')
            last = 0
            try:
                if plain.stat().st_size % (_page_size(plain) or 1):
                    raise sqlite3.DatabaseError('its last page is torn')  # SQLite adds zeros
                with closing(_connected(plain, 'rw' if played else 'ro&immutable=1')) as base:
                    topics = _topics(base)
                    for number, topic, time_ns, data in base.execute(
                        'SELECT id, topic_id, timestamp, data FROM messages ORDER BY id'
                    ):
                        last = number
                        if topic in topics:
                            yield Message(topics[topic], time_ns, data)
            except (sqlite3.Error, UnicodeDecodeError) as error:
                self.complete = False
                self.notes.append(f'{self.path.name}: {error}: read page by page')
                yield from self._torn(plain, last)

    def _torn(self, plain: Path, last: int) -> Iterator[Message]:
        """Messages with an id above `last` without their tree."""
        if not plain.stat().st_size:
            return
        with (
            plain.open('rb') as file,
            mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data,
        ):
            try:
                topics = _first_topics(data)
            except (sqlite3.Error, UnicodeDecodeError) as error:
                self.notes.append(f'{self.path.name}: its list of topics is lost ({error})')
                return
            for topic, time_ns, content in Pages(data).rows(last):
                if topic in topics:
                    yield Message(topics[topic], time_ns, content)


def _connected(file: Path, mode: str) -> sqlite3.Connection:
    return sqlite3.connect(f'{file.resolve().as_uri()}?mode={mode}', uri=True)


def _first_topics(data: mmap.mmap) -> dict[int, Topic]:
    """The tables at the beginning of a file of which the end may be missing."""
    size = Pages(data).page_size or 1
    count = min(len(data), FIRST_BYTES) // size
    head = bytearray(data[: count * size])
    head[28:32] = struct.pack('>I', count)  # else SQLite calls the whole file malformed
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, 'head.db3')
        file.write_bytes(head)
        with closing(_connected(file, 'ro&immutable=1')) as base:
            return _topics(base)


def _page_size(path: Path) -> int:
    with path.open('rb') as stream:
        return Pages(stream.read(100)).page_size


@contextmanager
def _still(path: Path) -> Iterator[Path]:
    """The file, or where it has a journal a copy of both."""
    journals = [path.with_name(path.name + suffix) for suffix in JOURNALS]
    journals = [p for p in journals if p.is_file() and p.read_bytes()[:1] in JOURNAL_STARTS]
    if not journals:
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        for file in (path, *journals):
            shutil.copy(file, folder)
        copy = Path(folder, path.name)
        page = _page_size(path)
        if page:  # else SQLite fills a torn page up with zeros
            os.truncate(copy, path.stat().st_size // page * page)
        yield copy


def _topics(base: sqlite3.Connection) -> dict[int, Topic]:
    try:
        definitions = dict(
            base.execute('SELECT topic_type, encoded_message_definition FROM message_definitions')
        )
    except sqlite3.OperationalError:  # before schema version 4
        definitions = {}
    rows = base.execute('SELECT id, name, type, offered_qos_profiles FROM topics')
    return {
        number: Topic(name, kind, definitions.get(kind, ''), qos)
        for number, name, kind, qos in rows
    }


@dataclass(frozen=True)
class Pages:
    """The pages of a database file, without its trees."""

    data: bytes | mmap.mmap

    @property
    def page_size(self) -> int:
        """Bytes; 0 where the header is missing."""
        if len(self.data) < 100:
            return 0
        (size,) = struct.unpack_from('>H', self.data, 16)
        return 65536 if size == 1 else int(size)

    def rows(self, after: int = 0) -> list[tuple[int, int, bytes]]:
        """(topic, time, data) of the messages with an id above `after`, in the order of ids."""
        size = self.page_size
        if size < 512:
            return []
        found: dict[int, tuple[int, int, bytes]] = {}
        for start in range(size, len(self.data) - size + 1, size):
            if self.data[start] != LEAF:
                continue
            (count,) = struct.unpack_from('>H', self.data[start : start + 8].ljust(8, b'\0'), 3)
            for i in range(count):
                try:
                    number, row = self._cell(start, start + 8 + 2 * i)
                except (struct.error, IndexError):
                    continue
                if row is not None and number > after:
                    found.setdefault(number, row)
        return [row for _, row in sorted(found.items())]

    def _cell(self, page: int, pointer: int) -> tuple[int, tuple[int, int, bytes] | None]:
        """Id and content of one cell; None where it is no message."""
        (offset,) = struct.unpack_from('>H', self.data, pointer)
        length, place = self._varint(page + offset)
        number, place = self._varint(place)
        payload = self._payload(place, length)
        if len(payload) != length:
            raise IndexError(length)
        record = Pages(payload)
        head, place = record._varint(0)
        types = []
        while place < head:
            kind, place = record._varint(place)
            types.append(kind)
        if len(types) != _COLUMNS or types[0] != 0 or types[3] < _FIRST_BLOB or types[3] % 2:
            return number, None
        values = []
        for kind in types[1:3]:
            width = _WIDTHS[kind] if kind < len(_WIDTHS) else 0
            whole = int.from_bytes(payload[place : place + width], 'big', signed=True)
            values.append(1 if kind == 9 else whole)
            place += width
        return number, (values[0], values[1], payload[place:])

    def _payload(self, place: int, length: int) -> bytes:
        """Content of a cell, with its overflow pages."""
        usable = self.page_size - self.data[20]
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
            out += self.data[start + 4 : start + min(usable, 4 + length - len(out))]
        return bytes(out)

    def _varint(self, place: int) -> tuple[int, int]:
        """Value and the place after it."""
        value = 0
        for i in range(8):
            byte = self.data[place + i]
            value = value << 7 | byte & 0x7F
            if byte < 0x80:
                return value, place + i + 1
        return value << 8 | self.data[place + 8], place + 9
