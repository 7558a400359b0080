"""Climb and surge of the virtual aircraft: ground effect and drag by name, and twins with neither.

The physics is quad_bridge.virtual's, which the analysis does not import; speed and altitude are
measured as a motion capture does, 62.5 times a second with noise.
"""

from dataclasses import replace
from unittest import mock

import numpy as np
import pytest

import quad_sysid as qs
from quad_bridge.virtual.aircraft import Aircraft
from quad_bridge.virtual.cycle import ADDED, INJECTION, THROTTLE
from quad_bridge.virtual.effects import AirDrag, Effects, Ground
from quad_bridge.virtual.physics import POSITION, VELOCITY
from quad_bridge.virtual.profile import Pilot, load_profile
from quad_bridge.virtual.simulation import INJECTIONS, Excited, fly, inputs
from quad_sysid.bags import read_bag, write_bag
from quad_sysid.contract import control_from_motors
from quad_sysid.craft import from_urdf
from quad_sysid.loop import kernels
from quad_sysid.loop.cascade import CascadeGains
from quad_sysid.loop.from_model import behind_lean, loop_plant, not_in_the_loop
from quad_sysid.loop.simulation import simulate_cascade
from quad_sysid.model import GainProposal
from quad_sysid.motion import (
    GRAVITY,
    altitude_of,
    in_body,
    lean,
    over_level,
    vertical_motion,
)
from quad_sysid.record import GainChange, Record, Segment
from quad_sysid.whole import whole_of
from quad_tuning.designer import propose
from quad_tuning.errors import DesignRefusedError

HEIGHT, RADIUS, STANDING = 0.6, 0.35, 0.2
GROUND = Effects(ground=Ground(enabled=True, rotor_radius_m=RADIUS, rotor_height_m=STANDING,
                               height_m=STANDING - HEIGHT))
DRAG = Effects(air_drag=AirDrag(enabled=True))
BODY = load_profile('plain').airframe
PARTS = (('train', 2.0, 26.0), ('validation', 29.0, 13.0))


def levels(seconds, shortest, longest, seed):
    """Steps of three sizes that hold for a random time."""
    rng, out, k = np.random.default_rng(seed), np.zeros(round(250 * seconds)), 0
    while k < out.size:
        held = int(rng.integers(250 * shortest, 250 * longest))
        out[k : k + held] = rng.choice([-1.0, -0.4, 0.4, 1.0])
        k += held
    return out


def flown(effects, axis, seed=1):
    """A flight in hover with this axis excited, as the analysis gets it from a bag."""
    climbs = axis == 'climb'
    size, times = (0.05, (0.1, 0.5)) if climbs else (0.2, (0.3, 1.5))
    flight = fly(
        replace(load_profile('plain'), mount='hover', effects=effects),
        [Excited(start, size * levels(length, *times, 10 * seed + k),
                 axis='climb' if climbs else 'pitch', role=role,
                 injection='control' if climbs else 'attitude')
         for k, (role, start, length) in enumerate(PARTS)],
        43.0, seed,
    )  # fmt: skip
    rng, n = np.random.default_rng(seed), flight.time_s.size
    yaw, (x, y, z) = flight.true_angles[:, 2], flight.velocity_m_s.T
    velocity = np.column_stack([np.cos(yaw) * x + np.sin(yaw) * y,
                                np.cos(yaw) * y - np.sin(yaw) * x, z])
    seen = {
        'velocity': velocity + 0.01 * rng.standard_normal((n, 3)),
        'altitude': flight.position_m[:, 2] + 0.005 * rng.standard_normal(n),
        'lean': lean(flight.true_angles + 0.002 * rng.standard_normal((n, 3))),
    }
    for values in seen.values():
        values[np.arange(n) % 4 != 0] = np.nan
    record = Record(
        source='virtual', dt=flight.dt, t0_ns=10**18, rates=flight.rates, angles=flight.angles,
        acceleration=flight.acceleration, motors=flight.motors,
        control=control_from_motors(flight.motors),
        segments=tuple(Segment(role, 'prbs', part.axis, part.injection, a, a + length)
                       for part, (role, a, length) in zip(flight.schedule, PARTS, strict=True)),
        gains=(GainChange(0.0, dict(flight.gains)),), **seen,
    )  # fmt: skip
    return record, flight


