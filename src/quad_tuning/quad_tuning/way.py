"""The way from the flown gains to the target: updates within the step limit, all of them safe.

Whoever goes there flies each set for some seconds, so each is held against the ensemble as the
target is. How far one update may go stands in bounds.py.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from quad_sysid.loop.cascade import TUNED, CascadeGains
from quad_tuning.bounds import reachable, steps_to
from quad_tuning.ensemble import Ensemble
from quad_tuning.errors import DesignRefusedError
from quad_tuning.objective import Requirements

SLACK = 0.85
"""A set on the way keeps this share of what the flown gains or the requirements keep, whichever is
less: it is flown for seconds only."""


@dataclass(frozen=True)
class Way:
    """Sets of gains from the first update to the last; `together`: every gain as far as it may."""

    steps: tuple[CascadeGains, ...]
    together: bool

    @property
    def first(self) -> CascadeGains:
        """The first update."""
        return self.steps[0]


def way_to(
    wanted: CascadeGains, active: CascadeGains, loops: Ensemble, needs: Requirements
) -> Way:
    """A safe way to `wanted`; raises DesignRefusedError where each that was tried is not.

    Tried are: every gain as far as it may go in each update; all by equal ratios; lower gains
    first.
    """
    least = _least(active, loops, needs)
    for number, steps in enumerate(_tried(wanted, active)):
        if all(_safe(gains, loops, least) for gains in steps[:-1]):
            return Way(steps, number == 0)
    raise DesignRefusedError(
        'every way from the flown gains to the best ones leads through gains with poor margins; '
        'lower rate.kp by hand first'
    )


def _tried(
    wanted: CascadeGains, active: CascadeGains
) -> tuple[tuple[CascadeGains, ...], ...]:
    together = steps_to(wanted, active)
    lower = {f: min(getattr(wanted, f), getattr(active, f)) for f in TUNED}
    between = replace(active, **lower)
    first = steps_to(between, active)
    return together, _even(wanted, active, len(together)), (*first, *steps_to(wanted, between))


def _even(wanted: CascadeGains, active: CascadeGains, least: int) -> tuple[CascadeGains, ...]:
    """Equal ratios (equal differences for gains near zero) in as many updates as it takes."""
    for count in range(max(least, 1), 65):
        path, now, fits = [], active, True
        for k in range(1, count + 1):
            following = wanted if k == count else _between(active, wanted, k / count)
            fits &= _within(following, now)
            path.append(following)
            now = following
        if fits:
            return tuple(path)
    return ()


def _between(active: CascadeGains, wanted: CascadeGains, share: float) -> CascadeGains:
    values = {}
    for field in TUNED:
        a, b = getattr(active, field), getattr(wanted, field)
        values[field] = a * (b / a) ** share if min(a, b) > 0.0 else a + share * (b - a)
    return replace(active, **values)


def _within(following: CascadeGains, now: CascadeGains) -> bool:
    for field in TUNED:
        low, high = reachable(field, getattr(now, field))
        if not low * (1 - 1e-9) <= getattr(following, field) <= high * (1 + 1e-9):
            return False
    return True


def _least(
    active: CascadeGains, loops: Ensemble, needs: Requirements
) -> tuple[float, float, float]:
    m = loops.margins(active)
    return (
        SLACK * min(needs.phase_margin_deg, float(np.min(m.phase_margin_deg))),
        SLACK * min(needs.gain_margin_db, float(np.min(m.gain_margin_db))),
        max(needs.peak_sensitivity, float(np.max(m.peak_sensitivity))) / SLACK,
    )


def _safe(gains: CascadeGains, loops: Ensemble, least: tuple[float, float, float]) -> bool:
    m = loops.margins(gains)
    kept = (
        np.min(m.phase_margin_deg) >= least[0]
        and np.min(m.gain_margin_db) >= least[1]
        and np.max(m.peak_sensitivity) <= least[2]
    )
    return bool(kept and not loops.unstable(gains).any())
