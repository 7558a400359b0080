"""Speed over the ground and altitude on the grid: of /odom, or of barometer and accelerometer.

Messages to arrays and back; what they mean is in motion.py. REP-105 and REP-103: the pose is in a
world ENU, the twist in the body's FLU; a source that writes the twist in the world is recognised
by its positions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from quad_sysid.bags.cdr import Stamped
from quad_sysid.bags.orientation import MIN_NORM, euler_from_quaternion, quaternions
from quad_sysid.bags.stamps import Grid
from quad_sysid.contract import FloatArray
from quad_sysid.motion import altitude_of, in_body, lean, over_level, turned, vertical_motion
from quad_sysid.record import Record

ODOM, BARO = '/odom', '/baro'
LEAST = 10
"""Messages of a topic that is used."""
MOVES_M = 0.05
"""Positions that spread less say nothing of how fast the aircraft is."""
SLOWEST_BARO_S = 0.5
"""Longest usual interval of a barometer, s, from which the vertical speed is taken."""
LONGEST_BARO_S = 2.0
"""Longest gap of a barometer, s, over which its height goes on straight: by 2 s the speed errs by
0.04 m/s where it swings by 2 m/s every 20 s, by 5 s by 0.3 m/s. What is heard for less tells less:
over 1 s the speed errs by up to 2 m/s."""
SMOOTH_S = 0.2
"""Slopes of positions are compared with the twist as means over this: their noise is white."""
CLOSER = 0.5
"""The twist is in the world's frame if it is that much closer to the slopes there: where the body
hardly turns both are about as close, and what the message says counts."""
AIR_PA = (1e4, 1.2e5)
"""Air, from 16 km of altitude to below the sea's level."""


@dataclass(frozen=True)
class Moving:
    """Motion over the ground, as a bag has it; None where it has none."""

    velocity: FloatArray | None = None
    """(n, 3) m/s forward, left, up; NaN where not measured."""
    altitude: FloatArray | None = None
    """(n,) m."""
    lean: FloatArray | None = None
    """(n, 2) as Record.lean."""
    by_force: bool = False
    """Whether the vertical speed is that of barometer and accelerometer."""


def moving(streams: Mapping[str, Stamped], grid: Grid, angles: FloatArray | None,
           acceleration: FloatArray | None, warnings: list[str]) -> Moving:
    """Motion by /odom where the bag has it, else the vertical one by /baro and accelerometer."""
    motion = _odometry(streams.get(ODOM), grid, angles, warnings)
    if motion.velocity is not None or acceleration is None or angles is None:
        return motion
    return _vertical(streams.get(BARO), grid, angles, acceleration)


def _odometry(stream: Stamped | None, grid: Grid, angles: FloatArray | None,
              warnings: list[str]) -> Moving:
    if stream is None:
        return Moving()
    stamps, rows = np.unique(stream.stamps, return_index=True)
    upward = not np.isfinite(stream.values[:, 7:9]).any()  # no horizontal speed is known
    columns = [*range(7), 9] if upward else slice(None)
    rows = rows[np.isfinite(stream.values[rows][:, columns]).all(axis=1)]
    if rows.size < LEAST:
        warnings.append(f'{ODOM}: {rows.size} messages whose numbers are finite; not used')
        return Moving()
    stamps, values = stream.stamps[rows], stream.values[rows]
    position, quaternion, twist = values[:, :3], values[:, 3:7], values[:, 7:]
    leans: FloatArray | None = None
    norm = np.linalg.norm(quaternion, axis=1)
    if (norm > MIN_NORM).all() and np.abs(quaternion[:, :3]).max() > 1e-9:
        attitude = euler_from_quaternion(quaternion / norm[:, None])
        leans = grid.place(stamps, lean(attitude))
    elif angles is not None:  # positions only: the attitude is that of /imu/data
        finite = np.flatnonzero(np.isfinite(angles).all(axis=1))
        attitude = np.column_stack([np.interp(grid.position(stamps), finite, a[finite])
                                    for a in angles.T])
    else:
        warnings.append(f'{ODOM} and /imu/data hold no attitude; not used')
        return Moving()
    level = twist if upward else _over_heading(position, twist, attitude, stamps, warnings)
    if level is None:
        return Moving()
    return Moving(grid.place(stamps, level), grid.place(stamps, position[:, 2:])[:, 0], leans)