def identified(record, axis, **more):
    """The answer without black-box models and without a design, which are others' tests."""
    with mock.patch('quad_sysid.pipeline.identify._black_boxes', return_value='left out'):
        return qs.identify(record, axes=axis, designer=lambda _: GainProposal(None, ''), **more)


def answer(effects, axis):
    return identified(flown(effects, axis)[0], axis)


@pytest.fixture(scope='module')
def climbed():
    """A flight without a ground: its record, what was flown, and the answer."""
    record, flight = flown(Effects(), 'climb')
    return record, flight, identified(record, 'climb', mass=BODY.mass_kg)


def test_climb_without_a_ground_lacks_nothing(climbed):
    found = climbed[2]
    tree = found.report['axes']['climb']
    assert (tree['verdict'], tree['error']['unit']) == ('no_missing_effect', 'm/s')
    thrust = 4.0 * BODY.motors.full_thrust_n / BODY.mass_kg
    assert found.answer.model.value('gain') == pytest.approx(thrust, rel=0.01)
    assert found.answer.model.value('bias') == pytest.approx(-9.81, rel=0.01)
    assert found.answer.model.value('damping') == pytest.approx(0.3, rel=0.03)


def test_a_speed_that_comes_rarely_is_not_measured_in_between(climbed):
    record, keep = climbed[0], np.arange(climbed[0].n) % 48 == 0
    rare = replace(record, velocity=np.where(keep[:, None], record.velocity, np.nan),
                   altitude=np.where(keep, record.altitude, np.nan))
    found = identified(rare, 'climb')
    assert found.report['axes']['climb']['verdict'] == 'no_missing_effect'
    assert found.answer.model.value('gain') == pytest.approx(
        climbed[2].answer.model.value('gain'), rel=0.005)


def test_climb_near_the_ground_names_it():
    found = answer(GROUND, 'climb')
    tree, model = found.report['axes']['climb'], found.answer.model
    assert [*not_in_the_loop(model)] == ['ground_effect']
    assert abs(loop_plant(model).rest_acceleration) < 1e-6
    assert [effect['name'] for effect in tree['effects']] == ['ground_effect']
    radius, ground = tree['effects'][0]['parameters']
    assert (radius['unit'], ground['unit']) == ('m', 'm')
    assert radius['value'] == pytest.approx(RADIUS, rel=0.02)
    assert ground['value'] == pytest.approx(-HEIGHT, rel=0.02)


def test_surge_without_drag_lacks_nothing():
    found = answer(Effects(), 'surge')
    assert found.report['axes']['surge']['verdict'] == 'no_missing_effect'
    assert found.answer.model.value('gain') == pytest.approx(9.81, rel=0.015)
    assert found.answer.model.value('damping') == pytest.approx(0.3, rel=0.03)


def test_surge_names_the_drag():
    tree = answer(DRAG, 'surge').report['axes']['surge']
    assert [effect['name'] for effect in tree['effects']] == ['quadratic_drag']
    (drag,) = tree['effects'][0]['parameters']
    assert drag['value'] == pytest.approx(0.25 / BODY.mass_kg, rel=0.1)
    assert drag['unit'] == 'm/s² per (m/s)²'


def test_a_bag_holds_what_a_record_says_of_the_motion(tmp_path):
    record, _ = flown(Effects(), 'surge')
    back = read_bag(write_bag(record, tmp_path / 'bag'))
    seen = np.isfinite(record.velocity[:, 0])
    assert back.velocity[seen] == pytest.approx(record.velocity[seen], abs=0.02)
    assert back.altitude[seen] == pytest.approx(record.altitude[seen], abs=1e-6)
    assert back.lean[seen] == pytest.approx(record.lean[seen], abs=0.02)
    assert not np.isfinite(back.velocity[~seen]).any()


