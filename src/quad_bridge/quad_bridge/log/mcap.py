"""One mcap file being written: chunks with checksum and index, each safe on the disk once synced.

stored/ reads, writer.py makes the bag around it. After a write that failed half-way the file is
truncated to its last complete record, so that it can still be closed.
Source: the MCAP specification, version 0 (little-endian; opcodes in stored/records.py).
"""

from __future__ import annotations

import fcntl
import os
import struct
import zlib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import yaml
from rosbags.interfaces import Qos
from rosbags.rosbag2.metadata import dump_qos_v9

from quad_bridge.log.stored.records import (
    CHANNEL,
    CHUNK,
    CHUNK_INDEX,
    DATA_END,
    FOOTER,
    HEADER,
    MAGIC,
    MESSAGE,
    MESSAGE_INDEX,
    METADATA,
    METADATA_INDEX,
    SCHEMA,
    STATISTICS,
    SUMMARY_OFFSET,
)

CHUNK_BYTES = 1 << 20
"""A chunk is closed at this size at the latest."""
REPEAT = 100
"""Topics are declared again when the file has doubled, or grown by this many times the size of the
declarations. Otherwise one damaged chunk, the first, would leave a killed recording nameless."""
_MESSAGE = struct.Struct('<BQHIQQ')
_PREFIX = 22
"""Bytes of a message record before its data."""


@dataclass(frozen=True)
class RecordedTopic:
    """One topic of a bag, with what a reader needs to decode and replay it."""

    name: str
    kind: str
    """Message type, such as `sensor_msgs/msg/Imu`."""
    definition: str
    digest: str
    """RIHS01 hash of the type."""
    qos: tuple[Qos, ...] = ()
    key: str = ''
    """Key of its counts: the name, unless another type has that."""

    @property
    def qos_text(self) -> str:
        """The publishers' QoS as YAML, as in the file."""
        return yaml.safe_dump(dump_qos_v9(list(self.qos)), sort_keys=False).strip()


@dataclass
class FileEntry:
    """Content of one file: messages by topic, first and last receive time (ns)."""

    name: str
    counts: dict[str, int] = field(default_factory=dict)
    first_ns: int = 0
    last_ns: int = 0
    size: int = 0
    """Bytes, once the file is closed."""
    repeated: dict[str, int] = field(default_factory=dict)
    """How many of the first messages repeat those of earlier files, by topic."""

    @property
    def messages(self) -> int:
        """All topics together."""
        return sum(self.counts.values())

    def add(self, topic: str, number: int, first_ns: int, last_ns: int) -> None:
        """Count messages of one topic that have been stored."""
        self.first_ns = min(self.first_ns or first_ns, first_ns)
        self.last_ns = max(self.last_ns, last_ns)
        self.counts[topic] = self.counts.get(topic, 0) + number


def record(opcode: int, body: bytes) -> bytes:
    """Opcode, length, content."""
    return struct.pack('<BQ', opcode, len(body)) + body


def text(value: str) -> bytes:
    """Length-prefixed UTF-8."""
    data = value.encode()
    return struct.pack('<I', len(data)) + data


def text_map(values: Mapping[str, str]) -> bytes:
    """Length-prefixed map of strings."""
    body = b''.join(text(key) + text(value) for key, value in values.items())
    return struct.pack('<I', len(body)) + body


