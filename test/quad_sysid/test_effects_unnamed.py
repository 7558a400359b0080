"""What stands in no table, and what hides: curves of friction, hysteresis, gusts, masked pairs.

The tests' own simulator (conftest.py); every planted thing is judged beside the same flight
without it. Tolerances stand beside what they hold for.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from quad_sysid.effects.consistency import inconsistency
from quad_sysid.effects.discover import discover
from quad_sysid.effects.judge import _unconfirmed, judge
from quad_sysid.effects.shapes import SHAPES
from quad_sysid.effects.table import EFFECTS, by_name
from quad_sysid.greybox.data import Windows, axis_data
from quad_sysid.greybox.fit import fit_base, fit_with_effect
from quad_sysid.greybox.one_step import one_step, sharpened
from quad_sysid.pipeline.assemble import axis_model
from quad_sysid.pipeline.evaluate import evaluate

QUIET = {'gyro_noise': 0.004, 'torque_noise': 0.02}
CALLS_A_SECOND = 2000
"""The simulator asks for the torque twice in each step of 1 ms."""


def answered(record):
    with threadpool_limits(limits=1):
        rng = np.random.default_rng(0)
        found = discover(axis_data([record], 'roll'), EFFECTS + SHAPES, rng)
        answer = judge(found, rng)
        return found, answer, axis_model(found, answer, {}, None)


def clocked(function):
    """A torque of (t, rate, angle) with the time from counting the simulator's calls."""
    calls = [0]

    def torque(rate, angle):
        calls[0] += 1
        return function(calls[0] / CALLS_A_SECOND, rate, angle)

    return torque


def hysteresis():
    """Dahl's friction, 0.4 rad/s² that build up over 0.05 rad."""
    state = [0.0]

    def torque(rate, _):
        step = rate / CALLS_A_SECOND / 0.05
        state[0] = min(1.0, max(-1.0, state[0] + step * (1.0 - state[0] * math.copysign(1, rate))))
        return -0.4 * state[0]

    return torque


def only(model):
    assert len(model.effects) == 1, [e.name for e in model.effects]
    return model.effects[0]


def friction_curve(model, name):
    """Knots and level of a friction along a curve, with the constant part that has the name."""
    kinds = {e.name for e in model.effects}
    assert name in kinds
    assert kinds <= {name, 'coulomb_friction'}, kinds
    effect = next(e for e in model.effects if e.name == name)
    assert effect.settings['variant'] == 'friction'
    constant = sum(e.parameters[0].value for e in model.effects if e.name == 'coulomb_friction')
    return np.array(effect.settings['knots']), np.array(effect.settings['values']) + constant


def test_a_friction_that_builds_up_is_a_hidden_state_with_its_strength(axis_type, flown):
    _, answer, model = answered(flown(axis_type(torque=hysteresis(), **QUIET), 3))
    assert answer.verdict == 'effects_added', answer.reason
    effect = only(model)
    assert (effect.name, effect.settings['variant']) == ('mode', 'hysteresis')
    torque, build_up = (p.value for p in effect.parameters)
    assert torque == pytest.approx(0.4, rel=0.15)
    assert build_up == pytest.approx(0.05, rel=0.35)


def test_a_friction_along_the_angle_is_told_as_a_curve_and_pays(axis_type, flown, second_plan):
    def torque(rate, angle):
        return -0.4 * min(3.0, abs(angle) / 0.1) * math.tanh(rate / 0.03)

    _, answer, model = answered(flown(axis_type(torque=torque, **QUIET), 4))
    assert answer.verdict == 'effects_added', answer.reason
    x, y = friction_curve(model, 'shape:angle')
    level = np.interp([-0.15, 0.0, 0.15], x, y)
    assert level[1] < 0.5 * min(level[0], level[2])  # the kink lies between two knots
    error = evaluate(model, flown(axis_type(torque=torque, **QUIET), 504, second_plan))
    assert error.before / error.after > 1.5


def test_a_bearing_that_warms_up_is_a_friction_that_drifts(axis_type, flown):
    """At 5 s and at 30 s within 25 % of 0.8 exp(-t / 20 s)."""
    torque = clocked(lambda t, w, _: -0.8 * math.exp(-t / 20.0) * math.tanh(w / 0.03))
    _, answer, model = answered(flown(axis_type(torque=torque, **QUIET), 5))
    assert answer.verdict == 'effects_added', answer.reason
    x, y = friction_curve(model, 'shape:time')
    for time in (5.0, 30.0):
        assert np.interp(time, x, y) == pytest.approx(0.8 * math.exp(-time / 20.0), rel=0.25)


