"""The tables of docs/results.md, from the rows that the benchmarks wrote: `make bench-results`.

What is published is copied from bench/out to bench/results. A table stands between
`<!-- name -->` and `<!-- end -->`; of a name without rows nothing changes. Nothing is flown here.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from effects_judge import SPOILED, extra, right
from intervals import WITHIN

ROWS = Path(__file__).parent / 'results'
PAGE = Path(__file__).parents[1] / 'docs' / 'results.md'
EDGES = (0.0, 0.5, 0.8, 0.95, 0.99, 1.01)
Row = dict[str, Any]


def rows_of(pattern: str) -> list[Row]:
    """Rows of all files of this name."""
    return [json.loads(line) for file in sorted(ROWS.glob(pattern))
            for line in file.read_text('utf-8').splitlines()]


def table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """As Markdown."""
    lines = [head, ['---'] * len(head), *rows]
    return '\n'.join('| ' + ' | '.join(str(cell) for cell in line) + ' |' for line in lines)


def share(holds: Sequence[bool]) -> str:
    """How many of how many."""
    return f'{sum(holds)} of {len(holds)}'


def named(rows: Sequence[Row]) -> str:
    """Effects of the list, pairs and flights with nothing missing (effects.py)."""
    kinds = {kind: [r for r in rows if r['kind'] == kind] for kind in ('named', 'pair', 'nothing')}
    closed = [(r['before'] - r['after']) / (r['before'] - r['true'])
              for r in rows if r['kind'] != 'nothing' and r['before'] > 1.05 * r['true']]
    return table(['', 'flights'], [
        ['right name on the first rung',
         share([r['named'][:1] == r['planted'] for r in kinds['named']])],
        ['an additional name', share([extra(r) for r in kinds['named']])],
        ['both names of a pair, no other',
         share([right(r) and not extra(r) for r in kinds['pair']])],
        ['nothing missing: an effect is named', share([bool(r['named'])
                                                       for r in kinds['nothing']])],
        ['part of the gap to the true structure that is closed, median',
         f'{np.median(closed):.2f}' if closed else '–'],
        ['made worse by 5 %',
         share([r['after'] > SPOILED * r['before'] for r in rows])],
        ['CPU time of a flight, median', f'{np.median([r["seconds"] for r in rows]):.0f} s'],
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
    """Effects from outside the project (outside.py)."""
    counted = [r for r in rows if r['counts']]
    return table(['flights that count', 'reported', 'half of the gap closed', 'made worse by 5 %',
                  'a wrong name'], [[
        len(counted), sum(r['verdict'] != 'no_missing_effect' for r in counted),
        sum(r['gap'] >= 0.5 for r in counted),
        sum(r['after'] > SPOILED * r['before'] for r in rows),
        sum(bool(r['wrong']) for r in counted),
    ]])


def twice(rows: Sequence[Row]) -> str:
    """Each aircraft flown twice (effects_twice.py)."""
    claims = [[[name for name, *_ in one['claims']] for one in r['flights']] for r in rows]
    spoke = [both for both in claims if any(both)]
    return table(['', 'flights'], [
        ['aircraft; those of which a flight claims something', f'{len(rows)}; {len(spoke)}'],
        ['the main cause is the same', share([a[:1] == b[:1] for a, b in spoke])],
        ['an effect that one flight claims is claimed in the other',
         share([name in b for pair in spoke for a, b in (pair, pair[::-1]) for name in a])],
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
    """What `probability` and `reproducible` promise, and how often the other flight agrees."""
    claims = [(p, again, name in {other for other, *_ in b['claims']})
              for r in rows for a, b in (r['flights'], r['flights'][::-1])
              for name, p, _, again in a['claims']]
    out = []
    for low, high in pairwise(EDGES):
        cells = []
        for which in (0, 1):
            inside = [one[2] for one in claims
                      if one[which] is not None and low <= one[which] < high]
            cells.append(share(inside) if inside else '–')
        out.append([f'{low:g} to {min(high, 1.0):g}', *cells])
    return table(['said', 'by `probability`, agreed', 'by `reproducible`, agreed'], out)


TABLES: dict[str, tuple[str, Callable[[Sequence[Row]], str]]] = {
    'named': ('rows*.jsonl', named), 'disturbances': ('hard_*.jsonl', disturbances),
    'outside': ('outside_*.jsonl', outside), 'twice': ('twice.jsonl', twice),
    'calibration': ('twice.jsonl', calibration), 'intervals': ('intervals.jsonl', intervals),
}
"""Name in the page → files of its rows, and how it is made."""


def _filled(new: str, place: re.Match[str]) -> str:
    return f'{place[1]}{new}{place[2]}'


def main() -> int:
    """Write what has rows into the page."""
    page = PAGE.read_text('utf-8')
    for name, (files, made) in TABLES.items():
        rows = rows_of(files)
        between = re.compile(f'(<!-- {name} -->\n).*?(<!-- end -->)', re.DOTALL)
        if rows:
            page = between.sub(partial(_filled, made(rows) + '\n'), page)
    PAGE.write_text(page, 'utf-8')
    return 0


if __name__ == '__main__':
    sys.exit(main())
