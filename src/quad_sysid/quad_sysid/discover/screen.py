"""Scores of candidates beside a fitted structure, by one linear step instead of a fit.

A candidate's columns pass through the same filter as the fit's derivatives. The score is what they
explain of the innovations beyond these, under their prior. It only chooses what is fitted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve
from scipy.signal import fftconvolve, find_peaks, lfilter

from quad_sysid.beside import side_by_side
from quad_sysid.contract import FloatArray
from quad_sysid.discover.constants import FEW_STARTS, PER_NONLINEAR
from quad_sysid.estimate.fit import Fit, Problem
from quad_sysid.model import recursion
from quad_sysid.model.data import AxisData
from quad_sysid.model.effect import SMALL, Effect, Part, per_unit, required
from quad_sysid.model.flight import per_coefficient
from quad_sysid.model.structure import BASE, Structure, coordinates, logs_of, natural

FAINT = 1e-30
"""Added to every column, rad/s²: what fades further is multiplied a hundred times as slowly."""
AT_ONCE = 16
"""Starts of a candidate that are filtered at once: events of a long flight have hundreds."""
ANSWER_S = 0.5
"""Innovations answer to a pulse for no longer."""
APART_S = 0.1
"""Least distance of two edges of a torque: about as long as innovations answer to one."""
LINES = 4
LINE_BAND_HZ = (0.1, 16.0)
BIN = 2.5e-4
"""Width of the bins over the motors' commands."""
STEPS = (16.0, 500.0)
"""Fewest and most steps in the whole range of a command."""
PADDED = 1 << 17
"""Bins of the spectrum in which they are sought."""


@dataclass(frozen=True)
class Score:
    """Result of one linear step for a candidate."""

    part: Part
    starts: tuple[FloatArray, ...]
    """Start values of its parameters, each (q,) in the coordinates of the fit."""
    nats: float


