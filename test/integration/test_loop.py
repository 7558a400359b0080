"""The loop through real processes, a pseudo-terminal and a real bag: one effect, and its twin.

The effect comes from a file that the test writes; the twin flies the plain profile, and nothing
may be found. Both fly in lockstep: every cycle is in the bag, however busy the machine is.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from campaign import campaign

from quad_sysid.bags import read_bag
from quad_tuning.demo.stages import close

INERTIA = 0.0135
"""Of the plain profile about roll, kg m²."""
GAIN = 4 * 9.218 * 0.225 / math.sqrt(2) / INERTIA
"""Of the plain profile: four motors of 9.218 N on arms of 0.225 m in X, rad/s² per command."""
FRICTION_NM = 0.008
MODULE = f"""
import math

def effect(t_s, rates, angles, thrusts, battery_v):
    return [-{FRICTION_NM} * math.tanh(rates[0] / 0.02), 0.0, 0.0]
"""
SCHEDULE = """
schedule:
  mount: rig
  ramp_s: 0.25
  segments:
    - {segment: idle, duration_s: 1.0}
    - {segment: train, signal: prbs, axis: roll, injection: attitude, amplitude_deg: 12.0,
       duration_s: 24.0, clock_s: 0.092, register_bits: 9, seed: 1}
    - {segment: idle, duration_s: 0.5}
    - {segment: validation, signal: prbs, axis: roll, injection: attitude, amplitude_deg: 12.0,
       duration_s: 8.5, clock_s: 0.092, register_bits: 8, seed: 2}
    - {segment: idle, duration_s: 0.5}
    - {segment: validation, signal: square, axis: roll, injection: attitude, amplitude_deg: 12.0,
       duration_s: 7.5, period_s: 3.0}
    - {segment: idle, duration_s: 0.5}
"""
WANTED = {
    'friction': {'module': MODULE, 'seed': 11, 'auto_update': True},
    'plain': {'seed': 12},
}
pytestmark = pytest.mark.timeout(1800)
EACH = [pytest.param(name, marks=pytest.mark.xdist_group(f'flight {name}')) for name in WANTED]
"""Tests that share a flight run in one process."""


@pytest.fixture(scope='session')
def flight(
    workspace: None, tmp_path_factory: pytest.TempPathFactory
) -> Callable[[str], SimpleNamespace]:
    """A campaign by its name, flown once; with its `record` and the `roll` of its report."""
    del workspace

    @cache
    def flown(name: str) -> SimpleNamespace:
        folder = tmp_path_factory.mktemp(f'loop_{name}')
        found = campaign(folder, schedule=SCHEDULE, identify=True, **WANTED[name])
        assert not found.failed
        found.record = read_bag(Path(found.bag))
        found.roll = json.loads(Path(found.report).read_text())['axes']['roll']
        found.before, found.after = dict(found.before), dict(found.after)
        return found

    return flown


@pytest.mark.parametrize('name', EACH)
def test_the_bag_holds_every_topic_and_every_cycle(flight, name):
    record = flight(name).record
    assert record.missing == ()
    assert record.dt == pytest.approx(0.004, rel=1e-9)
    assert not np.isnan(record.rates).any()
    signals = [s.signal for s in record.segments if s.role != 'idle']
    assert signals == ['prbs', 'prbs', 'square']


@pytest.mark.parametrize('name', EACH)
def test_the_base_is_the_plant(flight, name):
    values = {p['name']: p['value'] for p in flight(name).roll['base']['parameters']}
    tolerance = 0.03 if name == 'plain' else 0.15
    assert values['gain'] == pytest.approx(GAIN, rel=tolerance)
    assert values['lag'] + values['delay'] == pytest.approx(0.045 + 0.008, rel=2 * tolerance)


@pytest.mark.parametrize('name', EACH[:1])
def test_the_planted_effect_is_found_and_worth_it(flight, name):
    roll = flight(name).roll
    assert roll['verdict'] == 'effects_added'
    assert [effect['name'] for effect in roll['effects']] == ['coulomb_friction']
    torque = {p['name']: p['value'] for p in roll['effects'][0]['parameters']}['torque']
    assert torque == pytest.approx(FRICTION_NM / INERTIA, rel=0.1)
    assert roll['error']['after'] < 0.3 * roll['error']['before']


@pytest.mark.parametrize('name', EACH[:1])
def test_the_gains_reach_the_aircraft(flight, name):
    flown = flight(name)
    wanted = flown.roll['gains']
    assert wanted
    assert flown.updates == [f'identification of {flown.bag}']
    assert {k for k, value in wanted.items() if not close(flown.after[k], value)} == set()
    assert any(not close(flown.before[k], value) for k, value in wanted.items())


@pytest.mark.parametrize('name', EACH[1:])
def test_nothing_is_found_where_nothing_was_planted_and_no_gains_are_sent(flight, name):
    flown = flight(name)
    assert flown.roll['verdict'] == 'no_missing_effect'
    assert flown.roll['effects'] == []
    assert flown.roll['error']['after'] == flown.roll['error']['before']
    assert flown.updates == []  # auto_update is off
    assert flown.after == flown.before
