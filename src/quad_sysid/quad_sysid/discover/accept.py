"""The verdict on the validation segments, which are opened once, after everything is chosen.

Each effect of the answer's rung is confirmed by tests of its own or withdrawn, and the errors are
computed; nothing else is decided here.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
from scipy import special

from quad_sysid.contract import FloatArray
from quad_sysid.discover.base import fit_without
from quad_sysid.discover.constants import AGAIN, DIFFERS, FLIPS, LEAST_BLOCKS, LEVEL
from quad_sysid.discover.search import SearchResult
from quad_sysid.estimate.fit import Fit, Problem, stays_bounded
from quad_sysid.estimate.stored import Stored, noise_of
from quad_sysid.explain.ladder import Ladder
from quad_sysid.model.data import AxisData, Windows
from quad_sysid.model.effect import Effect
from quad_sysid.model.flight import Prediction
from quad_sysid.model.identified import UNLISTED
from quad_sysid.model.noise import growth, transitions

HORIZONS_S = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
SHORT_S = HORIZONS_S[2]
"""Windows over which motors answer, and gusts have hardly turned the aircraft yet."""
AT_ONCE = 20
"""Draws of random signs that are run side by side, which bounds the memory."""
MOST_DEPENDENT, LEAST_COUNT = 0.98, 1.5
"""Bounds of the dependence of neighbouring blocks, and of how many independent ones they are."""
HUGE = 1e100
LEAST_P = 1e-12
LEAST_REPORTED = 0.005
"""Share of the rivals' probability below which one is not reported."""


def p_value(shares: FloatArray) -> float:
    """Chance of a mean as large as that of `shares` (blocks,) where nothing speaks for a claim.

    One-sided t-test of as many independent blocks as these stand for, each of which may depend on
    the last: n (1 - r) / (1 + r) (Bayley, Hammersley 1946), with as many degrees of freedom. r is
    their correlation, of which removing the mean takes 1 / n.
    """
    n = shares.size
    if n < LEAST_BLOCKS:
        return 1.0
    mean = float(np.mean(shares))
    deviations = shares - mean
    squares = float(deviations @ deviations)
    if squares <= 0.0:
        return 0.0 if mean > 0.0 else 1.0
    estimated = float(deviations[1:] @ deviations[:-1]) / squares
    dependence = min(max(estimated + 1.0 / n, 0.0), MOST_DEPENDENT)
    count = max(n * (1.0 - dependence) / (1.0 + dependence), LEAST_COUNT)
    variance = squares / (n * (1.0 - 1.0 / count))
    return float(special.stdtr(count, -mean * math.sqrt(count / variance)))


def p_of_both(long: FloatArray, shorter: FloatArray, ahead: FloatArray) -> float:
    """Chance of what a model's free runs, shorter ones and the next sample's likelihood show.

    Each (windows,), -1 to 1. Two tests: the metric's own windows alone, and the mean of all three,
    for where gusts rule long windows shorter ones may tell. A model that was projected onto the
    long ones may predict the next sample worse.
    """
    return of_both(p_value(long), p_value((long + shorter + ahead) / 3.0))


def of_both(*p_values: float) -> float:
    """The chance that tests which depend on each other leave together (Wilson 2019)."""
    return float(1.0 / np.mean(1.0 / np.maximum(p_values, LEAST_P)))


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
class Claim:
    """What the held-out segments and the resampled flights say of one effect."""

    p_value: float
    error_reduction_pct: float
    """How much lower the error is with the effect."""
    reproducible: float

    @property
    def accepted(self) -> bool:
        """Whether it is claimed."""
        return self.p_value <= LEVEL and self.reproducible >= AGAIN


@dataclass(frozen=True)
class Verdict:
    """The answer for one axis."""

    verdict: str
    reason: str
    """Why no effect was added; if one was, what remains unexplained."""
    base: Fit
    """Rung 0: the base as near to the reference as it comes, with the noise of the training."""
    chosen: Fit
    """The answer's rung; `base` where no effect is claimed."""
    claims: tuple[Claim, ...]
    """One claim for each effect of `chosen`."""
    before: float
    after: float
    reference: float
    """Error of what predicts other times of the training best, rad/s."""
    rungs: tuple[float, ...]
    """Error of each rung of the ladder, rad/s."""
    rung_fits: tuple[Fit, ...]
    one_step_before: float
    one_step_after: float
    hold: float
    predicted: float
    """Error that the chosen model's own noise predicts for `after`, rad/s."""
    noise_floor: float
    horizons: tuple[Horizon, ...]
    probabilities: tuple[float, ...]
    """Posterior of each chosen effect."""
    rivals: tuple[tuple[tuple[str, float], ...], ...]
    """The alternatives of each chosen effect with their probabilities."""


