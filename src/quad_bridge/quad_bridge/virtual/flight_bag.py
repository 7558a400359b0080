"""A simulated flight as a rosbag2 bag of the contract, written in bulk with rosbags.

All messages of a fixed-layout topic differ from their first one only in stamp and numbers, so
they are made by copying its CDR bytes and writing numpy columns over them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from quad_bridge.virtual.simulation import INJECTIONS, Excited, Flight
from quad_bridge.wire.axes import quaternion

FloatArray = npt.NDArray[np.float64]
Message = tuple[int, str, bytes]  # stamp in ns, topic, CDR bytes

TYPES = {
    '/imu/data': 'sensor_msgs/msg/Imu',
    '/motors/command': 'sensor_msgs/msg/JointState',
    '/control/wrench': 'geometry_msgs/msg/WrenchStamped',
    '/setpoint/attitude': 'geometry_msgs/msg/Vector3Stamped',
    '/setpoint/rates': 'geometry_msgs/msg/Vector3Stamped',
    '/excitation/setpoint': 'geometry_msgs/msg/Vector3Stamped',
    '/excitation/applied': 'geometry_msgs/msg/Vector3Stamped',
    '/rc/in': 'sensor_msgs/msg/Joy',
    '/battery': 'sensor_msgs/msg/BatteryState',
    '/imu/mag': 'sensor_msgs/msg/MagneticField',
    '/baro': 'sensor_msgs/msg/FluidPressure',
    '/excitation/segment': 'rcl_interfaces/msg/ParameterEvent',
    '/gains/active': 'rcl_interfaces/msg/ParameterEvent',
}
LATCHED = {'/excitation/segment', '/gains/active'}
STORE = get_typestore(Stores.ROS2_JAZZY)
_FIRST_DOUBLE = 28  # where the first double of a message with a header of frame `base_link` stands
_FOREVER = QosTime(9223372036, 854775807)


def write_bag(
    flight: Flight,
    path: Path,
    *,
    storage: str = 'mcap',
    start_ns: int = 1_750_000_000_000_000_000,
    leave_out: tuple[str, ...] = (),
) -> Path:
    """Write the flight to the new folder `path`; `storage` mcap or sqlite3; returns `path`."""
    messages = [m for m in _messages(flight, start_ns) if m[1] not in leave_out]
    messages.sort(key=lambda message: message[0])
    plugin = StoragePlugin.MCAP if storage == 'mcap' else StoragePlugin.SQLITE3
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        connections = {
            topic: writer.add_connection(
                topic, kind, typestore=STORE, offered_qos_profiles=[_qos(topic in LATCHED)]
            )
            for topic, kind in TYPES.items()
            if topic not in leave_out
        }
        for stamp, topic, data in messages:
            writer.write(connections[topic], stamp, data)
    return path


def _messages(flight: Flight, start_ns: int) -> Iterator[Message]:
    """All messages, topic by topic."""
    stamps = start_ns + np.round(flight.time_s * 1e9).astype(np.int64)
    yield from _events(flight, stamps)
    for topic, rows, values in _streams(flight):
        offset = _FIRST_DOUBLE
        if topic == '/motors/command':
            offset = len(_template(topic)) - 32
        for stamp, data in _bulk(_template(topic), stamps[rows], values, offset):
            yield stamp, topic, data
    yield from _receiver_and_battery(flight, stamps)


def _streams(flight: Flight) -> Iterator[tuple[str, npt.NDArray[np.int64], FloatArray]]:
    """Topic, rows of the flight, and the doubles of its messages."""
    count = flight.time_s.size
    every = np.arange(count)
    slow = every[:: flight.profile.sensors.slow_divider]
    none = np.zeros((count, 9))
    orientation = np.array([quaternion((a, b, c)) for a, b, c in flight.angles.tolist()])
    imu = np.hstack(
        [orientation.reshape(-1, 4), none, flight.rates, none, flight.acceleration, none]
    )
    wrench = np.hstack([np.zeros((count, 2)), flight.wrench])
    excited = np.flatnonzero(flight.injection)
    yield '/imu/data', every, imu
    yield '/motors/command', every, flight.motors
    yield '/control/wrench', every, wrench
    yield '/setpoint/attitude', every, flight.attitude_setpoint
    yield '/setpoint/rates', every, flight.rate_setpoint
    yield '/excitation/setpoint', excited, flight.excitation[excited]
    yield '/excitation/applied', excited, flight.excitation[excited]
    yield '/imu/mag', slow, np.hstack([flight.mag[slow], none[slow]])
    yield '/baro', slow, np.column_stack([flight.pressure_pa[slow], np.zeros(slow.size)])


def _bulk(
    template: bytes, stamps: npt.NDArray[np.int64], values: FloatArray, offset: int
) -> Iterator[tuple[int, bytes]]:
    """Copies of `template` with the stamps and, from byte `offset` on, the rows of `values`."""
    rows = np.tile(np.frombuffer(template, dtype=np.uint8), (stamps.size, 1))
    rows[:, 4:8] = (stamps // 1_000_000_000).astype('<i4')[:, None].view(np.uint8)
    rows[:, 8:12] = (stamps % 1_000_000_000).astype('<u4')[:, None].view(np.uint8)
    raw = np.ascontiguousarray(values, dtype='<f8').view(np.uint8)
    rows[:, offset : offset + raw.shape[1]] = raw
    for stamp, row in zip(stamps.tolist(), rows, strict=True):
        yield stamp, row.tobytes()


def _template(topic: str) -> bytes:
    """CDR bytes of the topic's message with zeros in all numbers."""
    t = STORE.types
    header, three = _header(0), t['geometry_msgs/msg/Vector3'](0.0, 0.0, 0.0)
    kind = TYPES[topic]
    nine = np.zeros(9)
    fields: dict[str, tuple[Any, ...]] = {
        'sensor_msgs/msg/Imu': (
            t['geometry_msgs/msg/Quaternion'](0.0, 0.0, 0.0, 1.0),
            nine,
            three,
            nine,
            three,
            nine,
        ),
        'sensor_msgs/msg/JointState': (
            [f'motor_{i}' for i in range(1, 5)],
            np.zeros(0),
            np.zeros(0),
            np.zeros(4),
        ),
        'geometry_msgs/msg/WrenchStamped': (t['geometry_msgs/msg/Wrench'](three, three),),
        'geometry_msgs/msg/Vector3Stamped': (three,),
        'sensor_msgs/msg/MagneticField': (three, nine),
        'sensor_msgs/msg/FluidPressure': (0.0, 0.0),
    }
    return bytes(STORE.serialize_cdr(t[kind](header, *fields[kind]), kind))


