"""Notches where a planted vibration reaches the motors, and none where it does not."""

from dataclasses import replace

import numpy as np
import pytest

from quad_bridge.virtual.effects import Vibration
from quad_bridge.virtual.profile import load_profile
from quad_bridge.virtual.simulation import fly
from quad_sysid.contract import AXES
from quad_sysid.logview.spectrum import Peak, frames
from quad_tuning.notches import D_HIGHEST_HZ, MOST_PHASE_DEG, propose_notches

CROSSING = {'roll': 20.0, 'pitch': 20.0, 'yaw': 8.0}


def flown(gains, amplitude):
    profile = load_profile('hover')
    shaking = Vibration(enabled=True, frequency_hz=(70.0,), amplitude_rad_s=(amplitude,))
    profile = replace(profile, effects=replace(profile.effects, vibration=shaking))
    return fly(profile, [], 8.0, 3, gains=gains)


def peaks(flight):
    good = np.ones(len(flight.time_s), bool)
    seen = {axis: frames(flight.rates[:, i], good, flight.dt) for i, axis in enumerate(AXES)}
    return {axis: one.peaks() for axis, one in seen.items()}


def shaken(flight):
    """RMS of the roll command about the vibration."""
    good = np.ones(len(flight.time_s), bool)
    return frames(flight.wrench[:, 1], good, flight.dt).rms(66.0, 74.0)


def test_a_vibration_that_the_motors_follow_gets_a_notch_that_ends_it():
    before = flown({}, 0.8)
    found = propose_notches(peaks(before), before.gains, CROSSING, before.dt)
    assert found
    assert found[0].frequency_hz == pytest.approx(70.0, abs=1.0)
    assert all(one.phase_deg <= MOST_PHASE_DEG for one in found)
    after = flown({name: v for one in found for name, v in one.gains.items()}, 0.8)
    assert shaken(after) < 0.4 * shaken(before)


def test_none_is_proposed_where_nothing_shakes_or_the_command_does_not_follow():
    quiet = flown({}, 0.0)
    assert propose_notches(peaks(quiet), quiet.gains, CROSSING, quiet.dt) == ()
    faint = {'roll': (Peak(70.0, 0.002),)}
    assert propose_notches(faint, quiet.gains, CROSSING, quiet.dt) == ()


def test_what_lies_near_the_crossover_or_beyond_the_d_notch_is_left_to_others():
    gains = dict(flown({}, 0.0).gains)
    near = propose_notches({'roll': (Peak(21.0, 1.0),)}, gains, {'roll': 80.0}, 0.004)
    assert all(one.phase_deg <= MOST_PHASE_DEG for one in near)
    gains['roll.rate.kd'] = 0.02
    by_d = propose_notches({'roll': (Peak(80.0, 0.5),)}, gains, CROSSING, 0.004)
    assert [one.place for one in by_d] == ['rate.d_notch']
    assert 0.0 < by_d[0].phase_deg <= MOST_PHASE_DEG
    beyond = {'roll': tuple(Peak(D_HIGHEST_HZ + above, 0.5) for above in (2.0, 8.0, 14.0))}
    high = propose_notches(beyond, gains, CROSSING, 0.004)
    assert [one.place for one in high] == ['sensor.notch_1', 'sensor.notch_2']
    used = gains | {'sensor.notch_1_hz': 90.0, 'sensor.notch_2_hz': 100.0}
    assert propose_notches({'roll': (Peak(118.0, 0.5),)}, used, CROSSING, 0.004) == ()
