"""One mcap file being written: chunks with checksum and index, each safe on the disk once synced.

Not for reading (damaged_mcap.py), knows no bag around it (bag_writer.py). After a write that
failed half-way the file is cut back to its last whole record, so that it can still be closed.
Source: the MCAP specification, version 0 (little-endian; opcodes below).
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from quad_bridge.bag_metadata import FileEntry, RecordedTopic
from quad_bridge.compression import COMPRESSORS

MAGIC = b'\x89MCAP0\r\n'
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = 0x0B, 0x0C, 0x0D, 0x0E, 0x0F
CHUNK_BYTES = 1 << 20
"""A chunk is closed at this size at the latest."""
REPEAT = 100
"""Topics are declared again when the file has doubled, and at the latest when it has grown by so
many times what that takes: else one damaged chunk, the first, would leave all others of a killed
recording without names."""
_MESSAGE = struct.Struct('<BQHIQQ')
_PREFIX = 22
"""Bytes of a message record before its data."""


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
    """Open from construction to `close` or `abandon`. All methods may raise OSError."""

    def __init__(self, path: Path, compression: str = 'none') -> None:
        """Create the file; FileExistsError where there is one."""
        self.path = path
        self._name = '' if compression == 'none' else compression
        self._compress = COMPRESSORS[compression]
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        self._end = 0
        """Where the last whole record ends: what is beyond it may be cut off."""
        self._schemas: dict[str, bytes] = {}
        self._channels: dict[str, tuple[int, bytes]] = {}
        self._chunk_indexes: list[bytes] = []
        self.entry = FileEntry(path.name)
        """What closed chunks hold."""
        self._repeat_at = 0
        self._begin_chunk()
        self._append(MAGIC + record(HEADER, text('ros2') + text('quad_bridge')))

    @property
    def size(self) -> int:
        """Bytes on their way to the disk, the open chunk included."""
        return self._end + len(self._chunk)

    @property
    def pending(self) -> int:
        """Messages of the open chunk: those that a kill would lose."""
        return sum(map(len, self._index.values()))

    def add_topic(self, topic: RecordedTopic) -> None:
        """Declare a topic of this file before its first message."""
        if topic.kind not in self._schemas:
            coding = 'ros2idl' if topic.definition.startswith('=' * 80) else 'ros2msg'
            number = len(self._schemas) + 1
            body = struct.pack('<H', number) + text(topic.kind) + text(coding)
            self._schemas[topic.kind] = record(SCHEMA, body + text(topic.definition))
            self._chunk += self._schemas[topic.kind]
        channel = len(self._channels) + 1
        schema = list(self._schemas).index(topic.kind) + 1
        body = struct.pack('<HH', channel, schema) + text(topic.name) + text('cdr')
        body += text_map(
            {
                'offered_qos_profiles': topic.qos_text,
                'topic_type_hash': topic.digest,
            }
        )
        self._channels[topic.label] = channel, record(CHANNEL, body)
        self._chunk += self._channels[topic.label][1]

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
        """Close the chunk and wait until it is on the disk: from here it survives a power cut."""
        self._close_chunk()
        os.fdatasync(self._fd)

    def cut_back(self) -> None:
        """Remove what a failed write has left behind the last whole record."""
        os.ftruncate(self._fd, self._end)
        os.lseek(self._fd, self._end, os.SEEK_SET)

    def forget(self) -> None:
        """Drop the messages of the open chunk."""
        self._begin_chunk()

    def close(self, metadata: str) -> None:
        """Write the rest, rosbag2's metadata (YAML), the summary with all indexes; sync."""
        self._close_chunk()
        content = text('rosbag2') + text_map({'serialized_metadata': metadata})
        start = self._end
        described = record(METADATA, content)
        end_of_data = record(DATA_END, struct.pack('<I', 0))
        place = struct.pack('<QQ', start, len(described)) + text('rosbag2')
        summary_start = start + len(described) + len(end_of_data)
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
        whole = summary + offsets + footer
        whole += struct.pack('<I', zlib.crc32(whole))
        self._append(described + end_of_data + whole + MAGIC)
        os.fsync(self._fd)
        self.abandon()

    def abandon(self) -> None:
        """Close without index; what was synced stays. A second time does nothing."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            os.close(fd)

    def _begin_chunk(self) -> None:
        self._chunk = bytearray()
        self._index: dict[int, list[tuple[int, int]]] = {}
        """Channel to (time, offset) of its messages in the chunk."""

    def _close_chunk(self) -> None:
        """Write the open chunk with its message index; without messages nothing."""
        if not self._index:
            return
        content = bytes(self._chunk)
        packed = self._compress(content)
        tables = {channel: np.array(rows, '<u8') for channel, rows in self._index.items()}
        times = [int(t) for rows in tables.values() for t in (rows[:, 0].min(), rows[:, 0].max())]
        span = struct.pack('<QQ', min(times), max(times))
        body = span + struct.pack('<QI', len(content), zlib.crc32(content))
        chunk = record(CHUNK, body + text(self._name) + struct.pack('<Q', len(packed)) + packed)
        start, indexes, places = self._end, b'', b''
        for channel, rows in tables.items():
            places += struct.pack('<HQ', channel, start + len(chunk) + len(indexes))
            indexes += record(
                MESSAGE_INDEX, struct.pack('<HI', channel, 16 * len(rows)) + rows.tobytes()
            )
        self._append(chunk + indexes)
        entry = span + struct.pack('<QQI', start, len(chunk), len(places)) + places
        entry += struct.pack('<Q', len(indexes)) + text(self._name)
        entry += struct.pack('<QQ', len(packed), len(content))
        self._chunk_indexes.append(record(CHUNK_INDEX, entry))
        names = list(self._channels)
        for channel, rows in tables.items():
            self.entry.add(names[channel - 1], len(rows), min(times), max(times))
        self._begin_chunk()
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
