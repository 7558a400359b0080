"""The height mode's gains: designed in metres, admitted by the gate, better in flight."""

import dataclasses
import json

import numpy as np
import pytest
from virtual_aircraft import without_noise

from quad_bridge.errors import RefusedError
from quad_bridge.gains import gate
from quad_bridge.gains.table import DEFAULT_BOUNDS
from quad_bridge.virtual.profile import load_profile
from quad_bridge.virtual.receiver import Event, Receiver
from quad_bridge.virtual.simulation import Excited, fly
from quad_sysid.axes import THRUST
from quad_sysid.errors import BadInputError
from quad_sysid.loop.cascade import CascadeGains
from quad_sysid.loop.from_model import in_flight, loop_plant
from quad_sysid.loop.simulation import simulate_cascade
from quad_sysid.report.model_file import tree_of_models
from quad_sysid.result import sent_with
from quad_sysid.separation.design import nearest
from quad_tuning.bounds import within_thrust
from quad_tuning.cli import main
from quad_tuning.designer import design
from quad_tuning.errors import DesignRefusedError
from quad_tuning.exports import DESIGN, FIRMWARES, parameters
from quad_tuning.history import read_design
from quad_tuning.lqr import propose_lqr

CYCLE_S, HOVER = 0.004, 0.32


@pytest.fixture(scope='module')
def climb(model):
    """What identify finds of the virtual aircraft's climb, 62.5 times a second."""
    stds = {'gain': 0.03, 'lag': 0.0008, 'delay': 0.0007, 'damping': 0.001, 'bias': 0.01}
    found = model('climb', stds=stds, gain=30.75, lag=0.044, delay=0.009, damping=0.3, bias=-9.81)
    flown = found.active_gains | {'loop.rate_hz': 250.0, 'sensor.accel_filter_hz': 42.0}
    return dataclasses.replace(found, dt=0.016, gyro_filter_hz=None, units=THRUST,
                               active_gains=flown, mean_throttle=HOVER, mean_battery_v=None)


@pytest.mark.usefixtures('quick')
def test_a_design_of_the_climb_goes_from_the_model_to_the_gate(climb, tmp_path, printed):
    path, out = tmp_path / 'model.json', tmp_path / 'gains.json'
    path.write_text(json.dumps(tree_of_models({'climb': climb})))
    table = printed(main, 'design', path, '--axis', 'climb', '--out', out)
    assert 's²/m' in table
    assert not any('deg' in line for line in table.splitlines() if 'error' in line)
    answer = json.loads(out.read_text())['axes']['climb']
    said, gains = answer['figures'], answer['gains']
    assert set(gains) == {'climb.height.kp', *(f'climb.rate.k{x}' for x in 'pid')}
    assert said['crossover_rad_s'] <= 6.01
    assert said['rms_tracking_rad'] < 0.9 * said['rms_tracking_rad_before']
    assert said['disturbance_rms_rad'] < 0.5 * said['disturbance_rms_rad_before']
    active = climb.active_gains
    for step in answer['steps']:
        assert len(gate.steps(step, active, DEFAULT_BOUNDS)) == 1
        active = {**active, **step}
    asked = gate.read_request({**gains, **sent_with({'climb': said})})
    gate.check_flown(asked, climb.active_gains)
    assert asked.predicted['climb'].rate_rms_ratio >= 0.5
    with pytest.raises(RefusedError, match='the design began from'):
        gate.check_flown(asked, {**climb.active_gains, 'climb.rate.kp': 0.05})


def test_what_the_climb_cannot_have_is_refused_in_one_line(climb):
    low = dataclasses.replace(climb, mean_throttle=0.12)
    with pytest.raises(DesignRefusedError, match='too little is left to climb and sink by'):
        within_thrust(CascadeGains.default('climb'), low)
    with pytest.raises(DesignRefusedError, match='for roll, pitch and yaw; use --method pid'):
        propose_lqr(climb)
    with pytest.raises(BadInputError, match='hold none of roll, pitch, yaw'):
        parameters(FIRMWARES['px4'], {'climb.rate.kp': 0.1}, {})
    with pytest.raises(BadInputError, match='a flight is designed to separate effects of these'):
        nearest({'climb': climb})


def test_gains_of_an_outer_loop_are_not_sent(tmp_path):
    design = {'gains': {'surge.rate.kp': 0.2}, 'figures': {'surge.rate.kp_before': 0.1}}
    beside = {'gains': {'climb.rate.kp': 0.2}, 'figures': {'climb.rate.kp_before': 0.1}}
    path = tmp_path / 'gains.json'
    path.write_text(json.dumps({'schema': DESIGN, 'axes': {'surge': design, 'climb': beside}}))
    gains, also = read_design(path)
    assert gains == {'climb.rate.kp': 0.2}
    assert json.loads(also['flown']) == {'climb.rate.kp': 0.1}
    path.write_text(json.dumps({'schema': DESIGN, 'axes': {'surge': design}}))
    with pytest.raises(BadInputError, match='of an outer loop of your own only'):
        read_design(path)


def flown(gains):
    """The height mode: two seconds of climb by the stick, later 3 % less throttle; quiet sensors.

    A barometer without any noise says nothing new, and is taken for lost.
    """
    profile = without_noise(load_profile('hover'))
    script = [(1.0, 'throttle', HOVER), (2.0, 'aux4', 1.0), (10.0, 'throttle', 0.7),
              (12.0, 'throttle', HOVER)]  # fmt: skip
    profile = dataclasses.replace(
        profile, receiver=Receiver(tuple(Event(*row) for row in script)),
        sensors=dataclasses.replace(profile.sensors, pressure_noise_pa=0.1),
    )  # fmt: skip
    less = Excited(20.0, np.full(1500, -0.03), axis='climb', injection='control')
    return fly(profile, [less], 26.0, 3, gains=gains)


@pytest.mark.long
def test_the_designed_height_mode_flies_as_the_design_says_and_better(climb):
    """Firmware and physics against the model's loop, to 5 % of the largest and 2 mm."""
    proposal = design(climb)
    seen, plant = in_flight(climb), loop_plant(in_flight(climb))
    rises, sinks = [], []
    for new in ({}, proposal.steps[-1]):
        flight = flown(new)
        gains = CascadeGains.from_mapping({**seen.active_gains, **new}, 'climb')
        t, z, v = flight.time_s, flight.position_m[:, 2], flight.velocity_m_s[:, 2]
        sank = z[(t >= 20.0) & (t < 26.0)]
        said = simulate_cascade(plant, gains, np.zeros(sank.size), CYCLE_S,
                                disturbance=-plant.rest_acceleration,
                                control_excitation=np.full(sank.size, -0.03))
        largest = np.abs(said.angle).max()
        assert sank - sank[0] == pytest.approx(said.angle, abs=0.002 + 0.05 * largest)
        sinks.append(largest)
        rate = v[(t >= 10.0) & (t < 12.0)]
        said = simulate_cascade(plant, dataclasses.replace(gains, angle_kp=0.0),
                                np.zeros(rate.size), CYCLE_S, disturbance=-plant.rest_acceleration,
                                rate_excitation=np.full(rate.size, 0.5))
        assert rate == pytest.approx(said.rate, abs=0.05 * 0.5)
        rises.append(np.argmax(rate > 0.45) - np.argmax(rate > 0.05))
    assert rises[1] < rises[0] / 3
    assert sinks[1] < sinks[0] / 5
