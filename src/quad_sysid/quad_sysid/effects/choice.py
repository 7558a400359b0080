"""Which trial is worth adding, and which of several that are: by cross-validation alone.

The search that calls this stands in discover.py; the final test on unseen data in judge.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

from quad_sysid.effects.candidate import Candidate, candidate, without
from quad_sysid.effects.crossval import compare
from quad_sysid.effects.curves import besides
from quad_sysid.effects.persistence import persists
from quad_sysid.effects.screening import (
    Columns,
    FirstLook,
    Screen,
    enters_linearly,
    sharp_p,
    vanishes,
)
from quad_sysid.effects.worth import CHANCE, LOSSES, SMALLEST_GAIN, SPRINGS, against_nature
from quad_sysid.greybox.fit import fit_structure, fit_with_effect, settle
from quad_sysid.greybox.noise import NoiseModel
from quad_sysid.greybox.one_step import sharpened
from quad_sysid.greybox.simulate import Simulator
from quad_sysid.greybox.structure import Effect, Prepared

MOST_EFFECTS = 3
SCREENED_GAIN = 0.005
"""What promises less than this to first order is not fitted."""
SCREENED_CURVE_GAIN = 0.012
COUPLE_GAIN = 0.05
"""Two effects at once must lower the error of the best single one by this share."""
AS_GOOD = 1.03
"""A name explains as much as a curve where its error is at most this much larger."""
NAMED_SHARE = 0.8
"""Where it can't be told which is better, a name must explain this share of what a curve does."""
NEARLY_ALL = 0.95
"""So is one that explains this share of what the curve explains, of the mean square."""
HIDDEN_SHARE = 0.9
"""A hidden state, which can mimic much, gives way to a name that explains this share of it."""
ROUGH = 3e-5
"""A trial is fitted until its sum of squares changes by less; what is chosen, to the end."""
OUTCLASSED = 1.3
"""What errs this much more than the best first look is not fitted to the end."""
MOST_FITTED = 6
"""So many of the best first looks are fitted at most."""
FOREMOST = 3
"""So many trials are fitted again with the state correction that suits them."""


def fitting(current: Candidate, put: Prepared) -> Prepared:
    """A curve that refines named effects of its signal leaves out what they can say."""
    effect, settings = put
    names = tuple(
        e.name for e in current.fit.structure.effects
        if e.kind == 'named' and set(e.signals) & set(effect.signals)
    )
    return besides(effect, settings, names) if effect.kind == 'shape' and names else put


@dataclass(frozen=True, eq=False)
class Trial:
    """One more effect on top of what is there, with its first look where it has one."""

    put: Prepared
    columns: Columns | None
    look: FirstLook | None


def looked_at(screen: Screen, put: Prepared) -> Trial:
    """The first look at one more effect."""
    added = screen.columns(*put) if vanishes(put[0]) else None
    linear = added is not None and enters_linearly(put[0])
    return Trial(put, added, screen.look([put], [added]) if added and linear else None)


def promising(looks: Sequence[Trial]) -> float:
    """The error that a first look must stay below to be fitted: the few best of them, and near."""
    scores = sorted(one.look.score for one in looks if one.look)
    if not scores:
        return float('inf')
    return min(OUTCLASSED * scores[0], scores[min(MOST_FITTED, len(scores)) - 1])


def fitted(
    screen: Screen, current: Candidate, one: Trial, bar: float
) -> Candidate | FirstLook:
    """The effect fitted and cross-validated, or its first look where that says enough.

    bar: what first looks must promise to be fitted (`promising`). What no first look can judge is
    fitted anyway, though not to the end where it stays far above.
    """
    effect, settings = one.put
    if one.look is not None:
        single = len(effect.parameters) == 1
        least = SCREENED_GAIN if single else SCREENED_CURVE_GAIN
        certain = single and one.look.p_value < CHANCE
        gains = one.look.score <= min((1.0 - least) * current.score, bar)
        if not gains and not certain:
            return one.look
    fit = fit_with_effect(
        screen.sim, current.fit, effect, settings,
        start=None if one.look is None else one.look.theta,
        hopeless=OUTCLASSED * min(bar, current.score), tolerance=ROUGH,
    )
    return candidate(screen.sim, fit)


