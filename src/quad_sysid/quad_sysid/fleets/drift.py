"""What many flights of many aircraft say of one parameter: means, drift over time, odd flights.

A flight's value is its aircraft's own level, what this day added (standard deviation `tau`, one
for all aircraft) and the error of its estimate. `tau` is that with which the median aircraft
scatters about its own line as it should, so that a few bad ones do not set it. How much an
aircraft scatters beyond that is weighed with what the others do (Smyth 2004, moderated t), and
never counts as less than the errors of the estimates.

A drift is the most significant of these shapes, each beside a level: a ramp from any flight on
(from the first: a straight line) and a step between any two; its p-value is multiplied by their
number. It must remain when any one flight is left out, so that no single flight makes a drift. An
odd flight lies outside what the others of its aircraft predict. Both are held to one level
over all that is asked of the fleet (Holm 1979). Numbers only: no rows, no words, no files.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import optimize, special, stats

from quad_sysid.contract import FloatArray

LEVEL = 0.01
"""Probability of any false drift in a fleet, and of any false odd flight."""
LEAST_FLIGHTS = 5
"""Least flights of an aircraft for a drift or an odd one."""
LEAST_AIRCRAFT = 3
"""Least aircraft for which their scatter says something of each other's."""
INTERVAL = 0.95
"""Probability of every interval that is stated."""
NEAR = float(stats.chi2.ppf(INTERVAL, 1))
"""Loss of twice the logarithm of the likelihood within the interval of one parameter."""
NEARLY_NORMAL = 20.0
"""Degrees of freedom beyond which the tail of a single flight is not believed to be normal."""
MANY = 1e9
"""Degrees of freedom with which Student's t is normal."""


@dataclass(frozen=True)
class Series:
    """One parameter of one aircraft, flight by flight, in the order of time."""

    aircraft: str
    bags: tuple[str, ...]
    days: FloatArray
    """(n,) start of the flight."""
    values: FloatArray
    """(n,)"""
    stds: FloatArray
    """(n,) standard errors."""
    comes_and_goes: bool = False
    """Whether it is an effect that some of the flights do not show: its scatter is its own."""


@dataclass(frozen=True)
class Drift:
    """Change of one parameter of one aircraft over its flights."""

    aircraft: str
    kind: str
    """`ramp` or `step`."""
    since: float
    """Day of the last flight before it began."""
    between: tuple[float, float]
    """Days between which it may have begun, at INTERVAL."""
    before: float
    after: float
    """Level before, and at the last flight."""
    std: float
    """Standard error of the difference."""
    p_value: float
    """p-value for this parameter of this aircraft, corrected for the number of shapes."""
    flights: int
    claimed: bool = False


@dataclass(frozen=True)
class Odd:
    """A flight beside the others of its aircraft."""

    aircraft: str
    bag: str
    value: float
    expected: float
    std: float
    """Standard error of the difference."""
    p_value: float
    claimed: bool = False


@dataclass(frozen=True)
class Level:
    """The mean of an aircraft's flights, without odd ones."""

    aircraft: str
    flights: int
    mean: float
    std: float


@dataclass(frozen=True)
class Mean:
    """The hierarchical mean over aircraft: random effects by REML, interval of Hartung, Knapp."""

    mean: float
    low: float
    high: float
    between: float
    """Standard deviation between aircraft."""
    within: float
    """Standard deviation between flights of one aircraft, beside the estimates' errors."""
    levels: tuple[Level, ...]


@dataclass(frozen=True)
class OverFleet:
    """One parameter over a fleet."""

    mean: Mean
    drifts: tuple[Drift, ...]
    """Drift of each aircraft with enough flights, significant or not."""
    odd: tuple[Odd, ...]
    """Test of each of their flights."""


def holm(p_values: Sequence[float], level: float) -> list[bool]:
    """Whether each hypothesis is rejected, at one level for all of them together (Holm 1979)."""
    marks = [False] * len(p_values)
    for rank, i in enumerate(sorted(range(len(p_values)), key=p_values.__getitem__)):
        if p_values[i] * (len(p_values) - rank) > level:
            break
        marks[i] = True
    return marks


