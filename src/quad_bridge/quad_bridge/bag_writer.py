"""Serialised messages into a rosbag2 bag: one directory, one storage file after the other.

No ROS, no threads. What was written is on the disk after `flush`, also when the power fails then;
the formats of the files stand in mcap_file.py and sqlite_file.py.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from rosbags.interfaces import Qos
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore

from quad_bridge.bag_metadata import BagFormat, FileEntry, RecordedTopic, information, yaml_text
from quad_bridge.compression import COMPRESSORS
from quad_bridge.disk import MB, Reserve, free_bytes, is_full, sync_folder
from quad_bridge.errors import BadInputError
from quad_bridge.mcap_file import McapFile
from quad_bridge.sqlite_file import SqliteFile

STORAGES: dict[str, type[McapFile | SqliteFile]] = {'mcap': McapFile, 'sqlite3': SqliteFile}
COMPRESSIONS = tuple(COMPRESSORS)
MOST_NAMESAKES = 1000
"""Bags of one second."""
CLOSING_RESERVE = 4 * MB
"""Kept for index and metadata when the disk is full: that of some hours."""
AHEAD = 2 * MB
"""What may be written from one `flush` to the next: the reserve gives it back beforehand."""


class TakenError(BadInputError):
    """There is something at the path where a bag was to begin."""


def free_paths(folder: Path, prefix: str, now: datetime) -> Iterator[Path]:
    """Paths for a bag: prefix, date, time, a number where that is taken."""
    stem = f'{prefix}_{now:%Y%m%d_%H%M%S}'
    yield folder / stem
    for number in range(2, MOST_NAMESAKES + 1):
        yield folder / f'{stem}_{number}'


@dataclass(frozen=True)
class Definition:
    """A message's definition where the bag that is copied brings it along."""

    text: str
    digest: str
    """RIHS01 hash; empty where unknown."""


@dataclass(frozen=True)
class Limits:
    """When the next file of a bag begins (0: never), and what is reserved for the bag."""

    split_bytes: int = 0
    split_s: float = 0.0
    """Seconds of receive time."""
    reserve_bytes: int = 0


