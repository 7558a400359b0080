"""Reads what is whole in a damaged mcap file: no summary, index or footer needed.

rosbags needs the summary; this pass over the records does not. A chunk whose checksum fails is
left out; behind nonsense the next record is searched (mcap_records.py). How many messages are lost
is known from the statistics of a closed file, else from the index behind each chunk.
"""

from __future__ import annotations

import mmap
import zlib
from array import array
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from quad_bridge.compression import CODECS, decompress
from quad_bridge.errors import BadInputError
from quad_bridge.mcap_records import (
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
    Names,
    Topic,
    chunk_ends,
    end_of,
    has_chunks,
    looks_chunked,
    next_record,
    summary_of,
)

LONGEST = 1 << 30
"""Bytes of a message."""
ZEROS = 64
"""So many at the end of a file are blocks that were never written."""


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
        self.mended = 0
        """Chunks whose opcode or length is damaged and whose content is not."""
        self.ended = False
        """The end of the data section was found."""
        self.unchecked = 0
        """Messages of a chunk that is cut off: its checksum says nothing of them."""
        self.unnamed = 0
        """Messages whose channel stands nowhere."""
        self.doubtful_names: set[str] = set()
        """Topics whose channel stands in a damaged chunk alone."""
        self.stated: int | None = None
        """Messages by the statistics of a file that was closed; None without them."""
        self._found = 0
        self._times: dict[int, array[int]] = {}
        """Of all messages found, by channel, ns."""
        self._told: set[tuple[int, int]] = set()
        """(channel, time) in the indexes of chunks that were not read."""
        self._closed = False
        """The summary behind the data is whole."""
        self._names = Names()
        self._doubtful = Names()
        """From chunks that fail their checksum: better than none."""
        self._chunk: dict[int, int] = {}
        """Where in `_times` the messages of the last chunk begin, by channel."""
        self._behind_chunk = False
        """Nothing but its indexes has come since the last chunk."""
        self._plain = False
        """The file holds its messages without chunks."""
        self._looked_ahead = False
        self._only_names = False
        """Channels are looked for, behind the end of the data too."""

    @property
    def lost(self) -> int:
        """Messages that were in the file and did not come out: all of a closed one, else least."""
        if self.stated is not None:
            return max(self.stated - self._found, 0)
        if not self._times:
            return self.unnamed
        found = np.concatenate([np.array(times, '<u8') for times in self._times.values()])
        told = np.array([time for _, time in sorted(self._told)], '<u8')
        within = (told > found.min()) & (told < found.max())  # an index may be damaged too
        return int(np.count_nonzero(within & ~np.isin(told, found))) + self.unnamed

    @property
    def complete(self) -> bool:
        """Its data were read to their end, nothing was left out, and its summary agrees."""
        return self.ended and self._closed and not (self.lost or self.unread or self.bad_chunks)

    def messages(self) -> Iterator[Message]:
        """All whole messages in the file's order."""
        with (
            self._path.open('rb') as file,
            mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data,
        ):
            stop = self.size
            summary = summary_of(data)
            if summary is not None:
                self._names, self.stated = summary.names, summary.messages
                stop = summary.start
            self._plain = not has_chunks(data, stop)
            for message in self._pass(data, stop):
                self._found += 1
                yield message
            self._closed = summary is not None
            self.ended = self.ended or self._closed

    def _pass(self, data: mmap.mmap, stop: int) -> Iterator[Message]:
        before = position = len(MAGIC)
        while position < stop and (not self.ended or self._only_names):
            end = end_of(data, position, stop)
            opcode = data[position]
            if end is None or self._false(data, position, end, stop):
                before, position = (
                    position,
                    (yield from self._nonsense(data, before, position, stop)),
                )
                continue
            if opcode == CHUNK:
                body = data[position + RECORD.size : end]
                content = _content(body)
                if content is None:
                    self._doubtful_names(body)
                    before, position = position, self._skip(data, position, position, stop)
                    continue
                yield from self._sound_chunk(content)
            elif opcode == MESSAGE_INDEX:
                self._compare(data[position + RECORD.size : end])
            elif opcode in {SCHEMA, CHANNEL} and self.ended:  # of a summary that is damaged
                self._doubtful.take(opcode, data[position + RECORD.size : end])
            elif opcode in {SCHEMA, CHANNEL, MESSAGE}:
                yield from self._record(opcode, data[position + RECORD.size : end])
            elif opcode in {DATA_END, FOOTER} and not has_chunks(data, stop, end):
                self.ended = True
            before, position = (end - 1 if opcode == CHUNK else position), end

    def _false(self, data: mmap.mmap, position: int, end: int, stop: int) -> bool:
        """Whether something else looks like this record, whose length agrees."""
        opcode = data[position]
        if opcode == MESSAGE or opcode >= PRIVATE:  # of these any length agrees
            return not (self._bare(data, position, end) and self._goes_on(data, end, stop))
        # a chunk's length may look like the record of an end, where a byte before it is missing
        within = opcode in {DATA_END, FOOTER} and has_chunks(data, stop, end)
        return within and not self._goes_on(data, end, stop)

    def _bare(self, data: mmap.mmap, position: int, end: int) -> bool:
        """Whether the record is no chunk or index whose opcode is damaged."""
        return self._plain or not looks_chunked(data, position, end)

    def _goes_on(self, data: mmap.mmap, position: int, stop: int) -> bool:
        """Whether a record begins at `position`, or the file ends there within the next one."""
        if stop - position < RECORD.size or end_of(data, position, stop):
            return True
        last = next_record(data, position, stop, plain=True) is None
        return last and data[position] == MESSAGE and stop == self.size

    def _nonsense(
        self, data: mmap.mmap, before: int, position: int, stop: int
    ) -> Generator[Message, None, int]:
        """What can be had of a damaged record; returns where the next one begins.

        `before`: where the last record began. If that is damaged too, the next one begins in it.
        """
        ends = chunk_ends(data, position, stop)
        for end in ends:  # its opcode or one of its lengths may be all that is damaged
            if end <= stop:
                content = _content(data[position + RECORD.size : end], needs_checksum=True)
                if content is not None:
                    self.mended += 1
                    yield from self._sound_chunk(content)
                    return end
        last = len(ends) == 1 and ends[0] > stop == self.size and data[position] == CHUNK
        if last and next_record(data, position + 1, stop, plain=False) is None:
            yield from self._cut_off_chunk(data[position + RECORD.size : stop])
            return stop
        return self._skip(data, before, position, stop)

    def _skip(self, data: mmap.mmap, before: int, position: int, stop: int) -> int:
        """Leave out a damaged record; returns where the next one begins, within it or behind."""
        plain = self._plain and data[position] != CHUNK
        begin = position if self._plain else before
        found = next_record(data, begin + 1, stop, plain=plain)
        following = stop if found is None else found
        self.bad_chunks += data[position] == CHUNK
        self.unread += max(following - position, 0)
        self._behind_chunk = False
        return following

    def _sound_chunk(self, content: bytes) -> Iterator[Message]:
        self._behind_chunk = True
        self._chunk = {channel: len(times) for channel, times in self._times.items()}
        used = yield from self._records(content)
        self.unread += len(content) - used

    def _cut_off_chunk(self, body: bytes) -> Iterator[Message]:
        """Messages of the file's last chunk, as far as it goes."""
        self.bad_chunks += 1
        packed = body.rstrip(b'\0')
        packed = body if len(body) - len(packed) <= ZEROS else packed
        name, begin, _ = _head(body)
        content, _ = decompress(name, packed[begin:], cut_off=True)
        content = content if self._ends_in_a_record(content) else b''
        found = self._found
        used = yield from self._records(content)
        self.unchecked = self._found - found
        self.unread += len(body) - len(packed) + len(content) - used if used else len(body)

    def _ends_in_a_record(self, content: bytes) -> bool:
        """Whether nothing but its end is missing, as far as that can be told."""
        used, known = 0, set(self._names.channels)
        for opcode, body in _split(content):
            used += RECORD.size + len(body)
            if opcode == CHANNEL:
                known.add(int.from_bytes(body[:2], 'little'))
        rest = content[used:]
        if len(rest) < RECORD.size + 2:
            return True
        opcode, length = RECORD.unpack_from(rest)
        if opcode == MESSAGE:
            channel = int.from_bytes(rest[RECORD.size : RECORD.size + 2], 'little')
            return channel in known and length < LONGEST
        return opcode in {SCHEMA, CHANNEL} and length < LONGEST

    def _doubtful_names(self, body: bytes) -> None:
        name, begin, _ = _head(body)
        content, _ = decompress(name, body[begin:])
        self._doubtful.schemas = {**self._doubtful.schemas, **self._names.schemas}
        for opcode, record in _split(content):
            self._doubtful.take(opcode, record)

    def _records(self, content: bytes) -> Generator[Message, None, int]:
        """Messages of a chunk's content; returns how many bytes of it are whole records."""
        used = 0
        for opcode, body in _split(content):
            yield from self._record(opcode, body)
            used += RECORD.size + len(body)
        return used

    def _record(self, opcode: int, body: bytes) -> Iterator[Message]:
        """Take in a schema or channel, hand out a message; a record of nonsense is left out."""
        if opcode in {SCHEMA, CHANNEL}:
            if not self._names.take(opcode, body):
                self.unread += len(body)
        elif opcode == MESSAGE and len(body) >= MESSAGE_HEAD.size:
            channel, _, log_ns, _ = MESSAGE_HEAD.unpack_from(body)
            self._times.setdefault(channel, array('Q')).append(log_ns)
            topic = self._names.channels.get(channel) or self._named(channel)
            if topic is None:
                self.unnamed += 1
            else:
                yield Message(topic, log_ns, body[MESSAGE_HEAD.size :])

    def _named(self, channel: int) -> Topic | None:
        """A channel whose record is not among those before: further on, or in a damaged chunk."""
        if not self._looked_ahead:
            self._looked_ahead = True
            ahead = DamagedMcap(self._path)
            ahead._looked_ahead = ahead._only_names = True
            for _ in ahead.messages():
                pass
            known = {**ahead._names.channels, **self._names.channels}
            doubtful = {k: v for k, v in ahead._doubtful.channels.items() if k not in known}
            self.doubtful_names = {topic.name for topic in doubtful.values()}
            self._names.channels = {**doubtful, **known}
        return self._names.channels.get(channel)

    def _compare(self, index: bytes) -> None:
        """Keep the times of an index whose chunk did not give as many messages."""
        channel = int.from_bytes(index[:2], 'little')
        told = np.frombuffer(index, '<u8', offset=6)[::2].tolist()
        there = self._times.get(channel, array('Q'))[self._chunk.get(channel, 0) :]
        of_another = not self._behind_chunk and set(told).isdisjoint(there)
        if len(told) > len(there) or of_another:
            self._told.update((channel, time) for time in told)


