"""Search over structures by their evidence: every explanation pays the same price."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.discover.screen import Score, candidates, screen, vibration_line
from quad_sysid.estimate.fit import Fit, Problem, fit, start_of
from quad_sysid.model.effect import Part
from quad_sysid.model.plant import Structure

EXPECTED = 0.05
"""Prior probability that an effect is missing, shared by all candidates (log odds each)."""
BEAM = 3
"""Structures that are built upon at each level."""
REFITS = 6
"""Candidates that are fitted beside each of them."""
MOST_EFFECTS = 4
MOST_LINES = 3
"""Narrow lines of vibration that the noise may hold."""


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


def extended(fitted: Fit, score: Score) -> FloatArray:
    """Start of a fit with one more effect."""
    base = fitted.theta.size - len(fitted.structure.noise)
    return np.r_[fitted.theta[:base], score.start, fitted.theta[base:]]


def search(problem: Problem, effects: Sequence, *, log=None) -> Found:  # type: ignore[no-untyped-def, type-arg]  # noqa: ANN001
    """The structures that the training segments speak for."""
    parts, reasons = candidates(problem, effects)
    price = math.log(EXPECTED / max(len(parts), 1))
    base = best_base(problem)
    known: dict[frozenset[str], Scored] = {
        frozenset(): Scored(base, base.evidence)
    }
    beam = [known[frozenset()]]
    scored = 0
    for level in range(MOST_EFFECTS):
        fresh: list[Scored] = []
        for parent in beam:
            have = set(parent.fit.structure.labels)
            rest = [p for p in parts if p.effect.label not in have]
            scores = screen(problem, parent.fit, rest)
            scored += len(scores)
            if log:
                log(f'{level} {parent.fit.structure.labels} {parent.score:.1f}: ' + ', '.join(
                    f'{s.part.effect.label} {s.nats:.1f}' for s in scores[:8]))
            for one in scores[:REFITS]:
                if one.nats + price < -12.0:
                    break
                labels = frozenset((*have, one.part.effect.label))
                if labels in known:
                    continue
                try:
                    fitted = fit(problem, parent.fit.structure.plus(one.part),
                                 extended(parent.fit, one), rate=parent.fit.rate)
                except (FloatingPointError, np.linalg.LinAlgError):
                    continue
                known[labels] = Scored(
                    fitted, fitted.evidence + price * len(fitted.structure.parts)
                    - math.lgamma(len(labels) + 1)
                )
                if log:
                    log(f'    {fitted.structure.labels} {known[labels].score:.1f} {fitted.steps}{"" if fitted.converged else " NOT CONVERGED"}')
                fresh.append(known[labels])
        top = max(s.score for s in beam)
        fresh.sort(key=lambda s: -s.score)
        if not fresh or fresh[0].score <= top:
            break
        beam = [s for s in fresh[:BEAM] if s.score > fresh[0].score - 20.0]
    ordered = tuple(sorted(known.values(), key=lambda s: -s.score))
    return Found(base, ordered, reasons, scored)


def best_base(problem: Problem) -> Fit:
    """The base from several starts: its surface has more than one optimum in closed loop."""
    fits = []
    for lag, delay in ((0.04, 0.01), (0.005, 0.03), (0.15, 0.005)):
        start = start_of(problem)
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
        if shaken is None or shaken.evidence <= base.evidence:
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
