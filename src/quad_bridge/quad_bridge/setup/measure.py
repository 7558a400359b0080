"""The wizard's measurements as values of the table's SET_UP rows. Pure.

Vectors are in the firmware's axes, FRD; `raw` is what the chips show in the axes of the board,
before offsets, scales and the board's turn.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from quad_bridge.craft import rotation_of
from quad_bridge.errors import RefusedError
from quad_bridge.si import GRAVITY_M_S2, FloatArray

Values = dict[str, float]

MIN_MOVE_US = 150.0  # least travel of a stick or switch that was moved
ON_US = 1750.0  # a switch is on above it (SWITCHED_US of the firmware)
SNAP_RAD = np.radians(15.0)
"""A board that is turned by a quarter turn, within this, is meant to be turned by one."""
MIN_COVERED = 1.2  # least span in each axis, in radii of the compass: both ends are seen
ALONE = 0.5  # of the largest change: a second channel that moves by more is a mix
MAX_OFF_G = 0.35  # one of six positions that is this far off the best board was not held
SCALE = (0.8, 1.2)  # of a sound accelerometer: data sheets say 3 %
BY_DIRECTION = 0.025  # weight of a position's direction beside its length: hands err by degrees
MAX_OFFSET_M_S2 = 5.0  # half of gravity; more is a broken axis
MIN_FIELDS = 50  # some seconds of a compass
BATTERY_ON_V = 0.5
ROUND_SHARE = 0.15  # largest distance of the field's points from a sphere, in radii

FORCES = {
    'level, on its feet': (0.0, 0.0, -1.0),
    'upside down': (0.0, 0.0, 1.0),
    'nose straight down': (-1.0, 0.0, 0.0),
    'nose straight up': (1.0, 0.0, 0.0),
    'right side straight down': (0.0, -1.0, 0.0),
    'left side straight down': (0.0, 1.0, 0.0),
}
"""The six positions, and the specific force that the body feels in each, in units of gravity."""


def turn(roll: float, pitch: float, yaw: float) -> FloatArray:
    """(3, 3) from the board's axes to the body's (tune_turn of quad_attitude.c)."""
    return rotation_of(np.array([roll, pitch, yaw]))


def angles(rotation: FloatArray) -> tuple[float, float, float]:
    """Roll, pitch, yaw of a rotation as `turn` makes it; yaw 0 where its nose is up or down."""
    pitch = float(np.arcsin(np.clip(-rotation[2, 0], -1.0, 1.0)))
    if abs(rotation[2, 0]) > 1.0 - 1e-6:
        return float(np.arctan2(-rotation[1, 2], rotation[1, 1])), pitch, 0.0
    roll = float(np.arctan2(rotation[2, 1], rotation[2, 2]))
    return roll, pitch, float(np.arctan2(rotation[1, 0], rotation[0, 0]))


def _three(values: Mapping[str, float], name: str) -> FloatArray:
    return np.array([values[f'{name}_{axis}'] for axis in 'xyz'])


def _board(values: Mapping[str, float]) -> FloatArray:
    return turn(*(values[f'board.{axis}'] for axis in ('roll', 'pitch', 'yaw')))


def raw_accel(body: FloatArray, values: Mapping[str, float]) -> FloatArray:
    """(n, 3) what the chip shows, of what the firmware with these values makes of it."""
    return body @ _board(values) / _three(values, 'accel.scale') + _three(values, 'accel.offset')


def raw_compass(body: FloatArray, values: Mapping[str, float]) -> FloatArray:
    """(n, 3) the same of the compass, gauss."""
    return body @ _board(values) + _three(values, 'compass.offset')


def moved(before: Sequence[float], after: Sequence[float], what: str) -> int:
    """Channel (from 1) that moved alone. Raises RefusedError where none or two did."""
    change = np.abs(np.subtract(after, before))
    order = np.argsort(change)[::-1]
    if change[order[0]] < MIN_MOVE_US:
        raise RefusedError(f'{what}: no channel moved by {MIN_MOVE_US:g} µs')
    if change[order[1]] > ALONE * change[order[0]]:
        pair = sorted(int(i) + 1 for i in order[:2])
        raise RefusedError(f'{what}: channels {pair[0]} and {pair[1]} moved: switch mixes off')
    return int(order[0]) + 1


def stick(
    name: str, rest: Sequence[float], least: Sequence[float], most: Sequence[float]
) -> Values:
    """A stick's channel, ends and middle, of the pulses with it at rest and at both ends."""
    channel = moved(least, most, name)
    low, high, middle = (float(p[channel - 1]) for p in (least, most, rest))
    values = {f'receiver.{name}_channel': float(channel), f'receiver.{name}_min_us': low,
              f'receiver.{name}_max_us': high}  # fmt: skip
    if name == 'throttle':
        return values
    if not min(low, high) + MIN_MOVE_US <= middle <= max(low, high) - MIN_MOVE_US:
        raise RefusedError(f'{name}: at rest it reads {middle:.0f} µs, too close to an end of '
                           f'its travel ({low:.0f} to {high:.0f}): release it first')  # fmt: skip
    return {**values, f'receiver.{name}_centre_us': middle}


def switch(name: str, off: Sequence[float], on: Sequence[float]) -> Values:
    """A switch's channel."""
    channel = moved(off, on, name)
    if not on[channel - 1] > ON_US > off[channel - 1]:
        pulses = f'{off[channel - 1]:.0f} µs off and {on[channel - 1]:.0f} on'
        raise RefusedError(f'{name}: {pulses}: it is on above {ON_US:g}; turn it round in the '
                           'transmitter')  # fmt: skip
    return {f'receiver.{name}_channel': float(channel)}


