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


@dataclass(frozen=True)
class Noise:
    """Ratios to the gyro's noise, whose size the innovations give.

    white: torque noise over gyro noise, (rad/s²)/√Hz per rad/s; disturbance: RMS of d over gyro
    noise, rad/s² per rad/s; correlation_s: correlation time of d, s.
    """

    white: float
    disturbance: float
    correlation_s: float
    after: float = 0.1
    """Noise behind the gyro filter (rounding, sampling) over that before it, in a model that
    contains the filter."""
    lines: tuple[tuple[float, float, float], ...] = ()
    """Narrow lines of vibration in the measured rate that move no aircraft, each with its RMS
    over the gyro noise, its frequency and its width, Hz."""


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
    """(4 + 2 v,) what an innovation adds to the states: the rate, the disturbance, two of the gyro
    filter and two of each line of vibration."""
    move: FloatArray
    """(2 + 2 v,) what is left of the disturbance after a cycle, its mean over the cycle, and how
    each line turns in it: see recursion.predict."""
    innovation: float
    """Variance of the innovations over that of the gyro noise."""
    transition: FloatArray
    process: FloatArray
    covariance: FloatArray
    """Of the prediction, over the variance of the gyro noise."""
    output: FloatArray
    """From the states to the measured rate."""
    after: float
    """Variance of the noise that no state holds."""
    floor: float
    """Variance of the gyro's noise in the measured rate, over that of the noise before it."""


def kalman(noise: Noise, damping: float, gyro: FloatArray, filtered: bool, dt: float) -> Filter:
    """Steady gain for a rate that falls by `damping` (1/s, mean slope of the torque)."""
    fade = math.exp(-dt / noise.correlation_s)
    hold = noise.correlation_s / dt * (1.0 - fade)
    a = -0.5 * damping * dt
    ahead, push = (1.0 + a) / (1.0 - a), dt / (1.0 - a)
    size = 4 + 2 * len(noise.lines)
    rows = np.zeros((size, size))
    rows[0, 0], rows[0, 1], rows[1, 1] = ahead, push * hold, fade
    b = np.zeros((size, 2))  # accelerations over the two halves
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
    c = np.zeros(size)
    c[2 if filtered else 0] = 1.0
    move = [fade, hold]
    for i, (size_of, frequency, width) in enumerate(noise.lines):
        left = math.exp(-math.pi * width * dt)
        angle = 2.0 * math.pi * frequency * dt
        turn, over = left * math.cos(angle), left * math.sin(angle)
        at = 4 + 2 * i
        rows[at : at + 2, at : at + 2] = [[turn, -over], [over, turn]]
        process[at, at] = process[at + 1, at + 1] = size_of**2 * (1.0 - left**2)
        c[at] = 1.0
        move += [turn, over]
    r = floor = 1.0
    if filtered:
        r = noise.after**2
        inside = gyro[:, 2:].sum(axis=1)
        process[2:4, 2:4] += np.outer(inside, inside)
        floor = _floor(gyro) + r
    floor += sum(line[0] ** 2 for line in noise.lines)
    used = np.array([0, 1, *([2, 3] if filtered else []), *range(4, size)])
    block = np.ix_(used, used)
    covariance = riccati(
        np.ascontiguousarray(rows[block]), np.ascontiguousarray(process[block]), c[used], r
    )
    s = float(c[used] @ covariance @ c[used] + r)
    gain = np.zeros(size)
    gain[used] = covariance @ c[used] / s
    full = np.zeros((size, size))
    full[block] = covariance
    return Filter(gain, np.array(move), s, rows, process, full, c, r, floor)


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
    f, q, c, p = found.transition, found.process, found.output, found.covariance
    out = np.empty(steps)
    for k in range(steps):
        out[k] = c @ p @ c + found.after
        p = f @ p @ f.T + q
    return out
