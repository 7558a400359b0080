"""The way to the target is safe at every step; what the design promises to the watch holds."""

import dataclasses
import itertools

import numpy as np
import pytest

from quad_sysid.loop.cascade import CascadeGains
from quad_sysid.loop.from_model import loop_plant
from quad_sysid.loop.simulation import simulate_cascade
from quad_tuning import ensemble as ensembles
from quad_tuning.assess import GUST_RAD_S, promise
from quad_tuning.bounds import DESIGNED, reachable
from quad_tuning.errors import DesignRefusedError
from quad_tuning.way import way_to

ACTIVE = CascadeGains.default('roll')


def loops_of(m):
    return ensembles.build(m, np.random.default_rng(7))


def steps_of(m, proposal):
    return [CascadeGains.from_mapping({**m.active_gains, **s}, 'roll') for s in proposal.steps]


def held(steps, active):
    for before, step in itertools.pairwise((active, *steps)):
        for field in DESIGNED:
            low, high = reachable(field, getattr(before, field))
            assert low * (1.0 - 1e-6) <= getattr(step, field) <= high * (1.0 + 1e-6), field


@pytest.mark.parametrize('values', [{}, {'gain': 850.0, 'lag': 0.07}, {'gain': 250.0}])
def test_a_designs_steps_are_within_the_limit_and_stable(model, designed, values):
    m, proposal = model(**values), designed(**values)
    loops, gains = loops_of(m), steps_of(m, proposal)
    held(gains, ACTIVE)
    assert not any(loops.unstable(step).any() for step in gains)
    assert proposal.gains in proposal.steps


def test_where_all_at_once_is_unsafe_it_halts_between(model, designed):
    """kd needs three steps: the angle's gain must not be there before it."""
    values = {'gain': 350.0, 'lag': 0.075, 'delay': 0.004}
    m, proposal = model(**values), designed(**values)
    assert 0 < proposal.steps.index(proposal.gains) < len(proposal.steps) - 1
    loops, gains = loops_of(m), steps_of(m, proposal)
    held(gains, ACTIVE)
    flown, *lowest = (np.min(loops.margins(g).phase_margin_deg) for g in (ACTIVE, *gains))
    assert min(lowest) > min(28.0, 0.8 * flown)


def test_a_way_through_instability_is_refused(model):
    """The target itself is not judged here; the sets before it are, and none of them holds."""
    wanted = dataclasses.replace(ACTIVE, angle_kp=15.0, rate_kp=0.5, rate_kd=0.0)
    with pytest.raises(DesignRefusedError, match='poor margins'):
        way_to(wanted, ACTIVE, loops_of(model()))


AFTER = dataclasses.replace(ACTIVE, rate_kp=1.5 * ACTIVE.rate_kp, angle_kp=6.0)


def test_the_promised_change_of_the_rate_is_that_of_the_simulation(model):
    """The same gusts under both sets; the same gains promise no change."""
    m, rng = model(), np.random.default_rng(3)
    loops = ensembles.build(m, np.random.default_rng(0), 8)
    said = promise(loops, ACTIVE, AFTER, 0.043)
    gusts, state = np.empty(50_000), 0.0
    for k, push in enumerate(rng.normal(size=gusts.size)):
        state += GUST_RAD_S * m.dt * (push - state)
        gusts[k] = state
    before, after = (
        simulate_cascade(loop_plant(m), g, np.zeros(gusts.size), m.dt, disturbance=gusts).rate
        for g in (ACTIVE, AFTER)
    )
    assert said['rate_rms_ratio'] == pytest.approx(np.std(after) / np.std(before), rel=0.05)
    assert said['oscillation_ratio'] > said['rate_rms_ratio']
    assert 0.99 < said['peak'] < 1.8
    same = promise(loops, ACTIVE, ACTIVE, 0.043)
    assert same['rate_rms_ratio'] == same['oscillation_ratio'] == 1.0
