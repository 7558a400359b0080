"""Serialised messages into a rosbag2 bag: a directory of mcap files.

No ROS, no threads. `flush` brings everything to the disk, so that it survives a power cut. mcap.py
writes the files. Source of metadata.yaml: rosbag2's version 9, as in Jazzy.
"""

from __future__ import annotations

import os
import shutil
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import yaml
from rosbags.interfaces import Qos
from rosbags.rosbag2.metadata import dump_qos_v9
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore

from quad_bridge.errors import BadInputError
from quad_bridge.log.disk import MB, free_bytes, reserved, sync_folder
from quad_bridge.log.mcap import FileEntry, McapFile, RecordedTopic
from quad_bridge.topics import LATCHED

MAX_NAMESAKES = 1000
"""Most bags of one second."""
CLOSING_RESERVE = 4 * MB
"""Space for index and metadata of some hours when the disk is full."""
GAINS = '/gains/active'
"""The latched topic whose messages may add to each other: one need not name every gain."""


class PathExistsError(BadInputError):
    """The path of a new bag exists already."""


def free_paths(folder: Path, prefix: str, now: datetime) -> Iterator[Path]:
    """Possible paths of a bag: prefix, date, time, and a number if that exists."""
    stem = f'{prefix}_{now:%Y%m%d_%H%M%S}'
    yield folder / stem
    for number in range(2, MAX_NAMESAKES + 1):
        yield folder / f'{stem}_{number}'


@dataclass(frozen=True)
class Definition:
    """Definition of a message type from a bag that is copied."""

    text: str
    """Empty where that bag has none, as sqlite3 bags of ROS 2 Humble."""
    digest: str
    """RIHS01 hash; empty where unknown."""


@dataclass(frozen=True)
class Limits:
    """Size and time at which a bag is split (0: never), and the disk that it needs."""

    split_bytes: int = 0
    split_s: float = 0.0
    """Receive time, s."""
    reserve_bytes: int | None = None
    """Free space, beside CLOSING_RESERVE, without which no bag is begun; None: nothing is looked
    at or set aside."""


