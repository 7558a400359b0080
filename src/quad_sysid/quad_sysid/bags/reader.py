"""A recorded bag → one Record: `read_bag`.

Assigns topics to arrays. storage.py finds the files, cdr.py decodes the bytes, stamps.py puts them
on the grid. No fitting, no filtering.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from quad_sysid.bags.cdr import WIDTH, Stamped, decode
from quad_sysid.bags.events import EVENT, decode_events, gains_from, segments_from
from quad_sysid.bags.orientation import euler_angles
from quad_sysid.bags.stamps import Grid, uniform_grid
from quad_sysid.bags.storage import Storage
from quad_sysid.contract import (
    TOPIC_TYPES,
    FloatArray,
    control_from_motors,
    motors_from_wrench,
)
from quad_sysid.errors import BadInputError
from quad_sysid.record import Record

IMU_TOPIC = '/imu/data'
MOTORS, CONTROL = '/motors/command', '/control/wrench'
SEGMENT, GAINS = '/excitation/segment', '/gains/active'
OPTIONAL = {
    'wrench': CONTROL,
    'motors': MOTORS,
    'attitude_setpoint': '/setpoint/attitude',
    'rate_setpoint': '/setpoint/rates',
    'excitation': '/excitation/applied',
}
TOPICS = (IMU_TOPIC, *OPTIONAL.values(), '/battery', SEGMENT, GAINS)

PLAUSIBLE_PACK_V = (2.0, 100.0)
BATTERY_GAP_S = 2.0
LOST_WARNING = 0.01


@dataclass(frozen=True)
class _Content:
    """Content of the storage by topic."""

    streams: dict[str, Stamped]
    events: dict[str, list[bytes]]
    warnings: list[str]
    alike: list[str]
    """Other topics of the type of /imu/data."""


def read_bag(path: str | Path) -> Record:
    """Record of a rosbag2 directory or an .mcap file, timed by header stamps alone.

    Raises BadInputError if it is no bag, or lacks /imu/data or both /motors/command and
    /control/wrench. The record's `warnings` say what was repaired.
    """
    source = str(path)
    content = _read(Path(path))
    imu = content.streams.get(IMU_TOPIC)
    if imu is None or len(imu.stamps) == 0:
        told = [line.removeprefix(source).lstrip('/: ') for line in content.warnings]
        why = f' ({"; ".join(told)})' if told else ''
        raise BadInputError(
            source, f'{IMU_TOPIC} is missing or empty{why}',
            remedy=f'its type is that of {" and ".join(content.alike)}: `quad-sysid import` makes '
            'a bag of it' if content.alike
            else 'record it (sensor_msgs/msg/Imu); nothing can be identified without it',
        )
    grid = uniform_grid(imu.stamps, source)
    warnings = [*content.warnings, *grid.warnings]
    placed = np.full((grid.n, WIDTH[TOPIC_TYPES[IMU_TOPIC]]), np.nan)
    placed[grid.cells] = imu.values[grid.rows]
    rates = _finite(placed[:, 5:8], IMU_TOPIC, 'angular_velocity', grid, warnings)
    arrays = {name: _array(name, content, grid, warnings) for name in OPTIONAL}
    wrench, motors = arrays['wrench'], arrays['motors']
    if motors is not None:
        control = control_from_motors(motors)
    elif wrench is not None:
        control = control_from_motors(motors_from_wrench(wrench))
        warnings.append(f'{MOTORS} is missing: the input is {CONTROL} through mixer and limits')
    else:
        raise BadInputError(source, f'{MOTORS} and {CONTROL} are both missing or empty',
                            remedy='record one of them; it is the input of the model')
    battery = _battery(content, grid, warnings)

    def seconds(stamp: int) -> float:
        return float(grid.position(np.array([stamp], dtype=np.int64))[0]) * grid.dt

    segment_events, spoiled = decode_events(content.events.get(SEGMENT, ()))
    segments, told = segments_from(segment_events, seconds, grid.n * grid.dt)
    gain_events, spoiled_gains = decode_events(content.events.get(GAINS, ()))
    if spoiled + spoiled_gains:
        told.append(f'{spoiled + spoiled_gains} parameter events cannot be read')
    acceleration = placed[:, 8:11] if np.isfinite(placed[:, 8:11]).any() else None
    return Record(source=source, dt=grid.dt, rates=_frozen(rates), control=_frozen(control),
                  angles=_optional(_angles(placed[:, :5])), acceleration=_optional(acceleration),
                  motors=_optional(motors), wrench=_optional(wrench),
                  attitude_setpoint=_optional(arrays['attitude_setpoint']),
                  rate_setpoint=_optional(arrays['rate_setpoint']),
                  excitation=_optional(arrays['excitation']), battery_v=_optional(battery),
                  segments=segments, gains=gains_from(gain_events, seconds),
                  missing=_missing(content, arrays, battery), warnings=(*warnings, *told),
                  t0_ns=grid.t0_ns)


def _read(path: Path) -> _Content:
    """Decode all wanted topics, batch by batch to bound the memory."""
    storage = Storage(path, TOPICS)
    parts: dict[str, list[Stamped]] = {}
    events: dict[str, list[bytes]] = {}
    for batch in storage.batches():
        for topic, raws in batch.items():
            wanted = TOPIC_TYPES[topic]
            if wanted == EVENT:
                events.setdefault(topic, []).extend(raws)
            else:
                parts.setdefault(topic, []).append(decode(wanted, raws))
    warnings = list(storage.warnings)
    warnings += [f'{key}: {text}' for key, text in storage.notes.items()]
    streams = {}
    for topic, pieces in parts.items():
        streams[topic] = Stamped(np.concatenate([p.stamps for p in pieces]),
                                 np.concatenate([p.values for p in pieces]),
                                 sum(p.spoiled for p in pieces))
        if streams[topic].spoiled:
            warnings.append(
                f'{topic}: {streams[topic].spoiled} messages cannot be read as '
                f'{TOPIC_TYPES[topic]} of the contract; left out'
            )
    alike = [name for name, kind in sorted(storage.others.items())
             if kind.replace('/msg/', '/') == TOPIC_TYPES[IMU_TOPIC].replace('/msg/', '/')]
    return _Content(streams, events, warnings, alike)


def _array(name: str, content: _Content, grid: Grid, warnings: list[str]) -> FloatArray | None:
    """(n, k) one optional topic on the grid; None without usable values."""
    topic = OPTIONAL[name]
    stream = content.streams.get(topic)
    if stream is None or len(stream.stamps) == 0:
        return None
    placed = grid.place(stream.stamps, stream.values)
    if name == 'wrench':
        placed = np.ascontiguousarray(placed[:, 2:6])
    seen = np.isfinite(placed).all(axis=1)
    if not seen.any():
        warnings.append(f'{topic}: no finite value at a stamp of {IMU_TOPIC}; not used')
        return None
    lost = 1.0 - np.count_nonzero(seen) / len(grid.cells)
    if name != 'excitation' and lost > LOST_WARNING:
        warnings.append(
            f'{topic}: usable in only {100.0 * (1.0 - lost):.0f} % of the cycles of {IMU_TOPIC}'
        )
    return placed


def _finite(values: FloatArray, topic: str, field: str, grid: Grid,
            warnings: list[str]) -> FloatArray:
    """Values with infinities as NaN; warns of received samples that are not finite."""
    came = np.isfinite(values[grid.cells]).all(axis=1)
    count = int(np.count_nonzero(~came))
    if count:
        warnings.append(f'{topic}: {count} samples of {field} are NaN or infinite; kept as gaps')
    return np.where(np.isfinite(values), values, np.nan)


def _angles(orientation: FloatArray) -> FloatArray | None:
    """Roll, pitch, yaw (n, 3), rad; None where unknown or constantly the identity."""
    angles = euler_angles(orientation)
    known = np.isfinite(angles[:, 0])
    if not known.any() or np.allclose(orientation[known, :3], 0.0, atol=1e-12):
        return None
    return angles


def _battery(content: _Content, grid: Grid, warnings: list[str]) -> FloatArray | None:
    """Battery voltage (n,), V, interpolated; None where it was not measured."""
    stream = content.streams.get('/battery')
    if stream is None or len(stream.stamps) == 0:
        return None
    volts = stream.values[:, 0]
    finite = np.isfinite(volts)
    if not finite.any():
        warnings.append('/battery: voltage is NaN throughout; counted as not measured')
        return None
    low, high = PLAUSIBLE_PACK_V
    good = finite & (volts >= low) & (volts <= high)
    strange = volts[finite & ~good]
    if 2 * np.count_nonzero(good) < np.count_nonzero(finite):
        warnings.append(
            f'/battery: voltage around {np.median(strange):.3g} V is no battery ({low:g} to '
            f'{high:g} V); counted as not measured'
        )
        return None
    if len(strange):
        warnings.append(f'/battery: {len(strange)} values outside {low:g} to {high:g} V left out, '
                        f'such as {strange[0]:.3g} V')
    stamps, volts = stream.stamps[good], volts[good]
    places = grid.position(stamps)
    places, first = np.unique(places, return_index=True)
    cells = np.arange(grid.n, dtype=float)
    battery: FloatArray = np.interp(cells, places, volts[first])
    after = np.clip(np.searchsorted(places, cells), 1, max(1, len(places) - 1))
    if len(places) > 1:
        wide = (places[after] - places[after - 1]) * grid.dt > BATTERY_GAP_S
        inside = (cells > places[0]) & (cells < places[-1])
        battery[wide & inside] = np.nan
    return battery


def _missing(content: _Content, arrays: dict[str, FloatArray | None],
             battery: FloatArray | None) -> tuple[str, ...]:
    """Topics that a Record could use but the bag lacks."""
    absent = [OPTIONAL[name] for name, array in arrays.items() if array is None]
    if battery is None:
        absent.append('/battery')
    return (*absent, *(topic for topic in (SEGMENT, GAINS) if topic not in content.events))


def _frozen(array: FloatArray) -> FloatArray:
    out = np.ascontiguousarray(array, dtype=float)
    out.setflags(write=False)
    return out


def _optional(array: FloatArray | None) -> FloatArray | None:
    return None if array is None else _frozen(array)
