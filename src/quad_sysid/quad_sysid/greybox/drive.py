"""From the command to what it does to the rate when nothing feeds back: delay, lag, integrators.

Solved exactly for a command held over each cycle, for any delay (not only whole cycles). The
gain and everything that depends on the rate come later, in simulate.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.linalg import expm

from quad_sysid.contract import FloatArray
from quad_sysid.greybox import kernels

SHORTEST_LAG_S = 1e-6
"""A lag below this acts within the first sample as no lag at all does."""
SUBSTEP_S = 0.001
"""Step of simulators and of the gyro's own sampling."""
REALISATIONS = ('continuous', 'stepped')
"""How the far end integrates: exactly, as nature does, or in semi-implicit steps of 1 ms, as
common physics engines do; a command then acts half a step sooner. A bag does not tell; which one
fits better is chosen on training data, for the delay's sake: the error hardly depends on it."""
STEPPED_ADVANCE_S = 1.5 * SUBSTEP_S
"""How much sooner the stepped chain (integration, two filter states) answers than the exact."""


@dataclass(frozen=True)
class Steps:
    """One control cycle in exact parts: see kernels.feedforward."""

    whole: int
    matrices: FloatArray
    inputs: FloatArray
    pattern: np.ndarray


def _dynamics(lag_s: float) -> FloatArray:
    """(4, 4) continuous state matrix of (lag, rate, angle, command)."""
    tau = max(lag_s, SHORTEST_LAG_S)
    a = np.zeros((4, 4))
    a[0, 0], a[0, 3] = -1.0 / tau, 1.0 / tau
    a[1, 0] = 1.0
    a[2, 1] = 1.0
    return a


@lru_cache(maxsize=256)
def steps(lag_s: float, delay_s: float, dt: float) -> Steps:
    """Exact parts of one cycle of `dt` s behind `delay_s` s and a first-order lag."""
    whole = int(np.floor(delay_s / dt + 1e-9))
    fraction = min(max(delay_s / dt - whole, 0.0), 1.0)
    if fraction < 0.5:
        parts, pattern = (fraction, 0.5 - fraction, 0.5), (0, 1, 1, 1)
    else:
        parts, pattern = (0.5, fraction - 0.5, 1.0 - fraction), (0, 0, 1, 0)
    a = _dynamics(lag_s)
    exact = expm(a[None] * (np.array(parts) * dt)[:, None, None])
    return Steps(
        whole=whole,
        matrices=np.ascontiguousarray(exact[:, :3, :3]),
        inputs=np.ascontiguousarray(exact[:, :3, 3]),
        pattern=np.array(pattern, dtype=np.int64),
    )


@lru_cache(maxsize=16)
def gyro_step(gyro_filter_hz: float | None, dt: float, realisation: str) -> FloatArray:
    """(2, 5) step of the gyro filter over one cycle: 2nd-order Butterworth, unit gain at rest.

    Columns: state (output, its derivative), then the weights of the rate at the cycle's begin,
    half and end, a parabola between. `continuous`: the exact filter (as good as a bilinear one at
    the gyro's own 1 kHz); `stepped`: its two-integrator form at 1 kHz, as simulators step it.
    """
    if gyro_filter_hz is None:
        return np.array([[0.0, 0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.0, 0.0, 0.0]])
    cutoff = 2.0 * np.pi * gyro_filter_hz
    if realisation == 'stepped':
        return _stepped_gyro(cutoff, dt)
    # states g, g', then the input and its first two derivatives on s = t / dt
    a = np.zeros((5, 5))
    a[0, 1] = dt
    a[1, 0], a[1, 1], a[1, 2] = -(cutoff**2) * dt, -np.sqrt(2.0) * cutoff * dt, cutoff**2 * dt
    a[2, 3] = 1.0
    a[3, 4] = 1.0
    e = expm(a)
    # u(s) = u0 + s (-3 u0 + 4 um - u1) + s²/2 * 4 (u0 - 2 um + u1)
    basis = np.array([[1.0, 0.0, 0.0], [-3.0, 4.0, -1.0], [4.0, -8.0, 4.0]])
    return np.ascontiguousarray(np.hstack([e[:2, :2], e[:2, 2:] @ basis]))


def _stepped_gyro(cutoff: float, dt: float) -> FloatArray:
    """The same (2, 5) for g' += h (wc² (rate - g) - sqrt(2) wc g'), g += h g' at 1 kHz."""
    count = max(1, round(dt / SUBSTEP_S))
    h = dt / count
    total = np.zeros((2, 5))
    total[0, 0] = total[1, 1] = 1.0
    for i in range(1, count + 1):
        s = i / count
        rate = np.zeros(5)
        rate[2:] = [(1 - s) * (1 - 2 * s), 4 * s * (1 - s), s * (2 * s - 1)]
        slope = total[1] + h * (
            cutoff**2 * (rate - total[0]) - np.sqrt(2.0) * cutoff * total[1]
        )
        total = np.stack([total[0] + h * slope, slope])
    return np.ascontiguousarray(total)


def response(
    command: FloatArray,
    stretches: tuple[tuple[int, int], ...],
    lag_s: float,
    delay_s: float,
    gyro_filter_hz: float | None,
    dt: float,
    realisation: str,
) -> FloatArray:
    """(5, n) response for unit gain: rate, at half cycle, angle, at half cycle, gyro output.

    command (n,) normalised; each unbroken stretch [start, stop) starts at rest with its first
    command held before. Rates in s, angles in s² per unit of gain.
    """
    gyro = gyro_step(gyro_filter_hz, dt, realisation)
    if realisation == 'stepped':
        delay_s = max(0.0, delay_s - 0.5 * SUBSTEP_S)
    exact = steps(lag_s, delay_s, dt)
    out = np.zeros((5, command.size))
    for start, stop in stretches:
        kernels.feedforward(
            command, exact.whole, exact.matrices, exact.inputs, exact.pattern, gyro, start, stop,
            out,
        )
    return out
