"""Which candidates earn their place: groups of them left out of the search.

Flights are drawn once: effects from outside the project, effects of the list, pairs and measured
recordings. Each is answered with all candidates; without a group only where one of its candidates
stands in the reference or in the ladder, since elsewhere nothing can change but the prior.

    python bench/effects_ablation.py --flights 50 --out bench/out
"""

from __future__ import annotations

import argparse
import itertools
import json
import re
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import effects_scenarios as scenarios
import numpy as np
import outside
import real_recordings
from effects_answer import searched
from effects_outside import true_error
from threadpoolctl import threadpool_limits

from quad_sysid.bags import read_bag, split_segments
from quad_sysid.effects import EFFECTS
from quad_sysid.pipeline.assemble import axis_model
from quad_sysid.pipeline.evaluate import evaluate
from quad_sysid.pipeline.identify import Findings
from quad_sysid.record import Record

GROUPS = {
    'rough curves': r'rough',
    'curves of what a signal has lately been': r'memory curve',
    'surfaces over two signals': r'/with ',
    'damping, lag, delay, friction that wander; drifts': r'drift|(?<!gain:time)/wandering',
    'delays that repeat themselves, steps': r'shape:delay:time/(periodic|held)|/steps',
    'what the gyro shows of each motor': r'shown by the gyro',
    'motors that differ up and down, each or all': r'shape:lag:direction/(motor|axis)',
    'curves over other axes and, but for the gain, voltage; gain over angle, friction over angle '
    'and command': r'shape:(other_(rate|command)|other_angle/[sr]|battery|(damping|lag|delay):batt'
    r'|gain:angle|(angle|command)/\w+ friction)',
}
"""Name → its labels, as a regular expression; most of them went after commit 7621d87 was flown."""
FIRST_SEED, PERMUTED = 31_000, 5
REAL = ('flights/crazypad_weight_near_m3.csv', 'flights/lee_standard_1.csv',
        'flights/crazyflie_1khz_roll_pitch.csv', 'nanobench/B3_figure8_fast_rep1.csv.gz',
        'independent/flight', 'emps/DATA_EMPS.csv')
Row = dict[str, Any]


def flights() -> Iterator[scenarios.Scenario | outside.Case | str]:
    """All that may be flown, in the order in which they are."""
    drawn = [*scenarios.draw(FIRST_SEED, seeds=1, pairs=1, nothing=40, undeclared=0)]
    named = [s for s in drawn if s.kind == 'named' and s.simulator == 'virtual']
    pairs = [s for s in drawn if s.kind == 'pair']
    cases = outside.cases('', 0.3)
    cases = [cases[i] for i in np.random.default_rng(PERMUTED).permutation(len(cases))]
    for some in itertools.zip_longest(cases, named, pairs, REAL):
        yield from (one for one in some if one is not None)


def answered(flight: scenarios.Scenario | outside.Case | str, left_out: str,
             folder: Path) -> Row:
    """The answer to a flight without a group of candidates, '' for none."""
    effects = [e for e in EFFECTS if not (left_out and re.search(GROUPS[left_out], e.label))]
    if isinstance(flight, str):
        return _recorded(flight, effects, folder)
    if isinstance(flight, outside.Case):
        axis = outside.simulator.AXES[flight.axis]
        record = outside.record_of(flight.flown(unseen=False), axis)
        unseen = outside.record_of(flight.flown(unseen=True), axis)
        row = {'kind': 'outside', 'planted': [flight.effect], 'strength': flight.strength}
    else:
        axis, row = flight.axis, {'kind': flight.kind, 'planted': [*flight.planted]}
        record, unseen = (scenarios.flown(flight, unseen=later) for later in (False, True))
    begun = time.process_time()
    found = searched(record, axis, effects)
    seconds = time.process_time() - begun
    error = evaluate(axis_model(found, {}, None), unseen)
    return {**row, 'left_out': left_out, 'seconds': seconds, 'before': error.before,
            'after': error.after, 'reference': error.reference, **_said(found)}


def _recorded(name: str, effects: list[Any], folder: Path) -> Row:
    """The same of a measured recording, whose held-out part is the judge."""
    bag = folder / name.replace('/', '_')
    file = real_recordings.SHARED / name
    if file.is_dir():
        bag = file
    elif not bag.exists():
        real_recordings.imported(file, real_recordings.RECORDINGS[name], bag)
    record: Record = split_segments(read_bag(bag), axes=('roll',))
    begun = time.process_time()
    found = searched(record, 'roll', effects)
    seconds = time.process_time() - begun
    verdict = found.verdict
    return {'kind': 'recorded', 'planted': [name], 'seconds': seconds, 'before': verdict.before,
            'after': verdict.after, 'reference': verdict.reference, **_said(found)}


def _said(found: Findings) -> Row:
    model = axis_model(found, {}, None)
    return {'verdict': found.verdict.verdict, 'named': [e.name for e in model.effects],
            'probabilities': [e.probability for e in model.effects],
            'best': [*found.search.best.structure.labels],
            'rungs': [[(rung.labels or ('',))[-1], rung.explains_pct]
                      for rung in found.ladder.rungs]}


def featured(row: Row) -> list[str]:
    """The groups of which a candidate stands in the reference or in the ladder."""
    labels = {*row['best'], *(label for label, _ in row['rungs'])}
    return [name for name, own in GROUPS.items() if any(re.search(own, one) for one in labels)]


def main() -> int:
    """Fly with all candidates, then without each group that features."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--flights', type=int, default=50)
    parser.add_argument('--out', type=Path, default=Path('bench/out'), help='folder for rows')
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / 'ablation.jsonl'
    text = path.read_text() if path.exists() else ''
    known = {(row['number'], row['left_out']): row for row in map(json.loads, text.splitlines())}
    for number, flight in enumerate(itertools.islice(flights(), options.flights)):
        groups = ['']
        for left_out in groups:  # grows by the groups that feature
            row = known.get((number, left_out))
            if row is None:
                with threadpool_limits(limits=1):
                    row = {'number': number, **answered(flight, left_out, options.out)}
                    if isinstance(flight, outside.Case) and not left_out:
                        row['true'] = true_error(flight)
                with path.open('a') as file:
                    file.write(json.dumps({**row, 'left_out': left_out}) + '\n')
            groups += [] if left_out else featured(row)
            print(number, row['kind'], *row['planted'], '|', left_out or 'all', '|',
                  row['verdict'], *row['named'], f'{row["seconds"]:.0f} s', flush=True)
    return 0


if __name__ == '__main__':
    sys.exit(main())
