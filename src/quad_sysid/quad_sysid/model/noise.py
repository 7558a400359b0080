"""The noise of one axis and the Kalman gain that follows from it.

A torque disturbance d with its own correlation time and a white torque drive the rate; the gyro
adds white noise, before its filter where the model contains one. Nothing is fitted here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.linalg import expm

from quad_sysid.contract import FloatArray
from quad_sysid.model.recursion import riccati

AFTER_FILTER = 0.1
"""Noise of the rate behind the gyro filter (rounding, sampling) as a share of that before it."""


@dataclass(frozen=True)
class Noise:
    """Ratios to the gyro's noise, whose size the innovations give.

    white: torque noise over gyro noise, (rad/s²)/√Hz per rad/s; disturbance: RMS of d over gyro
    noise, rad/s² per rad/s; correlation_s: correlation time of d, s.
    """

    white: float
    disturbance: float
    correlation_s: float


@lru_cache(maxsize=16)
def gyro_step(gyro_filter_hz: float | None, dt: float) -> FloatArray:
    """(2, 5) step of the gyro filter over one cycle: 2nd-order Butterworth, unit gain at rest.

    Columns: state (output, its derivative), then the weights of the rate at the cycle's begin,
    half and end, a parabola between.
    """
    if gyro_filter_hz is None:
        return np.array([[0.0, 0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.0, 0.0, 0.0]])
    cutoff = 2.0 * math.pi * gyro_filter_hz
    a = np.zeros((5, 5))
    a[0, 1] = dt
    a[1, 0], a[1, 1], a[1, 2] = -(cutoff**2) * dt, -math.sqrt(2.0) * cutoff * dt, cutoff**2 * dt
    a[2, 3] = 1.0
    a[3, 4] = 1.0
    e = expm(a)
    # u(s) = u0 + s (-3 u0 + 4 um - u1) + s²/2 * 4 (u0 - 2 um + u1) on s = t / dt
    basis = np.array([[1.0, 0.0, 0.0], [-3.0, 4.0, -1.0], [4.0, -8.0, 4.0]])
    return np.ascontiguousarray(np.hstack([e[:2, :2], e[:2, 2:] @ basis]))


@dataclass(frozen=True)
class Filter:
    """The steady Kalman filter of one noise and damping."""

    gain: FloatArray
    """(4,) what an innovation adds to rate, disturbance and the two states of the gyro filter."""
    innovation: float
    """Variance of the innovations over that of the gyro noise."""
    fade: float
    """What is left of the disturbance after a cycle."""
    hold: float
    """Its mean over the cycle over its value at the begin."""
    transition: FloatArray
    process: FloatArray
    covariance: FloatArray
    """(4, 4) of the prediction, over the variance of the gyro noise."""
    floor: float
    """Variance of the gyro's noise in the measured rate, over that of the noise before it."""


def kalman(noise: Noise, damping: float, gyro: FloatArray, filtered: bool, dt: float) -> Filter:
    """Steady gain for a rate that falls by `damping` (1/s, mean slope of the torque)."""
    fade = math.exp(-dt / noise.correlation_s)
    hold = noise.correlation_s / dt * (1.0 - fade)
    a = -0.5 * damping * dt
    ahead, push = (1.0 + a) / (1.0 - a), dt / (1.0 - a)
    rows = np.zeros((4, 4))  # rate, disturbance, filter's two states
    rows[0, 0], rows[0, 1], rows[1, 1] = ahead, push * hold, fade
    b = np.zeros((4, 2))  # accelerations over the two halves
    b[0] = 0.5 * push
    bend = 0.25 * dt * np.array([1.0, -1.0])
    for i in range(2):
        g, q, begin, half, end = gyro[i]
        rows[2 + i, 0] = begin + half * 0.5 * (1.0 + ahead) + end * ahead
        rows[2 + i, 1] = (0.5 * half + end) * push * hold
        rows[2 + i, 2], rows[2 + i, 3] = g, q
        b[2 + i] = (0.5 * half + end) * 0.5 * push + half * bend
    process = noise.white**2 * 2.0 / dt * (b @ b.T)
    process[1, 1] += noise.disturbance**2 * (1.0 - fade**2)
    if not filtered:
        used = slice(0, 2)
        c, r = np.array([1.0, 0.0]), 1.0
        floor = 1.0
    else:
        used = slice(0, 4)
        c, r = np.array([0.0, 0.0, 1.0, 0.0]), AFTER_FILTER**2
        inside = gyro[:, 2:].sum(axis=1)
        process[2:, 2:] += np.outer(inside, inside)
        floor = _floor(gyro) + r
    f, p = np.ascontiguousarray(rows[used, used]), np.ascontiguousarray(process[used, used])
    covariance = riccati(f, p, c, r)
    s = float(c @ covariance @ c + r)
    gain = np.zeros(4)
    gain[used] = covariance @ c / s
    full = np.zeros((4, 4))
    full[used, used] = covariance
    return Filter(gain, s, fade, hold, rows, process, full, floor)


@lru_cache(maxsize=16)
def _floor_of(rows: tuple[float, ...]) -> float:
    gyro = np.array(rows).reshape(2, 5)
    a, b = gyro[:, :2], gyro[:, 2:].sum(axis=1)
    p = np.outer(b, b)
    total = p.copy()
    for _ in range(4000):
        p = a @ p @ a.T
        total += p
        if p.max() < 1e-14 * total.max():
            break
    return float(total[0, 0])


def _floor(gyro: FloatArray) -> float:
    """Variance behind the filter of unit white noise before it."""
    return _floor_of(tuple(gyro.ravel().tolist()))


def growth(found: Filter, steps: int) -> FloatArray:
    """(steps,) variance of the free run's error k cycles after a prediction, over the gyro's.

    Of the measured rate: the noise of the measurement is in it.
    """
    f, q = found.transition, found.process
    filtered = found.covariance[2, 2] > 0.0
    c = np.array([0.0, 0.0, 1.0, 0.0]) if filtered else np.array([1.0, 0.0, 0.0, 0.0])
    r = AFTER_FILTER**2 if filtered else 1.0
    if not filtered:
        f, q = f.copy(), q.copy()
        f[2:], q[2:], q[:, 2:] = 0.0, 0.0, 0.0
    p = found.covariance.copy()
    out = np.empty(steps)
    for k in range(steps):
        out[k] = c @ p @ c + r
        p = f @ p @ f.T + q
    return out
