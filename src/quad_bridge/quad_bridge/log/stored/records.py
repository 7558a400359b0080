"""Records of an mcap file: where they begin and end, and the topics that they name.

A record counts only where its content agrees with its length. scan.py handles messages and
compression.
Source: the MCAP specification, version 0 (opcode u8, length u64, little-endian).
"""

from __future__ import annotations

import mmap
import re
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

MAGIC = b'\x89MCAP0\r\n'
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA, METADATA_INDEX = range(0x09, 0x0E)
SUMMARY_OFFSET, DATA_END = 0x0E, 0x0F
PRIVATE = 0x80
"""First opcode that the specification leaves to others."""
RECORD = struct.Struct('<BQ')
MESSAGE_HEAD = struct.Struct('<HIQQ')
"""Channel, number, receive and publish time (ns) of a message, before its data."""
CHUNK_HEAD = struct.Struct('<QQQII')
"""First and last time, size of the content, its checksum, length of the compression's name."""
_FOOTER = struct.Struct('<QQI')
_CHUNK_START = rb'\x06(?=.{36}(?:\0{4}|\x04\0{3}zstd|\x03\0{3}lz4))'
_IN_CHUNKS = re.compile(_CHUNK_START + rb'|\x07(?=.{4}\0{4})|\x0f(?=\x04\0{7})', re.DOTALL)
_PLAIN = re.compile(rb'[\3\4\5](?=.{4}\0{4})|' + _IN_CHUNKS.pattern, re.DOTALL)

Data = bytes | mmap.mmap


class Topic(NamedTuple):
    """A channel with its schema."""

    name: str
    kind: str
    """Message type, such as `sensor_msgs/msg/Imu`; empty where unknown."""
    definition: str
    qos: str = ''
    """`offered_qos_profiles`, YAML as rosbag2 writes it; empty where unknown."""
    digest: str = ''
    """RIHS01 hash of the type; empty where unknown."""


@dataclass
class Names:
    """Schemas and channels by their numbers."""

    schemas: dict[int, tuple[str, str]] = field(default_factory=dict)
    """Number → (type, definition)."""
    channels: dict[int, Topic] = field(default_factory=dict)

    def take(self, opcode: int, body: bytes) -> bool:
        """Add a schema or channel record; False where its content is invalid."""
        try:
            if opcode == SCHEMA:
                name, after = _string(body, 2)
                _, after = _string(body, after)
                definition, _ = _string(body, after)
                self.schemas[struct.unpack_from('<H', body)[0]] = name, definition
            elif opcode == CHANNEL:
                number, schema = struct.unpack_from('<HH', body)
                name, after = _string(body, 4)
                _, after = _string(body, after)
                more = dict(_pairs(body, after))
                qos, digest = more.get('offered_qos_profiles', ''), more.get('topic_type_hash', '')
                self.channels[number] = Topic(name, *self.schemas[schema], qos, digest)
        except (struct.error, UnicodeDecodeError, KeyError):
            return False
        return True


def summary_of(data: Data) -> tuple[int, Names, int | None] | None:
    """Start of a closed file's summary, its names, and its number of messages.

    None where the summary is missing or damaged.
    """
    foot = len(data) - len(MAGIC) - RECORD.size - _FOOTER.size
    if foot < len(MAGIC) or data[-len(MAGIC) :] != MAGIC:
        return None
    if data[foot : foot + RECORD.size] != RECORD.pack(FOOTER, _FOOTER.size):
        return None
    start, _, checksum = _FOOTER.unpack_from(data, foot + RECORD.size)
    start = start or foot  # some write none
    if checksum and zlib.crc32(data[start : len(data) - len(MAGIC) - 4]) != checksum:
        return None
    names, messages, position = Names(), None, start
    while len(MAGIC) <= position < foot:
        end = end_of(data, position, foot)
        if end is None:
            return None
        opcode, body = data[position], data[position + RECORD.size : end]
        if opcode == STATISTICS:
            (messages,) = struct.unpack_from('<Q', body)
        names.take(opcode, body)
        position = end
    return (start, names, messages) if position == foot else None


def end_of(data: Data, position: int, stop: int) -> int | None:
    """End of the record at `position`; None where its content disagrees with its length."""
    if position + RECORD.size > stop:
        return None
    opcode, length = RECORD.unpack_from(data, position)
    start = position + RECORD.size
    if start + length > stop:
        return None
    try:
        sound = opcode >= PRIVATE or (opcode in _LENGTHS and _LENGTHS[opcode](data, start, length))
    except (struct.error, IndexError):
        return None
    return start + length if sound else None


def next_record(data: Data, position: int, stop: int, *, plain: bool) -> int | None:
    """Start of the next recognisable record; None where there is none.

    `plain`: the file has messages outside of chunks, which are sought too.
    """
    for match in (_PLAIN if plain else _IN_CHUNKS).finditer(data, position, stop):
        start = match.start()
        end = end_of(data, start, stop)
        if end is None:
            continue
        if data[start] in {CHUNK, MESSAGE_INDEX} or end == stop or end_of(data, end, stop):
            return start
    return None


def _string(body: bytes, offset: int) -> tuple[str, int]:
    (length,) = struct.unpack_from('<I', body, offset)
    end = offset + 4 + length
    if end > len(body):
        raise struct.error('string runs over the end of its record')
    return body[offset + 4 : end].decode(), end


def _pairs(body: bytes, offset: int) -> Iterator[tuple[str, str]]:
    """Content of a map of strings."""
    (length,) = struct.unpack_from('<I', body, offset)
    end, offset = offset + 4 + length, offset + 4
    while offset < end:
        key, offset = _string(body, offset)
        value, offset = _string(body, offset)
        yield key, value


def _made_of(parts: str) -> Callable[[Data, int, int], bool]:
    """Check of a record of these parts: bytes by number, `s` and `l` counted in 32 and 64 bits."""

    def check(data: Data, start: int, length: int) -> bool:
        place = start
        for part in parts.split():
            if part in 'sl':
                (count,) = struct.unpack_from('<I' if part == 's' else '<Q', data, place)
                place += (4 if part == 's' else 8) + count
            else:
                place += int(part)
            if place > start + length:
                return False
        return place == start + length

    return check


_LENGTHS: dict[int, Callable[[Data, int, int], bool]] = {
    HEADER: _made_of('s s'),
    FOOTER: _made_of('20'),
    SCHEMA: _made_of('2 s s s'),
    CHANNEL: _made_of('4 s s s'),
    MESSAGE: lambda _data, _start, length: length >= MESSAGE_HEAD.size,
    CHUNK: _made_of('28 s l'),
    MESSAGE_INDEX: _made_of('2 s'),
    CHUNK_INDEX: _made_of('32 s 8 s 16'),
    ATTACHMENT: _made_of('16 s s l 4'),
    ATTACHMENT_INDEX: _made_of('40 s s'),
    STATISTICS: _made_of('42 s'),
    METADATA: _made_of('s s'),
    METADATA_INDEX: _made_of('16 s'),
    SUMMARY_OFFSET: _made_of('17'),
    DATA_END: _made_of('4'),
}
"""Whether a record's content agrees with its length, by opcode."""
