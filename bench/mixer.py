"""The firmware's mixer beside plain clipping of each motor, at hard manoeuvres in free flight.

`python bench/mixer.py`: a minute. The same firmware is built twice, once with `quad_mix` replaced
by what it was before: each motor clipped by itself, integrators not told. Sticks of two axes are
thrown at high, middle and low throttle, with gains that use what the motors have; what counts is
the largest error of the rate of the axis that nobody commands.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
CLIPPED = """bool quad_mix(const float control[4], float idle, float motors[4], float given[4])
{
    bool cut = false;
    for (size_t i = 0; i < 4; i++) {
        float sum = control[0];
        for (size_t k = 1; k < 4; k++) {
            sum += mixer[i][k] * control[k];
        }
        motors[i] = fmaxf(0.0f * idle, fminf(1.0f, sum));
        given[i] = control[i];
        cut = cut || motors[i] != sum;
    }
    return cut;
}
"""
SECONDS, SEED = 12.0, 4
STICK_DEG = 45.0
GAINS = {'roll.angle.kp': 8.0, 'pitch.angle.kp': 8.0, 'yaw.angle.kp': 4.0, 'roll.rate.kp': 0.13,
         'pitch.rate.kp': 0.13, 'yaw.rate.kp': 0.3, 'roll.rate.kd': 0.003, 'pitch.rate.kd': 0.003,
         **{f'{axis}.rate.output_limit': 0.5 for axis in ('roll', 'pitch', 'yaw')},
         **{f'{axis}.angle.rate_limit': 8.0 for axis in ('roll', 'pitch')}}  # fmt: skip
THROTTLES = (0.9, 0.55, 0.12)
THROWS = (('roll', 'yaw'), ('pitch', 'yaw'), ('roll', 'pitch'))


def build(folder: Path) -> Path:
    """The library with plain clipping; its folder."""
    copy = folder / 'firmware'
    shutil.copytree(ROOT / 'firmware', copy, ignore=shutil.ignore_patterns('*.elf', 'registers'))
    source = copy / 'quad_control.c'
    text, count = re.subn(r'bool quad_mix\(.*?\n}\n', lambda _: CLIPPED, source.read_text('utf-8'),
                          flags=re.DOTALL)  # fmt: skip
    if count != 1:
        sys.exit('bench/mixer.py: quad_mix was not found in quad_control.c')
    source.write_text(text, encoding='utf-8')
    xml = ROOT / 'src/quad_bridge/quad_bridge/wire/quad_suite.xml'
    command = ['make', '-s', '-C', str(copy), f'XML={xml}', 'build/libquad_firmware.so']
    subprocess.run(command, check=True)
    return copy / 'build'


def fly_all() -> list[dict[str, object]]:
    """Each throttle and pair of sticks: the largest error of the rate, deg/s, by axis."""
    from quad_bridge.virtual.profile import load_profile
    from quad_bridge.virtual.receiver import Event, Receiver
    from quad_bridge.virtual.simulation import fly

    profile, rows = load_profile('hover'), []
    firmware = replace(profile.firmware, stick_angle_deg=STICK_DEG)
    profile = replace(profile, firmware=firmware)
    for throttle in THROTTLES:
        for pair in THROWS:
            events = [Event(1.0, 'throttle', throttle)]
            for k in range(10):
                thrown = 0.9 if k % 2 == 0 else -0.9
                events += [Event(1.0 + k, name, thrown) for name in pair]
            script = replace(profile, receiver=Receiver(tuple(events)))
            flight = fly(script, [], SECONDS, SEED, gains=GAINS)
            late = flight.time_s > 1.0
            error = np.degrees(flight.true_rates - flight.rate_setpoint)[late]
            names = ('roll', 'pitch', 'yaw')
            rows.append({'throttle': throttle, 'thrown': list(pair),
                         'largest_deg_s': {n: float(np.abs(error[:, i]).max())
                                         for i, n in enumerate(names)},
                         'cut_share': float(np.mean(flight.limits[late].astype(int) & 1))})
    return rows


def child(folder: Path) -> list[dict[str, object]]:
    """The rows, computed in a process of its own with the library of this folder."""
    environment = {**os.environ, 'QUAD_FIRMWARE': str(folder)}
    command = [sys.executable, __file__, '--rows']
    run = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    return list(json.loads(run.stdout))


def main() -> None:
    """Print the table."""
    if '--rows' in sys.argv:
        print(json.dumps(fly_all()))
        return
    with tempfile.TemporaryDirectory() as folder:
        clipped = child(build(Path(folder)))
    ours = child(ROOT / 'firmware/build')
    print('| throttle | sticks thrown | axis nobody commands | clipping, deg/s | mixer, deg/s '
          '| cycles with a motor at its limit |')
    print('|---|---|---|---|---|---|')
    for old, new in zip(clipped, ours, strict=True):
        idle = next(n for n in ('roll', 'pitch', 'yaw') if n not in new['thrown'])
        print(f'| {new["throttle"]} | {" and ".join(new["thrown"])} | {idle} '
              f'| {old["largest_deg_s"][idle]:.0f} | {new["largest_deg_s"][idle]:.0f} '
              f'| {100 * new["cut_share"]:.0f} % |')


if __name__ == '__main__':
    main()
