"""How probable each effect is against what could stand in its place.

Only what came near when it was chosen is fitted in its place; the others count as ruled out.
"""

from __future__ import annotations

from collections.abc import Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.effects.candidate import Candidate, candidate, without
from quad_sysid.effects.choice import AS_GOOD, NEARLY_ALL, ROUGH, fitting, same_signal
from quad_sysid.effects.persistence import persists
from quad_sysid.effects.screening import vanishes
from quad_sysid.effects.worth import against_nature
from quad_sysid.greybox.fit import Fit, fit_structure, fit_with_effect
from quad_sysid.greybox.one_step import BAND_HZ, block_of_rows, one_step, slow_errors
from quad_sysid.greybox.simulate import Simulator
from quad_sysid.greybox.structure import Prepared

MOST_RIVALS = 4
"""So many of the nearest others are fitted in the place of a chosen effect."""
SUPERFLUOUS = 0.9
"""A name goes where the curve alone is the better model with this probability."""
OUTDONE = 0.95
"""So likely, at Schwarz's price of a parameter, must be what takes the place of a name unnamed."""
EVIDENCE = 30.0
"""And so much less its deviance: models that are nearly the same differ by a few, yet surely."""
AKAIKE = 2.0
"""Price of a parameter in the criterion."""
FRICTION = 'coulomb_friction'


Shares = tuple[tuple[str, float], ...]
"""(name, probability) of all that could stand in a place, most probable first."""


def settled(
    sim: Simulator, current: Candidate, name: str, prepared: Sequence[Prepared],
    near: AbstractSet[str], rng: np.random.Generator,
) -> tuple[Candidate, str, Shares]:
    """The more probable name in the place of `name`, and the probabilities of all that could be.

    The free run chose `name`; where it can hardly tell it from another and the one-step errors,
    which are sharper, say that the other is more probable than all the rest, that one is taken.
    Where the other is against nature both are the shape of something else, and go: no name. So
    does a name whose likelier rival ends as nothing.
    """
    labels, one_of, shares = _contest(sim, current, name, prepared, near, rng)
    first, chance = shares[0]
    kind = next(e.kind for e in current.fit.structure.effects if e.name == name)
    if first == name or chance < 0.5 or kind != 'named' or first in current.names:
        return current, name, shares
    best = min(
        (one for label, one in zip(labels, one_of, strict=True) if label == first), key=_score
    )
    rest = without(sim, best, first)
    if against_nature(sim, rest, best, first) or _is_nothing(best, first):
        return rest, '', ()
    alike = best.score <= AS_GOOD * current.score and len(best.names) == len(current.names)
    if not alike or not persists(sim, best.fit, first):
        return current, name, shares
    best = candidate(sim, fit_structure(sim, best.fit.structure, best.fit.theta))
    near = {*near, name} - {first}
    return best, first, _contest(sim, best, first, prepared, near, rng)[2]


def _is_nothing(one: Candidate, name: str) -> bool:
    """Whether an effect that is gone at zero ended there: the rest alone says as much."""
    structure = one.fit.structure
    index = [e.name for e in structure.effects].index(name)
    gone = not one.fit.theta[structure.slices()[index]].any()
    return gone and vanishes(structure.effects[index])


def _score(one: Candidate) -> float:
    return one.score


def _contest(
    sim: Simulator, current: Candidate, name: str, prepared: Sequence[Prepared],
    near: AbstractSet[str], rng: np.random.Generator,
) -> tuple[list[str], list[Candidate], Shares]:
    """All that could stand in the place of `name`, fitted, itself included.

    A name may be replaced by names, and by a curve of its signal that is there beside it; a curve
    by anything. `near`: what came close to it when it was chosen.
    """
    kind = next(e.kind for e in current.fit.structure.effects if e.name == name)
    rest = without(sim, current, name)
    others = [
        fitting(rest, put) for put in prepared
        if put[0].name in near and (kind != 'named' or put[0].kind == 'named')
    ]
    labels = [name, *(put[0].name for put in others)]
    one_of = [current, *(_put(sim, rest, put) for put in others)]
    if kind == 'named':
        for label, alone in _curves_alone(sim, current, name, prepared):
            labels.append(label)
            one_of.append(alone)
    weights = selection_probabilities(sim, [one.fit for one in one_of], rng)
    summed: dict[str, float] = {}
    for label, weight in zip(labels, weights, strict=True):
        summed[label] = summed.get(label, 0.0) + float(weight)
    return labels, one_of, tuple(sorted(summed.items(), key=lambda pair: -pair[1]))


def _put(sim: Simulator, rest: Candidate, put: Prepared) -> Candidate:
    return candidate(sim, fit_with_effect(sim, rest.fit, *put, tolerance=ROUGH))


def selection_probabilities(
    sim: Simulator, fits: Sequence[Fit], rng: np.random.Generator, draws: int = 2000
) -> FloatArray:
    """(m,) how often each of m models is the best by Akaike's criterion on resampled blocks.

    Bayesian bootstrap (Rubin 1981) over blocks of the low-passed one-step errors, each model at
    the parameters that fit them best.
    """
    errors = _one_step_errors(sim, fits)
    weights = rng.dirichlet(np.ones(errors.summed.shape[1]), size=draws)
    best = errors.criterion(weights, AKAIKE).argmin(axis=1)
    return np.asarray(np.bincount(best, minlength=len(fits)) / draws)


