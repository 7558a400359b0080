"""How well a flight separates two rivals: the log evidence of the true one over the other.

The flight is simulated with the true rival and noise; both are fitted as in an identification. A
deviation of d standard deviations that no parameter can absorb gives a difference of log evidences
of d²/2 nats with a standard deviation of d; so the true one has the larger evidence with
probability Phi(d/2).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import special

from quad_sysid.discover.base import fitted_from
from quad_sysid.discover.screen import Score, screen
from quad_sysid.estimate.fit import Fit, Problem, fit
from quad_sysid.model.data import AxisData
from quad_sysid.model.effect import ActingEffect, Part
from quad_sysid.model.structure import BASE, NOISE, Structure, coordinates
from quad_sysid.separation.flight import Aircraft

GAIN_KNOWN = 0.1
"""Relative standard error of the gain below which a flight identifies the base."""
LIKELY = 2.0
"""Most standard deviations of its prior that an effect is assumed to be strong."""
REACH = 4.0
"""Range of the search for a strength: prior standard deviations, or powers of e."""


@dataclass(frozen=True)
class Apart:
    """Evidence of the true rival over the fitted one, in a flight of `seconds`."""

    nats: float
    """Log evidence of the true one less that of the other."""
    mimicked: float
    """Share (0..1) of the true effect's evidence over no effect that the other reaches."""
    seconds: float

    def over(self, seconds: float) -> Apart:
        """The evidence of a longer or shorter flight of this kind (s)."""
        return Apart(self.nats * seconds / self.seconds, self.mimicked, seconds)

    @property
    def distance(self) -> float:
        """Separation d in standard deviations."""
        return math.copysign(math.sqrt(2.0 * abs(self.nats)), self.nats)

    @property
    def score(self) -> float:
        """Expected difference over its standard deviation."""
        return 0.5 * self.distance

    @property
    def probability(self) -> float:
        """Probability that the true one has the larger evidence."""
        return float(special.ndtr(self.score))

    def seconds_for(self, probability: float) -> float:
        """Length of flight, s, for this probability."""
        nats = 2.0 * float(special.ndtri(probability)) ** 2
        return math.inf if self.nats <= 0.0 else self.seconds * nats / self.nats


