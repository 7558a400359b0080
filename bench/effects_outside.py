"""Effects that people outside the project wrote: is half of what the truth gains found?

The plants of outside/, flown by a simulator of their own at two strengths and two levels of
noise. The gap is that between the base's error on a second flight and what the true equations
foresee of that flight from its commands alone, scaled by what the base reaches beside them where
the effect is off. Where the truth gains less than a factor of 1.5 there is little to find, and a
flight does not count.

    python bench/effects_outside.py --noise 0.3 --only cables --out bench/out
    python bench/effects_outside.py --noise 0.3 --sealed FILE --drawn 46
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Sequence
from concurrent.futures import as_completed
from pathlib import Path
from typing import Any

import workers
from effects_answer import searched
from effects_judge import SPOILED, UNNAMED, WORTH
from outside import SETS, Case, cases, record_of, simulator
from threadpoolctl import threadpool_limits

from quad_sysid.effects import EFFECTS
from quad_sysid.pipeline.assemble import axis_model
from quad_sysid.pipeline.evaluate import evaluate


def true_error(case: Case) -> float:
    """Error of the true equations on the second flight, in the units of the base's error there."""
    axis = simulator.AXES[case.axis]
    learnt, off = (case.flown(unseen=later, there=False) for later in (False, True))
    plain = axis_model(searched(record_of(learnt, axis), axis, ()), {}, None)
    beside = evaluate(plain, record_of(off, axis)).before / simulator.foreseen(off, case.axis)
    return simulator.foreseen(case.flown(unseen=True), case.axis) * beside


def answered(case: Case) -> dict[str, Any]:
    """The answer to one case, beside the truth."""
    axis = simulator.AXES[case.axis]
    with threadpool_limits(limits=1):
        found = searched(record_of(case.flown(unseen=False), axis), axis, EFFECTS)
        model = axis_model(found, {}, None)
        error = evaluate(model, record_of(case.flown(unseen=True), axis))
        true = true_error(case)
    wrong = [
        e.name for e in model.effects
        if e.probability > 0.5 and not e.name.startswith(UNNAMED)
        and e.name not in case.plant.may_be
    ]
    return {
        **vars(case), 'file': '', 'verdict': found.verdict.verdict, 'wrong': wrong,
        'rungs': [[*rung.labels] for rung in found.ladder.rungs], 'reference': error.reference,
        'effects': [[e.name, e.variant, e.probability] for e in model.effects],
        'before': error.before, 'after': error.after, 'true': true,
        'gap': (error.before - error.after) / (error.before - true),
        'counts': error.before >= WORTH * true,
    }


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, int]:
    """The figures of a row of bench/results/outside_sets.csv."""
    counted = [row for row in rows if row['counts']]
    return {
        'flights': len(rows), 'counted': len(counted),
        'half_of_the_gap': sum(row['gap'] >= 0.5 for row in counted),
        'silent': sum(row['verdict'] == 'no_missing_effect' for row in counted),
        'wrong_names': sum(bool(row['wrong']) for row in counted),
        'made_worse': sum(row['after'] > SPOILED * row['before'] for row in rows),
    }


def main() -> int:
    """Fly, answer, compare."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--only', choices=('', *SETS), default='', help='one of the sets')
    parser.add_argument('--noise', type=float, default=1.0, help='of gyro and gusts, a factor')
    parser.add_argument('--jobs', type=int, default=os.cpu_count() or 1)
    parser.add_argument('--out', type=Path, default=Path('bench/out'), help='folder for rows')
    parser.add_argument('--sealed', default='', metavar='FILE',
                        help='the plants of a set that nobody here has read')
    parser.add_argument('--drawn', type=int, metavar='SEED', help='one strength each')
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    rows = []
    name = Path(options.sealed).parent.name if options.sealed else options.only or 'all'
    path = options.out / f'outside_{name}_{options.noise:g}.jsonl'
    with (workers.pool(options.jobs) as pool,
          path.open('w') as file):
        waiting = [pool.submit(answered, case)
                   for case in cases(options.only, options.noise, options.sealed, options.drawn)]
        for future in as_completed(waiting):
            row = future.result()
            rows.append(row)
            file.write(json.dumps(row) + '\n')
            file.flush()
            said = ', '.join(f'{one} {variant} {p:.2f}' for one, variant, p in row['effects'])
            errors = ' '.join(f'{1e3 * row[key]:6.1f}' for key in ('before', 'after', 'true'))
            print(f'{row["effect"]:34} {row["strength"]} {errors} {100 * row["gap"]:5.0f} % '
                  f'{"" if row["counts"] else "does not count "}{row["verdict"]} {said}',
                  flush=True)
    print(json.dumps(summary(rows)))
    return 0


if __name__ == '__main__':
    sys.exit(main())
