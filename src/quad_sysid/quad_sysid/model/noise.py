"""The sensor of an axis, the noise, and the Kalman gain that follows from both.

A torque disturbance d with its own correlation time and a white torque drive the rate; the sensor
adds white noise, before its filter where the model contains one. Nothing is fitted here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.linalg import expm, solve_discrete_lyapunov
from scipy.signal import savgol_coeffs

from quad_sysid.contract import FloatArray
from quad_sysid.model import recursion

FORM_STEP_S = 1e-3
"""Interval at which gyros run their own filter."""


@dataclass(frozen=True, eq=False)
class Sensor:
    """The sensor between rate and measurement: nothing, a filter, or an integral."""

    step: FloatArray
    """(2, 5) step of its two states over one cycle. Columns: the states, then the weights of the
    rate at the start, middle and end of the cycle (a parabola)."""
    behind: bool = False
    """Whether its first state is measured, instead of the rate."""
    noisy: bool = False
    """Whether noise enters before the filter (and little of it after)."""
    late_s: float = 0.0
    """Delay of the output behind the rate, s."""
    floor: tuple[float, float] = 0.0, 0.0
    """Variance behind the filter of unit white noise before it, and covariance over one cycle."""
    derived: float = 0.0
    """Variance of the derived rate over that of the angle's noise per cycle; 0 where the rate was
    measured."""


@lru_cache(maxsize=16)
def sensor_of(
    gyro_filter_hz: float | None, derived_s: float | None, dt: float, *, stepped: bool = False
) -> Sensor:
    """A gyro, a gyro with a 2nd-order Butterworth filter, or an angle sensor (angle / dt).

    derived_s: span to either side of the cubic whose slope (Savitzky and Golay 1964) was recorded
    as the rate; None: the rate was measured. stepped: the filter as two integrators in a row,
    each stepped at FORM_STEP_S, and not its exact solution.
    """
    if derived_s is not None:
        half = max(2, round(derived_s / dt))
        slope = savgol_coeffs(2 * half + 1, 3, deriv=1)
        mean = np.array([[1.0, 0.0, 1.0 / 6.0, 4.0 / 6.0, 1.0 / 6.0], np.zeros(5)])
        return Sensor(mean, behind=True, derived=float(slope @ slope))
    if gyro_filter_hz is None:
        return Sensor(np.array([[0.0, 0.0, 0.0, 0.0, 1.0], np.zeros(5)]))
    step = (_stepped if stepped else gyro_step)(gyro_filter_hz, dt)
    late = math.sqrt(2.0) / (2.0 * math.pi * gyro_filter_hz)
    inside = step[:, 2:].sum(axis=1)
    spread = solve_discrete_lyapunov(step[:, :2], np.outer(inside, inside))
    floor = float(spread[0, 0]), float((step[:, :2] @ spread)[0, 0])
    return Sensor(step, behind=True, noisy=True, late_s=late, floor=floor)


def gyro_step(gyro_filter_hz: float, dt: float) -> FloatArray:
    """(2, 5) step of the exact 2nd-order Butterworth filter, unit gain at rest (Sensor.step)."""
    cutoff = 2.0 * math.pi * gyro_filter_hz
    a = np.diag([dt, 0.0, 1.0, 1.0], k=1)
    a[1, :3] = -(cutoff**2) * dt, -math.sqrt(2.0) * cutoff * dt, cutoff**2 * dt
    e = expm(a)
    # u(s) = u0 + s (-3 u0 + 4 um - u1) + s²/2 * 4 (u0 - 2 um + u1) on s = t / dt
    basis = np.array([[1.0, 0.0, 0.0], [-3.0, 4.0, -1.0], [4.0, -8.0, 4.0]])
    return np.ascontiguousarray(np.hstack([e[:2, :2], e[:2, 2:] @ basis]))


def _stepped(gyro_filter_hz: float, dt: float) -> FloatArray:
    """(2, 5) the same for g' += h (wc² (rate - g) - sqrt(2) wc g'), g += h g'."""
    cutoff = 2.0 * math.pi * gyro_filter_hz
    count = max(1, round(dt / FORM_STEP_S))
    h = dt / count
    total = np.eye(2, 5)
    for s in np.arange(1, count + 1) / count:
        rate = np.array([0.0, 0.0, (1.0 - s) * (1.0 - 2.0 * s), 4.0 * s * (1.0 - s),
                         s * (2.0 * s - 1.0)])
        slope = total[1] + h * (
            cutoff**2 * (rate - total[0]) - math.sqrt(2.0) * cutoff * total[1]
        )
        total = np.stack([total[0] + h * slope, slope])
    return np.ascontiguousarray(total)


