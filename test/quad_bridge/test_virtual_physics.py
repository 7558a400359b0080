"""The virtual aircraft's dynamics against closed forms and invariants; all without noise."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from virtual_aircraft import coasting, open_loop, quiet_profile

from quad_bridge.virtual import compiled
from quad_bridge.virtual.aircraft import Aircraft
from quad_bridge.virtual.cycle import ADDED, ARMED, COLUMNS, INJECTION, INPUTS, THROTTLE
from quad_bridge.virtual.effects import BatterySag, Effects, GyroscopicCoupling, InertiaCoupling
from quad_bridge.virtual.physics import CHARGE, QUAT, RATES
from quad_bridge.virtual.plant import axis_gains

AXES = ('roll', 'pitch', 'yaw')


def inputs(cycles: int, aircraft: Aircraft, armed: bool = True) -> np.ndarray:
    given = np.zeros((cycles, INPUTS))
    given[:, ARMED] = float(armed)
    given[:, THROTTLE] = aircraft.hover_throttle
    return given


@pytest.mark.parametrize(
    ('rates', 'spin', 'cycles'), [((3.0, -2.0, 4.0), 0.0, 1250), ((1.0, 0.5, 0.2), 0.05, 750)]
)
def test_a_torque_free_body_keeps_its_angular_momentum_and_energy_while_it_tumbles(
    rates, spin, cycles
):
    """With the spinning part's momentum, which does no work."""
    effects = Effects(inertia_coupling=InertiaCoupling(enabled=True))
    if spin:
        effects = replace(effects, gyroscopic_coupling=GyroscopicCoupling(
            enabled=True, rotor_scale=0.0, extra_momentum_nm_s=spin))
    profile = quiet_profile(effects, mount='hover')
    aircraft = coasting(profile, rates)
    inertia, extra = np.array(profile.airframe.inertia_kg_m2), np.array([0.0, 0.0, spin])
    state = aircraft.machine.state
    momentum = inertia * state[RATES : RATES + 3] + extra
    energy = inertia @ state[RATES : RATES + 3] ** 2
    log = aircraft.run(inputs(cycles, aircraft, armed=False))
    to_world = Rotation.from_quat(np.roll(state[QUAT : QUAT + 4], -1))  # w x y z to x y z w
    after = to_world.apply(inertia * state[RATES : RATES + 3] + extra)
    turned = np.ptp(log[:, COLUMNS['true_rates']], axis=0)
    assert turned[: 2 if spin else 3].min() > 0.04
    assert after == pytest.approx(momentum, abs=1e-8)
    assert inertia @ state[RATES : RATES + 3] ** 2 == pytest.approx(energy, rel=1e-8)


@pytest.mark.parametrize('axis', AXES)
def test_a_control_step_gives_gain_lag_delay_and_damping_about_the_free_axis_alone(axis):
    index, damping, size, lag = AXES.index(axis), 0.4, 0.02, 0.045
    aircraft = Aircraft(quiet_profile(damping=damping, axis=axis), seed=1)
    open_loop(aircraft)
    given = inputs(250, aircraft)
    given[:, INJECTION], given[:, ADDED + index] = 3.0, size
    log = aircraft.run(given)
    gain = axis_gains(aircraft.profile.airframe)[index]
    since = np.maximum(0.0, log[:, 0] - 2 * 0.004)
    slow, fast = np.exp(-damping * since), np.exp(-since / lag)
    expected = (
        gain * size / damping * (1 - slow - damping * lag * (slow - fast) / (1 - damping * lag))
    )
    rates = log[:, COLUMNS['true_rates']]
    assert rates[:, index] == pytest.approx(expected, rel=1e-6, abs=1e-6)
    assert not np.delete(rates, index, axis=1).any()


def test_the_battery_sags_under_load_and_empties_by_its_current():
    aircraft = Aircraft(quiet_profile(), seed=1)
    machine = aircraft.machine
    log = aircraft.run(inputs(2500, aircraft))
    n = aircraft.hover_throttle
    current = 0.4 + 4 * 14.0 * n**1.5
    assert machine.state[CHARGE] - 0.05 * 4.5 * 3600 == pytest.approx(current * 10.0, rel=1e-6)
    open_v = 3 * np.interp(0.95, (0.9, 1.0), (4.06, 4.2))
    assert log[0, COLUMNS['battery_v']] == pytest.approx(open_v - 0.025 * current, abs=1e-9)


def test_a_battery_that_cannot_give_the_current_has_no_voltage_rather_than_less_than_none():
    profile = quiet_profile(Effects(battery_sag=BatterySag(enabled=True)), mount='hover')
    battery = replace(profile.airframe.battery, resistance_ohm=0.25)
    profile = replace(profile, airframe=replace(profile.airframe, battery=battery))
    aircraft = Aircraft(profile, seed=1)
    given = inputs(500, aircraft)
    given[:, THROTTLE] = 1.0
    log = aircraft.run(given)
    assert np.isfinite(log).all()
    assert log[:, COLUMNS['battery_v']].min() >= 0.0


def test_the_compiled_cache_follows_every_file_with_kernels():
    folder = Path(compiled.__file__).parent
    marked = {
        path.name
        for path in folder.glob('*.py')
        if re.search(r'^ *@(kernel|entry)$', path.read_text(encoding='utf-8'), re.MULTILINE)
    }
    assert marked <= set(compiled.KERNEL_FILES)
    assert all((folder / name).is_file() for name in compiled.KERNEL_FILES)
