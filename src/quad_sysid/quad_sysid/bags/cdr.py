"""Stamped messages of fixed layout in bulk: many CDR byte strings ↔ stamps and one array.

No files, no topics, no grids. Messages of one layout (layout.py) are read together; what fits none
goes through rosbags' own deserialiser, so the answer never depends on which way it was read.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from quad_sysid.bags.layout import Layout, LayoutError, layout_of, steps_of, typestore

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from quad_sysid.contract import FloatArray

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
"""How many layouts are tried among messages of one length before they are read one by one."""


@dataclass(frozen=True)
class Stamped:
    """Messages of one topic: stamps (n,) in ns, values (n, WIDTH[type]), `spoiled` unreadable."""

    stamps: npt.NDArray[np.int64]
    values: FloatArray
    spoiled: int = 0


def decode(msgtype: str, messages: Sequence[bytes]) -> Stamped:
    """Stamps and values of `messages` in their order; those that cannot be read are left out."""
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
    """Fill in the rows, all of one length, that share the first one's layout; which they are."""
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
    """(offset, dtype, count) of each run of numbers, and which number goes to which column."""
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
    """Copy one serialised message, `template`, with other stamps (n,) and values (n, w)."""
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


_VALUES: dict[str, Callable[[Any], FloatArray]] = {
    IMU: _imu_values,
    JOINTS: lambda m: np.asarray(m.effort, dtype=float)[list(motor_order(m.name))],
    WRENCH: lambda m: np.array([*_xyz(m.wrench.force), *_xyz(m.wrench.torque)]),
    VECTOR: lambda m: np.array(_xyz(m.vector)),
    BATTERY: lambda m: np.array([m.voltage]),
}
