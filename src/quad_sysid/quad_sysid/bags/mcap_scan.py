"""Messages of an mcap file by one pass over its records; needs neither summary nor index.

So a file that was cut off gives all that is whole in it, and one damaged record does not hide the
chunks behind it. No decoding of messages.
Source: the MCAP specification, version 0 (records, opcodes 0x01 to 0x0F; little-endian).
"""

from __future__ import annotations

import re
import struct
import sys
import zlib
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

import lz4.frame  # type: ignore[import-untyped]

if TYPE_CHECKING:
    import mmap
    from collections.abc import Iterator, Mapping

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

MAGIC = b'\x89MCAP0\r\n'
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, STATISTICS, DATA_END = 2, 3, 4, 5, 6, 0x0B, 0x0F
HIGHEST, PRIVATE = 0x0F, 0x80
"""The last opcode of the specification; from 0x80 on they are left to others."""
BATCH = 20_000
DAMAGED = (zstd.ZstdError, RuntimeError, EOFError, MemoryError)
"""What damaged content raises when it is decompressed."""
_HEAD = 9
"""Bytes of opcode and length."""
_SHAPE = rb'(.{8}).{28}(\0{4}|\x04\0{3}zstd|\x03\0{3}lz4)(.{8})'
_CHUNK_SHAPE = re.compile(_SHAPE, re.DOTALL)
"""Length of a chunk, compression, length of its content."""
_CHUNK_START = re.compile(rb'\x06(?=' + _SHAPE + rb')', re.DOTALL)
_FOOTER_SIZE = 29
"""Bytes, with opcode and length."""

Batch = dict[str, list[bytes]]
"""Topic → serialised messages in the file's order."""


