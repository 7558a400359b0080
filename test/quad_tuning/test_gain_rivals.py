"""Rivals in the ensemble, and what is said of effects: by probability, matched, named."""

import dataclasses

import numpy as np
import pytest

from quad_sysid.estimate.stored import estimate_of
from quad_tuning import ensemble as ensembles
from quad_tuning.designer import design
from quad_tuning.use import schedule


def effect(name, *fitted, rivals=(), probability=1.0, settings=None):
    return estimate_of(
        name, fitted, settings=settings, std=0.01, probability=probability, rivals=rivals
    )


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
