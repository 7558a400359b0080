"""Stamped messages of fixed layout in bulk: many CDR byte strings ↔ stamps and one array.

No files, no topics, no grids. rosbags reads and writes one message of each layout with its numbers
replaced, which shows where they lie; messages of one length that agree in all other bytes are then
read together, and what fits none goes through rosbags' own deserialiser, so the answer never
depends on which way it was read. CDR is OMG's XCDR1: 4 bytes of encapsulation header, alignment
counted after it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import count, islice, repeat
from operator import attrgetter
from typing import Any

import numpy as np
import numpy.typing as npt
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from quad_sysid.contract import FloatArray
from quad_sysid.record import finite_runs

LITTLE_ENDIAN = b'\x00\x01'
_DTYPES = {'bool': '|b1', 'byte': '|u1', 'char': '|u1', 'uint8': '|u1', 'int8': '|i1',
           'uint16': '<u2', 'int16': '<i2', 'uint32': '<u4', 'int32': '<i4', 'uint64': '<u8',
           'int64': '<i8', 'float32': '<f4', 'float64': '<f8'}


class LayoutError(Exception):
    """The bytes hold no message of a layout that can be read in bulk."""


@lru_cache(maxsize=1)
def typestore() -> Typestore:
    """Rosbags' table of Jazzy's message types."""
    return get_typestore(Stores.ROS2_JAZZY)


IMU = 'sensor_msgs/msg/Imu'
JOINTS = 'sensor_msgs/msg/JointState'
WRENCH = 'geometry_msgs/msg/WrenchStamped'
VECTOR = 'geometry_msgs/msg/Vector3Stamped'
BATTERY = 'sensor_msgs/msg/BatteryState'
ODOMETRY = 'nav_msgs/msg/Odometry'
PRESSURE = 'sensor_msgs/msg/FluidPressure'
TEXT = 'std_msgs/msg/String'

COLUMNS = {
    IMU: (*(f'orientation.{axis}' for axis in 'xyzw'), 'orientation_covariance[0]',
          *(f'angular_velocity.{axis}' for axis in 'xyz'),
          *(f'linear_acceleration.{axis}' for axis in 'xyz'),
          'angular_velocity_covariance[0]', 'linear_acceleration_covariance[0]'),
    WRENCH: tuple(f'wrench.{part}.{axis}' for part in ('force', 'torque') for axis in 'xyz'),
    VECTOR: ('vector.x', 'vector.y', 'vector.z'),
    BATTERY: ('voltage',),
    PRESSURE: ('fluid_pressure',),
    ODOMETRY: (*(f'pose.pose.position.{axis}' for axis in 'xyz'),
               *(f'pose.pose.orientation.{axis}' for axis in 'xyzw'),
               *(f'twist.twist.linear.{axis}' for axis in 'xyz')),
}
"""Which fields of a type are read, in the order of the columns; of JOINTS those of Joints."""

WIDTH = {msgtype: len(columns) for msgtype, columns in COLUMNS.items()}


@dataclass(frozen=True)
class Joints:
    """Layout of a JointState: one number per motor is read, motor_1 first."""

    count: int = 4
    field: str = 'effort'
    """`effort` or `velocity`."""

    @property
    def names(self) -> tuple[str, ...]:
        """motor_1 to motor_n."""
        return tuple(f'motor_{i + 1}' for i in range(self.count))

    def of(self, message: Any) -> FloatArray:
        """(count,) the numbers; without names they stand in order. Raises LayoutError."""
        names, values = list(message.name), np.asarray(getattr(message, self.field), dtype=float)
        if names and sorted(names) != sorted(self.names):
            raise LayoutError(f'names {names}')
        if values.size != self.count:
            raise LayoutError(f'{values.size} numbers of {self.count} motors')
        return values[[names.index(name) for name in self.names]] if names else values


FOUR = Joints()


def joints_of(messages: Sequence[bytes], field: str) -> Joints:
    """The motors of the first message that names them, or has one number for each."""
    for raw in messages:
        try:
            message: Any = typestore().deserialize_cdr(raw, JOINTS)
            joints = Joints(len(getattr(message, field)), field)
            joints.of(message)
        except Exception:  # noqa: BLE001, S112 - rosbags raises many kinds on spoiled bytes
            continue
        if joints.count:
            return joints
    return Joints(field=field)


@dataclass(frozen=True)
class Stamped:
    """Messages of one topic: stamps (n,) ns, values (n, w), `spoiled`: unreadable."""

    stamps: npt.NDArray[np.int64]
    values: FloatArray
    unreadable: int = 0


@dataclass(frozen=True)
class Layout:
    """Messages of one length that agree in all bytes but their numbers'."""

    pattern: npt.NDArray[np.uint8]
    """Bytes (m,) of one of these messages."""
    fixed: tuple[tuple[int, int], ...]
    """Ranges [start, stop) of the bytes that agree: the encapsulation, lengths and texts."""
    columns: tuple[tuple[int, str], ...]
    """Offset and type of the number that each of COLUMNS[type] is."""


