"""Search over structures by their evidence, under one prior for all."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np

from quad_sysid.beside import side_by_side
from quad_sysid.contract import FloatArray
from quad_sysid.discover.base import (
    FAR_BEHIND,
    ROUGH_NATS,
    Candidate,
    best_base,
    both_orders,
    compared_fits,
    fit_without,
    fitted_from,
    most_probable,
    second_reading,
    shares,
    with_slow_noise,
)
from quad_sysid.discover.constants import (
    BEAM,
    BLOCKS,
    BRIEF,
    BRIEF_BLOCK_S,
    DIFFERS,
    EXPECTED,
    HOPELESS,
    MOST_EFFECTS,
    NEGLIGIBLE,
    REFITS,
    SEARCHED,
)
from quad_sysid.discover.screen import Score, candidates, screen
from quad_sysid.estimate.fit import Fit, Problem, start_of, stays_bounded
from quad_sysid.model.effect import Effect, Part, required
from quad_sysid.model.structure import LINE, NOISE, Structure, coordinates

SIZES = (NOISE[0], NOISE[1], LINE[0])
"""Parts of the noise relative to the gyro's white noise."""
RESTART_MARGIN = 20.0
"""Nats by which a response that is fitted anew must beat the base; another is fitted from it."""
NEAR = 5.0
"""Nats behind the best structure within which another may be chosen."""
SHARED = (
    'what disturbs this axis disturbs the other one as well, so that its command and rate answer '
    'to the same gusts; fly in calm air, or excite that axis by itself'
)


@dataclass(frozen=True)
class Scored:
    """A structure that was fitted, with log evidence plus log prior."""

    fit: Fit
    score: float

    @property
    def labels(self) -> frozenset[str]:
        """The labels of its effects."""
        return frozenset(self.fit.structure.labels)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The names of its effects, sorted."""
        return tuple(sorted(part.effect.name for part in self.fit.structure.parts))


def law(effect: Effect) -> tuple[str, type[Effect]]:
    """What shares one prior: what one equation says in one place, of whichever motor or axis."""
    return effect.name, type(effect)


def explanation(structure: Structure) -> tuple[str, ...]:
    """What its effects say, sorted: hidden states of one name are unlike, its curves are not."""
    effects = (part.effect for part in structure.parts)
    return tuple(sorted(effect.label if effect.states else effect.name for effect in effects))


@dataclass(frozen=True)
class SearchResult:
    """All structures that were fitted, best first."""

    base: Fit
    all: tuple[Scored, ...]
    reasons: dict[str, str]
    """Why effects were not tried, by their labels."""
    prices: Mapping[str, float] = field(default_factory=dict)
    """Log prior of each effect, by its label."""
    other: Fit | None = None
    """The best structure with lag and damping in each other's place, where that is as probable."""
    cut_short: str = ''
    """Why it ended before all effects were tried; '' if they were."""

    @property
    def best(self) -> Fit:
        """The most probable variant of the most probable set of names."""
        return max(self.all, key=lambda entry: self.of_names(entry.names)).fit

    def of_names(self, names: tuple[str, ...]) -> float:
        """Log of the posterior of all structures with these names together."""
        return float(np.logaddexp.reduce([s.score for s in self.all if s.names == names]))

    def probabilities(self) -> FloatArray:
        """Posterior of each fitted structure, given the segments that scored it."""
        scores = np.array([s.score for s in self.all])
        return np.exp(scores - np.logaddexp.reduce(scores))

    def disagreement(self, fitted: Fit) -> FloatArray:
        """(p, p) mean square by which all structures disagree with a fit's physics.

        In the coordinates of the fit, each structure by its probability, as far as it has them:
        what a standard error within one structure does not contain (Draper 1995). Beside a curve
        or a mode that only one of both has, a parameter of the base is another quantity: a curve
        over the rate holds part of the damping. So is the lag beside motors that answer otherwise.
        """
        slices = {part.effect.label: where for part, where in fitted.structure.placed}
        lag = [i for i, spec in enumerate(fitted.structure.base) if spec.name == 'lag']
        own_effects = {part.effect.label: part.effect for part in fitted.structure.parts}
        out = np.zeros((fitted.theta.size, fitted.theta.size))
        base = slice(len(fitted.structure.base))
        for entry, probability in zip(self.all, self.probabilities(), strict=True):
            effects = {part.effect.label: part.effect for part in entry.fit.structure.parts}
            differing = [(own_effects | effects)[label]
                         for label in own_effects.keys() ^ effects.keys()]
            if any(effect.kind != 'named' for effect in differing):
                continue
            away, theta = np.zeros(fitted.theta.size), entry.fit.theta
            away[base] = theta[base] - fitted.theta[base]
            if any(effect.term == 'response' for effect in differing):
                away[lag] = 0.0
            for part, where in entry.fit.structure.placed:
                if part.effect.label in slices:
                    own = slices[part.effect.label]
                    away[own] = theta[where] - fitted.theta[own]
            out += probability * np.outer(away, away)
        return out


