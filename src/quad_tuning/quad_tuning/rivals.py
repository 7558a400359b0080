"""What the data could not tell from the model: the same axis with a rival in an effect's place.

A rival of the same signal gets the strength with which it does the same over the flown range; any
other rival is stood for by the model without the effect. Nothing is drawn or judged here.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from quad_sysid.loop.from_model import CURVES
from quad_sysid.model import AxisModel, EffectEstimate, Parameter

LEAST_PROBABILITY = 0.02
"""A rival below this is ruled out."""
FLOWN = {'rate': 1.5, 'angle': 0.25}
"""Amplitude of the signal over which two curves are matched, rad/s and rad."""
ONE_PARAMETER = {
    'coulomb_friction': 'torque',
    'quadratic_drag': 'coefficient',
    'pendulum_stiffness': 'stiffness',
    'cubic_stiffness': 'stiffness',
}
"""Torques that are proportional to one parameter."""


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
    known = CURVES.get(effect.name), CURVES.get(name)
    if known[0] is not None and known[1] is not None and known[0][0] == known[1][0]:
        matched = _matched(effect, name, model.dt)
        if matched is not None:
            return _reduced(model, (*rest, matched))
    return _reduced(model, rest)


def _matched(effect: EffectEstimate, name: str, dt: float) -> EffectEstimate | None:
    """The rival whose torque is nearest the effect's over a sine of the flown amplitude."""
    signal, curve = CURVES[effect.name]
    if name not in ONE_PARAMETER or signal not in FLOWN:
        return None
    x = FLOWN[signal] * np.sin((np.arange(256) + 0.5) * (2.0 * np.pi / 256))
    wanted = curve({p.name: p.value for p in effect.parameters}, dt)(x)
    unit = CURVES[name][1]({ONE_PARAMETER[name]: 1.0}, dt)(x)
    size = float(np.dot(unit, wanted) / np.dot(unit, unit))
    parameter = Parameter(ONE_PARAMETER[name], size, None, '')
    return EffectEstimate(name, 'named', effect.signals, (parameter,))


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
