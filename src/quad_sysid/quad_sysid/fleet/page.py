"""fleet.html: one self-contained page about a fleet, and the same in lines for a terminal."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape

import numpy as np

from quad_sysid.contract import AXES
from quad_sysid.fleet.row import ANSWERED, Row
from quad_sysid.fleet.summary import Summary
from quad_sysid.report.canvas import AFTER, MUTED, Picture, panels
from quad_sysid.report.html import SHEET
from quad_sysid.report.html import figure as figure_of
from quad_sysid.report.tables import Table
from quad_sysid.report.words import named, number

UNITS = {'gain': 'rad/s² per command', 'lag': 's', 'delay': 's', 'damping': '1/s',
         'bias': 'rad/s²'}
DRAWN = ('gain', 'lag', 'delay', 'damping')
MOST_FAILURES = 200
NO_NAME = 'all in one folder'


def page(summary: Summary, rows: Sequence[Row], title: str) -> str:
    """The page as text."""
    lacks, spreads, drifts, failures = _tables(summary)
    parts = [
        '<!doctype html><html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width,initial-scale=1">',
        f'<title>Fleet {escape(title)}</title><style>{SHEET}</style></head><body>',
        f'<h1>Fleet {escape(title)}</h1>', f'<p>{escape(_counts(summary))}</p>',
        _section('Who lacks what', lacks.html()
                 or '<p>No flight lacks anything that could be found.</p>'),
        _section('Spread of parameters', spreads.html() + _figures(rows)),
        _section('Drift over time', drifts.html()
                 or '<p>No drift beyond chance (four flights of an aircraft are needed).</p>'),
        _section('Without an answer', failures.html()) if failures.rows else '',
    ]
    return '\n'.join([*parts, '</body></html>\n'])


def lines(summary: Summary) -> list[str]:
    """For a terminal of 80 columns."""
    lacks, spreads, drifts, _ = _tables(summary)
    shown = (lacks.text((0, 1, 2, 4, 5)), spreads.text((0, 1, 3, 4, 5, 6, 7)),
             drifts.text((0, 1, 2, 3, 6, 7)))
    return [_counts(summary), *(line for part in shown if part for line in ('', *part))]


def _tables(summary: Summary) -> tuple[Table, Table, Table, Table]:
    """Who lacks what, the spread of parameters, their drift, and the bags without an answer."""
    return (
        Table(['aircraft', 'axis', 'effect', 'in words', 'found in', 'of flights'],
              [[lack.aircraft or NO_NAME, lack.axis, lack.effect, named(lack.effect),
                str(lack.found), str(lack.flights)] for lack in summary.lacks], (4, 5)),
        Table(['axis', 'parameter', 'unit', 'flights', 'median', '5 %', '95 %', 'spread, %',
               'far outside'],
              [[s.axis, s.parameter, UNITS[s.parameter], str(s.count), number(s.median, 4),
                number(s.low), number(s.high), _pct(s.relative_pct), ', '.join(s.outliers)]
               for s in summary.spreads], (3, 4, 5, 6, 7),
              caption='Spread: robust standard deviation over the median.'),
        Table(['aircraft', 'axis', 'parameter', 'flights', 'per day', '±', 'p', 'in all, %'],
              [[d.aircraft or NO_NAME, d.axis, d.parameter, str(d.flights), number(d.per_day),
                number(d.std), f'{d.p_value:.2g}', f'{d.relative_pct:+.1f}']
               for d in summary.drifts], (3, 4, 5, 6, 7)),
        Table(['bag', 'because'], [list(f) for f in summary.failures[:MOST_FAILURES]]),
    )


def _counts(summary: Summary) -> str:
    told = ', '.join(f'{count} {name.replace("_", " ")}' for name, count in
                     sorted(summary.counts.items()))
    craft = len([name for name in summary.aircraft if name]) or 1
    return f'{sum(summary.counts.values())} bags of {craft} aircraft: {told}.'


def _section(title: str, content: str) -> str:
    return f'<section><h2>{escape(title)}</h2>{content}</section>'


def _figures(rows: Sequence[Row]) -> str:
    """Each parameter over the flights' starts, by axis."""
    found = []
    for axis in AXES:
        names = [n for n in DRAWN if _points(rows, axis, n)[0].size > 1]
        if not names:
            continue
        figure, axes = panels(len(names), height_in=0.8 + 1.3 * len(names))
        for one, name in zip(axes, names, strict=True):
            days, values, spread = _points(rows, axis, name)
            one.errorbar(days, values, spread, color=AFTER, marker='o', ms=3, lw=0,
                         elinewidth=0.8, capsize=1.5)
            one.axhline(float(np.median(values)), color=MUTED, lw=0.8, ls=':')
            one.set_ylabel(f'{name}, {UNITS[name].replace(" per command", "")}')
        axes[-1].set_xlabel('days since the first flight, d')
        picture = Picture('fleet', f'{axis.capitalize()} over the flights',
                          'Estimates with 95 % bars; dotted: the median.', figure)
        found.append(figure_of(axis, picture))
    return f'<div class="figures">{"".join(found)}</div>' if found else ''


def _points(rows: Sequence[Row], axis: str, name: str) -> tuple[np.ndarray, ...]:
    """Days (n,), values (n,), half widths of 95 % (n,)."""
    known = [
        (float(row['start_ns']), float(row[f'{axis}_{name}']),
         1.96 * float(row[f'{axis}_{name}_std'] or 0.0))
        for row in rows
        if row['status'] == ANSWERED and row.get(f'{axis}_{name}') is not None
        and row.get('start_ns') is not None
    ]
    table_ = np.array(known, dtype=float).reshape(-1, 3)
    days = (table_[:, 0] - (table_[:, 0].min() if len(table_) else 0.0)) / 86_400e9
    return days, table_[:, 1], table_[:, 2]


def _pct(value: float) -> str:
    return '–' if math.isnan(value) else f'{value:.1f}'