def scored(fitted: Fit, prices: Mapping[str, float]) -> Scored:
    """A fit with its score, log evidence plus log prior."""
    labels = fitted.structure.labels
    return Scored(fitted, fitted.evidence + sum(prices.get(label, 0.0) for label in labels))


def extensions(parent: Fit, score: Score) -> list[Candidate]:
    """A structure with one more effect, begun with the parent's noise and with moderate sizes.

    What a poor model misses counts as torque noise, beside which the gyro's is nothing. There the
    likelihood is flat in the sizes, and no step leads back. Where the rate is as good as free of
    noise, differentiated positions for example, it is the moderate sizes that no step leaves.
    """
    specs = parent.structure.noise
    most = [s.centre + required(s.spread) if s in SIZES else math.inf for s in specs]
    physics, noise = parent.theta[: -len(specs)], parent.theta[-len(specs) :]
    moderate, structure = np.minimum(noise, most), parent.structure.plus(score.part)
    return [
        Candidate(structure, [np.r_[physics, start, sizes] for start in score.starts], parent.rate)
        for sizes in ([moderate] if np.array_equal(moderate, noise) else [moderate, noise])]


def extended(problem: Problem, parent: Fit, score: Score) -> Fit | None:
    """A structure with one more effect; None where its fit diverges."""
    return most_probable(compared_fits(problem, extensions(parent, score)))


def fits_from_priors(problem: Problem, parts: Sequence[Part], base: Fit) -> list[Fit]:
    """Fits of how the motors may respond, begun from the priors and not from the base.

    A response that overshoots, as of yaw with heavy rotors, draws the base so far away, up to a
    negative gain, that no step leads back from there once the response is added.
    """
    first, count = start_of(problem), len(problem.plain.base)
    return compared_fits(problem, [
        Candidate(problem.plain.plus(part), [
            np.r_[first[:count], coordinates(part.effect.parameters, start), first[count:]]
            for start in part.effect.starts(problem.data, part.settings)
        ], problem.flight.rate)
        for part in parts if part.effect.term == 'response' and not part.effect.motors
    ], base.evidence + RESTART_MARGIN)


def little(motion: float, error: float) -> float:
    """What a model may miss: less is no cause, however certain it is.

    A hundredth of the motion, and what raises the error of a free run by less than the factor
    DIFFERS. All are mean squares over the same windows, or sums. Small beside the motion alone is
    not enough: a friction that doubles the error may be half a hundredth of a lively flight.
    """
    return min(NEGLIGIBLE**2 * motion, (DIFFERS**2 - 1.0) * error)


