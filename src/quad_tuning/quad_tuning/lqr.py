"""LQR for the angle: discrete, the delay by prediction, integral action, observer.

Feedback of drive, rate, angle and the integral of the angle's error in the firmware's model
(state_feedback.py); weights by Bryson's rule. For a delayed input the optimal feedback is the
undelayed one on predicted states. Slow motors enter the model by the mean of the lags, the gyro's
filter by its delay, curves by their gain in wide motion. The loop is slowed until every loop of
the ensemble, which contains all of these, keeps its margins.
Source: Anderson, Moore, Optimal Control (1990), 2.3 and 7.2; Bryson, Ho, Applied Optimal Control
(1975), 5.2.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import control
import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.loop.cascade import CascadeGains, Dynamics, closed_loop_radius, margins
from quad_sysid.loop.plant import ComplexArray, LoopPlant, slopes_at, state_space
from quad_tuning.assess import SQUARE_AMPLITUDE_RAD, margin_figures, reference_square, square
from quad_tuning.ensemble import AMPLITUDES, Ensemble
from quad_tuning.errors import DesignRefusedError
from quad_tuning.objective import Requirements, meets
from quad_tuning.state_feedback import (
    LIMITS,
    StateFeedback,
    beside,
    controller_response,
    simulate,
)
from quad_tuning.way import least_on_the_way

FASTEST = 0.02
RAISE = 1.2
ROUNDS = 72
SHARES = (0.25, 0.5)
"""Shares of the state feedback in the bridge's steps."""


@dataclass(frozen=True)
class Weights:
    """Bryson's rule: the largest value of each that is acceptable; its weight is 1 / max²."""

    angle_rad: float = 0.1
    rate_rad_s: float = 0.7
    integral_rad_s: float = 0.2
    control: float = 0.1


@dataclass(frozen=True)
class Noise:
    """Noise that the observer assumes."""

    torque: float = 50.0
    """RMS of the torque noise over one cycle, rad/s²."""
    rate: float = 0.01
    """RMS, rad/s."""


@dataclass(frozen=True)
class LqrDesign:
    """A controller and its figures."""

    controller: StateFeedback
    figures: dict[str, float]
    """Margins, nominal and the worst over the ensemble, and its square wave."""
    control_weight: float
    """Factor on the control's Bryson weight with which the margins hold."""


def design_lqr(plant: LoopPlant, ensemble: Ensemble, output_limit: float,
               weights: Weights | None = None, noise: Noise | None = None,
               needs: Requirements | None = None) -> LqrDesign:
    """The fastest LQR of this family that keeps margins and bounds; else DesignRefusedError."""
    needs = needs or Requirements()
    factor = FASTEST
    for _ in range(ROUNDS):
        try:
            found = feedback(plant, output_limit, factor, weights or Weights(), noise or Noise())
        except (ValueError, np.linalg.LinAlgError):
            factor *= RAISE
            continue
        if not passes(found):
            factor *= RAISE
            continue
        dynamics = found.dynamics()
        every = margins(loop_gain(dynamics, ensemble), ensemble.omega)
        if meets(every, needs).all() and closed_loop_radius(dynamics, ensemble.cycle).max() < 1.0:
            return LqrDesign(controller=found,
                             figures={**margin_figures(every, ensemble), **_square(plant, found)},
                             control_weight=factor)
        factor *= RAISE
    raise DesignRefusedError('no LQR keeps the margins over all draws; identify more precisely')


def passes(found: StateFeedback) -> bool:
    """Whether its gains are within the bridge's bounds."""
    return all(low <= getattr(found, name) <= high
               for name, (low, high, _) in LIMITS.items() if name.startswith('k_'))


