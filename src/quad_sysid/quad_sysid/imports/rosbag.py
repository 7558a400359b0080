"""Messages of a ROS 1 or ROS 2 bag → columns with their times; definitions from a folder of .msg.

What a topic means is said by table.py's options, px4.py or mavros.py. Bags of the contract are
read by quad_sysid.bags.
"""

from __future__ import annotations

import math
import re
from array import array
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from quad_sysid.bags.stamps import spread
from quad_sysid.bags.storage import without_storage
from quad_sysid.bags.stored.files import storage_in
from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.files import read_by_library

MAX_NUMBERS = 64
"""Longest array that becomes columns; a longer one is an image, a cloud or a matrix of data."""
LATE_S = 0.1
"""Longest time that a message is on its way; stamps that differ by more are of two clocks."""
HELD_UP_S = 5.0
"""Longest time for which messages are held up; over a longer one the quickest show their clock."""
STREAM = 100
"""Least number of messages of a topic that says of its clock: others may have been kept for later
subscribers."""
MEND = '`ros2 run quad_bridge recover` rebuilds what is whole, `rosbag reindex` a bag of ROS 1'
PACKAGE_NAME = re.compile(r'<name>\s*([\w-]+)\s*</name>')

Columns = dict[str, FloatArray]
Getter = Callable[[Any], Any]


def topics_of(path: Path) -> dict[str, str]:
    """Types of a bag by topic; empty where the path is no bag that can be read."""
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2

    try:
        with (Reader1 if path.suffix == '.bag' else Reader2)(path) as reader:
            return {connection.topic: connection.msgtype for connection in reader.connections}
    except Exception:  # noqa: BLE001 - a library raises whatever a damaged bag makes it meet
        return {}


@contextmanager
def _opened(path: Path, messages: Path | None) -> Iterator[Any]:
    """The bag's reader, with the definitions that it holds, ROS's own and those of a folder."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    if path.is_dir() and not storage_in(path.iterdir()):
        raise without_storage(path)
    store = get_typestore(Stores.ROS2_JAZZY)
    with read_by_library(path, 'is not a whole bag', MEND):
        kinds = {kind.partition('/')[0] for kind in topics_of(path).values()}
        if messages is not None:
            _register(store, messages, kinds)
        reader = AnyReader([path], default_typestore=store)
        reader.open()
    try:
        if messages is not None:
            more = {name: fields for name, fields in store.fielddefs.items()
                    if name not in reader.typestore.fielddefs}
            reader.typestore.register(more)
        yield reader
    finally:
        reader.close()


def _register(store: Any, folder: Path, kinds: Collection[str]) -> None:
    """Add the definitions of a checkout's .msg files to a store."""
    from rosbags.typesys import get_types_from_msg

    files = sorted(folder.rglob('*.msg'))
    if not files:
        raise BadInputError('--messages', 'holds no .msg files', str(folder),
                            'name a checkout of the package that defines the messages')
    there = {name.partition('/')[0] for name in store.fielddefs}
    missing = [package for package in kinds if package not in there]
    for file in files:
        package = _package(file, folder)
        if package not in kinds and len(missing) == 1:
            package = missing[0]  # a folder of another name, such as PX4's own msg
        name = f'{package}/msg/{file.stem}'
        if name in store.fielddefs:
            continue
        try:
            types = get_types_from_msg(file.read_text(encoding='utf-8', errors='replace'), name)
            store.register({key: value for key, value in types.items()
                            if key not in store.fielddefs})
        except Exception:  # noqa: BLE001, S112 - one that cannot be read may not be needed
            continue


def _package(file: Path, folder: Path) -> str:
    for place in file.parents:
        package = place / 'package.xml'
        if package.is_file():
            match = PACKAGE_NAME.search(package.read_text(encoding='utf-8', errors='replace'))
            if match:
                return match[1]
        if place == folder:
            break
    return file.parent.parent.name if file.parent.name == 'msg' else file.parent.name