def layout_of(msgtype: str, raw: bytes, joints: Joints = FOUR) -> Layout:
    """Layout of one little-endian message. Raises LayoutError for what rosbags cannot read."""
    if raw[:2] != LITTLE_ENDIAN:
        raise LayoutError(raw[:2].hex())
    try:
        message = typestore().deserialize_cdr(raw, msgtype)
        kind = Nodetype.NAME, msgtype
        # numbers that no message holds show which of them goes to which column
        bare, full, counted = (_numbered(kind, message, numbers)
                               for numbers in (repeat(0), repeat(None), count(1_000_003)))
        low, high, plain = (
            np.frombuffer(bytes(typestore().serialize_cdr(message, msgtype)), np.uint8)
            for message in (bare, full, counted))
        layout = _values(msgtype, counted, joints).tolist()
        columns = tuple(_place(plain, value) for value in layout)
    except Exception as error:  # rosbags raises many kinds on spoiled bytes
        raise LayoutError(str(error)) from error
    fixed = finite_runs(low == high, (0, low.size))
    return Layout(np.frombuffer(raw, np.uint8), tuple(fixed), columns)


def _numbered(description: Any, value: Any, numbers: Iterator[int | None]) -> Any:
    """The same content with other numbers; None fills all of a number's bytes."""
    kind, content = description
    if kind == Nodetype.NAME:
        fields = typestore().fielddefs[content][1]
        return typestore().types[content](**{
            name: _numbered(field, getattr(value, name), numbers) for name, field in fields
        })
    base = content if kind == Nodetype.BASE else content[0][1]
    if base[0] == 'string':
        return value
    full = np.frombuffer(b'\x01' if base[0] == 'bool' else b'\x5a' * 8, _DTYPES[base[0]])[0]
    is_integer = full.dtype.kind in 'iub'  # counted numbers are looked for among the others
    size = 1 if kind == Nodetype.BASE else len(value)
    drawn = [full if n is None else n * (not is_integer) for n in islice(numbers, size)]
    drawn_messages = np.array(drawn, full.dtype)
    return drawn_messages[0].item() if kind == Nodetype.BASE else drawn_messages