Fitted = Fit | Stored
"""A model that predicts."""


class Unseen:
    """The validation segments, and the errors of fitted models on them."""

    def __init__(self, data: AxisData, spans: Sequence[tuple[int, int]]) -> None:
        self.problem = Problem(data, spans, whole=True)
        self.windows = data.windows(spans)
        self.lengths = self.windows, data.windows(spans, SHORT_S)
        self.long = data.windows(spans, HORIZONS_S[-1])
        self.start_rate = self.problem.flight.rate
        self.known: WeakKeyDictionary[Fitted, Prediction] = WeakKeyDictionary()
        self.ran: dict[tuple[Fitted, int], FloatArray] = {}

    def predict(self, fitted: Fitted) -> Prediction:
        """The filter's result along the segments.

        The first call measures the size of the innovations, by which the filter follows what
        wanders.
        """
        if fitted not in self.known:
            flight = self.problem.flight
            flight.rate = self.start_rate
            self.known[fitted] = flight.predict(fitted.structure, fitted.theta, sweeps=3)
        return self.known[fitted]

    def p_value(self, fitted: Fitted, other: Fitted) -> float:
        """Chance of this much evidence for a model against another if it predicts no better.

        1 where its error is not lower.
        """
        if rms(self.errors(fitted)) >= rms(self.errors(other)):
            return 1.0
        long, short = (shares_of(*pair) for pair in self.squares(other, fitted))
        shorter = np.array([np.mean(part) for part in np.array_split(short, long.size)]) \
            if short.size >= long.size else long
        return p_of_both(long, shorter, self.balance(fitted, other))

    def balance(self, fitted: Fitted, other: Fitted) -> FloatArray:
        """(windows,) balance of the log-likelihoods of a model and another, -1 to 1."""
        gain = self.log_likelihood(fitted) - self.log_likelihood(other)
        starts = np.searchsorted(self.problem.rows, self.windows.starts)
        stops = np.searchsorted(self.problem.rows, self.windows.starts + self.windows.length)
        sums = np.array([
            [np.sum(np.maximum(sign * gain[a:b], 0.0)) for sign in (1.0, -1.0)]
            for a, b in zip(starts, stops, strict=True)
        ]).reshape(-1, 2)
        return shares_of(*sums.T)

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
                self.ran[run] = self.problem.flight.run(
                    fitted.structure, fitted.theta, windows, prediction=prediction).errors
        return self.ran[run]

    def squares(self, *models: Fitted) -> list[list[FloatArray]]:
        """Mean squares (windows,) of each model's errors, for windows of both lengths."""
        return [[_squares(self.errors(model, windows)) for model in models]
                for windows in self.lengths]

    def one_step(self, fitted: Fitted) -> float:
        """RMS of the innovations in the windows, rad/s: behind a gap the filter has to settle."""
        rows = np.intersect1d(self.problem.rows, self.windows.cells)
        return rms(self.predict(fitted).innovation[rows])

    def holding(self, windows: Windows) -> FloatArray:
        """(windows, length) errors of holding the last rate, rad/s."""
        rate = self.problem.flight.gyro
        return rate[windows.starts - 1][:, None] - rate[windows.cells]


def rms(errors: FloatArray) -> float:
    """Root mean square; infinite where a model diverges."""
    with np.errstate(over='ignore', invalid='ignore'):
        value = float(np.sqrt(np.mean(errors**2))) if errors.size else math.nan
    return value if not math.isnan(value) else math.inf


