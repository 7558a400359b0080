"""The steps from the flown gains to the target, all within the step limit and safe.

Each step is flown for some seconds, so each is checked against the ensemble, as the target is.
bounds.py has the step limit.
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
"""A step must keep this share of the flown gains' margins, or FOR_SECONDS, whichever is less."""
FOR_SECONDS = Requirements(phase_margin_deg=30.0, gain_margin_db=6.0, peak_sensitivity=2.2)
HALTS = (0.85, 0.7, 0.55, 0.4, 0.25)
"""Shares of the way (by ratio) at which a design may stop."""


@dataclass(frozen=True)
class Way:
    """The steps to the target, and `told`, the gains of the first message.

    The bridge goes to `told` with each gain changing as far as it may in each step.
    """

    steps: tuple[CascadeGains, ...]
    told: CascadeGains


def way_to(wanted: CascadeGains, active: CascadeGains, loops: Ensemble) -> Way:
    """A safe way to `wanted`; raises DesignRefusedError where none was found.

    Three kinds are tried: each gain changes as far as it may in each step; the same up to a halt;
    all gains change by equal ratios.
    """
    least = least_on_the_way(active, loops)
    for way in _tried(wanted, active):
        if all(meets(loops.margins(gains), least).all() and not loops.unstable(gains).any()
               for gains in way.steps[:-1]):
            return way
    raise DesignRefusedError(
        'all steps from the flown gains to the best ones lead through gains with poor margins; '
        'lower rate.kp by hand first'
    )


def _tried(wanted: CascadeGains, active: CascadeGains) -> Iterator[Way]:
    together = steps_to(wanted, active)
    yield Way(together, wanted)
    for share in HALTS:
        halt = _between(active, wanted, share)
        yield Way((*steps_to(halt, active), *steps_to(wanted, halt)), halt)
    # equal ratios (equal differences for gains near zero) in as many updates as it takes
    for count in range(max(len(together), 1), 65):
        path = [*(_between(active, wanted, k / count) for k in range(1, count)), wanted]
        if all(_within(then, now) for now, then in zip([active, *path], path, strict=False)):
            yield Way(tuple(path), path[0])
            return


def _between(active: CascadeGains, wanted: CascadeGains, share: float) -> CascadeGains:
    values = {}
    for field in DESIGNED:
        a, b = getattr(active, field), getattr(wanted, field)
        values[field] = a * (b / a) ** share if min(a, b) > 0.0 else a + share * (b - a)
    return replace(active, **values)


def _within(following: CascadeGains, now: CascadeGains) -> bool:
    limits = ((field, reachable(field, getattr(now, field))) for field in DESIGNED)
    return all(low * (1 - 1e-9) <= getattr(following, field) <= high * (1 + 1e-9)
               for field, (low, high) in limits)


def least_on_the_way(active: CascadeGains, loops: Ensemble) -> Requirements:
    """The margins that a step must keep."""
    m = loops.margins(active)
    return Requirements(
        phase_margin_deg=min(FOR_SECONDS.phase_margin_deg,
                             SLACK * float(np.min(m.phase_margin_deg))),
        gain_margin_db=min(FOR_SECONDS.gain_margin_db, SLACK * float(np.min(m.gain_margin_db))),
        peak_sensitivity=max(FOR_SECONDS.peak_sensitivity,
                             float(np.max(m.peak_sensitivity)) / SLACK),
    )
