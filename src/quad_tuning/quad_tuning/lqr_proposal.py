"""From an axis model to an LQR with figures, or a refusal; the same admission as the cascade's.

Separate from designer.py because python-control is slow to import and the node does not need it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from quad_sysid.loop.cascade import CascadeGains, open_loop
from quad_sysid.loop.from_model import loop_plant
from quad_sysid.loop.plant import LoopPlant, dynamics, exact_step, slopes_at, state_space
from quad_sysid.model import AxisModel
from quad_tuning import ensemble as ensembles
from quad_tuning.assess import TORQUE_STEP, TORQUE_STEP_S, assess, mean_gain, ratios
from quad_tuning.bounds import check_band, check_model, flown_gains
from quad_tuning.designer import LARGEST_LOSS_PCT, SEED
from quad_tuning.ensemble import AMPLITUDES, Ensemble
from quad_tuning.errors import DesignRefusedError
from quad_tuning.lqr import Noise, Weights, design_lqr, loop_gain, way_is_safe
from quad_tuning.state_feedback import StateFeedback, controller_response, simulate


@dataclass(frozen=True)
class LqrProposal:
    """A controller for one axis with its figures; `<name>_before`: of the flown cascade."""

    controller: StateFeedback
    gains: dict[str, float]
    """The controller by the contract's names, with share 1, for /gains/update."""
    figures: dict[str, float]


WEIGHTS = {'angle': 'angle_rad', 'rate': 'rate_rad_s', 'integral': 'integral_rad_s',
           'control': 'control'}
"""Short name → field of Weights."""


def propose_lqr(model: AxisModel, largest: Mapping[str, float] | None = None) -> LqrProposal:
    """An LQR for the angle of one axis; raises DesignRefusedError with the reason.

    `largest`: Bryson's largest acceptable values by the names of WEIGHTS, in rad, rad/s, rad s and
    normalised command; missing ones have their defaults.
    """
    check_model(model)
    active = flown_gains(model)
    plant = loop_plant(model)
    loops = ensembles.build(model, np.random.default_rng(SEED))
    before = assess(plant, active, loops)
    check_band(model, before.crossover_rad_s)
    try:
        weights = Weights(**{WEIGHTS[name]: value for name, value in (largest or {}).items()})
        noise = Noise(rate=model.noise_rms) if model.noise_rms else Noise()
        found = design_lqr(plant, loops, active.output_limit, weights, noise)
    except DesignRefusedError as refusal:
        raise DesignRefusedError(f'{model.axis}: {refusal}') from refusal
    if not way_is_safe(found.controller, active, loops):
        raise DesignRefusedError(
            f'{model.axis}: a quarter or half of the LQR mixed with the flown gains leaves poor '
            'margins; take quad-tune design without --method lqr first'
        )
    figures = dict(found.figures)
    figures['disturbance_rms_rad'] = disturbance(plant, found.controller)
    if model.noise_rms:
        nominal = loops.subset(np.flatnonzero(loops.nominal)[:1])
        figures['motor_noise_rms'] = noise_gain(found.controller, nominal) * model.noise_rms
    old = before.named(model.noise_rms)
    figures.update({f'{name}_before': old[name] for name in figures})
    lost = 100.0 * (figures['rms_tracking_rad'] / figures['rms_tracking_rad_before'] - 1.0)
    if lost > LARGEST_LOSS_PCT:
        raise DesignRefusedError(
            f'{model.axis}: the LQR that keeps all margins would raise the tracking error by '
            f'{lost:.0f} %; the delay is too long for it, take the cascade (--method pid)'
        )
    figures.update(promise(loops, active, found.controller, plant.lag_s))
    figures['draws'] = float(loops.draws)
    figures['control_weight'] = found.control_weight
    return LqrProposal(
        controller=found.controller, gains=found.controller.to_mapping(model.axis),
        figures={name: value for name, value in figures.items() if np.isfinite(value)},
    )


def disturbance(plant: LoopPlant, controller: StateFeedback) -> float:
    """RMS angle under a torque step of TORQUE_STEP, rad."""
    slopes = slopes_at(plant, *AMPLITUDES[0])
    a, b, _ = dynamics(plant, slopes)
    _, push = exact_step(a, b, np.array(plant.dt))
    model = state_space(plant, slopes)
    torque = np.zeros(model.a.shape[0])
    torque[: a.shape[0]] = TORQUE_STEP * push[:, 1]
    n = round(TORQUE_STEP_S / plant.dt)
    angle, _ = simulate(model, controller, np.zeros(n), push=torque)
    return float(np.sqrt(np.mean(angle**2)))


def noise_gain(controller: StateFeedback, nominal: Ensemble) -> float:
    """RMS of the control per RMS of white noise on the measured rate, 1/(rad/s)."""
    omega = nominal.omega
    response = controller_response(controller.dynamics(), omega, controller.dt)
    loop = -np.einsum('of,of->f', response, nominal.response[:, 0])
    return mean_gain(response[0] / (1.0 + loop), omega)


def promise(loops: Ensemble, before: CascadeGains, after: StateFeedback,
            lag_s: float) -> dict[str, float]:
    """As assess.promise, from the flown cascade to the feedback."""
    old = open_loop(before, loops.response, loops.omega, loops.cycle.dt)
    new = loop_gain(after.dynamics(), loops)
    forward = controller_response(after.dynamics(), loops.omega, loops.cycle.dt)[1]
    peak = np.abs(loops.response[1] * forward / (1.0 + new)).max()
    return {**ratios(loops, old, new, lag_s), 'peak': float(peak)}
