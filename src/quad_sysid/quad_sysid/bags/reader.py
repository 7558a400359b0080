"""A recorded bag → one Record: `read_bag`.

Assigns topics to arrays. storage.py finds the files, cdr.py decodes the bytes, stamps.py puts them
on the grid. No fitting, no filtering.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from quad_sysid.bags import events
from quad_sysid.bags.cdr import JOINTS, WIDTH, Joints, Stamped, decode, joints_of, text_of
from quad_sysid.bags.odometry import BARO, ODOM, moving
from quad_sysid.bags.orientation import UNMEASURED, euler_angles
from quad_sysid.bags.stamps import SEVERAL, Grid, new_rows, spread, uniform_grid
from quad_sysid.bags.storage import Storage
from quad_sysid.bags.stored.files import storage_in
from quad_sysid.contract import TOPIC_TYPES, FloatArray
from quad_sysid.craft import Craft, X, from_urdf
from quad_sysid.errors import BadInputError
from quad_sysid.files import escaped
from quad_sysid.record import Record

IMU_TOPIC = '/imu/data'
PX4_RATES = 'px4_msgs/VehicleAngularVelocity'
MOTORS, CONTROL = '/motors/command', '/control/wrench'
SPEEDS, DESCRIPTION = '/motors/state', '/robot_description'
ACCEL_HZ = 'sensor.accel_filter_hz'
SEGMENT, GAINS = '/excitation/segment', '/gains/active'
OPTIONAL = {
    'wrench': CONTROL,
    'motors': MOTORS,
    'attitude_setpoint': '/setpoint/attitude',
    'rate_setpoint': '/setpoint/rates',
    'excitation': '/excitation/applied',
}
COMMANDS = ('wrench', 'motors')
TOPICS = (IMU_TOPIC, *OPTIONAL.values(), SPEEDS, DESCRIPTION, '/battery', ODOM, BARO,
          SEGMENT, GAINS)

PLAUSIBLE_PACK_V = (2.0, 100.0)
"""Voltage of a battery, V; values outside are left out."""
BATTERY_GAP_S = 2.0
"""Longest gap, s, over which the voltage is interpolated, and how long it is held at the ends."""
LOST_WARNING = 0.01
"""Share of the cycles without a value above which a warning says so."""
OFF = 0.1
"""Distance of a command's stamp from its cycle's, cycles, above which a warning says so."""
LATER_PART = re.compile(r'_[1-9][0-9]{0,3}(\.[a-z0-9]+)+$')
"""How the name ends of a file of a split bag that is not its first."""
SPEED_GAP = 5.0
"""Rotor speeds that are further apart than this many of their usual intervals are not joined."""


@dataclass(frozen=True)
class _Content:
    """Content of the storage by topic."""

    streams: dict[str, Stamped]
    events: dict[str, list[bytes]]
    warnings: list[str]
    other_rates: list[str]
    """Other topics of the type of /imu/data, and PX4's."""
    description: str = ''
    """The text of /robot_description."""