@dataclass(frozen=True, eq=False)
class _OneStepErrors:
    summed: FloatArray
    """(m, blocks) squares of the low-passed errors, each model at what fits them best."""
    size: np.ndarray
    """(m,) free parameters."""
    samples: float
    """Independent ones."""

    def criterion(self, weights: FloatArray, price: float) -> FloatArray:
        """(draws, m) deviance with blocks weighted (draws, blocks), and a price per parameter."""
        squares = np.maximum(weights @ self.summed.T, 1e-300)
        return np.asarray(self.samples * np.log(squares) + price * self.size)


def _one_step_errors(sim: Simulator, fits: Sequence[Fit]) -> _OneStepErrors:
    block = block_of_rows(sim)
    count = int(block.max()) + 1
    summed = np.empty((len(fits), count))
    for row, fit in zip(summed, fits, strict=True):
        theta = one_step(sim, fit).theta if not fit.prior.size else fit.theta
        row[:] = np.bincount(block, slow_errors(sim, fit.structure, theta) ** 2, minlength=count)
    samples = block.size * min(1.0, 2.0 * BAND_HZ * sim.data.dt)
    size = np.array([int((~fit.at_bound).sum()) for fit in fits])
    return _OneStepErrors(summed, size, samples)


def outdone(
    sim: Simulator, current: Candidate, name: str, unnamed: Sequence[Prepared],
    rng: np.random.Generator, draws: int = 2000,
) -> Candidate:
    """With a curve or hidden state in the place of `name` where free run and one step ask for it.

    A name goes before what explains hardly more in the free run, but that may be blunt: there
    hysteresis looks like a cubic spring. The one-step errors tell them apart. Friction gives way
    to no curve of the rate, which is friction too.
    """
    rest = without(sim, current, name)
    own = next(e for e in current.fit.structure.effects if e.name == name)
    others = [
        _put(sim, rest, fitting(rest, put)) for put in unnamed
        if same_signal(put[0], own) and not (name == FRICTION and put[0].kind == 'shape')
    ]
    others = [one for one in others if one.score < current.score]
    if not others:
        return current
    errors = _one_step_errors(sim, [one.fit for one in (current, *others)])
    blocks = errors.summed.shape[1]
    drawn = errors.criterion(
        rng.dirichlet(np.ones(blocks), size=draws), float(np.log(errors.samples))
    )
    best = 1 + int(drawn.mean(axis=0)[1:].argmin())
    likely = float(np.mean(drawn[:, best] < drawn[:, 0]))
    deviance = errors.criterion(np.full((1, blocks), 1.0 / blocks), 0.0)[0]
    other = others[best - 1]
    clearly = likely >= OUTDONE and deviance[0] - deviance[best] >= EVIDENCE
    if not clearly or not persists(sim, other.fit, other.names[-1]):
        return current
    return candidate(sim, fit_structure(sim, other.fit.structure, other.fit.theta))


def less_named(
    sim: Simulator, current: Candidate, prepared: Sequence[Prepared], rng: np.random.Generator
) -> Candidate:
    """Names taken back that a curve of their signal, which is there anyway, makes superfluous."""
    for effect in current.fit.structure.effects:
        if effect.kind != 'named' or effect.name not in current.names:
            continue
        for label, alone in _curves_alone(sim, current, effect.name, prepared):
            if _says_nearly_all(sim, current, effect.name, label):
                continue
            chances = selection_probabilities(sim, [current.fit, alone.fit], rng)
            if chances[1] > SUPERFLUOUS and alone.score <= 1.01 * current.score:
                current = alone
                break
    return current


def _says_nearly_all(sim: Simulator, current: Candidate, name: str, curve: str) -> bool:
    """Whether a name alone explains nearly all of what it explains together with a curve."""
    effect = next(e for e in current.fit.structure.effects if e.name == curve)
    if effect.variant == 'friction':
        return True  # friction first, its curve on top
    named = without(sim, current, curve)
    neither = without(sim, named, name)
    gained = neither.score**2 - current.score**2
    return gained > 0.0 and neither.score**2 - named.score**2 >= NEARLY_ALL * gained


def _curves_alone(
    sim: Simulator, current: Candidate, name: str, prepared: Sequence[Prepared]
) -> list[tuple[str, Candidate]]:
    """A curve that refines `name`, widened so that it may say all that the name said."""
    structure = current.fit.structure
    own = next(e for e in structure.effects if e.name == name)
    out = []
    for effect, settings in zip(structure.effects, structure.settings, strict=True):
        if effect.kind != 'shape' or not set(effect.signals) & set(own.signals):
            continue
        put = next(
            p for p in prepared if (p[0].name, p[0].variant) == (effect.name, effect.variant)
        )
        rest = without(sim, without(sim, current, name), effect.name)
        whole = fitting(rest, put)
        if whole[1] != settings:
            out.append((effect.name, _put(sim, rest, whole)))
    return out
