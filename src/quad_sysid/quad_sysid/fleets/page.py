"""`Fleet`: rows → what they say together, in lines for a terminal of 80 columns and as fleet.html.

Which values are compared is said here; how, in drift.py.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta, timezone
from functools import cached_property
from html import escape
from pathlib import PurePosixPath

import numpy as np

from quad_sysid.axes import EVERY, units_of
from quad_sysid.errors import BadInputError
from quad_sysid.fleets.bag import ANSWERED, BASE, CANNOT_TELL, FAILED, Row
from quad_sysid.fleets.drift import (
    LEAST_FLIGHTS,
    LEVEL,
    Drift,
    Odd,
    OverFleet,
    Series,
    over_fleet,
)
from quad_sysid.report.canvas import AFTER, BEFORE, MUTED, Picture, finish, framed, panels
from quad_sysid.report.style import document
from quad_sysid.report.tables import Table, wrapped
from quad_sysid.report.words import chance, named, number
from quad_sysid.units import unit_and_factor

MOST_ROWS, MOST_NAMES = 200, 10
"""Rows of one table on the page, and bags without an answer that a terminal names."""
NO_NAME = 'all'
TREND_SHARE = 0.5
"""Share of an aircraft's flights that show an effect whose size is followed over time."""
FIRST_DAY = 1000.0
"""Day since 1970 from which a flight has a date: a log without a clock begins at one second."""
GROUPS = ('aircraft', 'folder', 'none')
"""What is one aircraft: the first folder, the whole folder of a bag, or all flights."""
UNITS = {'gain': 'rad/s²', 'lag': 's', 'delay': 's', 'damping': '1/s', 'bias': 'rad/s²'}


@dataclass(frozen=True)
class Quantity:
    """A parameter of an axis over the fleet."""

    axis: str
    name: str
    """`gain`, …, or `<effect>.<parameter>`."""
    unit: str
    series: tuple[Series, ...]
    statistics: OverFleet


