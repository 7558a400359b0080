"""The verdict on the validation segments, which are opened once, after the search.

Predictive log-likelihoods are compared in blocks, as a bet against the claim that the added
effects predict nothing (an e-value: Shafer 2021, Waudby-Smith & Ramdas 2024). If the claim is
true, the bet's expectation is at most 1, whatever the noise is.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from weakref import WeakKeyDictionary

import numpy as np
from scipy import stats
from scipy.linalg import toeplitz
from scipy.special import expit

from quad_sysid.beside import side_by_side
from quad_sysid.contract import FloatArray
from quad_sysid.discover.base import fit_without
from quad_sysid.discover.constants import BLOCK_S, DIFFERS, EXPECTED, FLIPS, LEVEL, REFITS, STAKES
from quad_sysid.discover.search import Found
from quad_sysid.estimate.fit import Fit, Problem, tail_of
from quad_sysid.estimate.stored import Stored, noise_of
from quad_sysid.model.data import AxisData, Windows
from quad_sysid.model.effect import Part
from quad_sysid.model.identified import UNLISTED
from quad_sysid.model.noise import growth
from quad_sysid.model.plant import Prediction

HORIZONS_S = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
SHORT_S = HORIZONS_S[2]
"""Windows over which motors answer, and gusts have hardly turned the aircraft yet."""
AT_MOST = 10.0
"""Largest rate of a free run over the largest measured one."""
HUGE = 1e100
LEAST_REPORTED = 0.005
"""Share of the rivals' probability below which one is not reported."""


def bet(speaks_for: FloatArray, against: FloatArray) -> float:
    """E-value of 'no more speaks for the model than against it', from blocks in their order."""
    share = shares_of(speaks_for, against)
    with np.errstate(over='ignore'):
        return float(np.mean([np.prod(1.0 + stake * share) for stake in STAKES]))


def closed(e_values: Sequence[float]) -> list[float]:
    """Each e-value at one level for them all: the least mean of it and any of the others.

    Closed testing, since a mean of e-values is one (Vovk, Wang 2021).
    """
    counts = np.arange(1, len(e_values) + 1)
    return [
        float(np.min(np.cumsum([own, *np.sort(np.delete(e_values, i))]) / counts))
        for i, own in enumerate(e_values)
    ]


def shares_of(speaks_for: FloatArray, against: FloatArray) -> FloatArray:
    """(blocks,) balance of each block as a share of its turnover, -1 to 1.

    Both (blocks,), not negative; what is not finite diverged and is taken for huge. So loud blocks
    do not outweigh calm ones.
    """
    speaks_for, against = (
        np.nan_to_num(x, nan=HUGE, posinf=HUGE) for x in (speaks_for, against)
    )
    turnover = speaks_for + against
    balance = speaks_for - against
    return np.divide(balance, turnover, out=np.zeros_like(balance), where=turnover > 0.0)


@dataclass(frozen=True)
class Horizon:
    """RMS error of the rate at a time after the start of a free run, rad/s."""

    horizon_s: float
    hold: float
    before: float
    after: float


@dataclass(frozen=True)
class Verdict:
    """The answer for one axis."""

    verdict: str
    reason: str
    """Why no effect was added; if one was, what remains unexplained."""
    chosen: Fit
    """The reported fit: the base where no effect was accepted."""
    e_value: float
    """Evidence of the validation segments against the claim that nothing beats the base, at one
    level for all structures for which it was asked."""
    before: float
    after: float
    one_step_before: float
    one_step_after: float
    hold: float
    predicted: float
    """Error that the chosen model's own noise predicts for `after`, rad/s."""
    noise_floor: float
    horizons: tuple[Horizon, ...]
    without: tuple[float, ...]
    """Error without each effect of the chosen structure, the rest refitted, rad/s."""
    probabilities: tuple[float, ...]
    """Posterior of each chosen effect."""
    rivals: tuple[tuple[tuple[str, float], ...], ...]
    """For each chosen effect its alternatives with their probabilities."""
    found: Found
    """What the search found, as the held-out segments weigh it."""


