"""Which planted effect is named, how often nothing is, and what it buys: `make bench-effects`.

What was planted is sealed in a file before the flights; the analysis gets records alone, and the
judge opens the seal when the answers are written. The usual seeds were looked at during the
development; `--held-back`, or another `--first-seed`, draws flights apart from them, which are new
the first time only. The last line of the output is one JSON object.

    python bench/effects.py --seeds 4 --nothing 40 --out bench/out
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import as_completed
from pathlib import Path
from typing import Any

import effects_judge as judge_of
import effects_scenarios as scenarios
import workers
from effects_answer import answered, answered_by_command
from effects_picture import draw as draw_pictures

FIRST_SEED = 20_000
HELD_BACK_SEED = 70_000
"""Seeds of the flights that are kept until the end."""
BY_COMMAND = 3
"""Last digit of the numbers of flights that go through bag and command as well."""


def main() -> int:
    """Draw, seal, fly, answer, judge."""
    options = _options()
    folder = options.out
    folder.mkdir(parents=True, exist_ok=True)
    drawn = scenarios.draw(
        HELD_BACK_SEED if options.held_back else options.first_seed, seeds=options.seeds,
        pairs=options.pairs, nothing=options.nothing, undeclared=options.undeclared,
    )
    if options.only:
        drawn = [s for s in drawn if {s.kind, *s.planted} & set(options.only.split(','))]
    sealed = folder / 'sealed.jsonl'
    sealed.write_text(''.join(json.dumps(s.sealed()) + '\n' for s in drawn))
    answers = folder / 'answers.jsonl'
    with answers.open('w') as file:
        for row in _answers(drawn, options.jobs):
            file.write(json.dumps(row) + '\n')
            file.flush()
    rows = opened(sealed, answers)
    agree = _by_command(drawn, rows, folder / 'bags')
    (folder / 'rows.jsonl').write_text(''.join(json.dumps(row) + '\n' for row in rows))
    draw_pictures(rows, folder)
    print(judge_of.matrix(rows), judge_of.errors(rows), sep='\n\n')
    print('\nfactor (mean), right name alone, flights')
    for factor, share, count in judge_of.detection(rows):
        print(f'{factor:8.2f} {share:8.2f} {count:6d}')
    print('\nprobability said, share true, claims')
    for said, true, count in judge_of.reliability(rows):
        print(f'{said:8.2f} {true:8.2f} {count:6d}')
    print(f'\nthrough bag and command: {agree["same"]} of {agree["flights"]} as at array level')
    print(json.dumps({**judge_of.summary(rows), 'by_command': agree}))
    return 0


def _by_command(
    drawn: Sequence[scenarios.Scenario], rows: Sequence[judge_of.Row], folder: Path
) -> dict[str, Any]:
    """Every tenth flight of the virtual aircraft once more through a bag and the commands."""
    known = {row['number']: row for row in rows}
    tenth = [s for s in drawn if s.number % 10 == BY_COMMAND and s.simulator == 'virtual']
    same, seconds, apart = 0, [], []
    for scenario in tenth:
        with tempfile.TemporaryDirectory(dir=folder.parent) as work:
            row = answered_by_command(scenario, Path(work))
        array = known[scenario.number]
        agrees = (row['verdict'], row['named']) == (array['verdict'], array['named'])
        same += agrees
        seconds.append(row['seconds'])
        if not agrees:
            apart.append([scenario.number, row['verdict'], row['named'], array['named']])
    worst = max(seconds, default=None)
    return {'flights': len(tenth), 'same': same, 'seconds_worst': worst, 'apart': apart}


def opened(sealed: Path, answers: Path) -> list[judge_of.Row]:
    """Answers and sealed scenarios as rows, which thereby contain what was planted."""
    seals = {row['number']: row for row in map(json.loads, sealed.read_text().splitlines())}
    rows = [json.loads(line) for line in answers.read_text().splitlines()]
    return [{**seals[row['number']], **row} for row in sorted(rows, key=lambda r: r['number'])]


def _answers(
    drawn: Sequence[scenarios.Scenario], jobs: int
) -> Iterator[dict[str, Any]]:
    began = time.monotonic()
    with workers.pool(jobs) as pool:
        waiting = [pool.submit(answered, scenario) for scenario in drawn]
        for done, future in enumerate(as_completed(waiting), 1):
            row = future.result()
            left = (time.monotonic() - began) / done * (len(drawn) - done)
            print(
                f'\r{done}/{len(drawn)} flights, {left:.0f} s left ', end='', file=sys.stderr,
                flush=True,
            )
            yield row
    print(file=sys.stderr)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--seeds', type=int, default=8, help='flights per named effect')
    parser.add_argument('--pairs', type=int, default=2, help='flights per pair of effects')
    parser.add_argument('--nothing', type=int, default=200, help='flights with nothing missing')
    parser.add_argument('--undeclared', type=int, default=4, help='flights per invented effect')
    parser.add_argument('--first-seed', type=int, default=FIRST_SEED)
    parser.add_argument('--held-back', action='store_true', help='the seeds kept until the end')
    parser.add_argument('--only', default='', help='kinds or effects, with commas')
    parser.add_argument('--jobs', type=int, default=os.cpu_count() or 1)
    parser.add_argument('--out', type=Path, default=Path('bench/out'), help='folder for rows')
    return parser.parse_args()


if __name__ == '__main__':
    sys.exit(main())
