"""A fleet in words: `Fleet`, with lines for a terminal of 80 columns, and fleet.html."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime, timezone
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from quad_sysid.axes import EVERY
from quad_sysid.fleets.drift import LEAST_FLIGHTS, LEVEL
from quad_sysid.fleets.summary import Quantity, Summary
from quad_sysid.report.canvas import AFTER, BEFORE, MUTED, Picture, finish, panels, svg
from quad_sysid.report.style import document
from quad_sysid.report.tables import Table, wrapped
from quad_sysid.report.words import chance, named, number

if TYPE_CHECKING:
    from quad_sysid.fleets.drift import Drift, Odd

MOST_ROWS, MOST_NAMES = 200, 10
"""Rows of one table on the page, and bags without an answer that a terminal names."""
NO_NAME = 'all'


class Fleet(Summary):
    """Rows of bags, one each, what they say together, and how that is shown."""

    def only(self, since: str = '', group_by: str = '') -> Fleet:
        """The fleet from a day on, or grouped in another way."""
        return replace(self, since=since or self.since, group_by=group_by or self.group_by)

    def __str__(self) -> str:
        """The text that the command prints."""
        return '\n'.join(_lines(self))

    def page(self) -> str:
        """fleet.html: what is wrong first, then what every aircraft lacks and is."""
        return _page(self)


def date(days: float) -> str:
    """A day since the epoch as a date."""
    return datetime.fromtimestamp(days * 86_400.0, timezone.utc).strftime('%Y-%m-%d')


def drift_words(quantity: Quantity, drift: Drift) -> str:
    """One sentence: what, since when, how much."""
    unit = f' {quantity.unit}' if quantity.unit != '1' else ''
    verb = 'has grown' if drift.after > drift.before else 'has fallen'
    sudden = ', in one step' if drift.kind == 'step' else ''
    span = ' to '.join(dict.fromkeys(map(date, drift.between)))
    return (f'{drift.aircraft or NO_NAME}, {quantity.axis}: {quantity.name} {verb} from '
            f'{number(drift.before)} to {number(drift.after)}{unit} (± {number(drift.std, 2)}) '
            f'since the flight of {date(drift.since)}{sudden}; it began after {span}, '
            f'p {chance(drift.p_value)}')


def odd_words(bag: str, reasons: Sequence[tuple[Quantity, Odd]]) -> str:
    """One sentence: which flight, and what about it is odd."""
    parts = [f'{q.axis} {q.name} {number(o.value)} where {number(o.expected)} ± '
            f'{number(o.std, 2)} {q.unit if q.unit != "1" else ""}'.rstrip()
            + ' is expected' for q, o in reasons[:3]]
    more = f', and {len(reasons) - 3} more' if len(reasons) > 3 else ''
    return f'{bag}: {"; ".join(parts)}{more}'


def _lines(fleet: Summary) -> list[str]:
    lacks, means, _ = _tables(fleet)
    drifts = [drift_words(*pair) for pair in fleet.drifts]
    odd = [odd_words(bag, why) for bag, why in fleet.odd.items()]
    out = wrapped(_counts(fleet), '')
    for title, sentences in (('what drifts', drifts), ('odd flights', odd)):
        if sentences:
            out += ['', title, *(line for sentence in sentences
                                 for line in wrapped(sentence, '    ', '  '))]
    if not drifts and not odd:
        out += ['', *wrapped(_nothing(fleet), '')]
    for table in (lacks, means):
        if table.rows:
            # a terminal has room for these columns of the means
            out += ['', *table.text((0, 1, 3, 5, 6, 7) if table is means else None)]
    if fleet.unanswered:
        names, more = [bag for bag, _ in fleet.unanswered[:MOST_NAMES]], ''
        if len(fleet.unanswered) > MOST_NAMES:
            more = f' and {len(fleet.unanswered) - MOST_NAMES} more'
        out += ['', *wrapped(f'without an answer: {", ".join(names)}{more}; the table has the '
                             'reasons', '  ', '')]
    return out


def _nothing(fleet: Summary) -> str:
    tested = sum(len(q.statistics.drifts) for q in fleet.quantities)
    if not tested:
        return (f'Nothing is said of drift: that needs {LEAST_FLIGHTS} answered flights of an '
                'aircraft at different times.')
    return (f'Nothing drifts and no flight is odd, at a level of {LEVEL:.0%} over {tested} '
            'parameters of aircraft together.')


def _counts(fleet: Summary) -> str:
    if not fleet.flights:
        return f'No flight since {fleet.since}.' if fleet.since else 'No bag is done yet.'
    craft = len({row['aircraft'] for row in fleet.flights} - {''}) or 1
    counts = ', '.join(f'{count} {name.replace("_", " ")}' for name, count in fleet.counts.items())
    since = f' since {fleet.since}' if fleet.since else ''
    return f'{len(fleet.flights)} bags of {craft} aircraft{since}: {counts}.'


def _tables(fleet: Summary) -> tuple[Table, Table, Table]:
    """Who lacks what, the means over aircraft, the bags without an answer."""
    means = [[q.axis, q.name, q.unit, str(len(m.levels)), str(sum(v.flights for v in m.levels)),
              number(m.mean, 4), f'{number(m.low)} … {number(m.high)}', number(m.between, 2),
              number(m.within, 2)]
             for q in fleet.quantities for m in (q.statistics.mean,)]
    return (
        Table(['aircraft', 'axis', 'effect', 'found in', 'of flights'],
              [[craft or NO_NAME, axis, effect, str(n), str(of)]
               for craft, axis, effect, n, of in fleet.lacks], (3, 4)),
        Table(['axis', 'parameter', 'unit', 'aircraft', 'flights', 'mean', '95 %', 'between',
               'within'], means, (3, 4, 5, 7, 8),
              caption='Mean over aircraft with its interval; standard deviations between aircraft '
              "and between flights of one, beside the estimates' errors."),
        Table(['bag', 'because'], [list(pair) for pair in fleet.unanswered[:MOST_ROWS]]),
    )


def _page(fleet: Summary) -> str:
    title = f'Fleet {fleet.title or "fleet"}'
    lacks, means, failures = _tables(fleet)
    drifts, odd = fleet.drifts, fleet.odd
    sentences = [*(drift_words(*pair) for pair in drifts),
            *(f'Odd: {odd_words(bag, why)}' for bag, why in odd.items())]
    effects = {name: named({'name': name}) for *_, name, _, _ in fleet.lacks}
    words = '; '.join(f'{name}: {text}' for name, text in sorted(effects.items()))
    drawn = ''.join(_figure(q, d.aircraft, d) for q, d in drifts[:MOST_ROWS // 10])
    answer = ''.join(f'<p>{escape(line)}</p>' for line in sentences or [_nothing(fleet)])
    over_time = ''.join(_figure(q) for q in _drawn(fleet))
    levels = Table(
        ['aircraft', 'axis', 'parameter', 'flights', 'mean', 'std. error'],
        [[level.aircraft or NO_NAME, q.axis, q.name, str(level.flights), number(level.mean, 4),
          number(level.std, 2)] for q in fleet.quantities for level in q.statistics.mean.levels],
        (3, 4, 5))
    sections = [
        ('What drifts', f'<div class="figures">{drawn}</div>' if drawn else ''),
        ('Who lacks what', lacks.html() and f'{lacks.html()}<p class="small">{escape(words)}</p>'),
        ('Over aircraft', means.html()),
        ('Over time', f'<div class="figures">{over_time}</div>' if over_time else ''),
        ('Each aircraft', f'<details><summary>{len(levels.rows)} means</summary>'
         f'{levels.html()}</details>' if levels.rows else ''),
        ('Without an answer', failures.html()),
    ]
    return document(
        title, f'<h1>{escape(title)}</h1><p>{escape(_counts(fleet))}</p>',
        f'<section class="answer {"open" if sentences else "good"}">{answer}</section>',
        *(f'<section><h2>{name}</h2>{text}</section>' for name, text in sections if text))


def _drawn(fleet: Summary) -> list[Quantity]:
    """The quantities that are drawn for the whole fleet, each with two flights at least."""
    return sorted((q for q in fleet.quantities if sum(len(s.values) for s in q.series) > 1),
                  key=lambda q: ([*EVERY].index(q.axis), '.' in q.name))


def _figure(quantity: Quantity, aircraft: str | None = None, drift: Drift | None = None) -> str:
    """A quantity over time, of the fleet or of one aircraft with its drift."""
    some = [s for s in quantity.series if aircraft is None or s.aircraft == aircraft]
    days, values, stds = (np.concatenate([getattr(s, name) for s in some])
                          for name in ('days', 'values', 'stds'))
    every = max(1, len(days) // 2000)
    start = float(days.min())
    figure, (axes,) = panels(height_in=2.0)
    axes.errorbar(days[::every] - start, values[::every], 1.96 * stds[::every], color=AFTER,
                  marker='o', ms=3, lw=0, elinewidth=0.7, alpha=0.7, label='flights')
    if drift is None:
        mean = quantity.statistics.mean
        axes.axhspan(mean.low, mean.high, color=MUTED, alpha=0.25, lw=0, label='mean, 95 %')
    else:
        last = float(days.max()) - start
        knee = [0.0, drift.since - start, *([drift.since - start] if drift.kind == 'step' else []),
                last]
        level = [drift.before, drift.before, *([drift.after] if drift.kind == 'step' else []),
                 drift.after]
        axes.plot(knee, level, color=BEFORE, lw=1.2, label='drift')
    unit = f', {quantity.unit}' if quantity.unit != '1' else ''
    finish([axes], f'days since {date(start)}', f'{quantity.name}{unit}')
    craft = f'{aircraft or NO_NAME}, ' if aircraft is not None else ''
    picture = Picture(f'{quantity.name}-{aircraft or "fleet"}', f'{craft}{quantity.axis} '
                      f'{quantity.name}', 'Estimates with 95 % bars.', figure)
    return (f'<figure><h4>{escape(picture.title)}</h4>{svg(picture, quantity.axis)}'
            f'<figcaption>{escape(picture.caption)}</figcaption></figure>')
