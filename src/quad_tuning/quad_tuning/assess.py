"""What one set of gains gives: step, disturbance, noise, margins, nominal and over the ensemble.

The same figures for the gains that flew and for a proposal. Nothing is optimised here.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.integrate import trapezoid

from quad_sysid.contract import FloatArray
from quad_sysid.loop.cascade import (
    CascadeGains,
    bandwidth,
    noise_response,
    open_loop,
    reference_response,
)
from quad_sysid.loop.figures import StepFigures, square_figures, square_wave
from quad_sysid.loop.plant import LoopPlant
from quad_sysid.loop.simulation import simulate_cascade
from quad_tuning.ensemble import Ensemble
from quad_tuning.errors import DesignRefusedError

SQUARE_AMPLITUDE_RAD = np.radians(12.0)
SQUARE_HALF_PERIOD_S = 2.0
TORQUE_STEP = 2.0
"""rad/s² of the disturbance step."""
TORQUE_STEP_S = 3.0


@dataclass(frozen=True)
class LoopFigures:
    """What one set of gains gives on the nominal plant, and the worst over the ensemble."""

    step: StepFigures
    rms_tracking_rad: float
    disturbance_rms_rad: float
    noise_gain: float
    """RMS of the control per RMS of white noise on the measured rate, 1/(rad/s)."""
    bandwidth_rad_s: float
    crossover_rad_s: float
    phase_margin_deg: float
    gain_margin_db: float
    peak_sensitivity: float
    worst_phase_margin_deg: float
    worst_gain_margin_db: float
    worst_peak_sensitivity: float
    unstable: int
    rate_rms_rad_s: float
    """Of the rate over the square wave."""
    worst_peak_complementary: float
    """Largest |L / (1 + L)| over the ensemble."""


def assess(plant: LoopPlant, gains: CascadeGains, ensemble: Ensemble) -> LoopFigures:
    """Figures of `gains` on the nominal plant and over the ensemble."""
    every = ensemble.margins(gains)
    nominal = ensemble.subset(np.flatnonzero(ensemble.nominal)[:1])
    response = reference_response(gains, nominal.response, nominal.omega, plant.dt)
    reference = reference_square(plant.dt)
    run = simulate_cascade(plant, gains, reference, plant.dt, initial_angle=float(reference[0]))
    if not np.isfinite(run.angle).all():
        raise DesignRefusedError('the simulated loop diverges')
    square = square_figures(reference, run.angle, plant.dt)
    first = int(np.flatnonzero(ensemble.nominal)[0])
    return LoopFigures(
        step=square,
        rms_tracking_rad=square.rms_error_rad,
        disturbance_rms_rad=disturbance(plant, gains),
        noise_gain=noise_gain(gains, nominal),
        bandwidth_rad_s=float(bandwidth(response, nominal.omega)[0]),
        crossover_rad_s=float(every.crossover_rad_s[first]),
        phase_margin_deg=float(every.phase_margin_deg[first]),
        gain_margin_db=float(every.gain_margin_db[first]),
        peak_sensitivity=float(every.peak_sensitivity[first]),
        worst_phase_margin_deg=float(np.min(every.phase_margin_deg)),
        worst_gain_margin_db=float(np.min(every.gain_margin_db)),
        worst_peak_sensitivity=float(np.max(every.peak_sensitivity)),
        unstable=int(np.sum(ensemble.unstable(gains))),
        rate_rms_rad_s=float(np.sqrt(np.mean(run.rate**2))),
        worst_peak_complementary=_peak_complementary(gains, ensemble),
    )


def _peak_complementary(gains: CascadeGains, ensemble: Ensemble) -> float:
    loop = open_loop(gains, ensemble.response, ensemble.omega, ensemble.cycle.dt)
    return float(np.max(np.abs(loop / (1.0 + loop))))


def reference_square(dt: float) -> FloatArray:
    """The square wave (n,) that a design is judged by, rad."""
    return square_wave(float(SQUARE_AMPLITUDE_RAD), SQUARE_HALF_PERIOD_S, 1, dt)


def tracking(plant: LoopPlant, gains: CascadeGains, reference: FloatArray) -> tuple[float, float]:
    """RMS error, rad, and overshoot beyond the reference, %, of the square wave."""
    run = simulate_cascade(plant, gains, reference, plant.dt, initial_angle=float(reference[0]))
    beyond = (np.max(np.abs(run.angle)) / SQUARE_AMPLITUDE_RAD - 1.0) / 2.0
    return float(np.sqrt(np.mean((reference - run.angle) ** 2))), 100.0 * float(beyond)


def disturbance(plant: LoopPlant, gains: CascadeGains) -> float:
    """RMS angle under a torque step, rad."""
    n = round(TORQUE_STEP_S / plant.dt)
    level = replace(plant, bias=0.0)
    run = simulate_cascade(level, gains, np.zeros(n), plant.dt, disturbance=TORQUE_STEP)
    return float(np.sqrt(np.mean(run.angle**2)))


def noise_gain(gains: CascadeGains, nominal: Ensemble) -> float:
    """RMS of the control per RMS of white noise on the measured rate, 1/(rad/s)."""
    gain = np.abs(noise_response(gains, nominal.response, nominal.omega, nominal.cycle.dt)[0])
    total = trapezoid(gain**2, nominal.omega)
    return float(np.sqrt(total / (nominal.omega[-1] - nominal.omega[0])))