def couples(
    screen: Screen, current: Candidate, trials: Sequence[Trial], best_alone: float
) -> tuple[list[Candidate], int]:
    """Two named effects at once, where each alone is masked by the other; how many were tried.

    best_alone: the smallest error that one effect reaches.
    """
    if len(current.names) + 2 > MOST_EFFECTS:
        return [], 0
    single = [
        (one.put, one.columns) for one in trials
        if one.columns is not None and one.put[0].kind == 'named'
        and len(one.put[0].parameters) == 1
    ]
    tried = [
        (first, second, screen.look([first, second], [a, b]))
        for (first, a), (second, b) in combinations(single, 2)
        if first[0].name != second[0].name
    ]
    out = []
    for first, second, look in sorted(tried, key=lambda one: one[2].score)[:FOREMOST]:
        chance = min(
            look.p_value,
            compare(current.errors, look.errors, screen.sim.windows, screen.sim.data.dt).p_value,
        )
        if look.score > (1.0 - COUPLE_GAIN) * best_alone or chance > CHANCE / len(tried):
            continue
        structure = current.fit.structure.with_effect(*first).with_effect(*second)
        out.append(candidate(screen.sim, fit_structure(screen.sim, structure, look.theta)))
    return out, len(tried)


def pairs(
    sim: Simulator, current: Candidate, good: Sequence[Candidate], prepared: Sequence[Prepared]
) -> list[Candidate]:
    """Where a curve leads: the pairs of named effects of its signal, which it may stand for.

    A hidden state can mimic anything: the foremost names are what it may stand for.
    """
    full = len(current.names) + 2 > MOST_EFFECTS
    if full or not good or not _added_unnamed(current, good[0]):
        return []
    last = good[0].fit.structure.effects[-1]
    foremost = [one.names[-1] for one in good if not _added_unnamed(current, one)][:FOREMOST]
    named = [
        put for put in prepared
        if put[0].kind == 'named' and put[0].name not in current.names
        and (
            put[0].name in foremost if last.kind == 'mode'
            else set(put[0].signals) == set(last.signals)
        )
    ]
    out = []
    for i, first in enumerate(named):
        one = fit_with_effect(sim, current.fit, *first)
        others = [put for put in named[i + 1 :] if put[0].name != first[0].name]
        out += [candidate(sim, fit_with_effect(sim, one, *second)) for second in others]
    return [one for one in out if not against_nature(sim, current, one, one.names[-1])]


def strongest(
    sim: Simulator, current: Candidate, good: Sequence[Candidate]
) -> tuple[Candidate, NoiseModel, Simulator]:
    """The best of the foremost, each with the state correction that suits it.

    A curve or a hidden state gives way to a name that explains as much; two names at once give way
    to one that does.
    """
    settled = []
    named = sorted((one for one in good if not _added_unnamed(current, one)), key=_score)
    single = [one for one in named if len(one.names) == len(current.names) + 1]
    for one in dict.fromkeys([*good[:FOREMOST], *named[:FOREMOST], *single[:1]]):
        fit, noise, own = settle(sim, one.fit)
        settled.append((candidate(own, fit), noise, own))
    best = min(settled, key=lambda item: item[0].score)
    unnamed = _added_unnamed(current, best[0])
    last = best[0].fit.structure.effects[-1]
    simpler = [
        item for item in settled
        if not _added_unnamed(current, item[0])
        and (not unnamed or same_signal(last, item[0].fit.structure.effects[-1]))
        and (unnamed or len(item[0].names) < len(best[0].names))
        and _explains_as_much(current, item[0], best[0], sim)
    ]
    return min(simpler, key=lambda item: item[0].score) if simpler else best


def _score(one: Candidate) -> float:
    return one.score


def _added_unnamed(current: Candidate, one: Candidate) -> bool:
    return one.curves > current.curves


