"""Messages of some topics of a bag, decoded, whether the bag was closed, cut off or damaged.

Reads with the readers of `recover`, so what can be recovered can be read. No arrays here.
"""

from __future__ import annotations

import sqlite3
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from quad_bridge.bag_files import is_sqlite, missing_parts, storage_files
from quad_bridge.compression import plain_message, unpacked
from quad_bridge.damaged_mcap import DamagedMcap, Message
from quad_bridge.damaged_sqlite import DamagedSqlite
from quad_bridge.errors import BadInputError

REMEDY = '`ros2 run quad_bridge recover` says more'


@dataclass(frozen=True)
class Received:
    """One decoded message."""

    time_ns: int
    """When it was recorded, ns since 1970."""
    content: Any


@dataclass
class Contents:
    """What a bag holds of the wanted topics."""

    messages: dict[str, list[Received]] = field(default_factory=lambda: defaultdict(list))
    """By topic, in the order of recording."""
    warnings: list[str] = field(default_factory=list)
    """A line for each thing that is missing or damaged."""


def read_topics(bag: Path, kinds: Mapping[str, str]) -> Contents:
    """Messages of the topics in `kinds` (topic to type) of a bag directory or storage file.

    Messages of another type are no messages of the topic. Raises BadInputError where there is no
    bag, or nothing of it can be read.
    """
    found, store = Contents(), get_typestore(Stores.ROS2_JAZZY)
    files = storage_files(bag)
    found.warnings += [f'{bag}: {note}' for note in missing_parts(files)]
    if bag.is_dir() and not (bag / 'metadata.yaml').is_file():
        found.warnings.append(f'{bag}: has no metadata.yaml (the recorder was killed?); {REMEDY}')
    damaged = 0
    for file in files:
        try:
            for message in _whole(file, found.warnings):
                topic = message.topic
                if kinds.get(topic.name) != topic.kind:
                    continue
                content = _decoded(store, message)
                if content is None:
                    damaged += 1
                else:
                    found.messages[topic.name].append(Received(message.time_ns, content))
        except BadInputError as error:
            if len(files) == 1:
                raise
            found.warnings.append(f'{error}: that part is missing')
    if damaged:
        found.warnings.append(f'{bag}: {damaged} messages are damaged and left out; {REMEDY}')
    return found


def _decoded(store: Typestore, message: Message) -> Any:
    """The message; None where it is damaged."""
    data, whole = plain_message(message.data)
    try:
        return store.deserialize_cdr(data, message.topic.kind) if whole else None
    except Exception:  # noqa: BLE001  (whatever nonsense makes the decoder raise)
        return None


def _whole(file: Path, warnings: list[str]) -> Iterator[Message]:
    """What is whole in one file."""
    with unpacked(file) as plain:
        try:
            damaged = DamagedSqlite(plain) if is_sqlite(file) else DamagedMcap(plain)
            yield from damaged.messages()
        except (BadInputError, sqlite3.Error, OSError) as error:
            raise BadInputError(str(file), str(error).replace(f'{plain}: ', '')) from error
        if not damaged.complete:
            lost = f', at least {damaged.lost} messages are missing' if damaged.lost else ''
            warnings.append(f'{file}: damaged or cut off{lost}: read what is whole; {REMEDY}')
