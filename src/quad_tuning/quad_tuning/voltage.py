"""The firmware's schedule on the battery's voltage, where the aircraft offers one and sags.

Commands are multiplied by (reference / voltage) ** exponent in flight (`<axis>.sag.*`), so the
gains are designed for one voltage and hold at all. What the schedule leaves, an exponent that is
not known exactly, is the ensemble's business.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from quad_sysid.model import AxisModel
from quad_tuning.bounds import BOUNDS, STEP_FACTOR

EFFECT = 'battery_sag'


def settings(model: AxisModel) -> dict[str, float]:
    """Both parameters by the contract's names; empty without sag or without the firmware's offer.

    Commands stay as they are at the flight's mean voltage, or at the reference that is set.
    """
    exponent, reference = (f'{model.axis}.sag.{name}' for name in ('exponent', 'reference_v'))
    mean = model.mean_battery_v
    found = any(effect.name == EFFECT for effect in model.effects)
    if not (found and mean and exponent in model.active_gains and reference in model.active_gains):
        return {}
    bound, volts = BOUNDS['sag.exponent'], BOUNDS['sag.reference_v']
    power = min(max(model.value(f'{EFFECT}.exponent'), bound.lower), bound.upper)
    at = model.active_gains[reference] if model.active_gains[exponent] > 0.0 else mean
    if power == bound.lower or not volts.lower <= at <= volts.upper:
        return {}
    return {exponent: power, reference: at}


def scheduled(model: AxisModel, chosen: Mapping[str, float]) -> AxisModel:
    """The model as the loop will be with the schedule."""
    return replace(model, active_gains={**model.active_gains, **chosen}) if chosen else model


def along(
    steps: Sequence[Mapping[str, float]], chosen: Mapping[str, float], active: Mapping[str, float]
) -> tuple[dict[str, float], ...]:
    """The updates with the schedule in them, its exponent as far in each as the gate lets it."""
    path = [{**step, **chosen} for step in steps]
    name = next((key for key in chosen if key.endswith('sag.exponent')), None)
    if name is None or not path:
        return tuple(path)
    now, wanted, small = active[name], chosen[name], BOUNDS['sag.exponent'].small_step
    k = 0
    while now != wanted:
        low, high = min(now / STEP_FACTOR, now - small), max(now * STEP_FACTOR, now + small)
        now = min(max(wanted, low), high)
        if k == len(path):
            path.append(dict(path[-1]))
        path[k][name] = now
        k += 1
    return tuple(path)
