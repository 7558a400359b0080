"""The intact messages of an mcap file, damaged or not, in one pass over its records.

A chunk is recognised by its shape, whatever its opcode, and counts if its checksum is right; any
other record counts if its content agrees with its length. After damage the next record is sought,
so that a wrong length hides nothing. Neither summary nor index is needed. Messages are not decoded
here.
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
import numpy as np

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
    chunk_ends,
    chunk_follows,
    end_of,
    looks_chunked,
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
_LONGEST_MESSAGE = 1 << 30
"""Bytes."""
_ZEROS = 64
"""Zeros at the end of a file that indicate blocks that were never written."""
_CODECS = {
    b'zstd': (zstd.decompress, zstd.ZstdDecompressor),
    b'lz4': (lz4.frame.decompress, lz4.frame.LZ4FrameDecompressor),
}


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
        self.found = 0
        """Messages returned, of all topics."""
        self.stated: int | None = None
        """Messages by the statistics of a file that was closed; None without them."""
        self.lost = 0
        """Messages in the file that were not returned; a lower bound unless it was closed."""
        self.unread = 0
        """Bytes outside of intact records."""
        self.bad_chunks = 0
        """Chunks with a wrong checksum or incomplete content."""
        self.mended = 0
        """Chunks with a damaged opcode or length but intact content."""
        self.unchecked = 0
        """Messages of a chunk that is cut off, which its checksum cannot verify."""
        self.unnamed = 0
        """Messages of an unknown channel."""
        self.doubtful_names: set[str] = set()
        """Topics whose channel is in a damaged chunk only."""
        self.ended = False
        """The end of the data was found."""
        self.closed = False
        """The summary behind the data is whole."""
        self._names, self._doubtful = Names(), Names()
        self._missed: set[int] = set()
        """Times in the indexes of chunks that were not read."""
        self._others: Counter[int] = Counter()
        """Messages that `batches` was not asked for, by channel."""
        self._plain = self._looked_ahead = self._behind_chunk = False
        """The file holds its messages without chunks. Names were searched in all of it. Nothing
        but its indexes has come since the last sound chunk."""

    @property
    def complete(self) -> bool:
        """Whether all data were read, nothing was left out, and the summary agrees."""
        return self.closed and not (self.lost or self.unread or self.bad_chunks)

    @property
    def others(self) -> Counter[tuple[str, str]]:
        """Messages that `batches` was not asked for, by topic and type."""
        found: Counter[tuple[str, str]] = Counter()
        for channel, count in self._others.items():
            topic = self._names.channels.get(channel)
            if topic is not None:
                found[topic.name, topic.kind] += count
        return found

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
                    self.found += topic is not None
                    if topic is not None:
                        yield Message(topic, time_ns, body[MESSAGE_HEAD.size :])
                elif not self._names.take(opcode, body):
                    self.unread += len(body)
        self.lost = self._count_lost()

    def batches(self, wanted: Callable[[Topic], bool]) -> Iterator[dict[str, list[bytes]]]:
        """Data of the wanted topics' messages, by topic, in batches."""
        unpack, begin_of = struct.Struct('<BQH').unpack_from, RECORD.size + MESSAGE_HEAD.size
        batch: dict[str, list[bytes]] = {}
        sinks: dict[int, list[bytes]] = {}
        for content in self.contents():
            position, whole = 0, len(content)
            end = whole - RECORD.size - 2
            while position < end:
                opcode, length, channel = unpack(content, position)
                begin, position = position, position + RECORD.size + length
                if position > whole:  # of a chunk without a checksum
                    break
                if opcode == MESSAGE:
                    if channel in sinks:
                        sinks[channel].append(content[begin + begin_of : position])
                        continue
                    topic = self._named(channel)
                    if topic is not None and wanted(topic):
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
                self.found += count
                yield batch
                batch = {}
                sinks.clear()
        yield batch
        self.found += sum(map(len, batch.values())) + self._others.total() - self.unnamed
        self.lost = self._count_lost()

    def contents(self, *, behind_end: bool = False) -> Iterator[bytes]:
        """Intact records in groups: the content of a chunk, or a record outside of one.

        `behind_end`: the part after the end of the data is read too, for its names.
        """
        data, stop = self.data, len(self.data)
        summary = summary_of(data)
        if summary is not None:
            stop, self._names, self.stated = summary
        self._plain = not chunk_follows(data, len(MAGIC), stop)
        before = position = len(MAGIC)
        while position < stop and (behind_end or not self.ended):
            chunk = self._chunk(position, stop)
            if chunk is not None:
                self._behind_chunk = True
                yield chunk[0]
                before, position = chunk[1] - 1, chunk[1]
                continue
            end = self._trusted(position, stop)
            if end is None:
                if self._is_cut_off(position, stop):
                    yield self._cut_off(position)
                    break
                before, position = position, self._skip(before, position, stop)
                continue
            opcode = data[position]
            if opcode == MESSAGE_INDEX and not self._behind_chunk:
                entries = data[position + RECORD.size + 6 : end]
                self._missed.update(np.frombuffer(entries, '<u8')[::2].tolist())
            elif opcode in {SCHEMA, CHANNEL} and self.ended:  # of a summary that is damaged
                self._doubtful.take(opcode, data[position + RECORD.size : end])
            elif opcode in {SCHEMA, CHANNEL, MESSAGE}:
                yield data[position:end]
            elif opcode in {DATA_END, FOOTER} and not chunk_follows(data, end, stop):
                self.ended = True
            before, position = position, end
        self.closed = summary is not None
        self.ended = self.ended or self.closed

    def _chunk(self, position: int, stop: int) -> tuple[bytes, int] | None:
        """Content and end of the chunk here, even if its opcode or a length is damaged."""
        for end in chunk_ends(self.data, position, stop):
            if end > stop:
                continue
            length = end - position - RECORD.size
            agreed = RECORD.unpack_from(self.data, position) == (CHUNK, length)
            content, checksum = _content(self.data, position, end)
            if content is not None and (agreed or checksum or _whole(content) == len(content)):
                self.mended += not agreed
                return content, end
        return None

    def _trusted(self, position: int, stop: int) -> int | None:
        """End of the record here, if it is certainly not a chunk; else None."""
        data, opcode = self.data, self.data[position]
        end = end_of(data, position, stop)
        if end is None or opcode == CHUNK:
            return None
        if opcode == MESSAGE or opcode >= PRIVATE:  # of these any length agrees
            bare = self._plain or not looks_chunked(data, position, end)
            return end if bare and self._goes_on(end, stop) else None
        # a chunk's length may look like the record of an end, where a byte before it is missing
        within = opcode in {DATA_END, FOOTER} and chunk_follows(data, end, stop)
        return None if within and not self._goes_on(end, stop) else end

    def _goes_on(self, position: int, stop: int) -> bool:
        """Whether a record begins at `position`, or the file ends there within the next one."""
        if stop - position < RECORD.size or end_of(self.data, position, stop):
            return True
        last = next_record(self.data, position, stop, plain=True) is None
        return last and self.data[position] == MESSAGE and stop == len(self.data)

    def _skip(self, before: int, position: int, stop: int) -> int:
        """Skip to the next record and return its start.

        `before`: start of the last record; if that was invalid, the next one may begin in it.
        """
        data, opcode = self.data, self.data[position]
        if opcode == CHUNK:
            self.bad_chunks += 1
            self._keep_names(position, stop)
        plain = self._plain and opcode != CHUNK
        found = next_record(data, (position if self._plain else before) + 1, stop, plain=plain)
        if found == position:
            found = next_record(data, position + 1, stop, plain=plain)
        following = stop if found is None else found
        self.unread += max(following - position, 0)
        self._behind_chunk = False
        return following

    def _keep_names(self, position: int, stop: int) -> None:
        """Store the channels of a damaged chunk, in case there are no others."""
        for end in [end for end in chunk_ends(self.data, position, stop) if end <= stop][:1]:
            self._doubtful.schemas = {**self._doubtful.schemas, **self._names.schemas}
            for opcode, body in _split(_unpacked(*_packed(self.data, position, end))[0]):
                self._doubtful.take(opcode, body)

    def _is_cut_off(self, position: int, stop: int) -> bool:
        """Whether this is the file's last chunk and its end is missing."""
        data = self.data
        if data[position] != CHUNK or stop != len(data):
            return False
        ends = chunk_ends(data, position, stop)
        beyond = len(ends) == 1 and ends[0] > stop
        return beyond and next_record(data, position + 1, stop, plain=False) is None

    def _cut_off(self, position: int) -> bytes:
        """Records of a chunk that is cut off, unless more than its end is damaged."""
        self.bad_chunks += 1
        name, packed = _packed(self.data, position, len(self.data))
        written = packed.rstrip(b'\0')
        written = packed if len(packed) - len(written) <= _ZEROS else written
        content, _ = _unpacked(name, written)
        used, channels = _whole(content), set(self._names.channels)
        channels |= {int.from_bytes(b[:2], 'little') for o, b in _split(content) if o == CHANNEL}
        if not _begins_a_record(content[used:], channels):
            used = 0
        self.unread += len(content) - used if used else len(packed)
        self.unchecked = sum(opcode == MESSAGE for opcode, _ in _split(content[:used]))
        return content[:used]

    def _named(self, channel: int) -> Topic | None:
        """The channel, sought in the rest of the file where no record so far names it."""
        topic = self._names.channels.get(channel)
        if topic is None and not self._looked_ahead:
            self._looked_ahead = True
            ahead = McapScan(self.data)
            for content in ahead.contents(behind_end=True):
                for opcode, body in _split(content):
                    ahead._names.take(opcode, body)
            known = {**ahead._names.channels, **self._names.channels}
            doubtful = {k: v for k, v in ahead._doubtful.channels.items() if k not in known}
            self.doubtful_names = {topic.name for topic in doubtful.values()}
            self._names.channels = {**doubtful, **known}
            topic = self._names.channels.get(channel)
        return topic

    def _count_lost(self) -> int:
        if self.stated is not None:
            return max(self.stated - self.found, 0)
        if not self._missed:
            return self.unnamed
        times = np.array([
            MESSAGE_HEAD.unpack_from(body)[2]
            for content in McapScan(self.data).contents()
            for opcode, body in _split(content)
            if opcode == MESSAGE
        ], '<u8')  # fmt: skip
        if not len(times):
            return self.unnamed
        missed = np.setdiff1d(np.array(list(self._missed), '<u8'), times)
        # an index may be damaged too
        return int(np.sum((times.min() < missed) & (missed < times.max()))) + self.unnamed