def _place(content: npt.NDArray[np.uint8], value: float) -> tuple[int, str]:
    """Offset and type of a number that a message holds once."""
    for dtype in ('<f8', '<f4'):
        size = np.dtype(dtype).itemsize
        words = content[4 : 4 + (content.size - 4) // size * size].view(dtype)
        index = np.flatnonzero(words == value)
        if index.size == 1:
            return 4 + size * int(index[0]), dtype
    raise LayoutError(f'{value} cannot be found')


def decode(msgtype: str, messages: Sequence[bytes], joints: Joints = FOUR) -> Stamped:
    """Stamps and values of `messages` in order; unreadable ones are left out and counted."""
    stamps = np.zeros(len(messages), dtype=np.int64)
    values = np.full((len(messages), WIDTH.get(msgtype, joints.count)), np.nan)
    is_regular = np.zeros(len(messages), dtype=bool)
    lengths = np.fromiter(map(len, messages), dtype=np.int64, count=len(messages))
    for length in np.unique(lengths):
        rows = np.flatnonzero(lengths == length)
        key = msgtype, joints, int(length)
        layout = _LAST.get(key)
        for _ in range(8):  # layouts; what fits none is read one by one
            if len(rows) == 0:
                break
            unread = np.zeros(len(rows), dtype=bool)
            if layout is None:
                unread[0] = True  # without a layout it is read singly below
                try:
                    layout = _LAST[key] = layout_of(msgtype, messages[int(rows[0])], joints)
                except LayoutError:
                    rows = rows[~unread]
                    continue
            is_complete = len(rows) == len(messages)
            data = b''.join(messages if is_complete else [messages[i] for i in rows.tolist()])
            table = np.frombuffer(data, dtype=np.uint8).reshape(len(rows), -1)
            same = np.ones(len(rows), dtype=bool)
            for start, stop in layout.fixed:
                same &= (table[:, start:stop] == layout.pattern[start:stop]).all(axis=1)
            _fill(table if same.all() else table[same], rows[same], layout, stamps, values)
            is_regular[rows[same]] = True
            rows, layout = rows[~(same | unread)], None
    for i in np.flatnonzero(~is_regular).tolist():
        try:
            stamps[i], values[i] = _decode_one(msgtype, messages[i], joints)
        except Exception:  # noqa: BLE001, S112 - rosbags raises many kinds on spoiled bytes
            continue
        is_regular[i] = True
    return Stamped(stamps[is_regular], values[is_regular], int(np.count_nonzero(~is_regular)))


_LAST: dict[tuple[str, Joints, int], Layout] = {}
"""By type, motors and length the layout that was found last: a stream's messages are alike."""


def _fill(table: npt.NDArray[np.uint8], rows: npt.NDArray[np.intp], layout: Layout,
          stamps: npt.NDArray[np.int64], values: FloatArray) -> None:
    """Write stamps and values of messages of one layout into their rows."""

    def numbers(offset: int, dtype: str) -> Any:
        size = np.dtype(dtype).itemsize
        return np.ascontiguousarray(table[:, offset : offset + size]).view(dtype)[:, 0]

    stamps[rows] = numbers(4, '<i4').astype(np.int64) * 1_000_000_000 + numbers(8, '<u4')
    for column, place in enumerate(layout.columns):
        values[rows, column] = numbers(*place)


def encode(msgtype: str, template: bytes, stamps: npt.NDArray[np.int64],
           values: FloatArray, joints: Joints = FOUR) -> list[bytes]:
    """Serialised copies of `template` with stamps (n,) ns and values (n, w)."""
    table = np.tile(np.frombuffer(template, dtype=np.uint8), (len(stamps), 1))
    seconds, nanoseconds = np.divmod(stamps, 1_000_000_000)
    columns = zip(layout_of(msgtype, template, joints).columns, values.T, strict=False)
    for (offset, dtype), numbers in [((4, '<i4'), seconds), ((8, '<u4'), nanoseconds), *columns]:
        block = np.ascontiguousarray(numbers, dtype=dtype)[:, None].view(np.uint8)
        table[:, offset : offset + block.shape[1]] = block
    return [row.tobytes() for row in table]


def text_of(messages: Sequence[bytes]) -> str:
    """The text of the last readable std_msgs/String; '' without one."""
    for raw in reversed(messages):
        try:
            message: Any = typestore().deserialize_cdr(raw, TEXT)
        except Exception:  # noqa: BLE001, S112 - rosbags raises many kinds on spoiled bytes
            continue
        return str(message.data)
    return ''


def blank(msgtype: str, **values: Any) -> Any:
    """A message of the type with `values` in its fields; numbers are 0, texts and lists empty."""
    fields = {name: _nothing(kind) for name, kind in typestore().fielddefs[msgtype][1]}
    return typestore().types[msgtype](**{**fields, **values})


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


def _decode_one(msgtype: str, raw: bytes, joints: Joints) -> tuple[int, FloatArray]:
    """Stamp and values of one message by rosbags' deserialiser."""
    message: Any = typestore().deserialize_cdr(raw, msgtype)
    stamp = message.header.stamp
    return stamp.sec * 1_000_000_000 + stamp.nanosec, _values(msgtype, message, joints)


def _values(msgtype: str, message: Any, joints: Joints) -> FloatArray:
    """(w,) the wanted numbers of a message."""
    if msgtype == JOINTS:
        return joints.of(message)
    values = []
    for column in COLUMNS[msgtype]:  # such as `orientation.x` or `orientation_covariance[0]`
        path, _, index = column.rstrip(']').partition('[')
        field = attrgetter(path)(message)
        values.append(float(field[int(index)] if index else field))
    return np.array(values)