def _over_heading(position: FloatArray, twist: FloatArray, attitude: FloatArray,
                  stamps: np.ndarray, warnings: list[str]) -> FloatArray | None:
    """(m, 3) speed forward, left, up: the reading of the twist that the positions agree with."""
    time = 1e-9 * (stamps - stamps[0]).astype(float)
    body, world = over_level(twist, attitude), turned(twist, -attitude[:, 2])
    if np.ptp(position, axis=0).max() < MOVES_M:
        return body if np.ptp(twist, axis=0).max() > 0.0 else None
    derived = turned(np.gradient(position, time, axis=0), -attitude[:, 2])
    if not np.ptp(twist, axis=0).max() > 0.0:
        warnings.append(f'{ODOM}: its twist is not filled in; the speed is the slope of its '
                        'positions')
        return derived
    wide = max(1, round(SMOOTH_S / float(np.median(np.diff(time)))))

    def difference(quaternions: FloatArray) -> float:
        kernel = np.full(wide, 1.0 / wide)
        return float(sum(np.mean(np.convolve(column, kernel, 'valid')**2)
                         for column in (quaternions - derived).T))

    if difference(world) < CLOSER * difference(body):
        warnings.append(f'{ODOM}: its twist is in the frame of the world, by its positions')
        return world
    return body


def _vertical(stream: Stamped | None, grid: Grid, angles: FloatArray,
              acceleration: FloatArray) -> Moving:
    """Vertical speed and altitude where barometer and accelerometer overlap."""
    if stream is None:
        return Moving()
    stamps, rows = np.unique(stream.stamps, return_index=True)
    pressure = stream.values[rows, 0]
    plausible = np.isfinite(pressure) & (pressure > AIR_PA[0]) & (pressure < AIR_PA[1])
    stamps, pressure = stamps[plausible], pressure[plausible]
    if pressure.size < LEAST or not np.ptp(pressure) > 0.0 \
            or np.median(np.diff(stamps)) > 1e9 * SLOWEST_BARO_S:
        return Moving()
    places, heights = grid.position(stamps), altitude_of(pressure)
    force = over_level(acceleration, angles)[:, 2]
    finite = np.flatnonzero(np.isfinite(force))
    if finite.size < LEAST:
        return Moving()
    velocity, height = np.full((grid.n, 3), np.nan), np.full(grid.n, np.nan)
    gaps = np.flatnonzero(np.diff(places) * grid.dt > LONGEST_BARO_S) + 1
    for own, risen in zip(np.split(places, gaps), np.split(heights, gaps), strict=True):
        first, last = (int(np.clip(k, 0, grid.n - 1)) for k in (np.ceil(own[0]), own[-1]))
        cells = np.arange(first, last + 1)
        if own.size < LEAST or cells.size * grid.dt < LONGEST_BARO_S:
            continue
        velocity[cells, 2], height[cells] = vertical_motion(
            np.interp(cells, own, risen), np.interp(cells, finite, force[finite]), grid.dt)
    if not np.isfinite(height).any():
        return Moving()
    velocity[~np.isfinite(force), 2] = np.nan
    return Moving(velocity, height, by_force=True)


def odometry_of(record: Record, stamps: np.ndarray) -> Stamped | None:
    """The messages of /odom that say of the motion what a record does; None: it says nothing.

    Their orientation is that of the record's lean where it has one. The place is the integral of
    the speed from the first sample on. Without horizontal speeds the twist is the vertical one.
    """
    velocity, angles = record.velocity, record.angles
    if velocity is None or angles is None or record.speed_filter_hz is not None:
        return None
    measured = np.flatnonzero(np.isfinite(velocity[:, 2]) & np.isfinite(angles).all(axis=1))
    if measured.size < LEAST:
        return None
    attitude = angles[measured].copy()
    if record.lean is not None:
        tilted = np.isfinite(record.lean[measured]).all(axis=1)
        forward, left = record.lean[measured][tilted].T
        pitch = np.arctan(forward)
        attitude[tilted, :2] = np.column_stack([-np.arctan(left * np.cos(pitch)), pitch])
    speed, time = velocity[measured], measured * record.dt
    world = turned(np.nan_to_num(speed[:, :2]), attitude[:, 2])
    steps = 0.5 * (world[1:] + world[:-1]) * np.diff(time)[:, None]
    place = np.zeros((measured.size, 3))
    place[1:, :2] = np.cumsum(steps, axis=0)
    place[:, 2] = 0.0 if record.altitude is None else np.nan_to_num(record.altitude[measured])
    twist = in_body(speed, attitude) if np.isfinite(speed).all() else speed
    return Stamped(stamps[measured], np.column_stack([place, quaternions(attitude), twist]))
