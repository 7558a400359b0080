"""Flights or models → each parameter's difference, its error and p-value.

Base, trim and effects of every axis, the first flight against each other one. Two-sided tests,
held to one level together (Holm 1979). Values only: fits are pipeline's, words are cli.py's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from quad_sysid.contract import AXES
from quad_sysid.model import AxisModel
from quad_sysid.record import Record

LEVEL = 0.01
"""Probability of any false change among all comparisons."""
QUARTERS = 4
"""Parts of a flight whose trims give the trim's scatter between equal flights."""
MANY = 1e9
"""Degrees of freedom with which Student's t is normal."""
LEAST_IN_PART = 50
"""Samples."""


@dataclass(frozen=True)
class Estimate:
    """One parameter of one flight."""

    value: float
    std: float | None
    """None where there is no ordinary standard error."""
    unit: str
    degrees: float = np.inf
    """Degrees of freedom of `std`."""


@dataclass(frozen=True)
class Flight:
    """Parameters of one flight or model by axis and name."""

    source: str
    parameters: Mapping[str, Mapping[str, Estimate]]
    """`gain`, `lag`, …, `trim`, and `<effect>.<parameter>`; of answered axes."""
    reasons: Mapping[str, str]
    """By axis, why there is no model."""


@dataclass(frozen=True)
class Change:
    """One parameter in two flights."""

    axis: str
    name: str
    unit: str
    reference: float | None
    """In the first flight; None where it has no such effect."""
    value: float | None
    difference: float | None = None
    std: float | None = None
    """Standard error of the difference."""
    p_value: float | None = None
    """Probability of a difference as large without a change; None without an error."""
    changed: bool = False
    """Whether it is significant among all comparisons."""


def of_model(model: AxisModel) -> dict[str, Estimate]:
    """The base fitted alone, then the effects."""
    out = {p.name: Estimate(p.value, p.std, p.unit) for p in model.plain or model.base}
    for effect in model.effects:
        out |= {f'{effect.name}.{p.name}': Estimate(p.value, p.std, p.unit)
                for p in effect.parameters}
    return out


def trims(record: Record) -> dict[str, Estimate]:
    """Mean command of each axis over training and validation, normalised.

    Its error is the scatter between the flight's quarters, not that of their mean: a trim drifts
    with wind and battery, between flights as within one.
    """
    used = np.zeros(record.n, dtype=bool)
    for segment in record.segments:
        if segment.role != 'idle':
            used[slice(*record.span(segment))] = True
    used &= np.isfinite(record.control).all(axis=1)
    rows = np.flatnonzero(used if record.segments else np.isfinite(record.control[:, 0]))
    if len(rows) < QUARTERS * LEAST_IN_PART:
        return {}
    means = np.array([record.control[part].mean(axis=0)
                      for part in np.array_split(rows, QUARTERS)])
    std = means.std(axis=0, ddof=1)
    return {
        axis: Estimate(float(means[:, i].mean()), float(std[i]), '1', QUARTERS - 1.0)
        for i, axis in enumerate(AXES, 1) if std[i] > 0.0
    }


def changes(reference: Flight, other: Flight) -> tuple[Change, ...]:
    """All parameters of either flight, in the order of axes and names."""
    found = [
        _change(axis, name, reference.parameters.get(axis, {}).get(name),
                other.parameters.get(axis, {}).get(name))
        for axis in AXES
        for name in dict.fromkeys([*reference.parameters.get(axis, {}),
                                   *other.parameters.get(axis, {})])
    ]
    return _held(found)


def _change(axis: str, name: str, a: Estimate | None, b: Estimate | None) -> Change:
    from scipy.stats import t  # slow to import

    known = a or b
    unit = known.unit if known else ''
    change = Change(axis, name, unit, a.value if a else None, b.value if b else None)
    if a is None or b is None:
        return change
    change = replace(change, difference=b.value - a.value)
    if a.std is None or b.std is None or not a.std + b.std > 0.0:
        return change
    variances = np.array([a.std**2, b.std**2])
    std = float(np.sqrt(variances.sum()))
    # Welch 1947
    lost = float(np.sum(variances**2 / np.array([a.degrees, b.degrees])))
    degrees = min(float(variances.sum()) ** 2 / lost, MANY) if lost > 0.0 else MANY
    p = float(2.0 * t.sf(abs(b.value - a.value) / std, degrees))
    return replace(change, std=std, p_value=p)


def _held(found: Sequence[Change]) -> tuple[Change, ...]:
    """Mark the changes at LEVEL for all of them together."""
    tested = sorted((c.p_value, i) for i, c in enumerate(found) if c.p_value is not None)
    marked = set()
    for rank, (p, i) in enumerate(tested):
        if p * (len(tested) - rank) > LEVEL:
            break
        marked.add(i)
    return tuple(replace(c, changed=i in marked) for i, c in enumerate(found))