Fitted = Fit | Stored
"""A model that predicts."""


class Unseen:
    """The validation segments, and the errors of fitted models on them."""

    def __init__(self, data: AxisData, spans: Sequence[tuple[int, int]]) -> None:
        self.problem = Problem(data, spans, whole=True)
        self.windows = data.windows(spans)
        self.lengths = self.windows, data.windows(spans, SHORT_S)
        self.long = data.windows(spans, HORIZONS_S[-1])
        self.block = self.problem.blocks(BLOCK_S)
        self.begun = self.problem.flight.rate
        self.known: WeakKeyDictionary[Fitted, Prediction] = WeakKeyDictionary()
        self.ran: dict[tuple[Fitted, int], FloatArray] = {}

    def predict(self, fitted: Fitted) -> Prediction:
        """The filter's result along the segments.

        The first call measures the size of the innovations, by which the filter follows what
        wanders.
        """
        if fitted not in self.known:
            flight = self.problem.flight
            flight.rate = self.begun
            self.known[fitted] = flight.predict(fitted.structure, fitted.theta, sweeps=3)
        return self.known[fitted]

    def bet(self, fitted: Fitted, other: Fitted) -> float:
        """E-value of the predictive log-likelihood against another model's, by blocks."""
        gain = self.log_likelihood(fitted) - self.log_likelihood(other)
        return bet(*(
            np.bincount(self.block, np.maximum(one, 0.0)).astype(float) for one in (gain, -gain)
        ))

    def log_likelihood(self, fitted: Fitted) -> FloatArray:
        """(rows,) predictive log-likelihood of each sample, nats."""
        return fitted.tail.log_density(self.innovations(fitted))

    def innovations(self, fitted: Fitted) -> FloatArray:
        """(rows,) rad/s; where a model diverges they are huge."""
        e = self.predict(fitted).innovation[self.problem.rows]
        return np.clip(np.nan_to_num(e, nan=1e6), -1e6, 1e6)

    def errors(self, fitted: Fitted, windows: Windows | None = None) -> FloatArray:
        """(windows, length) errors of the free run, rad/s."""
        windows = windows or self.windows
        run = fitted, windows.length
        if run not in self.ran:
            prediction = self.predict(fitted)
            with np.errstate(over='ignore', invalid='ignore'):
                self.ran[run] = self.problem.flight.free_run(
                    fitted.structure, fitted.theta, windows, prediction=prediction
                )
        return self.ran[run]

    def squares(self, *models: Fitted) -> list[list[FloatArray]]:
        """For windows of both lengths (windows,) mean squares of each model's errors."""
        return [[_squares(self.errors(one, windows)) for one in models]
                for windows in self.lengths]

    def one_step(self, fitted: Fitted) -> float:
        """RMS of the innovations, rad/s."""
        return rms(self.predict(fitted).innovation[self.problem.rows])

    def holding(self, windows: Windows) -> FloatArray:
        """(windows, length) errors of holding the last rate, rad/s."""
        rate = self.problem.data.rate
        index = windows.starts[:, None] + np.arange(windows.length)
        return rate[windows.starts - 1][:, None] - rate[index]


def rms(errors: FloatArray) -> float:
    """Root mean square; infinite where a model diverges."""
    with np.errstate(over='ignore', invalid='ignore'):
        value = float(np.sqrt(np.mean(errors**2))) if errors.size else math.nan
    return value if not math.isnan(value) else math.inf


