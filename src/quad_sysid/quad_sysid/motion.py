"""What an aircraft's motion over the ground is made of: lean, heading, vertical speed.

Equations (1) to (3) of the paper, seen along the heading: thrust of which the lean points a share
forward or left, and its upright share against gravity. Array maths only; what of it an axis takes
is record.Record.motion.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quad_sysid.contract import FloatArray

GRAVITY = 9.80665
"""Standard gravity, m/s²."""
CROSSOVER_HZ = 0.15
"""Below it the barometer says how high the aircraft is, above it the accelerometer."""
HEAVE_S = 0.2
"""Time over which a vertical force is averaged: propellers shake an accelerometer faster, and an
aircraft rises and sinks more slowly."""


@dataclass(frozen=True)
class Motion:
    """One axis of a record, arrays of n rows; NaN where not measured."""

    rate: FloatArray
    """(n,) rad/s, or m/s."""
    position: FloatArray | None
    """(n,) rad, or m."""
    control: FloatArray
    """(n, 4); column `index` + 1 drives the axis."""
    motors: FloatArray | None
    """(n, k) commands 0..1; None where the effect of single motors on the axis is not known."""
    share: FloatArray
    """(n,) share of the motors' commands that acts along the axis."""


def lean(angles: FloatArray) -> FloatArray:
    """(n, 2) horizontal thrust per vertical one, forward and left, of roll, pitch, yaw (n, 3) rad.

    Gravity times this is the acceleration of an aircraft that holds its altitude; for small
    angles pitch and -roll.
    """
    roll, pitch = angles[:, 0], angles[:, 1]
    return np.column_stack([np.tan(pitch), -np.tan(roll) / np.cos(pitch)])


def relative_thrust(acceleration: FloatArray, angles: FloatArray, dt: float) -> FloatArray:
    """(n,) vertical thrust over weight by the specific force (n, 3), m/s²; 1 where not measured.

    Its mean counts as the weight: over a flight the mean vertical acceleration is next to nothing.
    """
    up = over_level(acceleration, angles)[:, 2]
    change = np.nan_to_num(up - np.nanmean(up)) / GRAVITY
    count = min(2 * round(0.5 * HEAVE_S / dt) + 1, change.size)
    return np.asarray(1.0 + np.convolve(change, np.full(count, 1.0 / count), 'same'))


def upright(angles: FloatArray) -> FloatArray:
    """(n,) share of the thrust that points up."""
    return np.asarray(np.cos(angles[:, 0]) * np.cos(angles[:, 1]))


def turned(vectors: FloatArray, angle: FloatArray) -> FloatArray:
    """(n, 2 or 3) vectors turned about the vertical by an angle (n,), rad."""
    c, s = np.cos(angle), np.sin(angle)
    x, y, *up = vectors.T
    return np.column_stack([c * x - s * y, s * x + c * y, *up])


def between(values: FloatArray) -> FloatArray:
    """(n, …) the mean of each sample and the next; the last as it is."""
    return np.asarray(0.5 * (values + np.concatenate([values[1:], values[-1:]])))


def over_level(body: FloatArray, angles: FloatArray) -> FloatArray:
    """(n, 3) body FLU vectors over the level and along the heading: forward, left, up."""
    (cr, cp), (sr, sp) = np.cos(angles[:, :2]).T, np.sin(angles[:, :2]).T
    x, y, z = body.T
    down = sr * y + cr * z
    return np.column_stack([cp * x + sp * down, cr * y - sr * z, cp * down - sp * x])


def in_body(level: FloatArray, angles: FloatArray) -> FloatArray:
    """(n, 3) the inverse of over_level."""
    (cr, cp), (sr, sp) = np.cos(angles[:, :2]).T, np.sin(angles[:, :2]).T
    x, y, z = level.T
    down = sp * x + cp * z
    return np.column_stack([cp * x - sp * z, cr * y + sr * down, cr * down - sr * y])


def altitude_of(pressure_pa: FloatArray) -> FloatArray:
    """Altitude (n,), m, above the first known of these pressures, by the standard atmosphere."""
    height = (1.0 - (pressure_pa / 101_325.0) ** (1.0 / 5.25588)) / 2.25577e-5
    finite = height[np.isfinite(height)]
    start = finite[: max(1, finite.size // 100)]
    return np.asarray(height - (start.mean() if finite.size else 0.0))


def vertical_motion(height: FloatArray, force: FloatArray,
                    dt: float) -> tuple[FloatArray, FloatArray]:
    """(n,) vertical speed, m/s, and altitude, m, of a height (n,), m, and a force (n,), m/s².

    The vertical specific force is quick but biased; integrated twice it is right but for what
    changes slowly, which the barometer's height gives. Both without gaps, dt in s.
    """
    # seconds to import, which other axes need not
    from scipy.integrate import cumulative_trapezoid
    from scipy.signal import butter, sosfiltfilt

    # by trapezia: a sum over samples is half a cycle ahead, which the delay would lack
    quick_speed = cumulative_trapezoid(force - force.mean(), dx=dt, initial=0.0)
    quick = cumulative_trapezoid(quick_speed, dx=dt, initial=0.0)
    slow = height - quick
    t = np.linspace(-1.0, 1.0, slow.size)
    # an accelerometer's bias, and its change, leave a cubic in the altitude
    drift = np.polynomial.Polynomial.fit(t, slow, 3)
    sections = butter(2, CROSSOVER_HZ, fs=1.0 / dt, output='sos')
    left = drift(t) + sosfiltfilt(sections, slow - drift(t),
                                  padlen=min(slow.size - 1, round(3.0 / (CROSSOVER_HZ * dt))))
    return quick_speed + np.gradient(left, dt), quick + left