@pytest.mark.parametrize(('every', 'lost'), [(1, []), (5, []), (5, [12, 33])])
def test_a_lean_acts_from_one_sample_to_the_next(every, lost):
    t = 0.02 / every * np.arange(100 * every)
    angles = np.column_stack([0.0 * t, np.arctan(0.1 * t), 0.0 * t])
    angles[lost] = np.nan
    speed = np.column_stack([0.05 * t**2, 0.0 * t, 0.0 * t])
    speed[np.arange(t.size) % every != 0] = np.nan
    record = Record('a flight', 0.02 / every, np.zeros((t.size, 3)), np.ones((t.size, 4)),
                    angles=angles, velocity=speed).for_axis('surge')
    driven = record.motion('surge').control[:-1, 1]
    np.testing.assert_allclose(driven, np.diff(0.05 * t[::every]**2) / 0.02, atol=1e-4)


def test_a_lean_counts_by_the_thrust_that_leans():
    """Altitude is held loosely, and the accelerometer shakes."""
    t = 0.004 * np.arange(5000)
    angles = np.column_stack([0.0 * t, np.full(t.size, 0.1), 0.0 * t])
    thrust = 1.0 + 0.15 * np.sin(1.5 * t)
    force = in_body(np.column_stack([0.0 * t, 0.0 * t, GRAVITY * thrust]), angles)
    force += np.random.default_rng(1).normal(0.0, 1.0, force.shape)
    speed = np.where(np.arange(t.size)[:, None] % 5 == 0, np.zeros((t.size, 3)), np.nan)
    record = Record('a flight', 0.004, np.zeros((t.size, 3)), np.ones((t.size, 4)),
                    angles=angles, acceleration=force, velocity=speed).for_axis('surge')
    driven = record.motion('surge').control[10:-10, 1]
    np.testing.assert_allclose(driven, np.tan(0.1) * thrust[2::5][10:-10], rtol=0.06)


@pytest.mark.parametrize('every', [1, 5])
def test_where_the_aircraft_turns_speed_and_lean_point_alike(every):
    t = 0.02 / every * np.arange(400 * every)
    forward, left = 0.1 * np.cos(0.6 * t), -0.1 * np.sin(0.6 * t)
    angles = np.column_stack([-np.arctan(left * np.cos(np.arctan(forward))), np.arctan(forward),
                              0.6 * t])
    speed = np.column_stack([10.0 * t * forward, 10.0 * t * left, 0.0 * t])
    record = Record('a flight', 0.02 / every, np.zeros((t.size, 3)), np.ones((t.size, 4)),
                    angles=angles, velocity=speed)
    surge, sway = (record.for_axis(axis).motion(axis) for axis in ('surge', 'sway'))
    way = np.arctan2(sway.rate, surge.rate) - np.arctan2(surge.control[:, 2], surge.control[:, 1])
    np.testing.assert_allclose(way[1:-1], 0.0, atol=1e-3)


def test_the_force_is_not_integrated_ahead_of_its_time():
    t = 0.004 * np.arange(2000)
    speed, _ = vertical_motion(np.sin(6.0 * t), -36.0 * np.sin(6.0 * t), 0.004)
    assert np.abs(speed - 6.0 * np.cos(6.0 * t))[250:-250].max() < 0.02


def test_barometer_and_accelerometer_give_the_climb(climbed):
    record, flight, _ = climbed
    force = over_level(record.acceleration, record.angles)[:, 2]
    speed, altitude = vertical_motion(altitude_of(flight.pressure_pa), force, record.dt)
    assert np.std(speed - flight.velocity_m_s[:, 2]) < 0.06
    assert np.std(altitude - flight.position_m[:, 2]) < 0.15


def test_the_excitation_of_the_climb_is_added_to_the_throttle(climbed):
    _, flight, _ = climbed
    added = np.zeros(flight.time_s.size)
    for part in flight.schedule:
        start = round(part.start_s / flight.dt)
        added[start : start + part.samples.size] = part.samples
    assert flight.wrench[:, 0] - flight.throttle == pytest.approx(added, abs=1e-6)


def test_the_aircraft_as_a_whole(climbed):
    record, _, found = climbed
    full = 4.0 * BODY.motors.full_thrust_n
    facts = {fact.name: fact for fact in found.whole.facts}
    assert facts['full_thrust'].value == pytest.approx(full, rel=0.01)
    assert facts['hover_throttle'].value == pytest.approx(BODY.mass_kg * 9.81 / full, rel=0.01)
    assert abs(facts['centre_of_mass_x'].value) < 1.0
    rig = replace(record, velocity=None,
                  acceleration=in_body(np.tile((0.0, 0.0, 9.81), (record.n, 1)), record.angles))
    assert {'hover_throttle', 'centre_of_mass_x'}.isdisjoint(
        fact.name for fact in whole_of({}, [rig]).facts)
    turned = whole_of({'climb': found.answer.model}, [record], thrust_n=full)
    assert turned.facts[0].value == pytest.approx(BODY.mass_kg, rel=0.01)
    assert from_urdf(found.report['aircraft']['urdf']).count == 4


