"""Each switchable effect acts, by its equation where a closed form exists; off it is absent."""

import math
from dataclasses import fields

import numpy as np
import pytest
from virtual_aircraft import coasting, quiet_profile, without_noise

from quad_bridge.virtual.aircraft import Aircraft
from quad_bridge.virtual.cycle import ARMED, COLUMNS, INPUTS, THROTTLE
from quad_bridge.virtual.effects import Effects
from quad_bridge.virtual.physics import QUAT
from quad_bridge.virtual.profile import Profile

NAMES = [field.name for field in fields(Effects)]
OF_AIR = ('air_drag', 'rotor_drag')


def enabled(name: str, **values) -> Effects:
    kind = type(getattr(Effects(), name))
    return Effects(**{name: kind(enabled=True, **values)})


def coast(effects: Effects, rate: float, angle: float, seconds: float, bias: float = 0.0):
    aircraft = coasting(quiet_profile(effects, bias=bias), (rate, 0.0, 0.0))
    aircraft.machine.state[QUAT : QUAT + 2] = math.cos(angle / 2), math.sin(angle / 2)
    log = aircraft.run(np.zeros((round(seconds * 250), INPUTS)))
    return log[:, 0], log[:, COLUMNS['true_rates']][:, 0], log[:, COLUMNS['true_angles']][:, 0]


def steps(rng: np.random.Generator, count: int, size: float) -> np.ndarray:
    return np.repeat(rng.choice([-size, size], count // 25), 25)


def excited_flight(effects: Effects):
    """All three axes are moved by control steps, the throttle by a stick."""
    profile = without_noise(Profile(mount='hover', effects=effects))
    aircraft = Aircraft(profile, seed=3)
    rng = np.random.default_rng(5)
    given = np.zeros((1000, INPUTS))
    given[:, ARMED] = 1.0
    given[:, THROTTLE] = aircraft.hover_throttle + steps(rng, 1000, 0.05)
    given[:, 1] = 3.0
    for i, size in enumerate((0.05, 0.05, 0.1)):
        given[:, 2 + i] = steps(rng, 1000, size)
    return aircraft.run(given)


@pytest.fixture(scope='module')
def plain():
    return excited_flight(Effects())


@pytest.mark.parametrize('name', NAMES)
def test_every_effect_of_the_table_can_be_switched_on_and_changes_the_flight(plain, name):
    values = {'step_event': {'time_s': 1.0}, 'saturation': {'lower': 0.3, 'upper': 0.36}}
    with_it = excited_flight(enabled(name, **values.get(name, {})))
    seen = {'vibration': 'rates'} | dict.fromkeys(OF_AIR, 'velocity_m_s')
    column = COLUMNS[seen.get(name, 'true_rates')]
    assert np.isfinite(with_it).all()
    assert np.abs(with_it[:, column] - plain[:, column]).max() > 2e-3


def test_coulomb_friction_stops_a_spin_after_its_time_and_then_holds_it():
    time, rate, _ = coast(enabled('coulomb_friction'), 1.0, 0.0, 6.0, bias=0.003)
    slope = (0.004 - 0.003) / 0.0135
    assert rate[time < 6.0] == pytest.approx(
        np.maximum(0.0, 1.0 - slope * time)[time < 6.0], abs=1e-3
    )
    stuck = coast(enabled('coulomb_friction'), 0.0, 0.0, 2.0, bias=0.0039)
    assert not stuck[1].any()
    slips = coast(enabled('coulomb_friction'), 0.0, 0.0, 1.0, bias=0.0050)
    assert slips[1][-1] == pytest.approx(0.001 / 0.0135, rel=0.01)


def test_quadratic_drag_decays_hyperbolically():
    time, rate, _ = coast(enabled('quadratic_drag'), 3.0, 0.0, 4.0)
    assert rate == pytest.approx(3.0 / (1.0 + 0.006 / 0.0135 * 3.0 * time), rel=1e-9)


@pytest.mark.parametrize(
    ('name', 'begin', 'potential'),
    [
        ('pendulum_stiffness', 0.02, lambda angle: 0.15 * (1 - np.cos(angle))),
        ('cubic_stiffness', 0.3, lambda angle: 0.25 * 3.0 * angle**4),
    ],
)
def test_a_stiffness_swings_and_keeps_its_energy(name, begin, potential):
    time, rate, angle = coast(enabled(name), 0.0, begin, 6.0)
    energy = 0.5 * 0.0135 * rate**2 + potential(angle)
    assert np.ptp(energy) / energy[0] < 1e-8
    assert np.ptp(angle) > 1.8 * begin
    if name == 'pendulum_stiffness':
        assert angle == pytest.approx(begin * np.cos(math.sqrt(0.15 / 0.0135) * time), abs=2e-5)