def _spectrum(problem: Problem, signal: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Frequency (Hz) and power of a signal (n,) over the longest segment."""
    start, stop = max(problem.spans, key=lambda span: span[1] - span[0])
    part = signal[start:stop] - signal[start:stop].mean()
    size = 4 * part.size
    power = np.abs(np.fft.rfft(part * np.hanning(part.size), size)) ** 2
    return np.fft.rfftfreq(size, problem.data.dt).astype(np.float64), power


def _peaks(power: FloatArray, apart: int) -> NDArray[np.int64]:
    """Where the highest peaks are, at least so far apart."""
    peaks = find_peaks(power, distance=apart)[0]
    return peaks[np.argsort(-power[peaks])][:LINES]


def vibration_line(problem: Problem, fitted: Fit) -> float | None:
    """Frequency (Hz) of the strongest line above that band; None where the rate is too low."""
    frequency, power = _spectrum(problem, np.nan_to_num(fitted.prediction.innovation))
    above = frequency > LINE_BAND_HZ[1]
    if above.sum() < 100:
        return None
    smooth = np.convolve(power, np.full(25, 1.0 / 25.0), mode='same')
    smooth[~above] = 0.0
    return float(frequency[int(np.argmax(smooth))])


def screen(problem: Problem, fitted: Fit, parts: Sequence[Part]) -> list[Score]:
    """The best start and score of each candidate, best first."""
    screening = _Screening(problem, fitted)
    scores = side_by_side([partial(screening.best, part) for part in parts])
    return sorted((score for score in scores if score is not None), key=lambda s: -s.nats)


class Trajectory:
    """What acts along a trajectory `rate` (n,) with a structure's parameters."""

    def __init__(self, problem: Problem, structure: Structure, theta: FloatArray,
                 rate: FloatArray) -> None:
        self.problem, self.structure, self.theta = problem, structure, theta
        flight = problem.flight
        self.values = structure.natural(theta)
        self.signals = flight.signals(structure, self.values, rate)
        self.push = flight.pushed(structure, self.values, rate)
        self.slope = self.push.slope

    @property
    def acceleration(self) -> FloatArray:
        """(n,) mean of each cycle, rad/s², of all but the disturbance."""
        return np.asarray(np.mean(self.push.known, axis=0) + self.slope * self.signals.rate)

    def columns(self, part: Part, linear: list[int], p: FloatArray) -> Sequence[FloatArray]:
        """Mean acceleration of each cycle per unit of each linear parameter, (n,) each, rad/s².

        Without a linear parameter the acceleration at `p`.
        """
        effect, values = part.effect, natural(logs_of(part.effect.parameters), p)
        if effect.wanders:
            return [per_coefficient(part, self.signals, values)]
        if not effect.moves_command:
            signals = self.problem.flight.hidden(part, self.signals, values)
            return effect.columns(signals, values, linear, part.settings).T if linear else [
                required(effect.torque(signals, values, part.settings))]
        if not linear:
            return [self._added(part, p)]
        return [self._added(part, p + step) / SMALL for step in SMALL * np.eye(p.size)[linear]]

    def _added(self, part: Part, p: FloatArray) -> FloatArray:
        """(n,) what a candidate that acts before the drive changes of its mean in each cycle."""
        structure = self.structure.plus(part)
        theta = np.insert(self.theta, -len(structure.noise), p)
        halves, _ = self.problem.flight.driven(structure, structure.natural(theta))
        return self.values[0] * np.mean(halves, axis=0) - self.signals.drive


def linear_of(part: Part) -> list[int]:
    """The parameters that a screen takes for linear."""
    return [j for j, spec in enumerate(part.effect.parameters)
            if not spec.log and not spec.starts and spec.centre == 0.0]


class _Screening(Trajectory):
    """The fit beside which candidates are scored; its parameters are projected out.

    The priors of the fit's parameters count as rows of their own.
    """

    def __init__(self, problem: Problem, fitted: Fit) -> None:
        self.fitted = fitted
        problem.flight.rate = fitted.rate
        super().__init__(problem, fitted.structure, fitted.theta, fitted.rate)
        e = self.innovation = np.nan_to_num(fitted.prediction.innovation)
        self.weight = np.zeros((e.size, 1))  # of samples that do not count
        counts = fitted.tail.weights(e[problem.rows])
        self.weight[problem.rows, 0] = np.sqrt(counts) / fitted.tail.scale
        jacobian = required(fitted.prediction.jacobian) * self.weight
        root = np.linalg.cholesky(fitted.precision).T
        self.q, self.of_priors = np.split(np.linalg.qr(np.vstack([jacobian, root]))[0], [e.size])
        weighted = e * self.weight[:, 0]
        self.left = weighted - self.q @ (self.q.T @ weighted)

    def best(self, part: Part) -> Score | None:
        """The best start and score of a candidate; None where none is physical.

        Of many starts those are scored that lead on the short part of the flight. It would miss
        what happens at a time.
        """
        starts = self.starts(part)
        short = self.on_short_problem
        if short is not None and len(starts) > FEW_STARTS and not part.effect.happens:
            nats = [-math.inf if s is None else s.nats for s in short.scored(part, starts)]
            starts = [starts[i] for i in np.argsort(nats)[: -FEW_STARTS - 1 : -1]]
        scores = (s for s in self.scored(part, starts) if s is not None)
        return max(scores, key=lambda s: s.nats, default=None)

    def scored(self, part: Part, starts: Sequence[FloatArray]) -> list[Score | None]:
        """The score of each start."""
        linear, scores = linear_of(part), []
        for begin in range(0, len(starts), AT_ONCE):
            batch = starts[begin : begin + AT_ONCE]
            inputs = np.vstack([self.columns(part, linear, p) for p in batch]) + FAINT
            responses = self.problem.flight.responses(
                np.ascontiguousarray(inputs.T), self.slope, self.fitted.prediction.filters
            )
            if part.effect.wanders:
                responses = np.stack([self._tracked_change(p, psi) for p, psi
                                      in zip(batch, responses.T, strict=True)], axis=1)
            out = self.weight * responses
            common = self.q.T @ out  # what the fit's own parameters can do too
            rest = np.vstack([out - self.q @ common, self.of_priors @ common])
            for p, b, own in zip(batch, np.split(-(out.T @ self.left), len(batch)),
                                 np.split(rest, len(batch), axis=1), strict=True):
                scores.append(self.score(part, linear, p, b, own.T @ own))
        return scores

    @cached_property
    def on_short_problem(self) -> _Screening | None:
        """The same on the short part of the flight."""
        short_problem = self.problem.short_problem
        if short_problem is None:
            return None
        fitted, short_problem.flight.rate = self.fitted, self.fitted.rate[short_problem.index]
        steps = short_problem.steps(fitted.structure, fitted.theta)
        prediction = short_problem.flight.predict(fitted.structure, fitted.theta, steps=steps)
        return None if prediction.jacobian is None else \
            _Screening(short_problem, replace(fitted, prediction=prediction))

    def starts(self, part: Part) -> list[FloatArray]:
        """Start values of a candidate, each (q,) coordinates, the linear parameters at zero."""
        effect = part.effect
        starts = effect.starts_by_residual(self, part.settings)
        return [coordinates(effect.parameters, start) for start in starts]

    @property
    def data(self) -> AxisData:
        """The flight."""
        return self.problem.data

    def lines(self, effect: Effect) -> list[float]:
        """Frequencies (Hz) at which a term swings, by the correlation with what it would cause."""
        signal, highest = self.innovation, LINE_BAND_HZ[1]
        if effect.term != 'torque':
            signal, highest = self.correlated(effect), math.inf
        frequency, power = _spectrum(self.problem, signal)
        power[(frequency < LINE_BAND_HZ[0]) | (frequency > highest)] = 0.0
        return [float(frequency[peak]) for peak in _peaks(power, 12)]

    def steps(self) -> list[FloatArray]:
        """Steps in which motors may take their commands, each with one level, the same way.

        Rounding adds a saw over the command, for which its first harmonic stands.
        """
        data, input_part = self.problem.data, self._behind_lag()
        late = round(self.values[2] / data.dt)
        bins = np.clip(np.roll(data.motors, late, axis=0), 0.0, 1.0) // BIN
        sums = np.zeros(1 + round(1.0 / BIN))
        for levels, share in zip(bins.T.astype(int), data.share, strict=True):
            sums += np.bincount(levels, share * input_part, sums.size)
        waves, count = np.fft.rfft(sums, PADDED), np.fft.rfftfreq(PADDED, BIN)
        size = np.where((count > STEPS[0]) & (count < STEPS[1]), np.abs(waves), 0.0)
        starts = []
        for peak in _peaks(size, 60):
            turn = 0.25 - np.angle(waves[peak]) / (2.0 * math.pi) - count[peak] * (0.5 - 0.5 * BIN)
            starts.append(np.array([1.0 / count[peak], turn - np.round(turn)]))
        return starts

    def edges(self) -> list[float]:
        """Times (s) at which a torque may begin or end, by the innovations that a step causes."""
        data, size = self.problem.data, np.abs(self._meeting(np.cumsum(self.answer)))
        return [float(data.clock[peak]) for peak in _peaks(size, round(APART_S / data.dt))]

    @cached_property
    def answer(self) -> FloatArray:
        """Innovations by a unit of acceleration in one cycle, from that cycle on."""
        flight, dt = self.problem.flight, self.problem.data.dt
        begin, n = flight.passes[0][0], self.innovation.size
        pulse = np.zeros((n, 1))
        pulse[begin] = 1.0
        answer = flight.responses(pulse, self.slope, self.fitted.prediction.filters)
        return answer[begin : begin + round(ANSWER_S / dt), 0]

    def _meeting(self, answer: FloatArray) -> FloatArray:
        """(n,) derivative of the log-likelihood by what causes that answer from each cycle on."""
        e = self.innovation * self.weight[:, 0] ** 2
        return -fftconvolve(e, answer[::-1])[answer.size - 1 :]

    @cached_property
    def backwards(self) -> FloatArray:
        """(n,) derivative of the log-likelihood by the acceleration of each cycle.

        The innovations pass backwards through the filter.
        """
        return self._meeting(self.answer)

    def correlated(self, effect: Effect) -> FloatArray:
        """(n,) the same by the effect's term: what moves the command acts through the lag."""
        if not effect.moves_command:
            return self.backwards * per_unit(effect.term, self.signals)
        return -self._behind_lag() * np.gradient(self.signals.command)

    def _behind_lag(self) -> FloatArray:
        """(n,) the same by the command times the gain."""
        keep = math.exp(-self.problem.data.dt / self.values[1])
        return lfilter([1.0 - keep], [1.0, -keep], self.backwards[::-1])[::-1]

    def score(self, part: Part, linear: list[int], p: FloatArray, b: FloatArray,
              rest: FloatArray) -> Score | None:
        """What a linear step gains from one start; None where its sign is not physical.

        b (k,): slope of the log-likelihood over each column; rest (k, k): squares and products of
        the columns beyond what the fit's own parameters can do.
        """
        effect = part.effect
        nats = -PER_NONLINEAR * (p.size - len(linear))
        if not np.isfinite(rest).all():
            return None
        if not linear:  # what it does from this start, as it is
            return Score(part, (p,), nats + float(b[0] - 0.5 * rest[0, 0]))
        precision = effect.precision(part.settings, self.problem.sizes_of(part))
        precision = precision[np.ix_(linear, linear)]
        try:
            factor = np.linalg.cholesky(rest + precision)
        except np.linalg.LinAlgError:  # rounding leaves nothing that is its own
            return None
        x = cho_solve((factor, True), b)
        narrowed = np.diag(factor) / np.diag(np.linalg.cholesky(precision))
        nats += 0.5 * float(b @ x) - float(np.sum(np.log(narrowed)))
        if any(effect.parameters[j].positive and v < 0.0 for j, v in zip(linear, x, strict=True)):
            return None
        start, gentle = p.copy(), p.copy()  # a linear step may overshoot what is not linear
        start[linear], gentle[linear] = x, 0.3 * x
        return Score(part, (start,) if len(linear) == p.size else (start, gentle), nats)

    def _tracked_change(self, p: FloatArray, psi: FloatArray) -> FloatArray:
        """(n,) change of the innovations if a coefficient follows them."""
        flight, e, psi = self.problem.flight, self.innovation, np.ascontiguousarray(psi)
        pursuit, out = flight.pursuit(psi, p), e.copy()
        for start, stop in flight.passes:
            recursion.pursued(e, psi, pursuit, start, stop, out)
        return out - e


MIN_MOTORS = 4
"""A report lists the effects of so many motors as not tested where no motor is known."""


def candidates(
    problem: Problem, effects: Sequence[Effect]
) -> tuple[list[Part], dict[str, str]]:
    """Candidates that these data can show, and the reasons against the others.

    What differs in a motor that the craft does not have is none of them; beside a law of the
    user's, what changes a built-in term can be shown only where the base keeps that term.
    """
    count = max(problem.data.motors.shape[1], MIN_MOTORS)
    settings_of = [(effect, _replaced(problem, effect) or effect.prepare(problem.data))
                   for effect in effects
                   if max(effect.motors, default=0) < count
                   and (not effect.axes or problem.data.axis in effect.axes)]
    parts = [Part(effect, settings) for effect, settings in settings_of
             if not isinstance(settings, str)]
    return parts, {effect.label: why for effect, why in settings_of if isinstance(why, str)}


def _replaced(problem: Problem, effect: Effect) -> str:
    """Why an effect has no built-in term to change beside a law of the user's; '' where it has."""
    of_drive = not effect.moves_command and effect.remembers_command
    term = 'gain' if of_drive else {'response': 'lag'}.get(effect.term, effect.term)
    gone = [BASE[i].name for i in problem.zero_terms]
    return (f"it acts on the {term}, which the base of one's own replaces; keep=({term!r},) fits "
            'it beside the law') if term in gone and term != 'damping' else ''