@dataclass
class _Topic:
    """Columns of one topic as they grow."""

    names: list[str]
    getters: list[tuple[Getter, int]]
    """What gives some of the columns, and how many."""
    stamps: array[float] = field(default_factory=lambda: array('d'))
    delays: array[float] = field(default_factory=lambda: array('d'))
    """From stamp to receipt, s; 0 where a message has no stamp."""
    values: array[float] = field(default_factory=lambda: array('d'))

    def add(self, received: float, message: Any) -> None:
        """Append one message; what it lacks is NaN."""
        stamp = _stamp(message) or received
        self.stamps.append(stamp)
        self.delays.append(received - stamp)
        for getter, count in self.getters:
            try:
                value = getter(message)
                row = [float(value)] if count == 0 else [float(x) for x in value][:count]
            except (AttributeError, IndexError, TypeError, ValueError):
                row = []
            self.values.extend(row + [math.nan] * (max(count, 1) - len(row)))

    def table(self) -> FloatArray:
        """(n, columns) a row for each message."""
        return np.frombuffer(self.values, dtype=np.float64).reshape(len(self.stamps), -1)


def read_messages(
    path: Path, names: Collection[str] | None = None, messages: Path | None = None
) -> tuple[Columns, Columns, tuple[str, ...]]:
    """Every number of every message as `/topic.field.x`, its times, s, and what was done to them.

    Of topics whose name begins a column in `names` (None: all). Raises BadInputError where the
    bag is damaged or holds no definitions of the messages that are wanted.
    """
    topics: dict[str, _Topic] = {}
    with _opened(path, messages) as reader:
        connections = [
            c for c in reader.connections
            if names is None or any(name.startswith(f'{c.topic}.') for name in names)
        ]
        defined = reader.typestore.fielddefs
        decoded = [c for c in connections if c.msgtype in defined]
        unknown = {c.topic: c.msgtype for c in connections if c.msgtype not in defined}
        if unknown and (names is not None or not decoded):
            raise _undefined(path, unknown, messages)
        with read_by_library(path, 'is not a whole bag', MEND):
            for connection, received, raw in reader.messages(connections=decoded):
                message = reader.deserialize(raw, connection.msgtype)
                topic = topics.get(connection.topic)
                if topic is None:
                    topic = topics[connection.topic] = _topic(message, connection.topic)
                topic.add(1e-9 * received, message)
    columns: Columns = {}
    times: Columns = {}
    notes: list[str] = []
    shifts = _other_clocks(topics)
    for name, topic in topics.items():
        values, shift = topic.table(), shifts.get(name, np.zeros(1))
        own, done = spread(np.array(topic.stamps) + shift, values)
        back = int(np.count_nonzero(np.diff(own) < 0.0))
        if np.abs(shift).max() > LATE_S:
            off = ' to '.join(dict.fromkeys(f'{x:.3f}' for x in (shift.min(), shift.max())))
            notes.append(f'{name}: its stamps are {off} s off the clock of the recorder: moved to '
                         'it by the messages that came quickest')
        notes += [f'{name}: {done}'] * bool(done)
        notes += [f'{name}: {back} messages run back in time and are sorted'] * bool(back)
        columns |= zip(topic.names, values.T.copy(), strict=True)
        times |= dict.fromkeys(topic.names, own)
    return columns, times, tuple(notes)


def _other_clocks(topics: Mapping[str, _Topic]) -> Columns:
    """What brings each topic's stamps onto the recorder's clock, s; none if they share one.

    One that was set back is none.
    """
    from scipy.ndimage import grey_closing, grey_opening  # slow to import

    shifts: Columns = {}
    received: Columns = {}
    was_set = False
    for name, topic in topics.items():
        stamps, delays = np.array(topic.stamps), np.array(topic.delays)
        if stamps.size < STREAM:
            continue
        received[name] = stamps + delays
        size = 1 + round(HELD_UP_S * stamps.size / max(np.ptp(received[name]), HELD_UP_S))
        shift = shifts[name] = grey_closing(grey_opening(delays, size), size)
        was_set |= bool(((np.diff(shift) > LATE_S) & (np.diff(stamps) < -LATE_S)).any())
    if not shifts:
        return {}
    moments = np.concatenate([*received.values()])[::STREAM]
    apart = np.ptp([np.interp(moments, received[name], shifts[name]) for name in shifts], axis=0)
    return shifts if was_set or apart.max() > LATE_S else {}