def _packed(data: Data, position: int, end: int) -> tuple[bytes, bytes]:
    """Compression's name and compressed content of a chunk."""
    name = position + RECORD.size + CHUNK_HEAD.size
    content = name + CHUNK_HEAD.unpack_from(data, position + RECORD.size)[-1]
    return data[name:content], data[content + 8 : end]


def _content(data: Data, position: int, end: int) -> tuple[bytes | None, int]:
    """The records of a chunk, None where they are damaged, and their checksum; 0 for none."""
    *_, checksum, _ = CHUNK_HEAD.unpack_from(data, position + RECORD.size)
    content, whole = _unpacked(*_packed(data, position, end))
    sound = whole and (not checksum or zlib.crc32(content) == checksum)
    return (content if sound else None), checksum


def _unpacked(name: bytes, packed: bytes) -> tuple[bytes, bool]:
    """Content as far as it can be decompressed, and whether that is all; `name` as in MCAP."""
    if not name:
        return packed, True
    if name not in _CODECS:
        return b'', False
    decompress, stream = _CODECS[name]
    with suppress(*UNPACK_ERRORS):
        return bytes(decompress(packed)), True
    with suppress(*UNPACK_ERRORS):  # its end may be missing
        return bytes(stream().decompress(packed)), False
    return b'', False


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


def _whole(content: bytes) -> int:
    """Bytes of a chunk's complete records."""
    return sum(RECORD.size + len(body) for _, body in _split(content))


def _begins_a_record(rest: bytes, channels: set[int]) -> bool:
    """Whether an incomplete record of a chunk probably begins here."""
    if len(rest) < RECORD.size + 2:
        return True
    opcode, length = RECORD.unpack_from(rest)
    if length >= _LONGEST_MESSAGE:
        return False
    if opcode == MESSAGE:
        return int.from_bytes(rest[RECORD.size : RECORD.size + 2], 'little') in channels
    return opcode in {SCHEMA, CHANNEL}
