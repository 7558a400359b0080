"""The search: nothing better anywhere, nothing where no gains keep the margins or a rival's."""

import numpy as np
import pytest
from scipy.optimize import differential_evolution

from quad_sysid.estimate.stored import estimate_of
from quad_sysid.loop.cascade import CascadeGains
from quad_sysid.loop.from_model import loop_plant
from quad_tuning import ensemble as ensembles
from quad_tuning import pid as searches
from quad_tuning.designer import design
from quad_tuning.objective import Requirements, pose


def problem_of(m, axis='roll', **needs):
    loops = ensembles.build(m, np.random.default_rng(7))
    active = CascadeGains.default(axis)
    return pose(loop_plant(m), active, loops, Requirements(**needs))


SLOW = {'gain': 260.0, 'lag': 0.075, 'delay': 0.012}


@pytest.mark.long
@pytest.mark.parametrize('values', [{}, SLOW])
def test_another_global_optimiser_finds_nothing_better(model, values):
    """Differential evolution with a penalty, on the loops that bind: within 1 % on either side."""
    problem = problem_of(model(**values))
    best, at = searches.search(problem)[0]
    loops = problem.ensemble.subset(searches._worst(problem, problem.gains(at), 2))

    def judged(x):
        gains = problem.gains(x)
        if loops.unstable(gains).any():
            return 10.0
        value, kept = problem.value(gains)
        return value - 20.0 * min(0.0, np.min(kept), np.min(problem.room(loops, gains)))

    other = differential_evolution(
        judged, [(0.0, 1.0)] * 5, seed=5, popsize=10, maxiter=80, tol=1e-4, polish=False
    )
    assert best < 1.01 * other.fun
    assert other.fun > 0.99 * best


def test_what_no_gains_can_keep_is_not_found(model):
    assert searches.search(problem_of(model(), peak_sensitivity=1.01)) == []


def test_the_margins_hold_for_the_rival_too(model):
    """A resonance that may as well be slow motors: the design is held against both."""
    mode = estimate_of('resonance', (6.0, 0.05, 0.0, 0.03), std=0.01, probability=0.6,
                       rivals=(('motor_lag', 0.4),))
    m = model(effects=[mode])
    figures = design(m).figures
    loops = ensembles.build(m, np.random.default_rng(5))
    assert loops.cycle.phi.shape[-1] == 7
    assert figures['worst_phase_margin_deg'] >= 45.0
    assert figures['unstable_draws'] == 0
