"""LQR for the angle: discrete, the delay by prediction, integral action, observer.

Feedback of drive, rate, angle and the integral of the angle's error in the firmware's model
(state_feedback.py); weights by Bryson's rule. For a delayed input the optimal feedback is the
undelayed one on predicted states. The firmware's model is the one that answers most like the plant
in wide motion (`likeness`). The loop is slowed until every loop of the ensemble keeps its margins.
Source: Anderson, Moore, Optimal Control (1990), 2.3 and 7.2; Bryson, Ho, Applied Optimal Control
(1975), 5.2.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import control
import numpy as np
from scipy.optimize import least_squares

from quad_sysid.axes import EVERY
from quad_sysid.contract import AXES, FloatArray
from quad_sysid.loop.cascade import CascadeGains, of_other_firmware
from quad_sysid.loop.linear import WIDE, loops_of
from quad_sysid.loop.plant import Flying
from quad_sysid.model import BEFORE, AxisModel
from quad_tuning.assess import Requirements, assess, meets, promise
from quad_tuning.bounds import BOUNDS, by_contract, check_inside, check_model, flown_gains
from quad_tuning.designer import LARGEST_LOSS_PCT, flown_loop
from quad_tuning.ensemble import Ensemble
from quad_tuning.errors import DesignRefusedError
from quad_tuning.state_feedback import PARAMETERS, StateFeedback, beside
from quad_tuning.way import least_on_the_way

FASTEST = 0.02
RAISE = 1.2
ROUNDS = 72
BAND_RAD_S = 2.0, 50.0
"""Where the firmware's model must answer like the plant."""
SHARES = (0.25, 0.5)
"""Shares of the state feedback in the bridge's steps."""


@dataclass(frozen=True)
class Weights:
    """Bryson's rule: the largest value of each that is acceptable; its weight is 1 / max²."""

    angle: float = 0.1
    """rad."""
    rate: float = 0.7
    """rad/s."""
    integral: float = 0.2
    """rad s."""
    control: float = 0.1


@dataclass(frozen=True)
class Noise:
    """Noise that the observer assumes."""

    torque: float = 50.0
    """RMS of the torque noise over one cycle, rad/s²."""
    rate: float = 0.01
    """RMS, rad/s."""


@dataclass(frozen=True)
class LqrProposal:
    """A controller for one axis with its figures; `<name>_before`: of the flown cascade."""

    controller: StateFeedback
    gains: dict[str, float]
    """The controller by the contract's names, with share 1, for /gains/update."""
    figures: dict[str, float]


def propose_lqr(model: AxisModel, weights: Weights | None = None) -> LqrProposal:
    """An LQR for the angle of one axis; raises DesignRefusedError with the reason."""
    if not EVERY[model.axis].turns or of_other_firmware(model.active_gains, model.axis):
        raise DesignRefusedError(f'{model.axis}: only the firmware of this project has a state '
                                 'feedback (--method lqr), for roll, pitch and yaw; use '
                                 '--method pid')
    check_model(model)
    check_inside(model)
    active = flown_gains(model)
    plant, loops, before = flown_loop(model, active)
    try:
        noise = Noise(rate=model.noise_rms) if model.noise_rms else Noise()
        controller, factor = design_lqr(plant, loops, active.output_limit, weights, noise)
    except DesignRefusedError as refusal:
        raise DesignRefusedError(f'{model.axis}: {refusal}') from refusal
    if not way_is_safe(controller, active, loops):
        raise DesignRefusedError(
            f'{model.axis}: a quarter or half of the LQR mixed with the flown gains leaves poor '
            'margins; take quad-tune design without --method lqr first'
        )
    after = assess(plant, controller, loops)
    lost = 100.0 * (after.rms_tracking_rad / before.rms_tracking_rad - 1.0)
    if lost > LARGEST_LOSS_PCT:
        raise DesignRefusedError(
            f'{model.axis}: the LQR that keeps all margins would raise the tracking error by '
            f'{lost:.0f} %; the delay is too long for it, take the cascade (--method pid)'
        )
    figures = {
        **after.named(model.noise_rms),
        **{f'{name}{BEFORE}': value for name, value in (
            before.named(model.noise_rms) | by_contract(active, model.axis, model.active_gains)
        ).items()},
        **promise(loops, active, controller, model.value('lag')), 'draws': float(loops.draws),
        'control_weight': factor,
    }
    return LqrProposal(controller, controller.to_mapping(model.axis),
                       {name: value for name, value in figures.items() if np.isfinite(value)})