@dataclass(frozen=True)
class Fleet:
    """Rows of bags, one each, what they say together, and how that is shown."""

    rows: list[Row]
    group_by: str = 'aircraft'
    since: str = ''
    """Flights before this day are left out of all but `rows`."""
    title: str = field(default='', compare=False)

    def __post_init__(self) -> None:
        if self.group_by not in GROUPS:
            raise BadInputError('group_by', f'must be one of {", ".join(GROUPS)}', self.group_by)
        _ = self.begin_ns

    def only(self, since: str = '', group_by: str = '') -> Fleet:
        """The fleet from a day on, or grouped in another way."""
        return replace(self, since=since or self.since, group_by=group_by or self.group_by)

    def __repr__(self) -> str:
        """The text that the command prints."""
        return '\n'.join(_lines(self))

    def page(self) -> str:
        """fleet.html: what is wrong first, then what every aircraft lacks and is."""
        return _page(self)

    @property
    def begin_ns(self) -> float:
        """The start of `since`. Raises BadInputError where it is neither a day nor `<n>d`."""
        if not self.since:
            return -np.inf
        try:
            if self.since.endswith('d'):
                begin = datetime.now(timezone.utc) - timedelta(days=float(self.since[:-1]))
            else:
                begin = datetime.fromisoformat(self.since)
        except (ValueError, OverflowError):
            raise BadInputError('--since', 'is neither a day nor a number of days', self.since,
                                'such as 2026-05-31, or 90d') from None
        zoned = begin if begin.tzinfo else begin.replace(tzinfo=timezone.utc)
        return zoned.timestamp() * 1e9

    @cached_property
    def flights(self) -> list[Row]:
        """The rows within `since`, with `aircraft` as they are grouped."""
        return [{**row, 'aircraft': self._craft(row)} for row in self.rows
                if row.get('start_ns', np.inf) >= self.begin_ns]

    def _craft(self, row: Row) -> str:
        if self.group_by == 'aircraft':
            return str(row['aircraft'])
        parent = PurePosixPath(row['bag']).parent.as_posix()
        return '' if self.group_by == 'none' or parent == '.' else parent

    @cached_property
    def counts(self) -> dict[str, int]:
        """Number of bags per status."""
        return dict(sorted(Counter(row['status'] for row in self.flights).items()))

    @cached_property
    def unanswered(self) -> list[tuple[str, str]]:
        """Bag and reason, where there is no answer."""
        return [(row['bag'], row['reason']) for row in self.flights
                if row['status'] in (FAILED, CANNOT_TELL)]

    @cached_property
    def answered(self) -> dict[str, list[Row]]:
        """By its first bag, each flight with an answer: the rows of all bags that hold it.

        Copies are bags of one aircraft that begin at the same time and give the same model.
        """
        flights: dict[tuple[object, ...], list[Row]] = {}
        for row in self.flights:
            if row['status'] == ANSWERED:
                model = (f'{row.get(f"{axis}_{name}") or 0.0:.5g}' for axis in EVERY
                         for name in BASE)
                start = row.get('start_ns', row['bag'])
                flights.setdefault((row['aircraft'], start, *model), []).append(row)
        return {rows[0]['bag']: rows for rows in flights.values()}

    @cached_property
    def lacks(self) -> list[tuple[str, str, str, int, int]]:
        """Aircraft, axis, effect, number of flights that show it, number of flights answered."""
        out = []
        answered = [row for row, *_ in self.answered.values()]
        for craft, axis in sorted({(row['aircraft'], axis) for row in answered for axis in EVERY}):
            flights = [row for row in answered if row['aircraft'] == craft
                       and row.get(f'{axis}_verdict') not in (None, CANNOT_TELL)]
            counts = Counter(effect for row in flights
                            for effect in row[f'{axis}_effects'].split(',') if effect)
            out += [(craft, axis, effect, n, len(flights)) for effect, n in counts.most_common()]
        return out

    @cached_property
    def quantities(self) -> list[Quantity]:
        """Every parameter of base and named effects: means, drifts, odd flights."""
        rows = [*self._series()]
        statistics = over_fleet([series for *_, series in rows])
        return [Quantity(axis, name, unit, series, statistic)
                for (axis, name, unit, series), statistic in zip(rows, statistics, strict=True)]

    @property
    def drifts(self) -> list[tuple[Quantity, Drift]]:
        """Significant drifts, the surest first."""
        every = [(q, d) for q in self.quantities for d in q.statistics.drifts if d.claimed]
        return sorted(every, key=lambda pair: pair[1].p_value)

    @property
    def odd(self) -> dict[str, list[tuple[Quantity, Odd]]]:
        """The flights that stand out beyond chance, each with why, the surest first."""
        every = [(q, o) for q in self.quantities for o in q.statistics.odd if o.claimed]
        out: dict[str, list[tuple[Quantity, Odd]]] = {}
        for pair in sorted(every, key=lambda pair: pair[1].p_value):
            out.setdefault(pair[1].bag, []).append(pair)
        return out

    def _series(self) -> Iterator[tuple[str, str, str, tuple[Series, ...]]]:
        """Axis, name, unit and the series of each aircraft."""
        for axis in EVERY:
            flights = [row for row, *_ in self.answered.values()
                       if row.get(f'{axis}_verdict') not in (None, CANNOT_TELL)]
            units, values = _values(axis, flights)
            for name, of_bag in values.items():
                by_craft: dict[str, list[tuple[float, str, float, float]]] = {}
                for row in flights:
                    if row['bag'] in of_bag:
                        by_craft.setdefault(row['aircraft'], []).append(
                            (row['start_ns'] / 86_400e9, row['bag'], *of_bag[row['bag']]))
                series = []
                for craft, every in sorted(by_craft.items()):
                    some = [one for one in every if one[0] > FIRST_DAY] or every
                    share = sum(value != 0.0 for *_, value, _ in some) / len(some)
                    if share < TREND_SHARE:
                        continue
                    days, bags, numbers, stds = zip(*sorted(some), strict=True)
                    series.append(Series(craft, bags, np.array(days), np.array(numbers),
                                         np.array(stds), share < 1.0))
                if series:
                    yield axis, name, units[name], tuple(series)


