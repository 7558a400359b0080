"""What is measured of an aircraft on a bench: inertia by a swing, thrust on a scale.

Pure formulas for the airframe section of the virtual aircraft's YAML.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from quad_bridge.errors import RefusedError
from quad_bridge.sensors.rest import GRAVITY, FloatArray

LEAST_POINTS = 4
MOST_THRUST_N = 1e4
"""Largest plausible value of one motor."""


@dataclass(frozen=True)
class ThrustCurve:
    """thrust = full_thrust_n ((1 - curvature) u + curvature u²), u the command 0..1."""

    full_thrust_n: float
    curvature: float
    misfit: float
    """RMS distance of the readings, as a share of the full thrust."""


def bifilar_inertia(mass_kg: float, distance_m: float, length_m: float, period_s: float) -> float:
    """Moment of inertia (kg m²) about the vertical axis between two parallel strings.

    The aircraft hangs on two strings of `length_m`, `distance_m` apart, its centre of mass midway;
    turned a little and let go it swings with `period_s`: I = m g d² T² / (16 π² L). For roll and
    pitch hang it with that axis upright. Raises RefusedError for numbers that are not positive.
    """
    named = {'mass': mass_kg, 'distance': distance_m, 'length': length_m, 'period': period_s}
    for name, value in named.items():
        if not (math.isfinite(value) and value > 0.0):
            raise RefusedError(f'{name} must be positive, found {value:g}')
    swing = distance_m * period_s
    inertia = mass_kg * GRAVITY * swing * swing / (16.0 * math.pi**2 * length_m)
    if not 0.0 < inertia < math.inf:
        raise RefusedError(f'the inertia comes out as {inertia:g} kg m²; check the units')
    return inertia


def thrust_curve(command: FloatArray, thrust_n: FloatArray) -> ThrustCurve:
    """Fit readings of one motor on a scale: commands (n,) 0..1 and thrusts (n,) in N.

    Raises RefusedError, in one line, where they do not tell a curve.
    """
    if len(command) < LEAST_POINTS or np.ptp(command) < 0.4:
        raise RefusedError(
            f'{len(command)} readings over {np.ptp(command) if len(command) else 0.0:.2f} of the '
            f'command; {LEAST_POINTS} over 0.4 are needed'
        )
    odd = np.flatnonzero(~(np.isfinite(command) & (np.abs(thrust_n) < MOST_THRUST_N)))
    if len(odd):
        k = int(odd[0])
        raise RefusedError(f'reading {k + 1} is {command[k]:g}, {thrust_n[k]:g}: no such thrust')
    if command.min() < 0.0 or command.max() > 1.0:
        raise RefusedError(
            f'commands must lie in 0..1, found {command.min():g}..{command.max():g}'
        )
    design = np.stack([command, command**2], axis=1)
    (linear, square), *_ = np.linalg.lstsq(design, thrust_n, rcond=None)
    full = float(linear + square)
    if full <= 0.0:
        raise RefusedError(f'thrust at full command comes out as {full:g} N; check its sign')
    misfit = float(np.sqrt(np.mean((design @ [linear, square] - thrust_n) ** 2))) / full
    return ThrustCurve(full, float(square) / full, misfit)
