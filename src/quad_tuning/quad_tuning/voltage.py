"""The firmware's schedule on the battery's voltage, where a model has battery sag.

A firmware that offers it multiplies commands by (reference / voltage) ** exponent
(`<axis>.sag.*`), so one set of gains suits all voltages.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from quad_sysid.model import AxisModel
from quad_tuning.bounds import BOUNDS, STEP_FACTOR

EFFECT = 'battery_sag'


def settings(model: AxisModel) -> dict[str, float]:
    """Exponent and reference by the contract's names; empty without sag or such a firmware.

    Commands are not scaled at the reference: the active one, else the flight's mean voltage.
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
    """The model with the schedule active."""
    return replace(model, active_gains={**model.active_gains, **chosen}) if chosen else model


def along(steps: Sequence[Mapping[str, float]], chosen: Mapping[str, float],
          active: Mapping[str, float]) -> tuple[dict[str, float], ...]:
    """The steps with the schedule, its exponent in each as far as the gate allows."""
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
