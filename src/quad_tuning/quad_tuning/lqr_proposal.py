"""From an axis model to an LQR with figures, or a refusal; the same admission as the cascade's.

Apart from designer.py because python-control is slow to import and the node has no need of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from quad_sysid.loop.from_model import loop_plant
from quad_sysid.model import AxisModel
from quad_tuning import ensemble as ensembles
from quad_tuning import lqr_figures
from quad_tuning.assess import assess
from quad_tuning.bounds import check_band, check_model, flown_gains
from quad_tuning.designer import LARGEST_LOSS_PCT, SEED, loop_figures
from quad_tuning.errors import DesignRefusedError
from quad_tuning.lqr import LqrDesign, Noise, Weights, design_lqr, way_is_safe
from quad_tuning.state_feedback import StateFeedback


@dataclass(frozen=True)
class LqrProposal:
    """A controller for one axis with its figures; `<name>_before` is the cascade that flew."""

    controller: StateFeedback
    gains: dict[str, float]
    """What /gains/update takes: the controller by the contract's names, with the whole share."""
    figures: dict[str, float]


WEIGHTS = {'angle': 'angle_rad', 'rate': 'rate_rad_s', 'integral': 'integral_rad_s',
           'control': 'control'}  # fmt: skip
"""Short name to the field of Weights."""


def propose_lqr(model: AxisModel, largest: Mapping[str, float] | None = None) -> LqrProposal:
    """An LQR for the angle of one axis; raises DesignRefusedError with the reason.

    `largest` are Bryson's largest acceptable values by the names of WEIGHTS: rad, rad/s, rad s,
    normalised command; those not given have their defaults.
    """
    check_model(model)
    active = flown_gains(model)
    plant = loop_plant(model)
    loops = ensembles.build(model, np.random.default_rng(SEED))
    before = assess(plant, active, loops)
    check_band(model, before.crossover_rad_s)
    try:
        weights = Weights(**{WEIGHTS[name]: value for name, value in (largest or {}).items()})
        found = design_lqr(plant, loops, active.output_limit, weights, _noise(model))
    except DesignRefusedError as refusal:
        raise DesignRefusedError(f'{model.axis}: {refusal}') from refusal
    if not way_is_safe(found.controller, active, loops):
        raise DesignRefusedError(
            f'{model.axis}: a quarter or half of the LQR beside the gains that fly leaves poor '
            'margins; take quad-tune design without --method lqr first'
        )
    figures = _figures(found)
    figures['disturbance_rms_rad'] = lqr_figures.disturbance(plant, found.controller)
    if model.noise_rms:
        nominal = loops.subset(np.flatnonzero(loops.nominal)[:1])
        noise = lqr_figures.noise_gain(found.controller, nominal)
        figures['motor_noise_rms'] = noise * model.noise_rms
    old = loop_figures(before, model.noise_rms)
    figures.update({f'{name}_before': old[name] for name in figures})
    _check_worth(model.axis, figures)
    figures.update(lqr_figures.promise(loops, active, found.controller, plant.lag_s))
    figures['draws'] = float(loops.draws)
    figures['control_weight'] = found.control_weight
    return LqrProposal(
        controller=found.controller,
        gains=found.controller.to_mapping(model.axis),
        figures={name: value for name, value in figures.items() if np.isfinite(value)},
    )


def _check_worth(axis: str, figures: Mapping[str, float]) -> None:
    lost = 100.0 * (figures['rms_tracking_rad'] / figures['rms_tracking_rad_before'] - 1.0)
    if lost > LARGEST_LOSS_PCT:
        raise DesignRefusedError(
            f'{axis}: the LQR that keeps all margins would raise the tracking error by '
            f'{lost:.0f} %; the delay is too long for it, take the cascade (--method pid)'
        )


def _noise(model: AxisModel) -> Noise:
    """What the observer expects: the flight's measurement noise where the model knows it."""
    return Noise(rate=model.noise_rms) if model.noise_rms else Noise()


def _figures(found: LqrDesign) -> dict[str, float]:
    return {
        'phase_margin_deg': float(found.nominal.phase_margin_deg[0]),
        'gain_margin_db': float(found.nominal.gain_margin_db[0]),
        'peak_sensitivity': float(found.nominal.peak_sensitivity[0]),
        'crossover_rad_s': float(found.nominal.crossover_rad_s[0]),
        'worst_phase_margin_deg': float(found.worst.phase_margin_deg[0]),
        'worst_gain_margin_db': float(found.worst.gain_margin_db[0]),
        'worst_peak_sensitivity': float(found.worst.peak_sensitivity[0]),
        'rise_time_s': found.square.rise_time_s,
        'overshoot_pct': found.square.overshoot_pct,
        'settling_time_s': found.square.settling_time_s,
        'rms_tracking_rad': found.square.rms_error_rad,
    }
