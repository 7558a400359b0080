"""The first flight of `make demo` with other noise each time: is the cause the same every time?

The demo's aircraft, bearing and schedule, flown cycle by cycle as in lockstep but without ROS, so
that a flight takes seconds. The bearing holds fast, then slides more easily: `coulomb_friction`.

    python bench/demo.py --flights 8 --out bench/out
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from effects_answer import searched
from threadpoolctl import threadpool_limits
from virtual_flights import record_of

from quad_bridge.virtual.profile import load_profile
from quad_bridge.virtual.simulation import Excited, Flight, fly
from quad_sysid.effects import EFFECTS
from quad_sysid.excitation_settings import load_schedule
from quad_sysid.pipeline.assemble import axis_model
from quad_tuning.demo.friction_bearing import effect

SCHEDULE = Path(__file__).parents[1] / 'src/quad_sysid/config/schedule_demo.yaml'
AXIS = 'roll'
START_S = 2.0
"""When the excitation begins; the demo waits for stream and logger."""


def flown(seed: int) -> Flight:
    """The demo's first flight."""
    profile = replace(load_profile('plain'), mount='rig', axis=AXIS)
    schedule, planned = load_schedule(SCHEDULE), []
    cycle = 1.0 / profile.firmware.rate_hz
    for part, start in zip(schedule.parts, schedule.starts_s, strict=True):
        if part.role != 'idle':
            times = np.arange(round(part.duration_s / cycle)) * cycle
            planned.append(Excited(START_S + start, np.array([part.at(t) for t in times]),
                                   part.axis, part.injection, part.role, part.signal))
    return fly(profile, planned, START_S + schedule.duration_s, seed, effect=effect)


def answered(seed: int) -> dict[str, Any]:
    """The analysis' answer to one flight."""
    record = record_of(flown(seed))
    began = time.process_time()
    with threadpool_limits(limits=1):
        found = searched(record, AXIS, EFFECTS)
        model = axis_model(found, {}, None)
    rungs = found.ladder.rungs
    return {
        'seed': seed, 'verdict': found.verdict.verdict,
        'first_rung': [*rungs[1].labels] if len(rungs) > 1 else [],
        'claims': [[e.name, e.probability, e.explains_pct, found.ladder.reproducible.get(e.name)]
                   for e in model.effects],
        'torque': [p.value for e in model.effects for p in e.parameters if p.name == 'torque'],
        'before': found.verdict.before, 'after': found.verdict.after,
        'reference': found.verdict.reference, 'seconds': time.process_time() - began,
    }


def main() -> int:
    """Fly, answer, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--flights', type=int, default=20)
    parser.add_argument('--first', type=int, default=1, help='seed of the first one')
    parser.add_argument('--out', type=Path, default=Path('bench/out'), help='folder for rows')
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    first: Counter[str] = Counter()
    with (options.out / 'demo.jsonl').open('w') as file:
        for seed in range(options.first, options.first + options.flights):
            row = answered(seed)
            file.write(json.dumps(row) + '\n')
            file.flush()
            first[' and '.join(row['first_rung'][:1]) or 'nothing'] += 1
            print(seed, row['first_rung'], row['claims'], f'{row["seconds"]:.1f} s', flush=True)
    print('; '.join(f'{name} on the first rung: {count}' for name, count in first.most_common()))
    return 0


if __name__ == '__main__':
    sys.exit(main())
