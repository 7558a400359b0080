"""From a path to raw messages: finds a bag's storage files, opens and decompresses them.

Knows directories and storage formats, not the messages' meaning. stored/, a link into quad_bridge,
finds the intact parts of a file.
"""

from __future__ import annotations

import mmap
import re
import sqlite3
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import yaml

from quad_sysid.bags.stored import files as stored
from quad_sysid.bags.stored.records import MAGIC
from quad_sysid.bags.stored.scan import BATCH, McapScan
from quad_sysid.contract import STORAGE, TOPIC_TYPES
from quad_sysid.errors import BadInputError
from quad_sysid.files import readable

RECOVER = '`ros2 run quad_bridge recover` may find more'
Batch = dict[str, list[bytes]]
"""Topic → serialised messages in the file's order."""
FOREIGN = {
    **dict.fromkeys(('.csv', '.txt'),
                    'a table; turn it into a bag with `quad-sysid import`'),
    '.gz': 'a compressed table; turn it into a bag with `quad-sysid import`',
    '.bag': 'a ROS 1 bag; convert it with `rosbags-convert`',
    '.ulg': 'a PX4 log; turn it into a bag with `quad-sysid import`',
    '.bin': 'a log of another controller; turn it into a bag with `quad-sysid import`',
    '.yaml': 'a YAML file; give the directory it lies in',
}