def judge(data: AxisData, problem: Problem, found: Found) -> Verdict:
    """Open the validation segments and decide."""
    unseen = Unseen(data, data.validation)
    unseen.predict(found.base)  # which measures the innovations that wandering effects follow
    known: dict[frozenset[str], Fit | None] = {
        frozenset(one.fit.structure.labels): one.fit for one in found.all
    }
    trained, found = found.best, weighed(unseen, found)
    base, chain = found.base, list(_shortened(problem, found.best, known))
    # another choice than the training's counts once for each of those it was chosen from
    count = 1 if found.best is trained else REFITS
    best, e_value = _claimed(unseen, found, chain, count)
    told = _commands_tell(problem, unseen, best)
    chosen = best if told else base
    parts, after = chosen.structure.parts, rms(unseen.errors(chosen))
    without = tuple(
        math.inf if one is None else rms(unseen.errors(one))
        for one in _each_left_out(problem, chosen, known)
    )
    noise, spread = noise_of(chosen), growth(chosen.prediction.filter, unseen.windows.length)
    hold = rms(unseen.holding(unseen.windows))
    verdict, reason = 'cannot_tell', (
        'the commands do not predict the held-out rates better than the rates themselves do'
    )
    if told:
        verdict, reason = ('effects_added', unexplained(unseen, chosen)) if parts \
            else _empty(found, unseen, e_value)
    as_named = listed(parts, without, after, 0.5 * hold)
    probabilities, rivals = _posterior(found, chosen, as_named)
    return Verdict(
        verdict=verdict, reason=reason, chosen=chosen, e_value=e_value,
        before=rms(unseen.errors(base)), after=after,
        one_step_before=unseen.one_step(base), one_step_after=unseen.one_step(chosen),
        hold=hold, predicted=noise.gyro_rms * math.sqrt(float(np.mean(spread))),
        noise_floor=noise.measured_rms, horizons=horizons(unseen, base, chosen), without=without,
        probabilities=probabilities, rivals=rivals, found=found,
    )


def weighed(unseen: Unseen, found: Found) -> Found:
    """The scores of the best structures and the base with what the held-out segments say of them.

    That is the likelihood of their innovations there, whose scale and tail alone are fitted: there
    may be more or less wind. Where a likelihood is right, the variance of a log ratio is twice its
    mean. Where that between the training's choice and its strongest rival varies more from block
    to block, all count less (a generalised posterior: Grünwald, van Ommen 2017).
    """
    best = found.best
    kept = [one for i, one in enumerate(found.all)
            if i < REFITS or one.fit is best or one.fit is found.base]
    if len(kept) < 2 or not unseen.block.size:
        return found
    innovations = side_by_side([partial(unseen.innovations, one.fit) for one in kept])
    blocks = np.array([np.bincount(unseen.block, tail_of(e).log_density(e)) for e in innovations])
    own = [one.fit for one in kept].index(best)
    ratios = blocks - blocks[own]
    rival = max(np.delete(ratios, own, axis=0), key=np.sum)
    varies = 0.5 * float(np.sum(np.diff(rival) ** 2))  # beside what excitation does
    share = min(1.0, 2.0 * abs(float(np.sum(rival))) / varies) if varies > 0.0 else 1.0
    said = dict(zip(kept, share * np.sum(ratios, axis=1), strict=True))
    scored = [replace(one, score=one.score + float(said.get(one, 0.0))) for one in found.all]
    return replace(found, all=tuple(sorted(scored, key=lambda one: -one.score)))


def _claimed(unseen: Unseen, found: Found, chain: Sequence[Fit], count: int) -> tuple[Fit, float]:
    """Which structure of a chain (_shortened) is claimed, and its e-value; else the base.

    The largest counts that the validation confirms against the base, and against which it confirms
    no shorter one: what does not transfer is dropped. So is what the training misses least where
    the odds for it, all variants of its name together, are below 1 / LEVEL and the validation does
    not confirm it, as long as the structure without it counts in the same way.
    count: how many structures the first of the chain was chosen from.
    """
    base = found.base
    e_values = [e / count for e in closed([_evidence(unseen, base, one) for one in chain])]
    stands = [
        e * LEVEL >= 1.0 and _falls(unseen, base, one) and stays_bounded(unseen, one)
        and not any(_better(unseen, shorter, one) for shorter in chain[i + 1 :])
        for i, (one, e) in enumerate(zip(chain, e_values, strict=True))
    ]
    if not any(stands):
        return base, e_values[0] if chain else 1.0
    largest = last = stands.index(True)
    for i in range(largest + 1, len(chain)):
        if not (stands[i] and _needless(found, unseen, chain[largest], chain[i])):
            break
        last = i
    return chain[last], e_values[last]


