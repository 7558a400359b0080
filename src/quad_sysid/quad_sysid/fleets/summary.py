"""Rows → what they say together: `Summary`, of which page.py makes text and a page.

Which values are compared is said here; how, in drift.py.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta, timezone
from functools import cached_property
from pathlib import PurePosixPath
from typing import TYPE_CHECKING

import numpy as np

from quad_sysid.axes import EVERY, units_of
from quad_sysid.errors import BadInputError
from quad_sysid.fleets.bag import ANSWERED, BASE, CANNOT_TELL, FAILED, Row
from quad_sysid.units import shown_in

if TYPE_CHECKING:
    from quad_sysid.fleets.drift import Drift, Odd, OverFleet, Series

SHOWN = 0.5
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
class Summary:
    """Rows of bags, one each, and what they say together."""

    rows: list[Row]
    group_by: str = 'aircraft'
    since: str = ''
    """Flights before this day are left out of all but `rows`."""
    title: str = field(default='', compare=False)

    def __post_init__(self) -> None:
        if self.group_by not in GROUPS:
            raise BadInputError('group_by', f'must be one of {", ".join(GROUPS)}', self.group_by)
        _ = self.begin_ns

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
    def lacks(self) -> list[tuple[str, str, str, int, int]]:
        """Aircraft, axis, effect, number of flights that show it, number of flights answered."""
        out = []
        answered = [row for row in self.flights if row['status'] == ANSWERED]
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
        from quad_sysid.fleets.drift import over_fleet

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
        from quad_sysid.fleets.drift import Series

        for axis in EVERY:
            flights = [row for row in self.flights if row['status'] == ANSWERED
                       and row.get(f'{axis}_verdict') not in (None, CANNOT_TELL)]
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
                    shown = sum(value != 0.0 for *_, value, _ in some) / len(some)
                    if shown < SHOWN:
                        continue
                    days, bags, numbers, stds = zip(*sorted(some), strict=True)
                    series.append(Series(craft, bags, np.array(days), np.array(numbers),
                                         np.array(stds), shown < 1.0))
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
    units = {name: shown_in(axis_units, unit)[0] for name, unit in UNITS.items()}
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
    searched = [row['bag'] for row in flights if row[f'{axis}_verdict'] != 'not_searched']
    for name in vanishing:
        some = values[name].values()
        unsure = max(float(np.median([std for _, std in some])),
                     min(abs(value) for value, _ in some) / 2.0)
        values[name] |= {bag: (0.0, unsure) for bag in searched if bag not in values[name]}
    return units, values
