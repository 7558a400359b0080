"""The tables of the pages of results, from the data in bench/results: `make bench-results`.

A table stands between `<!-- name -->` and `<!-- end -->` in docs/results.md or docs/results/. It
is computed from the rows that a benchmark wrote (`TABLES`; copy them from bench/out to
bench/results), or is `bench/results/name.csv` as it stands. A single figure stands in a sentence
between `<!-- name.column -->` and `<!-- end -->`. Where a name has no data nothing changes;
nothing is flown here.

    python bench/results.py --check       # fails where a page differs from its data
"""

from __future__ import annotations

import csv
import json
import re
import sys
from collections.abc import Callable, Sequence
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any

import effects_judge as judge
import numpy as np
from effects_judge import SPOILED, right
from intervals import WITHIN

ROWS = Path(__file__).parent / 'results'
DOCS = Path(__file__).parents[1] / 'docs'
PAGES = (DOCS / 'results.md', DOCS / 'what_is_missing.md',
         *sorted((DOCS / 'results').glob('*.md')))
PLACE = re.compile(r'(<!-- (\w+) -->\n)(.*?)(<!-- end -->)', re.DOTALL)
FIGURE = re.compile(r'(<!-- (\w+)\.(\w+) -->)(.*?)(<!-- end -->)')
"""One figure in a sentence: file and column of its first row."""
EDGES = (0.0, 0.5, 0.8, 0.95, 0.99, 1.01)
Row = dict[str, Any]


def rows_of(pattern: str) -> list[Row]:
    """Rows of all files of this name."""
    return [json.loads(line) for file in sorted(ROWS.glob(pattern))
            for line in file.read_text('utf-8').splitlines()]