def test_a_hold_of_the_altitude_flies_as_with_the_found_model(climbed):
    """A step of 0.5 m and a gust of 0.4 m/s under one cascade: to 10 % of the step."""
    gains = CascadeGains(1.5, 0.12, 0.06, 0.0, output_limit=0.25, rate_limit=1.0)
    plant = loop_plant(climbed[2].answer.model)
    every, n = round(plant.dt * 250.0), round(10.0 / plant.dt)
    wanted, gust = np.where(np.arange(n) * plant.dt < 1.0, 0.0, 0.5), round(6.0 / plant.dt)
    push = np.zeros(n)
    push[gust] = 0.4 / plant.dt
    said = simulate_cascade(plant, gains, wanted, plant.dt,
                            disturbance=push - plant.rest_acceleration)

    profile = replace(load_profile('plain'), mount='hover', pilot=Pilot(0.0, 0.0))
    aircraft = Aircraft(profile, seed=7)
    state, given = aircraft.machine.state, inputs(aircraft, [], every)
    height, integral = np.zeros(n), 0.0
    for k in range(n):
        state[VELOCITY + 2] += 0.4 * (k == gust)
        height[k], climb = state[POSITION + 2], state[VELOCITY + 2]
        error = float(np.clip(gains.angle_kp * (wanted[k] - height[k]), -1.0, 1.0)) - climb
        integral += gains.rate_ki * plant.dt * error
        given[:, THROTTLE] = aircraft.hover_throttle + np.clip(
            gains.rate_kp * error + integral, -0.25, 0.25)
        aircraft.run(given)
    assert np.sqrt(np.mean((said.angle - height) ** 2)) < 0.1 * 0.5
    assert np.abs(said.angle - height).max() < 0.1


@pytest.mark.long
def test_designed_gains_hold_the_position_as_with_the_found_model():
    """A step of 1 m and a gust of 0.5 m/s: to 10 % of the step, at its worst moment too."""
    found = qs.identify(flown(Effects(), 'surge')[0], axes=('surge', 'pitch'), effects=())
    models = {axis: one.model for axis, one in found.answers.items()}
    with pytest.raises(DesignRefusedError, match='the model of pitch is needed too'):
        propose(models['surge'])
    proposal = propose(models['surge'], inner=models['pitch'])
    assert proposal.figures['rise_time_s'] < 0.8 * proposal.figures['rise_time_s_before']
    gains = CascadeGains.from_mapping(proposal.steps[-1], 'surge')
    plant = loop_plant(behind_lean(models['surge'], models['pitch']))
    dt, n = plant.dt, round(20.0 / plant.dt)
    wanted, gust = np.where(np.arange(n) * dt < 1.0, 0.0, 1.0), round(12.0 / dt)
    push = np.zeros(n)
    push[gust] = 0.5 / dt
    said = simulate_cascade(plant, gains, wanted, dt, disturbance=push - plant.rest_acceleration)

    aircraft = Aircraft(replace(load_profile('plain'), mount='hover'), seed=7)
    state, given = aircraft.machine.state, inputs(aircraft, [], round(250.0 * dt))
    given[:, INJECTION] = INJECTIONS.index('attitude')
    place, memory, u = np.zeros(n), np.zeros((1, kernels.MEMORY)), np.zeros(1)
    for k in range(n):
        state[VELOCITY] += 0.5 * (k == gust)
        place[k], speed = state[POSITION], state[VELOCITY]
        kernels.control_each(gains.constants(dt), memory, np.array([[wanted[k], 0.0, 0.0]]),
                             place[k : k + 1], np.array([speed]), u)
        given[:, ADDED + 1] = np.arctan(u[0])
        aircraft.run(given)
    assert np.abs(said.angle - place).max() < 0.1