class BagWriter:
    """One bag, open from construction to `close`; never overwrites an existing one."""

    def __init__(self, path: Path, limits: Limits | None = None) -> None:
        """Create the bag's directory and first file. Raises BadInputError where that fails."""
        self.path = path
        self.counts: dict[str, int] = {}
        """Messages written, by topic; without those that a new file repeats."""
        self._limits = limits or Limits()
        self._topics: dict[str, RecordedTopic] = {}
        self._store = get_typestore(Stores.ROS2_JAZZY)
        self._closed: list[FileEntry] = []
        self._began_ns = 0
        self._split_due = False
        self._latched: dict[tuple[str, str], bytes] = {}
        """By topic and gain the message that holds, in their order: a new file repeats them, so
        that it can be read without the others."""
        self._repeated_bytes = 0
        created = False
        try:
            _check_space(path, self._limits.reserve_bytes)
            path.mkdir(parents=True)
            created = True
            self._closing = reserved(
                path, 0 if self._limits.reserve_bytes is None else CLOSING_RESERVE)
            self._file = self._open_file()
            sync_folder(path.parent)
        except FileExistsError as error:  # another recorder's, of this moment
            raise PathExistsError(str(path), 'exists already, not overwritten') from error
        except OSError as error:
            if created:
                shutil.rmtree(path, ignore_errors=True)
            raise BadInputError(str(path), f'cannot write a bag here: {error.strerror}') from error

    @property
    def size(self) -> int:
        """Bytes of all files so far, with the open chunk."""
        still_open = 0 if self._file_closed else self._file.size
        return sum(entry.size for entry in self._closed) + still_open

    def add_topic(
        self,
        topic: str,
        kind: str,
        qos: tuple[Qos, ...] = (),
        definition: Definition | None = None,
        *,
        name: str = '',
    ) -> None:
        """Declare a topic before its first message; a second call does nothing.

        `kind` such as `sensor_msgs/msg/Imu`. A topic's second type, in a bag that is copied, is
        declared under another `topic` with the `name` of the first. Raises BadInputError for a
        type that is not standard in Jazzy, without a `definition`.
        """
        if topic in self._topics:
            return
        try:
            text, _ = self._store.generate_msgdef(kind, ros_version=2)
            digest = self._store.hash_rihs01(kind)
        except (TypesysError, KeyError) as error:
            if definition is None:
                where = f'{self.path}: {topic}'
                raise BadInputError(where, 'message type is not a standard one', kind) from error
            text, digest = definition.text, self._hash(kind, definition)
        self._topics[topic] = RecordedTopic(name or topic, kind, text, digest, qos, topic)
        self._file.add_topic(self._topics[topic])
        self.counts[topic] = 0

    def _hash(self, kind: str, definition: Definition) -> str:
        """RIHS01 hash of a type that is not standard; the definition's where it is unknown."""
        unknown = definition.digest or 'RIHS01_' + '0' * 64
        if not definition.text:
            return unknown
        try:
            self._store.register(get_types_from_msg(definition.text, kind))
            return self._store.hash_rihs01(kind)
        except Exception:  # noqa: BLE001  (whatever a damaged text makes the parser raise)
            return unknown

    def write(self, topic: str, time_ns: int, data: bytes | memoryview) -> None:
        """Append one serialised message with its receive time, ns."""
        if self._split_due or self._over_time(time_ns):
            self._split(time_ns)
        self._began_ns = self._began_ns or time_ns
        self._file.write(topic, time_ns, data)
        self.counts[topic] += 1
        if topic in LATCHED and (self._limits.split_bytes or self._limits.split_s):
            self._remember(topic, bytes(data))

    def flush(self) -> None:
        """Bring everything written so far to the disk. Raises OSError."""
        if not self._file.path.exists():
            raise FileNotFoundError(f'{self._file.path.name} was removed or renamed')
        self._file.sync()
        own = self._file.size - self._repeated_bytes  # or a large description would split for ever
        self._split_due = 0 < self._limits.split_bytes <= own

    def close(self) -> None:
        """Write the index and metadata.yaml."""
        self._closing.close()
        if not self._file_closed:
            self._close_file()
        text = information(list(self._topics.values()), self._closed)
        part = self.path / 'metadata.yaml.part'
        with part.open('w', encoding='utf-8') as file:
            file.write(yaml_text({'rosbag2_bagfile_information': text}))
            file.flush()
            os.fsync(file.fileno())  # else a power cut could leave the name of an empty file
        part.replace(self.path / 'metadata.yaml')
        sync_folder(self.path)

    def close_after_fault(self) -> None:
        """Write the open chunk into the reserved space and close; `counts` says what is stored.

        Raises OSError where that fails too: call `abort`, and `recover` later.
        """
        self._closing.close()
        if not self._file.path.exists():
            raise FileNotFoundError(f'{self._file.path.name} was removed or renamed')
        if not self._file_closed:
            self._file.cut_back()
            try:
                self._file.sync()
            except OSError:
                self._file.cut_back()
                self._file.forget()
        self._recount()
        self.close()

    def abort(self) -> None:
        """Close without index; flushed messages stay for `recover`."""
        self._closing.close()
        self._recount()
        self._file.abandon()

    def _recount(self) -> None:
        """Count the stored messages, without the open chunk."""
        entries = {id(entry): entry for entry in (*self._closed, self._file.entry)}.values()
        for topic in self.counts:
            self.counts[topic] = sum(
                max(0, entry.counts.get(topic, 0) - entry.repeated.get(topic, 0))
                for entry in entries
            )

    @property
    def _file_closed(self) -> bool:
        """No next file could be opened after the last one."""
        return any(entry is self._file.entry for entry in self._closed)

    def _over_time(self, time_ns: int) -> bool:
        limit = self._limits.split_s
        self._began_ns = min(self._began_ns, time_ns)  # the clock was set back
        return bool(limit and self._began_ns and time_ns - self._began_ns >= limit * 1e9)

    def _split(self, time_ns: int) -> None:
        """Go on in a new file, which begins with what holds, as if it came with its first message.

        Received when it was, it would overlap with the files before; its stamp is unchanged.
        """
        self._close_file()
        self._file = self._open_file()
        self._began_ns, self._split_due = 0, False
        for topic in self._topics.values():
            self._file.add_topic(topic)
        holding = list(dict.fromkeys((key[0], data) for key, data in self._latched.items()))
        self._repeated_bytes = sum(len(data) for _, data in holding)
        self._file.entry.repeated = Counter(topic for topic, _ in holding)
        for key, data in holding:
            self._file.write(key, time_ns, data)

    def _remember(self, topic: str, data: bytes) -> None:
        """Keep a latched message for as long as it holds."""
        for name in self._gains(data) if topic == GAINS else ['']:
            self._latched.pop((topic, name), None)  # to the end, so that the latest comes last
            self._latched[topic, name] = data

    def _gains(self, data: bytes) -> list[str]:
        """The gains that a message names; none of a damaged one."""
        try:
            event: Any = self._store.deserialize_cdr(data, self._topics[GAINS].kind)
            return [parameter.name for parameter in event.changed_parameters]
        except Exception:  # noqa: BLE001  (whatever nonsense makes the decoder raise)
            return []

    def _open_file(self) -> McapFile:
        file = McapFile(self.path / f'{self.path.name}_{len(self._closed)}.mcap')
        sync_folder(self.path)
        return file

    def _close_file(self) -> None:
        self._file.sync()
        entry = self._file.entry
        alone = information(list(self._topics.values()), [entry])
        self._file.close(yaml_text(alone).strip())
        entry.size = self._file.size
        self._closed.append(entry)


