"""The intact messages of an mcap file, damaged or not, in one pass over its records.

A chunk counts if its checksum is right; any other record counts if its content agrees with its
length and another record follows it. Otherwise the next record is searched byte by byte, so that
a wrong length hides nothing. Neither summary nor index is needed. Messages are not decoded here.
"""

from __future__ import annotations

import struct
import sys
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import NamedTuple

import lz4.frame  # type: ignore[import-untyped]

from .records import (
    CHANNEL,
    CHUNK,
    CHUNK_HEAD,
    DATA_END,
    FOOTER,
    MAGIC,
    MESSAGE,
    MESSAGE_HEAD,
    MESSAGE_INDEX,
    PRIVATE,
    RECORD,
    SCHEMA,
    Data,
    Names,
    Topic,
    end_of,
    next_record,
    summary_of,
)

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

BATCH = 20_000
"""Messages per batch."""
UNPACK_ERRORS = (zstd.ZstdError, RuntimeError, EOFError, MemoryError)
"""Errors that damaged content raises."""
_UNPACK: dict[bytes, Callable[[bytes], bytes]] = {
    b'': bytes,
    b'zstd': zstd.decompress,
    b'lz4': lz4.frame.decompress,
}
"""Decompressors by the name of the compression in MCAP."""
_UNPACK_PART: dict[bytes, Callable[[bytes], bytes]] = {
    b'': bytes,
    b'zstd': lambda compressed: zstd.ZstdDecompressor().decompress(compressed),
    b'lz4': lambda compressed: lz4.frame.LZ4FrameDecompressor().decompress(compressed),
}
"""Decompressors for content whose end is missing."""


class Message(NamedTuple):
    """One serialised message."""

    topic: Topic
    time_ns: int
    """Receive time, ns."""
    data: bytes


