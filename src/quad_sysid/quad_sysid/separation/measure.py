"""How far apart two rivals are on one flight: what the other, refitted, cannot mimic, over noise.

The flight is free of noise and flown with the true rival; the other is fitted to it together with
the base as identification does. What then is left of the free-run windows, e (windows, length),
is what real flights would have to tell them apart by:

    distance = sqrt(sum e' S^-1 e)                      (Mahalanobis; S the noise's covariance)
    score    = sum |e|² / sqrt(4 sum e' S e)            (paired difference of squared errors,
                                                         expected value over its spread)

and Phi(score) is the probability that the true one has the smaller error.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import linalg, special

from quad_sysid.contract import FloatArray
from quad_sysid.effects.judge import hold_error
from quad_sysid.greybox.data import AxisData
from quad_sysid.greybox.fit import fit_structure, fit_with_effect
from quad_sysid.greybox.noise import (
    NoiseModel,
    scaled,
    white_noise_model,
    window_covariance,
)
from quad_sysid.greybox.simulate import Simulator
from quad_sysid.greybox.structure import Prepared, Structure
from quad_sysid.separation.aircraft import Aircraft

FEW_STEPS = 20
"""Iterations of a fit to a flight without noise."""
MOTION = 3.0
"""Holding the last rate must err by so many times the noise, or the base is not told."""


@dataclass(frozen=True)
class Noise:
    """Noise of an aircraft, and what it does to a free-run window."""

    model: NoiseModel
    covariance: FloatArray
    """(length, length) (rad/s)²."""
    root: FloatArray
    """Lower Cholesky factor of it."""

    @property
    def rms(self) -> float:
        """Free-run error that the noise alone explains, rad/s."""
        return float(np.sqrt(np.mean(np.diag(self.covariance))))


def noise_of(aircraft: Aircraft, data: AxisData) -> Noise:
    """The aircraft's noise, and the state correction that suits it."""
    damping = float(aircraft.theta[3])
    measurement = max(aircraft.noise_rms, 1e-6)
    model = white_noise_model(
        max(aircraft.torque_noise / measurement, 1e-3), damping, data,
        before_filter=data.gyro_filter_hz is not None,
    )
    model = scaled(model, model.innovation_rms * measurement)
    length = data.windows(data.train).length
    covariance = window_covariance(model, damping, data, length)
    # behind a filter neighbouring samples hardly differ; a little white noise keeps S regular
    covariance += (0.1 * measurement) ** 2 * np.eye(length)
    return Noise(model, covariance, linalg.cholesky(covariance, lower=True))


@dataclass(frozen=True)
class Apart:
    """How far one fitted rival stays behind the true one, over a flight of `seconds`."""

    distance: float
    """In standard deviations of the noise."""
    score: float
    mimicked: float
    """Share of the true effect's trace (mean square) that the other takes over, 0..1."""
    seconds: float

    def over(self, seconds: float) -> Apart:
        """The same for a longer or shorter flight of this kind."""
        grown = math.sqrt(seconds / self.seconds)
        return Apart(self.distance * grown, self.score * grown, self.mimicked, seconds)

    @property
    def probability(self) -> float:
        """That the true one has the smaller error."""
        return float(special.ndtr(self.score))

    def seconds_for(self, probability: float) -> float:
        """Length of flight after which the true one has the smaller error so surely."""
        wanted = float(special.ndtri(probability))
        return math.inf if self.score <= 0.0 else self.seconds * (wanted / self.score) ** 2


def base_growth(
    data: AxisData, noise: Noise, structure: Structure, theta: FloatArray
) -> float:
    """Error of `structure` refitted to a flight, over the noise; 1 where it lacks nothing."""
    sim = _simulator(data, noise)
    fit = fit_structure(sim, structure, theta, max_iterations=FEW_STEPS)
    if not np.isfinite(fit.errors).all():
        return math.inf
    return math.sqrt(1.0 + (fit.rms / noise.rms) ** 2)


def apart(
    data: AxisData, noise: Noise, true: tuple[Structure, FloatArray],
    plain: tuple[Structure, FloatArray], other: tuple[Prepared, ...],
) -> Apart:
    """Fit `other` (the best of its variants; none: nothing) on top of `plain` to a flight.

    true, plain: structure and parameters (p,) with the true rival, and with neither.
    """
    sim = _simulator(data, noise)
    seconds = sim.windows.count * sim.windows.length * data.dt
    exact = sim.run(*true).errors
    base = fit_structure(sim, *plain, max_iterations=FEW_STEPS)
    fits = [fit_with_effect(sim, base, *put, max_iterations=FEW_STEPS) for put in other]
    best = min(fits, key=lambda fit: fit.rms, default=base)
    if best.rms > base.rms:
        best = base
    errors, before = best.errors - exact, base.errors - exact
    if not (np.isfinite(errors).all() and np.isfinite(before).all()):
        return Apart(0.0, 0.0, 1.0, seconds)
    square, all_of_it = float(np.sum(errors**2)), float(np.sum(before**2))
    white = linalg.solve_triangular(noise.root, errors.T, lower=True)
    spread = 2.0 * math.sqrt(float(np.sum((errors @ noise.root) ** 2)))
    return Apart(
        distance=float(np.linalg.norm(white)),
        score=square / spread if spread > 0.0 else 0.0,
        mimicked=max(0.0, 1.0 - square / all_of_it) if all_of_it > 0.0 else 1.0,
        seconds=seconds,
    )


def informative(data: AxisData, noise: Noise) -> bool:
    """Whether the flight moves enough for half a second of free run to tell the base itself."""
    return hold_error(_simulator(data, noise)) > MOTION * noise.rms


def _simulator(data: AxisData, noise: Noise) -> Simulator:
    return Simulator(data, data.train, data.windows(data.train), noise.model.correction)
