"""Residuals of base, completed model and selected black box on the held-out segments, with tests.

Errors and innovations of the free run and the filter, whiteness, correlation with the command,
spectrum with peaks, and the torque that a model seems to lack over time. The verdict on them is
discover/accept.py's; written by report/document.py, drawn by report/plots_*.py.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage, signal, special

from quad_sysid.blackbox import Model, innovation_test, predict, residual_test
from quad_sysid.contract import FloatArray
from quad_sysid.discover.accept import Unseen
from quad_sysid.errors import QuadSysidError
from quad_sysid.estimate import stored
from quad_sysid.estimate.fit import Fit
from quad_sysid.model.effect import required
from quad_sysid.pipeline.answer import AxisAnswer, Findings, HeldOut, MissingTorque, Residual
from quad_sysid.record import IOData, finite_runs


def held_out(unseen: Unseen, fitted: Fit) -> HeldOut:
    """Errors of a fitted structure on the validation segments."""
    predicted, errors = unseen.predict(fitted), unseen.errors(fitted)
    inside = np.zeros(unseen.problem.data.rate.size, dtype=bool)
    for start, stop in unseen.problem.spans:
        inside[start:stop] = True
    with np.errstate(over='ignore', invalid='ignore'):
        return HeldOut(fitted, errors, interval(errors),
                       np.where(inside, predicted.innovation, np.nan),
                       np.where(inside, predicted.states[:, 1], np.nan))


def interval(errors: FloatArray) -> tuple[float, float]:
    """95 % of the RMS over windows (windows, length) that are independent of each other."""
    square = np.mean(errors**2, axis=1)
    mean = float(np.mean(square))
    if square.size < 2 or not mean > 0.0:
        return 0.0, float('inf')
    spread = 1.96 * float(np.std(square, ddof=1)) / np.sqrt(square.size) / mean
    low, high = np.sqrt(mean) * np.exp(0.5 * np.array([-spread, spread]))
    return float(low), float(high)


LOWEST_PEAK_HZ = 1.0
"""Below this, two lines of the spectrum, a peak cannot be told from a slope."""
WINDOW_S = 2.0
"""Window of the spectra, which resolves peaks half a hertz apart."""
PEAK = 6.0
"""Least power of a peak over its surroundings, whatever its significance."""


def residuals(answer: AxisAnswer, findings: Findings) -> dict[str, Residual]:
    """Residuals of the held-out rate: `before`, `after` (with or without effects), `blackbox`.

    A model is left out where the segments are too short to test it.
    """
    z = required(answer.validation)
    out = {name: replace(tested, missing=missing_torque(result, z.dt))
           for name, result in (('before', findings.before), ('after', findings.after))
           if (tested := residual(result.innovations, z)) is not None}
    if answer.selected is not None:
        model = answer.rows[answer.selected].step_a.model
        tested = residual(z.y - predict(model, z, 1), z, model)
        out |= {} if tested is None else {'blackbox': tested}
    return out


def residual(errors: FloatArray, z: IOData, model: Model | None = None) -> Residual | None:
    """Tests and spectrum of one-step errors (n,), NaN where there are none; None if too few.

    model: the black box whose errors they are.
    """
    try:
        test = innovation_test(errors, z) if model is None else residual_test(z, model)
    except QuadSysidError:
        return None
    spectrum = _spectrum(errors, z.dt)
    f, density, _ = spectrum or (np.zeros(0), np.zeros(0), 0)
    finite = errors[np.isfinite(errors)]
    return Residual(test=test, rms=float(np.sqrt(np.mean(finite**2))), frequency_hz=f,
                    density=density, peaks=_peaks(*spectrum) if spectrum else ())


def missing_torque(result: HeldOut, dt: float) -> MissingTorque:
    """The torque disturbance that the filter sees, beside what its own noise lets one expect."""
    samples = np.flatnonzero(np.isfinite(result.disturbance))
    noise, steady = stored.noise_of(result.fit), result.fit.prediction.filter
    variance = max(noise.ratios['disturbance'] ** 2 - float(steady.covariance[1, 1]), 0.0)
    return MissingTorque(samples.astype(np.float64) * dt, result.disturbance[samples],
                         noise.gyro_rms * float(np.sqrt(variance)))


def _peaks(f: FloatArray, density: FloatArray, count: int) -> tuple[tuple[float, float], ...]:
    """Frequency (Hz) and power over the surroundings of each narrow peak, strongest first.

    The spectrum of `count` windows is compared with its own running median; a peak must stand out
    of the scatter of the estimate at 0.1 % over all frequencies together.
    """
    if not density.max() > 0.0:
        return ()
    width = max(9, round(10.0 * WINDOW_S) | 1)
    median = ndimage.median_filter(density, size=width, mode='nearest')
    ratio = density / np.maximum(median, 1e-12 * density.max())
    tested = (f >= LOWEST_PEAK_HZ) & (f < 0.95 * f[-1])  # the last lines hold folded ones
    freedom = 1.2 * count  # halves overlap, so neighbours in time are not independent
    level = float(special.chdtri(freedom, 1e-3 / max(int(tested.sum()), 1))) / freedom
    # half as much again, since a running median only follows the background
    high = tested & (ratio > max(PEAK, 1.5 * level))
    peaks = [
        (float(f[i]), float(ratio[i])) for i in np.flatnonzero(high)
        if ratio[i] == ratio[max(i - 4, 0) : i + 5].max()
    ]
    return tuple(sorted(peaks, key=lambda item: -item[1]))


def _spectrum(values: FloatArray, dt: float) -> tuple[FloatArray, FloatArray, int] | None:
    """Frequencies (m,) Hz, Welch's density (m,) per Hz over the unbroken stretches, its windows.

    None where there is too little for a spectrum.
    """
    size = round(WINDOW_S / dt)
    runs = [r for r in finite_runs(np.isfinite(values), (0, values.size)) if r[1] - r[0] >= size]
    spectra: list[FloatArray] = []
    weights: list[int] = []
    f = np.zeros(0)
    for a, b in runs:
        f, density = signal.welch(values[a:b] - values[a:b].mean(), 1.0 / dt, nperseg=size)
        spectra.append(np.asarray(density))
        weights.append(max(1, 2 * (b - a) // size - 1))
    count = sum(weights)
    if count < 4:
        return None
    density = np.average(spectra, axis=0, weights=weights)
    return f, np.asarray(density), count