@dataclass
class McapScan:
    """One pass over one file; the figures are complete once `batches` has run."""

    data: bytes | mmap.mmap
    wanted: Mapping[str, str]
    """Topic → message type; empty where any type counts."""
    foreign: Counter[tuple[str, str]] = field(default_factory=Counter)
    """(topic, type) → messages of wanted topics that are of another type."""
    cut_off: bool = False
    """The file ended inside a record, or without its footer."""
    damaged: int = 0
    """Chunks, or other records with damaged lengths before a chunk."""
    seen: int = 0
    """Messages of all topics."""
    unnamed: int = 0
    """Messages whose channel stands nowhere before."""
    _schemas: dict[int, str] = field(default_factory=dict)
    _channels: dict[int, tuple[str, str]] = field(default_factory=dict)
    """Number → topic and type."""

    @property
    def stated(self) -> int | None:
        """Messages by the statistics of a file that was closed; None without sound ones."""
        end = len(self.data) - len(MAGIC)
        foot = self.data[max(end - _FOOTER_SIZE, 0) : end]
        if len(foot) < _FOOTER_SIZE or self.data[end:] != MAGIC or foot[0] != FOOTER:
            return None
        position, _, checksum = struct.unpack_from('<QQI', foot, _HEAD)
        if checksum and zlib.crc32(self.data[position : end - 4]) != checksum:
            return None
        while 0 < position < end - _FOOTER_SIZE:
            opcode, size = struct.unpack('<BQ', self.data[position : position + _HEAD])
            if opcode == STATISTICS and size >= 8:
                return int.from_bytes(self.data[position + _HEAD : position + _HEAD + 8], 'little')
            position += _HEAD + size
        return None

    def batches(self) -> Iterator[Batch]:
        """Messages of the wanted topics, some thousand at a time."""
        position, end, finished = len(MAGIC), len(self.data), False
        batch: Batch = {}
        count = 0
        while not finished and position + _HEAD <= end:
            opcode, size = struct.unpack('<BQ', self.data[position : position + _HEAD])
            following = position + _HEAD + size
            taken = self._take(opcode, position, following, batch)
            if taken is None:
                hidden = self._next_chunk(position + 1, end)
                self.damaged += hidden is not None or opcode == CHUNK
                if hidden is None and (opcode != CHUNK or following > end):
                    break
                following = following if hidden is None else hidden
            count += taken or 0
            if count >= BATCH:
                yield batch
                batch, count = {}, 0
            position = following
            finished = opcode in (FOOTER, DATA_END) and self._next_chunk(position, end) is None
        self.cut_off = not finished
        yield batch

    def _take(self, opcode: int, position: int, following: int, batch: Batch) -> int | None:
        """Number of messages kept of one record; None where it is damaged."""
        start, end = position + _HEAD, len(self.data)
        if opcode == CHUNK or self._is_chunk(position):
            if following <= end:
                return self._chunk(self.data[start:following], batch)
            last = self._next_chunk(position + 1, end) is None
            return self._chunk(self.data[start:end], batch, cut_off=True) if last else None
        if not (0 < opcode <= HIGHEST or opcode >= PRIVATE) or following > end:
            return None
        if self._next_chunk(position + 1, following) is not None:
            return None  # a chunk begins within another record only where its length is damaged
        if opcode in (SCHEMA, CHANNEL):
            self._declare(opcode, self.data[start:following])
        return self._messages(self.data[position:following], batch) if opcode == MESSAGE else 0

    def _is_chunk(self, position: int) -> bool:
        """Whether a chunk with lengths that agree begins here, whatever its opcode says."""
        shape = _CHUNK_SHAPE.match(self.data, position + 1)
        if shape is None:
            return False
        length, name, content = shape.groups()
        size = int.from_bytes(length, 'little')
        return size == 36 + len(name) + int.from_bytes(content, 'little')

    def _next_chunk(self, position: int, end: int) -> int | None:
        """Where the next chunk begins before `end`."""
        for found in _CHUNK_START.finditer(self.data, position, end):
            if self._is_chunk(found.start()):
                return found.start()
        return None

    def _chunk(self, body: bytes, batch: Batch, *, cut_off: bool = False) -> int | None:
        """Take in one chunk: of one that is cut off what is whole, of a damaged one the names."""
        if len(body) < 36:
            return None
        checksum, name_length = struct.unpack_from('<II', body, 24)
        name = body[32 : 32 + name_length].decode(errors='replace')
        records, whole = _decompress(name, body[40 + name_length :])
        if cut_off:
            self.damaged += 1
            return self._messages(records, batch)
        if not whole or (checksum and zlib.crc32(records) != checksum):
            self._messages(records, batch, only_names=True)
            return None
        return self._messages(records, batch)

    def _messages(self, records: bytes, batch: Batch, *, only_names: bool = False) -> int:
        """Take in records one after the other; returns the number of messages kept."""
        position, end, count, seen = 0, len(records), 0, 0
        unpack = struct.Struct('<BQH').unpack_from
        topics = self._wanted()
        while position + _HEAD + 2 <= end:
            opcode, length, channel = unpack(records, position)
            start = position + _HEAD
            position = start + length
            if position > end:
                break
            if opcode == MESSAGE:
                if only_names:
                    continue
                seen += 1
                if channel in topics:
                    batch.setdefault(topics[channel], []).append(records[start + 22 : position])
                    count += 1
                else:
                    self._count(channel)
            elif opcode in (SCHEMA, CHANNEL):
                self._declare(opcode, records[start:position])
                topics = self._wanted()
        self.seen += seen
        return count

    def _wanted(self) -> dict[int, str]:
        """Channels whose messages are asked for."""
        return {
            number: topic
            for number, (topic, kind) in self._channels.items()
            if topic in self.wanted and same_type(kind, self.wanted[topic])
        }

    def _count(self, channel: int) -> None:
        """Count a message that is not kept."""
        topic, kind = self._channels.get(channel, ('', ''))
        self.unnamed += channel not in self._channels
        if topic in self.wanted:
            self.foreign[topic, kind] += 1

    def _declare(self, opcode: int, body: bytes) -> None:
        """Take in one schema or channel."""
        with suppress(struct.error):
            number, second = struct.unpack_from('<HH', body)
            name = _string(body, 2 if opcode == SCHEMA else 4)
            if opcode == SCHEMA:
                self._schemas[number] = name
            else:
                self._channels[number] = name, self._schemas.get(second, '')


def same_type(kind: str, wanted: str) -> bool:
    """Whether a message type is the wanted one; an unknown one may be."""
    return not kind or not wanted or kind.replace('/msg/', '/') == wanted.replace('/msg/', '/')


def _string(body: bytes, offset: int) -> str:
    (length,) = struct.unpack_from('<I', body, offset)
    return body[offset + 4 : offset + 4 + length].decode(errors='replace')


def _decompress(name: str, payload: bytes) -> tuple[bytes, bool]:
    """Content of a chunk as far as it can be had, and whether that is all of it."""
    if not name:
        return payload, True
    if name == 'zstd':
        try:
            return zstd.decompress(payload), True
        except DAMAGED:
            stream = zstd.ZstdDecompressor()
            return _piecewise(stream.decompress, payload), False
    if name == 'lz4':
        try:
            return lz4.frame.decompress(payload), True
        except DAMAGED:
            lz4_stream = lz4.frame.LZ4FrameDecompressor()
            return _piecewise(lz4_stream.decompress, payload), False
    return b'', False


class _Decompress(Protocol):
    def __call__(self, data: bytes, /) -> bytes: ...


def _piecewise(decompress: _Decompress, payload: bytes) -> bytes:
    """Decompress a stream up to its damage."""
    out = bytearray()
    with suppress(*DAMAGED):
        for start in range(0, len(payload), 4096):
            out += decompress(payload[start : start + 4096])
    return bytes(out)
