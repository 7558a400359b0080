"""The ladder from the base to the reference: which effects explain how much, the main cause first.

Rung 0 is the base, fitted to what the reference does (projection.py); its miss is 100 %. Each
further rung adds the effect that takes away most of what is left, a named law before a curve that
takes hardly more. The lowest rung that explains EXPLAINS is the answer, if each up to it adds one
effect. Everything here uses the training segments only.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import compress, pairwise

import numpy as np
from numpy.typing import NDArray

from quad_sysid.beside import side_by_side
from quad_sysid.contract import FloatArray
from quad_sysid.discover.base import fitted_from
from quad_sysid.discover.constants import (
    BLOCK_S,
    ENOUGH,
    EXPLAINS,
    LEAST_OF_BEST,
    LEAST_SHARE,
    MOST_RUNGS,
    MOST_STRUCTURES,
    NAMED_FIRST,
    NEGLIGIBLE,
    PRIOR_SIGMAS,
    PROJECTED,
    RESAMPLES,
)
from quad_sysid.discover.screen import Trajectory, linear_of
from quad_sysid.discover.search import SearchResult, little
from quad_sysid.estimate.fit import Fit, Problem, stays_bounded
from quad_sysid.estimate.stored import Stored
from quad_sysid.explain.projection import Projected, Projection
from quad_sysid.model.effect import Effect, Part
from quad_sysid.model.structure import coordinates

DISTURBANCE = 1
"""Place of the disturbance among the parameters of the noise."""


class Models:
    """Projected models with the noise that the training gives them, each fitted once.

    A smaller model need not follow a flight at all: without the effect that holds another one it
    may run away. It is no explanation then, and only that rung of the ladder falls away.
    """

    def __init__(self, result: SearchResult, projection: Projection) -> None:
        self.problem, self.projection = projection.problem, projection
        self.best_fits = {(): result.base} | {
            tuple(sorted(scored.fit.structure.labels)): scored.fit
            for scored in reversed(result.all)}
        self.known: dict[tuple[str, ...], Fit] = {}

    def follows(self, model: Projected) -> bool:
        """Whether the model can follow the training, and its free runs stay bounded there."""
        fitted = self.comparable(model)
        return isinstance(fitted, Fit) and stays_bounded(self.problem, fitted, fitted.prediction)

    def fitted(self, model: Projected) -> Fit:
        """The model with its physics as projected and its noise fitted by the likelihood.

        Where the most likely parameters run better over the training's windows, those.
        """
        reference, labels = self.projection.reference, tuple(sorted(model.structure.labels))
        if labels == tuple(sorted(reference.structure.labels)):
            return reference
        if labels not in self.known:
            physics = range(model.theta.size - self.projection.noise.size)
            fits = (fitted_from(self.problem, model.structure, model.theta,
                                self._loud(model.theta), rate=reference.rate,
                                fixed=tuple(physics)), self.best_fits.get(labels))
            able = [fit for fit in fits if fit is not None]
            if not able:  # then with the noise as it is
                as_it_is = fitted_from(self.problem, model.structure, self._loud(model.theta),
                                       rate=reference.rate, max_steps=0)
                able = [] if as_it_is is None else [as_it_is]
            if not able:
                raise FloatingPointError(f'{" and ".join(labels) or "the base"} diverges')
            self.known[labels] = min([fit for fit in able if fit.converged] or able,
                                     key=self._trained)
        return self.known[labels]

    def comparable(self, model: Projected) -> Fit | Stored:
        """The same for a comparison only; what cannot follow a flight is run as it is."""
        try:
            return self.fitted(model)
        except FloatingPointError:
            return Stored(model.structure, model.theta, self.projection.reference.tail)

    def _trained(self, fitted: Fit) -> float:
        """Mean square of the free run over the training's windows, from the fit's own states."""
        flight, windows = self.problem.flight, self.projection.windows
        with np.errstate(all='ignore'):
            errors = flight.run(fitted.structure, fitted.theta, windows,
                                prediction=fitted.prediction).errors
            return float(np.nan_to_num(np.mean(errors**2), nan=np.inf))

    def _loud(self, theta: FloatArray) -> FloatArray:
        """The same start with a torque disturbance a hundred times as large."""
        out: FloatArray = theta.copy()
        out[out.size - self.projection.noise.size + DISTURBANCE] += math.log(100.0)
        return out

    def each_left_out(self, model: Projected) -> list[Projected]:
        """The model without each of its effects, the rest projected anew."""
        return [
            self.projection.project(model.structure.minus(i), np.delete(model.theta, columns))
            for i, columns in enumerate(model.structure.slices)
        ]


@dataclass(frozen=True, eq=False)
class Rung:
    """A projected model, and the share of the base's miss that it explains."""

    model: Projected
    missed: FloatArray
    """(windows,) what its structure misses with parameters of the other stretches, (rad/s)²."""
    explains_pct: float

    @property
    def total(self) -> float:
        """Sum of `missed`."""
        return float(np.sum(self.missed))

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of its effects, the main cause first."""
        return self.model.structure.labels


@dataclass(frozen=True, eq=False)
class Ladder:
    """The rungs from the base upwards."""

    models: Models
    rungs: tuple[Rung, ...]
    drift: FloatArray
    """(windows,) what the base misses with parameters of other times, (rad/s)²."""
    blocks: int = 0
    reproducible: dict[str, float] = field(default_factory=dict)
    """Name of each effect of the answer → share of the resampled flights in which it is in the
    answer, whatever its variant."""

    @property
    def projection(self) -> Projection:
        """Onto whose runs the rungs are projected."""
        return self.models.projection

    @cached_property
    def added(self) -> dict[str, int]:
        """Label of an effect → index of the rung that adds it, and it alone."""
        return {rung.labels[-1]: i for i, rung in enumerate(self.rungs)
                if i and set(rung.labels[:-1]) == set(self.rungs[i - 1].labels)}

    @cached_property
    def new(self) -> list[set[str]]:
        """Labels that each rung above the base has and the one below it has not."""
        return [{*rung.labels} - {*below.labels} for below, rung in pairwise(self.rungs)]

    def rank(self, label: str) -> int:
        """Place of an effect among those of all rungs, the main cause's 0; any other is last."""
        labels = tuple(dict.fromkeys(label for rung in self.rungs for label in rung.labels))
        return labels.index(label) if label in labels else len(labels)

    def explains(self, label: str) -> float:
        """Percent that an effect of the answer explains, of what the answer does.

        In proportion to the squares that its rung takes away.
        """
        rungs = self.rungs[: self.answer + 1]
        whole = rungs[0].total - rungs[-1].total
        for new, (below, rung) in zip(self.new, pairwise(rungs), strict=False):
            if label in new:
                return rungs[-1].explains_pct * ((below.total - rung.total) / whole)
        return 0.0

    @property
    def negligible(self) -> bool:
        """Whether the reference sees more than the base, but little (discover/search.py)."""
        equal = np.ones_like(self.drift)
        return self.rungs[0].total > 0.0 and bool(self.slight(self.drift[None], equal)[0])

    @property
    def predicts_pct(self) -> float:
        """Share of the motion's RMS that the base already predicts, as the reference sees it."""
        missed = self.rungs[0].total / max(np.sum(self.projection.motion), 1e-30)
        return 100.0 * (1.0 - math.sqrt(min(missed, 1.0)))

    def slight(self, missed: FloatArray, weights: FloatArray) -> NDArray[np.bool_]:
        """(rungs,) whether what misses `missed` (rungs, windows) misses next to nothing.

        In slow motion as in fast. weights: (windows,) of a resampled flight.
        """
        little_missed = [total < small for total, small in self._by_thirds(missed, weights)]
        return np.asarray(np.all(little_missed, axis=0))

    @cached_property
    def _parts(self) -> FloatArray:
        """(2, windows) the squares of the motion and of the reference's error, (rad/s)²."""
        projection = self.projection
        return np.array([projection.motion, np.sum(projection.goal**2, axis=1)])

    def _by_thirds(self, missed: FloatArray,
                   weights: FloatArray) -> Iterator[tuple[FloatArray, float]]:
        """What is missed (rungs,) in each third, of `missed` (rungs, windows); what may be."""
        for third in self.projection.thirds:
            yield (missed[:, third] @ weights[third],
                   little(*self._parts[:, third] @ weights[third]))

    def explained(self, missed: FloatArray) -> FloatArray:
        """(rungs,) percent explained by what misses `missed` (rungs, windows), the base first.

        The least of `thirds`: slow and fast motion count alike, for a drag may do for a friction
        where the aircraft turns fast. A third where the base misses next to nothing, also with
        parameters of other times, does not count.
        """
        both, equal = np.vstack([self.drift, missed]), np.ones_like(self.drift)
        shares = [1.0 - total[1:] / max(total[1], 1e-30)
                  for total, small in self._by_thirds(both, equal) if total[0] > small]
        return np.asarray(100.0 * np.min([np.ones(missed.shape[0]), *shares], axis=0))

    def sufficient(self, missed: FloatArray) -> int | None:
        """The lowest rung that explains EXPLAINS, or the base that misses next to nothing."""
        if self.slight(self.drift[None], np.ones_like(self.drift))[0]:
            return 0
        enough = np.flatnonzero(self.explained(missed) >= EXPLAINS)
        return int(enough[0]) if enough.size else None

    @cached_property
    def last(self) -> int:
        """The last rung of those that add one effect each; only the whole reference adds several.

        Those explain something together only, so that none of them by itself is a cause.
        """
        return sum(len(new) <= 1 for new in self.new)

    @cached_property
    def answer(self) -> int:
        """The sufficient rung, or the last."""
        if not self.last:
            return 0
        enough = self.sufficient(
            np.array([rung.missed for rung in self.rungs[: self.last + 1]]))
        return self.last if enough is None else enough

    @cached_property
    def predicting(self) -> Fit:
        """The answer, a finer rung or the reference: what predicts other times best.

        One step ahead the reference does; what it fits of one time may not come again at another.
        """
        projection = self.projection
        if not projection.reference.structure.parts or not projection.windows.count:
            return projection.reference
        rungs = [self.models.fitted(rung.model) for rung in self.rungs[self.answer :]]
        return min(dict.fromkeys((*rungs, projection.reference)),  # often the last rung
                   key=lambda fit: float(np.sum(projection.later_error(fit))))