def six_positions(raw: Mapping[str, FloatArray]) -> Values:
    """Board's turn, accelerometer's offset and scale, of the mean raw force (3,) in each position.

    Raises RefusedError where these are no six positions of one board.
    """
    force = np.array([raw[name] for name in FORCES])
    place = GRAVITY_M_S2 * np.array(list(FORCES.values()))
    # as if held exactly: raw = offset + force_body @ A, A = turn / scale, by least squares
    solved, *_ = np.linalg.lstsq(np.column_stack([np.ones(6), place]), force, rcond=None)
    offset, scale_terms = solved[0], solved[1:]
    scale = 1.0 / np.maximum(np.linalg.norm(scale_terms, axis=0), 1e-6)
    rotation = _nearest(scale_terms * scale)
    off = force - offset - place @ (rotation / scale)
    worst = int(np.argmax(np.linalg.norm(off, axis=1)))
    if np.linalg.det(rotation) < 0.0 or np.linalg.norm(off[worst]) > MAX_OFF_G * GRAVITY_M_S2:
        raise RefusedError(f'the six positions do not fit one board: {list(FORCES)[worst]!r} is '
                           'the furthest off; take them again')  # fmt: skip
    if not np.all((scale > SCALE[0]) & (scale < SCALE[1])) \
            or np.abs(offset).max() > MAX_OFFSET_M_S2:
        numbers = f'offset {np.round(offset, 2)} m/s², scale {np.round(scale, 3)}'
        raise RefusedError(f'{numbers}: no sound accelerometer; hold it still in each position')
    offset, scale, rotation = _of_length_g(force, place, offset, scale)
    square = np.round(rotation)
    near = np.linalg.norm(rotation - square) < np.sqrt(2.0) * SNAP_RAD
    if near and np.linalg.det(square) == 1.0:
        rotation = square
    values = dict(zip(('board.roll', 'board.pitch', 'board.yaw'), angles(rotation), strict=True))
    for i, axis in enumerate('xyz'):
        values[f'accel.offset_{axis}'] = float(offset[i])
        values[f'accel.scale_{axis}'] = float(scale[i])
    return values


def _nearest(shape: FloatArray) -> FloatArray:
    u, _, vt = np.linalg.svd(shape)
    nearest: FloatArray = u @ vt
    return nearest


def _of_length_g(
    force: FloatArray, place: FloatArray, offset: FloatArray, scale: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Offset, scale and turn that make each force (6, 3) as long as gravity, however it is held.

    The directions `place` count little: they say how the board is turned, and the difference of
    two scales where it is turned by 45 degrees. By Gauss and Newton, from the values given.
    """
    for _ in range(20):
        corrected = (force - offset) * scale
        rotation = _nearest(place.T @ corrected)
        length = np.linalg.norm(corrected, axis=1, keepdims=True)
        of_length = np.hstack([-corrected * scale, corrected * (force - offset)]) / length
        of_direction = np.vstack([np.hstack([np.diag(-scale), np.diag(one)])
                                  for one in force - offset])  # fmt: skip
        residual = np.concatenate([length[:, 0] - GRAVITY_M_S2,
                                   BY_DIRECTION * (corrected - place @ rotation).ravel()])
        slopes = np.vstack([of_length, BY_DIRECTION * of_direction])
        step, *_ = np.linalg.lstsq(slopes, -residual, rcond=None)
        offset, scale = offset + step[:3], scale + step[3:]
    return offset, scale, _nearest(place.T @ ((force - offset) * scale))


def compass(raw: FloatArray) -> Values:
    """Offset of the compass by the sphere that fits raw fields (n, 3) best.

    |m|^2 = 2 c m + r^2 - |c|^2, linear in the centre c. Raises RefusedError where they cover too
    little of it, or are no sphere.
    """
    if len(raw) < MIN_FIELDS:
        raise RefusedError(f'the compass: {len(raw)} fields are too few; is there one?')
    solved, *_ = np.linalg.lstsq(
        np.column_stack([2.0 * raw, np.ones(len(raw))]), (raw**2).sum(axis=1), rcond=None
    )
    centre = solved[:3]
    radius = float(np.sqrt(max(solved[3] + centre @ centre, 1e-12)))
    covered = np.ptp(raw, axis=0) / radius
    if covered.min() < MIN_COVERED:
        axis = 'xyz'[int(covered.argmin())]
        raise RefusedError('the compass: not turned through all directions: too little along '
                           f'its {axis} axis; turn it over as well')  # fmt: skip
    spread = float(np.std(np.linalg.norm(raw - centre, axis=1)))
    if spread > ROUND_SHARE * radius:
        raise RefusedError(f'the compass: its fields lie {100 * spread / radius:.0f} % off a '
                           'sphere: iron or a current is near it')  # fmt: skip
    return {f'compass.offset_{axis}': float(centre[i]) for i, axis in enumerate('xyz')}


def divider(board_v: float, true_v: float, now: float) -> Values:
    """The battery's divider, by a voltmeter."""
    if not (board_v > BATTERY_ON_V and true_v > BATTERY_ON_V):
        raise RefusedError(f'the board shows {board_v:.2f} V: is the battery on?')
    return {'battery.divider': now * true_v / board_v}


def outputs(places: Mapping[int, int], now: Mapping[str, float]) -> Values:
    """Which output drives which motor: `places` (1..4) of each motor that was spun."""
    if sorted(places.values()) != [1, 2, 3, 4]:
        raise RefusedError(f'places {list(places.values())}: each of 1 to 4 once; spin them again')
    return {f'motors.output_{place}': now[f'motors.output_{motor}']
            for motor, place in places.items()}  # fmt: skip
