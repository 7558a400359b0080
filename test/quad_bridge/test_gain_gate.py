"""No gain passes that is unknown, not finite, out of bounds, from anybody, or too far away."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from quad_bridge.errors import BadInputError, RefusedError
from quad_bridge.gains.gate import bound_from, steps
from quad_bridge.gains.table import AXES, DEFAULT_BOUNDS, Bound

BOUNDS = {'roll.angle.kp': Bound(0.3, 15.0), 'roll.rate.ki': Bound(0.0, 2.0, small_step=0.004)}
ACTIVE = {'roll.angle.kp': 3.0, 'roll.rate.ki': 0.0, 'yaw.rate.kp': 0.2}


def test_a_change_within_the_limit_is_one_step_and_a_larger_one_several():
    wanted = {'roll.angle.kp': 5.0, 'roll.rate.ki': 0.004}
    assert steps(wanted, ACTIVE, BOUNDS) == [wanted]
    path = steps({'roll.angle.kp': 14.0, 'roll.rate.ki': 0.005}, ACTIVE, BOUNDS)
    assert [p['roll.angle.kp'] for p in path] == pytest.approx([6.0, 12.0, 14.0], rel=1e-3)
    assert [p['roll.rate.ki'] for p in path] == pytest.approx([0.004, 0.005, 0.005])
    # 0.01 per s in the firmware's units; a step may add 0.004 per rad, or double it
    ki = 0.01 * math.degrees(1.0) / 1000.0
    path = steps({'roll.rate.ki': 0.02}, {'roll.rate.ki': ki}, DEFAULT_BOUNDS)
    assert len(path) == 4
    # whatever a user allows, no step is larger than the table's
    assert bound_from('roll.angle.kp', [0.3, 15.0, 50.0, 0.0]).max_factor == 2.0
    with pytest.raises(RefusedError, match='more than 16 steps'):
        steps({'roll.angle.kp': 14.0}, ACTIVE, {'roll.angle.kp': Bound(0.3, 15.0, 1.05)})


@given(st.sampled_from(sorted(DEFAULT_BOUNDS)), st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_no_step_leaves_factor_two_or_the_small_step(name, a, b):
    bound = DEFAULT_BOUNDS[name]
    now, wanted = (bound.lower + x * (bound.upper - bound.lower) for x in (a, b))
    model = {f'{axis}.{own}': 20.0 for axis in AXES for own in ('lqr.gain', 'sag.reference_v')}
    for own in ('lqr.k_angle', 'lqr.k_rate', 'lqr.observer'):
        model |= {f'{axis}.{own}': 0.2 for axis in AXES}
    for step in steps({name: wanted}, {**model, name: now}, DEFAULT_BOUNDS):
        value = step[name]
        small = abs(value - now) <= bound.small_step * (1 + 1e-9)
        assert small or max(value / now, now / value) <= 2.0
        assert bound.lower <= value <= bound.upper
        now = value
    assert now == pytest.approx(wanted, rel=1e-6, abs=1e-30)


def test_a_state_feedback_comes_in_by_quarters_and_its_gains_move_freely_only_before():
    wanted = {
        'roll.lqr.share': 1.0, 'roll.lqr.k_angle': 0.4, 'roll.lqr.k_rate': 0.1,
        'roll.lqr.gain': 450.0, 'roll.lqr.observer': 0.2,
    }  # fmt: skip
    off = dict.fromkeys(wanted, 0.0)
    path = steps(wanted, off, DEFAULT_BOUNDS)
    assert [p['roll.lqr.share'] for p in path] == [0.25, 0.5, 1.0]
    assert all(p['roll.lqr.k_angle'] == 0.4 for p in path)
    path = steps({'roll.lqr.k_angle': 0.9}, wanted, DEFAULT_BOUNDS)
    assert [p['roll.lqr.k_angle'] for p in path] == pytest.approx([0.8, 0.9], rel=1e-3)
    for name in wanted.keys() - {'roll.lqr.share'}:  # each alone makes it do nothing
        rest = {**wanted, name: 0.0}
        with pytest.raises(RefusedError, match=f'does not work as long as {name} is 0'):
            steps({'roll.lqr.share': 0.25}, {**rest, 'roll.lqr.share': 0.0}, DEFAULT_BOUNDS)
    with pytest.raises(RefusedError, match='must lie in'):
        steps({'roll.lqr.share': 1.5}, wanted, DEFAULT_BOUNDS)
    with pytest.raises(RefusedError, match=r'roll\.sag\.reference_v is 0'):
        steps({'roll.sag.exponent': 1.0}, {'roll.sag.exponent': 0.0}, DEFAULT_BOUNDS)


@pytest.mark.parametrize(
    ('damping', 'observer', 'before', 'refused'),
    [
        (-5.0, 0.005, {}, True),
        (-5.0, 0.03, {}, False),
        (1.0, 0.005, {}, False),
        # the set after the first step, not the last one: 0.01 beside -3
        (20.0, 0.005, {'share': 0.25, 'damping': -5.0, 'observer': 0.02}, True),
    ],
)
def test_no_observer_is_let_through_that_diverges(damping, observer, before, refused):
    active = {'share': 0.0, 'gain': 200.0, 'damping': 0.0, 'observer': 0.0, **before}
    active = {f'roll.lqr.{name}': value for name, value in active.items()}
    wanted = {'roll.lqr.damping': damping, 'roll.lqr.observer': observer}
    if refused:
        with pytest.raises(RefusedError, match=r'roll\.lqr\.observer: the observer diverges'):
            steps(wanted, active, DEFAULT_BOUNDS)
    else:
        assert steps(wanted, active, DEFAULT_BOUNDS)[-1] == wanted


@pytest.mark.parametrize(
    ('wanted', 'active', 'reason'),
    [
        ({'roll.angle.kp': math.nan}, ACTIVE, 'must be finite: found nan'),
        ({'roll.angle.kp': 0.2}, ACTIVE, r'must lie in 0\.3 \.\. 15: found 0\.2'),
        ({'roll.rate.ki': -1e-9}, ACTIVE, 'must lie in'),
        ({'roll.angle.kq': 1.0}, ACTIVE, 'no gain of this name'),
        ({'loop.rate_hz': 500.0}, ACTIVE, 'no gain of this name'),
        ({'yaw.rate.kp': 0.2}, ACTIVE, 'the configuration allows no change'),
        ({}, ACTIVE, 'no gain in changed_parameters'),
        ({'roll.angle.kp': 3.1}, {}, 'has not reported it'),
        ({'roll.angle.kp': 3.1}, {'roll.angle.kp': 40.0}, 'active value 40 lies outside'),
    ],
)
def test_bad_gains_are_refused_by_name_and_value(wanted, active, reason):
    with pytest.raises(RefusedError, match=reason):
        steps(wanted, active, BOUNDS)


@pytest.mark.parametrize(
    'values',
    [
        [], [1.0], [2.0, 1.0], [0.0, 1.0, 0.5], [0.0, 1.0, 1.0],
        [0.0, math.inf], [0.0, 1.0, math.nan], [0.0, 1e39], [math.nan, 1.0],
        [0.0, 1.0, 2.0, -1.0], [0.0, 1.0, 2.0, 0.1, 5.0],
    ],
)  # fmt: skip
def test_bounds_that_make_no_sense_name_their_parameter(values):
    with pytest.raises(BadInputError, match=r'parameter bounds\.roll\.angle\.kp'):
        bound_from('roll.angle.kp', values)
