"""A campaign in which something breaks ends with the reason, and leaves no process behind."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from campaign import campaign

SHORT = """
schedule:
  mount: rig
  segments:
    - {segment: train, signal: prbs, axis: roll, injection: attitude, amplitude_deg: 12.0,
       duration_s: 30.0, clock_s: 0.092, register_bits: 9, seed: 1}
"""
BREAKS = """
def effect(t_s, rates, angles, thrusts, battery_v):
    if abs(rates[0]) > 0.3:
        raise ZeroDivisionError('the bearing broke')
    return [0.0, 0.0, 0.0]
"""


@pytest.mark.usefixtures('workspace')
@pytest.mark.parametrize(
    ('wanted', 'words', 'started'),
    [
        ({'profile': 'no_such_profile'}, r'connect: virtual_stm32 ended with status 2: .*no_such',
         {'virtual_stm32'}),
        ({'module': BREAKS}, r'flight: .*ended with status .*the bearing broke',
         {'virtual_stm32', 'serial_bridge', 'bag_logger', 'flight_excitation'}),
    ],
)
def test_it_ends_with_the_reason_and_leaves_nothing(
    tmp_path: Path, wanted: dict[str, str], words: str, started: set[str]
) -> None:
    found = campaign(tmp_path / 'run', schedule=SHORT, **wanted)
    assert re.match(words, found.failed), found.failed
    assert (set(found.processes), found.left) == (started, [])