def _evidence(unseen: Unseen, before: Fit, after: Fit) -> float:
    """E-value of 'the second predicts nothing better than the first'.

    The stakes are on the next sample and on free runs of both lengths: where gusts rule the
    windows of the verdict, short ones may tell. A mean of e-values is one.
    """
    runs = (bet(*squares) for squares in unseen.squares(before, after))
    return float(np.mean([unseen.bet(after, before), *runs]))


def _falls(unseen: Unseen, before: Fit, after: Fit) -> bool:
    """Whether the errors of free runs fall: their RMS, and by a paired t-test of the windows.

    Noise of another colour than the model's may pay one step ahead, but not in a free run. The
    test is made for windows of two lengths, each at half of the level.
    """
    return rms(unseen.errors(after)) < rms(unseen.errors(before)) and any(
        stats.ttest_1samp(shares_of(*squares), 0.0, alternative='greater').pvalue <= 0.5 * LEVEL
        for squares in unseen.squares(before, after)
    )


def stays_bounded(unseen: Unseen, fitted: Fitted) -> bool:
    """Whether its free runs stay near what was flown, also begun at twice the rate or against it.

    Within AT_MOST times the largest measured rate: what runs away from there explains nothing,
    and would not hold on a livelier flight.
    """
    flight, prediction = unseen.problem.flight, unseen.predict(fitted)
    windows = unseen.long if unseen.long.count else unseen.windows
    if not windows.count:
        return True
    rate = unseen.problem.data.rate
    largest = float(np.nanmax(np.abs(rate)))
    measured = rate[windows.starts[:, None] + np.arange(windows.length)]
    for offset in (-largest, 0.0, largest):
        states = prediction.states.copy()
        states[:, 0] += offset
        begun = replace(prediction, states=states)
        with np.errstate(over='ignore', invalid='ignore'):
            errors = flight.free_run(fitted.structure, fitted.theta, windows, prediction=begun)
            if not np.nanmax(np.nan_to_num(np.abs(errors + measured), nan=np.inf)
                             [np.isfinite(measured)], initial=0.0) <= AT_MOST * largest:
                return False
    return True


def _better(unseen: Unseen, one: Fit, other: Fit) -> bool:
    """Whether the validation confirms the first against the second."""
    return _evidence(unseen, other, one) * LEVEL >= 1.0 and _falls(unseen, other, one)


def _needless(found: Found, unseen: Unseen, one: Fit, shorter: Fit) -> bool:
    """Whether neither the odds nor the validation claim what a structure has beside another."""
    odds = found.weight(one) - found.weight(shorter)
    return odds < -math.log(LEVEL) and not _better(unseen, one, shorter)


def _shortened(
    problem: Problem, best: Fit, known: dict[frozenset[str], Fit | None]
) -> Iterator[Fit]:
    """The most probable structure, then one by one without the effect that training misses least.

    known: as in _each_left_out.
    """
    fitted: Fit | None = best
    while fitted is not None and fitted.structure.parts:
        yield fitted
        shorter = [one for one in _each_left_out(problem, fitted, known) if one is not None]
        fitted = max(shorter, key=lambda f: f.evidence, default=None)


def _each_left_out(
    problem: Problem, fitted: Fit, known: dict[frozenset[str], Fit | None]
) -> list[Fit | None]:
    """The fits without each effect, None where one diverges.

    known: fits by the labels of their effects, to which new ones are added.
    """
    out = []
    for i in range(len(fitted.structure.parts)):
        labels = frozenset(fitted.structure.minus(i).labels)
        if labels not in known:
            known[labels] = fit_without(problem, fitted, i)
        out.append(known[labels])
    return out


