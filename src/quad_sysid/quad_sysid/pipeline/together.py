"""Whether several flights can be fitted together: one sample rate, and none of them twice."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from quad_sysid.errors import BadInputError
from quad_sysid.record import Record

SAME_RATE = 5e-3
"""Relative difference of sample intervals that two clocks of one rate may have."""
WORTH_SAYING = 5e-4
"""Above it the difference is told."""
LEAST_OVERLAP = 50
"""Samples; fewer may agree by chance, as at rest."""


def together(records: Sequence[Record]) -> tuple[Record, ...]:
    """The records on the first one's sample interval, its clock's difference taken as nothing.

    Raises BadInputError where their rates differ by more than SAME_RATE, or where two of them
    hold the same measurement, which would count twice.
    """
    first = records[0]
    for record in records[1:]:
        if not same_rate(record.dt, first.dt):
            raise BadInputError(
                record.source, 'all bags must have one sample rate',
                f'{1.0 / record.dt:.6g} Hz, the first {1.0 / first.dt:.6g} Hz',
                'identify them one by one',
            )
    for one, other in combinations(records, 2):
        _check_apart(one, other)
    return tuple(_told(record, first.dt) for record in records)


def same_rate(dt: float, other: float) -> bool:
    """Whether two sample intervals, s, are those of one rate under two clocks."""
    return abs(dt - other) <= SAME_RATE * other


def _told(record: Record, dt: float) -> Record:
    """The record at dt, with a warning where that changes it by more than WORTH_SAYING."""
    taken = record.at_interval(dt)
    if abs(record.dt - dt) <= WORTH_SAYING * dt:
        return taken
    told = (
        f"{record.source}: its {1.0 / record.dt:.6g} Hz are taken as the first bag's "
        f'{1.0 / dt:.6g} Hz'
    )
    return replace(taken, warnings=(*taken.warnings, told))


def _check_apart(one: Record, other: Record) -> None:
    """Refuse a flight that is given twice, whole or in part, by stamps or from its start."""
    for shift in {round((other.t0_ns - one.t0_ns) * 1e-9 / one.dt), 0}:
        a = one.rates[max(shift, 0) :][: max(other.n + min(shift, 0), 0)]
        b = other.rates[max(-shift, 0) :][: a.shape[0]]
        known = np.isfinite(a[: b.shape[0]]).all(axis=1) & np.isfinite(b).all(axis=1)
        a, b = a[: b.shape[0]][known], b[known]
        if a.shape[0] < LEAST_OVERLAP or not np.ptp(a, axis=0).any():
            continue
        same = (a == b).all(axis=1)
        if same.mean() > 0.5:
            raise BadInputError(
                other.source, f'holds the same measurement as {one.source}',
                f'{np.count_nonzero(same)} samples', 'give each flight once',
            )
