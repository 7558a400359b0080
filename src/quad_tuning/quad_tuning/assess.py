"""Figures of a controller: step, disturbance, noise, margins, and its prediction for the watch.

The figures are the same for flown and new gains, nominal and over the ensemble. Cascade and state
feedback share margins, noise and prediction. Nothing is optimised here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
import numpy.typing as npt
from scipy.integrate import trapezoid

from quad_sysid.axes import EVERY
from quad_sysid.contract import FloatArray
from quad_sysid.loop.cascade import (
    CascadeGains,
    Controller,
    Margins,
    bandwidth,
    noise_response,
    reference_response,
)
from quad_sysid.loop.figures import square_figures, square_wave
from quad_sysid.loop.linear import ComplexArray
from quad_sysid.loop.plant import Flying
from quad_sysid.loop.simulation import LoopResponse, simulate_cascade
from quad_tuning.ensemble import Ensemble
from quad_tuning.errors import DesignRefusedError
from quad_tuning.state_feedback import StateFeedback, simulate

Flown = CascadeGains | Sequence[CascadeGains] | StateFeedback


@dataclass(frozen=True)
class Requirements:
    """Requirements on every loop of the ensemble, or on the nominal one."""

    phase_margin_deg: float = 45.0
    gain_margin_db: float = 8.0
    peak_sensitivity: float = 1.8
    overshoot_pct: float = 15.0
    """Nominal, of the square wave."""
    noise_factor: float = 3.0
    """Noise at the motors relative to the flown gains; always allowed up to `motor_noise`."""
    motor_noise: float = 0.01
    """Harmless RMS noise at the motors, normalised command."""
    disturbance_factor: float = 1.0
    """RMS angle under a torque step, relative to the flown gains."""
    highest_crossover_rad_s: float = float('inf')
    """Nominal."""


@dataclass(frozen=True)
class LoopFigures:
    """Figures of one set of gains on the nominal plant; `worst_…` over the ensemble."""

    phase_margin_deg: float
    gain_margin_db: float
    peak_sensitivity: float
    crossover_rad_s: float
    worst_phase_margin_deg: float
    worst_gain_margin_db: float
    worst_peak_sensitivity: float
    rise_time_s: float
    overshoot_pct: float
    settling_time_s: float
    rms_tracking_rad: float
    """RMS error over the square wave; rate_rms_rad_s is the RMS of the rate over it."""
    rate_rms_rad_s: float
    disturbance_rms_rad: float
    bandwidth_rad_s: float
    noise_gain: float
    """RMS of the control per RMS of the noise on the measured rate, 1/(rad/s)."""
    unstable_draws: int
    worst_peak_complementary: float
    """Largest |L / (1 + L)| over the ensemble."""

    def named(self, noise_rms: float | None = None) -> dict[str, float]:
        """The figures by name; `motor_noise_rms` (normalised command) where the noise is known."""
        values = {name: float(value) for name, value in asdict(self).items()}
        gain = values.pop('noise_gain')
        return values if noise_rms is None else {**values, 'motor_noise_rms': gain * noise_rms}


def assess(plant: Flying, controller: CascadeGains | StateFeedback,
           ensemble: Ensemble) -> LoopFigures:
    """Figures of a controller on the nominal plant and over the ensemble."""
    nominal = ensemble.subset(np.flatnonzero(ensemble.nominal)[:1])
    response = reference_response(controller, nominal.response, nominal.omega, plant.dt)
    reference = reference_square(plant)
    run = flown(plant, controller, reference, float(reference[0]))
    if not np.isfinite(run.angle).all():
        raise DesignRefusedError('the simulated loop diverges; identify again')
    square = square_figures(reference, run.angle, plant.dt)
    loop, every = ensemble.loop(controller), ensemble.margins(controller)
    first = int(np.flatnonzero(ensemble.nominal)[0])
    return LoopFigures(phase_margin_deg=float(every.phase_margin_deg[first]),
                       gain_margin_db=float(every.gain_margin_db[first]),
                       peak_sensitivity=float(every.peak_sensitivity[first]),
                       crossover_rad_s=float(every.crossover_rad_s[first]),
                       worst_phase_margin_deg=float(np.min(every.phase_margin_deg)),
                       worst_gain_margin_db=float(np.min(every.gain_margin_db)),
                       worst_peak_sensitivity=float(np.max(every.peak_sensitivity)),
                       rise_time_s=square.rise_time_s, overshoot_pct=square.overshoot_pct,
                       settling_time_s=square.settling_time_s,
                       rms_tracking_rad=square.rms_error_rad,
                       rate_rms_rad_s=float(np.sqrt(np.mean(run.rate**2))),
                       disturbance_rms_rad=float(disturbance(plant, controller)),
                       bandwidth_rad_s=float(bandwidth(response, nominal.omega)[0]),
                       noise_gain=noise_gain(controller, nominal),
                       unstable_draws=int(np.sum(ensemble.unstable(controller))),
                       worst_peak_complementary=float(np.max(np.abs(loop / (1.0 + loop)))))


def meets(margins: Margins, needs: Requirements) -> npt.NDArray[np.bool_]:
    """(p,) True where a loop keeps phase margin, gain margin and peak sensitivity."""
    return np.asarray(
        (margins.phase_margin_deg >= needs.phase_margin_deg)
        & (margins.gain_margin_db >= needs.gain_margin_db)
        & (margins.peak_sensitivity <= needs.peak_sensitivity)
    )


def flown(plant: Flying, controller: Flown, reference: FloatArray, start: float = 0.0,
          torque: float = 0.0) -> LoopResponse:
    """The loop over time from the angle `start`, rad, under a constant torque, rad/s²."""
    if isinstance(controller, StateFeedback):
        return simulate(plant, controller, reference, start, torque)
    return simulate_cascade(plant, controller, reference, plant.dt, disturbance=torque,
                            initial_angle=start)


def reference_square(plant: Flying) -> FloatArray:
    """The square wave (n,), rad, by which designs are judged."""
    return square_wave(plant.trial.step, plant.trial.half_period_s, 1, plant.dt)


def tracking(plant: Flying, sets: Sequence[CascadeGains],
             reference: FloatArray) -> tuple[FloatArray, FloatArray]:
    """RMS error, rad, and overshoot beyond the reference, %, of the square wave, (g,) each."""
    angle = flown(plant, sets, reference, float(reference[0])).angle
    beyond = (np.max(np.abs(angle), axis=1) / plant.trial.step - 1.0) / 2.0
    return np.sqrt(np.mean((reference - angle) ** 2, axis=1)), 100.0 * beyond


def disturbance(plant: Flying, controller: Flown) -> FloatArray:
    """RMS angle under a torque step, rad; (g,) for several sets of gains."""
    still = np.zeros(round(plant.trial.push_s / plant.dt))
    run = flown(plant, controller, still, torque=plant.trial.push - plant.rest_acceleration)
    return np.asarray(np.sqrt(np.mean(run.angle**2, axis=-1)))


def noise_gain(controller: Controller, nominal: Ensemble) -> float:
    """RMS of the control per RMS of the noise on the measured rate, 1/(rad/s)."""
    omega = nominal.omega
    response = noise_response(controller, nominal.response, omega, nominal.cycle.dt)[0]
    total = trapezoid(nominal.noise * np.abs(response) ** 2, omega)
    return float(np.sqrt(total / (omega[-1] - omega[0])))


def promise(loops: Ensemble, before: Controller, after: Controller,
            lag_s: float) -> dict[str, float]:
    """Predicted change of the rates under the same disturbances, for the watch in flight.

    `rate_rms_ratio`, `oscillation_ratio` (the worst octave) and `peak`, the largest response to
    the reference over all draws. `lag_s` is the motors' lag, which does not delay a gust. The
    bridge's gains/watch.py reads them.
    """
    trial = EVERY[loops.axis].trial
    old, new = (_power(loops, loops.loop(one), lag_s) for one in (before, after))
    octaves = [(loops.omega > centre / np.sqrt(2.0)) & (loops.omega < centre * np.sqrt(2.0))
               for centre in trial.bands_rad_s]
    every = [np.sqrt(new[band].sum() / old[band].sum()) for band in octaves if band.any()]
    peak = np.abs(reference_response(after, loops.response, loops.omega, loops.cycle.dt)).max()
    return {'rate_rms_ratio': float(np.sqrt(new.sum() / old.sum())),
            'oscillation_ratio': float(max(every)), 'peak': float(peak)}


def _power(loops: Ensemble, loop: ComplexArray, lag_s: float) -> FloatArray:
    """(f,) power of the rate under gusts per grid point, mean of the nominal loops."""
    gust = loops.omega * np.gradient(np.log(loops.omega))  # the width that a point stands for
    gust /= 1.0 + (loops.omega / EVERY[loops.axis].trial.gust_rad_s) ** 2
    gust *= 1.0 + (loops.omega * lag_s) ** 2
    power = gust * np.abs(loops.response[0] / (1.0 + loop)) ** 2
    return np.asarray(power[loops.nominal].mean(axis=0))
