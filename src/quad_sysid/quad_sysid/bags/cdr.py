"""Stamped messages of fixed layout in bulk: many CDR byte strings ↔ stamps and one array.

No files, no topics, no grids. A type's fields, known from rosbags, give the positions of the
numbers in one message. Messages of one layout are read together; those that fit none go through
rosbags' deserialiser, with the same result. Source: OMG CDR (XCDR1), 4 bytes of encapsulation
header, alignment counted after it.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from functools import lru_cache
from operator import attrgetter
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from rosbags.typesys.store import Typestore

    from quad_sysid.contract import FloatArray

LITTLE_ENDIAN = b'\x00\x01'
PADDING = 3
"""Bytes that may follow the last field."""
_DTYPES = {
    'bool': '|u1', 'byte': '|u1', 'char': '|u1', 'uint8': '|u1', 'int8': '|i1', 'uint16': '<u2',
    'int16': '<i2', 'uint32': '<u4', 'int32': '<i4', 'uint64': '<u8', 'int64': '<i8',
    'float32': '<f4', 'float64': '<f8',
}  # fmt: skip
_LENGTH = struct.Struct('<I')


class LayoutError(Exception):
    """The bytes hold no message of a layout that can be read in bulk."""


@lru_cache(maxsize=1)
def typestore() -> Typestore:
    """Rosbags' table of Jazzy's message types."""
    return get_typestore(Stores.ROS2_JAZZY)


@dataclass(frozen=True)
class Step:
    """The next part of a message: consecutive numbers, a string, or a sequence of them."""

    names: tuple[str, ...]
    """Names of the numbers, such as `orientation.x`; one for a string or a sequence."""
    dtype: str = ''
    """numpy type of numbers; empty for strings."""
    many: bool = False
    """A sequence, preceded by its length."""

    @property
    def size(self) -> int:
        """Bytes of one number."""
        return np.dtype(self.dtype).itemsize


@dataclass
class Layout:
    """Positions in a message. Messages of one layout agree in their `fixed` bytes."""

    places: list[tuple[int, int]] = field(default_factory=list)
    """(offset, count) of each step's numbers."""
    fixed: list[tuple[int, int]] = field(default_factory=list)
    """Byte ranges [start, stop) that are the same in all messages, such as lengths."""
    texts: list[tuple[int, int]] = field(default_factory=list)
    """Byte ranges of strings with their terminating zero."""
    lists: dict[str, list[str]] = field(default_factory=dict)
    """Content of sequences of strings; their bytes are in `fixed` too."""
    end: int = 4


@lru_cache(maxsize=64)
def steps_of(msgtype: str) -> tuple[Step, ...]:
    """Steps of a type; neighbouring numbers of one type are joined. Raises LayoutError."""
    joined: list[Step] = []
    for step in _steps(msgtype, ''):
        last = joined[-1] if joined else None
        if last and step.dtype and last.dtype == step.dtype and not (last.many or step.many):
            joined[-1] = Step(last.names + step.names, step.dtype)
        else:
            joined.append(step)
    return tuple(joined)


def _steps(msgtype: str, prefix: str) -> Iterator[Step]:
    for name, description in typestore().fielddefs[msgtype][1]:
        yield from _field(description, prefix + name)


def _field(description: Any, name: str) -> Iterator[Step]:
    kind, content = description
    if kind == Nodetype.NAME:
        yield from _steps(content, f'{name}.')
    elif kind == Nodetype.BASE:
        yield _base(content[0], name, many=False)
    elif kind == Nodetype.ARRAY:
        for i in range(content[1]):
            yield from _field(content[0], f'{name}[{i}]')
    elif content[0][0] == Nodetype.BASE:
        yield _base(content[0][1][0], name, many=True)
    else:
        raise LayoutError(f'{name}: sequence of messages')


def _base(kind: str, name: str, *, many: bool) -> Step:
    if kind != 'string' and kind not in _DTYPES:
        raise LayoutError(f'{name}: {kind}')
    return Step((name,), _DTYPES.get(kind, ''), many)


def layout_of(msgtype: str, raw: bytes) -> Layout:
    """Layout of one little-endian message.

    Raises LayoutError for messages that are invalid or cannot be read in bulk.
    """
    if raw[:2] != LITTLE_ENDIAN:
        raise LayoutError(raw[:2].hex())
    layout = Layout(fixed=[(0, 2)])
    try:
        for step in steps_of(msgtype):
            _take(step, raw, layout)
    except (struct.error, UnicodeDecodeError) as error:
        raise LayoutError(str(error)) from error
    if not layout.end <= len(raw) <= layout.end + PADDING:
        raise LayoutError(f'{len(raw)} bytes for {layout.end}')
    return layout


