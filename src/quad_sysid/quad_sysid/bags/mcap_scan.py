"""Messages of an mcap file by one pass over its records; needs neither summary nor index.

So a file that was cut off gives all that is whole in it. No decoding of messages.
Source: the MCAP specification, version 0 (records, opcodes 0x01 to 0x0F; little-endian).
"""

from __future__ import annotations

import struct
import sys
import zlib
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

import lz4.frame  # type: ignore[import-untyped]

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

MAGIC = b'\x89MCAP0\r\n'
SCHEMA, CHANNEL, MESSAGE, CHUNK, DATA_END, FOOTER = 0x03, 0x04, 0x05, 0x06, 0x0F, 0x02
BATCH = 20_000

Batch = dict[str, list[bytes]]
"""Topic → serialised messages in the file's order."""


class Buffer(Protocol):
    """Bytes, or a mapped file."""

    def __getitem__(self, index: slice, /) -> bytes: ...

    def __len__(self) -> int: ...


@dataclass
class McapScan:
    """One pass over one file; `types` fills up while `batches` runs."""

    data: Buffer
    topics: Collection[str]
    types: dict[str, str] = field(default_factory=dict)
    """Topic → message type, of all channels seen."""
    cut_off: bool = False
    """The file ended inside a record, or without its footer."""
    damaged_chunks: int = 0
    _schemas: dict[int, str] = field(default_factory=dict)
    _channels: dict[int, str] = field(default_factory=dict)

    def batches(self) -> Iterator[Batch]:
        """Messages of the wanted topics, some thousand at a time."""
        position, end, finished = len(MAGIC), len(self.data), False
        batch: Batch = {}
        count = 0
        while not finished and position + 9 <= end:
            opcode, size = struct.unpack('<BQ', self.data[position : position + 9])
            start, position = position + 9, position + 9 + size
            if opcode == CHUNK:
                count += self._chunk(self.data[start : min(position, end)], size, batch)
            elif position > end:
                break
            elif opcode in (SCHEMA, CHANNEL, MESSAGE):
                count += self._record(opcode, self.data[start:position], batch)
            if count >= BATCH:
                yield batch
                batch, count = {}, 0
            finished = opcode in (FOOTER, DATA_END)
        self.cut_off = not finished
        yield batch

    def _chunk(self, body: bytes, size: int, batch: Batch) -> int:
        """Take in one chunk and return the number of messages kept.

        Of one that is cut off what is whole counts, of one whose checksum fails only the names.
        """
        if len(body) < 36:
            self.damaged_chunks += 1
            return 0
        checksum, name_length = struct.unpack_from('<II', body, 24)
        name = body[32 : 32 + name_length].decode(errors='replace')
        payload = body[40 + name_length :]
        records, whole = _decompress(name, payload)
        complete = whole and len(body) == size
        sound = not complete or not checksum or zlib.crc32(records) == checksum
        if not complete or not sound:
            self.damaged_chunks += 1
        position, end, count = 0, len(records), 0
        wanted = self._wanted() if sound else set()
        unpack = struct.Struct('<BQH').unpack_from
        while position + 11 <= end:
            opcode, length, channel = unpack(records, position)
            start = position + 9
            position = start + length
            if position > end:
                break
            if opcode == MESSAGE:
                if channel in wanted:
                    batch.setdefault(self._channels[channel], []).append(
                        records[start + 22 : position]
                    )
                    count += 1
            elif opcode in (SCHEMA, CHANNEL):
                self._record(opcode, records[start:position], batch)
                wanted = self._wanted() if sound else set()
        return count

    def _wanted(self) -> set[int]:
        """Channels whose messages are asked for."""
        return {key for key, topic in self._channels.items() if topic in self.topics}

    def _record(self, opcode: int, body: bytes, batch: Batch) -> int:
        """Take in one schema, channel or message; returns the number of messages kept."""
        if opcode == MESSAGE:
            topic = self._channels.get(int.from_bytes(body[:2], 'little'), '')
            if topic not in self.topics:
                return 0
            batch.setdefault(topic, []).append(body[22:])
            return 1
        try:
            number, second = struct.unpack_from('<HH', body)
            name = _string(body, 2 if opcode == SCHEMA else 4)
        except struct.error:
            return 0
        if opcode == SCHEMA:
            self._schemas[number] = name
        else:
            self._channels[number] = name
            self.types[name] = self._schemas.get(second, '')
        return 0


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
        except zstd.ZstdError:
            stream = zstd.ZstdDecompressor()
            return _piecewise(stream.decompress, payload, zstd.ZstdError), False
    if name == 'lz4':
        try:
            return lz4.frame.decompress(payload), True
        except RuntimeError:
            lz4_stream = lz4.frame.LZ4FrameDecompressor()
            return _piecewise(lz4_stream.decompress, payload, RuntimeError), False
    return b'', False


class _Decompress(Protocol):
    def __call__(self, data: bytes, /) -> bytes: ...


def _piecewise(decompress: _Decompress, payload: bytes, error: type[Exception]) -> bytes:
    """Decompress a stream up to its damage."""
    out = bytearray()
    with suppress(error, EOFError):
        for start in range(0, len(payload), 4096):
            out += decompress(payload[start : start + 4096])
    return bytes(out)
