"""Frames and motor orders of other flight controllers → the contract's.

FRD/NED (PX4, ArduPilot): x forward, y right, z down. FLU/ENU (contract, REP-103): x forward, y
left, z up. Roll is the same in both, pitch and yaw turn the other way, yaw counts from east.
Motors come by name, by a file, by their places, by the motion; source of the contract's order and
signs: eq. (7) of the paper, contract.MIXER.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from quad_sysid.bags.orientation import euler_from_quaternion
from quad_sysid.contract import AXES, MIXER_INVERSE, FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.motor_layout import Pattern

MIRROR: FloatArray = np.array([1.0, -1.0, -1.0])
"""Body vectors, rates and torques from FRD to FLU (and back)."""
MIRROR.setflags(write=False)
SHIPPED = Path(__file__).with_name('mixer_files')
"""Mixer files that are known by their name alone."""


@dataclass(frozen=True)
class Mixer:
    """U = matrix @ motors."""

    name: str
    """Name for messages: `--mixer x`, or its place in the log."""
    matrix: FloatArray
    """(4, k): U1..U4 from k motors in the order in which they are given."""
    unsaid: tuple[str, ...] = ()
    """Axes whose signs the log does not state; the motion gives them, where certain."""

    def told_by(self, patterns: Sequence[Pattern]) -> Mixer:
        """The mixer with the motion's patterns for the axes in `unsaid`."""
        matrix = self.matrix.copy()
        for pattern in patterns:
            if pattern.axis in self.unsaid and pattern.certain:
                matrix[1 + AXES.index(pattern.axis)] = _signed_mean(pattern)
        return Mixer(self.name, matrix)

    @property
    def order(self) -> tuple[int, ...] | None:
        """Indices of the contract's motors 1..4; None where the matrix is not a permutation."""
        if self.matrix.shape != MIXER_INVERSE.shape:
            return None
        for order in permutations(range(4)):
            matrix = np.zeros((4, 4))
            matrix[:, list(order)] = MIXER_INVERSE
            if np.allclose(matrix, self.matrix):
                return order
        return None


def shipped() -> list[str]:
    """Names of the mixer files that come with the package."""
    return sorted(file.stem for file in SHIPPED.glob('*.yaml'))


def mixer_of_patterns(patterns: Sequence[Pattern], motors: int) -> Mixer:
    """U1 as the mean of the motors, U2..U4 as signed means; 0 without a pattern."""
    matrix = np.zeros((4, motors))
    matrix[0] = 1.0 / motors
    for pattern in patterns:
        matrix[1 + AXES.index(pattern.axis)] = _signed_mean(pattern)
    return Mixer('--mixer auto', matrix)


def _signed_mean(pattern: Pattern) -> FloatArray:
    signs = np.array(pattern.signs, dtype=float)
    return np.asarray(signs / np.abs(signs).sum())


def mixer_of(name: str, columns: Sequence[str]) -> Mixer:
    """Mixer by name or file; raises BadInputError naming file and field.

    A file is YAML with `matrix:` of 4 rows U1..U4 by as many columns as --motors has.
    """
    where = f'--mixer {name}'
    file = SHIPPED / f'{name}.yaml' if name in shipped() else Path(name)
    try:
        content: Any = {'matrix': MIXER_INVERSE} if name == 'x' else yaml.safe_load(
            file.read_text(encoding='utf-8'))
        matrix = np.array(content['matrix'], dtype=float)
    except (OSError, UnicodeDecodeError) as error:
        raise BadInputError(
            where, 'is not a mixer and cannot be read as a file',
            remedy=f'use auto, x, {", ".join(shipped())} or a YAML file with matrix:',
        ) from error
    except (yaml.YAMLError, ValueError, TypeError, LookupError, RecursionError) as error:
        raise BadInputError(where, 'is not YAML with a matrix of numbers',
                            remedy=f'{SHIPPED / "crazyflie.yaml"} is an example') from error
    if matrix.ndim != 2 or len(matrix) != 4 or not np.isfinite(matrix).all():
        raise BadInputError(where, 'needs 4 rows of finite numbers, U1 to U4',
                            remedy=f'{SHIPPED / "crazyflie.yaml"} is an example')
    if matrix.shape[1] != len(columns):
        raise BadInputError(where, f'is one of {matrix.shape[1]} motors',
                            f'{len(columns)} columns in --motors', 'use --mixer auto')
    return Mixer(where, matrix)


def mirrored(values: FloatArray) -> FloatArray:
    """Body vectors, rates or torques (n, 3) from FRD to FLU, and back."""
    return values * MIRROR


def mixer_at_places(name: str, order: tuple[int, ...], *, clockwise_rear_left: bool) -> Mixer:
    """U1..U4 from motors of which `order` says which stands at each place of the contract's.

    A propeller that turns clockwise pushes the body counter-clockwise: positive yaw in FLU; the
    contract's rear left one does.
    """
    matrix = np.zeros((4, 4))
    matrix[:, list(order)] = MIXER_INVERSE
    matrix[3] *= 1.0 if clockwise_rear_left else -1.0
    return Mixer(name, matrix)


def ned_angles(wxyz: FloatArray) -> FloatArray:
    """Roll, pitch, yaw (n, 3), rad, of FLU in ENU; from w x y z (n, 4) of FRD in NED."""
    return angles_from_ned(euler_from_quaternion(np.roll(wxyz, -1, axis=1)))


def angles_from_ned(angles: FloatArray) -> FloatArray:
    """Roll, pitch, yaw (n, 3) of FRD in NED → of FLU in ENU, rad, yaw unwrapped."""
    out = angles * MIRROR
    out[:, 2] = np.unwrap(0.5 * np.pi + out[:, 2])
    return np.asarray(out)


def order_by_places(x: FloatArray, y_right: FloatArray) -> tuple[int, ...] | None:
    """Which of four rotors stands at each place, from positions; None where it is not an X."""
    wanted = ((-1, -1), (-1, 1), (1, 1), (1, -1))
    signs = [(int(np.sign(a)), int(np.sign(b))) for a, b in zip(x, y_right, strict=True)]
    if sorted(signs) != sorted(wanted):
        return None
    return tuple(signs.index(place) for place in wanted)