def over_fleet(every: Sequence[Sequence[Series]]) -> list[OverFleet]:
    """Drifts and odd flights of each parameter, at LEVEL over all parameters and flights."""
    shared = [_scale([one for one in series if not one.comes_and_goes]) for series in every]
    scales = [[_scale([one]) if one.comes_and_goes else scale for one in series]
              for series, scale in zip(every, shared, strict=True)]
    drifts = [[_drift(*pair) for pair in zip(series, own, strict=True) if _enough(pair[0])]
              for series, own in zip(every, scales, strict=True)]
    marks = iter(holm([d.p_value for some in drifts for d in some], LEVEL))
    drifts = [[replace(d, claimed=next(marks)) for d in some] for some in drifts]
    odd = []
    for series, scales_here, some in zip(every, scales, drifts, strict=True):
        claimed = {d.aircraft: d for d in some if d.claimed}
        odd.append([odd for s, scale in zip(series, scales_here, strict=True) if _enough(s)
                    for odd in _odd(s, scale, claimed.get(s.aircraft))])
    marks = iter(holm([o.p_value for some in odd for o in some], LEVEL))
    odd = [[replace(o, claimed=next(marks)) for o in some] for some in odd]
    return [OverFleet(_mean(series, [scale.tau for scale in own],
                        {o.bag for o in outside if o.claimed}), tuple(some), tuple(outside))
            for series, own, some, outside in zip(every, scales, drifts, odd, strict=True)]


@dataclass(frozen=True)
class _Scale:
    """How flights of one aircraft scatter."""

    tau: float
    usual: float
    """Usual ratio of the scatter to what tau and the errors say, squared."""
    degrees: float
    """Degrees of freedom that the other aircraft are good for."""

    def variance(self, series: Series, scatter: FloatArray, degrees: float) -> FloatArray:
        """The ratio of an aircraft whose sum of squares is known with so many degrees.

        It is at least that of the estimates' own errors.
        """
        least = float(np.mean(series.stds**2 * _weights(series, self.tau)))
        return np.maximum(least, (self.degrees * self.usual + scatter) / (self.degrees + degrees))


def _enough(series: Series) -> bool:
    return len(series.values) >= LEAST_FLIGHTS and float(np.ptp(series.days)) > 0.0


def _least(values: FloatArray) -> float:
    """Scatter below which these values are alike."""
    return 1e-9 * float(np.max(np.abs(values))) + 1e-300


def _weights(series: Series, tau: float) -> FloatArray:
    return np.asarray(1.0 / (series.stds**2 + tau**2 + _least(series.values)**2))


def _lines(x: FloatArray, y: FloatArray, w: FloatArray) -> tuple[FloatArray, ...]:
    """Weighted regressions of y on each row of x (k, n) beside a level.

    Slope (k,), its information (k,), residuals (k, n), leverage (k, n), x about its mean (k, n).
    """
    total = w.sum(axis=-1)
    about = x - ((x * w).sum(axis=-1) / total)[..., None]
    level = y - ((y * w).sum(axis=-1) / total)[..., None]
    information = (about**2 * w).sum(axis=-1)
    slope = (about * level * w).sum(axis=-1) / information
    leverage = w * (1.0 / total[..., None] + about**2 / information[..., None])
    return slope, information, level - slope[..., None] * about, leverage, about


def _scale(series: Sequence[Series]) -> _Scale:
    able = [one for one in series if _enough(one) and float(np.ptp(one.values)) > 0.0]
    if not able:
        return _Scale(_about_means(series), 1.0, 0.0)
    longest = max(len(one.values) for one in able)
    x, y, stds, there = (np.zeros((len(able), longest)) for _ in range(4))
    for i, each in enumerate(able):
        n = len(each.values)
        x[i, :n], y[i, :n], stds[i, :n], there[i, :n] = (
            each.days - each.days.mean(), each.values, each.stds, 1.0)
    free = there.sum(axis=1) - 2.0
    least = _least(y)

    def scatter(tau: float) -> FloatArray:
        w = there / (stds**2 + tau**2 + least**2)
        return np.asarray((_lines(x, y, w)[2]**2 * w).sum(axis=1))

    def beyond(tau: float) -> float:
        return float(np.median(scatter(tau) / stats.chi2.median(free))) - 1.0

    tau, most = 0.0, 10.0 * float(np.max(np.ptp(y, axis=1))) + least
    if beyond(0.0) > 0.0:
        tau = float(optimize.brentq(beyond, 0.0, most, rtol=1e-6))
    return _Scale(tau, *_prior(scatter(tau), free))