class _Search:
    """The structures fitted so far, by the labels of their effects."""

    def __init__(self, problem: Problem, parts: Sequence[Part], base: Fit,
                 halt: Callable[[], str], progress: Callable[[str], None]) -> None:
        self.problem, self.parts, self.halt, self.progress = problem, parts, halt, progress
        laws = Counter(law(part.effect) for part in parts)
        self.prices = {
            part.effect.label: math.log(EXPECTED / len(laws) / laws[law(part.effect)])
            for part in parts
        }
        self.base = Scored(base, base.evidence)
        self.known: dict[frozenset[str], Scored] = {frozenset(): self.base}
        self.promising: set[str] = set()
        self.built: set[frozenset[str]] = set()
        """The structures beside which one more effect was sought, or need not be."""

    def run(self) -> None:
        """Add one effect at a time, then leave out, replace and add until nothing is better."""
        if not self.halt():
            for fit in fits_from_priors(self.problem, self.parts, self.base.fit):
                self.store(fit)
        beam = leading(self.known.values())
        for _ in range(MOST_EFFECTS):
            if self.halt():
                return
            before, beam = beam[0], leading(self.build_on(beam))
            if not beam:
                break
            beam[0] = self.store(both_orders(self.problem, beam[0].fit))
            if beam[0].score <= before.score or self.improves_little(before.fit, beam[0].fit):
                break
        while not self.halt() and (self.spare() or self.exchange() or self.add()):
            pass

    def build_on(self, parents: Sequence[Scored]) -> list[Scored]:
        """Fitted structures with one more effect, whose linear score may reach the best parent's.

        parents: best first. Where nothing may reach that beside the best, the others are not
        scored.
        """
        best = parents[0].score
        ahead: list[tuple[float, Fit, Score]] = []
        for parent in parents:
            self.built.add(parent.labels)
            ahead += [(parent.score + self.gain(candidate) - best, parent.fit, candidate)
                      for candidate in self.scores(
                          parent.fit, all_candidates=parent is parents[0])]
            if all(score < HOPELESS for score, _, _ in ahead):
                break
        return self.fit_promising(ahead)

    def exchange(self) -> bool:
        """Try others in the place of each effect of the best structure; whether one was better.

        One that was added first may stand for what a later one leaves of another (sequential
        replacement: Miller 2002, ch. 3). Linear scores are compared with that of the effect.
        """
        best = self.best()
        ahead: list[tuple[float, Fit, Score]] = []
        for index, part in enumerate(best.fit.structure.parts):
            smaller = self.known.get(frozenset(best.fit.structure.minus(index).labels))
            if smaller is None or smaller is self.base:
                continue
            others = {score.part.effect.label: score
                      for score in self.scores(smaller.fit, all_candidates=True)}
            own = others.pop(part.effect.label, None)  # a fit of another process has copies
            if own is not None:
                ahead += [(self.gain(score) - self.gain(own), smaller.fit, score)
                          for score in others.values()]
        self.fit_promising(ahead)
        return self.best() is not best

    def add(self) -> bool:
        """Build on the best structure, unless that was done; whether that was better.

        An exchange may have led there, or an effect that changes next to nothing: what another one
        does may show only beside it. One look beyond is enough.
        """
        best = self.best()
        if len(best.labels) < MOST_EFFECTS and best.labels not in self.built:
            self.build_on([best])
        better = self.best()
        if better is not best and self.improves_little(best.fit, better.fit):
            self.built.add(better.labels)
        return better is not best

    def gain(self, candidate: Score) -> float:
        """What a candidate adds to the score of a structure, as far as linear."""
        return candidate.nats + self.prices[candidate.part.effect.label]

    def fit_promising(self, ahead: Iterable[tuple[float, Fit, Score]]) -> list[Scored]:
        """Fits of structures with one more effect, by their relative linear scores.

        Of each explanation the variant with the best score.
        """
        variants: dict[tuple[str, ...], tuple[float, Fit, Score]] = {}
        for score, parent, candidate in ahead:
            names = explanation(parent.structure.plus(candidate.part))
            if score >= variants.get(names, (HOPELESS,))[0]:
                variants[names] = score, parent, candidate
        promising = sorted(variants.values(), key=lambda entry: -entry[0])[:REFITS]
        if self.halt():
            return []
        candidates = [each for _, fit, score in promising for each in extensions(fit, score)]
        fits = compared_fits(self.problem, candidates, self.best().fit.evidence - FAR_BEHIND)
        entries = [self.store(fit) for fit in fits]
        best = ' and '.join(self.best().names) or 'the base'
        self.progress(f'{len(self.known)} structures, best so far {best}')
        return entries

    def scores(self, parent: Fit, *, all_candidates: bool) -> list[Score]:
        """Linear scores of the candidates beside a structure, best first.

        Not all candidates: of the named laws, which may mask each other (friction and drag behind
        the damping), and of the others that have explained something beside another structure.
        """
        scores = screen(self.problem, parent, [
            part for part in self.parts if part.effect.label not in parent.structure.labels
            and (all_candidates or part.effect.kind == 'named'
                 or part.effect.label in self.promising)
        ])
        self.promising |= {score.part.effect.label for score in scores if score.nats > 0.0}
        return scores

    def store(self, fitted: Fit) -> Scored:
        """Store a fit with its score, where it is the better one of its structure."""
        entry = scored(fitted, self.prices)
        known = self.known.get(entry.labels)
        if known is None or entry.score > known.score:
            self.known[entry.labels] = known = entry
        return known

    def best(self) -> Scored:
        """The most probable structure."""
        return max(self.known.values(), key=lambda s: s.score)

    def improves_little(self, simpler: Fit, more: Fit) -> bool:
        """Whether one more effect changes next to nothing, however sure it is.

        Free runs of both differ by less than NEGLIGIBLE of what the base misses of the larger one,
        or by `little`.
        """
        problem = self.problem
        windows = problem.data.windows(problem.spans)
        if not windows.count:
            return False
        with np.errstate(all='ignore'):
            least, less, full = (
                problem.flight.run(fit.structure, fit.theta, windows,
                                   prediction=fit.prediction).errors
                for fit in (self.base.fit, simpler, more)
            )
        rate = problem.flight.gyro[windows.cells]
        motion = float(np.mean((rate - rate[:, :1]) ** 2))
        change, error = (float(np.mean((full - run) ** 2)) for run in (less, least))
        return change < max(NEGLIGIBLE * error, little(motion, float(np.mean(full**2))))

    def spare(self) -> bool:
        """Leave out each effect of the best structure in turn; whether that was better.

        What remains may have been fitted before, to a lower maximum than the best one leads to.
        """
        best = self.best()
        count = len(best.fit.structure.parts)
        if count < 2:  # the base is known
            return False
        for fit in side_by_side([partial(fit_without, self.problem, best.fit, index,
                                         tolerance_nats=ROUGH_NATS) for index in range(count)]):
            if fit is not None:
                self.store(fit)
        return self.best() is not best