@dataclass(frozen=True)
class Filter:
    """The steady Kalman filter of one noise and damping."""

    floor: float
    """Variance of all noise in `output` over that before the gyro filter."""
    gain: FloatArray
    """(4 + 2 v,) Kalman gain: rate, disturbance, two states of the gyro filter and two of each of
    the v lines in the noise."""
    move: FloatArray
    """(2 + 2 v,) decay of the disturbance over a cycle, its mean over the cycle, and the rotation
    of each line (recursion.predict)."""
    innovation: float
    """Variance of the innovations over that of the gyro noise."""
    transition: FloatArray
    process: FloatArray
    covariance: FloatArray
    """Covariance of the prediction over the variance of the gyro noise."""
    output: FloatArray
    """Row that gives the recorded rate from the states."""
    after: float
    """Variance that the measurement's white noise adds to that of `output`, and covariance."""


def kalman(
    noise: FloatArray, damping: float, sensor: Sensor, dt: float, *, averaged: bool = False
) -> Filter:
    """Steady Kalman filter for a rate with this damping, 1/s (mean slope of the torque).

    noise (4 + 3 v,): the parameters of structure.NOISE, ratios to the gyro's noise, whose size
    the innovations give; without a gyro filter the last does not count. Then of each of the v
    lines the three of structure.LINE. averaged: as in structure.Structure.
    """
    floor = 1.0
    if sensor.noisy:
        floor = noise[3] ** 2 + sensor.floor[0] + averaged * sensor.floor[1]
    steady = Filter(floor + float(np.sum(noise[4::3] ** 2)), *recursion.steady_filter(
        noise, damping, sensor.step, sensor.behind, sensor.noisy, averaged, dt
    ))
    if not sensor.derived:
        return steady
    rate = np.eye(steady.gain.size)[0]
    return replace(steady, output=rate, after=sensor.derived, floor=sensor.derived)


def growth(steady: Filter, steps: int) -> FloatArray:
    """(steps,) variance of the free run's error after k cycles, over the gyro noise's.

    The error is that of the measured rate, with the measurement's noise.
    """
    f, q, c, p = steady.transition, steady.process, steady.output, steady.covariance
    out = np.empty(steps)
    for k in range(steps):
        out[k] = c @ p @ c + steady.after
        p = f @ p @ f.T + q
    return out


def transitions(steady: Filter, sensor: Sensor, slope: FloatArray, dt: float) -> FloatArray:
    """(n, states, states) Filter.transition where the torque has its own slope (n,) in each cycle.

    slope: over the rate, 1/s.
    """
    a, hold = 0.5 * dt * slope, steady.move[1]
    factor, input_gain = (1.0 + a) / (1.0 - a), dt / (1.0 - a)
    out = np.tile(steady.transition, (slope.size, 1, 1))
    out[:, 0, 0], out[:, 0, 1] = factor, input_gain * hold
    for i, (begin, half, end) in enumerate(sensor.step[:, 2:], 2):
        out[:, i, 0] = begin + 0.5 * half * (1.0 + factor) + end * factor
        out[:, i, 1] = (0.5 * half + end) * input_gain * hold
    return out
