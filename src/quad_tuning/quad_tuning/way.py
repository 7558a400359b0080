"""The way from the flown gains to the target: updates within the step limit, all of them safe.

Whoever goes there flies each set for some seconds, so each is held against the ensemble as the
target is. How far one update may go stands in bounds.py.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from quad_sysid.loop.cascade import CascadeGains
from quad_tuning.bounds import DESIGNED, reachable, steps_to
from quad_tuning.ensemble import Ensemble
from quad_tuning.errors import DesignRefusedError
from quad_tuning.objective import Requirements, meets

SLACK = 0.85
"""A set on the way, which is flown for seconds, keeps this share of what the flown gains keep, or
FOR_SECONDS, whichever is less."""
FOR_SECONDS = Requirements(phase_margin_deg=30.0, gain_margin_db=6.0, peak_sensitivity=2.2)
HALTS = (0.85, 0.7, 0.55, 0.4, 0.25)
"""Shares of the way, by ratio, at which an update may halt."""


@dataclass(frozen=True)
class Way:
    """Sets of gains from the first update to the last, and how far the first message may ask.

    Who is told `told` goes there with every gain as far as it may in each step.
    """

    steps: tuple[CascadeGains, ...]
    told: CascadeGains


def way_to(wanted: CascadeGains, active: CascadeGains, loops: Ensemble) -> Way:
    """A safe way to `wanted`; raises DesignRefusedError where each that was tried is not.

    Tried are: every gain as far as it may go in each step; the same with a halt between; all by
    equal ratios.
    """
    least = least_on_the_way(active, loops)
    for way in _tried(wanted, active):
        if all(_safe(gains, loops, least) for gains in way.steps[:-1]):
            return way
    raise DesignRefusedError(
        'every way from the flown gains to the best ones leads through gains with poor margins; '
        'lower rate.kp by hand first'
    )


def _tried(wanted: CascadeGains, active: CascadeGains) -> Iterator[Way]:
    together = steps_to(wanted, active)
    yield Way(together, wanted)
    for share in HALTS:
        halt = _between(active, wanted, share)
        yield Way((*steps_to(halt, active), *steps_to(wanted, halt)), halt)
    even = _even(wanted, active, len(together))
    if even:
        yield Way(even, even[0])


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
    for field in DESIGNED:
        a, b = getattr(active, field), getattr(wanted, field)
        values[field] = a * (b / a) ** share if min(a, b) > 0.0 else a + share * (b - a)
    return replace(active, **values)


def _within(following: CascadeGains, now: CascadeGains) -> bool:
    for field in DESIGNED:
        low, high = reachable(field, getattr(now, field))
        if not low * (1 - 1e-9) <= getattr(following, field) <= high * (1 + 1e-9):
            return False
    return True


def least_on_the_way(active: CascadeGains, loops: Ensemble) -> Requirements:
    """The margins that a set which is flown for seconds keeps."""
    m = loops.margins(active)
    return Requirements(
        phase_margin_deg=min(FOR_SECONDS.phase_margin_deg,
                             SLACK * float(np.min(m.phase_margin_deg))),
        gain_margin_db=min(FOR_SECONDS.gain_margin_db, SLACK * float(np.min(m.gain_margin_db))),
        peak_sensitivity=max(FOR_SECONDS.peak_sensitivity,
                             float(np.max(m.peak_sensitivity)) / SLACK),
    )


def _safe(gains: CascadeGains, loops: Ensemble, least: Requirements) -> bool:
    return bool(meets(loops.margins(gains), least).all() and not loops.unstable(gains).any())