def _check_space(path: Path, reserve: int | None) -> None:
    if path.exists():
        raise PathExistsError(str(path), 'exists already, not overwritten')
    if reserve is None:
        return
    free = free_bytes(path)
    if free < reserve + CLOSING_RESERVE:
        raise BadInputError(
            str(path),
            f'needs {(reserve + CLOSING_RESERVE) / MB:.0f} MB of free disk for a flight',
            f'{free / MB:.0f} MB',
            'free the disk' + (' or lower reserve_mb' if reserve else ''),
        )


def new_bag(paths: Iterable[Path], limits: Limits | None = None) -> BagWriter:
    """A bag at the first free one of `paths`, even while other recorders choose theirs.

    Raises BadInputError where none can be created.
    """
    *others, last = paths
    for path in others:
        with suppress(PathExistsError):
            return BagWriter(path, limits)
    return BagWriter(last, limits)


def information(topics: Sequence[RecordedTopic], files: Sequence[FileEntry]) -> dict[str, Any]:
    """Content of `rosbag2_bagfile_information` for these files."""
    filled = [entry for entry in files if entry.messages]
    first = min((entry.first_ns for entry in filled), default=0)
    last = max((entry.last_ns for entry in filled), default=0)
    return {
        'version': 9,
        'storage_identifier': 'mcap',
        'duration': {'nanoseconds': last - first},
        'starting_time': {'nanoseconds_since_epoch': first},
        'message_count': sum(entry.messages for entry in files),
        'topics_with_message_count': [
            {
                'topic_metadata': {
                    'name': topic.name,
                    'type': topic.kind,
                    'serialization_format': 'cdr',
                    'offered_qos_profiles': dump_qos_v9(list(topic.qos)),
                    'type_description_hash': topic.digest,
                },
                'message_count': sum(entry.counts.get(topic.key, 0) for entry in files),
            }
            for topic in topics
        ],
        'compression_format': '',
        'compression_mode': '',
        'relative_file_paths': [entry.name for entry in files],
        'files': [
            {
                'path': entry.name,
                'starting_time': {'nanoseconds_since_epoch': entry.first_ns},
                'duration': {'nanoseconds': entry.last_ns - entry.first_ns},
                'message_count': entry.messages,
            }
            for entry in files
        ],
        'custom_data': None,
        'ros_distro': 'jazzy',
    }


def yaml_text(content: Mapping[str, Any]) -> str:
    """YAML in the order of the keys."""
    return yaml.safe_dump(dict(content), sort_keys=False)