class BagWriter:
    """One bag, open from construction to `close`; never writes over an existing one."""

    def __init__(
        self,
        path: Path,
        storage: str = 'mcap',
        compression: str = 'none',
        limits: Limits | None = None,
    ) -> None:
        """Create the bag's directory and first file. Raises BadInputError where it cannot be."""
        _check(path, storage, compression)
        self.path = path
        self.counts: dict[str, int] = {}
        """Messages written, by topic."""
        self._format = BagFormat(storage, compression)
        self._limits = limits or Limits()
        self._topics: dict[str, RecordedTopic] = {}
        self._store = get_typestore(Stores.ROS2_JAZZY)
        self._closed: list[FileEntry] = []
        self._began_ns = 0
        self._split_due = False
        made = False
        try:
            _check_space(path, self._limits.reserve_bytes)
            path.mkdir(parents=True)
            made = True
            self._reserve = Reserve(path, self._limits.reserve_bytes)
            self._closing = Reserve(path, CLOSING_RESERVE if self._limits.reserve_bytes else 0)
            self._file = self._open_file()
            sync_folder(path.parent)
        except FileExistsError as error:  # another recorder's, of this moment
            raise TakenError(str(path), 'exists already, not overwritten') from error
        except (OSError, sqlite3.Error) as error:
            if made:
                _remove_empty(path)
            reason = getattr(error, 'strerror', None) or str(error)
            raise BadInputError(str(path), f'cannot write a bag here: {reason}') from error

    @property
    def pending(self) -> int:
        """Messages that a kill at this moment would lose."""
        return self._file.pending

    @property
    def size(self) -> int:
        """Bytes of all files so far, what waits for the disk included."""
        return sum(entry.size for entry in self._closed) + self._file.size

    def add_topic(
        self,
        topic: str,
        kind: str,
        qos: tuple[Qos, ...] = (),
        definition: Definition | None = None,
        *,
        name: str = '',
    ) -> None:
        """Declare a topic before its first message; a second time does nothing.

        Where a bag that is copied has a topic with a second type, that is declared under another
        `topic` with the `name` of the first.
        `kind` such as `sensor_msgs/msg/Imu`. Raises BadInputError for a type that neither Jazzy's
        standard types nor `definition` give.
        """
        if topic in self._topics:
            return
        try:
            text, _ = self._store.generate_msgdef(kind, ros_version=2)
            digest = self._store.hash_rihs01(kind)
        except (TypesysError, KeyError) as error:
            if definition is None or not definition.text:
                where = f'{self.path}: {topic}'
                raise BadInputError(where, 'message type is not a standard one', kind) from error
            text, digest = definition.text, self._hash(kind, definition)
        self._topics[topic] = RecordedTopic(name or topic, kind, text, digest, qos, topic)
        self._file.add_topic(self._topics[topic])
        self.counts[topic] = 0

    def _hash(self, kind: str, definition: Definition) -> str:
        """RIHS01 of a type that is no standard one; as the definition says where it is unknown."""
        try:
            self._store.register(get_types_from_msg(definition.text, kind))
            return self._store.hash_rihs01(kind)
        except Exception:  # noqa: BLE001  (whatever a damaged text makes the parser raise)
            return definition.digest or 'RIHS01_' + '0' * 64

    def write(self, topic: str, time_ns: int, data: bytes | memoryview) -> None:
        """Append one serialised message; `time_ns` is when it was received."""
        if self._split_due or self._over_time(time_ns):
            self._split()
        self._began_ns = self._began_ns or time_ns
        try:
            self._file.write(topic, time_ns, data)
        except (OSError, sqlite3.Error) as error:  # it waits in the file's chunk all the same
            self._take_more(error)
            self._sync()
        self.counts[topic] += 1

    def flush(self) -> None:
        """Hand everything written so far to the disk. Raises OSError or sqlite3.Error."""
        if not self._file.path.exists():
            raise FileNotFoundError(f'{self._file.path.name} was removed or renamed')
        self._reserve.give(self.size + AHEAD)
        self._sync()
        self._split_due = 0 < self._limits.split_bytes <= self._file.size

    def close(self) -> None:
        """Write the index and metadata.yaml."""
        self._release()
        if not self._file_closed:
            self._close_file()
        whole = information(self._format, list(self._topics.values()), self._closed)
        part = self.path / 'metadata.yaml.part'
        part.write_text(yaml_text({'rosbag2_bagfile_information': whole}), encoding='utf-8')
        part.replace(self.path / 'metadata.yaml')
        sync_folder(self.path)

    def close_after_fault(self) -> None:
        """Write what waits from the reserve and close; `counts` says what is there.

        Raises OSError or sqlite3.Error where that fails too: then `abort`, and `recover` later.
        """
        self._release()
        if not self._file.path.exists():
            raise FileNotFoundError(f'{self._file.path.name} was removed or renamed')
        if not self._file_closed:
            self._file.cut_back()
            try:
                self._file.sync()
            except (OSError, sqlite3.Error):
                self._file.cut_back()
                self._file.forget()
        self._recount()
        self.close()

    def abort(self) -> None:
        """Give up without index: what was flushed stays, `recover` reads it."""
        self._release()
        self._recount()
        self._file.abandon()

    def _sync(self) -> None:
        while True:
            try:
                return self._file.sync()
            except (OSError, sqlite3.Error) as error:  # noqa: PERF203  (once, mostly)
                self._take_more(error)

    def _take_more(self, error: Exception) -> None:
        """Take more of the reserve for another try; raises `error` where that cannot help."""
        if not is_full(error) or not self._reserve.more(AHEAD):
            raise error
        self._file.cut_back()

    def _recount(self) -> None:
        """Count what is stored, without what waits."""
        entries = {id(entry): entry for entry in (*self._closed, self._file.entry)}.values()
        for topic in self.counts:
            self.counts[topic] = sum(entry.counts.get(topic, 0) for entry in entries)

    @property
    def _file_closed(self) -> bool:
        """No next file could be opened after the last one."""
        return any(entry is self._file.entry for entry in self._closed)

    def _release(self) -> None:
        self._reserve.release()
        self._closing.release()

    def _over_time(self, time_ns: int) -> bool:
        limit = self._limits.split_s
        self._began_ns = min(self._began_ns, time_ns)  # the clock was set back
        return bool(limit and self._began_ns and time_ns - self._began_ns >= limit * 1e9)

    def _split(self) -> None:
        self._close_file()
        self._file = self._open_file()
        self._began_ns, self._split_due = 0, False
        for topic in self._topics.values():
            self._file.add_topic(topic)

    def _open_file(self) -> McapFile | SqliteFile:
        name = f'{self.path.name}_{len(self._closed)}{self._format.suffix}'
        file = STORAGES[self._format.storage](self.path / name, self._format.compression)
        sync_folder(self.path)
        return file

    def _close_file(self) -> None:
        self._file.sync()
        entry = self._file.entry
        alone = information(self._format, list(self._topics.values()), [entry])
        self._file.close(yaml_text(alone).strip())
        entry.size = self._file.size
        self._closed.append(entry)


def _check(path: Path, storage: str, compression: str) -> None:
    if storage not in STORAGES:
        raise BadInputError(str(path), 'storage must be mcap or sqlite3', storage)
    if compression not in COMPRESSIONS:
        known = ', '.join(COMPRESSIONS)
        raise BadInputError(str(path), f'compression must be one of {known}', compression)
    if (storage, compression) == ('sqlite3', 'lz4'):
        raise BadInputError(
            str(path), 'compression lz4 exists in mcap only', remedy='take zstd or storage mcap'
        )


def _check_space(path: Path, reserve: int) -> None:
    if path.exists():
        raise TakenError(str(path), 'exists already, not overwritten')
    free = free_bytes(path)
    if free < reserve + CLOSING_RESERVE and reserve:
        raise BadInputError(
            str(path),
            f'needs {(reserve + CLOSING_RESERVE) / MB:.0f} MB of free disk for a flight',
            f'{free / MB:.0f} MB',
            'free the disk or lower reserve_mb',
        )


def _remove_empty(path: Path) -> None:
    for file in path.iterdir():
        file.unlink()
    path.rmdir()


def new_bag(
    paths: Iterable[Path], storage: str, compression: str, limits: Limits | None = None
) -> BagWriter:
    """A bag at the first of `paths` that is free, also where others look for one now.

    Raises BadInputError where none can be.
    """
    *others, last = paths
    for path in others:
        with suppress(TakenError):
            return BagWriter(path, storage, compression, limits)
    return BagWriter(last, storage, compression, limits)
