"""What the data could not tell from the model: the same axis with a rival in an effect's place.

A rival of the same signal gets the strength with which it does the same over the flown range; any
other rival is stood for by the model without the effect. Nothing is drawn or judged here.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from quad_sysid.effects import EFFECTS
from quad_sysid.estimate.stored import estimate_of
from quad_sysid.loop.from_model import Placed, placed
from quad_sysid.model import AxisModel, EffectEstimate
from quad_sysid.model.effect import Effect, Part

LEAST_PROBABILITY = 0.02
"""A rival below this is ruled out."""
FLOWN = {'rate': 1.5, 'angle': 0.25}
"""Amplitude of the signal over which two curves are matched, rad/s and rad."""
REST = {'throttle': 0.5, 'battery': 1.0}


def variants(model: AxisModel) -> tuple[tuple[float, AxisModel], ...]:
    """The model and those with a rival in the place of one effect; probabilities sum to 1."""
    out = [(float(np.prod([_own(effect) for effect in model.effects])), model)]
    for effect in model.effects:
        others = float(np.prod([_own(e) for e in model.effects if e is not effect]))
        for name, probability in effect.rivals:
            if probability >= LEAST_PROBABILITY:
                out.append((probability * others, _with_rival(model, effect, name)))
    total = sum(weight for weight, _ in out)
    if not total > 0.0:
        return ((1.0, model),)
    return tuple((weight / total, variant) for weight, variant in out)


def shares(weights: tuple[float, ...], count: int) -> tuple[int, ...]:
    """How many of `count` draws each weight gets: the largest remainders get the rest."""
    exact = np.array(weights) / np.sum(weights) * count
    whole = np.floor(exact).astype(int)
    for index in np.argsort(whole - exact, kind='stable')[: count - int(whole.sum())]:
        whole[index] += 1
    return tuple(int(n) for n in whole)


def _own(effect: EffectEstimate) -> float:
    return min(max(effect.probability, 0.0), 1.0)


def _with_rival(model: AxisModel, effect: EffectEstimate, name: str) -> AxisModel:
    rest = tuple(e for e in model.effects if e is not effect)
    matched = _matched(placed(model, effect), name)
    return _reduced(model, rest if matched is None else (*rest, matched))


def _matched(found: Placed, name: str) -> EffectEstimate | None:
    """The rival whose torque is nearest the effect's over a sine of the flown amplitude."""
    rival = next((e for e in EFFECTS if e.name == name), None)
    signal = found.effect.signals[0]
    if rival is None or signal not in FLOWN or not (_simple(found.effect) and _simple(rival)):
        return None
    if rival.signals != found.effect.signals:
        return None
    x = FLOWN[signal] * np.sin((np.arange(256) + 0.5) * (2.0 * np.pi / 256))
    wanted = found.torque(REST, x.size, **{signal: x})
    shape = np.array([
        1.0 if spec.spread is None else math.exp(spec.centre) for spec in rival.parameters
    ])
    unit = Placed(Part(rival), shape).torque(REST, x.size, **{signal: x})
    size = float(np.dot(unit, wanted) / np.dot(unit, unit))
    return estimate_of(name, (size,), rival.variant)


def _simple(effect: Effect) -> bool:
    """Whether it is a torque in proportion to its first parameter, the others of its form."""
    first, *form = (spec.spread is None for spec in effect.parameters)
    return effect.term == 'torque' and first and not any(form)


def _reduced(model: AxisModel, effects: tuple[EffectEstimate, ...]) -> AxisModel:
    """The model with other effects; rows of the covariance that lost their parameter go."""
    kept = {f'{e.name}.{p.name}' for e in effects for p in e.parameters}
    keep = [
        i for i, name in enumerate(model.parameter_names) if '.' not in name or name in kept
    ]
    covariance = model.covariance
    return replace(
        model,
        effects=effects,
        parameter_names=tuple(model.parameter_names[i] for i in keep),
        covariance=None if covariance is None else np.asarray(covariance)[np.ix_(keep, keep)],
    )