def test_a_gust_is_found_in_training_and_said_where_it_returns(axis_type, flown):
    """1.2 rad/s² for 2 s, once in training and once on held-out data: no model foresees it."""
    torque = clocked(lambda t, _w, _a: 1.2 if 12.0 <= t < 14.0 or 44.0 <= t < 46.0 else 0.0)
    found, answer, model = answered(flown(axis_type(torque=torque, **QUIET), 6))
    event = found.chosen.structure.effects[0]
    assert event.name == 'event'
    start, duration = found.chosen.theta[5:7]
    assert start == pytest.approx(12.0, abs=0.15)
    assert duration == pytest.approx(2.0, abs=0.3)
    assert answer.verdict == 'unexplained_residual'
    assert 'a few moments' in answer.reason
    assert model.effects == ()


def test_two_effects_that_mask_each_other_are_both_named(axis_type, flown):
    """Drag raises the damping that the base fits, a spring lowers it: alone, each hides."""
    def torque(rate, angle):
        return -1.2 * rate * abs(rate) - 1.6 * math.sin(angle)

    _, answer, model = answered(flown(axis_type(torque=torque, **QUIET), 7))
    assert answer.verdict == 'effects_added', answer.reason
    assert {e.name for e in model.effects} == {'quadratic_drag', 'pendulum_stiffness'}
    for effect, true in zip(
        sorted(model.effects, key=lambda e: e.name), (1.6, 1.2), strict=True
    ):
        parameter = effect.parameters[0]
        assert abs(parameter.value - true) < 3.0 * parameter.std


def test_nothing_is_found_where_nothing_acts(axis_type, flown):
    """The twin of all of the above."""
    for seed in (3, 7):
        _, answer, model = answered(flown(axis_type(**QUIET), seed))
        assert answer.verdict == 'no_missing_effect', answer.reason
        assert model.effects == ()


# one-step estimates


def test_one_step_errors_are_sharper_and_cover_the_truth(axis_type, flown):
    """Twelve flights: 95 % intervals hold the friction in ten or more, at lower spread."""
    true, inside, sharp, blunt = 0.15, 0, [], []
    for seed in range(12):
        def torque(rate, _):
            return -true * math.tanh(rate / 1e-3)

        data = axis_data([flown(axis_type(torque=torque, **QUIET), 100 + seed)], 'roll')
        base, _, sim = fit_base(data, data.train)
        fit = fit_with_effect(sim, base, by_name('coulomb_friction'), {})
        found = one_step(sim, fit)
        inside += abs(found.theta[5] - true) < 1.96 * fit.quoted * found.std[5]
        sharp.append(found.theta[5] - true)
        blunt.append(fit.theta[5] - true)
    assert inside >= 10
    assert np.sqrt(np.mean(np.square(sharp))) < np.sqrt(np.mean(np.square(blunt)))


def test_sharper_estimates_are_left_where_the_free_run_does_not_agree(axis_type, flown):
    """A spring that no structure here holds: the one-step optimum would spoil the free run."""
    def torque(_, angle):
        return -12.0 * max(0.0, abs(angle) - 0.1) * math.copysign(1.0, angle)

    data = axis_data([flown(axis_type(torque=torque, **QUIET), 9)], 'roll')
    base, _, sim = fit_base(data, data.train)
    kept = sharpened(sim, base)
    assert kept.rms <= 1.01 * base.rms


# whether the base holds on unseen segments


def windows(count: int) -> Windows:
    return Windows(np.arange(count) * 125, 125, np.zeros(count, dtype=np.int64))


def errors(rng, count: int, size: float) -> np.ndarray:
    return size**2 * rng.chisquare(20, count) / 20.0


def test_even_errors_agree_and_uneven_or_larger_ones_do_not():
    rng = np.random.default_rng(11)
    seen, unseen = errors(rng, 80, 0.006), errors(rng, 60, 0.006)
    assert inconsistency(seen, windows(80), unseen, windows(60), 0.004) == ''
    larger = inconsistency(seen, windows(80), 1.5**2 * unseen, windows(60), 0.004)
    assert 'times that on the training segments' in larger
    struck = unseen.copy()
    struck[20:24] *= 60.0
    assert 'around 10' in inconsistency(seen, windows(80), struck, windows(60), 0.004)


def test_an_error_that_nothing_missing_ever_makes_needs_less_certainty():
    """Blocks that differ much, p = 0.03: 1.6 times the error is told, 1.45 times is not."""
    rng = np.random.default_rng(24)
    seen, unseen = np.repeat(rng.lognormal(0.0, 1.2, 20), 4), np.repeat(rng.lognormal(size=15), 4)
    for growth, told in ((1.6, True), (1.45, False)):
        grown = growth**2 * seen.mean() / unseen.mean() * unseen
        said = inconsistency(seen, windows(80), grown, windows(60), 0.004)
        assert ('bent around something' in said) == told, said


def test_an_effect_that_unseen_data_deny_is_called_uncertain():
    tests = {'pendulum_stiffness': (1e-4, 135.0), 'cubic_stiffness': (1.0, -27.3)}
    said = _unconfirmed(tests)
    assert 'cubic_stiffness does not add to that' in said
    assert '27 % smaller' in said
    assert 'pendulum' not in said
    assert _unconfirmed({'coulomb_friction': (1e-6, 200.0)}) == ''
