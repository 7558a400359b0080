"""The noise that drives and covers the rate: state correction, measurement noise, torque noise.

Model: white torque noise of intensity q drives the rate; white gyro noise enters before the gyro
filter (as in the chip) or after it. The steady-state Kalman gain follows from their ratio.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.greybox import kernels
from quad_sysid.greybox.data import AxisData
from quad_sysid.greybox.drive import gyro_step

NUGGET_S = (0.03, 0.12)
"""Lags of the variogram: longer than the gyro filter's memory, too short for much torque."""
LEAD_S = 0.04
"""So long a window still knows the noise that was in its first sample."""


@dataclass(frozen=True)
class NoiseModel:
    """Torque and measurement noise, both white, with the Kalman gain they give."""

    torque: float
    """Intensity sqrt(q) of the torque noise, (rad/s²)/√Hz (two-sided)."""
    measurement_rms: float
    """RMS of the noise in the measured rate, rad/s."""
    before_filter: bool
    correction: FloatArray
    """(4,) what the innovation adds to the state, as kernels.track takes it."""
    covariance: FloatArray
    """(4, 4) of the predicted state (rate, gyro noise, filter output, carry)."""
    innovation_rms: float


def _linear(
    damping: float, data: AxisData
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """F (4, 4), G (4, 2), C (4,) of (rate, gyro noise, output, carry); the filter (2, 5)."""
    dt = data.dt
    step = gyro_step(data.gyro_filter_hz, dt, data.realisation).copy()
    # between two cycles the noise-driven rate is a straight line to first order
    step[:, 2] += 0.5 * step[:, 3]
    step[:, 4] += 0.5 * step[:, 3]
    step[:, 3] = 0.0
    decay = float(np.exp(-max(damping, 0.0) * dt))
    f = np.zeros((4, 4))
    f[0, 0] = decay
    f[2] = [step[0, 2] + step[0, 4] * decay, step[0, 2], step[0, 0], step[0, 1]]
    f[3] = [step[1, 2] + step[1, 4] * decay, step[1, 2], step[1, 0], step[1, 1]]
    g = np.array([[1.0, 0.0], [0.0, 1.0], [step[0, 4], step[0, 4]], [step[1, 4], step[1, 4]]])
    return f, g, np.array([0.0, 0.0, 1.0, 0.0]), step


def white_noise_model(
    ratio: float,
    damping: float,
    data: AxisData,
    *,
    before_filter: bool,
) -> NoiseModel:
    """Noise model for measurement noise of 1 rad/s RMS and torque noise of intensity `ratio`.

    ratio in (rad/s²)/√Hz per rad/s; scale all but `correction` by what the innovations say
    (`scaled`).
    """
    f, g, c, step = _linear(damping, data)
    q, r = _intensities(ratio, 1.0, step, data.dt, before_filter=before_filter)
    p = kernels.steady_covariance(f, g @ q @ g.T, c, r, 20000)
    s = float(p[2, 2]) + r
    gain = p[:, 2] / s
    correction = np.array(
        [gain[0], gain[2], gain[3] + step[0, 2] * gain[1], step[1, 2] * gain[1]]
    )
    return NoiseModel(ratio, 1.0, before_filter, correction, p, float(np.sqrt(s)))


def _intensities(
    torque: float, measurement_rms: float, step: FloatArray, dt: float, *, before_filter: bool
) -> tuple[FloatArray, float]:
    """Covariance (2, 2) of (rate increment, gyro noise) a cycle, and that behind the filter."""
    if not before_filter:
        return np.diag([torque**2 * dt, 0.0]), measurement_rms**2
    impulse = np.zeros(400)
    g = d = 0.0
    for i in range(impulse.size):
        now, last = float(i == 0), float(i == 1)
        g, d = (
            step[0, 0] * g + step[0, 1] * d + step[0, 2] * last + step[0, 4] * now,
            step[1, 0] * g + step[1, 1] * d + step[1, 2] * last + step[1, 4] * now,
        )
        impulse[i] = g
    variance = measurement_rms**2 / float(impulse @ impulse)
    return np.diag([torque**2 * dt, variance]), 1e-6 * measurement_rms**2


def measured_noise(errors: FloatArray, dt: float) -> float | None:
    """RMS of the noise in the measured rate, rad/s, whatever its colour; None: cannot be told.

    errors (windows, length): free-run errors. Half the mean square of what they change by over a
    lag is the noise's variance and what torque and model error add, which vanishes as the lag
    goes to zero; the value there (the nugget of a variogram, Matheron 1963) by a parabola.
    """
    within = errors[:, round(LEAD_S / dt) :]
    last = min(round(NUGGET_S[1] / dt), within.shape[1] - 1)
    lags = np.arange(max(1, round(NUGGET_S[0] / dt)), last + 1)
    if lags.size < 4 or not np.isfinite(within).all():
        return None
    half = [0.5 * float(np.mean((within[:, k:] - within[:, :-k]) ** 2)) for k in lags]
    nugget = np.polynomial.Polynomial.fit(lags * dt, half, 2)(0.0)
    return float(np.sqrt(max(nugget, 0.0)))


def scaled(model: NoiseModel, innovation_rms: float) -> NoiseModel:
    """The model with its noises scaled so that the innovations have this RMS."""
    factor = innovation_rms / model.innovation_rms
    return NoiseModel(
        torque=model.torque * factor,
        measurement_rms=model.measurement_rms * factor,
        before_filter=model.before_filter,
        correction=model.correction,
        covariance=model.covariance * factor**2,
        innovation_rms=innovation_rms,
    )


def predicted_rms(
    model: NoiseModel, damping: float, data: AxisData, length: int
) -> float:
    """RMS of the free-run error over `length` samples that the noise alone explains, rad/s."""
    f, g, c, step = _linear(damping, data)
    q, r = _intensities(
        model.torque, model.measurement_rms, step, data.dt, before_filter=model.before_filter
    )
    p = model.covariance
    total = 0.0
    for _ in range(length):
        total += float(c @ p @ c) + r
        p = f @ p @ f.T + g @ q @ g.T
    return float(np.sqrt(total / length))


def window_covariance(
    model: NoiseModel, damping: float, data: AxisData, length: int
) -> FloatArray:
    """(length, length) covariance of the free-run error over a window, from the noise alone.

    Its mean diagonal is the square of `predicted_rms`.
    """
    f, g, c, step = _linear(damping, data)
    q, r = _intensities(
        model.torque, model.measurement_rms, step, data.dt, before_filter=model.before_filter
    )
    p, out = model.covariance, np.zeros((length, length))
    for i in range(length):
        ahead = p @ c
        for j in range(i, length):
            out[i, j] = out[j, i] = float(c @ ahead)
            ahead = f @ ahead
        out[i, i] += r
        p = f @ p @ f.T + g @ q @ g.T
    return out
