"""Names that something else only looks like: what outdoes them, and springs against each other.

The tests' own simulator (conftest.py). Each has its twin, where the name is the truth.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from quad_sysid.effects.candidate import candidate
from quad_sysid.effects.rivals import outdone
from quad_sysid.effects.shapes import SHAPES
from quad_sysid.effects.table import EFFECTS, by_name
from quad_sysid.effects.worth import against_nature
from quad_sysid.greybox.data import axis_data
from quad_sysid.greybox.fit import fit_base, fit_with_effect

QUIET = {'gyro_noise': 0.004, 'torque_noise': 0.02}
CALLS_A_SECOND = 2000
"""The simulator asks for the torque twice in each step of 1 ms."""


def hysteresis():
    """Dahl's friction, 0.2 rad/s² that build up over 0.1 rad."""
    state = [0.0]

    def torque(rate, _):
        step = rate / CALLS_A_SECOND / 0.1
        state[0] = min(1.0, max(-1.0, state[0] + step * (1.0 - state[0] * math.copysign(1, rate))))
        return -0.2 * state[0]

    return torque


def with_names(record, *names):
    """Simulator, the base alone, and the base with named effects."""
    base, _, sim = fit_base(axis_data([record], 'roll'), axis_data([record], 'roll').train)
    fits = [base]
    for name in names:
        fits.append(fit_with_effect(sim, fits[-1], by_name(name), {}))
    return sim, candidate(sim, base), candidate(sim, fits[-1])


def unnamed(sim, name, variant=''):
    effect = next(e for e in EFFECTS + SHAPES if (e.name, e.variant) == (name, variant))
    settings = effect.prepare(sim.data) if effect.prepare else {}
    assert not isinstance(settings, str), settings
    return effect, settings


@pytest.mark.parametrize(
    ('torque', 'left'),
    [(hysteresis, ('mode',)), (lambda: lambda _, a: -40.0 * a**3, ('cubic_stiffness',))],
    ids=['hysteresis', 'twin'],
)
def test_hysteresis_is_no_cubic_spring(axis_type, flown, torque, left):
    sim, _, named = with_names(flown(axis_type(torque=torque(), **QUIET), 31), 'cubic_stiffness')
    rivals = [unnamed(sim, 'mode', 'hysteresis'), unnamed(sim, 'shape:angle')]
    found = outdone(sim, named, 'cubic_stiffness', rivals, np.random.default_rng(0))
    assert found.names == left
    assert found.score <= named.score


def test_friction_gives_way_to_no_curve_of_the_rate(axis_type, flown):
    """Stribeck's curve is friction: the curve may refine it, but the name stays."""

    def torque(rate, _):
        return -(0.3 + 0.9 / (1.0 + (rate / 0.3) ** 2)) * math.tanh(rate / 0.01)

    sim, _, named = with_names(flown(axis_type(torque=torque, **QUIET), 32), 'coulomb_friction')
    curve = [unnamed(sim, 'shape:rate')]
    assert outdone(sim, named, 'coulomb_friction', curve, np.random.default_rng(0)) is named


@pytest.mark.parametrize(
    ('torque', 'other'),
    [
        (lambda _, a: -9.0 * math.copysign(max(0.0, abs(a) - 0.1), a), True),  # soft stops
        (lambda _, a: 4.0 * math.sin(a) - 60.0 * a**3, False),  # top-heavy, on an elastic cable
        (lambda _, a: -4.0 * math.sin(a) - 60.0 * a**3, False),
    ],
    ids=['stops', 'top-heavy', 'both'],
)
def test_a_weak_spring_against_a_strong_one_is_another_shape(axis_type, flown, torque, other):
    record = flown(axis_type(torque=torque, **QUIET), 33)
    sim, base, both = with_names(record, 'cubic_stiffness', 'pendulum_stiffness')
    assert against_nature(sim, base, both, 'pendulum_stiffness') == other
    assert against_nature(sim, base, both, 'cubic_stiffness') == other