def judge(unseen: Unseen, problem: Problem, search: SearchResult, ladder: Ladder) -> Verdict:
    """Confirm or withdraw each claimed effect on the validation segments.

    What is claimed, and in which order, the training has decided (explain/ladder.py).
    """
    unseen.predict(search.base)  # which measures the innovations that wandering effects follow
    models = ladder.models
    rungs = [models.fitted(rung.model) for rung in ladder.rungs]
    base = chosen = rungs[0]
    answer = ladder.rungs[ladder.answer].model
    claims: list[Claim] = []
    while answer.structure.parts:
        fitted = models.comparable(answer)
        if not isinstance(fitted, Fit):  # what is left may not follow a flight
            break
        without = dict(zip(answer.structure.labels, models.each_left_out(answer), strict=True))
        # a fit of the search has its effects in the search's order
        claims = [_claim(unseen, ladder, rungs, fitted,
                         models.comparable(without[part.effect.label]), part.effect)
                  for part in fitted.structure.parts]
        weak = {label: claim for label, claim in zip(fitted.structure.labels, claims, strict=True)
                if not claim.accepted}
        if not weak:
            if unseen.p_value(fitted, base) <= LEVEL:
                chosen = fitted
            break
        # one at a time: each of two that stand for the same makes the other look needless
        weakest = max(weak, key=lambda label: (weak[label].p_value, -weak[label].reproducible))
        if weakest == min(without, key=ladder.rank):
            break  # the main cause, in whose place the others would stand
        answer = without[weakest]
    commanded = any(_commands_predict(problem, unseen, fitted)
                    for fitted in dict.fromkeys((chosen, ladder.predicting)))
    if not commanded or not stays_bounded(unseen.problem, chosen, unseen.predict(chosen)):
        chosen = base
    if chosen is base:
        claims = []
    parts = chosen.structure.parts
    noise, spread = noise_of(chosen), growth(chosen.prediction.filter, unseen.windows.length)
    verdict, reason = 'cannot_tell', (
        'the commands do not predict the held-out rates better than the rates themselves do'
    )
    if commanded:
        verdict, reason = ('effects_added', unexplained(unseen, chosen)) if parts \
            else _empty(ladder, unseen, base)
    probabilities, rivals = _posterior(search, chosen, ladder)
    return Verdict(
        verdict=verdict, reason=reason, base=base, chosen=chosen, claims=tuple(claims),
        before=rms(unseen.errors(base)), after=rms(unseen.errors(chosen)),
        reference=rms(unseen.errors(ladder.predicting)),
        rungs=tuple(rms(unseen.errors(rung)) for rung in rungs), rung_fits=tuple(rungs),
        one_step_before=unseen.one_step(base), one_step_after=unseen.one_step(chosen),
        hold=rms(unseen.holding(unseen.windows)),
        predicted=noise.gyro_rms * math.sqrt(float(np.mean(spread))),
        noise_floor=noise.measured_rms, horizons=horizons(unseen, base, chosen),
        probabilities=probabilities, rivals=rivals,
    )


def _claim(unseen: Unseen, ladder: Ladder, rungs: Sequence[Fitted], chosen: Fitted,
           without: Fitted, effect: Effect) -> Claim:
    """What the answer and what is left of it without an effect say of that effect.

    Two tests: the answer against that, and the rung that adds the effect against the one below. A
    finer effect that contains a friction makes that friction needless, but not untrue.
    """
    added = ladder.added.get(effect.label)
    pairs = [(chosen, without)] + ([(rungs[added], rungs[added - 1])] if added else [])
    errors = [[rms(unseen.errors(fitted)) for fitted in pair] for pair in pairs]
    reduction = max(1.0 - error / max(other, LEAST_P) for error, other in errors)
    return Claim(of_both(*(unseen.p_value(*pair) for pair in pairs)), 100.0 * reduction,
                 ladder.reproducible.get(effect.name, 1.0))


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


def _commands_predict(problem: Problem, unseen: Unseen, fitted: Fit) -> bool:
    """Whether a model's commands predict beyond chance, and clearly at some horizon.

    Its error must be below that without commands and that of holding the rate. A feedback's
    commands contain past rates and angles, which predict a little even while the motors stand.
    """
    by_command = (  # these may move by it without a gain
        i for i, part in enumerate(fitted.structure.parts) if 'command' in part.effect.signals
    )
    uncommanded = fit_without(problem, fitted, *by_command, fixed=(0, 1, 2), silent=True)
    errors, hold_errors = unseen.errors(fitted), unseen.holding(unseen.windows)
    without, shares, clearly = hold_errors, [], False
    if uncommanded is not None:
        without = unseen.errors(uncommanded)
        shares.append(unseen.balance(fitted, uncommanded))
    for horizon in HORIZONS_S:
        k = at_horizon(horizon, unseen.problem.data.dt)
        if k < unseen.windows.length:
            shares.append(shares_of(without[:, k] ** 2, errors[:, k] ** 2))
            least = min(rms(without[:, k]), rms(hold_errors[:, k]))
            clearly |= DIFFERS * rms(errors[:, k]) < least
    return clearly and p_value(np.mean(shares, axis=0)) <= LEVEL


def _empty(ladder: Ladder, unseen: Unseen, base: Fit) -> tuple[str, str]:
    """Verdict and reason without effects, where the commands predict."""
    reason = unexplained(unseen, base)
    if reason:
        return 'unexplained_residual', reason
    if ladder.negligible:
        return 'no_missing_effect', (
            f'the base predicts all but {100.0 - ladder.predicts_pct:.1g} % of the motion'
        )
    richer = ladder.predicting
    if unseen.p_value(richer, base) <= LEVEL:
        lower = 1.0 - rms(unseen.errors(richer)) / rms(unseen.errors(base))
        return 'unexplained_residual', (
            f'the model that predicts best lowers the held-out error by {100.0 * lower:.0f} %, '
            'yet no cause of that is confirmed')
    return 'no_missing_effect', ''


