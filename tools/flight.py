"""Two flights of the demo's aircraft as bags, without ROS and in seconds: `make flight`.

The simulated rig has one free axis, roll, whose bearing sticks and slips; a PRBS trains, then one
validates. `my_flight` is to be identified, `another_flight` to judge the model by.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from quad_bridge.virtual.flight_bag import write_bag
from quad_bridge.virtual.simulation import Excited, fly
from quad_tuning.demo.friction_bearing import effect

NAMES = ('my_flight', 'another_flight')


def levels(seconds: float, seed: int) -> np.ndarray:
    """Random steps of the roll reference between ±10 degrees, rad, 0.1 s each, at 250 Hz."""
    rng = np.random.default_rng(seed)
    return np.repeat(rng.choice([-0.175, 0.175], round(seconds / 0.1)), 25)


def main(folder: Path) -> int:
    """Write both bags into the folder, which may not hold them yet."""
    taken = [name for name in NAMES if (folder / name).exists()]
    if taken:
        sys.stderr.write(f'{folder / taken[0]}: is there already; move it away\n')
        return 2
    for seed, name in enumerate(NAMES):
        schedule = [Excited(1.0, levels(30.0, 2 * seed)),
                    Excited(32.0, levels(15.0, 2 * seed + 1), role='validation')]
        path = write_bag(fly('demo_rig', schedule, 48.0, seed, effect=effect), folder / name)
        sys.stdout.write(f'{path}\n')
    sys.stdout.write(f'now: quad-sysid identify {folder / NAMES[0]} --axis roll\n')
    return 0


if __name__ == '__main__':
    sys.exit(main(Path(*sys.argv[1:])))