def explain(problem: Problem, search: SearchResult, parts: Sequence[Part]) -> Ladder:
    """The ladder to the search's most probable structure, and how often its answer comes again.

    parts: the candidates of the search.
    """
    ladder = _ladder(problem, search, parts)
    if not ladder.answer:
        return ladder
    blocks, reproducible = resampled(problem, search, ladder)
    return replace(ladder, blocks=blocks, reproducible=reproducible)


def _ladder(problem: Problem, search: SearchResult, parts: Sequence[Part]) -> Ladder:
    reference, base = search.best, search.base
    projection = Projection(problem, reference)
    models = Models(search, projection)
    if not reference.structure.parts:  # nothing to explain
        single = projection.ordered(reference.structure)
        return Ladder(models, (Rung(single, single.missed, 0.0),), single.missed)
    plain = projection.structure(())
    if not projection.windows.count:  # too short for a free run
        single = Projected(plain, projection.alone(base.theta), np.zeros(0))
        return Ladder(models, (Rung(single, single.missed, 0.0),), single.missed)
    starts = [projection.alone(start) for start in (reference.theta, base.theta)]
    first = min((projection.project(plain, start, coarse=True) for start in starts),
                key=lambda model: model.total)
    lowest = projection.project(plain, first.theta)
    fitted = models.fitted(lowest)
    rungs = [Rung(lowest, projection.disagreement(fitted), 0.0)]
    ladder = Ladder(models, tuple(rungs), projection.disagreement(fitted, later=True))
    if ladder.negligible or lowest.total <= 0.0:
        return ladder
    climb, equal = _Climb(models, search, parts, lowest.total), np.ones_like(lowest.missed)
    while rungs[-1].explains_pct < ENOUGH and len(rungs) <= MOST_RUNGS:
        last = rungs[-1]
        if last.explains_pct >= EXPLAINS and ladder.slight(last.missed[None], equal)[0]:
            break
        step = climb.next(last.model, finer=last.explains_pct >= EXPLAINS)
        if step is None or last.model.total - step.total < NEGLIGIBLE * lowest.total:
            break
        missed = projection.disagreement(models.fitted(step)) if models.follows(step) else None
        if missed is not None and last.total - np.sum(missed) >= NEGLIGIBLE * rungs[0].total:
            climb.left_out.clear()
            both = np.array([rungs[0].missed, missed])
            percents = ladder.explained(both)[-1]
            rungs.append(Rung(step, missed, max(last.explains_pct, float(percents))))
        else:
            climb.left_out.add(_added(step).label)
    if rungs[-1].explains_pct < ENOUGH:
        climbed = replace(ladder, rungs=tuple(rungs))
        parts = sorted(reference.structure.parts,
                       key=lambda part: climbed.rank(part.effect.label))
        complete = projection.ordered(replace(reference.structure, parts=tuple(parts)))
        rungs.append(Rung(complete, complete.missed, 100.0))
    return replace(ladder, rungs=tuple(rungs))