def feedback(plant: LoopPlant, output_limit: float, factor: float, weights: Weights,
             noise: Noise) -> StateFeedback:
    """The optimal feedback where the control's weight is `factor` times Bryson's."""
    slopes = slopes_at(plant, *AMPLITUDES[0])
    dt, slow = plant.dt, plant.slow
    lag = plant.lag_s if slow is None else (
        (1.0 - slow.share) * plant.lag_s + slow.share * slow.lag_s
    )
    late = plant.delay_s
    if plant.gyro_filter_hz is not None:  # a Butterworth's delay at low frequency
        late += np.sqrt(2.0) / (2.0 * np.pi * plant.gyro_filter_hz)
    bare = StateFeedback(k_angle=0.0, k_rate=0.0, k_drive=0.0, k_integral=0.0,
                         gain=plant.gain * slopes.command, lag_s=max(lag, 0.001),
                         delay_s=dt * round(late / dt), damping=plant.damping - slopes.rate,
                         observer=_observer(plant.damping - slopes.rate, dt, noise), dt=dt,
                         output_limit=output_limit)
    a, b = _states(bare)
    # a loop slower by s = factor^(-1/4) keeps its shape when rates count s^-2 and integrals s^2
    q = np.diag([0.0, np.sqrt(factor) / weights.rate_rad_s**2, 1.0 / weights.angle_rad**2,
                 1.0 / np.sqrt(factor) / weights.integral_rad_s**2])
    gain, _, _ = control.dlqr(a, b, q, [[factor / weights.control**2]])
    k_drive, k_rate, k_angle, pull = (float(value) for value in np.asarray(gain)[0])
    return replace(bare, k_angle=k_angle, k_rate=k_rate, k_drive=k_drive, k_integral=-pull)


def way_is_safe(found: StateFeedback, active: CascadeGains, ensemble: Ensemble) -> bool:
    """Whether each mix of feedback and flown cascade keeps the margins of a step."""
    least = least_on_the_way(active, ensemble)
    mixed = [beside(found, active, share) for share in SHARES]
    return all(
        meets(margins(loop_gain(both, ensemble), ensemble.omega), least).all()
        and closed_loop_radius(both, ensemble.cycle).max() < 1.0 for both in mixed
    )


def loop_gain(dynamics: Dynamics, ensemble: Ensemble) -> ComplexArray:
    """(p, f) loop gain broken at the control, with the sign of negative feedback."""
    response = controller_response(dynamics, ensemble.omega, ensemble.cycle.dt)
    return np.asarray(-np.einsum('of,opf->pf', response, ensemble.response))


def _states(bare: StateFeedback) -> tuple[FloatArray, FloatArray]:
    """(4, 4) and (4, 1) of drive, rate, angle and the integral of -angle, without the delay."""
    dt, share = bare.dt, -np.expm1(-bare.dt / bare.lag_s)
    a, b = np.eye(4), np.zeros((4, 1))
    a[0, 0], b[0, 0] = 1.0 - share, share * bare.gain
    a[1, 0], b[1, 0] = 0.5 * dt * (2.0 - share), 0.5 * dt * share * bare.gain
    a[1, 1] = 1.0 - dt * bare.damping
    a[2, :2], b[2] = 0.5 * dt * (a[1, :2] + (0.0, 1.0)), 0.5 * dt * b[1]
    a[3, 2] = -dt
    return a, b


def _observer(damping: float, dt: float, noise: Noise) -> float:
    """Stationary Kalman gain of the rate: the drive is known from the commands."""
    keep, push, measured = 1.0 - damping * dt, (noise.torque * dt) ** 2, noise.rate**2
    # spread = keep² spread measured / (spread + measured) + push
    half = 0.5 * (push + measured * (keep**2 - 1.0))
    spread = half + np.sqrt(half**2 + push * measured)
    return float(spread / (spread + measured))


def _square(plant: LoopPlant, controller: StateFeedback) -> dict[str, float]:
    model = state_space(plant, slopes_at(plant, *AMPLITUDES[0]))
    reference = reference_square(plant.dt)
    angle, _ = simulate(model, controller, reference, -float(SQUARE_AMPLITUDE_RAD))
    return square(reference, angle, plant.dt)
