"""The same aircraft flown twice, other excitation and other noise: does the answer come again?

Named effects, pairs and effects from outside the project, an aircraft each. Where something is
claimed in a flight, the other one should say it too; `probability` and `reproducible` promise how
often.

    python bench/effects_twice.py --plants 60 --out bench/out
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import sys
from collections.abc import Iterator
from concurrent.futures import as_completed
from dataclasses import replace
from pathlib import Path
from typing import Any

import effects_scenarios as scenarios
import outside
import workers
from effects_answer import searched
from threadpoolctl import threadpool_limits

from quad_sysid.effects import EFFECTS
from quad_sysid.pipeline.assemble import axis_model
from quad_sysid.record import Record

FIRST_SEED = 52_000
AGAIN = 400_000
"""What the second flight adds to the seed."""
Plant = scenarios.Scenario | outside.Case


def plants(count: int, first: int = FIRST_SEED) -> list[Plant]:
    """Up to `count` plants, alternating between the kinds; other aircraft with another seed."""
    drawn = scenarios.draw(first, seeds=4, pairs=2, nothing=0, undeclared=0)
    kinds: list[list[Plant]] = [
        [one for one in drawn if one.kind == 'named' and one.simulator == 'virtual'],
        [one for one in drawn if one.kind == 'pair'],
        [replace(one, seed=one.seed + first - FIRST_SEED) for one in outside.cases('', 0.3)
         if one.strength == outside.STRENGTHS[1]],
    ]
    spread = [one[:: max(1, len(one) * len(kinds) // count)] for one in kinds]
    mixed = itertools.chain.from_iterable(itertools.zip_longest(*spread))
    return [one for one in mixed if one is not None][:count]


def flown(plant: Plant, seed: int) -> tuple[Record, str]:
    """A flight with the seed, and its axis."""
    own = replace(plant, seed=seed)
    if isinstance(own, outside.Case):
        axis = outside.simulator.AXES[own.axis]
        return outside.record_of(own.flown(unseen=False), axis), axis
    return scenarios.flown(own, unseen=False), own.axis


def answered(plant: Plant) -> dict[str, Any]:
    """The answers to two flights of one plant."""
    both = []
    with threadpool_limits(limits=1):
        for seed in (plant.seed, plant.seed + AGAIN):
            record, axis = flown(plant, seed)
            found = searched(record, axis, EFFECTS)
            model = axis_model(found, {}, None)
            both.append({
                'verdict': found.verdict.verdict,
                'claims': [[e.name, e.probability, e.explains_pct,
                            found.ladder.reproducible.get(e.name)] for e in model.effects],
                'before': found.verdict.before, 'after': found.verdict.after,
            })
    name = plant.effect if isinstance(plant, outside.Case) else ' + '.join(plant.planted)
    return {'plant': name, 'kind': 'outside' if isinstance(plant, outside.Case) else plant.kind,
            'seed': plant.seed, 'flights': both}


def answers(chosen: list[Plant], jobs: int) -> Iterator[dict[str, Any]]:
    """Answers for all plants, in the order in which they finish."""
    with workers.pool(jobs) as pool:
        for future in as_completed([pool.submit(answered, one) for one in chosen]):
            yield future.result()


def main() -> int:
    """Fly, answer, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--plants', type=int, default=60)
    parser.add_argument('--first-seed', type=int, default=FIRST_SEED)
    parser.add_argument('--jobs', type=int, default=os.cpu_count() or 1)
    parser.add_argument('--out', type=Path, default=Path('bench/out'), help='folder for rows')
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    with (options.out / 'twice.jsonl').open('w') as file:
        for row in answers(plants(options.plants, options.first_seed), options.jobs):
            file.write(json.dumps(row) + '\n')
            file.flush()
            said = ['+'.join(name for name, *_ in one['claims']) or '-' for one in row['flights']]
            print(f'{row["plant"]:34} {" | ".join(said)}', flush=True)
    return 0


if __name__ == '__main__':
    sys.exit(main())
