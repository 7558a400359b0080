"""Gyro bias and drift, accelerometer bias and level offsets of an aircraft that stands still.

Pure: arrays in, one estimate out, or a refusal where it moves. Standing on level ground a tilt of
the sensor and a bias of its x and y cannot be distinguished: they are one level offset.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from quad_bridge.errors import RefusedError
from quad_bridge.si import GRAVITY_M_S2, FloatArray

BLOCK_S = 0.5  # over it noise averages out, and a touch does not
MIN_S = 5.0  # ten blocks: a straight line through them, and a scatter about it
STILL_RATE = 0.01  # rad/s: by how much the mean of a block may leave the straight line through all
STILL_ACCELERATION = 0.15  # m/s²: the same for the accelerations
MAX_READING = 1e4  # rad/s, m/s²: a larger value is damaged and not used
MAX_BIAS = 0.15  # rad/s: more is no bias but a turn, or a sensor that is broken
MAX_NORM_ERROR = 0.8  # m/s²: by how much the measured gravity may be off


@dataclass(frozen=True)
class RestEstimate:
    """Estimates for the middle of the recording, with standard errors where there are any."""

    duration_s: float
    gyro_bias: tuple[float, float, float]  # rad/s, body axes x y z
    gyro_bias_std: tuple[float, float, float]
    gyro_drift: tuple[float, float, float]  # rad/s per s
    gyro_drift_std: tuple[float, float, float]
    gyro_noise: tuple[float, float, float]  # rad/s RMS, sample by sample
    acceleration_norm_error: float
    """m/s²: measured gravity minus 9.80665; the bias of z where the aircraft stands level."""
    level: tuple[float, float]  # rad: roll and pitch that the accelerometer shows


def estimate_at_rest(
    times: FloatArray, gyro: FloatArray, acceleration: FloatArray
) -> RestEstimate:
    """Estimate from stamps (n,) in s, rates (n, 3) in rad/s, accelerations (n, 3) in m/s².

    Axes FLU; at rest the acceleration points up. Raises RefusedError, in one line, where the data
    are too short or the aircraft moves.
    """
    plausible = (np.abs(np.hstack([gyro, acceleration])) < MAX_READING).all(axis=1)
    t, rates, force = times[plausible], gyro[plausible], acceleration[plausible]
    duration = float(t[-1] - t[0]) if len(t) else 0.0
    if duration < MIN_S:
        raise RefusedError(f'only {duration:.1f} s of data; let it stand still for {MIN_S:g} s')
    middle = 0.5 * (t[0] + t[-1])
    blocks = np.minimum((t - t[0]) // BLOCK_S, duration // BLOCK_S - 1).astype(int)
    clock = _means(t[:, None], blocks)[:, 0] - middle
    line, errors, off = _line(clock, _means(rates, blocks))
    _still(off, STILL_RATE, 'rad/s', 'turns')
    tilt, _, off = _line(clock, _means(force, blocks))
    _still(off, STILL_ACCELERATION, 'm/s²', 'is moved or shaken')
    tilted = float(np.abs(tilt[1]).max()) * duration
    if tilted > STILL_ACCELERATION:
        raise RefusedError(
            f'it tilts: accelerations change by {tilted:.2g} m/s² in {duration:.0f} s, rest is '
            f'below {STILL_ACCELERATION:g} m/s²; let it stand still'
        )
    bias = line[0]
    if np.abs(bias).max() > MAX_BIAS:
        axis = 'xyz'[int(np.argmax(np.abs(bias)))]
        raise RefusedError(f'rate {axis} is {np.abs(bias).max():.3f} rad/s throughout: it turns')
    up = force.mean(axis=0)
    norm = float(np.linalg.norm(up))
    if abs(norm - GRAVITY_M_S2) > MAX_NORM_ERROR:
        raise RefusedError(f'gravity is measured as {norm:.2f} m/s²; calibrate the accelerometer')
    level = float(np.arctan2(up[1], up[2])), float(np.arctan2(-up[0], np.hypot(up[1], up[2])))
    return RestEstimate(
        duration, _three(bias), _three(errors[0]), _three(line[1]), _three(errors[1]),
        _three(np.std(np.diff(rates, axis=0), axis=0) / np.sqrt(2.0)), norm - GRAVITY_M_S2, level,
    )  # fmt: skip


def _means(values: FloatArray, blocks: npt.NDArray[np.int_]) -> FloatArray:
    """(blocks, w) means of the rows of each block."""
    counts = np.bincount(blocks)
    occupied = counts > 0
    sums = [np.bincount(blocks, column)[occupied] / counts[occupied] for column in values.T]
    return np.stack(sums, axis=1)


def _line(clock: FloatArray, means: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(2, w) offset and slope of a straight line, their standard errors, the residuals."""
    design = np.stack([np.ones_like(clock), clock], axis=1)
    line, *_ = np.linalg.lstsq(design, means, rcond=None)
    off: FloatArray = means - design @ line
    spread = (off**2).sum(axis=0) / max(len(clock) - 2, 1)
    covariance = np.diag(np.linalg.inv(design.T @ design))
    errors: FloatArray = np.sqrt(covariance[:, None] * spread)
    return np.asarray(line, float), errors, off


def _still(off: FloatArray, limit: float, unit: str, what: str) -> None:
    worst = float(np.abs(off).max())
    if worst > limit:
        block = int(np.argmax(np.abs(off).max(axis=1)))
        raise RefusedError(
            f'it {what}: {worst:.3g} {unit} at {block * BLOCK_S:.1f} s, rest is below {limit:g} '
            f'{unit}; let it stand still'
        )


def _three(values: FloatArray) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z