def of_one_aircraft(path: Path, pattern: re.Pattern[str], names: Collection[str],
                    messages: Path | None) -> tuple[Columns, Columns, tuple[str, ...]]:
    """Topics `names` of the aircraft that has most of them, by its own names; what is left out.

    `pattern` finds in a topic its `place`, whose it is, and its name as `topic`, and may find a
    `way`: what an autopilot says (`out`) counts before what it hears (`in`).
    """
    topics = [topic for topic in topics_of(path)
              if (match := pattern.match(f'{topic}.')) and match['topic'] in names]
    columns, times, notes = read_messages(path, [f'{topic}.' for topic in topics], messages)
    matches = [match for name in columns if (match := pattern.match(name))]
    places = [match['place'] for match in matches]
    chosen = max(dict.fromkeys(places), key=places.count, default='')
    ours: Columns = {}
    clock: Columns = {}
    for match in sorted(matches, key=lambda match: match.groupdict().get('way', '')):
        if match['place'] == chosen:
            own = f'{match["topic"]}.{match.string[match.end():]}'
            ours[own], clock[own] = columns[match.string], times[match.string]
    alternatives = ', '.join(sorted(set(places) - {chosen}))
    note = f'of several aircraft {chosen or "/"} is read; left out: {alternatives}'
    return ours, clock, (*notes, *[note] * bool(alternatives))


def _undefined(path: Path, unknown: dict[str, str], messages: Path | None) -> BadInputError:
    packages = sorted({kind.partition('/')[0] for kind in unknown.values()})
    name = ', '.join(packages)
    what = 'holds no definitions of its messages' if messages is None else \
        f'has messages that {messages} does not define'
    return BadInputError(str(path), what, ', '.join(sorted(set(unknown.values()))[:3]),
                         f'give a checkout of {name} that fits: --messages FOLDER')


def _stamp(message: Any) -> float:
    """The message's own time, s: its header's, or the one that PX4 gives; 0 without one."""
    header = getattr(message, 'header', None)
    if header is not None and hasattr(header, 'stamp'):
        stamp = header.stamp
        return float(stamp.sec + 1e-9 * stamp.nanosec)
    for name in ('timestamp_sample', 'timestamp'):
        ticks = getattr(message, name, 0)
        if isinstance(ticks, int | np.integer) and ticks > 0:
            return 1e-6 * float(ticks)
    return 0.0


def _topic(message: Any, name: str) -> _Topic:
    names: list[str] = []
    getters: list[tuple[Getter, int]] = []
    for own, getter, count in _leaves(message, (), name):
        getters.append((getter, count))
        names += [own] if count == 0 else [f'{own}[{i}]' for i in range(count)]
    return _Topic(names, getters)


def _leaves(
    message: Any, path: tuple[str | int, ...], name: str
) -> Iterator[tuple[str, Getter, int]]:
    """The numbers of a message: name, what gives them, and how many (0: one alone)."""
    if isinstance(message, bool | int | float | np.number):
        yield name, _getter(path), 0
    elif isinstance(message, np.ndarray | list | tuple):
        if not 0 < len(message) <= MAX_NUMBERS:
            return
        if all(isinstance(x, bool | int | float | np.number) for x in message):
            yield name, _getter(path), len(message)
        else:
            for i, value in enumerate(message):
                yield from _leaves(value, (*path, i), f'{name}[{i}]')
    elif hasattr(message, '__dataclass_fields__'):
        for key in message.__dataclass_fields__:
            if key not in ('header', '__msgtype__'):
                yield from _leaves(getattr(message, key), (*path, key), f'{name}.{key}')


def _getter(path: Sequence[str | int]) -> Getter:
    def get(message: Any) -> Any:
        for key in path:
            message = message[key] if isinstance(key, int) else getattr(message, key)
        return message

    return get
