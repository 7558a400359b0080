"""The way to the target: inside the step limit, safe at every step, otherwise by another way."""

import dataclasses

import numpy as np
import pytest

from quad_sysid.loop.cascade import CascadeGains
from quad_tuning import ensemble as ensembles
from quad_tuning.bounds import check_step
from quad_tuning.designer import design
from quad_tuning.errors import DesignRefusedError
from quad_tuning.objective import Requirements
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
    assert proposal.gains in (proposal.steps[0], proposal.steps[-1])


def test_where_all_at_once_is_unsafe_it_goes_by_equal_ratios(model):
    """Ten times the damping and half the gain: kd must not arrive before kp has gone down."""
    wanted = dataclasses.replace(ACTIVE, angle_kp=12.0, rate_kp=0.16, rate_kd=0.0056)
    m = model(gain=300.0, lag=0.06)
    way = way_to(wanted, ACTIVE, loops_of(m), Requirements(30.0, 5.0, 3.0))
    assert not way.together
    assert way.steps[-1] == wanted
    held(way.steps, ACTIVE)


def test_a_way_through_instability_is_refused(model):
    """The target itself is not judged here; the sets before it are, and none of them holds."""
    wanted = dataclasses.replace(ACTIVE, angle_kp=15.0, rate_kp=0.5, rate_kd=0.0)
    with pytest.raises(DesignRefusedError, match='poor margins'):
        way_to(wanted, ACTIVE, loops_of(model()), Requirements())


def test_equal_ratios_reach_a_gain_that_is_zero():
    wanted = dataclasses.replace(ACTIVE, rate_kd=0.0, angle_kp=12.0)
    steps = _even(wanted, ACTIVE, 1)
    held(steps, ACTIVE)
    assert steps[-1] == wanted