def _added(model: Projected) -> Effect:
    """The effect of the last rung."""
    return model.structure.parts[-1].effect


def _within_prior(model: Projected) -> bool:
    """Whether the last rung's effect, if it is a law, has parameters that its prior allows."""
    effect, values = _added(model), model.theta[model.structure.slices[-1]]
    sizes = np.array([spec.spread or np.inf for spec in effect.parameters])
    precision = np.diag(effect.precision(model.structure.parts[-1].settings, sizes))
    away = values - [spec.centre for spec in effect.parameters]
    return effect.kind != 'named' or bool(np.all(precision * away**2 <= PRIOR_SIGMAS**2))


class _Climb:
    """The step from a rung to the next one."""

    def __init__(self, models: Models, search: SearchResult, parts: Sequence[Part],
                 whole: float) -> None:
        self.models, self.projection = models, models.projection
        self.parts, self.whole = parts, whole
        self.scores = {frozenset(scored.fit.structure.labels): scored.score
                       for scored in search.all}
        self.left_out: set[str] = set()
        """Labels of what runs away beside the rung, or explains too little of the rest."""

    def next(self, model: Projected, *, finer: bool) -> Projected | None:
        """The model with one more effect, of those believed, that is nearest to the reference.

        A named law that explains EXPLAINS is taken before a curve is tried. Of those that take
        nearly as much the search's most probable one is taken, and of its variants the plainest.
        finer: what the reference has, no more causes.
        """
        promising = self.promising(model, () if finer else self.parts)
        trials: list[Projected] = []
        for kinds in (('named',), ('shape', 'mode', 'event')):
            trials += filter(_within_prior, side_by_side([
                partial(self.extended, model, part, values)
                for part, values in promising if part.effect.kind in kinds]))
            best = min(trials, key=lambda trial: trial.total, default=None)
            if best is not None and \
                    best.total <= (1.0 - 0.01 * EXPLAINS) * self.whole < model.total:
                break
        if best is None:
            return None
        least = NAMED_FIRST * (model.total - best.total)
        named = [trial for trial in trials if _added(trial).kind == 'named'
                 and model.total - trial.total >= least > 0.0]
        first = max(named, default=best, key=lambda trial: (
            self.scores.get(frozenset(trial.structure.labels), -np.inf), -trial.total))
        group = [trial for trial in (named or [best]) if _added(trial).name == _added(first).name]
        plainest = min(group, key=lambda trial: (len(_added(trial).parameters), trial.total))
        if plainest.total <= 0.0:  # the reference itself
            return plainest
        return self.projection.project(plainest.structure, plainest.theta)

    def extended(self, model: Projected, part: Part, values: FloatArray) -> Projected:
        """The projection of a model with one more effect, from its coordinates `values` (q,)."""
        projection, structure = self.projection, model.structure.plus(part)
        if set(structure.labels) == set(projection.reference.structure.labels):
            return projection.ordered(structure)
        start = np.insert(model.theta, -projection.noise.size, values)
        fitted = self.models.best_fits.get(tuple(sorted(structure.labels)))
        if fitted is not None:  # by the search, perhaps where the base alone does not lead
            own = {other.effect.label: fitted.theta[where]
                   for other, where in fitted.structure.effects}
            of_search = np.concatenate([fitted.theta[: projection.base],
                                        *(own[label] for label in structure.labels),
                                        projection.noise])
            start = min((start, of_search), key=lambda theta: projection.project(
                structure, theta, most=0).total)
        return projection.project(structure, start, coarse=True)

    def promising(self, model: Projected, parts: Sequence[Part]) -> list[tuple[Part, FloatArray]]:
        """The named laws and the effects of the reference that explain most of the missing torque.

        Of the reference's effects also the plainer variants, which say the same with less.
        The missing torque is the reference's acceleration less the model's along the reference's
        trajectory; a law explains of it what its columns do beside the base's own.
        """
        projection = self.projection
        reference, problem, flight = projection.reference, projection.problem, projection.flight
        structure, theta, rate = model.structure, model.theta, reference.rate
        have = {*structure.labels, *self.left_out}
        trajectory = Trajectory(problem, structure, theta, rate)
        target = Trajectory(problem, reference.structure, reference.theta, rate).acceleration
        missing = (target - trajectory.acceleration)[problem.rows]
        steps = np.r_[projection.steps(structure, theta), np.full(projection.noise.size, 1e-4)]
        columns, _, _ = flight.columns(structure, theta, rate, steps)
        q = np.linalg.qr(columns[problem.rows, : -projection.noise.size])[0]
        residual = missing - q @ (q.T @ missing)
        of_reference = [
            (_explained(trajectory, part, [], reference.theta[where], q, residual)[0], part,
             reference.theta[where])
            for part, where in reference.structure.effects if part.effect.label not in have]
        of_reference = sorted(of_reference, key=lambda law: -law[0])[:PROJECTED]
        have |= {part.effect.label for _, part, _ in of_reference}
        shares: list[tuple[float, Part, FloatArray]] = []
        for part in parts:
            effect = part.effect
            if effect.kind == 'named' and effect.label not in have and not effect.wanders and (
                    effect.happens
                    or type(effect).starts_by_residual is Effect.starts_by_residual):
                shares += _share(trajectory, part, q, residual)
        best: dict[str, tuple[float, Part, FloatArray]] = {}
        for law in sorted(shares, key=lambda law: -law[0]):
            best.setdefault(law[1].effect.label, law)
        most = max((law[0] for law in (*of_reference, *best.values())), default=0.0)
        size = {part.effect.name: len(part.effect.parameters) for _, part, _ in of_reference}
        plainer, rivals = [], []
        for share, part, p in best.values():
            if len(part.effect.parameters) < size.get(part.effect.name, 0):
                plainer.append((share, part, p))
            elif share >= LEAST_OF_BEST * most:
                rivals.append((share, part, p))
        return [(part, p) for _, part, p in (*of_reference, *plainer, *rivals[:PROJECTED])]