def read_bag(path: str | Path) -> Record:
    """Record of a rosbag2 directory or an .mcap file, timed by header stamps alone.

    Raises BadInputError if it is no bag, or lacks /imu/data or both /motors/command and
    /control/wrench. The record's `warnings` say what was repaired.
    """
    source = str(path)
    content = _read(Path(path))
    imu = content.streams.get(IMU_TOPIC)
    if imu is None or len(imu.stamps) == 0:
        reasons = [line.removeprefix(source).lstrip('/: ') for line in content.warnings]
        why = f' ({"; ".join(reasons)})' if reasons else ''
        raise BadInputError(
            source, f'{IMU_TOPIC} is missing or empty{why}',
            remedy=f'the rates may be in {" or ".join(content.other_rates)}: '
            '`quad-sysid import` makes a bag of it' if content.other_rates
            else 'record it (sensor_msgs/msg/Imu); nothing can be identified without it',
        )
    grid = uniform_grid(imu.stamps, source)
    warnings = [*content.warnings, *grid.warnings]
    imu_grid = np.full((grid.n, WIDTH[TOPIC_TYPES[IMU_TOPIC]]), np.nan)
    imu_grid[grid.cells] = imu.values[grid.rows]
    new_angles, new_rates = (new_rows(imu.values[grid.rows, part])
                             for part in (slice(4), slice(5, 8)))
    warnings += [f'{IMU_TOPIC}: {what} stands in {new.size / new.sum():.3g} messages until the '
                 'next one was measured: each is taken once' for what, new in (
                     ('a rate', new_rates), ('an orientation', new_angles)) if not new.all()]
    imu_grid[imu_grid[:, 11] == UNMEASURED, 5:8] = np.nan
    imu_grid[imu_grid[:, 12] == UNMEASURED, 8:11] = np.nan
    rates = _finite(imu_grid[:, 5:8], IMU_TOPIC, 'angular_velocity', grid, warnings)
    rates[grid.cells[~new_rates]] = np.nan
    arrays = {name: _array(name, content, grid, warnings) for name in OPTIONAL}
    wrench, motors = arrays['wrench'], arrays['motors']
    gain_events, unreadable_gains = events.decode_events(content.events.get(GAINS, ()))
    desaturation = events.desaturation_from(gain_events)
    craft = _craft(content, source, warnings)
    if motors is not None:
        _check_count(motors.shape[1], craft, source, described=bool(content.description))
        control = craft.control(motors)
    elif wrench is not None and desaturation == 'none':
        control = wrench
        warnings.append(f'{MOTORS} is missing: the input is {CONTROL} as it was commanded; what '
                        'the motors made of it is not known')
    elif wrench is not None:
        control = craft.control(
            craft.commands(wrench, desaturation, events.idle_from(gain_events)))
        warnings.append(f'{MOTORS} is missing: the input is {CONTROL} through mixer and limits')
    else:
        raise BadInputError(source, f'{MOTORS} and {CONTROL} are both missing or empty',
                            remedy='record one of them; it is the input of the model')
    battery = _battery(content, grid, warnings)

    def seconds(stamp: int) -> float:
        return float(grid.position(np.array([stamp], dtype=np.int64))[0]) * grid.dt

    segment_events, unreadable = events.decode_events(content.events.get(SEGMENT, ()))
    segments, notes = events.segments_from(segment_events, seconds, grid.n * grid.dt)
    segments, unended = events.as_excited(segments, arrays['excitation'], grid.dt)
    notes += unended
    if unreadable + unreadable_gains:
        notes.append(f'{unreadable + unreadable_gains} parameter events cannot be read')
    angles = _angles(imu_grid[:, :5])
    if angles is not None and not new_angles.all():
        cells = grid.cells[new_angles]
        angles = joined(cells.astype(float), angles[cells], np.arange(float(grid.n)))
    acceleration = imu_grid[:, 8:11] if np.isfinite(imu_grid[:, 8:11]).any() else None
    gains = events.gains_from(gain_events, seconds)
    motion = moving(content.streams, grid, angles, acceleration, warnings)
    accel_hz = next((change.values.get(ACCEL_HZ) for change in gains), None)
    return Record(source=escaped(source), dt=grid.dt, rates=_frozen(rates),
                  control=_frozen(control), angles=_optional(angles),
                  acceleration=_optional(acceleration),
                  motors=_optional(motors), wrench=_optional(wrench),
                  speeds=_optional(_speeds(content, grid, craft, warnings)), craft=craft,
                  desaturation=desaturation,
                  attitude_setpoint=_optional(arrays['attitude_setpoint']),
                  rate_setpoint=_optional(arrays['rate_setpoint']),
                  excitation=_optional(arrays['excitation']), battery_v=_optional(battery),
                  velocity=_optional(motion.velocity), altitude=_optional(motion.altitude),
                  lean=_optional(motion.lean),
                  speed_filter_hz=accel_hz if motion.by_force else None,
                  segments=segments, gains=gains,
                  missing=_missing(content, arrays, battery), warnings=(*warnings, *notes),
                  t0_ns=grid.t0_ns)


