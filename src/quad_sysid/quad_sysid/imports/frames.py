"""Frames and motor orders of other flight controllers → the contract's. Array maths only.

FRD/NED (PX4, ArduPilot): x forward, y right, z down. FLU/ENU (contract, REP-103): x forward, y
left, z up. Roll is the same in both, pitch and yaw turn the other way, yaw counts from east.
"""

from __future__ import annotations

import numpy as np

from quad_sysid.bags.orientation import euler_from_quaternion
from quad_sysid.contract import MIXER_INVERSE, FloatArray
from quad_sysid.imports.mixers import Mixer

MIRROR: FloatArray = np.array([1.0, -1.0, -1.0])
"""Body vectors, rates and torques from FRD to FLU (and back)."""
MIRROR.setflags(write=False)


def mirrored(values: FloatArray) -> FloatArray:
    """Body vectors, rates or torques (n, 3) from FRD to FLU, and back."""
    return values * MIRROR


def mixer_at_places(
    name: str, order: tuple[int, ...], *, clockwise_rear_left: bool
) -> Mixer:
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
