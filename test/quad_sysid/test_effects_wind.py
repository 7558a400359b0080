"""What only follows a slow disturbance is no effect; what acts behind the lag, or one way, is one.

The tests' own simulator (conftest.py). Tolerances stand beside what they hold for.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from quad_sysid.effects.commands import behind_lag
from quad_sysid.effects.discover import discover
from quad_sysid.effects.judge import judge
from quad_sysid.effects.persistence import persists
from quad_sysid.effects.shapes import SHAPES
from quad_sysid.effects.table import EFFECTS, by_name
from quad_sysid.greybox.data import axis_data
from quad_sysid.greybox.fit import fit_base, fit_with_effect

QUIET = {'gyro_noise': 0.004, 'torque_noise': 0.02}
CALLS_A_SECOND = 2000
PASSING = {'event', 'step_event', 'periodic_disturbance', 'shape:time'}


def answered(record):
    with threadpool_limits(limits=1):
        rng = np.random.default_rng(0)
        found = discover(axis_data([record], 'roll'), EFFECTS + SHAPES, rng)
        return found, judge(found, rng)


def names(found):
    return {e.name for e in found.chosen.structure.effects}


def clocked(function):
    calls = [0]

    def torque(rate, angle):
        calls[0] += 1
        return function(calls[0] / CALLS_A_SECOND, rate, angle)

    return torque


def wind(seed, size):
    """A torque that jumps between +-size at random times, every 4 s on average."""
    jumps = np.cumsum(np.random.default_rng(seed).exponential(4.0, 200))
    return clocked(lambda t, _w, _a: size * (-1.0) ** np.searchsorted(jumps, t))


@pytest.mark.parametrize('seed', [11, 12])
def test_what_follows_the_wind_does_not_persist(axis_type, flown, seed):
    name = 'dead_zone'
    data = axis_data([flown(axis_type(torque=wind(seed, 0.6), **QUIET), seed)], 'roll')
    base, _, sim = fit_base(data, data.train)
    fit = fit_with_effect(sim, base, by_name(name), {})
    assert fit.theta[5] > 3.0 * fit.std[5]  # the free run is taken in
    assert not persists(sim, fit, name)


@pytest.mark.parametrize(
    ('name', 'axis'),
    [
        ('dead_zone', {'command': lambda u, _: math.copysign(max(abs(u) - 5e-4, 0.0), u)}),
        ('pendulum_stiffness', {'torque': lambda _, a: -1.0 * math.sin(a)}),
        ('coulomb_friction', {'torque': lambda w, _: -0.2 * math.tanh(w / 1e-3)}),
        ('quadratic_drag', {'torque': lambda w, _: -1.0 * w * abs(w)}),
    ],
)
def test_what_is_there_persists(axis_type, flown, name, axis):
    """The twin: the same in calm air."""
    data = axis_data([flown(axis_type(**axis, **QUIET), 21)], 'roll')
    base, _, sim = fit_base(data, data.train)
    assert persists(sim, fit_with_effect(sim, base, by_name(name), {}), name)


def test_wind_is_given_no_name_of_the_aircraft(axis_type, flown):
    found, _ = answered(flown(axis_type(torque=wind(13, 0.6), **QUIET), 13))
    assert names(found) <= PASSING, names(found)


def test_a_drag_one_way_is_a_curve_of_the_rate(axis_type, flown):
    def torque(rate, _):
        return -1.0 * rate * abs(rate) if rate > 0.0 else 0.0

    found, answer = answered(flown(axis_type(torque=torque, **QUIET), 14))
    assert answer.verdict == 'effects_added', answer.reason
    assert names(found) == {'shape:rate'}
    assert answer.before.free_run / answer.after.free_run > 1.3


def test_grease_that_warms_up_is_a_damping_that_drifts(axis_type, flown):
    torque = clocked(lambda t, w, _: -2.0 * w * math.exp(-t / 15.0))
    found, answer = answered(flown(axis_type(torque=torque, **QUIET), 15))
    assert answer.verdict == 'effects_added', answer.reason
    (effect,) = found.chosen.structure.effects
    assert (effect.name, effect.variant) == ('shape:time', 'damping')


def test_a_motor_that_misses_twice_is_not_passed_over(axis_type, flown):
    """A third of the gain from 10 s to 18 s, in training, and again from 44 s to 50 s."""
    volts = (12.4, 12.3)  # falls evenly: the simulator's clock

    def command(u, volt):
        t = 54.0 * (volts[0] - volt) / (volts[0] - volts[1])
        return 0.35 * u if 10.0 < t < 18.0 or 44.0 < t < 50.0 else u

    _, answer = answered(flown(axis_type(command=command, volts=volts, **QUIET), 16))
    assert answer.verdict in {'unexplained_residual', 'effects_added'}, answer.reason


def test_a_curve_behind_the_lag_is_what_the_motors_give(axis_type, flown):
    """Against 50 steps a cycle, within 1e-2 of the range: a cycle may span a kink."""
    data = axis_data([flown(axis_type(**QUIET), 17)], 'roll')
    x, y, tau = np.array([-0.1, 0.0, 0.1]), np.array([0.02, 0.0, 0.03]), 0.05
    bent = behind_lag(data, data.command, tau, x, y)
    keep = math.exp(-data.dt / 50 / tau)
    plain = wanted = data.command[0]
    given = plain + np.interp(plain, x, y)
    worst = 0.0
    for u, c in zip(data.command[:2000], bent[:2000], strict=True):
        for _ in range(50):
            plain = u + (plain - u) * keep
            given = c + (given - c) * keep
        wanted = plain + np.interp(plain, x, y)
        worst = max(worst, abs(given - wanted))
    assert worst < 1e-2 * np.ptp(data.command)