def _read(path: Path) -> _Content:
    """Decode all wanted topics, batch by batch to bound the memory."""
    storage = Storage(path, TOPICS)
    parts: dict[str, list[Stamped]] = {}
    raw_events: dict[str, list[bytes]] = {}
    joints: dict[str, Joints] = {}
    for batch in storage.batches():
        for topic, raws in batch.items():
            expected = TOPIC_TYPES[topic]
            if expected == events.EVENT or topic == DESCRIPTION:
                raw_events.setdefault(topic, []).extend(raws)
                continue
            if expected == JOINTS and topic not in joints:
                joints[topic] = joints_of(raws, 'velocity' if topic == SPEEDS else 'effort')
            parts.setdefault(topic, []).append(decode(expected, raws, joints.get(topic, Joints())))
    warnings = list(storage.warnings)
    warnings += [f'{key}: {text}' for key, text in storage.notes.items()]
    streams = {}
    for topic, pieces in parts.items():
        stamps = np.concatenate([p.stamps for p in pieces])
        values = np.concatenate([p.values for p in pieces])
        times, note = spread(stamps.astype(float), values)
        warnings += [f'{topic}: {note}'] * bool(note)
        streams[topic] = Stamped(times.astype(np.int64) if note else stamps, values,
                                 sum(p.unreadable for p in pieces))
        if streams[topic].unreadable:
            warnings.append(f'{topic}: {streams[topic].unreadable} messages cannot be read as '
                            f'{TOPIC_TYPES[topic]}; left out')
    with_rates = {TOPIC_TYPES[IMU_TOPIC].replace('/msg/', '/'), PX4_RATES}
    rates = [name for name, kind in sorted(storage.others.items())
             if kind.replace('/msg/', '/') in with_rates]
    description = text_of(raw_events.pop(DESCRIPTION, []))
    return _Content(streams, raw_events, warnings, rates, description)


def _craft(content: _Content, source: str, warnings: list[str]) -> Craft:
    """The craft that the bag describes; the project's X frame where it does not."""
    if not content.description:
        path = Path(source)
        first = path if path.is_file() else storage_in(path.iterdir())[0]
        if LATER_PART.search(first.name) and first.name.partition('.')[0] != path.name:
            warnings.append(f'begins with {first.name}, by its name a later file of a split bag, '
                            f"and has no {DESCRIPTION}: the project's X frame is assumed; read "
                            'the whole bag')
        return X
    try:
        craft = from_urdf(content.description)
    except ValueError as error:
        raise BadInputError(source, f'{DESCRIPTION} {error}') from error
    if craft is None:
        warnings.append(f'{DESCRIPTION} has no joints motor_1 to motor_n, so it says nothing of '
                        "the motors: left aside, the project's X frame is assumed")
    return craft or X


def _check_count(motors: int, craft: Craft, source: str, *, described: bool) -> None:
    """Raise BadInputError where the commands are of more or fewer motors than the craft has."""
    if motors != craft.count:
        count = f'of {craft.count}' if described else 'missing, so there are four'
        raise BadInputError(source, f'{MOTORS} is of {motors} motors, {DESCRIPTION} is {count}',
                            remedy='record the description of this craft, a URDF with joints '
                            f'motor_1 to motor_{motors}')


def _speeds(content: _Content, grid: Grid, craft: Craft, warnings: list[str]) -> FloatArray | None:
    """Speeds of the rotors (n, k), rad/s, on the grid; None where they were not measured."""
    stream = content.streams.get(SPEEDS)
    if stream is None or len(stream.stamps) < 2 or not np.isfinite(stream.values).any():
        return None
    if stream.values.shape[1] != craft.count:
        warnings.append(f'{SPEEDS} has {stream.values.shape[1]} motors, the craft {craft.count}: '
                        'left out')
        return None
    stamps, rows = np.unique(stream.stamps, return_index=True)
    return joined(grid.position(stamps), stream.values[rows], np.arange(grid.n, dtype=float))


