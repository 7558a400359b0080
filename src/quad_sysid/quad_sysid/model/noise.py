"""The sensor of an axis, the noise, and the Kalman gain that follows from both.

A torque disturbance d with its own correlation time and a white torque drive the rate; the sensor
adds white noise, before its filter where the model contains one. Nothing is fitted here.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numba import njit
from scipy.linalg import expm, solve_discrete_lyapunov
from scipy.signal import savgol_coeffs

from quad_sysid.contract import FloatArray
from quad_sysid.model.recursion import riccati

FORM_STEP_S = 1e-3
"""Interval at which gyros run their own filter."""


@dataclass(frozen=True, eq=False)
class Sensor:
    """What lies between the rate and the measurement: nothing, a filter, or an integral."""

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
    """Where only the angle was measured: variance of the derived rate over that of the angle's
    noise per cycle; else 0."""


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
    a = np.zeros((5, 5))
    a[0, 1] = dt
    a[1, 0], a[1, 1], a[1, 2] = -(cutoff**2) * dt, -math.sqrt(2.0) * cutoff * dt, cutoff**2 * dt
    a[2, 3] = 1.0
    a[3, 4] = 1.0
    e = expm(a)
    # u(s) = u0 + s (-3 u0 + 4 um - u1) + s²/2 * 4 (u0 - 2 um + u1) on s = t / dt
    basis = np.array([[1.0, 0.0, 0.0], [-3.0, 4.0, -1.0], [4.0, -8.0, 4.0]])
    return np.ascontiguousarray(np.hstack([e[:2, :2], e[:2, 2:] @ basis]))


def _stepped(gyro_filter_hz: float, dt: float) -> FloatArray:
    """(2, 5) the same for g' += h (wc² (rate - g) - sqrt(2) wc g'), g += h g'."""
    cutoff = 2.0 * math.pi * gyro_filter_hz
    count = max(1, round(dt / FORM_STEP_S))
    h = dt / count
    total = np.hstack([np.eye(2), np.zeros((2, 3))])
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

    gain: FloatArray
    """(4 + 2 v,) Kalman gain: rate, disturbance, two states of the gyro filter and two of each of
    the v lines of vibration."""
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
    """From the states to the recorded rate."""
    after: float
    """What adds to the variance of `output`: white noise, and what that has in common with it."""
    floor: float
    """Variance of all noise in `output` over that before the gyro filter."""


def kalman(
    noise: FloatArray, damping: float, sensor: Sensor, dt: float, *, averaged: bool = False
) -> Filter:
    """Steady Kalman filter for a rate with this damping, 1/s (mean slope of the torque).

    noise (4 + 3 v,): the parameters of structure.NOISE, ratios to the gyro's noise, whose size
    the innovations give; without a gyro filter the last does not count. Then of each of the v
    lines of vibration the three of structure.VIBRATION. averaged: as in structure.Structure.
    """
    gain, move, innovation, transition, process, covariance, output, after = _steady(
        noise, damping, sensor.step, sensor.behind, sensor.noisy, averaged, dt
    )
    floor = 1.0
    if sensor.noisy:
        floor = noise[3] ** 2 + sensor.floor[0] + averaged * sensor.floor[1]
    floor += float(np.sum(noise[4::3] ** 2))
    if sensor.derived:
        output, after = np.eye(output.size)[0], sensor.derived
        floor = after
    return Filter(gain, move, innovation, transition, process, covariance, output, after, floor)


