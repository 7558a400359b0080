"""Stamped messages of fixed layout in bulk: many CDR byte strings ↔ stamps and one array.

No files, no topics, no grids. A message whose layout differs from its neighbours' goes through
rosbags' own deserialiser, so the answer never depends on which way it was read.
Source of the layout: OMG CDR (XCDR1), 4 bytes of encapsulation header, alignment counted after it.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from rosbags.typesys import Stores, get_typestore

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rosbags.typesys.store import Typestore

    from quad_sysid.contract import FloatArray

IMU = 'sensor_msgs/msg/Imu'
JOINTS = 'sensor_msgs/msg/JointState'
WRENCH = 'geometry_msgs/msg/WrenchStamped'
VECTOR = 'geometry_msgs/msg/Vector3Stamped'
BATTERY = 'sensor_msgs/msg/BatteryState'

MOTOR_NAMES = ('motor_1', 'motor_2', 'motor_3', 'motor_4')

WIDTH = {IMU: 11, JOINTS: 4, WRENCH: 6, VECTOR: 3, BATTERY: 1}
"""Columns per type. Imu: orientation x y z w, orientation_covariance[0], rates, acceleration.
JointState: effort of motor_1..motor_4. Wrench: force, torque. Battery: voltage."""

LITTLE_ENDIAN = b'\x00\x01'


@dataclass(frozen=True)
class Stamped:
    """Messages of one topic: stamps (n,) in ns, values (n, WIDTH[type]), `spoiled` unreadable."""

    stamps: npt.NDArray[np.int64]
    values: FloatArray
    spoiled: int = 0


@dataclass(frozen=True)
class Layout:
    """Where the numbers of one message lie. Messages of this layout agree in `fixed` bytes."""

    columns: tuple[tuple[int, str, int], ...]
    """(offset, dtype, count) of each run of numbers; in the order of the columns."""
    order: tuple[int, ...]
    """Which number of the runs stands in which column."""
    fixed: tuple[tuple[int, int], ...]
    """Byte ranges [start, stop) of lengths and names."""


class LayoutError(Exception):
    """The bytes hold no message of a layout that can be read in bulk."""


@lru_cache(maxsize=1)
def typestore() -> Typestore:
    """Rosbags' table of Jazzy's message types."""
    return get_typestore(Stores.ROS2_JAZZY)


def decode(msgtype: str, messages: Sequence[bytes]) -> Stamped:
    """Stamps and values of `messages` in their order; those that cannot be read are left out."""
    stamps = np.zeros(len(messages), dtype=np.int64)
    values = np.full((len(messages), WIDTH[msgtype]), np.nan)
    good = np.zeros(len(messages), dtype=bool)
    lengths = np.fromiter(map(len, messages), dtype=np.int64, count=len(messages))
    for length in np.unique(lengths):
        rows = np.flatnonzero(lengths == length)
        group = [messages[i] for i in rows.tolist()]
        taken = _decode_group(msgtype, group, stamps, values, rows)
        good[taken] = True
    for i in np.flatnonzero(~good).tolist():
        try:
            stamps[i], values[i] = _decode_one(msgtype, messages[i])
        except Exception:  # noqa: BLE001, S112 - rosbags raises many kinds on spoiled bytes
            continue
        good[i] = True
    return Stamped(stamps[good], values[good], int(np.count_nonzero(~good)))


def _decode_group(
    msgtype: str,
    messages: list[bytes],
    stamps: npt.NDArray[np.int64],
    values: FloatArray,
    rows: npt.NDArray[np.intp],
) -> npt.NDArray[np.intp]:
    """Fill in the rows whose bytes agree with the first one's layout; returns these rows."""
    try:
        layout = layout_of(msgtype, messages[0])
    except (LayoutError, struct.error, UnicodeDecodeError):
        return rows[:0]
    table = np.frombuffer(b''.join(messages), dtype=np.uint8).reshape(len(messages), -1)
    same = np.ones(len(messages), dtype=bool)
    for start, stop in layout.fixed:
        same &= (table[:, start:stop] == table[0, start:stop]).all(axis=1)
    picked = table if same.all() else table[same]
    taken = rows[same]
    seconds = _numbers(picked, 4, '<i4', 1)[:, 0].astype(np.int64)
    stamps[taken] = seconds * 1_000_000_000 + _numbers(picked, 8, '<u4', 1)[:, 0]
    columns = [_numbers(picked, *column) for column in layout.columns]
    values[taken] = np.concatenate(columns, axis=1)[:, list(layout.order)]
    return taken


def _numbers(table: npt.NDArray[np.uint8], offset: int, dtype: str, count: int) -> Any:
    """Take (n, count) numbers at one offset of every row."""
    size = np.dtype(dtype).itemsize * count
    return np.ascontiguousarray(table[:, offset : offset + size]).view(dtype)