def _share(trajectory: Trajectory, part: Part, q: FloatArray,
           residual: FloatArray) -> list[tuple[float, Part, FloatArray]]:
    """The share of `residual` (rows,) that a law explains, and its values, from each start."""
    effect, linear, out = part.effect, linear_of(part), []
    for start in effect.starts(trajectory.problem.data, part.settings):
        p = coordinates(effect.parameters, start)
        p[linear] = 0.0
        share, sizes = _explained(trajectory, part, linear, p, q, residual)
        if linear:
            p[linear] = sizes
        if not any(effect.parameters[j].positive and p[j] < 0.0 for j in linear):
            out.append((share, part, p))
    return out


def _explained(trajectory: Trajectory, part: Part, linear: list[int], p: FloatArray, q: FloatArray,
               residual: FloatArray) -> tuple[float, FloatArray]:
    """The share of `residual` (rows,) that an effect explains at p, and its linear parameters.

    Without any its acceleration counts in any size. q (rows, m): an orthonormal basis of what
    others explain as well.
    """
    rows = trajectory.problem.rows
    c = np.stack([column[rows] for column in trajectory.columns(part, linear, p)], axis=1)
    c = c - q @ (q.T @ c)
    sizes = np.linalg.lstsq(c, residual, rcond=1e-8)[0]
    after = residual - c @ sizes
    return 1.0 - float(after @ after) / max(float(residual @ residual), 1e-30), sizes


