"""Messages of a sqlite3 bag file; what a killed recorder or a torn disk left is read on a copy.

The file itself is never written to. No decoding of messages. Source: rosbag2_storage_sqlite3's
tables; the SQLite file format (header: page size at byte 16, number of pages at byte 28).
"""

from __future__ import annotations

import os
import shutil
import sqlite3
import struct
from collections import Counter
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from quad_sysid.bags.mcap_scan import BATCH, Batch, same_type

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

MAGIC = b'SQLite format 3\x00'
RECOVER = '`ros2 run quad_bridge recover` may find more'
JOURNALS = ('-journal', '-wal')
JOURNAL_STARTS = (b'\xd9', b'\x37')
"""First byte of a rollback journal that is still to be played back, and of a write-ahead log."""


@dataclass
class SqliteScan:
    """One pass over one file; `foreign` and `notes` are complete once `batches` has run."""

    path: Path
    wanted: Mapping[str, str]
    """Topic → message type; empty where any type counts."""
    foreign: Counter[tuple[str, str]] = field(default_factory=Counter)
    """(topic, type) → messages of wanted topics that are of another type."""
    notes: list[str] = field(default_factory=list)
    strange: int = 0
    """Rows of wanted topics whose data are no bytes."""

    def batches(self) -> Iterator[Batch]:
        """Messages of the wanted topics in the order of writing, some thousand at a time."""
        batch: Batch = {}
        count = 0
        try:
            with self._settled() as address, closing(sqlite3.connect(address, uri=True)) as base:
                for topic, raw in self._rows(base):
                    batch.setdefault(topic, []).append(raw)
                    count += 1
                    if count >= BATCH:
                        yield batch
                        batch, count = {}, 0
        except (sqlite3.Error, UnicodeDecodeError) as error:  # its own words may be damaged
            reason = error if isinstance(error, sqlite3.Error) else 'malformed'
            self.notes.append(f'damaged sqlite3 file ({reason}): read what is whole; {RECOVER}')
        if self.strange:
            self.notes.append(f'{self.strange} rows are no messages; left out')
        yield batch

    def _rows(self, base: sqlite3.Connection) -> Iterator[tuple[str, bytes]]:
        base.text_factory = lambda raw: raw.decode(errors='replace')
        told = [str(row[0]) for row in base.execute('PRAGMA quick_check(1)')]
        names, foreign = {}, {}
        for number, name, kind in base.execute('SELECT id, name, type FROM topics'):
            if name in self.wanted and same_type(str(kind), self.wanted[name]):
                names[number] = name
            elif name in self.wanted:
                foreign[number] = name, str(kind)
        marks = ','.join('?' * (len(names) + len(foreign)))
        rows = base.execute(
            f'SELECT topic_id, data FROM messages WHERE topic_id IN ({marks}) ORDER BY id',  # noqa: S608
            [*names, *foreign],
        )
        for number, raw in rows:
            if number in foreign:
                self.foreign[foreign[number]] += 1
            elif isinstance(raw, bytes):
                yield names[number], raw
            else:
                self.strange += 1
        if told != ['ok']:  # SQLite may leave out rows without a word
            what = ' '.join(told).removeprefix('*** in database main ***').strip()
            self.notes.append(f'damaged sqlite3 file ({what}): read what is whole; {RECOVER}')

    @contextmanager
    def _settled(self) -> Iterator[str]:
        """Address of a database that can be read without being written to."""
        journals = [self.path.with_name(self.path.name + suffix) for suffix in JOURNALS]
        hot = [p for p in journals if p.is_file() and p.read_bytes()[:1] in JOURNAL_STARTS]
        pages = _pages(self.path)
        if not hot and pages is None:
            yield f'{self.path.resolve().as_uri()}?mode=ro&immutable=1'
            return
        with TemporaryDirectory() as folder:
            for file in (self.path, *hot):
                shutil.copy(file, folder)
            copy = Path(folder, self.path.name)
            os.truncate(copy, _whole(copy))  # else SQLite fills a torn page up with zeros
            if hot:
                self.notes.append('the recorder was killed within a transaction: read without it')
            elif pages is not None:
                self.notes.append('its end is missing')
                with copy.open('r+b') as stream:  # else SQLite takes the whole file for malformed
                    stream.seek(28)
                    stream.write(struct.pack('>I', pages))
            yield f'{copy.as_uri()}?mode=rw'


def _page_size(head: bytes) -> int:
    (size,) = struct.unpack_from('>H', head.ljust(100, b'\0'), 16)
    return 65536 if size == 1 else max(size, 512)


def _whole(path: Path) -> int:
    """Bytes of the file's whole pages."""
    with path.open('rb') as stream:
        page = _page_size(stream.read(100))
    return path.stat().st_size // page * page


def _pages(path: Path) -> int | None:
    """How many pages are there, where the header counts more; else None."""
    with path.open('rb') as stream:
        head = stream.read(100)
    (told,) = struct.unpack_from('>I', head.ljust(100, b'\0'), 28)
    there = path.stat().st_size // _page_size(head)
    return there if there < told else None
