"""Whether /motors/command follows from /control/wrench by the mixer, or its motors are swapped.

A swap that leaves the identified axis as it was cannot be seen in that axis' motion, but it turns
another one's command: no gains may come of such a bag. Values only.
"""

from __future__ import annotations

from itertools import permutations

import numpy as np

from quad_sysid.contract import motors_from_wrench
from quad_sysid.record import Record

ROWS = 20_000
"""At most so many samples are compared, spread over the record."""
BETTER = 0.5
"""Another order counts where it leaves less than this share of what the contract's leaves."""
FLOOR = 2e-4
"""RMS of a motor command, normalised, below which a difference is rounding (1 µs of pulse)."""


def swapped_motors(record: Record) -> tuple[int, ...] | None:
    """The motors (1..4) that stand in the four places of /motors/command; None: in order.

    None also where the record lacks one of the topics. Only orders are compared, so that topics
    that lag by a cycle, or limits below the nominal ones, raise no alarm.
    """
    if record.motors is None or record.wrench is None:
        return None
    expected = motors_from_wrench(record.wrench)
    both = np.isfinite(record.motors).all(axis=1) & np.isfinite(expected).all(axis=1)
    good = np.flatnonzero(both)
    rows = good[:: max(1, good.size // ROWS)]
    if rows.size == 0:
        return None
    motors, expected = record.motors[rows], expected[rows]
    left = {
        order: float(np.sqrt(np.mean((motors - expected[:, order]) ** 2)))
        for order in permutations(range(4))
    }
    best = min(left, key=left.__getitem__)
    plain = left[0, 1, 2, 3]
    if plain <= FLOOR or left[best] >= BETTER * plain:
        return None
    return tuple(motor + 1 for motor in best)


def refusal(record: Record) -> str:
    """One line that says why no gains may come of this record; empty where nothing is wrong."""
    order = swapped_motors(record)
    if order is None:
        return ''
    return (
        f'{record.source}: /motors/command holds the motors in the order '
        f'{", ".join(map(str, order))} (by /control/wrench and the mixer), not 1, 2, 3, 4; '
        'put them in order and fly again'
    )
