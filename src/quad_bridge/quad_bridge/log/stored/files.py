"""Compression of files and messages, and the state of sqlite3 files.

rosbags reads sqlite3 files; here is only the check whether SQLite can still read all of one.
"""

from __future__ import annotations

import fcntl
import os
import re
import shutil
import sqlite3
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from shlex import quote

from .records import MAGIC
from .scan import UNPACK_ERRORS

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'
PACKED = '.zstd'
"""Suffix of a storage file that is compressed as a whole."""
SQLITE_MAGIC = b'SQLite format 3\x00'
ORPHANS = 'SELECT count(*) FROM messages WHERE topic_id NOT IN (SELECT id FROM topics)'
"""How many messages have lost their topic, in SQL."""


RECORDING = 'is still being recorded'
RECENT_S = 5.0
"""A file without its end that has changed since may be in the hands of another recorder."""


def storage_in(paths: Iterable[Path]) -> list[Path]:
    """The storage files among these, the parts of a split bag in their order.

    A compressed one beside its own content does not count: its recorder was killed meanwhile.
    """
    present = {path.name: path for path in paths}
    return sorted((path for name, path in present.items()
                   if (plain := name.removesuffix(PACKED)).endswith(('.mcap', '.db3'))
                   and (plain == name or plain not in present)),
                  key=lambda path: (len(path.name), path.name))


def missing_parts(files: Sequence[Path]) -> list[str]:
    """A line for each missing part of a split bag, by the recorder's numbers."""
    numbers = [int(m[1]) for file in files if (m := re.match(r'[^.]*_(\d+)(?:\.|$)', file.name))]
    if len(numbers) != len(files) or min(numbers) > 0 or max(numbers) > 10_000:
        return []
    absent = sorted(set(range(max(numbers))) - set(numbers))
    return [f'part {number} of the bag is missing' for number in absent]


def recording_state(file: Path) -> str:
    """Whether a recorder still writes this file, in words; empty where none does.

    Our logger keeps its file locked. Others do not: theirs is an mcap file without its end that
    changed a moment ago.
    """
    try:
        with file.open('rb') as stream:
            fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
            if stream.read(len(MAGIC)) != MAGIC:
                return ''
            stream.seek(-len(MAGIC), os.SEEK_END)
            ended = stream.read() == MAGIC and stream.tell() > len(MAGIC)
    except OSError as error:
        return RECORDING if isinstance(error, BlockingIOError) else ''
    recent = abs(time.time() - file.stat().st_mtime) < RECENT_S
    return f'{RECORDING}, or its recorder was killed' if recent and not ended else ''


def plain_message(data: bytes) -> bytes:
    """A message, decompressed where it was compressed; empty where it is damaged."""
    if data[: len(ZSTD_MAGIC)] != ZSTD_MAGIC:
        return data
    frame = zstd.ZstdDecompressor()  # a third faster than zstd.decompress on so short a text
    try:
        content = frame.decompress(data)
    except UNPACK_ERRORS:
        return b''
    return content if frame.eof else b''


@contextmanager
def plain_file(file: Path) -> Iterator[Path]:
    """The file, or a decompressed copy of one that is compressed as a whole."""
    with file.open('rb') as stream:
        is_compressed = stream.read(len(ZSTD_MAGIC)) == ZSTD_MAGIC
    if not is_compressed:
        yield file
        return
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder, file.name.removesuffix(PACKED))
        with plain.open('wb') as target, suppress(*UNPACK_ERRORS):  # its end may be missing
            shutil.copyfileobj(zstd.open(file, 'rb'), target)
        yield plain


def address(file: Path) -> str:
    """Address with which sqlite3 opens a file read-only, whatever journal lies beside it."""
    return f'{file.resolve().as_uri()}?mode=ro&immutable=1'


def sqlite_fault(file: Path) -> str:
    """Description of the damage in a sqlite3 file; empty for a sound one.

    The file is only read. SQLite cannot see damage within a row.
    """
    for suffix, first in (('-journal', b'\xd9'), ('-wal', b'\x37')):
        journal = file.with_name(file.name + suffix)
        if journal.is_file() and journal.read_bytes()[:1] == first:
            return 'its last transaction was not finished'
    with file.open('rb') as stream:
        head = stream.read(18)
    size = int.from_bytes(head[16:], 'big')
    if head[:16] == SQLITE_MAGIC and size and file.stat().st_size % (65536 if size == 1 else size):
        return 'its last page is torn'
    try:
        with closing(sqlite3.connect(address(file), uri=True)) as base:
            (text,) = base.execute('PRAGMA quick_check(1)').fetchone()
    except (sqlite3.Error, UnicodeDecodeError) as error:
        text = str(error)
    return '' if text == 'ok' else ' '.join(text.removeprefix('*** in database main ***').split())


def sqlite_remedy(file: Path) -> str:
    """The command that saves what SQLite can still read of a damaged file.

    Its `.recover` reads more, but is not compiled into the `sqlite3` of Debian and Ubuntu.
    """
    plain = file.with_name(file.name.removesuffix(PACKED))
    unpack = f'zstdcat {quote(str(file))} > {quote(str(plain))}; ' if plain != file else ''
    saved = quote(f'{plain.stem}_recovered.db3')
    return (f"`{unpack}sqlite3 {quote(str(plain))} .dump | sed 's/^ROLLBACK.*/COMMIT;/' | "
            f'sqlite3 {saved}` saves what SQLite can still read')
