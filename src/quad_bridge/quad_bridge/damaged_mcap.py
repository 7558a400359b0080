"""Reads what is whole in an mcap file that was cut off: no summary, index or footer needed.

rosbags needs the summary; this pass over the records does not. Source: the MCAP specification,
version 0 (opcode u8, length u64, little-endian).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from quad_bridge.compression import ZstdDecompressor, ZstdError
from quad_bridge.errors import BadInputError

MAGIC = b'\x89MCAP0\r\n'
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, DATA_END = 0x02, 0x03, 0x04, 0x05, 0x06, 0x0F
_RECORD = struct.Struct('<BQ')
_MESSAGE = struct.Struct('<HIQQ')


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
        """Read the file. Raises BadInputError where it is empty or no mcap."""
        try:
            self._data = path.read_bytes()
        except OSError as error:
            raise BadInputError(str(path), f'cannot be read: {error.strerror}') from error
        if not self._data:
            raise BadInputError(str(path), 'is empty', remedy='nothing can be recovered')
        if not self._data.startswith(MAGIC):
            head = self._data[:8].hex()
            raise BadInputError(str(path), 'is no mcap file', f'first bytes {head}')
        self.size = len(self._data)
        self.unread = 0
        """Bytes that belong to no whole record."""
        self.complete = False
        """The end of the data section was found."""
        self._schemas: dict[int, tuple[str, str]] = {}
        self._channels: dict[int, Topic] = {}

    def messages(self) -> Iterator[Message]:
        """All whole messages in the file's order."""
        position = len(MAGIC)
        while position + _RECORD.size <= self.size:
            opcode, length = _RECORD.unpack_from(self._data, position)
            start, end = position + _RECORD.size, position + _RECORD.size + length
            if opcode in {DATA_END, FOOTER}:
                self.complete = True
                return
            body = self._data[start:end]
            if opcode == CHUNK:
                yield from self._chunk(body, length)
            elif end <= self.size:
                yield from self._record(opcode, body)
            if end > self.size:
                self.unread = self.size - start if opcode != CHUNK else self.unread
                return
            position = end
        self.unread += self.size - position

    def _chunk(self, body: bytes, length: int) -> Iterator[Message]:
        if len(body) < 32:
            self.unread += len(body)
            return
        (name_length,) = struct.unpack_from('<I', body, 28)
        packed = body[40 + name_length :]
        try:
            records = _unpacked(body[32 : 32 + name_length], packed)
        except ZstdError:
            self.unread += len(packed)
            return
        used = 0
        while used + _RECORD.size <= len(records):
            opcode, size = _RECORD.unpack_from(records, used)
            start, end = used + _RECORD.size, used + _RECORD.size + size
            if end > len(records):
                break
            yield from self._record(opcode, records[start:end])
            used = end
        if len(body) < length:
            self.unread += len(records) - used

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


def _unpacked(compression: bytes, packed: bytes) -> bytes:
    """Records of a chunk; of one that is cut off, as far as the decompressor gets."""
    if compression == b'':
        return packed
    if compression == b'zstd':
        return bytes(ZstdDecompressor().decompress(packed))
    raise ZstdError(f'unknown compression {compression!r}')
