"""A demo in which something breaks ends with the reason, and leaves no process behind."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2 or its wheels')

from quad_tuning.demo.domain import own_domain
from quad_tuning.demo.errors import StageFailedError
from quad_tuning.demo.observer import Observer
from quad_tuning.demo.processes import Crew, executable
from quad_tuning.demo.stages import Aircraft, Campaign, connect, fly

SHORT = """
schedule:
  mount: rig
  segments:
    - {segment: train, signal: prbs, axis: roll, injection: attitude, amplitude_deg: 12.0,
       duration_s: 30.0, clock_s: 0.092, register_bits: 9, seed: 1}
"""
BREAKS = """
def effect(t_s, rates, angles, thrusts, battery_v):
    if t_s > 6.0:
        raise ZeroDivisionError('the bearing broke')
    return [0.0, 0.0, 0.0]
"""


@pytest.fixture(autouse=True)
def _built() -> None:
    try:
        executable('quad_bridge', 'virtual_stm32')
    except StageFailedError as missing:
        pytest.skip(f'needs the built workspace: {missing}')


def all_gone(crew: Crew) -> bool:
    """Whether no process group of the crew has a member left."""
    for child in crew.children.values():
        try:
            os.killpg(child.process.pid, 0)
        except ProcessLookupError:
            continue
        return False
    return True


def test_a_wrong_profile_is_named(tmp_path: Path) -> None:
    with own_domain() as domain, Crew(tmp_path, domain) as crew, Observer(domain) as observer:
        run = Campaign(crew, observer, lambda _: None)
        with pytest.raises(
            StageFailedError, match=r'virtual_stm32 ended with status 2: .*no_such'
        ):
            connect(run, Aircraft('no_such_profile', 'roll', 1))
    assert all_gone(crew)


def test_an_aircraft_that_dies_in_flight_ends_it_with_its_last_words(tmp_path: Path) -> None:
    module, schedule = tmp_path / 'breaks.py', tmp_path / 'schedule.yaml'
    module.write_text(BREAKS)
    schedule.write_text(SHORT)
    with own_domain() as domain, Crew(tmp_path, domain) as crew, Observer(domain) as observer:
        run = Campaign(crew, observer, lambda _: None)
        # On a busy host the aircraft may already break while the stages before the flight run.
        with pytest.raises(StageFailedError, match=r'ended with status .*the bearing broke'):
            _connect_and_fly(run, Aircraft('plain', 'roll', 1, effect_module=module), schedule)
    assert all_gone(crew)
    assert {'virtual_stm32', 'serial_bridge', 'bag_logger'} <= set(crew.cpu())


def _connect_and_fly(run: Campaign, aircraft: Aircraft, schedule: Path) -> None:
    connect(run, aircraft)
    fly(run, 'flight', schedule)