def horizons(unseen: Unseen, base: Fitted, chosen: Fitted) -> tuple[Horizon, ...]:
    """Errors of holding the rate, of the base and of the chosen model, by horizon."""
    windows, dt = unseen.long, unseen.problem.data.dt
    if not windows.count:
        return ()
    errors = unseen.holding(windows), *(unseen.errors(f, windows) for f in (base, chosen))
    return tuple(
        Horizon(horizon, *(rms(e[:, at_horizon(horizon, dt)]) for e in errors))
        for horizon in HORIZONS_S
    )


def at_horizon(horizon_s: float, dt: float) -> int:
    """Column of a free run's errors at a time after its start."""
    return max(round(horizon_s / dt), 1) - 1


def _commands_tell(problem: Problem, unseen: Unseen, fitted: Fit) -> bool:
    """Whether a model's commands predict beyond chance, and clearly at some horizon.

    Its error must be below that without commands and that of holding the rate. A feedback's
    commands contain past rates and angles, which predict a little even while the motors stand.
    """
    by_command = (  # these may move by it without a gain
        i for i, part in enumerate(fitted.structure.parts) if 'command' in part.effect.signals
    )
    uncommanded = fit_without(problem, fitted, *by_command, still=(0, 1, 2))
    own, held = unseen.errors(fitted), unseen.holding(unseen.windows)
    without, evidence, clearly = held, [], False
    if uncommanded is not None:
        without, evidence = unseen.errors(uncommanded), [unseen.bet(fitted, uncommanded)]
    for horizon in HORIZONS_S:
        k = at_horizon(horizon, unseen.problem.data.dt)
        if k < unseen.windows.length:
            evidence.append(bet(without[:, k] ** 2, own[:, k] ** 2))
            clearly |= DIFFERS * rms(own[:, k]) < min(rms(without[:, k]), rms(held[:, k]))
    return clearly and float(np.mean(evidence)) * LEVEL >= 1.0  # a mean of e-values is one


def _empty(found: Found, unseen: Unseen, e_value: float) -> tuple[str, str]:
    """Verdict and reason without effects, where the commands predict."""
    base = found.base
    left = unexplained(unseen, base)
    if left:
        return 'unexplained_residual', left
    if e_value * LEVEL >= 1.0 and not stays_bounded(unseen, found.best):
        return 'unexplained_residual', (
            'the most probable structure predicts better than the base, but a free run of it '
            'leaves all bounds, so it explains nothing'
        )
    if e_value * LEVEL >= 1.0:
        return 'unexplained_residual', (
            'the most probable structure predicts the next sample better than the base, but not '
            'the free run: the noise may have another colour than the model gives it, or the '
            'structure may hold for the training only'
        )
    if found.probabilities()[[s.fit is base for s in found.all]].sum() < LEVEL:
        return 'unexplained_residual', (
            'the data contradict the base alone, but support no structure that was tried clearly '
            'enough to claim it'
        )
    return 'no_missing_effect', ''


def unexplained(unseen: Unseen, fitted: Fit) -> str:
    """How the free run's errors are larger or more uneven than noise causes; '' if they are not.

    Under the noise model the sign of an innovation says nothing about the next, whatever their
    sizes: gusts may have lulls and bursts. The errors are therefore compared with those that the
    same innovations cause, through the filter's gain, with random signs. An error counts if it
    exceeds all of FLIPS such draws and, by the factor DIFFERS, their median.
    """
    windows = unseen.windows
    if windows.count < 2:
        return ''
    found = fitted.prediction.filter
    state, response = found.gain, np.ones(windows.length)
    for k in range(1, windows.length):
        state = found.transition @ state
        response[k] = found.output @ state
    through = np.triu(toeplitz(response))
    at = windows.starts[:, None] + np.arange(windows.length)
    innovations = np.nan_to_num(unseen.predict(fitted).innovation[at])
    rng = np.random.default_rng(0)
    drawn = np.array([
        _size_and_spread((innovations * rng.choice((-1.0, 1.0), innovations.shape)) @ through)
        for _ in range(FLIPS)
    ])
    derived = unseen.problem.flight.sensor.derived  # innovations are of the angle there
    own = _size_and_spread(innovations @ through if derived else unseen.errors(fitted))
    ratio = own / np.median(drawn, axis=0)
    size, spread = np.where(own > drawn.max(axis=0), ratio, 1.0)
    if size > DIFFERS:
        return f'the held-out error is {size:.2f} times what noise of that size would cause'
    if spread > DIFFERS:
        return f'the held-out errors come in bursts, {spread:.2f} times as uneven as from noise'
    return ''