def encode(
    msgtype: str, template: bytes, stamps: npt.NDArray[np.int64], values: FloatArray
) -> list[bytes]:
    """Copy one serialised message, `template`, with other stamps (n,) and values (n, w)."""
    layout = layout_of(msgtype, template)
    table = np.tile(np.frombuffer(template, dtype=np.uint8), (len(stamps), 1))
    seconds, rest = np.divmod(stamps, 1_000_000_000)
    table[:, 4:8] = seconds.astype('<i4')[:, None].view(np.uint8)
    table[:, 8:12] = rest.astype('<u4')[:, None].view(np.uint8)
    start = 0
    for offset, dtype, count in layout.columns:
        block = np.empty((len(stamps), count), dtype=dtype)
        for column, place in enumerate(layout.order):
            if start <= place < start + count:
                block[:, place - start] = values[:, column]
        size = block.dtype.itemsize * count
        table[:, offset : offset + size] = block.view(np.uint8)
        start += count
    return [row.tobytes() for row in table]


def layout_of(msgtype: str, raw: bytes) -> Layout:
    """Layout of one little-endian message; raises LayoutError where it is not of that kind."""
    if raw[:2] != LITTLE_ENDIAN:
        raise LayoutError(raw[:2].hex())
    layout = _LAYOUTS[msgtype](raw)
    end = max(offset + np.dtype(dtype).itemsize * count for offset, dtype, count in layout.columns)
    if end > len(raw):
        raise LayoutError(f'{len(raw)} bytes')
    return layout


def _align(offset: int, size: int) -> int:
    """Next offset aligned to `size`, counted after the encapsulation header."""
    return offset + (4 - offset) % size


def _header(raw: bytes) -> int:
    """Offset after std_msgs/Header."""
    (length,) = struct.unpack_from('<I', raw, 12)
    return 16 + int(length)


def _plain(dtype: str, count: int) -> Callable[[bytes], Layout]:
    """Layout of a header and `count` numbers of one dtype."""

    def layout(raw: bytes) -> Layout:
        offset = _align(_header(raw), np.dtype(dtype).itemsize)
        return Layout(((offset, dtype, count),), tuple(range(count)), ((0, 2), (12, 16)))

    return layout


def _imu(raw: bytes) -> Layout:
    start = _align(_header(raw), 8)
    columns = ((start, '<f8', 5), (start + 13 * 8, '<f8', 3), (start + 25 * 8, '<f8', 3))
    return Layout(columns, tuple(range(11)), ((0, 2), (12, 16)))


def _joints(raw: bytes) -> Layout:
    fixed = [(0, 2), (12, 16)]
    offset = _align(_header(raw), 4)
    start = offset
    (count,) = struct.unpack_from('<I', raw, offset)
    offset += 4
    names = []
    for _ in range(min(count, 64)):
        offset = _align(offset, 4)
        (length,) = struct.unpack_from('<I', raw, offset)
        names.append(raw[offset + 4 : offset + 3 + length].decode())
        offset += 4 + length
    fixed.append((start, offset))
    for field in ('position', 'velocity', 'effort'):
        offset = _align(offset, 4)
        (count,) = struct.unpack_from('<I', raw, offset)
        fixed.append((offset, offset + 4))
        offset += 4
        if count:
            offset = _align(offset, 8)
        if field == 'effort' and count == len(MOTOR_NAMES):
            return Layout(((offset, '<f8', 4),), motor_order(names), tuple(fixed))
        offset += 8 * count
    raise LayoutError('effort does not hold four motors')


def motor_order(names: Sequence[str]) -> tuple[int, ...]:
    """Where motor_1..motor_4 stand among `names`; without names in this order."""
    if not names:
        return 0, 1, 2, 3
    if sorted(names) != sorted(MOTOR_NAMES):
        raise LayoutError(f'names {list(names)}')
    return tuple(list(names).index(name) for name in MOTOR_NAMES)


def _decode_one(msgtype: str, raw: bytes) -> tuple[int, FloatArray]:
    """Stamp and values by rosbags' deserialiser."""
    message: Any = typestore().deserialize_cdr(raw, msgtype)
    stamp = message.header.stamp
    return stamp.sec * 1_000_000_000 + stamp.nanosec, _VALUES[msgtype](message)


def _xyz(vector: Any) -> list[float]:
    return [vector.x, vector.y, vector.z]


def _imu_values(message: Any) -> FloatArray:
    quaternion = message.orientation
    return np.array(
        [
            *_xyz(quaternion), quaternion.w, message.orientation_covariance[0],
            *_xyz(message.angular_velocity), *_xyz(message.linear_acceleration),
        ]
    )


_LAYOUTS: dict[str, Callable[[bytes], Layout]] = {
    IMU: _imu,
    JOINTS: _joints,
    WRENCH: _plain('<f8', 6),
    VECTOR: _plain('<f8', 3),
    BATTERY: _plain('<f4', 1),
}

_VALUES: dict[str, Callable[[Any], FloatArray]] = {
    IMU: _imu_values,
    JOINTS: lambda m: np.asarray(m.effort, dtype=float)[list(motor_order(m.name))],
    WRENCH: lambda m: np.array([*_xyz(m.wrench.force), *_xyz(m.wrench.torque)]),
    VECTOR: lambda m: np.array(_xyz(m.vector)),
    BATTERY: lambda m: np.array([m.voltage]),
}
