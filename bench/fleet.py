"""What a fleet costs beside its bags, what a second worker brings, and what its page says.

    python bench/fleet.py --bags 200                    overhead per bag: threads, then Dask
    python bench/fleet.py --bags 200 --work identify    the same bag again and again, no effects
    python bench/fleet.py --drift --effects             30 aircraft x 10 flights, with the search

CPU per bag is that of this process, which holds threads, scheduler and the results' files; wall
time means little where other work shares the cores. The flights of --drift are those of
the tests' plain simulation (test/flown_axis.py): the bearing of aircraft 7 wears from flight 5 on
(Coulomb friction), a motor of aircraft 11 weakens from the first; --nothing leaves both out.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'test'))
from fleet_work import answer
from flown_axis import Axis, Plan, fly

from quad_sysid.bags import write_bag
from quad_sysid.fleets import bag, engine
from quad_sysid.fleets.page import Fleet

PLAN = Plan(26.0, (('train', 'prbs', 0.0, 15.0), ('validation', 'prbs', 15.0, 26.0)))
AIRCRAFT, FLIGHTS, APART_DAYS = 30, 10, 20
BEARING, MOTOR = 7, 11


def overhead(bags: int, *, identify: bool) -> None:
    with tempfile.TemporaryDirectory() as room:
        flights = Path(room, 'flights')
        write_bag(fly(Axis(), 1, PLAN), Path(room, 'one'))
        for number in range(bags):
            if identify:
                shutil.copytree(Path(room, 'one'), flights / f'{number:04d}')
            else:
                flights.mkdir(exist_ok=True)
                (flights / f'{number:04d}.mcap').touch()
        for cluster in ('', 'local'):
            for workers in (1, 2):
                every = bag.jobs(flights, Path(room, f'out_{cluster}_{workers}'),
                                 search_effects=False)
                marks: list[tuple[float, float]] = []
                begun = time.monotonic()
                rows = engine.run(
                    every, workers, cluster, work=bag.look if identify else answer,
                    show=lambda _, m=marks: m.append((time.monotonic(), time.process_time())))
                wall, cpu = ((b - a) / (len(rows) - 1)
                             for a, b in zip(marks[0], marks[-2], strict=True))
                own, used = (sum(row.get(name, 0.0) for row in rows) / len(rows)
                             for name in ('seconds', 'cpu_s'))
                print(f'{cluster or "threads"}, {workers} workers: {1e3 * wall:.1f} ms a bag, '
                      f'{1e3 * cpu:.1f} ms of CPU here; its own work {1e3 * own:.1f} ms, '
                      f'{1e3 * used:.1f} ms of CPU; {marks[-2][0] - begun:.1f} s with the start',
                      flush=True)


def drift(seed: int, aircraft: int, *, nothing: bool, effects: bool) -> None:
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as room:
        for k in range(aircraft):
            gain, lag = 450.0 * (1.0 + 0.1 * rng.standard_normal()), 0.04 + 0.004 * rng.random()
            for i in range(FLIGHTS):
                worn = 0.0 if nothing or k != BEARING else 1.5 * max(0, i - 4)
                weak = 0.0 if nothing or k != MOTOR else 0.03 * i
                day = 1.0 + 0.01 * rng.standard_normal()
                axis = Axis(gain=gain * (1.0 - weak) * day, lag_s=lag,
                            torque=lambda _, rate, __, c=worn: -c * np.tanh(rate / 0.02))
                record = fly(axis, int(rng.integers(2**31)), PLAN)
                record = replace(record, t0_ns=record.t0_ns + i * APART_DAYS * 86_400 * 10**9)
                write_bag(record, Path(room, 'flights', f'craft_{k:02d}', f'{i}'))
        every = bag.jobs(Path(room, 'flights'), Path(room, 'out'), search_effects=effects)
        print(Fleet(engine.run(every, os.cpu_count() or 1, log=print)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0])
    parser.add_argument('--bags', type=int, default=200)
    parser.add_argument('--work', choices=('nothing', 'identify'), default='nothing')
    parser.add_argument('--drift', action='store_true')
    parser.add_argument('--nothing', action='store_true')
    parser.add_argument('--effects', action='store_true')
    parser.add_argument('--aircraft', type=int, default=AIRCRAFT)
    parser.add_argument('--seed', type=int, default=1)
    options = parser.parse_args()
    if options.drift:
        drift(options.seed, options.aircraft, nothing=options.nothing, effects=options.effects)
    else:
        overhead(options.bags, identify=options.work == 'identify')


if __name__ == '__main__':
    main()