def table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A Markdown table."""
    lines = [head, ['---'] * len(head), *rows]
    return '\n'.join('| ' + ' | '.join(str(cell) for cell in line) + ' |' for line in lines)


def share(holds: Sequence[bool]) -> str:
    """Words such as `3 of 4`."""
    return f'{sum(holds)} of {len(holds)}'


def listed(rows: Sequence[Row]) -> str:
    """The study of effects of the list and inventions beside its targets (effects.py)."""
    figures = judge.summary(rows)

    def of(name: str) -> str:
        return counted(figures[name]['share'], figures[name]['n'])

    def counted(part: float, count: int) -> str:
        return f'{round(part * count)} of {count}'

    return table(['', 'target', 'result'], [
        [f'right name, where the truth lowers the error by a factor of {judge.WORTH:g} or more',
         '98 %', of('named')],
        ['an additional name there', '1 %', of('named_extra')],
        ['both names of a pair on the first two rungs', '95 %', of('pairs_on_two_rungs')],
        ['both in the answer, which ends at 90 %', '', of('pairs')],
        *([f'nothing missing: {words}', target, f'{figures[name]} of {figures["nothing"]}']
          for words, target, name in (
              ('an effect is named', '2 %', 'nothing_effects_added'),
              ('`unexplained_residual`', '5 %', 'nothing_unexplained'))),
        ['part of the gap to the refitted true structure that is closed, median', '0.9',
         f'{figures["gap_closed_median"]:.2f}'],
        ['95 % intervals of the parameters of named effects that hold the truth but for its sign',
         '90 %', of('coverage_95')],
        ['inventions: not silent', '95 %',
         counted(figures['undeclared_not_silent'], figures['undeclared'])],
        ['inventions: gap closed, median', '0.5',
         f'{figures["undeclared_gap_closed_median"]:.2f}'],
        ['inventions: a wrong name, with a probability over 0.5', '3 %',
         counted(figures['undeclared_wrong_name'], figures['undeclared'])],
        ['error made worse by over 5 %', 'none',
         f'{len(figures["made_worse"])} of {figures["flights"]}'],
        ['Brier score of the probabilities, inventions included', '',
         f'{figures["brier"]:.3f}'],
    ])


def disturbances(rows: Sequence[Row]) -> str:
    """Flights with nothing missing, by what disturbs them (effects_hard.py)."""
    kinds = dict.fromkeys(r['kind'] for r in rows)
    return table(['disturbance', 'an effect is named', '`unexplained_residual`'], [
        [kind, share([bool(r['named']) for r in rows if r['kind'] == kind]),
         share([r['verdict'] == 'unexplained_residual' for r in rows if r['kind'] == kind])]
        for kind in kinds
    ])


def outside(rows: Sequence[Row]) -> str:
    """Effects from outside the project (effects_outside.py)."""
    counted = [r for r in rows if r['counts']]
    return table(['flights that count', 'reported', 'half of the gap closed', 'made worse by 5 %',
                  'a wrong name'], [[
        len(counted), sum(r['verdict'] != 'no_missing_effect' for r in counted),
        sum(r['gap'] >= 0.5 for r in counted),
        sum(r['after'] > SPOILED * r['before'] for r in rows),
        sum(bool(r['wrong']) for r in counted),
    ]])


def everyday(rows: Sequence[Row]) -> str:
    """Everyday faults, two sealed sets (effects_outside.py), judged by their writers' words.

    `right`: whether the claims hold what the writer accepts; `extra`: claims beside it.
    """
    out = []
    for opened in dict.fromkeys(r['opened'] for r in rows):
        own = [r for r in rows if r['opened'] == opened]
        counted = [r for r in own if r['counts']]
        out.append([opened, len(own), len(counted), share([r['gap'] >= 0.5 for r in counted]),
                    share([r['right'] for r in counted]),
                    share([bool(r['extra']) for r in counted]),
                    share([r['after'] > SPOILED * r['before'] for r in own])])
    return table(['set', 'flown', 'count', 'half of the gap closed', 'right by its writer',
                  'something beside it is claimed', 'made worse by 5 %'], out)


def everyday_effects(rows: Sequence[Row]) -> str:
    """Table of the everyday effects, one per row."""
    return table(['effect', 'strength', 'gap closed', 'answer', 'right by its writer'], [
        [r['effect'].replace('_', ' '), r['strength'],
         f'{100 * r["gap"]:.0f} %' if r['counts'] else '·',
         ', '.join(f'`{name}`' for name, *_ in r['effects']) or f'`{r["verdict"]}`',
         'yes' if r['right'] else 'no'] for r in rows])


def twice(rows: Sequence[Row]) -> str:
    """Each aircraft flown twice, by the kind of what is planted (effects_twice.py)."""
    lines: list[list[object]] = [
        ['aircraft'], ['those of which a flight claims something'], ['the main cause is the same'],
        ['an effect that one flight claims is claimed in the other']]
    for kind in ('named', 'pair', 'outside'):
        claims = [[[name for name, *_ in flight['claims']] for flight in r['flights']]
                  for r in rows if r['kind'] == kind]
        spoke = [both for both in claims if any(both)]
        for line, cell in zip(lines, (
            len(claims), len(spoke), share([a[:1] == b[:1] for a, b in spoke]),
            share([name in b for pair in spoke for a, b in (pair, pair[::-1]) for name in a]),
        ), strict=True):
            line.append(cell)
    return table(['', 'one of the list', 'two of them', 'from outside'], lines)


def demo(rows: Sequence[Row]) -> str:
    """The demo's first flight, other noise each time (demo.py)."""
    cause = 'coulomb_friction'
    sizes = [size for r in rows for size in r['torque']]
    return table(['', 'flights'], [
        [f'`{cause}` on the first rung', share([r['first_rung'][:1] == [cause] for r in rows])],
        [f'`{cause}` is claimed', share([cause in [c[0] for c in r['claims']] for r in rows])],
        ['anything else is claimed', share([any(c[0] != cause for c in r['claims'])
                                            for r in rows])],
        ['its size, rad/s²', f'{min(sizes):.3f} to {max(sizes):.3f}' if sizes else '–'],
        ['held-out error without it, with it, of the reference, mean, rad/s',
         ', '.join(f'{np.mean([r[key] for r in rows]):.4f}'
                   for key in ('before', 'after', 'reference'))],
        ['CPU time, median', f'{np.median([r["seconds"] for r in rows]):.0f} s'],
    ])


def intervals(rows: Sequence[Row]) -> str:
    """Gain, lag and damping within their 95 % intervals (intervals.py)."""
    out = []
    for rough in (False, True):
        own = [r for r in rows if r['rough'] == rough and r['verdict'] != 'cannot_tell']
        cells = []
        for name in own[0]['told']:
            away = [(r['told'][name][0] - r['truth'][name]) / r['told'][name][1] for r in own
                    if r['told'][name][1] is not None]
            cells.append(share([abs(one) < WITHIN for one in away]))
        out.append(['with friction and drag' if rough else 'bare', *cells])
    return table(['', 'gain', 'lag', 'damping', 'damping, with what is not named'], out)


def calibration(rows: Sequence[Row]) -> str:
    """Table of `probability` and `reproducible` against agreement between flights and truth.

    A plant without a name of the list counts for the agreement only.
    """
    claims = []
    for r in rows:
        planted = r['plant'].split(' + ') if r['kind'] in ('named', 'pair') else None
        for a, b in (r['flights'], r['flights'][::-1]):
            others = {other for other, *_ in b['claims']}
            claims += [((p, again), name in others, None if planted is None else name in planted)
                       for name, p, _, again in a['claims']]
    out = []
    for low, high in pairwise(EDGES):
        cells = []
        for which, held in ((0, 1), (0, 2), (1, 1), (1, 2)):
            inside = [one[held] for one in claims if one[held] is not None
                      and one[0][which] is not None and low <= one[0][which] < high]
            cells.append(share(inside) if inside else '–')
        out.append([f'{low:g} to {min(high, 1.0):g}', *cells])
    return table(['said', 'by `probability`, agreed', 'true', 'by `reproducible`, agreed', 'true'],
                 out)


