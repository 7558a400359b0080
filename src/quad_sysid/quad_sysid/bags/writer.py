"""A Record → a bag of the contract: `write_bag`; any streams of stamped messages: `write_streams`.

The inverse of reader.py. The bag logger of quad_bridge records live.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Literal

import numpy as np
from rosbags import interfaces as ros
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from quad_sysid.bags import cdr
from quad_sysid.bags.cdr import Stamped
from quad_sysid.bags.events import DESATURATION, DESATURATIONS, EVENT, Event, encode_event
from quad_sysid.bags.odometry import ODOM, odometry_of
from quad_sysid.bags.orientation import UNMEASURED, quaternions
from quad_sysid.contract import TOPIC_TYPES, FloatArray
from quad_sysid.craft import X
from quad_sysid.errors import BadInputError
from quad_sysid.files import escaped, unfinished
from quad_sysid.record import Record, Segment

Storage = Literal['mcap', 'sqlite3']
Compression = Literal['none', 'message', 'file', 'storage']

NODE_NAMES = {'/excitation/segment': '/excitation', '/gains/active': '/serial_bridge'}
BLOCK = 20_000
"""Messages of a topic that are encoded at once."""
UNKNOWN = ('temperature', 'current', 'charge', 'capacity', 'design_capacity', 'percentage')


@dataclass(frozen=True)
class BagOptions:
    """How a bag is stored, and notes for its metadata (custom_data)."""

    storage: Storage = 'mcap'
    compression: Compression = 'none'
    notes: Mapping[str, str] | None = None


def write_bag(record: Record, path: str | Path, options: BagOptions | None = None) -> Path:
    """Write a record as a rosbag2 directory; rows of NaN are not written.

    Without motors and wrench, the control is written as /motors/command through the craft's mixer.
    A craft that is not the contract's X frame is written as /robot_description. Raises
    BadInputError where `path` exists or the motor commands would lie outside 0..1.
    """
    stamps = record.t0_ns + np.rint(np.arange(record.n) * record.dt * 1e9).astype(np.int64)
    streams = {'/imu/data': _imu(record, stamps)}
    motors = record.motors
    if motors is None and record.wrench is None:
        motors = record.control @ record.craft.mixer.T
        low, high = float(np.nanmin(motors)), float(np.nanmax(motors))
        if low < -1e-9 or high > 1.0 + 1e-9:
            raise BadInputError(record.source, 'control gives motor commands outside 0..1',
                                f'{low:.3g} to {high:.3g}',
                                'scale the control down, or give the wrench')
        motors = np.clip(motors, 0.0, 1.0)
    wrench = record.wrench
    if wrench is not None:
        wrench = np.column_stack((np.zeros((record.n, 2)), wrench))
    battery = record.battery_v
    step = max(1, round(0.1 / record.dt))  # at 10 Hz
    arrays: dict[str, FloatArray | None] = {
        '/motors/command': motors,
        '/motors/state': record.speeds,
        '/control/wrench': wrench,
        '/setpoint/attitude': record.attitude_setpoint,
        '/setpoint/rates': record.rate_setpoint,
        '/excitation/applied': record.excitation,
    }
    for topic, array in arrays.items():
        if array is not None:
            streams[topic] = _stream(stamps, array)
    if battery is not None:
        streams['/battery'] = _stream(stamps[::step], battery[::step, None])
    odometry = odometry_of(record, stamps)
    if odometry is not None:
        streams[ODOM] = odometry
    return write_streams(path, streams, _events(record), options,
                         '' if record.craft == X else record.craft.to_urdf())


def write_streams(path: str | Path, streams: Mapping[str, Stamped],
                  events: Mapping[str, Sequence[Event]],
                  options: BagOptions | None = None, description: str = '') -> Path:
    """Write topics in the order of their stamps.

    `description`: the URDF of /robot_description, which stands before all others. Raises
    BadInputError where `path` exists or cannot be written.
    """
    path = Path(path)
    options = options or BagOptions()
    if path.exists():
        raise BadInputError(str(path), 'exists already and is not overwritten',
                            remedy='choose another --out')
    if escaped(path.name) != path.name:
        raise BadInputError(escaped(str(path)), 'is no UTF-8, as the name of a bag must be',
                            remedy='choose another --out')
    topics = [*streams, *events, *(['/robot_description'] if description else [])]
    plugin = StoragePlugin.MCAP if options.storage == 'mcap' else StoragePlugin.SQLITE3
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with unfinished(path.parent) as folder:
            writer = Writer(folder / path.name, version=9, storage_plugin=plugin)
            writer.set_compression(CompressionMode[options.compression.upper()],
                                   CompressionFormat.ZSTD)
            for key, text in (options.notes or {}).items():
                writer.set_custom_data(key, text)
            with writer:
                connections = {
                    topic: writer.add_connection(topic, TOPIC_TYPES[topic],
                                                 typestore=cdr.typestore(),
                                                 offered_qos_profiles=[_qos(TOPIC_TYPES[topic])])
                    for topic in topics
                }
                for stamp, topic, raw in _in_order(streams, events, description):
                    writer.write(connections[topic], stamp, raw)
            (folder / path.name).rename(path)
    except OSError as error:
        raise BadInputError(str(path), 'cannot be written', error.strerror,
                            'make room, or choose another --out') from error
    return path


def _in_order(
    streams: Mapping[str, Stamped], events: Mapping[str, Sequence[Event]], description: str
) -> Iterator[tuple[int, str, bytes]]:
    """Stamp, topic and bytes of every message in the order of the stamps.

    They are encoded block by block, so that hours fit into memory.
    """
    encoded = [(event.stamp, topic, encode_event(event, NODE_NAMES.get(topic, '/import')))
               for topic, items in events.items() for event in items]
    encoded.sort(key=lambda entry: entry[0])
    sources, stamps = [], [np.array([stamp for stamp, _, _ in encoded], dtype=np.int64)]
    for topic, stream in streams.items():
        kind = TOPIC_TYPES[topic]
        joints = cdr.Joints(stream.values.shape[1],
                        'velocity' if topic == '/motors/state' else 'effort')
        pattern = template(kind, joints)
        order = np.argsort(stream.stamps, kind='stable')
        sources.append((topic, kind, joints, pattern, stream, order))
        stamps.append(stream.stamps[order])
    if description:
        text = cdr.typestore().serialize_cdr(cdr.blank(cdr.TEXT, data=description), cdr.TEXT)
        first = min((int(times[0]) for times in stamps if times.size), default=0)
        yield first, '/robot_description', bytes(text)
    longest = max(stamps, key=len)
    edges = [int(stamp) for stamp in longest[BLOCK::BLOCK]]
    begins = [0] * len(stamps)
    for edge in (*edges, None):
        ends = [times.size if edge is None else int(np.searchsorted(times, edge))
                for times in stamps]
        part: list[tuple[int, str, bytes]] = []
        for k, (topic, kind, joints, pattern, stream, order) in enumerate(sources, 1):
            rows = order[begins[k] : ends[k]]
            raws = cdr.encode(kind, pattern, stream.stamps[rows], stream.values[rows], joints)
            part += zip(stream.stamps[rows].tolist(), [topic] * len(raws), raws, strict=True)
        part += encoded[begins[0] : ends[0]]
        part.sort(key=lambda entry: entry[0])
        yield from part
        begins = ends


def _stream(stamps: np.ndarray, values: FloatArray) -> Stamped:
    """Rows that contain a number."""
    finite = np.isfinite(values).any(axis=1)
    return Stamped(stamps[finite], values[finite])


def _imu(record: Record, stamps: np.ndarray) -> Stamped:
    values = np.zeros((record.n, cdr.WIDTH[cdr.IMU]))
    values[:, 3] = 1.0
    if record.angles is None:
        values[:, 4] = UNMEASURED
    else:
        values[:, 0:4] = quaternions(record.angles)
    values[:, 5:8] = record.rates
    if record.acceleration is None:
        values[:, 12] = UNMEASURED
    else:
        values[:, 8:11] = record.acceleration
    finite = np.isfinite(record.rates).any(axis=1)
    return Stamped(stamps[finite], values[finite])


def _events(record: Record) -> dict[str, list[Event]]:
    def stamp(seconds: float) -> int:
        return record.t0_ns + round(seconds * 1e9)

    segments: list[Event] = []
    together: dict[tuple[float, float, str], list[Segment]] = {}
    for each in sorted(record.segments, key=lambda s: s.start_s):
        together.setdefault((each.start_s, each.end_s, each.role), []).append(each)
    single = [same[0] for same in together.values()]
    axes = [','.join(s.axis for s in same) for same in together.values()]
    for i, segment in enumerate(single):
        names = {'segment': segment.role, 'signal': segment.signal, 'axis': segment.axis,
                 'injection': segment.injection, **({'axes': axes[i]} if ',' in axes[i] else {})}
        segments.append(Event(stamp(segment.start_s), {**names, **segment.parameters}))
        following = single[i + 1].start_s if i + 1 < len(single) else record.n * record.dt
        if following - segment.end_s > 0.5 * record.dt:
            idle = {**names, 'segment': 'idle', 'signal': 'none'}
            segments.append(Event(stamp(segment.end_s), idle))
    gains = [Event(stamp(change.time_s), dict(change.values)) for change in record.gains]
    if record.desaturation != DESATURATIONS[0]:
        gains.insert(0, Event(stamp(0.0), {DESATURATION: record.desaturation}))
    topics = {'/excitation/segment': segments, '/gains/active': gains}
    return {topic: events for topic, events in topics.items() if events}


def _qos(msgtype: str) -> ros.Qos:
    """Reliable; events and texts are kept for late subscribers (contract: transient local)."""
    unlimited = ros.QosTime(9223372036, 854775807)
    durability = ros.QosDurability.TRANSIENT_LOCAL if msgtype in {EVENT, cdr.TEXT} \
        else ros.QosDurability.VOLATILE
    return ros.Qos(ros.QosHistory.KEEP_LAST, 10, ros.QosReliability.RELIABLE, durability,
                   unlimited, unlimited, ros.QosLiveliness.AUTOMATIC, unlimited, False)


@lru_cache(maxsize=8)
def template(msgtype: str, joints: cdr.Joints = cdr.FOUR) -> bytes:
    """CDR of one message."""
    message = cdr.blank(msgtype)
    message.header.frame_id = 'base_link'
    if msgtype == cdr.IMU:
        message.orientation.w = 1.0
    elif msgtype == cdr.JOINTS:
        message.name = list(joints.names)
        setattr(message, joints.field, np.zeros(joints.count))
    elif msgtype == cdr.BATTERY:
        message.present = True
        for name in UNKNOWN:
            setattr(message, name, float('nan'))
    return bytes(cdr.typestore().serialize_cdr(message, msgtype))
