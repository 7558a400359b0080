"""Compile everything that numba compiles, so that no first use has to wait for it (make build).

A short simulated flight goes through every command that calculates. What the commands call is
compiled as they call it and stays in numba's cache; no list of functions is kept here. Nothing
that it finds matters.
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

import numpy as np
from flight import record_of

from quad_bridge.virtual.process import prepared
from quad_bridge.virtual.profile import Profile
from quad_bridge.virtual.simulation import Excited, fly
from quad_sysid.bags import write_bag
from quad_sysid.cli import main as quad_sysid
from quad_tuning.cli import main as quad_tune

TRAIN_S, VALIDATION_S = 12.0, 6.0


def excited(start_s: float, seconds: float, role: str, seed: int) -> Excited:
    """A random binary signal on the roll axis, as the excitation node adds it."""
    levels = np.random.default_rng(seed).choice([-0.2, 0.2], round(seconds / 0.1))
    samples = np.repeat(levels, 25)
    return Excited(start_s, samples, role=role)


def main() -> int:
    """Status 1 where a command failed; what it printed is on stdout."""
    with tempfile.TemporaryDirectory() as name:
        os.chdir(name)
        schedule = [
            excited(1.0, TRAIN_S, 'train', 1),
            excited(2.0 + TRAIN_S, VALIDATION_S, 'validation', 2),
        ]
        seconds = TRAIN_S + VALIDATION_S + 3.0
        write_bag(record_of(fly('demo_rig', schedule, seconds, 1)), Path('bag'))
        fly('demo_rig', [], 0.1, 1, effect=lambda *_: np.zeros(3))  # steps with a Python effect
        prepared(Profile(), seed=1)  # the process' own steps
        model, status = 'result/model.json', 0
        for command, *arguments in (
            (quad_sysid, 'identify', 'bag', '--axis', 'roll', '--out', 'result'),
            (quad_sysid, 'evaluate', model, 'bag'),
            (quad_tune, 'design', model),
            (quad_tune, 'design', model, '--method', 'lqr'),
        ):
            status |= command(arguments)
    return int(status != 0)


if __name__ == '__main__':
    sys.exit(main())
