"""Which trials lower the error beyond chance, by enough, and for a reason that is the aircraft's.

How trials come about and which of them is taken stands in choice.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from quad_sysid.effects.candidate import Candidate
from quad_sysid.effects.crossval import compare
from quad_sysid.effects.persistence import persists
from quad_sysid.effects.screening import sharp_p, vanishes
from quad_sysid.greybox.simulate import Simulator

CHANCE = 0.02
"""Level of the cross-validated paired test, shared out over the candidates that were tried."""
SMALLEST_GAIN = 0.015
"""An effect that lowers the cross-validated error by less than this share is not worth a name."""
HARMLESS = 1.005
"""An effect that is certain by the one-step errors may not raise the free-run error by more."""
REFINEMENT_GAIN = 0.10
"""A curve on top of a named effect of the same signal must lower the error by this share."""
PLACES = 1000
"""So many beginnings and ends of an event are tried, more or less."""
MOST_ASKED = 8
"""So many of the best are asked whether they stand in the wind; the rest fall behind them."""
DRAG = 'quadratic_drag'
LOSSES = (DRAG, 'coulomb_friction')
"""Effects that only take energy away, as the base's damping does."""
SPRINGS: dict[str, Callable[[float], float]] = {
    'pendulum_stiffness': math.sin, 'cubic_stiffness': lambda angle: angle**3,
}
"""Torques along the angle, per unit of stiffness."""
LARGEST_PCT = 99.0
WEAK = 0.5
"""Of two springs against each other one that is weaker than this share of the other, at the
largest angles, only bends the other's curve."""
FALLEN = 3.0
"""Standard errors by which a damping must have fallen where it ends just below zero."""


def worthy(
    current: Candidate, trials: Sequence[Candidate], sim: Simulator, count: int
) -> list[Candidate]:
    """The trials that lower the error beyond chance and by enough, best first.

    count: how many were looked at, screened ones included. One parameter that the one-step errors
    see beyond chance is enough, however little it lowers the free-run error of these data; not on
    top of a curve or hidden state, whose own coarseness they would see as well.
    """
    good = []
    for one in trials:
        level = CHANCE / count
        small = one.score >= (1.0 - _least(current, one)) * current.score
        chance = compare(current.errors, one.errors, sim.windows, sim.data.dt).p_value
        if one.fit.structure.effects[-1].kind == 'event':
            chance = min(1.0, PLACES * float(sharp_p(sim, one.fit)[-1]))
        single = one.fit.theta.size - current.fit.theta.size == 1
        if single and vanishes(one.fit.structure.effects[-1]):
            if one.score > HARMLESS * current.score:
                continue
            sharp = 2.0 * float(sharp_p(sim, one.fit)[-1])
            small = small and (sharp >= level or current.curves > 0)
            chance = min(2.0 * chance, sharp)
        paid = against_nature(sim, current, one, one.names[-1])
        if not small and chance < level and not paid:
            good.append(one)
    good = sorted(good, key=lambda one: one.score)[:MOST_ASKED]
    return [one for one in good if _stands(sim, current, one)]


def _stands(sim: Simulator, current: Candidate, one: Candidate) -> bool:
    """Whether what is added shows without what is slow, and does not mend a curve's coarseness."""
    curves = [set(e.signals) for e in current.fit.structure.effects if e.kind == 'shape']
    added = [e for e in one.fit.structure.effects if e.name not in current.names]
    return not any(e.kind == 'named' and set(e.signals) in curves for e in added) and all(
        persists(sim, one.fit, e.name) for e in added
    )


def against_nature(sim: Simulator, rest: Candidate, one: Candidate, added: str) -> bool:
    """Whether `added` and what is beside it are together the shape of something else.

    A loss that is paid for by a viscous damping below zero: friction that falls with the rate
    (Stribeck) looks like drag beside a negative damping; alone it is still friction. A weak spring
    against a stronger one. rest: the model without `added`.
    """
    if added in SPRINGS:
        return _weak_against_strong(sim, one)
    if added not in LOSSES or DRAG not in one.names:
        return False
    damping, error = float(one.fit.theta[3]), float(one.fit.std[3])
    fallen = float(rest.fit.theta[3]) - damping
    below = damping < -0.5 * error and fallen > 0.0
    return below or (damping < 0.0 and fallen > FALLEN * error)


def _weak_against_strong(sim: Simulator, one: Candidate) -> bool:
    """Soft stops look like a cubic spring that a weak negative pendulum flattens."""
    angle = sim.data.angle
    structure = one.fit.structure
    where = dict(zip((e.name for e in structure.effects), structure.slices(), strict=True))
    if angle is None or not set(SPRINGS) <= set(where):
        return False
    inside = np.concatenate([angle[a:b] for a, b in sim.spans])
    far = float(np.nanpercentile(np.abs(inside), LARGEST_PCT))
    first, second = (
        float(one.fit.theta[where[name].start]) * curve(far)
        for name, curve in SPRINGS.items()
    )
    weak, strong = sorted((abs(first), abs(second)))
    return first * second < 0.0 and weak < WEAK * strong


def _least(current: Candidate, one: Candidate) -> float:
    """Share of the error that a trial must take away: more where a curve refines a name."""
    signals = {s for e in current.fit.structure.effects for s in e.signals}
    added = one.fit.structure.effects[-1]
    refines = added.kind == 'shape' and bool(signals & set(added.signals))
    return REFINEMENT_GAIN if refines else SMALLEST_GAIN
