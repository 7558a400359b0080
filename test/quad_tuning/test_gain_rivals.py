"""Rivals in the ensemble, and what is said of effects: by probability, matched, named."""


import numpy as np

from quad_sysid.estimate.stored import estimate_of
from quad_tuning import ensemble as ensembles
from quad_tuning.designer import design


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