def _squares(errors: FloatArray) -> FloatArray:
    """(windows,) mean squares of errors (windows, length)."""
    with np.errstate(over='ignore', invalid='ignore'):
        return np.asarray(np.mean(errors**2, axis=1))


def _size_and_spread(errors: FloatArray) -> FloatArray:
    """(2,) RMS of errors (windows, length), and its ratio to the windows' geometric mean."""
    square = _squares(errors)
    with np.errstate(over='ignore', invalid='ignore'):
        size = np.sqrt(np.mean(square))
        return np.array([size, size / np.exp(0.5 * np.mean(np.log(square + 1e-300)))])


def listed(
    parts: Sequence[Part], without: Sequence[float], after: float, usual: float
) -> list[float]:
    """Probability of each effect, if it helps, that it is what its name says.

    A free form describes physics that the list lacks, and so do several shapes and modes: one
    cause is likelier than many. A named effect beside them may merely mend that description, and
    is then no larger than they are; one of its own is as probable as any (EXPECTED), and of the
    usual size. All in rad/s; without: errors without each.
    """
    squares = np.clip(np.square(without) - after**2, 0.0, HUGE)
    named = np.array([part.effect.kind == 'named' for part in parts], dtype=bool)
    described = float(np.sum(squares[~named]))
    of_the_list = np.sum(~named) == 1 and not any(part.effect.free for part in parts)
    if of_the_list or not described > 0.0:
        return [1.0] * len(parts)
    ratio = described / usual**2  # of the variances of two normal distributions
    odds = math.log(EXPECTED) + 0.5 * math.log(ratio) + 0.5 * (1.0 - ratio) * squares / described
    return [float(p) for p in np.where(named, expit(odds), 1.0)]


def _posterior(
    found: Found, chosen: Fit, as_named: Sequence[float]
) -> tuple[tuple[float, ...], tuple[tuple[tuple[str, float], ...], ...]]:
    """Probability of each chosen effect, and of its alternatives.

    as_named: if it is the most probable one, that it is what its name says.
    """
    probabilities, rivals = [], []
    own = Counter(part.effect.name for part in chosen.structure.parts)
    dropped = Counter(part.effect.name for part in found.best.structure.parts) - own
    for part, listed_as in zip(chosen.structure.parts, as_named, strict=True):
        name = part.effect.name
        rest = own - Counter([name])
        share: defaultdict[str, float] = defaultdict(float)
        for scored, p in zip(found.all, found.probabilities(), strict=True):
            left = Counter(scored.names) - dropped
            if left >= rest:
                others = set(left - rest) or {'nothing'}
                for one in others:
                    share[one] += float(p) / len(others)
        least = LEAST_REPORTED * sum(share.values())
        kept = {one: v for one, v in share.items() if one == name or v > least}
        total, full = sum(kept.values()) or 1.0, kept.pop(name, 0.0)
        doubt = (1.0 - listed_as) * full
        if doubt > least:
            kept[UNLISTED] = doubt
        probabilities.append((full - kept.get(UNLISTED, 0.0)) / total)
        rivals.append(tuple(sorted(
            ((one, v / total) for one, v in kept.items()), key=lambda item: -item[1]
        )))
    return tuple(probabilities), tuple(rivals)
