"""Rows → summary of the fleet: spread, missing effects, drift. Arithmetic only."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from quad_sysid.contract import AXES
from quad_sysid.fleet.row import ANSWERED, BASE, Row

LEAST_FLIGHTS = 4
"""Least flights of one aircraft for a drift."""
DRIFT_LEVEL = 0.01
"""Significance level of drifts."""
DAY_NS = 86_400e9
OUTLYING = 3.5
"""Distance of an outlier in robust standard deviations (Iglewicz, Hoaglin 1993)."""


@dataclass(frozen=True)
class Spread:
    """One parameter of one axis over a group of flights."""

    axis: str
    parameter: str
    count: int
    median: float
    low: float
    """5 % quantile."""
    high: float
    """95 % quantile."""
    relative_pct: float
    """Robust standard deviation, % of the median; NaN where that is 0."""
    outliers: tuple[str, ...]
    """Bags that lie far outside."""


@dataclass(frozen=True)
class Drift:
    """A parameter of one aircraft that changes over time."""

    aircraft: str
    axis: str
    parameter: str
    flights: int
    per_day: float
    std: float
    """Standard error of `per_day`."""
    p_value: float
    relative_pct: float
    """Drift over the whole time, % of the mean."""


@dataclass(frozen=True)
class Lack:
    """An effect that an aircraft lacks in its base model."""

    aircraft: str
    axis: str
    effect: str
    found: int
    flights: int
    """Answered flights of that axis."""


@dataclass(frozen=True)
class Summary:
    """Summary of a fleet's rows."""

    counts: Mapping[str, int]
    aircraft: tuple[str, ...]
    spreads: tuple[Spread, ...]
    lacks: tuple[Lack, ...]
    drifts: tuple[Drift, ...]
    failures: tuple[tuple[str, str], ...]
    """Bag and reason, where there is no answer."""


def summarise(rows: Sequence[Row]) -> Summary:
    """The fleet's summary; rows without an answer count as such and give nothing else."""
    answered = [row for row in rows if row['status'] == ANSWERED]
    aircraft = tuple(sorted({row['aircraft'] for row in rows}))
    return Summary(
        counts=dict(Counter(str(row['status']) for row in rows)),
        aircraft=aircraft,
        spreads=tuple(
            s for axis in AXES for name in BASE if (s := _spread(answered, axis, name)) is not None
        ),
        lacks=tuple(
            lack for craft in aircraft for axis in AXES
            for lack in _lacks([r for r in answered if r['aircraft'] == craft], craft, axis)
        ),
        drifts=tuple(
            d for craft in aircraft for axis in AXES for name in BASE
            if (d := _drift([r for r in answered if r['aircraft'] == craft], craft, axis, name))
            is not None
        ),
        failures=tuple(
            (str(row['bag']), str(row['reason'])) for row in rows if row['status'] != ANSWERED
        ),
    )


def _values(rows: Sequence[Row], column: str) -> list[tuple[Row, float]]:
    return [(row, float(row[column])) for row in rows if row.get(column) is not None]


def _spread(rows: Sequence[Row], axis: str, name: str) -> Spread | None:
    known = _values(rows, f'{axis}_{name}')
    if not known:
        return None
    values = np.array([value for _, value in known])
    median = float(np.median(values))
    sigma = 1.4826 * float(np.median(np.abs(values - median)))
    outliers = tuple(
        str(row['bag']) for row, value in known
        if sigma > 0.0 and abs(value - median) > OUTLYING * sigma
    ) if len(known) >= LEAST_FLIGHTS else ()
    low, high = np.quantile(values, [0.05, 0.95])
    return Spread(axis, name, len(known), median, float(low), float(high),
                  100.0 * sigma / abs(median) if median else math.nan, outliers)


def _lacks(rows: Sequence[Row], craft: str, axis: str) -> list[Lack]:
    flights = [row for row in rows if row.get(f'{axis}_verdict') not in (None, 'cannot_tell')]
    counts = Counter(
        effect for row in flights for effect in (row[f'{axis}_effects'] or '').split(',') if effect
    )
    return [Lack(craft, axis, effect, n, len(flights)) for effect, n in counts.most_common()]


def _drift(rows: Sequence[Row], craft: str, axis: str, name: str) -> Drift | None:
    """Straight line over the flights' starts."""
    from scipy import stats

    known = [(row, value) for row, value in _values(rows, f'{axis}_{name}') if row.get('start_ns')]
    if len(known) < LEAST_FLIGHTS:
        return None
    days = np.array([row['start_ns'] for row, _ in known]) / DAY_NS
    values = np.array([value for _, value in known])
    if np.ptp(days) <= 0.0 or np.ptp(values) <= 0.0:
        return None
    found = stats.linregress(days, values)
    tests = max(1, len(BASE))
    if not found.pvalue < DRIFT_LEVEL / tests:
        return None
    mean = float(np.mean(values))
    change = 100.0 * float(found.slope) * float(np.ptp(days)) / abs(mean) if mean else math.nan
    return Drift(craft, axis, name, len(known), float(found.slope), float(found.stderr),
                 float(found.pvalue), change)
