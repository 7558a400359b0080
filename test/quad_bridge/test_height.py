"""The height mode in flight: virtual aircraft, barometer and accelerometer, ground and all."""

from dataclasses import replace

import numpy as np
import pytest

from quad_bridge.virtual.effects import Ground
from quad_bridge.virtual.profile import load_profile
from quad_bridge.virtual.receiver import Event, Receiver
from quad_bridge.virtual.simulation import fly

HOVER = 0.32
LANDED = 4


def flown(script, duration_s, *, ground=None):
    profile = load_profile('hover')
    events = tuple(Event(*row) for row in script)
    effects = replace(profile.effects, ground=ground or Ground())
    return fly(replace(profile, receiver=Receiver(events), effects=effects), [], duration_s, 3)


def at(flight, start_s, end_s):
    return (flight.time_s >= start_s) & (flight.time_s < end_s)


def test_it_holds_its_height_climbs_by_the_stick_and_knows_both():
    """2 Pa of noise are 0.17 m at the barometer; a hand at the throttle would drift away."""
    flight = flown([(1.0, 'throttle', HOVER), (2.0, 'aux4', 1.0), (12.0, 'throttle', 0.7),
                    (15.0, 'throttle', HOVER)], 30.0)  # fmt: skip
    held = at(flight, 4.0, 12.0)
    assert np.ptp(flight.position_m[:, 2][held]) < 0.25
    assert np.abs(flight.height_m - flight.position_m[:, 2])[held].max() < 0.2
    moved = at(flight, 20.0, 30.0)
    assert np.ptp(flight.position_m[:, 2][moved]) < 0.25
    rose = flight.position_m[:, 2][moved].mean() - flight.position_m[:, 2][held].mean()
    assert rose == pytest.approx(1.5, abs=0.5)  # half of the climb's limit for three seconds
    speed = np.gradient(flight.position_m[:, 2], flight.dt)
    assert np.sqrt(np.mean((speed - flight.climb_m_s)[held | moved] ** 2)) < 0.1


@pytest.mark.parametrize('radius_m', [0.0, 0.127])
def test_it_takes_off_and_lands_with_and_without_a_cushion_of_air(radius_m):
    flight = flown([(0.0, 'throttle', 0.0), (1.0, 'aux4', 1.0), (3.0, 'throttle', 0.8),
                    (6.0, 'throttle', 0.5), (10.0, 'throttle', 0.0)], 24.0,
                   ground=Ground(enabled=True, rotor_radius_m=radius_m))  # fmt: skip
    landed = flight.limits.astype(int) & LANDED > 0
    assert landed[at(flight, 1.0, 3.0)].all()
    assert flight.position_m[:, 2][at(flight, 1.0, 3.0)].max() <= 0.0
    up = at(flight, 7.0, 10.0)
    assert not landed[up].any()
    assert flight.position_m[:, 2][up].min() > 0.8
    assert landed[-1]
    assert flight.motors[-1].max() == 0.0
    touch = flight.time_s[at(flight, 10.0, 24.0) & (flight.position_m[:, 2] <= 0.0)][0]
    before = at(flight, touch - 0.2, touch)
    sinking = np.gradient(flight.position_m[:, 2], flight.dt)[before]
    assert sinking.min() > -0.8  # it sets down softly