def same_signal(unnamed: Effect, named: Effect) -> bool:
    """Whether a name can stand for it: a hidden state can mimic what acts through any signal."""
    return unnamed.kind != 'shape' or bool(set(unnamed.signals) & set(named.signals))


def _explains_as_much(
    current: Candidate, simple: Candidate, best: Candidate, sim: Simulator
) -> bool:
    """By its error, or because the data can't tell which is better."""
    if simple.score <= AS_GOOD * best.score:
        return True
    share = (current.score**2 - simple.score**2) / (current.score**2 - best.score**2)
    hidden = best.fit.structure.effects[-1].kind == 'mode'
    one_name = len(simple.names) == len(current.names) + 1
    # a friction along a curve is friction first, and the curve can be added on top
    friction = best.fit.structure.effects[-1].variant == 'friction'
    least = HIDDEN_SHARE if hidden else NAMED_SHARE if friction else NEARLY_ALL
    if one_name and share >= least:
        return True
    better = compare(simple.errors, best.errors, sim.windows, sim.data.dt)
    return share >= NAMED_SHARE and better.p_value > CHANCE


def backward(sim: Simulator, current: Candidate) -> Candidate:
    """Take out what the others made superfluous; a name never gives way to a curve."""
    for name in _absent(current):
        current = without(sim, current, name)
    for name in current.names:
        if not persists(sim, current.fit, name):  # what was added later took its place
            current = without(sim, current, name)
    current = _natural(sim, current)
    while len(current.names) > 1:
        effects = current.fit.structure.effects
        curves = {signal for e in effects if e.kind != 'named' for signal in e.signals}
        sharp = sharp_p(sim, current.fit)
        optional = [
            e.name for e, where in zip(effects, current.fit.structure.slices(), strict=True)
            if (e.kind != 'named' or not curves & set(e.signals))
            and not (
                where.stop - where.start == 1 and vanishes(e)
                and sharp[where.start] < 0.5 * CHANCE
            )
        ]
        reduced = [without(sim, current, name) for name in optional]
        if not reduced:
            break
        best = min(reduced, key=_score)
        lost = compare(best.errors, current.errors, sim.windows, sim.data.dt)
        if lost.p_value < CHANCE and current.score < (1.0 - SMALLEST_GAIN) * best.score:
            break
        current = best
    return current


def _natural(sim: Simulator, current: Candidate) -> Candidate:
    """Less what is against nature, by the free run or by the sharper one-step errors.

    Of two of a family the one goes that the other can do without.
    """
    sharp = replace(current, fit=sharpened(sim, current.fit))
    for family in (LOSSES, tuple(SPRINGS)):
        alike = [name for name in current.names if name in family]
        rests = [without(sim, current, name) for name in alike]
        if any(
            against_nature(sim, rest, one, name)
            for rest, name in zip(rests, alike, strict=True) for one in (current, sharp)
        ):
            return _natural(sim, min(rests, key=_score))
    return current


def renamed(sim: Simulator, current: Candidate, prepared: Sequence[Prepared]) -> Candidate:
    """Names in the place of curves and hidden states, where beside the rest they say as much.

    A curve that was best alone may be no more than a name once the others are there.
    """
    for effect in current.fit.structure.effects:
        if effect.kind == 'named' or len(current.names) < 2:
            continue
        rest = without(sim, current, effect.name)
        best: Candidate | None = None
        for put in prepared:
            if put[0].kind != 'named' or put[0].name in current.names:
                continue
            if not same_signal(effect, put[0]):
                continue
            one = candidate(sim, fit_with_effect(sim, rest.fit, *put, tolerance=ROUGH))
            if against_nature(sim, rest, one, put[0].name):
                continue
            if best is None or one.score < best.score:
                best = one
        if best is not None and _explains_as_much(rest, best, current, sim):
            current = best
    return current


def _absent(current: Candidate) -> list[str]:
    """Effects whose only parameter ended at zero."""
    structure, theta = current.fit.structure, current.fit.theta
    return [
        e.name for e, where in zip(structure.effects, structure.slices(), strict=True)
        if where.stop - where.start == 1 and vanishes(e) and theta[where.start] == 0.0
    ]
