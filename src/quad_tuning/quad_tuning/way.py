"""The steps from the flown gains to the target, all within the step limit and safe.

Each step is flown for some seconds, so each is checked against the ensemble, as the target is.
bounds.py has the step limit. With them goes the firmware's schedule on the battery's voltage,
where a model has battery sag: a firmware that offers it multiplies commands by
(reference / voltage) ** exponent (`<axis>.sag.*`), so one set of gains suits all voltages.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from quad_sysid.loop.cascade import CascadeGains
from quad_sysid.model import AxisModel
from quad_tuning.assess import Requirements, meets
from quad_tuning.bounds import BOUNDS, DESIGNED, reachable, steps_to
from quad_tuning.ensemble import Ensemble
from quad_tuning.errors import DesignRefusedError

SLACK = 0.85
"""A step must keep this share of the flown gains' margins, or FOR_SECONDS, whichever is less."""
FOR_SECONDS = Requirements(phase_margin_deg=30.0, gain_margin_db=6.0, peak_sensitivity=2.2)
HALTS = (0.85, 0.7, 0.55, 0.4, 0.25)
"""Shares of the way (by ratio) at which a design may stop."""


@dataclass(frozen=True)
class Way:
    """The steps to the target, and `first`, the gains of the first message.

    The bridge goes to `first` with each gain changing as far as it may in each step.
    """

    steps: tuple[CascadeGains, ...]
    first: CascadeGains


def way_to(target: CascadeGains, active: CascadeGains, loops: Ensemble) -> Way:
    """A safe way to `target`; raises DesignRefusedError where there is none.

    Three kinds are tried: each gain changes as far as it may in each step; the same up to a halt;
    all gains change by equal ratios.
    """
    least = least_on_the_way(active, loops)
    for way in _candidates(target, active, loops.axis):
        if all(meets(loops.margins(gains), least).all() and not loops.unstable(gains).any()
               for gains in way.steps[:-1]):
            return way
    raise DesignRefusedError(
        'all steps from the flown gains to the best ones lead through gains with poor margins; '
        'lower rate.kp by hand first'
    )


def _candidates(target: CascadeGains, active: CascadeGains, axis: str) -> Iterator[Way]:
    together = steps_to(target, active, axis)
    yield Way(together, target)
    for share in HALTS:
        halt = _between(active, target, share)
        yield Way((*steps_to(halt, active, axis), *steps_to(target, halt, axis)), halt)
    # equal ratios (equal differences for gains near zero) in as many updates as it takes
    for count in range(max(len(together), 1), 65):
        path = [*(_between(active, target, k / count) for k in range(1, count)), target]
        if all(_within(then, now, axis) for now, then in zip([active, *path], path, strict=False)):
            yield Way(tuple(path), path[0])
            return


def _between(active: CascadeGains, target: CascadeGains, share: float) -> CascadeGains:
    values = {}
    for field in DESIGNED:
        a, b = getattr(active, field), getattr(target, field)
        values[field] = a * (b / a) ** share if min(a, b) > 0.0 else a + share * (b - a)
    return replace(active, **values)


def _within(following: CascadeGains, now: CascadeGains, axis: str) -> bool:
    limits = ((field, reachable(field, getattr(now, field), axis)) for field in DESIGNED)
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


EFFECT = 'battery_sag'


def sag_settings(model: AxisModel) -> dict[str, float]:
    """Exponent and reference by the contract's names; empty without sag or such a firmware.

    Commands are not scaled at the reference: the active one, else the flight's mean voltage.
    """
    exponent, reference = (f'{model.axis}.sag.{name}' for name in ('exponent', 'reference_v'))
    mean = model.mean_battery_v
    sags = any(effect.name == EFFECT for effect in model.effects)
    if not (sags and mean and exponent in model.active_gains and reference in model.active_gains):
        return {}
    bound, volts = BOUNDS[exponent], BOUNDS[reference]
    power = min(max(model.value(f'{EFFECT}.exponent'), bound.lower), bound.upper)
    at = model.active_gains[reference] if model.active_gains[exponent] > 0.0 else mean
    if power == bound.lower or not volts.lower <= at <= volts.upper:
        return {}
    return {exponent: power, reference: at}


def with_schedule(steps: Sequence[Mapping[str, float]], chosen: Mapping[str, float],
                  active: Mapping[str, float]) -> tuple[dict[str, float], ...]:
    """The steps with the schedule, its exponent in each as far as the gate allows."""
    path = [{**step, **chosen} for step in steps]
    name = next((key for key in chosen if key.endswith('sag.exponent')), None)
    if name is None or not path:
        return tuple(path)
    now, target, k = active[name], chosen[name], 0
    while now != target:
        low, high = BOUNDS[name].one_step(now)
        now = min(max(target, low), high)
        if k == len(path):
            path.append(dict(path[-1]))
        path[k][name] = now
        k += 1
    return tuple(path)
