"""The demo: the loop through real processes, a pseudo-terminal and real bags, an effect planted.

Bearing and flights are the test's own, in files that it writes; the twin, in which nothing may be
found, is in test_nodes_go_on.py. It flies in lockstep: every cycle is in the bag, however busy the
machine is. The firmware built for Linux flies, and with `make test-qemu` the ELF of the STM32.
"""

import json
import math
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from node_process import QUICKLY, python

from quad_sysid.bags import read_bag
from quad_tuning.demo.summary import flown_square
from quad_tuning.history import changed, read_history

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
       duration_s: 7.5, clock_s: 0.092, register_bits: 9, seed: 1}
    - {segment: idle, duration_s: 0.5}
    - {segment: validation, signal: prbs, axis: roll, injection: attitude, amplitude_deg: 12.0,
       duration_s: 3.5, clock_s: 0.092, register_bits: 8, seed: 2}
    - {segment: idle, duration_s: 0.5}
    - {segment: validation, signal: square, axis: roll, injection: attitude, amplitude_deg: 12.0,
       duration_s: 4.8, period_s: 2.4}
    - {segment: idle, duration_s: 0.5}
"""
LINES = SCHEDULE.splitlines()
AGAIN = '\n'.join([*LINES[:6], *LINES[-3:]])
"""Its square alone."""


NODE = f"""#!{sys.executable}
{QUICKLY}
from quad_sysid.result import Result
from quad_sysid.start_node import identification
save = Result.save
Result.save = lambda self, folder: save(self, folder, html=False, pictures=False)
identification()
"""
"""Without page and pictures, which test_nodes_go_on.py looks for."""


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


DEMO = """
import sys
from pathlib import Path
from quad_tuning.demo import main, processes
here, found = Path(sys.argv.pop(1)), processes.executable
main.HERE, main.get_package_share_directory = here, lambda _: here
processes.executable = lambda package, name: (
    here / name if name == 'identification' else found(package, name))
sys.exit(main.main())
"""
"""Its files, and the node that identifies, are those of a folder."""


@pytest.mark.timeout(1800)
@pytest.mark.usefixtures('workspace')
def test_an_effect_is_flown_found_and_flown_against(tmp_path: Path, emulated: bool) -> None:
    here, out = tmp_path / 'here', tmp_path / 'out'
    (here / 'config').mkdir(parents=True)
    for name, text in {'friction_bearing.py': MODULE, 'config/schedule_demo.yaml': SCHEDULE,
                       'second_flight.yaml': AGAIN, 'identification': NODE}.items():
        (here / name).write_text(text)
    (here / 'identification').chmod(0o755)
    demo = python('-c', DEMO, here, '--out', out, '--seed', '11', '--lockstep',
                  *['--qemu'] * emulated, timeout=None)
    assert demo.returncode == 0, demo.stderr + demo.stdout
    bags = sorted(out.glob('flight_*/'))
    # the bag holds every topic and every cycle
    record = read_bag(bags[0])
    assert record.missing == ()
    assert record.dt == pytest.approx(0.004, rel=1e-9)
    assert not np.isnan(record.rates).any()
    parts = [s for s in record.segments if s.role != 'idle']
    assert [s.signal for s in parts] == ['prbs', 'prbs', 'square']
    assert [s.end_s - s.start_s for s in parts] == pytest.approx([7.5, 3.5, 4.8], abs=0.005)
    assert parts[0].parameters['amplitude'] == pytest.approx(math.radians(12.0), abs=1e-4)
    sent = record.excitation[slice(*record.span(parts[0]))]
    assert np.nanmax(np.abs(sent[:, 0])) == pytest.approx(math.radians(12.0), abs=1e-4)
    assert not np.nan_to_num(sent[:, 1:]).any()
    # the effect is found and worth it
    roll = json.loads((out / 'report/report.json').read_text())['axes']['roll']
    assert roll['verdict'] == 'effects_added'
    assert [effect['name'] for effect in roll['effects']] == ['coulomb_friction']
    torque = {p['name']: p['value'] for p in roll['effects'][0]['parameters']}['torque']
    assert torque == pytest.approx(FRICTION_NM / INERTIA, rel=0.1)
    assert roll['error']['after'] < 0.3 * roll['error']['before']
    # the gains reach the aircraft
    (history,) = (out / 'aircraft').glob('*/gains.jsonl')
    sets = read_history(history)
    assert roll['gains']
    assert changed(sets[0].gains, roll['gains'])
    assert changed(sets[-1].gains, roll['gains']) == {}
    # and it flies better with them
    first, second = (flown_square(bag, 'roll').figures for bag in bags)
    assert second.rms_error_rad < 0.9 * first.rms_error_rad
    assert second.rise_time_s < 0.7 * first.rise_time_s
    # and that is what is said
    said, angle = ' '.join(demo.stdout.split()), 'roll.angle.kp'
    old, new = (math.degrees(one.rms_error_rad) for one in (first, second))
    before, after = (roll['error'][when] for when in ('before', 'after'))
    for line in (f'torque {torque:.4g} rad/s²', f'RMS tracking error, deg {old:.2f} {new:.2f}',
                 f'{angle} {sets[0].gains[angle]:.4g} {sets[-1].gains[angle]:.4g} 1/s',
                 f'held-out: {before:.4f} before, {after:.4f} after ({after / before:.2f})'):
        assert line in said, demo.stdout
    assert (out / 'square_wave.png').exists()