@njit(cache=True, nogil=True, error_model='numpy')
def _steady(noise, damping, step, behind, noisy, averaged, dt):  # type: ignore[no-untyped-def]
    """The fields of Filter, the floor excepted, for a sensor that measures the rate."""
    white, disturbance, correlation, after = noise[:4]
    lines = (noise.size - 4) // 3
    fade = math.exp(-dt / correlation)
    hold = correlation / dt * (1.0 - fade)
    a = -0.5 * damping * dt
    ahead, push = (1.0 + a) / (1.0 - a), dt / (1.0 - a)
    size = 4 + 2 * lines
    # beside the states, last: what the gyro's noise of the last cycle adds to the output directly
    rows = np.zeros((size + 1, size + 1))
    rows[0, 0], rows[0, 1], rows[1, 1] = ahead, push * hold, fade
    by_halves = np.zeros((size + 1, 2))  # of accelerations over the two halves
    by_halves[0] = 0.5 * push
    process = np.zeros((size + 1, size + 1))
    move = np.empty(2 + 2 * lines)
    move[0], move[1] = fade, hold
    inside = np.zeros(2)
    for i in range(2):
        begin, half, end = step[i, 2:]
        rows[2 + i, 0] = begin + half * 0.5 * (1.0 + ahead) + end * ahead
        rows[2 + i, 1] = (0.5 * half + end) * push * hold
        rows[2 + i, 2:4] = step[i, :2]
        by_halves[2 + i] = (0.5 * half + end) * 0.5 * push
        by_halves[2 + i, 0] += 0.25 * dt * half
        by_halves[2 + i, 1] -= 0.25 * dt * half
        inside[i] = begin + half + end
    process += white**2 * 2.0 / dt * (by_halves @ by_halves.T)
    process[1, 1] += disturbance**2 * (1.0 - fade**2)
    c = np.zeros(size + 1)
    c[2 if behind else 0] = 1.0
    for i in range(lines):
        rms, frequency, width = noise[4 + 3 * i : 7 + 3 * i]
        turn = cmath.exp(math.pi * dt * complex(-width, 2.0 * frequency))  # over a cycle
        k = 4 + 2 * i
        c[k] = 1.0
        move[2 + 2 * i], move[3 + 2 * i] = turn.real, turn.imag
        rows[k, k] = rows[k + 1, k + 1] = turn.real
        rows[k, k + 1], rows[k + 1, k] = -turn.imag, turn.imag
        process[k, k] = process[k + 1, k + 1] = rms**2 * (1.0 - abs(turn) ** 2)
    r = adds = 1.0
    if noisy:
        # The filter's states after noise that was held over the cycle before last are those after
        # `older` held over the last one, but for what of it they could not show yet.
        older = np.zeros(2)
        if averaged:
            inside *= math.sqrt(0.5)
            older[:] = np.linalg.solve(step[:, :2].copy(), inside)
        entered = inside + older
        for i in range(2):
            for j in range(2):
                process[2 + i, 2 + j] += entered[i] * entered[j]
            process[2 + i, size] = process[size, 2 + i] = entered[i]
        process[size, size] = 1.0
        c[size] = -older[0]
        r = after**2
        adds = r + older[0] ** 2 - 2.0 * entered[0] * older[0]
    used = np.ones(size + 1, np.bool_)
    used[2] = behind
    used[3] = used[size] = noisy
    at = np.flatnonzero(used)
    part = riccati(rows[at][:, at], process[at][:, at], c[at], r)
    gain = np.zeros(size + 1)
    s = c[at] @ part @ c[at] + r
    gain[at] = part @ c[at] / s
    covariance = np.zeros((size + 1, size + 1))
    for i, k in enumerate(at):
        covariance[k, at] = part[i]
    return (
        gain[:size], move, s, rows[:size, :size].copy(), process[:size, :size].copy(),
        covariance[:size, :size].copy(), c[:size].copy(), adds,
    )


def growth(found: Filter, steps: int) -> FloatArray:
    """(steps,) variance of the free run's error after k cycles, over the gyro noise's.

    The error is that of the measured rate, with the measurement's noise.
    """
    f, q, c, p = found.transition, found.process, found.output, found.covariance
    out = np.empty(steps)
    for k in range(steps):
        out[k] = c @ p @ c + found.after
        p = f @ p @ f.T + q
    return out
