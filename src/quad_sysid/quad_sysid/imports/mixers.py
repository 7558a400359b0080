"""Frames of other flight controllers → the contract's, and the craft that a user names or flies.

FRD/NED (PX4, ArduPilot): x forward, y right, z down. FLU/ENU (contract, REP-103): x forward, y
left, z up. Roll is the same in both, pitch and yaw turn the other way, yaw counts from east.
A craft comes by a layout's name, a URDF, a matrix in a file, or by the motion; what an autopilot's
parameters say of it is in craft.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from quad_sysid.bags.orientation import euler_from_quaternion
from quad_sysid.contract import AXES, FloatArray
from quad_sysid.craft import LAYOUTS, Craft, craft_at, from_urdf
from quad_sysid.errors import BadInputError
from quad_sysid.motor_layout import Pattern, share_of

MIRROR: FloatArray = np.array([1.0, -1.0, -1.0])
"""Body vectors, rates and torques from FRD to FLU (and back)."""
MIRROR.setflags(write=False)
EXAMPLE = 'matrix: [[.5, .5, .5, .5], [1, -1, -1, 1], [1, 1, -1, -1], [1, -1, 1, -1]]'
"""A mixer file."""
SHORT = ('x', 'plus', 'crazyflie')
"""Layouts that messages name; docs/import.md lists all."""


@dataclass(frozen=True)
class Mixer:
    """U = matrix @ motors, where no places and spins of motors give that."""

    name: str
    """Name for messages: `--mixer mine.yaml`."""
    inverse: FloatArray
    """(4, k): U1..U4 from k motors in the order in which they are given."""


def mixer_of_patterns(patterns: Sequence[Pattern], motors: int) -> Craft | Mixer:
    """Motors at the places that the motion shows; a matrix where it does not show all axes.

    Its U1 is the mean of the motors, U2..U4 are signed means; 0 without a pattern.
    """
    matrix = np.zeros((4, motors))
    matrix[0] = 1.0 / motors
    for pattern in patterns:
        signs = np.array(pattern.signs, dtype=float)
        matrix[1 + AXES.index(pattern.axis)] = signs / np.abs(signs).sum()
    return _craft_of('the motion', matrix) or Mixer('--mixer auto', matrix)


def _craft_of(name: str, matrix: FloatArray) -> Craft | None:
    """The craft of a matrix (4, k) that places and spins of its motors explain."""
    throttle, roll, pitch, yaw = matrix
    even = [np.ptp(np.abs(row)) <= 1e-6 * np.abs(row).max() and row.any()
            for row in (throttle, yaw)]
    if not all(even) or (throttle < 0.0).any() or not roll.any() or not pitch.any():
        return None
    size = np.abs(matrix[1:3]).sum(axis=1)
    return craft_at(name, -pitch / size[1], roll / size[0], [-int(s) for s in np.sign(yaw)])


def chosen(crafts: Sequence[Craft | Mixer], patterns: Sequence[Pattern], rates: FloatArray,
           motors: FloatArray, dt: float) -> Craft | Mixer | None:
    """The craft, of several, with which the motors explain most of the motion; None for none."""
    certain = [p for p in patterns if p.certain]

    def explained(craft: Craft | Mixer) -> float:
        return sum(share_of(craft.inverse[1 + AXES.index(p.axis)], rates[:, AXES.index(p.axis)],
                            motors, dt) for p in certain)

    return max(crafts, key=explained, default=None) if len(crafts) > 1 else \
        next(iter(crafts), None)


def mixer_of(name: str, columns: Sequence[str]) -> Craft | Mixer:
    """A layout by its name, a URDF or a matrix in a file; BadInputError naming file and field.

    A matrix is YAML with `matrix:` of 4 rows U1..U4 by as many columns as --motors has.
    """
    where = f'--mixer {name}'
    mixer = LAYOUTS.get(name.lower()) or _read(where, name)
    count = mixer.count if isinstance(mixer, Craft) else mixer.inverse.shape[1]
    if count != len(columns):
        raise BadInputError(where, f'is one of {count} motors',
                            f'{len(columns)} columns in --motors', 'use --mixer auto')
    return mixer


def _read(where: str, name: str) -> Craft | Mixer:
    try:
        text = Path(name).read_text(encoding='utf-8')
    except (OSError, UnicodeDecodeError) as error:
        raise BadInputError(
            where, 'is not a mixer and cannot be read as a file',
            remedy=f'use auto, {", ".join(SHORT)}, another layout of docs/import.md, a URDF or a '
            'YAML file with matrix:',
        ) from error
    if text.lstrip().startswith('<'):
        try:
            craft = from_urdf(text)
        except ValueError as error:
            raise BadInputError(where, str(error)) from error
        if craft is None:
            raise BadInputError(where, 'is a URDF without joints motor_1 to motor_n')
        return craft
    try:
        content: Any = yaml.safe_load(text)
        matrix = np.array(content['matrix'], dtype=float)
    except (yaml.YAMLError, ValueError, TypeError, LookupError, RecursionError) as error:
        raise BadInputError(where, 'is not YAML with a matrix of numbers',
                            remedy=f'such as {EXAMPLE}') from error
    if matrix.ndim != 2 or len(matrix) != 4 or not np.isfinite(matrix).all():
        raise BadInputError(where, 'needs 4 rows of finite numbers, U1 to U4',
                            remedy=f'such as {EXAMPLE}')
    return _craft_of(where, matrix) or Mixer(where, matrix)


def mirrored(values: FloatArray) -> FloatArray:
    """Body vectors, rates or torques (n, 3) from FRD to FLU, and back."""
    return values * MIRROR


def enu(values: FloatArray) -> FloatArray:
    """(n, 3) east, north, up of north, east, down."""
    return np.asarray(values[:, [1, 0, 2]] * [1.0, 1.0, -1.0])


def ned_angles(wxyz: FloatArray) -> FloatArray:
    """Roll, pitch, yaw (n, 3), rad, of FLU in ENU; from w x y z (n, 4) of FRD in NED."""
    return angles_from_ned(euler_from_quaternion(np.roll(wxyz, -1, axis=1)))


def angles_from_ned(angles: FloatArray) -> FloatArray:
    """Roll, pitch, yaw (n, 3) of FRD in NED → of FLU in ENU, rad, yaw unwrapped."""
    out = angles * MIRROR
    out[:, 2] = np.unwrap(0.5 * np.pi + out[:, 2])
    return np.asarray(out)