def _receiver_and_battery(flight: Flight, stamps: npt.NDArray[np.int64]) -> Iterator[Message]:
    """/rc/in at 50 Hz (sticks as flown), /battery at 10 Hz."""
    t, rate = STORE.types, flight.profile.firmware.rate_hz
    joy, battery = TYPES['/rc/in'], TYPES['/battery']
    aux = [-1.0] * 5
    for row in range(0, stamps.size, round(rate / 50.0)):
        roll, pitch, yaw = flight.sticks[row]
        axes = np.array([roll, pitch, flight.throttle[row], yaw, *aux], dtype=np.float32)
        buttons = np.zeros(1, dtype=np.int32)
        stamp = int(stamps[row])
        message = t[joy](_header(stamp), axes, buttons)
        yield stamp, '/rc/in', bytes(STORE.serialize_cdr(message, joy))
    nan, none = float('nan'), np.zeros(0, dtype=np.float32)
    for row in range(0, stamps.size, round(rate / 10.0)):
        stamp = int(stamps[row])
        volts = float(flight.battery_v[row])
        message = t[battery](
            _header(stamp), volts, nan, nan, nan, nan, nan, nan, 2, 1, 3, True, none, none, '', ''
        )
        yield stamp, '/battery', bytes(STORE.serialize_cdr(message, battery))


def _events(flight: Flight, stamps: npt.NDArray[np.int64]) -> Iterator[Message]:
    """/gains/active once, /excitation/segment at each start and end."""
    first = int(stamps[0])
    yield first, '/gains/active', _event(first, '/serial_bridge', flight.gains)
    parts = sorted(flight.schedule, key=lambda part: part.start_s)
    axis = parts[0].axis if parts else 'roll'
    idle = {'segment': 'idle', 'signal': 'none', 'axis': axis, 'injection': 'attitude'}
    if not parts or parts[0].start_s > 0:
        yield first, '/excitation/segment', _event(first, '/excitation', idle)
    for part, follower in zip(parts, [*parts[1:], None], strict=True):
        start = first + round(part.start_s * 1e9)
        yield start, '/excitation/segment', _event(start, '/excitation', _segment(part))
        end_s = part.start_s + part.samples.size * flight.dt
        touching = follower is not None and follower.start_s <= end_s + flight.dt / 2
        end = first + round(end_s * 1e9)
        if not touching and end <= int(stamps[-1]):
            over = {**idle, 'axis': part.axis}
            yield end, '/excitation/segment', _event(end, '/excitation', over)


def _segment(part: Excited) -> dict[str, float | int | str]:
    """What the excitation node would say of a segment."""
    if part.injection not in INJECTIONS:
        raise ValueError(f'schedule: injection must be one of {INJECTIONS}: {part.injection!r}')
    return {
        'segment': part.role,
        'signal': part.signal,
        'axis': part.axis,
        'injection': part.injection,
        **part.parameters,
    }


def _event(stamp: int, node: str, values: Mapping[str, float | int | str]) -> bytes:
    t, kind = STORE.types, 'rcl_interfaces/msg/ParameterEvent'
    changed = [
        t['rcl_interfaces/msg/Parameter'](name, _parameter_value(value))
        for name, value in values.items()
    ]
    message = t[kind](_time(stamp), node, [], changed, [])
    return bytes(STORE.serialize_cdr(message, kind))


def _parameter_value(value: float | str) -> Any:
    number = isinstance(value, (int, float))
    whole = isinstance(value, int)
    code = 4 if not number else (2 if whole else 3)
    none = [np.zeros(0, dtype=kind) for kind in (np.int8, np.bool_, np.int64, np.float64)]
    return STORE.types['rcl_interfaces/msg/ParameterValue'](
        code,
        False,
        value if whole else 0,
        value if number and not whole else 0.0,
        '' if number else value,
        *none,
        [],
    )


def _time(stamp: int) -> Any:
    sec, nanosec = divmod(stamp, 1_000_000_000)
    return STORE.types['builtin_interfaces/msg/Time'](sec, nanosec)


def _header(stamp: int) -> Any:
    return STORE.types['std_msgs/msg/Header'](_time(stamp), 'base_link')


def _qos(latched: bool) -> Qos:
    durability = QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE
    return Qos(
        QosHistory.KEEP_LAST,
        50,
        QosReliability.RELIABLE,
        durability,
        _FOREVER,
        _FOREVER,
        QosLiveliness.AUTOMATIC,
        _FOREVER,
        False,
    )
