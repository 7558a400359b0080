"""The schedule on the battery's voltage: in the firmware, in the design, on the way there."""

import dataclasses

import numpy as np
import pytest
from virtual_aircraft import without_noise

from quad_bridge.gains.gate import steps as gate_steps
from quad_bridge.gains.table import DEFAULT_BOUNDS
from quad_bridge.virtual.profile import load_profile
from quad_bridge.virtual.simulation import Excited, fly
from quad_sysid.axes import TURNING
from quad_sysid.estimate.stored import estimate_of
from quad_sysid.loop.from_model import loop_plant
from quad_tuning.designer import design

EXPONENT, REFERENCE = 'roll.sag.exponent', 'roll.sag.reference_v'


def sagging(model, power=1.2, **active):
    effect = estimate_of('battery_sag', (power,), settings={'reference_v': 11.1}, std=0.05)
    m = model(effects=[effect])
    return dataclasses.replace(m, mean_battery_v=11.4, active_gains={**m.active_gains, **active})


def slopes(charge, gains, power=1.5):
    """RMS of the roll rate's steps per command that acts, on a pack of this charge."""
    profile = without_noise(load_profile('plain'))
    sag = dataclasses.replace(profile.effects.battery_sag, enabled=True, exponent=power)
    battery = dataclasses.replace(profile.airframe.battery, start_charge=charge)
    profile = dataclasses.replace(
        profile, mount='rig', axis='roll',
        effects=dataclasses.replace(profile.effects, battery_sag=sag),
        airframe=dataclasses.replace(profile.airframe, battery=battery),
    )  # fmt: skip
    wave = TURNING.step * np.where((np.arange(3000) // 500) % 2 == 0, 1.0, -1.0)
    flight = fly(profile, [Excited(3.0, wave)], 15.0, 5, gains=gains)
    return flight.true_angles[1250:, 0], float(flight.battery_v.mean())


def test_a_low_pack_flies_as_a_full_one():
    full, volts = slopes(0.95, {})
    low, _ = slopes(0.15, {})
    scheduled, _ = slopes(0.15, {EXPONENT: 1.5, REFERENCE: volts})
    lost = np.sqrt(np.mean((low - full) ** 2))
    left = np.sqrt(np.mean((scheduled - full) ** 2))
    assert left < 0.2 * lost
    assert np.degrees(lost) > 0.1
    off, _ = slopes(0.15, {EXPONENT: 0.0, REFERENCE: volts})
    np.testing.assert_array_equal(off, low)


@pytest.mark.usefixtures('quick')
def test_the_design_takes_the_schedule(model):
    """In steps that the gate makes; test_design.py: without sag there is none."""
    with_it = design(sagging(model))
    assert with_it.gains[EXPONENT] == pytest.approx(1.2)
    assert with_it.gains[REFERENCE] == pytest.approx(11.4)
    assert with_it.figures['worst_phase_margin_deg'] >= 45.0
    m = sagging(model)
    made = gate_steps(with_it.gains, m.active_gains, DEFAULT_BOUNDS)
    ours, gates = ([step[EXPONENT] for step in steps] for steps in (with_it.steps, made))
    least = min(len(ours), len(gates))
    assert gates[:least] == pytest.approx(ours[:least], rel=1e-3)
    assert all(step[REFERENCE] == pytest.approx(11.4) for step in made)


def test_a_flight_with_the_schedule_is_analysed_with_it(model):
    m = sagging(model, **{EXPONENT: 1.2, REFERENCE: 12.0})
    ours, plain = (loop_plant(one).plant.p[0] for one in (m, sagging(model)))
    assert ours == pytest.approx(plain * (12.0 / 11.4) ** 1.2)