def _about_means(series: Sequence[Series]) -> float:
    """How flights scatter about their aircraft's mean, where no line can be laid through them.

    At it the sum of weighted squares is what it should be (Paule, Mandel 1982).
    """
    several = [one for one in series if len(one.values) > 1]
    free = sum(len(one.values) - 1 for one in several)

    def beyond(tau: float) -> float:
        total = 0.0
        for one in several:
            w = _weights(one, tau)
            total += float((w * (one.values - (w * one.values).sum() / w.sum())**2).sum())
        return total / free - 1.0

    if not free or beyond(0.0) <= 0.0:
        return 0.0
    most = 10.0 * max(float(np.ptp(one.values)) for one in several)
    return float(optimize.brentq(beyond, 0.0, most, rtol=1e-6))


def _prior(scatter: FloatArray, free: FloatArray) -> tuple[float, float]:
    """Usual ratio and its degrees of freedom: the scaled F distribution of Smyth 2004."""
    if len(scatter) < LEAST_AIRCRAFT:
        return 1.0, 0.0
    logs = np.log(np.maximum(scatter / free, 1e-12)) - special.digamma(free / 2) + np.log(free / 2)
    more = float(logs.var(ddof=1)) - float(special.polygamma(1, free / 2).mean())
    if more <= 0.0:
        return float(np.exp(logs.mean())), MANY
    half = float(optimize.brentq(lambda h: float(special.polygamma(1, h)) - more, 1e-3, 1e9))
    usual = float(np.exp(logs.mean() + special.digamma(half) - np.log(half)))
    return usual, min(2.0 * half, MANY)


def _shapes(days: FloatArray) -> tuple[FloatArray, list[tuple[str, int]]]:
    """Ramps and steps (k, n), each with the flight after which it begins.

    Two flights at least lie on either side of a step and on a ramp.
    """
    n = len(days)
    ramps = [('ramp', i) for i in range(n - 2)]
    steps = [('step', i) for i in range(1, n - 2)]
    columns, shapes = [], []
    for kind, i in (*ramps, *steps):
        shape = (np.maximum(days - days[i], 0.0) if kind == 'ramp'
               else (np.arange(n) > i).astype(float))
        if np.count_nonzero(shape) >= 2:  # flights may share their day
            columns.append((kind, i))
            shapes.append(shape)
    return np.array(shapes), columns


def _drift(series: Series, scale: _Scale) -> Drift:
    y, w, n = series.values, _weights(series, scale.tau), len(series.values)
    x, shapes = _shapes(series.days)
    slope, information, residuals, leverage, about = _lines(x, y, w)
    # each flight left out in turn: (k, n)
    free = np.maximum(1.0 - leverage, 1e-9)
    less = np.maximum(information[:, None] - w * about**2 * w.sum() / (w.sum() - w), 0.0)
    without = slope[:, None] - w * about * residuals / (information[:, None] * free)
    squares = (residuals**2 * w).sum(axis=1)
    scatter = np.maximum(squares[:, None] - w * residuals**2 / free, 0.0)
    deleted_residuals = np.abs(without) * np.sqrt(less / scale.variance(series, scatter, n - 3.0))
    t = np.abs(slope) * np.sqrt(information / scale.variance(series, squares, n - 2.0))
    best = int(np.argmax(t))
    p = min(1.0, len(shapes) * _chance(t[best], scale, n - 2.0))
    alone = min(1.0, len(shapes) * _chance(deleted_residuals[best].min(), scale, n - 3.0))
    variance = float(scale.variance(series, squares[best], n - 2.0))
    limit = squares[best] + NEAR * variance
    near = [series.days[i] for k, (_, i) in enumerate(shapes) if squares[k] <= limit]
    kind, first = shapes[best]
    change = float(slope[best] * np.ptp(x[best]))
    level = float((y * w).sum() / w.sum() - slope[best] * (x[best] * w).sum() / w.sum())
    return Drift(series.aircraft, kind, float(series.days[first]),
                 (float(min(near)), float(max(near))), level, level + change,
                 float(np.ptp(x[best]) * np.sqrt(variance / information[best])),
                 p if alone <= LEVEL else max(p, alone), n)