SETS = ('set', 'noise', 'flights that count', 'something is reported (target 95 %)',
        'half of the gap closed (90 %)', 'made worse by 5 % (none)',
        'a wrong name with a probability over one half (3 %)')
FIGURES = ('counted', 'reported', 'half_of_the_gap', 'made_worse', 'wrong_names')


def sets() -> str:
    """Effects from outside the project, as their sets were opened, and sums of each two sets."""
    with (ROWS / 'outside_sets.csv').open(encoding='utf-8', newline='') as file:
        rows = list(csv.DictReader(file))
    cells = [[f'{r["set"]}: {r["physics"]} ({r["asked for"]})', r['noise'],
              *(r[key] for key in FIGURES)] for r in rows]
    for _, group in groupby(rows[2:], lambda r: int(r['set']) // 2):
        two = list(group)
        count, reported, half, worse, wrong = (sum(int(r[key]) for r in two) for key in FIGURES)
        cells.append([f'{two[0]["set"]} and {two[-1]["set"]} together', '', count, reported,
                      f'{half} ({100 * half / count:.0f} %)', worse,
                      f'{wrong} ({100 * wrong / count:.0f} %)'])
    return table(SETS, cells)


def ablation(rows: Sequence[Row]) -> str:
    """Groups of candidates left out of the search (effects_ablation.py)."""
    whole = {r['number']: r for r in rows if r.get('left_out') == ''}

    def closed(row: Row) -> float | None:
        before, true = (whole[row['number']].get(key) for key in ('before', 'true'))
        return None if true is None else (before - row['after']) / (before - true)

    def shown(each: Sequence[Row]) -> list[str]:
        gaps = [gap for gap in map(closed, each) if gap is not None]
        known = [r for r in each if r['kind'] in ('named', 'pair')]
        return [share([gap >= 0.5 for gap in gaps]) if gaps else '–',
                share([right(r) for r in known]) if known else '–',
                f'{sum(r["seconds"] for r in each):.0f}' if each else '–']

    out = []
    for group in (r for r in rows if 'group' in r):
        without = [r for r in rows if r.get('left_out') == group['group']]
        pairs = zip(shown([whole[r['number']] for r in without]), shown(without), strict=True)
        out.append([group['group'], f'{group["candidates"]}, {group["parameters"]}', len(without),
                    *(both[0] if both[0] == '–' else f'{both[0]}; {both[1]}' for both in pairs)])
    return table(['left out', 'candidates, parameters', f'stand in the answer of, of {len(whole)}',
                  'half of the gap closed, with; without', 'right names', 'CPU s'], out)


TABLES: dict[str, tuple[str, Callable[[Sequence[Row]], str]]] = {
    'named_effects': ('effects.jsonl', listed), 'disturbances': ('hard_*.jsonl', disturbances),
    'outside': ('outside_*.jsonl', outside), 'twice': ('twice.jsonl', twice),
    'calibration': ('twice.jsonl', calibration), 'ablation': ('ablation.jsonl', ablation),
    'everyday': ('everyday.jsonl', everyday),
    'everyday_effects': ('everyday.jsonl', everyday_effects),
    'intervals': ('intervals.jsonl', intervals), 'demo': ('demo.jsonl', demo),
}
"""Name in the page → files of its rows, and how it is made."""


def made(name: str) -> str | None:
    """The table of this name, None where it has no data."""
    if name == 'outside_sets':
        return sets()
    if name in TABLES:
        files, make = TABLES[name]
        rows = rows_of(files)
        return make(rows) if rows else None
    file = ROWS / f'{name}.csv'
    if not file.exists():
        return None
    with file.open(encoding='utf-8', newline='') as lines:
        head, *cells = csv.reader(lines)
    return table(head, cells)


def figure(name: str, column: str) -> str:
    """A column of the first row of a file."""
    with (ROWS / f'{name}.csv').open(encoding='utf-8', newline='') as lines:
        return next(csv.DictReader(lines))[column]


def filled(page: str) -> str:
    """The page with the tables and figures of today's data."""
    page = FIGURE.sub(lambda at: f'{at[1]}{figure(at[2], at[3])}{at[5]}', page)
    return PLACE.sub(
        lambda at: f'{at[1]}{new}\n{at[4]}' if (new := made(at[2])) else at[0], page)


def main() -> int:
    """Write what has data into the pages; `--check` compares only."""
    behind = []
    for path in PAGES:
        old = path.read_text('utf-8')
        new = filled(old)
        if new != old:
            behind.append(path.name)
            if '--check' not in sys.argv:
                path.write_text(new, 'utf-8')
    if '--check' in sys.argv and behind:
        print(f'{", ".join(behind)}: differs from bench/results; run make bench-results')
        return 1
    return 0


if __name__ == '__main__':
    sys.exit(main())