def _head(body: bytes) -> tuple[str, int, int]:
    """Compression, where the content begins, checksum of a chunk with room for all that."""
    *_, checksum, length = CHUNK_HEAD.unpack_from(body)
    begin = CHUNK_HEAD.size + length
    return body[CHUNK_HEAD.size : begin].decode(errors='replace'), begin + 8, checksum


def _content(body: bytes, *, needs_checksum: bool = False) -> bytes | None:
    """The records of a chunk; None where they are damaged or cannot be checked as they must."""
    name, begin, checksum = _head(body)
    known = name in CODECS
    for codec in (name,) if known else CODECS:  # the checksum tells which, if it is damaged
        content, whole = decompress(codec, body[begin:])
        if whole and (zlib.crc32(content) == checksum if checksum else known):
            return None if needs_checksum and not checksum else content
    return None


def _split(content: bytes) -> Iterator[tuple[int, bytes]]:
    """Opcode and content of the whole records of a chunk."""
    position = 0
    while position + RECORD.size <= len(content):
        opcode, length = RECORD.unpack_from(content, position)
        start, position = position + RECORD.size, position + RECORD.size + length
        known = opcode in {SCHEMA, CHANNEL, MESSAGE} or opcode >= PRIVATE
        if not known or position > len(content):
            return
        yield opcode, content[start:position]
