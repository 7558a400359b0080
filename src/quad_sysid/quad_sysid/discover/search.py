"""Search over structures by their evidence: every explanation pays the same price."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.discover.screen import Score, candidates, screen, vibration_line
from quad_sysid.estimate.fit import Fit, Problem, fit, start_of
from quad_sysid.model.effect import Effect, Part
from quad_sysid.model.plant import Structure

EXPECTED = 0.05
"""Prior probability that an effect is missing: shared alike by all names that can be tried, and of
each name by its variants (smoothnesses, motors, other axes)."""
BEAM = 2
"""Structures that are built upon at each level."""
REFITS = 5
"""Candidates that are fitted beside each of them."""
EXCHANGES = 3
"""Candidates that are fitted in the place of an effect of the best structure."""
MOST_EFFECTS = 4
HOPELESS = -8.0
"""Linear score plus log prior below which a candidate is not fitted, nats: about where it gains
nothing before its prior is counted."""
ABANDONED = 20.0
"""A structure so many nats behind the best of its size is not built upon."""
MOST_LINES = 3
"""Narrow lines of vibration that the noise may hold."""

Log = Callable[[str], None]


@dataclass(frozen=True)
class Scored:
    """A structure that was fitted, with log evidence plus log prior."""

    fit: Fit
    score: float


@dataclass(frozen=True)
class Found:
    """All structures that were fitted, best first."""

    base: Fit
    all: tuple[Scored, ...]
    reasons: dict[str, str]
    scored: int

    @property
    def best(self) -> Fit:
        """The most probable one."""
        return self.all[0].fit

    def probabilities(self) -> FloatArray:
        """Of each structure that was fitted, given the training segments."""
        scores = np.array([s.score for s in self.all])
        p = np.exp(scores - scores.max())
        out: FloatArray = p / p.sum()
        return out


class _Search:
    """What was fitted so far, by the labels of its effects."""

    def __init__(
        self, problem: Problem, parts: Sequence[Part], base: Fit, log: Log | None
    ) -> None:
        self.problem, self.parts, self.log = problem, parts, log or (lambda _: None)
        names = Counter(part.effect.name for part in parts)
        self.prices = {
            part.effect.label: math.log(EXPECTED / len(names) / names[part.effect.name])
            for part in parts
        }
        self.known: dict[frozenset[str], Scored] = {frozenset(): Scored(base, base.evidence)}
        self.screens: dict[frozenset[str], list[Score]] = {}

    def build_on(self, parent: Fit, refits: int) -> list[Scored]:
        """Structures with one more effect that linear scores speak for, fitted."""
        out = []
        for one in self.scores(parent)[:refits]:
            if one.nats + self.prices[one.part.effect.label] < HOPELESS:
                continue
            fitted = self.add(parent, one)
            if fitted is not None:
                out.append(fitted)
        return out

    def scores(self, parent: Fit) -> list[Score]:
        """Linear scores of what may be added to a structure, best first."""
        labels = frozenset(parent.structure.labels)
        if labels not in self.screens:
            rest = [p for p in self.parts if p.effect.label not in labels]
            self.screens[labels] = screen(self.problem, parent, rest)
            self.log(f'{parent.structure.labels}: ' + ', '.join(
                f'{s.part.effect.label} {s.nats:.1f}' for s in self.screens[labels][:8]
            ))
        return self.screens[labels]

    def add(self, parent: Fit, one: Score) -> Scored | None:
        """A structure with one more effect; None where it was fitted before or runs away."""
        labels = frozenset((*parent.structure.labels, one.part.effect.label))
        if labels in self.known:
            return None
        structure = parent.structure.plus(one.part)
        base = parent.theta.size - len(parent.structure.noise)
        tried: list[Fit] = []
        for start in one.starts:
            theta = np.r_[parent.theta[:base], start, parent.theta[base:]]
            try:
                tried.append(fit(self.problem, structure, theta, rate=parent.rate, most_steps=0))
            except (FloatingPointError, np.linalg.LinAlgError):
                continue
        if not tried:
            return None
        best = max(tried, key=lambda f: f.log_posterior)
        try:
            return self.keep(fit(self.problem, structure, best.theta, rate=best.rate))
        except (FloatingPointError, np.linalg.LinAlgError):
            return None

    def keep(self, fitted: Fit) -> Scored:
        """Note a fit with its score: log evidence plus log prior."""
        labels = frozenset(fitted.structure.labels)
        price = sum(self.prices[label] for label in labels)
        # effects come in any order: the list of a set counts once
        scored = Scored(fitted, fitted.evidence + price - math.lgamma(len(labels) + 1))
        self.known[labels] = scored
        self.log(f'    {fitted.structure.labels} {scored.score:.1f}, {fitted.steps} steps'
                 + ('' if fitted.converged else ', not converged'))
        return scored

    def best(self) -> Scored:
        """The most probable structure."""
        return max(self.known.values(), key=lambda s: s.score)

    def exchange(self) -> bool:
        """Try to put another effect in the place of each of the best; whether one was better."""
        best = self.best()
        if len(best.fit.structure.parts) < 2:
            return False
        for index in range(len(best.fit.structure.parts)):
            structure = best.fit.structure.minus(index)
            labels = frozenset(structure.labels)
            if labels not in self.known:
                where = best.fit.structure.slices()[index]
                keep = np.r_[0 : where.start, where.stop : best.fit.theta.size]
                self.keep(fit(self.problem, structure, best.fit.theta[keep], rate=best.fit.rate))
            self.build_on(self.known[labels].fit, EXCHANGES)
        return self.best() is not best


def search(problem: Problem, effects: Sequence[Effect], *, log: Log | None = None) -> Found:
    """The structures that the training segments speak for.

    A beam over structures, one effect at a time, until the evidence falls; then each effect of
    the best is exchanged for what else could stand there, until nothing is better.
    """
    parts, reasons = candidates(problem, effects)
    base = best_base(problem)
    problem.measure(base)
    found = _Search(problem, parts, base, log)
    beam = [found.best()]
    for _ in range(MOST_EFFECTS):
        top = max(s.score for s in beam)
        fresh = [s for parent in beam for s in found.build_on(parent.fit, REFITS)]
        fresh.sort(key=lambda s: -s.score)
        if not fresh or fresh[0].score <= top:
            break
        beam = [s for s in _unlike(fresh)[:BEAM] if s.score > fresh[0].score - ABANDONED]
    for _ in range(MOST_EFFECTS):
        if not found.exchange():
            break
    ordered = tuple(sorted(found.known.values(), key=lambda s: -s.score))
    return Found(base, ordered, reasons, sum(map(len, found.screens.values())))


def _unlike(ordered: Sequence[Scored]) -> list[Scored]:
    """The first of each set of names: two smoothnesses of a curve are one explanation."""
    out: dict[tuple[str, ...], Scored] = {}
    for one in ordered:
        out.setdefault(tuple(sorted(p.effect.name for p in one.fit.structure.parts)), one)
    return list(out.values())


def best_base(problem: Problem) -> Fit:
    """The base from several starts: its surface has more than one optimum in closed loop."""
    fits = []
    for way, lag, delay in ((1, 0.04, 0.01), (1, 0.005, 0.03), (1, 0.15, 0.005), (-1, 0.04, 0.01)):
        start = start_of(problem)
        start[0] *= way
        start[1], start[2] = math.log(lag), math.log(delay)
        try:
            fits.append(fit(problem, Structure(), start))
        except (FloatingPointError, np.linalg.LinAlgError):
            continue
    if not fits:
        raise FloatingPointError('no start of the base holds')
    base = max(fits, key=lambda f: f.log_posterior)
    for _ in range(MOST_LINES):
        shaken = with_vibration(problem, base)
        if shaken is None or shaken.evidence + math.log(EXPECTED) <= base.evidence:
            break
        base = shaken
    return base


def with_vibration(problem: Problem, base: Fit) -> Fit | None:
    """The base with one more narrow line in the gyro's noise, the strongest that is left."""
    frequency = vibration_line(problem, base)
    if frequency is None:
        return None
    try:
        return fit(
            problem, replace(base.structure, lines=base.structure.lines + 1),
            np.r_[base.theta, 0.0, math.log(frequency), math.log(0.1)], rate=base.rate,
        )
    except (FloatingPointError, np.linalg.LinAlgError):
        return None


__all__ = ['Found', 'Part', 'Scored', 'best_base', 'search']