def design_lqr(plant: Flying, ensemble: Ensemble, output_limit: float,
               weights: Weights | None = None, noise: Noise | None = None,
               needs: Requirements | None = None) -> tuple[StateFeedback, float]:
    """The fastest LQR of this family that keeps margins and bounds; else DesignRefusedError.

    With it comes the factor on the control's Bryson weight with which the margins hold.
    """
    needs, like = needs or Requirements(), likeness(plant)
    for factor in FASTEST * RAISE ** np.arange(ROUNDS):
        try:
            controller = feedback(plant, like, output_limit, factor, weights or Weights(),
                             noise or Noise())
        except (ValueError, np.linalg.LinAlgError):
            continue
        if (passes(controller) and meets(ensemble.margins(controller), needs).all()
                and not ensemble.unstable(controller).any()):
            return controller, float(factor)
    raise DesignRefusedError('no LQR keeps the margins over all draws; identify more precisely')


def passes(controller: StateFeedback) -> bool:
    """Whether its gains are within the bridge's bounds."""
    bounds = {name: BOUNDS[f'{AXES[0]}.lqr.{name}'] for name in PARAMETERS}
    return all(bounds[name].lower <= getattr(controller, name) <= bounds[name].upper
               for name in PARAMETERS if name.startswith('k_'))


def likeness(plant: Flying) -> tuple[float, float, float, float]:
    """Gain (rad/s² per command), lag (s), delay (s) and damping (1/s) that answer like the plant.

    In wide motion, over the band of a loop, by least squares of the logarithm of the response;
    the gyro filter is a part of the delay.
    """
    p, omega = plant.plant.p, np.geomspace(*BAND_RAD_S, 40)
    rate = loops_of([(plant, WIDE)]).response(omega)[0, 0]
    s = 1j * omega
    start = np.array([p[0], p[1], p[2] + plant.plant.sensor.late_s, max(p[3], 0.1)])

    def mismatch(factors: FloatArray) -> FloatArray:
        gain, lag, delay, damping = start * np.exp(factors)
        own = gain * np.exp(-s * (delay + 0.5 * plant.dt)) / ((lag * s + 1.0) * (s + damping))
        error = np.log(own / rate)
        phase = np.mod(error.imag + np.pi, 2.0 * np.pi) - np.pi
        return np.concatenate([error.real, phase, 0.05 * factors])

    best = start * np.exp(least_squares(mismatch, np.zeros(4)).x)
    return tuple(float(value) for value in best)  # type: ignore[return-value]


def feedback(plant: Flying, like: tuple[float, float, float, float], output_limit: float,
             factor: float, weights: Weights, noise: Noise) -> StateFeedback:
    """The optimal feedback with `factor` times Bryson's weight of the control."""
    dt, (gain, lag, late, damping) = plant.dt, like
    bare = StateFeedback(
        k_angle=0.0, k_rate=0.0, k_drive=0.0, k_integral=0.0, gain=gain, lag_s=max(lag, 0.001),
        delay_s=dt * round(late / dt), damping=damping, observer=_observer(damping, dt, noise),
        dt=dt, output_limit=output_limit,
    )
    a, b = _states(bare)
    # a loop slower by s = factor^(-1/4) keeps its shape when rates count s^-2 and integrals s^2
    q = np.diag([0.0, np.sqrt(factor) / weights.rate**2, 1.0 / weights.angle**2,
                 1.0 / np.sqrt(factor) / weights.integral**2])
    gain, _, _ = control.dlqr(a, b, q, [[factor / weights.control**2]])
    k_drive, k_rate, k_angle, pull = (float(value) for value in np.asarray(gain)[0])
    return replace(bare, k_angle=k_angle, k_rate=k_rate, k_drive=k_drive, k_integral=-pull)


def way_is_safe(controller: StateFeedback, active: CascadeGains, ensemble: Ensemble) -> bool:
    """Whether each mix of feedback and flown cascade keeps the margins of a step."""
    least = least_on_the_way(active, ensemble)
    mixed = [beside(controller, active, share) for share in SHARES]
    return all(meets(ensemble.margins(both), least).all() and not ensemble.unstable(both).any()
               for both in mixed)


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
