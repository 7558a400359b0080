"""Rivals in the ensemble, and what is said of effects: by probability, matched, named."""

import dataclasses

import numpy as np
import pytest

from quad_sysid.estimate.stored import estimate_of
from quad_sysid.loop.from_model import loop_plant
from quad_tuning import ensemble as ensembles
from quad_tuning.designer import design
from quad_tuning.ensemble import shares, variants
from quad_tuning.use import schedule, uses


def effect(name, *fitted, rivals=(), probability=1.0, settings=None):
    return estimate_of(
        name, fitted, settings=settings, std=0.01, probability=probability, rivals=rivals
    )


def test_a_rival_of_the_same_signal_does_the_same_over_the_flown_range(model):
    found = effect('coulomb_friction', 0.8, rivals=(('quadratic_drag', 0.3), ('backlash', 0.1)),
                   probability=0.6)
    weights, models = zip(*variants(model(effects=[found])), strict=True)
    assert weights == pytest.approx((0.6, 0.3, 0.1))
    rates = 1.5 * np.sin(np.linspace(0, 2 * np.pi, 400))
    friction, drag = (np.mean(-loop_plant(m).rate_curve(rates) * rates) for m in models[:2])
    assert models[1].value('quadratic_drag.coefficient') > 0.0
    assert drag == pytest.approx(friction, rel=0.2)
    assert models[2].effects == ()


def test_draws_are_shared_out_by_probability(model):
    assert shares((0.6, 0.3, 0.1), 240) == (144, 72, 24)
    assert sum(shares((0.55, 0.335, 0.115), 241)) == 241
    found = effect('coulomb_friction', 2.0, rivals=(('quadratic_drag', 0.5),), probability=0.5)
    loops = ensembles.build(model(effects=[found]), np.random.default_rng(1))
    # near rest dry friction damps far more than drag: two families of low-frequency gains
    rest = np.abs(loops.response[0, loops.response.shape[1] // 2 + 1 :, 40])
    assert 0.4 < np.mean(rest < np.sqrt(rest.min() * rest.max())) < 0.6


def test_the_margins_hold_for_the_rival_too(model):
    """A resonance that may as well be slow motors: the design is held against both."""
    mode = effect(
        'resonance', 6.0, 0.05, 0.0, 0.03, rivals=(('motor_lag', 0.4),), probability=0.6,
    )  # fmt: skip
    m = model(effects=[mode])
    proposal = design(m)
    loops = ensembles.build(m, np.random.default_rng(5))
    assert loops.cycle.phi.shape[-1] == 7
    gains = proposal.figures
    assert gains['worst_phase_margin_deg'] >= 45.0
    assert gains['unstable_draws'] == 0
    assert ('motor_lag', 'rival of resonance: 40 % of the draws have it instead') in proposal.used


def test_sag_gives_a_schedule_that_keeps_the_loop_gain(model):
    sag = effect('battery_sag', 1.5, settings={'reference_v': 11.5})
    m = dataclasses.replace(model(effects=[sag]), mean_battery_v=11.5)
    proposal = design(m)
    rows = proposal.schedule
    assert len(rows) == 5
    for volts, row in rows:
        gain = (volts / 11.5) ** 1.5 * row['roll.rate.kp']
        assert gain == pytest.approx(proposal.steps[-1]['roll.rate.kp'], rel=1e-6)
        assert row['roll.angle.kp'] == proposal.steps[-1]['roll.angle.kp']
    assert schedule(model(), None) == ()


def test_every_effect_is_told_once_and_feed_forward_is_not_claimed(model):
    told = dict(uses(model(effects=[
        effect('coulomb_friction', 0.5), effect('backlash', 0.001),
        effect('thrust_curve', 0.3, settings={'throttle': 0.4}),
    ])))
    assert list(told) == ['bias_torque', 'coulomb_friction', 'backlash', 'thrust_curve']
    assert 'better the tracking by less than 1 %' in told['coulomb_friction']
    assert 'left out of the loop' in told['backlash']
