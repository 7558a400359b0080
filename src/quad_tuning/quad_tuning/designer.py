"""The designer that the identification finds: an axis model in, gains or a refusal out.

Wiring only: checks, ensemble, PID design, steps, battery voltage. It is the entry point `pid` of
the group `quad_sysid.designers`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from quad_sysid.axes import EVERY
from quad_sysid.errors import QuadSysidError
from quad_sysid.loop.cascade import CascadeGains, contract_names
from quad_sysid.loop.from_model import behind_lean, in_flight, loop_plant, not_in_the_loop
from quad_sysid.loop.plant import Flying
from quad_sysid.model import BEFORE, AxisModel, GainProposal
from quad_tuning import ensemble as ensembles
from quad_tuning.assess import LoopFigures, Requirements, assess, promise
from quad_tuning.bounds import (
    BAND_REACH,
    DESIGNED,
    bounds_of,
    by_contract,
    check_band,
    check_bounds,
    check_inside,
    check_model,
    flown_gains,
    shared_by_axes,
    within_thrust,
)
from quad_tuning.ensemble import Ensemble
from quad_tuning.errors import DesignRefusedError, QuadTuningError
from quad_tuning.pid import PidDesign, retune
from quad_tuning.way import sag_settings, way_to, with_schedule

SEED = 20_250_101
"""Seed of the draws, so that a model always gives the same gains."""
LEAST_GAIN_PCT = 2.0
"""Predicted improvement below which flown gains that keep the margins stay."""
LARGEST_LOSS_PCT = 3.0
"""Largest predicted loss of tracking that is accepted for the margins."""


def design(model: AxisModel, inner: AxisModel | None = None) -> GainProposal:
    """Gains for one axis, or the reason against; a model's faults never raise."""
    try:
        return propose(model, inner=inner)
    except (QuadTuningError, QuadSysidError) as refusal:
        return GainProposal(gains=None, refused_because=str(refusal))


def propose(model: AxisModel, inner: AxisModel | None = None) -> GainProposal:
    """Gains for one axis; raises DesignRefusedError with the reason where there are none.

    `inner`: of surge and sway, the model of pitch or roll, whose loop follows the lean.
    """
    check_model(model)
    check_inside(model)
    model = _around_lean(model, inner) if EVERY[model.axis].outer else in_flight(model)
    active = within_thrust(flown_gains(model), model)
    flown, chosen = model, sag_settings(model)
    model = replace(model, active_gains={**model.active_gains, **chosen})
    plant, loops, before = flown_loop(model, active)
    needs = Requirements()
    if model.noise_rms:
        spare = needs.motor_noise / (before.noise_gain * model.noise_rms)
        needs = replace(needs, noise_factor=max(needs.noise_factor, spare))
    highest = plant.trial.crossover_rad_s
    if model.trusted_band_rad_s is not None:
        highest = min(highest, BAND_REACH * model.trusted_band_rad_s[1])
    if highest < np.inf:
        needs = replace(
            needs, highest_crossover_rad_s=max(highest, before.crossover_rad_s))
    known = by_contract(active, model.axis, model.active_gains)
    names, free = contract_names(model.axis), known.keys() - shared_by_axes(model)
    fixed = [field for field in DESIGNED if names[field] not in free]
    try:
        designed = retune(plant, active, loops, needs, fixed=fixed,
                       bounds=bounds_of(model.axis, model.active_gains))
        _check_improvement(designed, needs)
        way = way_to(designed.gains, active, loops)
    except DesignRefusedError as refusal:
        raise DesignRefusedError(f'{model.axis}: {refusal}') from refusal
    check_bounds(by_contract(designed.gains, model.axis, known), known)
    return GainProposal(
        gains={**by_contract(way.first, model.axis, known), **chosen},
        figures={**_figures(model, designed, known, loops.draws),
                 **promise(loops, active, way.first, model.value('lag'))},
        left_out=not_in_the_loop(model),
        steps=with_schedule([by_contract(step, model.axis, known) for step in way.steps], chosen,
                    flown.active_gains),
    )


def flown_loop(model: AxisModel,
               active: CascadeGains) -> tuple[Flying, Ensemble, LoopFigures]:
    """Plant, ensemble, the flown gains' figures; refuses a model that the flight contradicts."""
    plant, loops = loop_plant(model), ensembles.build(model, np.random.default_rng(SEED))
    if loops.unstable(active)[loops.nominal].any():
        raise DesignRefusedError(
            f'{model.axis}: the model says that the gains that flew are unstable, so it does not '
            'describe the flight; identify again'
        )
    before = assess(plant, active, loops)
    check_band(model, before.crossover_rad_s)
    return plant, loops, before


def _around_lean(model: AxisModel, inner: AxisModel | None) -> AxisModel:
    """The model of an outer loop, which begins from usual gains where none are known."""
    if inner is None:
        raise DesignRefusedError(
            f'{model.axis}: its loop commands the lean, so the model of '
            f'{EVERY[model.axis].excited_as} is needed too; identify both into one model.json'
        )
    usual = CascadeGains.default(model.axis).to_mapping(model.axis)
    return replace(behind_lean(model, inner), active_gains={**usual, **model.active_gains})


def _check_improvement(designed: PidDesign, needs: Requirements) -> None:
    before, after = designed.before, designed.figures
    drop = 100.0 * (1.0 - after.rms_tracking_rad / before.rms_tracking_rad)
    within = (
        before.worst_phase_margin_deg >= needs.phase_margin_deg
        and before.worst_gain_margin_db >= needs.gain_margin_db
        and before.worst_peak_sensitivity <= needs.peak_sensitivity
    )
    if within and drop < LEAST_GAIN_PCT:
        raise DesignRefusedError(
            'the gains that flew keep all margins, and the best ones would lower the tracking '
            f'error by {drop:.1f} % only'
        )
    if drop < -LARGEST_LOSS_PCT:
        raise DesignRefusedError(
            'the best gains that keep all margins would raise the tracking error '
            f'by {-drop:.0f} % (flown: phase margin {before.worst_phase_margin_deg:.0f} deg at '
            'worst); lower the gains by hand'
        )


def _figures(model: AxisModel, designed: PidDesign, known: Mapping[str, float],
             draws: int) -> dict[str, float]:
    before = {**designed.before.named(model.noise_rms), **known}
    values = designed.figures.named(model.noise_rms) | {f'{name}{BEFORE}': value for name,
                                                     value in before.items()} | {
        'draws': draws, 'searches_that_agree': designed.agreeing, 'searches': designed.searches,
        'disturbance_kept': designed.disturbance_kept,
    }
    return {name: float(value) for name, value in values.items() if np.isfinite(value)}
