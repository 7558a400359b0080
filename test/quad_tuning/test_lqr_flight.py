"""The LQR in the virtual firmware's nonlinear flight: as designed, without a jump on its way."""

from dataclasses import replace

import numpy as np
import pytest
from virtual_aircraft import without_noise

from quad_bridge.virtual.aircraft import Aircraft
from quad_bridge.virtual.cycle import COLUMNS
from quad_bridge.virtual.plant import axis_gains
from quad_bridge.virtual.profile import load_profile
from quad_bridge.virtual.simulation import Excited, fly, inputs
from quad_sysid.axes import TURNING
from quad_sysid.record import GainChange, Record
from quad_tuning.designer import design
from quad_tuning.lqr import propose_lqr

HALF = 500


@pytest.fixture(scope='module')
def profile():
    return replace(load_profile('plain'), mount='rig', axis='roll')


@pytest.fixture(scope='module')
def proposal(model, profile):
    body, firmware = profile.airframe, profile.firmware
    m = model(
        gain=float(axis_gains(body)[0]), lag=body.motors.lag_s,
        delay=firmware.delay_cycles / firmware.rate_hz, damping=body.mounts.rig.damping_per_s[0])
    return propose_lqr(replace(m, gyro_filter_hz=profile.sensors.gyro_filter_hz))


def square(profile, gains):
    wave = TURNING.step * np.where((np.arange(8 * HALF) // HALF) % 2 == 0, 1.0, -1.0)
    flight = fly(profile, [Excited(3.0, wave)], 19.0, 5, gains=gains)
    return flight, (flight.attitude_setpoint - flight.true_angles)[750 + HALF :, 0]


def test_it_tracks_as_the_design_promises(profile, proposal):
    flown = [square(profile, gains)[1] for gains in (proposal.gains, {})]
    after, before = (float(np.sqrt(np.mean(error**2))) for error in flown)
    said = proposal.figures
    promised = said['rms_tracking_rad'] / said['rms_tracking_rad_before']
    assert after / before == pytest.approx(promised, abs=0.03)
    assert after < 0.9 * before


def test_the_firmware_forms_the_command_that_the_design_has_analysed(profile, proposal):
    gains = {**proposal.gains, 'roll.angle.rate_limit': 20.0, 'roll.rate.integrator_limit': 1.0}
    flight, _ = square(profile, gains)
    c = replace(proposal.controller, output_limit=0.3)
    own = np.zeros(c.size)
    own[1] = flight.rates[0, 0]
    for k in range(3000):
        error = flight.attitude_setpoint[k, 0] - flight.angles[k, 0]
        raw, own = c.command(own, flight.rates[k, 0], error)
        u = min(max(raw, -0.3), 0.3)
        assert flight.wrench[k, 1] == pytest.approx(u, abs=1e-6)
        own = c.moved(own, error, u, limited=abs(u) >= 0.3)


def test_it_comes_in_by_quarters_and_goes_out_without_a_jump(profile, proposal):
    """At rest under a standing torque no change of the share moves the angle by half a degree."""
    quiet = without_noise(profile)
    aircraft = Aircraft(quiet, seed=1)
    given = inputs(aircraft, [], 750)
    aircraft.run(inputs(aircraft, [], 5000))
    hardly = {'roll.lqr.share': 0.0, 'roll.lqr.k_integral': 1e-44}
    for change in (hardly, *({'roll.lqr.share': s} for s in (0.25, 0.5, 1.0, 0.5, 0.25, 0.0))):
        aircraft.set_gains({**proposal.gains, **change})
        angle = aircraft.run(given)[:, COLUMNS['true_angles']][:, 0]
        assert np.degrees(np.abs(angle)).max() < 0.5


def test_off_it_leaves_no_trace(profile, proposal):
    excited = [Excited(0.5, np.full(200, 0.1))]
    off = {**proposal.gains, 'roll.lqr.gain': 0.0, 'roll.lqr.share': 1.0}
    flights = [fly(profile, excited, 2.0, 2, gains=gains) for gains in ({}, off)]
    np.testing.assert_array_equal(*(flight.wrench for flight in flights))


def test_a_flight_under_it_is_no_flight_of_the_cascade(model):
    record = Record(
        source='flight', dt=0.004, rates=np.zeros((4, 3)), control=np.zeros((4, 4)),
        gains=(GainChange(0.0, {'roll.rate.kp': 0.07, 'pitch.rate.kp': 0.07}),
               GainChange(1.0, {'roll.lqr.share': 0.25})),
    )  # fmt: skip
    assert 'roll.rate.kp' in record.gains_at(0.5)
    assert set(record.gains_at(2.0)) == {'pitch.rate.kp', 'roll.lqr.share'}
    flown = replace(model(), active_gains=record.gains_at(2.0))
    assert 'set the share to 0 and fly again' in design(flown).refused_because
