"""Reads what is whole in a sqlite3 bag file: by SQL, and where the tree is torn page by page.

The file itself is never opened for writing. A journal that a killed recorder has left is played
back on a copy. Pages and rows without SQL: sqlite_pages.py. sqlite3 keeps no checksums: what is
damaged within a message cannot be seen.
"""

from __future__ import annotations

import mmap
import os
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from quad_bridge.damaged_mcap import Message
from quad_bridge.mcap_records import Topic
from quad_bridge.sqlite_pages import Pages, Value, page_size

JOURNALS = ('-journal', '-wal')
JOURNAL_STARTS = (b'\xd9', b'\x37')
"""First byte of a rollback journal that is still to be played back, and of a write-ahead log."""
FEWEST_BYTES = 12
"""Of a row with its cell: more rows than fit into a file are no number to count by."""


@dataclass
class DamagedSqlite:
    """One file; `messages` may be run once, the notes and figures hold afterwards."""

    path: Path
    notes: list[str] = field(default_factory=list)
    complete: bool = True
    """Its tree is whole, and so is every row."""
    lost: int = 0
    """Rows that were there by the numbers of those that are, or that are no messages."""
    unread: int = 0
    """Bytes of pages that are not whole."""
    _last: int = 0
    """Highest row number so far."""
    _found: int = 0

    def messages(self) -> Iterator[Message]:
        """All whole messages, in the order of writing."""
        with _still(self.path) as plain:
            played = plain != self.path
            if played:
                self.notes.append(f'{self.path.name}: its last transaction was not finished')
            try:
                _check(plain, copied=played)
                with closing(_connected(plain, copied=played)) as base:
                    yield from self._by_sql(base)
            except (sqlite3.Error, UnicodeDecodeError) as error:  # its own words may be damaged
                self.complete = False
                told = error if isinstance(error, sqlite3.Error) else 'malformed'
                reason = ' '.join(str(told).split())
                self.notes.append(f'{self.path.name}: {reason}: read page by page')
                yield from self._by_pages(plain)
        self.complete = self.complete and not self.lost

    def _by_sql(self, base: sqlite3.Connection) -> Iterator[Message]:
        topics = _topics(base)
        for number, *values in base.execute(
            'SELECT id, topic_id, timestamp, data FROM messages ORDER BY id'
        ):
            message = _message(topics, values)
            self._last = number
            if message is None:
                self.lost += 1
            else:
                yield message

    def _by_pages(self, plain: Path) -> Iterator[Message]:
        """Messages behind those that SQL gave, without their tree."""
        self.lost = 0
        if not plain.stat().st_size:
            return
        with (
            plain.open('rb') as file,
            mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data,
        ):
            pages = Pages(data)
            topics, rows = _survey(pages)
            if not topics and rows:
                self.notes.append(f'{self.path.name}: its list of topics is damaged')
            before = None
            for number, key, place in sorted(rows):
                if number <= self._last or (number, key) == before:
                    continue
                before = number, key
                message = _message(topics, pages.values(place)[1:])
                self._found += message is not None
                if message is not None:
                    yield message
            numbers = (pages.indexed, *(number for number, _, _ in rows))
            fitting = [number for number in numbers if number * FEWEST_BYTES <= len(data)]
            self.lost = max(max(fitting, default=0) - self._last - self._found, 0)
            self._count_pages(pages, len(data))

    def _count_pages(self, pages: Pages, there: int) -> None:
        size = pages.page_size
        self.unread = len(pages.damaged) * size + there % size
        if pages.damaged:
            self.notes.append(
                f'{self.path.name}: {len(pages.damaged)} of {there // size} pages are not whole'
            )
        if pages.told * size > there and pages.told * size < 2 * there:
            self.notes.append(
                f'{self.path.name}: {pages.told - there // size} of {pages.told} pages are missing'
            )


def _survey(
    pages: Pages,
) -> tuple[dict[int, Topic], list[tuple[int, tuple[int, int], tuple[int, int]]]]:
    """Topics by number; (number, (topic, time), place) of all messages."""
    names: dict[int, tuple[str, str, str, str]] = {}
    definitions: dict[str, str] = {}
    rows = []
    for row in pages.rows():
        match row.values:
            case (None, int(topic), int(time_ns), bytes()):
                rows.append((row.number, (topic, time_ns), row.place))
            case (None, str(name), str(kind), str(), *more) if name[:1] == '/':
                qos, digest = [value for value in (*more, '', '') if isinstance(value, str)][:2]
                names.setdefault(row.number, (name, kind, qos, digest))
            case (None, str(kind), str(), str(text), str()):
                definitions.setdefault(kind, text)
    return {
        number: Topic(name, kind, definitions.get(kind, ''), qos, digest)
        for number, (name, kind, qos, digest) in names.items()
    }, rows


def _message(topics: dict[int, Topic], values: Sequence[Value]) -> Message | None:
    """A message from topic, time, data; None where one of them is none."""
    match values:
        case [int(number), int(time_ns), bytes(data)] if number in topics and time_ns >= 0:
            return Message(topics[number], time_ns, data)
    return None


def _check(plain: Path, *, copied: bool) -> None:
    """Raise sqlite3.DatabaseError where SQLite could not read all that is there."""
    if not plain.stat().st_size:
        raise sqlite3.DatabaseError('is empty')
    with plain.open('rb') as stream:
        if plain.stat().st_size % page_size(stream.read(100)):
            raise sqlite3.DatabaseError('its last page is torn')  # SQLite adds zeros
    with closing(_connected(plain, copied=copied)) as base:
        told = [str(row[0]) for row in base.execute('PRAGMA quick_check(1)')]
    if told != ['ok']:
        raise sqlite3.DatabaseError(' '.join(told).removeprefix('*** in database main ***'))
    with plain.open('rb') as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        if Pages(data).zeros():  # within a long row SQLite takes them for its content
            raise sqlite3.DatabaseError('pages were never written')


def _connected(file: Path, *, copied: bool) -> sqlite3.Connection:
    """The file itself read-only, whatever journal it has; a copy with its journal."""
    mode = 'rw' if copied else 'ro&immutable=1'
    base = sqlite3.connect(f'{file.resolve().as_uri()}?mode={mode}', uri=True)
    base.text_factory = lambda raw: raw.decode(errors='replace')
    return base


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
        with path.open('rb') as stream:
            page = page_size(stream.read(100))
        # else SQLite fills a torn page up with zeros
        os.truncate(copy, path.stat().st_size // page * page)
        yield copy


def _topics(base: sqlite3.Connection) -> dict[int, Topic]:
    try:
        definitions = dict(
            base.execute('SELECT topic_type, encoded_message_definition FROM message_definitions')
        )
    except sqlite3.OperationalError:  # before schema version 4
        definitions = {}
    cursor = base.execute('SELECT * FROM topics')  # of its columns not every version has all
    columns = [column[0] for column in cursor.description]
    if not {'id', 'name', 'type'} <= set(columns):
        raise sqlite3.DatabaseError('its table of topics is damaged')
    topics = {}
    for values in cursor:
        row = dict(zip(columns, values, strict=True))
        if isinstance(row['name'], str) and isinstance(row['type'], str):
            more = (row.get('offered_qos_profiles', ''), row.get('type_description_hash', ''))
            definition = str(definitions.get(row['type'], ''))
            topics[row['id']] = Topic(row['name'], row['type'], definition, *map(str, more))
    return topics