def joined(times: FloatArray, values: FloatArray, grid: FloatArray) -> FloatArray:
    """Samples (m, k) at increasing places, interpolated on a grid (n,); NaN over gaps."""
    out = np.full((grid.size, values.shape[1]), np.nan)
    for column, series in zip(out.T, values.T, strict=True):
        is_finite = np.isfinite(series)
        places = times[is_finite]
        if places.size < 2:
            continue
        steps = np.diff(places)
        after = np.clip(np.searchsorted(places, grid), 1, places.size - 1)
        near = steps[after - 1] <= SPEED_GAP * float(np.median(steps))
        inside = (grid >= places[0]) & (grid <= places[-1])
        column[:] = np.where(near & inside, np.interp(grid, places, series[is_finite]), np.nan)
    return out


def _array(name: str, content: _Content, grid: Grid, warnings: list[str]) -> FloatArray | None:
    """(n, k) one optional topic on the grid; None without usable values."""
    topic = OPTIONAL[name]
    stream = content.streams.get(topic)
    if stream is None or len(stream.stamps) == 0:
        return None
    lay = grid.commanded if name in COMMANDS else grid.place
    placed = lay(stream.stamps, stream.values)
    if name == 'wrench':
        placed = np.ascontiguousarray(placed[:, 2:6])
    finite = np.isfinite(placed).all(axis=1)
    if not finite.any():
        warnings.append(f'{topic}: no finite value at a stamp of {IMU_TOPIC}; not used')
        return None
    missing = 1.0 - np.count_nonzero(finite) / len(grid.cells)
    if name in COMMANDS and len(stream.stamps) > 1:
        warnings += filter(None, [_timing(topic, grid.position(stream.stamps))])
    if name != 'excitation' and missing > LOST_WARNING:
        warnings.append(
            f'{topic}: usable in only {100.0 * (1.0 - missing):.0f} % of the cycles of {IMU_TOPIC}'
        )
    return placed


def _timing(topic: str, place: FloatArray) -> str:
    """What is to be said of commands at these places (n,), cycles of the rates."""
    each = float(np.median(np.diff(place)))
    if each >= SEVERAL:
        return (f'{topic}: one for {each:.3g} cycles of {IMU_TOPIC}, held until the next one: '
                'where the controller is faster, fast motion has the wrong input')
    off = float(np.median(np.abs(place - np.rint(place))))
    if off <= OFF or each * SEVERAL <= 1.0:
        return ''
    return (f'{topic}: its stamps lie {off:.2g} of a cycle from those of {IMU_TOPIC}, and each '
            'command counts in the nearest cycle, so that the delay is wrong by as much: stamp it '
            'like the rates that it answers to')


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
    is_finite = np.isfinite(angles[:, 0])
    if not is_finite.any() or np.allclose(orientation[is_finite, :3], 0.0, atol=1e-12):
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
    plausible = finite & (volts >= low) & (volts <= high)
    outliers = volts[finite & ~plausible]
    if 2 * np.count_nonzero(plausible) < np.count_nonzero(finite):
        warnings.append(
            f'/battery: voltage around {np.median(outliers):.3g} V is no battery ({low:g} to '
            f'{high:g} V); counted as not measured'
        )
        return None
    if len(outliers):
        warnings.append(f'/battery: {len(outliers)} values outside {low:g} to {high:g} V left '
                        f'out, such as {outliers[0]:.3g} V')
    stamps, volts = stream.stamps[plausible], volts[plausible]
    places, first = np.unique(grid.position(stamps), return_index=True)
    reach, cells = BATTERY_GAP_S / grid.dt, np.arange(grid.n, dtype=float)
    places = np.concatenate([places[:1] - reach, places, places[-1:] + reach])
    battery: FloatArray = np.interp(cells, places, np.pad(volts[first], 1, 'edge'), np.nan, np.nan)
    after = np.clip(np.searchsorted(places, cells), 1, len(places) - 1)
    battery[np.diff(places)[after - 1] > reach + 1e-6] = np.nan
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
