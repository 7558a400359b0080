"""Hard-iron offsets of a magnetometer that was turned about: the centre of a sphere. Pure.

Soft iron (an ellipsoid) is not estimated: how far the readings are from a sphere is said instead.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quad_bridge.errors import RefusedError
from quad_bridge.sensors.rest import FloatArray

EARTH_T = (15e-6, 75e-6)  # tesla: the earth's field is 22 to 67 µT
LEAST_SPREAD = 0.05
"""Of directions: least eigenvalue of their covariance; a third where they fill the sphere."""
MOST_MISFIT = 0.1
LEAST_READINGS = 50


@dataclass(frozen=True)
class HardIron:
    """What to subtract from every reading."""

    offset: tuple[float, float, float]  # tesla, body axes
    field: float  # tesla: radius of the sphere
    misfit: float  # RMS distance from the sphere, as a share of the radius


def hard_iron(readings: FloatArray) -> HardIron:
    """Centre of the sphere through readings (n, 3) in tesla, by linear least squares.

    |m|² = 2 m·c + (r² − |c|²). Raises RefusedError, in one line, where the aircraft was not turned
    about enough or the readings are no sphere.
    """
    m = readings[np.isfinite(readings).all(axis=1)]
    if len(m) < LEAST_READINGS:
        raise RefusedError(f'only {len(m)} readings; at least {LEAST_READINGS} are needed')
    scale = float(np.abs(m).max()) or 1.0
    m = m / scale
    design = np.column_stack((2.0 * m, np.ones(len(m))))
    solution, _, rank, _ = np.linalg.lstsq(design, (m**2).sum(axis=1), rcond=None)
    centre = solution[:3]
    radius = float(np.sqrt(max(solution[3] + centre @ centre, 0.0)))
    away = np.linalg.norm(m - centre, axis=1)
    directions = (m - centre) / np.maximum(away, 1e-12)[:, None]
    spread = float(np.linalg.eigvalsh(np.cov(directions.T))[0])
    if rank < 4 or spread < LEAST_SPREAD:
        raise RefusedError(
            f'turned about too little: directions spread by {spread:.3f}, {LEAST_SPREAD} is '
            'needed; turn it once about each of its three axes'
        )
    misfit = float(np.sqrt(np.mean((away / radius - 1.0) ** 2)))
    if misfit > MOST_MISFIT:
        raise RefusedError(
            f'readings are {100 * misfit:.0f} % off a sphere; keep motors and iron away'
        )
    field = radius * scale
    if not EARTH_T[0] <= field <= EARTH_T[1]:
        raise RefusedError(f"field of {1e6 * field:.1f} µT is not the earth's; check the unit")
    x, y, z = (centre * scale).tolist()
    return HardIron((x, y, z), field, misfit)
