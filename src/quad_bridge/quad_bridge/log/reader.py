"""Messages of a bag, closed, cut off or damaged; intact sqlite3 bags by rosbags.

It reads everything that `recover` can recover. No arrays here.
"""

from __future__ import annotations

import mmap
import sqlite3
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from itertools import repeat
from pathlib import Path
from typing import Any

import yaml
from rosbags.rosbag2 import Reader
from rosbags.rosbag2.metadata import dump_qos_v9
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from quad_bridge.errors import BadInputError
from quad_bridge.log.stored.files import (
    ORPHANS,
    ZSTD_MAGIC,
    address,
    missing_parts,
    plain_file,
    plain_message,
    recording_state,
    sqlite_fault,
    sqlite_remedy,
    storage_in,
)
from quad_bridge.log.stored.records import MAGIC, Topic
from quad_bridge.log.stored.scan import McapScan, Message

REMEDY = '`ros2 run quad_bridge recover` says more'
_DAMAGED = Message(Topic('', '', ''), 0, b'')
"""Stands for a row that is no message: without a topic, a time or bytes."""


@dataclass(frozen=True)
class Received:
    """One decoded message."""

    time_ns: int
    """Time of recording, ns since 1970."""
    content: Any


@dataclass
class Contents:
    """Messages of the wanted topics in a bag."""

    messages: dict[str, list[Received]] = field(default_factory=lambda: defaultdict(list))
    """Messages by topic, in the order of recording."""
    warnings: list[str] = field(default_factory=list)
    """A line for each missing or damaged part."""


def read_topics(bag: Path, kinds: Mapping[str, str]) -> Contents:
    """Messages of the topics in `kinds` (topic to type) of a bag directory or storage file.

    Messages of other types are ignored. Raises BadInputError where there is no bag, or nothing of
    it can be read.
    """
    result, store = Contents(), get_typestore(Stores.ROS2_JAZZY)
    files = storage_files(bag)
    result.warnings += [f'{bag}: {note}' for note in missing_parts(files)]
    state = recording_state(files[-1])
    growing = files[-1] if state else None
    result.warnings += _unfinished(bag, state)
    damaged = 0

    def judge(scan: McapScan, file: Path) -> None:
        if not (scan.complete or file == growing):
            lost = f', at least {scan.lost} messages are missing' if scan.lost else ''
            result.warnings.append(
                f'{file}: damaged or cut off{lost}: read what is whole; {REMEDY}'
            )

    for file in files:
        try:
            for message in messages_of(file, judge):
                if kinds.get(message.topic.name) == message.topic.kind:
                    damaged += not _stored(message, result, store)
        except BadInputError as error:  # noqa: PERF203  (files are few)
            if len(files) == 1:
                raise
            result.warnings.append(f'{error}: that part is missing')
    if damaged:
        result.warnings.append(f'{bag}: {damaged} messages are damaged and left out; {REMEDY}')
    return result


def _unfinished(bag: Path, state: str) -> list[str]:
    """A line on a bag that is not closed, or not yet."""
    if state:
        return [f'{bag}: {state}: read as far as it is on the disk']
    if bag.is_dir() and not (bag / 'metadata.yaml').is_file():
        return [f'{bag}: has no metadata.yaml (the recorder was killed?); {REMEDY}']
    return []


def _stored(message: Message, result: Contents, store: Typestore) -> bool:
    """Decode and store a message; False where it is damaged."""
    try:
        content = store.deserialize_cdr(message.data, message.topic.kind)
    except Exception:  # noqa: BLE001  (whatever nonsense makes the decoder raise)
        return False
    result.messages[message.topic.name].append(Received(message.time_ns, content))
    return True


def storage_files(bag: Path) -> list[Path]:
    """Storage files of a bag directory, or the given file; raises BadInputError without any."""
    if not bag.exists():
        raise BadInputError(str(bag), 'does not exist', remedy='check the path')
    files = storage_in(bag.iterdir() if bag.is_dir() else [bag])
    if not files:
        raise BadInputError(str(bag), 'holds no .mcap or .db3 file', remedy='check the path')
    return files


def messages_of(
    file: Path, judge: Callable[[McapScan, Path], None] = lambda _scan, _file: None
) -> Iterator[Message]:
    """All intact messages of one file in order, decompressed; empty data where that fails.

    `judge` is called with the scan of an mcap file at its end. Raises BadInputError for a file
    that cannot be read, is empty or of neither storage, and for a damaged sqlite3 file.
    """
    try:
        file.open('rb').close()
    except OSError as error:
        raise BadInputError(str(file), f'cannot be read: {error.strerror}') from error
    with plain_file(file) as plain:
        is_sqlite = plain.name.endswith('.db3')
        stored = _sqlite_messages(plain, file) if is_sqlite else _mcap_messages(plain, file, judge)
        for message in stored:
            compressed = message.data[:4] == ZSTD_MAGIC
            yield message._replace(data=plain_message(message.data)) if compressed else message


def _mcap_messages(
    plain: Path, file: Path, judge: Callable[[McapScan, Path], None]
) -> Iterator[Message]:
    with plain.open('rb') as stream:
        head = stream.read(len(MAGIC))
        if not head:
            raise BadInputError(str(file), 'is empty', remedy='nothing can be recovered')
        if head != MAGIC:
            raise BadInputError(str(file), 'is not an mcap file', f'first bytes {head.hex()}')
        with mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
            scan = McapScan(data)
            yield from scan.messages()
            judge(scan, file)


def _sqlite_messages(plain: Path, file: Path) -> Iterator[Message]:
    fault = sqlite_fault(plain)
    if fault:
        what = f'is a damaged sqlite3 file ({fault})'
        raise BadInputError(str(file), what, remedy=sqlite_remedy(file))
    topics = {}
    try:
        with Reader(plain) as reader:
            for c in reader.connections:
                qos = yaml.safe_dump(dump_qos_v9(list(c.ext.offered_qos_profiles)))  # type: ignore[union-attr]
                topics[c.id] = Topic(str(c.topic), str(c.msgtype), c.msgdef.data, qos, c.digest)
            for c, time_ns, data in reader.messages():
                whole = isinstance(data, bytes) and isinstance(time_ns, int) and time_ns >= 0
                yield Message(topics[c.id], time_ns, data) if whole else _DAMAGED
        with closing(sqlite3.connect(address(plain), uri=True)) as base:
            (orphans,) = base.execute(ORPHANS).fetchone()
        yield from repeat(_DAMAGED, orphans)
    except Exception as error:
        what = f'cannot be read as a sqlite3 bag ({" ".join(str(error).split())})'
        raise BadInputError(str(file), what, remedy='is it a bag of rosbag2?') from error