def _take(step: Step, raw: bytes, layout: Layout) -> None:
    """Move the layout's end behind one step."""
    count = len(step.names)
    if step.many:
        count = _length(raw, layout)
    if step.dtype:
        if count:
            layout.end = _align(layout.end, step.size)
        layout.places.append((layout.end, count))
        layout.end += step.size * count
        return
    layout.places.append((layout.end, count))
    start, found = layout.end, []
    if count > len(raw):
        raise LayoutError(f'{count} strings')
    for _ in range(count):
        length = _length(raw, layout)
        begin, layout.end = layout.end, layout.end + length
        if length < 1 or layout.end > len(raw) or raw[layout.end - 1]:
            raise LayoutError(f'string of {length} bytes')
        layout.texts.append((begin, layout.end))
        found.append(raw[begin : layout.end - 1].decode())
    if step.many:
        layout.lists[step.names[0]] = found
        layout.fixed.append((start, layout.end))


def _length(raw: bytes, layout: Layout) -> int:
    """Take the length of a string or sequence."""
    start = _align(layout.end, 4)
    (length,) = _LENGTH.unpack_from(raw, start)
    layout.fixed.append((start, start + 4))
    layout.end = start + 4
    return int(length)


def _align(offset: int, size: int) -> int:
    """Next offset aligned to `size`, counted after the encapsulation header."""
    return offset + (4 - offset) % size


IMU = 'sensor_msgs/msg/Imu'
JOINTS = 'sensor_msgs/msg/JointState'
WRENCH = 'geometry_msgs/msg/WrenchStamped'
VECTOR = 'geometry_msgs/msg/Vector3Stamped'
BATTERY = 'sensor_msgs/msg/BatteryState'

MOTOR_NAMES = ('motor_1', 'motor_2', 'motor_3', 'motor_4')

COLUMNS = {
    IMU: (
        *(f'orientation.{axis}' for axis in 'xyzw'), 'orientation_covariance[0]',
        *(f'angular_velocity.{axis}' for axis in 'xyz'),
        *(f'linear_acceleration.{axis}' for axis in 'xyz'),
    ),
    JOINTS: tuple(f'effort of {name}' for name in MOTOR_NAMES),
    WRENCH: tuple(f'wrench.{part}.{axis}' for part in ('force', 'torque') for axis in 'xyz'),
    VECTOR: ('vector.x', 'vector.y', 'vector.z'),
    BATTERY: ('voltage',),
}
"""Which fields of a type are read, in the order of the columns."""

WIDTH = {msgtype: len(columns) for msgtype, columns in COLUMNS.items()}

MOST_LAYOUTS = 8
"""Layouts that are tried for messages of one length before they are read one by one."""


@dataclass(frozen=True)
class Stamped:
    """Messages of one topic: stamps (n,) ns, values (n, WIDTH[type]), `spoiled`: unreadable."""

    stamps: npt.NDArray[np.int64]
    values: FloatArray
    spoiled: int = 0


def decode(msgtype: str, messages: Sequence[bytes]) -> Stamped:
    """Stamps and values of `messages` in order; unreadable ones are left out and counted."""
    stamps = np.zeros(len(messages), dtype=np.int64)
    values = np.full((len(messages), WIDTH[msgtype]), np.nan)
    good = np.zeros(len(messages), dtype=bool)
    lengths = np.fromiter(map(len, messages), dtype=np.int64, count=len(messages))
    for length in np.unique(lengths):
        rows = np.flatnonzero(lengths == length)
        for _ in range(MOST_LAYOUTS):
            if len(rows) == 0:
                break
            taken = _decode_group(msgtype, messages, rows, stamps, values)
            good[rows[taken]] = True
            taken[0] = True  # of no layout to be read in bulk: one by one below
            rows = rows[~taken]
    for i in np.flatnonzero(~good).tolist():
        try:
            stamps[i], values[i] = _decode_one(msgtype, messages[i])
        except Exception:  # noqa: BLE001, S112 - rosbags raises many kinds on spoiled bytes
            continue
        good[i] = True
    return Stamped(stamps[good], values[good], int(np.count_nonzero(~good)))


def _decode_group(
    msgtype: str,
    messages: Sequence[bytes],
    rows: npt.NDArray[np.intp],
    stamps: npt.NDArray[np.int64],
    values: FloatArray,
) -> npt.NDArray[np.bool_]:
    """Read the rows (of one length) that share the first one's layout; returns them."""
    try:
        layout = layout_of(msgtype, messages[rows[0]])
        columns, order = _columns(msgtype, layout)
    except LayoutError:
        return np.zeros(len(rows), dtype=bool)
    joined = b''.join(messages if len(rows) == len(messages) else [messages[i] for i in rows])
    table = np.frombuffer(joined, dtype=np.uint8).reshape(len(rows), -1)
    same = np.ones(len(rows), dtype=bool)
    for start, stop in layout.fixed:
        same &= (table[:, start:stop] == table[0, start:stop]).all(axis=1)
    for start, stop in layout.texts:  # plain ASCII; whatever else rosbags may judge
        same &= (table[:, start : stop - 1] < 0x80).all(axis=1) & (table[:, stop - 1] == 0)
    picked = table if same.all() else table[same]
    taken = rows[same]
    seconds = _numbers(picked, 4, '<i4', 1)[:, 0].astype(np.int64)
    stamps[taken] = seconds * 1_000_000_000 + _numbers(picked, 8, '<u4', 1)[:, 0]
    numbers = np.concatenate([_numbers(picked, *column) for column in columns], axis=1)
    values[taken] = numbers if order is None else numbers[:, list(order)]
    return same


