"""The way to the target: inside the step limit, safe at every step, otherwise by another way."""

import dataclasses

import numpy as np
import pytest

from quad_sysid.loop.cascade import CascadeGains
from quad_tuning import ensemble as ensembles
from quad_tuning.bounds import check_step
from quad_tuning.designer import design
from quad_tuning.errors import DesignRefusedError
from quad_tuning.way import _even, way_to

ACTIVE = CascadeGains.default('roll')


def loops_of(m):
    return ensembles.build(m, np.random.default_rng(7))


def held(steps, active):
    now = active
    for following in steps:
        check_step(following.to_mapping('roll'), now.to_mapping('roll'))
        now = following


@pytest.mark.parametrize('values', [{}, {'gain': 850.0, 'lag': 0.07}, {'gain': 250.0}])
def test_a_designs_steps_are_within_the_limit_and_stable(model, values):
    m = model(**values)
    proposal = design(m)
    loops = loops_of(m)
    now = {k: v for k, v in m.active_gains.items() if k in proposal.gains}
    for step in proposal.steps:
        check_step(step, now)
        gains = CascadeGains.from_mapping({**m.active_gains, **step}, 'roll')
        assert not loops.unstable(gains).any()
        now = step
    assert proposal.gains in proposal.steps


def test_where_all_at_once_is_unsafe_it_halts_between(model):
    """kd needs three steps: the angle's gain must not be there before it."""
    m = model(gain=350.0, lag=0.075, delay=0.004)
    proposal = design(m)
    halt = proposal.steps.index(proposal.gains)
    assert 0 < halt < len(proposal.steps) - 1
    loops = loops_of(m)
    gains = [CascadeGains.from_mapping({**m.active_gains, **s}, 'roll') for s in proposal.steps]
    held(gains, ACTIVE)
    flown = np.min(loops.margins(ACTIVE).phase_margin_deg)
    lowest = [np.min(loops.margins(g).phase_margin_deg) for g in gains]
    assert min(lowest) > min(28.0, 0.8 * flown)


def test_a_way_through_instability_is_refused(model):
    """The target itself is not judged here; the sets before it are, and none of them holds."""
    wanted = dataclasses.replace(ACTIVE, angle_kp=15.0, rate_kp=0.5, rate_kd=0.0)
    with pytest.raises(DesignRefusedError, match='poor margins'):
        way_to(wanted, ACTIVE, loops_of(model()))


def test_equal_ratios_reach_a_gain_that_is_zero():
    wanted = dataclasses.replace(ACTIVE, rate_kd=0.0, angle_kp=12.0)
    steps = _even(wanted, ACTIVE, 1)
    held(steps, ACTIVE)
    assert steps[-1] == wanted
