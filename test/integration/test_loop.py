"""The loop through real processes, a pseudo-terminal and a real bag, with one effect planted.

The effect comes from a file that the test writes; the twin, in which nothing may be found, is in
test_nodes_go_on.py. It flies in lockstep: every cycle is in the bag, however busy the machine is.
The firmware built for Linux flies, and with `make test-qemu` the ELF of the STM32.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from campaign import campaign

from quad_sysid.bags import read_bag
from quad_tuning.demo.summary import flown_square
from quad_tuning.history import changed

INERTIA = 0.0135
"""Of the plain profile about roll, kg m²."""
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
       duration_s: 9.0, clock_s: 0.092, register_bits: 9, seed: 1}
    - {segment: idle, duration_s: 0.5}
    - {segment: validation, signal: prbs, axis: roll, injection: attitude, amplitude_deg: 12.0,
       duration_s: 4.0, clock_s: 0.092, register_bits: 8, seed: 2}
    - {segment: idle, duration_s: 0.5}
    - {segment: validation, signal: square, axis: roll, injection: attitude, amplitude_deg: 12.0,
       duration_s: 4.8, period_s: 2.4}
    - {segment: idle, duration_s: 0.5}
"""


AGAIN = """
schedule:
  mount: rig
  ramp_s: 0.25
  segments:
    - {segment: idle, duration_s: 1.0}
    - {segment: validation, signal: square, axis: roll, injection: attitude, amplitude_deg: 12.0,
       duration_s: 4.8, period_s: 2.4}
    - {segment: idle, duration_s: 0.5}
"""


@pytest.fixture(params=[False, pytest.param(True, marks=pytest.mark.qemu)], ids=['linux', 'stm32'])
def emulated(request, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> bool:
    """Whether the STM32's ELF flies in QEMU; then it is built."""
    if not request.param:
        return False
    for tool in ('qemu-system-arm', 'arm-none-eabi-gcc'):
        if shutil.which(tool) is None:
            pytest.skip(f'not installed: {tool}')
    built, source = tmp_path / 'elf', Path(__file__).resolve().parents[2] / 'firmware'
    command = ['make', '-s', '-C', source, f'BUILD={built}', f'PYTHON={sys.executable}']
    subprocess.run([*command, built / 'stm32f405.elf'], check=True)
    monkeypatch.setenv('QUAD_FIRMWARE', str(built))
    return True


@pytest.mark.timeout(1800)
@pytest.mark.usefixtures('workspace')
def test_an_effect_is_flown_found_and_flown_against(tmp_path: Path, emulated: bool) -> None:
    flown = campaign(tmp_path / 'loop', schedule=SCHEDULE, module=MODULE, seed=11, identify=True,
                     auto_update=True, again=AGAIN, qemu=emulated)
    assert not flown.failed
    # the bag holds every topic and every cycle
    record = read_bag(Path(flown.bag))
    assert record.missing == ()
    assert record.dt == pytest.approx(0.004, rel=1e-9)
    assert not np.isnan(record.rates).any()
    signals = [s.signal for s in record.segments if s.role != 'idle']
    assert signals == ['prbs', 'prbs', 'square']
    # the effect is found and worth it
    roll = json.loads(Path(flown.report).read_text())['axes']['roll']
    assert roll['verdict'] == 'effects_added'
    assert [effect['name'] for effect in roll['effects']] == ['coulomb_friction']
    torque = {p['name']: p['value'] for p in roll['effects'][0]['parameters']}['torque']
    assert torque == pytest.approx(FRICTION_NM / INERTIA, rel=0.1)
    assert roll['error']['after'] < 0.3 * roll['error']['before']
    # the gains reach the aircraft
    wanted, before, after = roll['gains'], dict(flown.before), dict(flown.after)
    assert wanted
    assert flown.update.startswith('sent')
    assert changed(after, wanted) == {}
    assert changed(before, wanted)
    # and it flies better with them
    first, second = (flown_square(Path(bag), 'roll').figures for bag in (flown.bag, flown.again))
    assert second.rms_error_rad < 0.9 * first.rms_error_rad
    assert second.rise_time_s < 0.7 * first.rise_time_s