def _numbers(table: npt.NDArray[np.uint8], offset: int, dtype: str, count: int) -> Any:
    """Take (n, count) numbers at one offset of every row."""
    size = np.dtype(dtype).itemsize * count
    return np.ascontiguousarray(table[:, offset : offset + size]).view(dtype)


def _columns(
    msgtype: str, layout: Layout
) -> tuple[list[tuple[int, str, int]], tuple[int, ...] | None]:
    """(offset, dtype, count) of each run of numbers, and the column of each number."""
    steps = steps_of(msgtype)
    if msgtype == JOINTS:
        index = next(i for i, step in enumerate(steps) if step.names == ('effort',))
        offset, count = layout.places[index]
        if count != len(MOTOR_NAMES):
            raise LayoutError('effort does not hold four motors')
        return [(offset, '<f8', count)], motor_order(layout.lists['name'])
    return [
        (layout.places[i][0] + first * steps[i].size, steps[i].dtype, count)
        for i, first, count in _runs(msgtype)
    ], None


@lru_cache(maxsize=16)
def _runs(msgtype: str) -> tuple[tuple[int, int, int], ...]:
    """(step, first number, count) of the columns' runs."""
    runs: list[tuple[int, int, int]] = []
    steps = enumerate(steps_of(msgtype))
    places = {name: (i, k) for i, step in steps for k, name in enumerate(step.names)}
    for name in COLUMNS[msgtype]:
        step, place = places[name]
        if runs and runs[-1][0] == step and sum(runs[-1][1:]) == place:
            runs[-1] = step, runs[-1][1], runs[-1][2] + 1
        else:
            runs.append((step, place, 1))
    return tuple(runs)


def encode(
    msgtype: str, template: bytes, stamps: npt.NDArray[np.int64], values: FloatArray
) -> list[bytes]:
    """Serialised copies of `template` with stamps (n,) ns and values (n, w)."""
    columns, order = _columns(msgtype, layout_of(msgtype, template))
    places = order or range(WIDTH[msgtype])
    table = np.tile(np.frombuffer(template, dtype=np.uint8), (len(stamps), 1))
    seconds, rest = np.divmod(stamps, 1_000_000_000)
    table[:, 4:8] = seconds.astype('<i4')[:, None].view(np.uint8)
    table[:, 8:12] = rest.astype('<u4')[:, None].view(np.uint8)
    start = 0
    for offset, dtype, count in columns:
        block = np.empty((len(stamps), count), dtype=dtype)
        for column, place in enumerate(places):
            if start <= place < start + count:
                block[:, place - start] = values[:, column]
        size = block.dtype.itemsize * count
        table[:, offset : offset + size] = block.view(np.uint8)
        start += count
    return [row.tobytes() for row in table]


def motor_order(names: Sequence[str]) -> tuple[int, ...]:
    """Indices of motor_1..motor_4 in `names`; without names 0..3."""
    if not names:
        return 0, 1, 2, 3
    if sorted(names) != sorted(MOTOR_NAMES):
        raise LayoutError(f'names {list(names)}')
    return tuple(list(names).index(name) for name in MOTOR_NAMES)


def blank(msgtype: str, **given: Any) -> Any:
    """A message of the type with `given` fields; numbers are 0, texts and lists empty."""
    fields = {name: _nothing(kind) for name, kind in typestore().fielddefs[msgtype][1]}
    return typestore().types[msgtype](**{**fields, **given})


def _nothing(description: Any) -> Any:
    kind, content = description
    if kind == Nodetype.NAME:
        return blank(content)
    if kind == Nodetype.BASE:
        return {'string': '', 'bool': False}.get(content[0], 0)
    inner, count = content[0], content[1] if kind == Nodetype.ARRAY else 0
    if inner[0] != Nodetype.BASE or inner[1][0] == 'string':
        return [_nothing(inner) for _ in range(count)]
    return np.zeros(count, dtype=_DTYPES[inner[1][0]])


def _decode_one(msgtype: str, raw: bytes) -> tuple[int, FloatArray]:
    """Stamp and values of one message by rosbags' deserialiser."""
    message: Any = typestore().deserialize_cdr(raw, msgtype)
    stamp = message.header.stamp
    if msgtype == JOINTS:
        values = np.asarray(message.effort, dtype=float)[list(motor_order(message.name))]
    else:
        values = np.array([_get(message, name) for name in COLUMNS[msgtype]], dtype=float)
    return stamp.sec * 1_000_000_000 + stamp.nanosec, values


def _get(message: Any, column: str) -> float:
    """A column's field, such as `orientation.x` or `orientation_covariance[0]`."""
    path, _, index = column.rstrip(']').partition('[')
    found = attrgetter(path)(message)
    return float(found[int(index)] if index else found)
