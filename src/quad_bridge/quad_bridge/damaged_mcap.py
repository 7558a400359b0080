"""Reads what is whole in an mcap file that was cut off: no summary, index or footer needed.

rosbags needs the summary; this pass over the records does not. A chunk whose checksum fails is
left out; behind nonsense the next chunk is searched. Source: the MCAP specification, version 0
(opcode u8, length u64, little-endian).
"""

from __future__ import annotations

import mmap
import re
import struct
import zlib
from collections.abc import Collection, Generator, Iterator
from dataclasses import dataclass
from pathlib import Path

from quad_bridge.compression import decompress
from quad_bridge.errors import BadInputError

MAGIC = b'\x89MCAP0\r\n'
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, DATA_END = 0x02, 0x03, 0x04, 0x05, 0x06, 0x0F
HIGHEST = 0x0F
"""The last opcode of the specification; 0x80 and above are left to others."""
_RECORD = struct.Struct('<BQ')
_MESSAGE = struct.Struct('<HIQQ')
_CHUNK = struct.Struct('<QQQII')
"""Start, end, uncompressed size, checksum, length of the compression's name."""
_CHUNK_HEAD = re.compile(rb'\x06.{36}(?:\0\0\0\0|\x04\0\0\0zstd|\x03\0\0\0lz4)', re.DOTALL)


@dataclass(frozen=True)
class Topic:
    """A channel with its schema."""

    name: str
    kind: str
    definition: str
    qos: str
    """`offered_qos_profiles`, YAML as rosbag2 writes it; empty where unknown."""


@dataclass(frozen=True)
class Message:
    """One serialised message."""

    topic: Topic
    time_ns: int
    data: bytes


class DamagedMcap:
    """One file; `messages` may be run once, the figures hold afterwards."""

    def __init__(self, path: Path) -> None:
        """Look at the file. Raises BadInputError where it is empty or no mcap."""
        try:
            self.size = path.stat().st_size
            with path.open('rb') as file:
                head = file.read(len(MAGIC))
        except OSError as error:
            raise BadInputError(str(path), f'cannot be read: {error.strerror}') from error
        if not self.size:
            raise BadInputError(str(path), 'is empty', remedy='nothing can be recovered')
        if head != MAGIC:
            raise BadInputError(str(path), 'is no mcap file', f'first bytes {head.hex()}')
        self._path = path
        self.unread = 0
        """Bytes that belong to no whole record."""
        self.bad_chunks = 0
        """Chunks that fail their checksum or cannot be decompressed to their end."""
        self.complete = False
        """The end of the data section was found."""
        self._schemas: dict[int, tuple[str, str]] = {}
        self._channels: dict[int, Topic] = {}

    def messages(self) -> Iterator[Message]:
        """All whole messages in the file's order."""
        with (
            self._path.open('rb') as file,
            mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data,
        ):
            yield from self._pass(data)

    def _pass(self, data: mmap.mmap) -> Iterator[Message]:
        position = len(MAGIC)
        while position + _RECORD.size <= self.size:
            opcode, length = _RECORD.unpack_from(data, position)
            start, end = position + _RECORD.size, position + _RECORD.size + length
            if opcode in {DATA_END, FOOTER} and end <= self.size:
                self.complete = True
                return
            if end > self.size or not (0 < opcode <= HIGHEST or opcode >= 0x80):
                found = self._next_chunk(data, position + 1)
                stop = self.size if found is None else found
                if opcode == CHUNK:
                    yield from self._chunk(data[start:stop])
                else:
                    self.unread += stop - position
                position = stop
                continue
            if opcode == CHUNK:
                yield from self._chunk(data[start:end])
            elif opcode in {SCHEMA, CHANNEL, MESSAGE}:
                yield from self._record(opcode, data[start:end])
            position = end
        self.unread += self.size - position

    def _next_chunk(self, data: mmap.mmap, position: int) -> int | None:
        """Where the next chunk begins whose lengths agree with each other."""
        for found in _CHUNK_HEAD.finditer(data, position):
            (length,) = struct.unpack_from('<Q', data, found.start() + 1)
            if found.end() + 8 > self.size or length > self.size:
                continue
            (packed,) = struct.unpack_from('<Q', data, found.end())
            if found.start() + _RECORD.size + length == found.end() + 8 + packed:
                return found.start()
        return None

    def _chunk(self, body: bytes) -> Iterator[Message]:
        """Messages of a chunk; of one that is cut off, as far as it goes."""
        if len(body) < _CHUNK.size + 16:
            self.unread += len(body)
            return
        *_, checksum, name_length = _CHUNK.unpack_from(body)
        begin = _CHUNK.size + min(name_length, 4) + 8
        name = body[_CHUNK.size : begin - 8].decode(errors='replace')
        (length,) = struct.unpack_from('<Q', body, begin - 8)
        content = body[begin : begin + length]
        records, whole = decompress(name, content)
        if len(content) == length and checksum and zlib.crc32(records) != checksum:
            self.bad_chunks += 1
            self.unread += len(body)
            for _ in self._records(records, without={MESSAGE}):  # the names may serve later
                pass
            return
        if not whole or len(content) < length:
            self.bad_chunks += 1
        used = yield from self._records(records)
        self.unread += len(records) - used if whole or used else len(body)

    def _records(
        self, records: bytes, without: Collection[int] = ()
    ) -> Generator[Message, None, int]:
        """Messages of a chunk's content; returns how many bytes of it are whole records."""
        used = 0
        while used + _RECORD.size <= len(records):
            opcode, size = _RECORD.unpack_from(records, used)
            start, end = used + _RECORD.size, used + _RECORD.size + size
            if end > len(records):
                break
            if opcode not in without:
                yield from self._record(opcode, records[start:end])
            used = end
        return used

    def _record(self, opcode: int, body: bytes) -> Iterator[Message]:
        """Take in a schema or channel, hand out a message; a record of nonsense is left out."""
        try:
            if opcode == MESSAGE:
                channel, _, log_ns, _ = _MESSAGE.unpack_from(body)
                if channel in self._channels:
                    yield Message(self._channels[channel], log_ns, body[_MESSAGE.size :])
            elif opcode == SCHEMA:
                name, after = _string(body, 2)
                _, after = _string(body, after)
                definition, _ = _string(body, after)
                self._schemas[struct.unpack_from('<H', body)[0]] = name, definition
            elif opcode == CHANNEL:
                self._channel(body)
        except (struct.error, UnicodeDecodeError, KeyError):
            self.unread += len(body)

    def _channel(self, body: bytes) -> None:
        number, schema = struct.unpack_from('<HH', body)
        name, after = _string(body, 4)
        _, after = _string(body, after)
        (length,) = struct.unpack_from('<I', body, after)
        end, after = after + 4 + length, after + 4
        metadata = {}
        while after < end:
            key, after = _string(body, after)
            metadata[key], after = _string(body, after)
        kind, definition = self._schemas[schema]
        qos = metadata.get('offered_qos_profiles', '')
        self._channels[number] = Topic(name, kind, definition, qos)


def _string(body: bytes, offset: int) -> tuple[str, int]:
    (length,) = struct.unpack_from('<I', body, offset)
    end = offset + 4 + length
    if end > len(body):
        raise struct.error('string runs over the end of its record')
    return body[offset + 4 : end].decode(), end