class McapScan:
    """One pass over a file, by `messages` or `batches`; the figures are valid afterwards."""

    def __init__(self, data: Data) -> None:
        """Take a file's bytes, which begin with `MAGIC`; they must stay open for the pass."""
        self.data = data
        self.returned = 0
        """Messages returned, of all topics."""
        self.stated: int | None = None
        """Messages by the statistics of a file that was closed; None without them."""
        self.lost = 0
        """Messages in the file that were not returned; a lower bound unless it was closed."""
        self.unread = 0
        """Bytes outside of intact records."""
        self.bad_chunks = 0
        """Chunks with a wrong checksum or incomplete content."""
        self.unchecked = 0
        """Messages of a chunk that is cut off, which its checksum cannot verify."""
        self.unnamed = 0
        """Messages of an unknown channel."""
        self.ended = False
        """The end of the data was found."""
        self.closed = False
        """The summary behind the data is whole."""
        self._names = Names()
        self._others: Counter[int] = Counter()
        """Messages that `batches` was not asked for, by channel."""
        self._plain = self._scanned_channels = False
        """The file holds its messages without chunks. Names were sought in all of it."""

    @property
    def complete(self) -> bool:
        """Whether all data were read, nothing was left out, and the summary agrees."""
        return self.closed and not (self.lost or self.unread or self.bad_chunks)

    @property
    def others(self) -> Counter[tuple[str, str]]:
        """Messages that `batches` was not asked for, by topic and type."""
        counts: Counter[tuple[str, str]] = Counter()
        for channel, count in self._others.items():
            topic = self._names.channels.get(channel)
            if topic is not None:
                counts[topic.name, topic.kind] += count
        return counts

    def messages(self) -> Iterator[Message]:
        """All intact messages in the file's order."""
        for content in self.contents():
            self.unread += len(content)
            for opcode, body in _split(content):
                self.unread -= RECORD.size + len(body)
                if opcode == MESSAGE:
                    channel, _, time_ns, _ = MESSAGE_HEAD.unpack_from(body)
                    topic = self._named(channel)
                    self.unnamed += topic is None
                    self.returned += topic is not None
                    if topic is not None:
                        yield Message(topic, time_ns, body[MESSAGE_HEAD.size :])
                elif not self._names.take(opcode, body):
                    self.unread += len(body)
        self.lost = self._count_lost()

    def batches(self, select: Callable[[Topic], bool]) -> Iterator[dict[str, list[bytes]]]:
        """Data of the wanted topics' messages, by topic, in batches."""
        unpack, begin_of = struct.Struct('<BQH').unpack_from, RECORD.size + MESSAGE_HEAD.size
        batch: dict[str, list[bytes]] = {}
        sinks: dict[int, list[bytes]] = {}
        for content in self.contents():
            position, size = 0, len(content)
            end = size - RECORD.size - 2
            while position < end:
                opcode, length, channel = unpack(content, position)
                begin, position = position, position + RECORD.size + length
                if position > size:  # of a chunk without a checksum
                    break
                if opcode == MESSAGE:
                    if channel in sinks:
                        sinks[channel].append(content[begin + begin_of : position])
                        continue
                    topic = self._named(channel)
                    if topic is not None and select(topic):
                        sinks[channel] = batch.setdefault(topic.name, [])
                        sinks[channel].append(content[begin + begin_of : position])
                    else:
                        self.unnamed += topic is None
                        self._others[channel] += 1
                elif opcode in (SCHEMA, CHANNEL):
                    self._names.take(opcode, content[begin + RECORD.size : position])
                    sinks.clear()
            count = sum(map(len, batch.values()))
            if count >= BATCH:
                self.returned += count
                yield batch
                batch = {}
                sinks.clear()
        yield batch
        self.returned += sum(map(len, batch.values())) + self._others.total() - self.unnamed
        self.lost = self._count_lost()

    def contents(self) -> Iterator[bytes]:
        """Intact records in groups: the content of a chunk, or a record outside of one."""
        data, stop = self.data, len(self.data)
        summary = summary_of(data)
        if summary is not None:
            stop, self._names, self.stated = summary
        before = position = len(MAGIC)
        self._plain = not self._chunked(stop)
        while position < stop:
            if self.ended and next_record(data, position, stop, plain=False) is None:
                break  # what follows is a summary that is damaged
            end, content = self._record(position, stop)
            if end is None:
                # the record before may be too long: the next one may begin in it
                end = self._next(position if self._plain else before, position, stop)
                if end == len(data) and data[position] == CHUNK:
                    content = self._cut_off(position)
                self.unread += max(end - position, 0)
            before, position = position, end
            if content:
                yield content
        self.closed = summary is not None
        self.ended = self.ended or self.closed

    def _chunked(self, stop: int) -> bool:
        """Whether the messages of the file are in chunks."""
        header = end_of(self.data, len(MAGIC), stop)
        second = next_record(self.data, len(MAGIC), stop, plain=False)
        starts = [offset for offset in (header, second) if offset is not None and offset < stop]
        return any(self.data[offset] in {CHUNK, MESSAGE_INDEX} for offset in starts)

    def _next(self, before: int, position: int, stop: int) -> int:
        """Start of the record that follows the one before, but not at `position`; or `stop`."""
        start = next_record(self.data, before + 1, stop, plain=self._plain)
        if start == position:
            start = next_record(self.data, position + 1, stop, plain=self._plain)
        return stop if start is None else start

    def _record(self, position: int, stop: int) -> tuple[int | None, bytes]:
        """End of the record here, None where there is no intact one, and what it adds."""
        data, opcode = self.data, self.data[position]
        end = end_of(data, position, stop)
        is_whole = end is not None and (
            end == stop or data[end] == CHUNK or end_of(data, end, stop) is not None
        )
        if opcode == CHUNK:
            content = None if end is None else _content(data, position, end, unchecked=is_whole)
            self.bad_chunks += content is None
            return (None, b'') if content is None else (end, content)
        if end is None or not is_whole or (opcode == MESSAGE and not self._plain):
            return None, b''
        self.ended = self.ended or opcode in {DATA_END, FOOTER}
        self.unread += (opcode >= PRIVATE) * (end - position)  # it may have been a chunk
        # behind the end only the checksum of the summary makes its names trustworthy
        counts = opcode == MESSAGE or (opcode in {SCHEMA, CHANNEL} and not self.ended)
        return end, data[position:end] if counts else b''

    def _cut_off(self, position: int) -> bytes:
        """Whole messages of the last chunk, if its end is missing or was never written."""
        name, compressed = _compressed(self.data, position, len(self.data))
        body, content = compressed.rstrip(b'\0'), b''
        present = len(self.data) - position - RECORD.size - (len(compressed) - len(body))
        if not body or RECORD.unpack_from(self.data, position)[1] <= present:
            return b''  # it is all there, and damaged
        with suppress(*UNPACK_ERRORS, KeyError):
            content = bytes(_UNPACK_PART[name](body))
        *_, checksum, _ = CHUNK_HEAD.unpack_from(self.data, position + RECORD.size)
        if not checksum or zlib.crc32(content) != checksum:  # else the compression's end is cut
            self.unchecked = sum(opcode == MESSAGE for opcode, _ in _split(content))
        return content

    def _named(self, channel: int) -> Topic | None:
        """The channel, sought in the rest of the file where no record so far names it."""
        if channel not in self._names.channels and not self._scanned_channels:
            self._scanned_channels = True
            scan = McapScan(self.data)
            for content in scan.contents():
                for opcode, body in _split(content):
                    scan._names.take(opcode, body)
            self._names.channels = {**scan._names.channels, **self._names.channels}
        return self._names.channels.get(channel)

    def _count_lost(self) -> int:
        return self.unnamed if self.stated is None else max(self.stated - self.returned, 0)


def _compressed(data: Data, position: int, end: int) -> tuple[bytes, bytes]:
    """Compression's name and compressed content of a chunk."""
    start = position + RECORD.size + CHUNK_HEAD.size
    if start > end:
        return b'', b''
    content = start + CHUNK_HEAD.unpack_from(data, position + RECORD.size)[-1]
    return data[start:content], data[content + 8 : end]


def _content(data: Data, position: int, end: int, *, unchecked: bool) -> bytes | None:
    """The records of a chunk, None where they are damaged; `unchecked`: without a checksum too."""
    *_, checksum, _ = CHUNK_HEAD.unpack_from(data, position + RECORD.size)
    name, compressed = _compressed(data, position, end)
    if checksum or unchecked:
        with suppress(*UNPACK_ERRORS, KeyError):
            content = bytes(_UNPACK[name](compressed))
            return content if not checksum or zlib.crc32(content) == checksum else None
    return None


def _split(content: bytes) -> Iterator[tuple[int, bytes]]:
    """Opcode and content of a chunk's complete records."""
    position = 0
    while position + RECORD.size <= len(content):
        opcode, length = RECORD.unpack_from(content, position)
        start, position = position + RECORD.size, position + RECORD.size + length
        known = opcode in {SCHEMA, CHANNEL} or opcode >= PRIVATE
        known = known or (opcode == MESSAGE and length >= MESSAGE_HEAD.size)
        if not known or position > len(content):
            return
        yield opcode, content[start:position]