def _chance(t: float, scale: _Scale, degrees: float) -> float:
    """Two-sided p-value."""
    return 2.0 * float(special.stdtr(min(scale.degrees + degrees, MANY), -t))


def _odd(series: Series, scale: _Scale, drift: Drift | None) -> list[Odd]:
    """Each flight against what the others of its aircraft say, along a drift that is claimed."""
    y, w, n = series.values, _weights(series, scale.tau), len(series.values)
    if drift is None:
        residuals, leverage, fitted = y - (y * w).sum() / w.sum(), w / w.sum(), 1
    else:
        x, shapes = _shapes(series.days)
        this = next(k for k, (kind, i) in enumerate(shapes)
                    if kind == drift.kind and series.days[i] == drift.since)
        _, _, all_residuals, all_leverage, _ = _lines(x, y, w)
        residuals, leverage, fitted = all_residuals[this], all_leverage[this], 2
    free = np.maximum(1.0 - leverage, 1e-9)
    degrees = n - fitted - 1.0
    scatter = np.maximum((residuals**2 * w).sum() - w * residuals**2 / free, 0.0)
    deleted = residuals / free  # from what is expected without this flight
    std = np.sqrt(scale.variance(series, scatter, degrees) / (w * free))
    p = 2.0 * special.stdtr(min(scale.degrees + degrees, NEARLY_NORMAL), -np.abs(deleted) / std)
    expected = y - deleted
    return [Odd(series.aircraft, bag, float(y[k]), float(expected[k]), float(std[k]), float(p[k]))
            for k, bag in enumerate(series.bags)]


def _mean(series: Sequence[Series], taus: Sequence[float], odd: set[str]) -> Mean:
    levels = []
    for one, tau in zip(series, taus, strict=True):
        regular = np.array([bag not in odd for bag in one.bags])
        w = _weights(one, tau)[regular]
        if w.size:
            levels.append(Level(one.aircraft, int(w.size), float((one.values[regular] * w).sum()
                                                                 / w.sum()),
                                float(np.sqrt(1.0 / w.sum()))))
    y = np.array([level.mean for level in levels])
    v = np.array([level.std**2 for level in levels])
    between = _reml(y, v)
    w = 1.0 / (v + between**2)
    mean = float((w * y).sum() / w.sum())
    if len(y) > 1:
        std = float(np.sqrt((w * (y - mean)**2).sum() / (len(y) - 1) / w.sum()))
        half = float(stats.t.ppf(0.5 + INTERVAL / 2.0, len(y) - 1)) * std
    else:
        free = levels[0].flights - 1  # one flight: its estimate's own error is all that is known
        half = float(stats.t.ppf(0.5 + INTERVAL / 2.0, free or np.inf) * np.sqrt(v[0]))
    return Mean(mean, mean - half, mean + half, between, float(np.median(taus)), tuple(levels))


def _reml(y: FloatArray, v: FloatArray) -> float:
    """Standard deviation between aircraft, by restricted maximum likelihood."""
    spread = float(np.std(y))
    if len(y) < 2 or not spread > 0.0:
        return 0.0

    def loss(tau: float) -> float:
        w = 1.0 / (v + tau**2)
        mean = (w * y).sum() / w.sum()
        return float((w * (y - mean)**2).sum() - np.log(w).sum() + np.log(w.sum()))

    best = optimize.minimize_scalar(loss, bounds=(0.0, 4.0 * spread), method='bounded')
    return float(best.x) if best.fun < loss(0.0) else 0.0