@dataclass
class JudgedFlight:
    """A flight with its model fitted without the rivals, for their comparison."""

    problem: Problem
    base: Fit
    scores: dict[str, Score] = field(default_factory=dict)
    """Linear scores of the rivals so far, by label."""

    @property
    def identified(self) -> bool:
        """Whether the flight identifies the base."""
        variance = np.linalg.inv(self.base.hessian)[0, 0]
        return bool(math.sqrt(variance) < GAIN_KNOWN * abs(self.base.theta[0]))

    def _ranked(self, parts: Sequence[Part]) -> list[Score]:
        """The linear scores of those rivals that are physical, best first."""
        new_parts = [part for part in parts if part.effect.label not in self.scores]
        for score in screen(self.problem, self.base, new_parts) if new_parts else []:
            self.scores[score.part.effect.label] = score
        scores = (self.scores.get(part.effect.label) for part in parts)
        return sorted((s for s in scores if s is not None), key=lambda s: -s.nats)

    def linear(self, parts: Sequence[Part]) -> float:
        """Evidence of the best of some rivals over nothing, by one linear step."""
        return max((score.nats for score in self._ranked(parts)), default=0.0)

    def fitted(self, parts: Sequence[Part]) -> float:
        """Largest evidence, nats, of the two variants that the linear step ranks first, fitted."""
        best = 0.0
        count = self.base.theta.size - len(NOISE)
        for score in self._ranked(parts)[:2]:
            for start in score.starts:
                theta = np.r_[self.base.theta[:count], start, self.base.theta[count:]]
                structure = self.base.structure.plus(score.part)
                fitted = fitted_from(self.problem, structure, theta, rate=self.base.rate)
                if fitted is not None:
                    best = max(best, fitted.evidence - self.base.evidence)
        return best

    def trace(self, acting: ActingEffect) -> float:
        """Evidence for an effect on this flight, nats, beyond what the base can explain."""
        flight, base = self.problem.flight, self.base
        count = base.theta.size - len(NOISE)
        values = base.values
        plain = flight.pushed(base.structure, values, base.rate)
        more = np.r_[values[:count], acting.p, values[count:]]
        added = flight.pushed(base.structure.plus(acting.part), more, base.rate)
        rows = self.problem.rows
        difference = np.mean(added.known - plain.known, axis=0)
        difference = difference + (added.slope - plain.slope) * base.rate
        columns = np.ascontiguousarray(difference[:, None])
        out = flight.responses(columns, plain.slope, base.prediction.filters)
        jacobian = np.vstack([np.asarray(base.prediction.jacobian)[rows] / base.tail.scale,
                              np.linalg.cholesky(base.precision).T])
        q = np.linalg.qr(jacobian)[0][: rows.size]
        c = out[rows, 0] / base.tail.scale
        return 0.5 * float(c @ c - np.sum((q.T @ c) ** 2))

    def sized(self, part: Part, target_nats: float) -> ActingEffect:
        """The effect at about the strength that gives `target_nats` on this flight, if it can be.

        Parameters that are zero without the effect are scaled (several in a direction drawn from
        their prior); otherwise the first parameter is searched over its prior.
        """
        specs = part.effect.parameters
        starts = list(part.effect.starts(self.problem.data, part.settings))
        p = np.array(starts[len(starts) // 2], dtype=float)
        p = np.array([math.exp(s.centre) if s.log and not v > 0.0 else v
                      for s, v in zip(specs, p, strict=True)])
        free = [j for j, s in enumerate(specs) if not s.log and p[j] == 0.0]
        if free:
            precision = part.effect.precision(part.settings, self.problem.sizes_of(part))
            root = np.linalg.cholesky(np.linalg.inv(precision[np.ix_(free, free)]))
            drawn = np.random.default_rng(0).standard_normal(len(free))
            direction = root @ (drawn / np.sqrt(np.mean(drawn**2)))
            if len(free) == 1:
                direction = np.abs(direction)
            scale = 0.1
            for _ in range(8):
                p[free] = scale * direction
                nats = self.trace(ActingEffect(part, p))
                scale *= float(np.clip(math.sqrt(target_nats / max(nats, 1e-12)), 0.05, 20.0))
                scale = min(scale, LIKELY)
            p[free] = scale * direction
            return ActingEffect(part, p)
        spread = specs[0].spread or 1.0
        reach = np.linspace(-REACH, REACH, 65)
        grid = p[0] * np.exp(reach) if specs[0].log else p[0] + 0.5 * spread * reach
        levels = [self.trace(ActingEffect(part, np.r_[value, p[1:]])) for value in grid]
        misses = np.abs(np.log(np.maximum(levels, 1e-12) / target_nats))
        return ActingEffect(part, np.r_[grid[int(np.argmin(misses))], p[1:]])


def judged(aircraft: Aircraft, data: AxisData) -> JudgedFlight:
    """Fit the model without the rivals to a flight, from the aircraft's own values."""
    problem = Problem(data, data.train)
    noise = aircraft.noise
    base = coordinates(BASE, aircraft.theta, 1e-4)
    noise_theta = np.log([max(noise.ratios.get(s.name, math.exp(s.centre)), 1e-3) for s in NOISE])
    fitted = fit(problem, Structure(), np.r_[base, noise_theta])
    problem.measure(fitted)
    if aircraft.acting:
        structure = Structure(tuple(acting.part for acting in aircraft.acting))
        values = [coordinates(acting.effect.parameters, acting.p) for acting in aircraft.acting]
        fitted = fit(problem, structure, np.concatenate([base, *values, noise_theta]))
    return JudgedFlight(problem, fitted)