def unexplained(unseen: Unseen, fitted: Fit) -> str:
    """How the free run's errors are larger or more uneven than noise causes; '' if they are not.

    Under the noise model the sign of an innovation says nothing about the next, whatever their
    sizes: gusts may have lulls and bursts. The errors are therefore compared with those that the
    same innovations cause, through the filter's gain and the slope of the torque where they fell,
    with random signs: what turns freely keeps an error that a friction would hold. An error counts
    if it exceeds all of FLIPS such draws and, by the factor DIFFERS, their median.
    """
    windows = unseen.windows
    if windows.count < 2 or rms(unseen.errors(fitted)) < fitted.tail.scale:  # less than its noise
        return ''
    innovations = np.nan_to_num(unseen.predict(fitted).innovation[windows.cells])
    rng = np.random.default_rng(0)
    drawn = np.array([
        _size_and_spread(errors) for _ in range(0, FLIPS, AT_ONCE)
        for errors in _caused(unseen, fitted, innovations * rng.choice(
            (-1.0, 1.0), (AT_ONCE, *innovations.shape)))
    ])
    derived = unseen.problem.flight.sensor.derived  # innovations are of the angle there
    measured = _size_and_spread(_caused(unseen, fitted, innovations[None])[0] if derived
                                   else unseen.errors(fitted))
    ratio = measured / np.median(drawn, axis=0)
    size, spread = np.where(measured > drawn.max(axis=0), ratio, 1.0)
    if size > DIFFERS:
        return f'the held-out error is {size:.2f} times what noise of that size would cause'
    if spread > DIFFERS:
        return f'the held-out errors come in bursts, {spread:.2f} times as uneven as from noise'
    return ''


def _caused(unseen: Unseen, fitted: Fitted, innovations: FloatArray) -> FloatArray:
    """Errors (k, windows, length) that innovations of that shape cause in the free runs."""
    windows, flight, prediction = unseen.windows, unseen.problem.flight, unseen.predict(fitted)
    steady, dt = prediction.filter, unseen.problem.data.dt
    values = fitted.structure.natural(fitted.theta)
    slope = flight.pushed(fitted.structure, values, prediction.rate).slope
    errors, state = innovations.copy(), np.zeros((*innovations.shape[:2], steady.gain.size))
    for j in range(windows.length):
        errors[..., j] += state @ steady.output
        moves = transitions(steady, flight.sensor, slope[windows.starts + j], dt)
        state = np.einsum('wij,kwj->kwi', moves, state + innovations[..., j, None] * steady.gain)
    return unseen.problem.data.where_measured(errors, windows)


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


def _posterior(
    search: SearchResult, chosen: Fit, ladder: Ladder
) -> tuple[tuple[float, ...], tuple[tuple[tuple[str, float], ...], ...]]:
    """Probability of each chosen effect, and of its alternatives, by the training's evidence.

    Each is compared beside what the answer and the reference share. An effect that the ladder put
    in the place of one of the reference's is as probable as it comes again.
    """
    probabilities, rivals = [], []
    chosen_names, best_names = (Counter(part.effect.name for part in fitted.structure.parts)
                                for fitted in (chosen, search.best))
    finer = best_names - chosen_names
    for part in chosen.structure.parts:
        name = part.effect.name
        other_names = (chosen_names & best_names) - Counter([name])
        share: defaultdict[str, float] = defaultdict(float)
        for scored, p in zip(search.all, search.probabilities(), strict=True):
            rest = Counter(scored.names) - finer
            if rest >= other_names:
                alternatives = sorted(rest - other_names) or ['nothing']
                for other in alternatives:
                    share[other] += float(p) / len(alternatives)
        if name not in best_names:
            reproducible = ladder.reproducible.get(name, 1.0)
            share = defaultdict(float, {name: reproducible, UNLISTED: 1.0 - reproducible})
        least = LEAST_REPORTED * sum(share.values())
        probable = {other: v for other, v in share.items() if other == name or v > least}
        if len(search.prices) == 1:  # a lone candidate has no other rival
            probable['nothing'] = share['nothing']
        total = sum(probable.values()) or 1.0
        probabilities.append(probable.pop(name, 0.0) / total)
        rivals.append(tuple(sorted(
            ((other, v / total) for other, v in probable.items()), key=lambda item: -item[1]
        )))
    return tuple(probabilities), tuple(rivals)