@dataclass
class Storage:
    """A bag's raw messages. `warnings` are complete once `batches` has run.

    If a topic has messages of several types, only the contract's type is read.
    """

    path: Path
    topics: Collection[str]
    warnings: list[str] = field(default_factory=list)
    notes: dict[str, str] = field(default_factory=dict)
    """`custom_data` of metadata.yaml."""
    others: dict[str, str] = field(default_factory=dict)
    """Topics of the files that are not wanted, with their types."""
    _counts: dict[str, int] = field(default_factory=dict)
    """Messages of each file by metadata.yaml."""
    _growing: Path | None = None
    """The file that a recorder still writes."""

    def batches(self) -> Iterator[Batch]:
        """Messages of `topics`, decompressed. BadInputError for a damaged or foreign file."""
        with readable(self.path):
            files = self._files()
        foreign: Counter[tuple[str, str]] = Counter()
        for file in files:
            with (self._as_warning(alone=len(files) == 1), readable(file),
                  stored.plain_file(file) as plain):
                yield from self._read(plain, file, foreign)
        self.warnings += [f'{topic}: {count} messages of type {kind} left out; '
                          f'this project reads {TOPIC_TYPES[topic]}'
                          for (topic, kind), count in sorted(foreign.items())]

    @contextmanager
    def _as_warning(self, *, alone: bool) -> Iterator[None]:
        """Make the fault of one file of several a warning."""
        try:
            yield
        except BadInputError as error:
            if alone:
                raise
            self.warnings.append(f'{error}: that part of the flight is missing')

    def _files(self) -> list[Path]:
        """The storage files in order. Raises BadInputError where there is no bag."""
        path = self.path
        if not path.exists():
            raise BadInputError(str(path), 'no such bag', remedy='check the path')
        if path.is_file():
            self._unlisted([path])
            return [path]
        files = stored.storage_in(path.iterdir())
        listed = self._metadata()
        if not files:
            raise without_storage(path, listed)
        if listed is None:
            names = ', '.join(p.name for p in files)
            self._unlisted(files, f'metadata.yaml is missing or unreadable (the recorder was '
                           f'killed?): read {names} as it is')
            self.warnings += [f'{path}: {part}' for part in stored.missing_parts(files)]
            return files
        absent = [name for name in listed if not (path / name).exists()]
        if absent:
            self.warnings.append(
                f'{path}: metadata.yaml lists {", ".join(absent)}, which is not there: '
                'that part of the flight is missing'
            )
        present = [path / name for name in listed if (path / name).exists()]
        if not present:
            return files
        unlisted = [file for file in files if file.name not in listed]
        parts = [file for file in unlisted if _is_part(file.name, listed)]
        for group, what in ((parts, 'read as parts of the flight'),
                            ([file for file in unlisted if file not in parts], 'left out')):
            if group:
                names = ', '.join(file.name for file in group)
                self.warnings.append(f'{path}: metadata.yaml does not list {names}: {what}')
        return sorted([*present, *parts], key=lambda p: (len(p.name), p.name))

    def _unlisted(self, files: list[Path], otherwise: str = '') -> None:
        """Warn of files that are still being recorded, or else say this."""
        state = stored.recording_state(files[-1])
        if state:
            self._growing = files[-1]
            otherwise = (f'{state}: read as far as it is on the disk; stop the recording for '
                         'all of it')
        if otherwise:
            self.warnings.append(f'{self.path}: {otherwise}')

    def _metadata(self) -> list[str] | None:
        """File names that metadata.yaml lists; None where it is missing or unreadable."""
        file = self.path / 'metadata.yaml'
        try:
            content = yaml.safe_load(file.read_text(encoding='utf-8'))
            information = content['rosbag2_bagfile_information']
            names = [Path(str(name)).name for name in information['relative_file_paths']]
            self._counts = {Path(str(file['path'])).name: int(file['message_count'])
                            for file in information.get('files') or ()}
            custom = information.get('custom_data') or {}
            self.notes.update({str(key): str(value) for key, value in custom.items()})
        except (OSError, ValueError, RecursionError, yaml.YAMLError, LookupError, TypeError,
                AttributeError):
            return None
        return names

    def _read(self, plain: Path, source: Path,
              foreign: Counter[tuple[str, str]]) -> Iterator[Batch]:
        """Batches of one decompressed file; counts messages of other types in `foreign`."""
        with plain.open('rb') as stream:
            head = stream.read(16)
        if head.startswith(MAGIC):
            batches = self._read_mcap(plain, source, foreign)
        elif head == stored.SQLITE_MAGIC:
            batches = self._read_sqlite(plain, source, foreign)
        elif source.suffix in FOREIGN:
            raise BadInputError(str(source), f'is {FOREIGN[source.suffix]}')
        elif not head:
            raise BadInputError(str(source), 'is empty',
                                remedy='the recording never reached the disk; record again')
        else:
            raise BadInputError(str(source), 'is neither mcap nor sqlite3',
                                f'first bytes {head[:8].hex()}', 'give a rosbag2 directory or an '
                                '.mcap file; quad-sysid import makes one of a log or a table')
        for batch in batches:
            yield {topic: self._decompressed(raws, source) for topic, raws in batch.items()}

    def _selects(self, topic: str, kind: str) -> bool:
        """Whether the topic is wanted and its type is, or may be, the contract's."""
        if topic not in self.topics:
            self.others[topic] = kind
        expected = TOPIC_TYPES.get(topic, '')
        same = not (kind and expected) or \
            kind.replace('/msg/', '/') == expected.replace('/msg/', '/')
        return topic in self.topics and same

    def _read_mcap(self, plain: Path, source: Path,
                   foreign: Counter[tuple[str, str]]) -> Iterator[Batch]:
        with (plain.open('rb') as stream,
              mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data):
            scan = McapScan(data)
            yield from scan.batches(lambda topic: self._selects(topic.name, topic.kind))
        if not (scan.ended or scan.returned or scan.others or scan.unnamed):
            raise BadInputError(str(source), 'is cut off before its first whole message',
                                remedy='nothing can be recovered: record again')
        if scan.stated is None and source != self._growing:
            scan.stated = self._counts.get(source.name)
            scan.lost = max((scan.stated or 0) - scan.returned, 0)
        if not scan.ended and source != self._growing:
            self.warnings.append(f'{source}: cut off (no end of data): read the intact part; '
                                 '`ros2 run quad_bridge recover` rebuilds the bag')
        elif scan.bad_chunks:
            self.warnings.append(f'{source}: {scan.bad_chunks} damaged chunks: read the rest')
        elif scan.unread and scan.stated is None:  # no statistics count what was in them
            self.warnings.append(f'{source}: {scan.unread} bytes are damaged: read the rest; '
                                 f'{RECOVER}')
        if scan.unnamed:
            self.warnings.append(f'{source}: {scan.unnamed} messages have lost their topic')
        if scan.stated is not None and scan.lost:
            self.warnings.append(
                f'{source}: {scan.lost} of {scan.stated} messages are missing; {RECOVER}'
            )
        foreign.update({key: n for key, n in scan.others.items() if key[0] in self.topics})

    def _read_sqlite(self, plain: Path, source: Path,
                     foreign: Counter[tuple[str, str]]) -> Iterator[Batch]:
        fault = stored.sqlite_fault(plain)
        if fault:
            what = f'is a damaged sqlite3 file ({fault})'
            raise BadInputError(str(source), what, remedy=stored.sqlite_remedy(source))
        try:
            with closing(sqlite3.connect(stored.address(plain), uri=True)) as base:
                (orphans,) = base.execute(stored.ORPHANS).fetchone()
                topics = base.execute(
                    'SELECT id, CAST(name AS TEXT), CAST(type AS TEXT) FROM topics').fetchall()
                mine = {i: name for i, name, kind in topics if self._selects(name, kind)}
                count = 'SELECT count(*) FROM messages WHERE topic_id = ?'
                foreign.update({
                    (name, kind): base.execute(count, (i,)).fetchone()[0]
                    for i, name, kind in topics if name in self.topics and i not in mine
                })
                marks = ', '.join('?' * len(mine))
                rows = base.execute(  # it was 45 % slower through rosbags
                    f'SELECT topic_id, data FROM messages WHERE topic_id IN ({marks}) '  # noqa: S608
                    'ORDER BY id',
                    tuple(mine),
                )
                while part := rows.fetchmany(BATCH):
                    batch: Batch = {name: [] for name in mine.values()}
                    for i, raw in part:
                        batch[mine[i]].append(raw)
                    for name, raws in batch.items():
                        batch[name] = [raw for raw in raws if type(raw) is bytes]
                        orphans += len(raws) - len(batch[name])
                    yield batch
        except (sqlite3.Error, UnicodeDecodeError) as error:
            what = f'cannot be read as a sqlite3 bag ({" ".join(str(error).split())})'
            raise BadInputError(str(source), what, remedy='is it a bag of rosbag2?') from error
        if orphans:
            self.warnings.append(f'{source}: {orphans} rows are not messages; left out')

    def _decompressed(self, raws: list[bytes], source: Path) -> list[bytes]:
        """Messages as CDR; those compressed one by one (known by their magic) are decompressed."""
        if not raws or stored.ZSTD_MAGIC not in (raws[0][:4], raws[-1][:4]):
            return raws
        messages = [stored.plain_message(raw) for raw in raws]
        damaged = messages.count(b'')
        if damaged:
            self.warnings.append(f'{source}: {damaged} compressed messages are damaged; left out')
        return [raw for raw in messages if raw]


def without_storage(path: Path, listed: Collection[str] | None = None) -> BadInputError:
    """The refusal of a folder that is no bag; names one of those in it, if there are such."""
    inside = sorted(str(file.parent) for file in path.glob('*/*') if file.name.endswith(STORAGE))
    remedy = 'give a rosbag2 directory or an .mcap file'
    if inside:
        remedy = f'give one of the bags in it, such as {inside[0]}, or all to quad-sysid fleet'
    if listed:
        remedy = f'metadata.yaml names {", ".join(listed)}: copy it there'
    return BadInputError(str(path), 'holds no storage file (.mcap or .db3)', remedy=remedy)


def _is_part(name: str, listed: Collection[str]) -> bool:
    """Whether a file is a part of the split bag with the files `listed`, not a copy."""
    stem = name.partition('.')[0]
    stems = {other.partition('.')[0] for other in listed}
    numbered = {re.sub(r'_\d+$', '', other) for other in stems}
    return stem not in stems and re.sub(r'_\d+$', '', stem) in numbered