class McapFile:
    """A file open from construction to `close` or `abandon`. All methods may raise OSError."""

    def __init__(self, path: Path) -> None:
        """Create the file; FileExistsError where it exists."""
        self.path = path
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        with suppress(OSError):  # a reader looks just now, or the disk has no locks
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)  # ends with the process: files.py
        self._end = 0
        """End of the last complete record; what follows may be truncated."""
        self._schemas: dict[str, bytes] = {}
        self._channels: dict[str, tuple[int, bytes]] = {}
        self._chunk_indexes: list[bytes] = []
        self.entry = FileEntry(path.name)
        """Content of the closed chunks."""
        self._repeat_at = 0
        self.forget()
        self._append(MAGIC + record(HEADER, text('ros2') + text('quad_bridge')))

    @property
    def size(self) -> int:
        """Bytes written, with the open chunk."""
        return self._end + len(self._chunk)

    def add_topic(self, topic: RecordedTopic) -> None:
        """Declare a topic of this file before its first message."""
        if topic.kind not in self._schemas:
            coding = 'ros2msg' if topic.definition else ''  # by rosbag2, where it has found none
            coding = 'ros2idl' if topic.definition.startswith('=' * 80) else coding
            number = len(self._schemas) + 1
            body = struct.pack('<H', number) + text(topic.kind) + text(coding)
            self._schemas[topic.kind] = record(SCHEMA, body + text(topic.definition))
            self._chunk += self._schemas[topic.kind]
        channel = len(self._channels) + 1
        schema = list(self._schemas).index(topic.kind) + 1
        body = struct.pack('<HH', channel, schema) + text(topic.name) + text('cdr')
        metadata = {'offered_qos_profiles': topic.qos_text, 'topic_type_hash': topic.digest}
        self._channels[topic.key] = channel, record(CHANNEL, body + text_map(metadata))
        self._chunk += self._channels[topic.key][1]

    def write(self, topic: str, time_ns: int, data: bytes | memoryview) -> None:
        """Append one message to the open chunk."""
        channel = self._channels[topic][0]
        length = _PREFIX + len(data)
        head = _MESSAGE.pack(MESSAGE, length, channel, 0, time_ns, time_ns)
        self._index.setdefault(channel, []).append((time_ns, len(self._chunk)))
        self._chunk += head
        self._chunk += data
        if len(self._chunk) >= CHUNK_BYTES:
            self._close_chunk()

    def sync(self) -> None:
        """Close the chunk and sync; it then survives a power cut."""
        self._close_chunk()
        os.fdatasync(self._fd)

    def cut_back(self) -> None:
        """Truncate after the last complete record."""
        os.ftruncate(self._fd, self._end)
        os.lseek(self._fd, self._end, os.SEEK_SET)

    def forget(self) -> None:
        """Drop the open chunk and begin a new one."""
        self._chunk = bytearray()
        self._index: dict[int, list[tuple[int, int]]] = {}
        """Channel → (time, offset) of its messages in the chunk."""

    def close(self, metadata: str) -> None:
        """Write the open chunk, rosbag2's metadata (YAML) and the summary with indexes; sync."""
        self._close_chunk()
        content = text('rosbag2') + text_map({'serialized_metadata': metadata})
        start = self._end
        description = record(METADATA, content)
        end_of_data = record(DATA_END, struct.pack('<I', 0))
        place = struct.pack('<QQ', start, len(description)) + text('rosbag2')
        summary_start = start + len(description) + len(end_of_data)
        groups: list[tuple[int, Sequence[bytes]]] = [
            (SCHEMA, list(self._schemas.values())),
            (CHANNEL, [channel for _, channel in self._channels.values()]),
            (STATISTICS, [self._statistics()]),
            (CHUNK_INDEX, self._chunk_indexes),
            (METADATA_INDEX, [record(METADATA_INDEX, place)]),
        ]
        summary, offsets = b'', b''
        for opcode, records in groups:
            body = b''.join(records)
            if body:
                where = struct.pack('<BQQ', opcode, summary_start + len(summary), len(body))
                offsets += record(SUMMARY_OFFSET, where)
            summary += body
        footer = struct.pack('<BQ', FOOTER, 20)
        footer += struct.pack('<QQ', summary_start, summary_start + len(summary))
        ending = summary + offsets + footer
        ending += struct.pack('<I', zlib.crc32(ending))
        self._append(description + end_of_data + ending + MAGIC)
        os.fsync(self._fd)
        self.abandon()

    def abandon(self) -> None:
        """Close without index; synced chunks stay. A second call does nothing."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            os.close(fd)

    def _close_chunk(self) -> None:
        """Write the open chunk with its message index, if it has messages."""
        if not self._index:
            return
        content = bytes(self._chunk)
        tables = {channel: np.array(rows, '<u8') for channel, rows in self._index.items()}
        times = [int(t) for rows in tables.values() for t in (rows[:, 0].min(), rows[:, 0].max())]
        span = struct.pack('<QQ', min(times), max(times))
        body = span + struct.pack('<QI', len(content), zlib.crc32(content)) + text('')
        chunk = record(CHUNK, body + struct.pack('<Q', len(content)) + content)
        start, indexes, places = self._end, b'', b''
        for channel, rows in tables.items():
            places += struct.pack('<HQ', channel, start + len(chunk) + len(indexes))
            indexes += record(
                MESSAGE_INDEX, struct.pack('<HI', channel, 16 * len(rows)) + rows.tobytes()
            )
        self._append(chunk + indexes)
        entry = span + struct.pack('<QQI', start, len(chunk), len(places)) + places
        entry += struct.pack('<Q', len(indexes)) + text('')
        entry += struct.pack('<QQ', len(content), len(content))
        self._chunk_indexes.append(record(CHUNK_INDEX, entry))
        names = list(self._channels)
        for channel, rows in tables.items():
            self.entry.add(names[channel - 1], len(rows), min(times), max(times))
        self.forget()
        if self._end >= self._repeat_at:
            self._chunk += b''.join(self._schemas.values())
            self._chunk += b''.join(channel for _, channel in self._channels.values())
            self._repeat_at = self._end + min(self._end, REPEAT * len(self._chunk))

    def _statistics(self) -> bytes:
        stored = [self.entry.counts.get(name, 0) for name in self._channels]
        counts = b''.join(struct.pack('<HQ', i + 1, count) for i, count in enumerate(stored))
        head = struct.pack(
            '<QHIIIIQQI', sum(stored), len(self._schemas), len(stored), 0, 1,
            len(self._chunk_indexes), self.entry.first_ns, self.entry.last_ns, len(counts),
        )  # fmt: skip
        return record(STATISTICS, head + counts)

    def _append(self, data: bytes) -> None:
        rest = memoryview(data)
        while rest:
            rest = rest[os.write(self._fd, rest) :]
        self._end += len(data)