def leading(fits: Iterable[Scored]) -> list[Scored]:
    """The best of each explanation, best first, BEAM at most: its variants lead the same way."""
    unlike: dict[tuple[str, ...], Scored] = {}
    for entry in sorted(fits, key=lambda s: -s.score):
        unlike.setdefault(explanation(entry.fit.structure), entry)
    return list(unlike.values())[:BEAM]


def search(problem: Problem, effects: Sequence[Effect], halt: Callable[[], str] = lambda: '',
           progress: Callable[[str], None] = lambda _: None) -> SearchResult:
    """The structures that the training segments support.

    A beam search adds one effect at a time until no score beside the best structure promises more,
    the evidence falls, or the effect changes next to nothing; then what a later effect has made
    needless is left out.

    Of a long flight it sees SEARCHED rows; only the structures that lead there are fitted on all.

    A coupling counts only if no gust disturbs both axes: a gust at an angle moves both, each
    feedback answers it, and one axis' command would seem to turn the other. If the evidence asks
    for such a gust beside the coupling, the search is repeated without that axis (a test of
    exogeneity: Hausman 1978). If slow noise of the gyro explains more than all effects together,
    it is repeated beside such noise. Once `halt` gives a reason nothing more is fitted, and what
    was not is listed with it; `progress` gets a line of text after each round.
    """
    full_problem, problem = problem, problem.shortened(SEARCHED, BLOCKS)
    parts, reasons = candidates(problem, effects)
    first = base = _measured(problem, best_base(problem))
    while True:
        search = _Search(problem, parts, base, halt, progress)
        search.run()
        slow = with_slow_noise(problem, base) if base is first and not halt() else None
        if slow is not None and slow.evidence + math.log(EXPECTED) > search.best().score:
            base = _measured(problem, slow)
            continue
        best = search.best().fit
        used = {axis for part in best.structure.parts for axis in part.effect.others}
        shared = {which for which in used if shares(problem, best, base, which)}
        if not shared or halt():
            break
        reasons |= {p.effect.label: SHARED for p in parts if shared & set(p.effect.others)}
        parts = [p for p in parts if p.effect.label not in reasons]
    cut_short = ''
    if why := halt():
        fitted = {label for labels in search.known for label in labels}
        untried = [p.effect.label for p in parts if p.effect.label not in fitted]
        reasons |= dict.fromkeys(untried, f'{why}: it was not tried')
        cut_short = why if untried else ''
    ranking = tuple(sorted(search.known.values(), key=lambda s: -s.score))
    leading_ones = SearchResult(base, ranking, reasons, search.prices, cut_short=cut_short)
    if problem is not full_problem:
        problem, leading_ones = full_problem, _on_all(full_problem, leading_ones)
    return to_convergence(problem, leading_ones)