# ------------------------------------------------------------------ what comes again


def resampled(
    problem: Problem, search: SearchResult, ladder: Ladder
) -> tuple[int, dict[str, float]]:
    """Number of blocks; name of each effect of the answer → how often it comes again.

    Bagged posteriors (Huggins, Miller 2023): blocks of the training are weighted at random (a
    Bayesian bootstrap, Rubin 1981). With the same weights each fitted structure has another
    evidence, so that another reference may lead. An effect comes again where its rung takes away
    no negligible part of what the base misses of that one. Whether the rungs below it already
    suffice there does not count: one that explains about EXPLAINS would halve what is sure.
    """
    block = problem.blocks(BLOCK_S)
    entries = search.all[:MOST_STRUCTURES]
    logs = np.array([
        np.bincount(block, fit.tail.log_density(fit.prediction.innovation[problem.rows]))
        for fit in (scored.fit for scored in entries)
    ])
    prior = np.array([scored.score for scored in entries]) - logs.sum(axis=1)
    blocks = int(block.max()) + 1
    weights = np.random.default_rng(0).exponential(size=(RESAMPLES, blocks))
    weights *= blocks / weights.sum(axis=1, keepdims=True)
    leading = np.argmax(prior + weights @ logs.T, axis=1)
    rows = np.searchsorted(problem.rows, ladder.projection.windows.starts)
    weights = weights[:, block[np.clip(rows, 0, block.size - 1)]]
    rungs = ladder.rungs[: ladder.answer + 1]
    fits = [ladder.models.fitted(rung.model) for rung in rungs]
    added = [_added(rung.model).name for rung in rungs[1:]]
    counts: Counter[str] = Counter()
    for index, count in Counter(leading.tolist()).most_common():
        reference = entries[index].fit
        if not reference.structure.parts or count < LEAST_SHARE * RESAMPLES:
            continue
        missed, drift = (np.array([rung.missed for rung in rungs]), ladder.drift) \
            if reference is search.best else _missed(Projection(problem, reference), fits)
        for weight in weights[leading == index]:
            if not ladder.slight(drift[None], weight)[0]:
                total = missed @ weight
                counts.update(set(compress(added, -np.diff(total) >= NEGLIGIBLE * total[0])))
    answer = rungs[-1].model.structure.parts
    return blocks, {part.effect.name: counts[part.effect.name] / RESAMPLES for part in answer}


def _missed(projection: Projection, rungs: Sequence[Fit]) -> tuple[FloatArray, FloatArray]:
    """(rungs, windows) what each rung misses of another reference; its `drift`."""
    return (np.array([projection.disagreement(rung) for rung in rungs]),
            projection.disagreement(rungs[0], later=True))
