"""The judge of bench/effects.py: answers held against what was sealed, as tables and figures."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from effects_undeclared import UNDECLARED

from quad_sysid.model.identified import UNLISTED

WORTH = 1.5
"""Targets hold where the true structure lowers the error by this factor or more."""
SPOILED = 1.05
"""An answer that makes the error on the unseen flight larger by this factor is listed."""
UNNAMED = ('shape:', 'mode', 'event')

Row = Mapping[str, Any]


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """All figures of the study, over these rows."""
    worth = [r for r in rows if r['kind'] == 'named' and (r['factor'] or 0.0) >= WORTH]
    pairs = [r for r in rows if r['kind'] == 'pair' and (r['factor'] or 0.0) >= WORTH]
    none = [r for r in rows if r['kind'] == 'nothing']
    odd = [r for r in rows if r['kind'] == 'undeclared' and r['lost'] >= WORTH]
    known = [*worth, *pairs]
    gaps = [_gap(r) for r in known if r['before'] > 1.05 * r['true']]
    lies = [r for r in odd if wrong_names(r)]
    return {
        'flights': len(rows),
        'named': _share(worth, right),
        'named_extra': _share(worth, extra),
        'pairs': _share(pairs, right),
        'pairs_extra': _share(pairs, extra),
        'pairs_on_two_rungs': _share(pairs, on_two_rungs),
        'nothing': len(none),
        'nothing_effects_added': sum(r['verdict'] == 'effects_added' for r in none),
        'nothing_unexplained': sum(r['verdict'] == 'unexplained_residual' for r in none),
        'gap_closed_median': _median(gaps),
        'undeclared': len(odd),
        'undeclared_not_silent': _share(odd, _speaks)['share'],
        'undeclared_gap_closed_median': _median([_gap(r) for r in odd]),
        'undeclared_wrong_name': len(lies) / len(odd) if odd else None,
        'coverage_95': _coverage(known),
        'brier': _brier(rows),
        'made_worse': [r['number'] for r in rows if r['after'] > SPOILED * r['before']],
        'seconds_median': _median([r['seconds'] for r in rows]),
        'seconds_nothing_median': _median([r['seconds'] for r in none]),
        'seconds_worst': max(r['seconds'] for r in rows),
    }


def _speaks(row: Row) -> bool:
    return row['verdict'] != 'no_missing_effect'


def right(row: Row) -> bool:
    """All that was planted is named."""
    return set(row['planted']) <= set(row['named'])


def extra(row: Row) -> bool:
    """Something is named that was not planted."""
    return bool(set(row['named']) - set(row['planted']))


def on_two_rungs(row: Row) -> bool:
    """All that was planted stands on the ladder's first two rungs; the answer may end below."""
    return set(row['planted']) <= {name for rung in row['rungs'][:3] for name in rung}


def wrong_names(row: Row) -> list[str]:
    """Names of the table with a probability over 0.5 that are a lie for this invention."""
    return [
        name for name, p in zip(row['named'], row['probabilities'], strict=True)
        if p > 0.5 and name not in true_names(row) and not name.startswith(UNNAMED)
    ]


def true_names(row: Row) -> Sequence[str]:
    """Names of the table that are no lie: what was planted, or comes near an invention."""
    if row['kind'] == 'undeclared':
        return UNDECLARED[row['planted'][0]].may_be
    return row['planted']


def _gap(row: Row) -> float:
    return (row['before'] - row['after']) / (row['before'] - row['true'])


def _share(rows: Sequence[Row], holds) -> dict[str, Any]:
    count = sum(bool(holds(r)) for r in rows)
    return {'n': len(rows), 'share': count / len(rows) if rows else None}


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if len(values) else None


def _coverage(rows: Sequence[Row]) -> dict[str, Any]:
    inside = [ok for r in rows for ok in r['covered'].values()]
    return {'n': len(inside), 'share': float(np.mean(inside)) if inside else None}


def claims(rows: Sequence[Row]) -> np.ndarray:
    """(m, 2) stated probability of each name, and whether the flight has it (0 or 1).

    That physics is not on the list is true of every invention.
    """
    out = [
        (p, float(name in true_names(r) or (name == UNLISTED and r['kind'] == 'undeclared')))
        for r in rows for rivals in r['rivals'] for name, p in rivals
        if not name.startswith(UNNAMED) and name != 'nothing'
    ]
    return np.array(out).reshape(-1, 2)


def _brier(rows: Sequence[Row]) -> float | None:
    said = claims(rows)
    return float(np.mean((said[:, 0] - said[:, 1]) ** 2)) if said.size else None


def reliability(rows: Sequence[Row]) -> list[tuple[float, float, int]]:
    """Mean stated probability, share that was true, and number of claims, in five bins."""
    said = claims(rows)
    out = []
    for low, high in zip((0.0, 0.05, 0.3, 0.7, 0.95), (0.05, 0.3, 0.7, 0.95, 1.01), strict=True):
        inside = said[(said[:, 0] >= low) & (said[:, 0] < high)] if said.size else said
        if len(inside):
            out.append((float(inside[:, 0].mean()), float(inside[:, 1].mean()), len(inside)))
    return out


def matrix(rows: Sequence[Row]) -> str:
    """Planted against named, as text."""
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    for r in rows:
        counts[' + '.join(r['planted']) or 'nothing'][
            ' + '.join(r['named']) or str(r['verdict'])
        ] += 1
    lines = [f'{"planted":<40} {"n":>3}  answer']
    for name, answers in counts.items():
        lines += [f'{name:<40} {n:>3}  {answer}' for answer, n in answers.most_common()]
    return '\n'.join(lines)


def errors(rows: Sequence[Row]) -> str:
    """Median errors before, after and of the true structure, per planted effect."""
    groups: dict[str, list[Row]] = defaultdict(list)
    for r in rows:
        groups[' + '.join(r['planted']) or 'nothing'].append(r)
    lines = [f'{"planted":<40} {"n":>3}  {"before":>8} {"after":>8} {"true":>8}  mrad/s, medians']
    for name, group in groups.items():
        values = [
            _median([1e3 * r[key] for r in group if r[key] is not None])
            for key in ('before', 'after', 'true')
        ]
        shown = ' '.join(f'{v:8.2f}' if v is not None else f'{"-":>8}' for v in values)
        lines.append(f'{name:<40} {len(group):>3}  {shown}')
    return '\n'.join(lines)


def detection(rows: Sequence[Row]) -> list[tuple[float, float, int]]:
    """(geometric mean factor, share with the right name and no other, number) over factors."""
    edges = (1.0, 1.1, 1.2, 1.35, 1.5, 1.75, 2.0, 2.5, 3.5, 50.0)
    known = [r for r in rows if r['kind'] == 'named' and r['factor']]
    out = []
    for low, high in pairwise(edges):
        inside = [r for r in known if low <= r['factor'] < high]
        if inside:
            mean = math.exp(float(np.mean([math.log(r['factor']) for r in inside])))
            good = float(np.mean([right(r) and not extra(r) for r in inside]))
            out.append((mean, good, len(inside)))
    return out