Values = dict[str, tuple[float, float]]


def _values(axis: str, flights: Sequence[Row]) -> tuple[dict[str, str], dict[str, Values]]:
    """Units by name; value and standard error by name and bag.

    A parameter at its bound has no error of its own: it was not measured.
    An effect that a flight does not show is no gap where its parameter vanishes without it: it is
    0 there, give or take half of the least that was found anywhere.
    """
    axis_units = units_of(axis)
    units = {name: unit_and_factor(axis_units, unit)[0] for name, unit in UNITS.items()}
    values = dict[str, Values]()
    for row in flights:
        units |= row.get(f'{axis}_base_units', {})
        for name in BASE:
            if std := row.get(f'{axis}_{name}_std'):
                values.setdefault(name, {})[row['bag']] = float(row[f'{axis}_{name}']), float(std)
    vanishing = set()
    for row in flights:
        for name, entry in json.loads(row.get(f'{axis}_effect_parameters') or '{}').items():
            if not entry['std']:
                continue
            units[name] = entry['unit']
            values.setdefault(name, {})[row['bag']] = float(entry['value']), float(entry['std'])
            if entry.get('vanishes'):
                vanishing.add(name)
    bags = [row['bag'] for row in flights if row[f'{axis}_verdict'] != 'not_searched']
    for name in vanishing:
        some = values[name].values()
        unsure = max(float(np.median([std for _, std in some])),
                     min(abs(value) for value, _ in some) / 2.0)
        values[name] |= {bag: (0.0, unsure) for bag in bags if bag not in values[name]}
    return units, values


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


def _lines(fleet: Fleet) -> list[str]:
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
        names = _few([bag for bag, _ in fleet.unanswered])
        out += ['', *wrapped(f'without an answer: {names}; the table has the reasons', '  ', '')]
    return out


def _nothing(fleet: Fleet) -> str:
    tested = sum(len(q.statistics.drifts) for q in fleet.quantities)
    if not tested:
        return (f'Nothing is said of drift: that needs {LEAST_FLIGHTS} answered flights of an '
                'aircraft at different times.')
    return (f'Nothing drifts and no flight is odd, at a level of {LEVEL:.0%} over {tested} '
            'parameters of aircraft together.')


def _counts(fleet: Fleet) -> str:
    if not fleet.flights:
        return f'No flight since {fleet.since}.' if fleet.since else 'No bag is done yet.'
    craft = len({row['aircraft'] for row in fleet.flights} - {''}) or 1
    counts = ', '.join(f'{count} {name.replace("_", " ")}' for name, count in fleet.counts.items())
    since = f' since {fleet.since}' if fleet.since else ''
    copies = [f'{copy["bag"]} of {bag}' for bag, (_, *more) in fleet.answered.items()
              for copy in more]
    once = f' Flights count once; copies: {_few(copies)}.' if copies else ''
    return f'{len(fleet.flights)} bags of {craft} aircraft{since}: {counts}.{once}'


def _few(names: Sequence[str]) -> str:
    """The first of the names, and how many more there are."""
    more = f' and {len(names) - MOST_NAMES} more' if len(names) > MOST_NAMES else ''
    return ', '.join(names[:MOST_NAMES]) + more


def _tables(fleet: Fleet) -> tuple[Table, Table, Table]:
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
              caption='Mean over aircraft with its interval. Between, within: standard deviations '
              "between aircraft, and between flights of one, beyond the estimates' errors."),
        Table(['bag', 'because'], [list(pair) for pair in fleet.unanswered[:MOST_ROWS]]),
    )


def _page(fleet: Fleet) -> str:
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


def _drawn(fleet: Fleet) -> list[Quantity]:
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
    return framed(picture, f'{quantity.axis}-{picture.name}')