def to_convergence(problem: Problem, search: SearchResult) -> SearchResult:
    """The same with those that may be chosen brought to convergence; what does not get there goes.

    It stays where nothing near it converges either. What leads and runs away in a free run goes
    too: it predicts the next sample only.
    """
    best = max(entry.score for entry in search.all)
    near = [entry.fit for entry in search.all
            if entry.score > best - NEAR and not entry.fit.converged]
    fits = side_by_side([partial(fitted_from, problem, fit.structure, fit.theta, rate=fit.rate)
                         for fit in near])
    ended = {fit.structure.labels: scored(fit, search.prices) for fit in fits if fit is not None}
    entries = [ended.get(entry.fit.structure.labels, entry) for entry in search.all]
    near_best = [entry for entry in entries if entry.fit.converged or entry.score <= best - NEAR]
    able = near_best if any(entry.score > best - NEAR for entry in near_best) else entries
    out = replace(search, all=tuple(sorted(able, key=lambda entry: -entry.score)))
    while out.best.structure.parts and len(out.all) > 1 and not stays_bounded(
            problem, out.best, out.best.prediction):
        runaway = out.best
        out = replace(out, all=tuple(entry for entry in out.all if entry.fit is not runaway))
    return replace(out, other=second_reading(problem, out.best))


def _measured(problem: Problem, base: Fit) -> Fit:
    """The base; the problem takes its sizes, and its short part, from that."""
    problem.measure(base)
    problem.short_problem = _brief(problem, base)
    return base


def _brief(problem: Problem, base: Fit) -> Problem | None:
    """A short part of the rows, with the priors that the base has there; None: there is none."""
    rows = problem.rows.size // BRIEF
    blocks = int(np.clip(rows * problem.data.dt / BRIEF_BLOCK_S, 2, BLOCKS))
    short_problem = problem.shortened(rows, blocks)
    if 2 * short_problem.data.rate.size > problem.data.rate.size:
        return None
    fitted = fitted_from(short_problem, base.structure, base.theta,
                         rate=base.rate[short_problem.index])
    if fitted is None:
        return None
    short_problem.measure(fitted)
    return short_problem


def _on_all(problem: Problem, search: SearchResult) -> SearchResult:
    """The leading structures of a search on a part of the rows, fitted on all of them."""
    base = fitted_from(problem, search.base.structure, search.base.theta) or best_base(problem)
    problem.measure(base)
    fits = compared_fits(problem, [
        Candidate(entry.fit.structure, (entry.fit.theta,), base.rate)
        for entry in search.all[:REFITS]
        if entry.fit.structure.parts and entry.score > search.all[0].score - FAR_BEHIND
    ])
    entries = (Scored(base, base.evidence), *(scored(fit, search.prices) for fit in fits))
    return replace(search, base=base, all=tuple(sorted(entries, key=lambda entry: -entry.score)))
