"""Maximum a posteriori by Gauss-Newton on the innovations, its evidence and standard errors.

The innovations follow Student's t distribution, whose scale and degrees of freedom are fitted too,
so that bursts of noise do not dominate. Least squares by QR, evidence by Laplace's approximation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from quad_sysid.contract import FloatArray
from quad_sysid.model.data import (
    AxisData,
    Span,
    high,
    shifted_spans,
    slice_of,
    typical_acceleration,
)
from quad_sysid.model.effect import Part, required
from quad_sysid.model.flight import Flight, Prediction, passes_of
from quad_sysid.model.structure import BASE, Structure
from quad_sysid.qr import upper
from quad_sysid.record import INDEPENDENT_S, finite_runs

UNHARMFUL_S, BEHIND_GAP_S = 0.02, 0.1
"""A gap longer than the first makes the innovations larger, for the second's time behind it."""
SETTLE_S = 0.5
"""Innovations count from this long after the start of an unbroken stretch."""
DEGREES = (3.0, 4.0, 6.0, 10.0, 20.0, 50.0, 1e4)
"""Degrees of freedom of the innovations that are tried; the last is a normal distribution."""
FINEST = 1.5e-4
"""The least scale of the innovations over the RMS of the rate: no gyro resolves its own motion
better, nor a model within a cycle. Without it a rate that carries no noise asks for disturbances
of any size, in which a constant torque is lost."""
DAMPING = 5.0
"""Prior of the base's damping, 1/s."""
LAG_DAMPING, LAG_DAMPING_SPREAD = 0.035, 0.9
"""Prior of lag times damping, the motors' time constant over the body's: its logarithm is normal
about this. Lags of 15 to 80 ms and bodies that lose their rate in 0.2 to 5 s are four spreads."""
BASE_STD = 30.0
"""Prior of the base's gain and bias, relative to the typical acceleration. It is so wide
that it does not draw an estimate; as all structures have it, comparisons hardly depend on it."""
NULL_BASE, FIXED_STD = (0.0, math.log(1e-5), math.log(1e-6), 0.0, 0.0), 1e-6
"""Coordinates of a base whose terms are nothing, and how far one that is held may be off."""
TURN = 0.1
"""The most by which a step of a derivative turns the phase of what repeats itself, rad."""
SMALL_NATS = 0.02
"""Gain of evidence, nats, below which a fit has converged: no verdict depends on so little."""
LONGEST_STEP = 1.5
"""The longest step of a logarithm: no step leads back from a delay of minutes."""
LARGEST_GROWTH = 10.0
"""Largest rate of a free run over the largest measured one."""
BOUNDED_S = 1.0
"""Length of the runs that have to stay within it."""
MOST_STEPS = 40
"""A fit that needs more has not converged."""


@dataclass(frozen=True)
class Tail:
    """The distribution of the innovations, Student's t: scale in rad/s, degrees of freedom."""

    scale: float
    degrees: float

    def log_density(self, e: FloatArray) -> FloatArray:
        """(n,) logarithm of the density of innovations e, nats."""
        v = self.degrees
        constant = gammaln(0.5 * (v + 1.0)) - gammaln(0.5 * v) - 0.5 * math.log(math.pi * v)
        shape = 0.5 * (v + 1.0) * np.log1p((e / self.scale) ** 2 / v)
        return constant - math.log(self.scale) - shape

    def weights(self, e: FloatArray) -> FloatArray:
        """(n,) weights of the equivalent least squares; 1 for a normal distribution."""
        return (self.degrees + 1.0) / (self.degrees + (e / self.scale) ** 2)

    @property
    def variance(self) -> float:
        """Variance of the innovations, (rad/s)²; three times scale² where it is infinite."""
        v = self.degrees
        return self.scale**2 * (v / (v - 2.0) if v > 2.0 else 3.0)

    @property
    def information(self) -> float:
        """Fisher information of the location, times scale²."""
        return (self.degrees + 1.0) / (self.degrees + 3.0)


def tail_of(e: FloatArray, least: float) -> Tail:
    """The most likely scale, `least` (rad/s) or more, and degrees of freedom."""
    least = max(least, 1e-12)
    best, value, square, weights = Tail(1.0, DEGREES[-1]), -math.inf, e**2, np.empty(e.size)
    scale = max(math.sqrt(float(np.mean(square))), least)
    for v in DEGREES[::-1]:
        for _ in range(60):
            # parameter-expanded EM (Liu et al. 1998)
            np.divide(1.0, np.add(square, v * scale**2, out=weights), out=weights)
            new = math.sqrt(float(weights @ square) / float(weights.sum()))
            previous, scale = scale, max(new, least)
            if abs(new - previous) < 1e-7 * previous:
                break
        tail = Tail(scale, v)
        total = float(np.sum(tail.log_density(e)))
        if total > value:
            best, value = tail, total
        elif total < value - 1.0:
            break
    return best


def _behind_gaps(data: AxisData) -> NDArray[np.bool_]:
    """(n,) samples whose innovations are larger than the steady filter's variance says.

    After lost samples the filter has to find the state again; with the usual weight what follows
    would make the standard errors too small.
    """
    out = np.zeros(data.rate.size, bool)
    for start, stop in () if data.lost is None else finite_runs(data.lost, (0, out.size)):
        if (stop - start) * data.dt > UNHARMFUL_S:
            out[stop : stop + round(BEHIND_GAP_S / data.dt)] = True
    return out


class Problem:
    """The data of a fit: spans of an axis' flight, each with its lead; the rest is left out.

    `data` and `spans` describe the part that is kept, or, if `whole`, the whole flight.
    """

    acceleration: float
    """Typical acceleration of the axis, rad/s², to which priors are relative."""
    finest: float
    """The least scale of the innovations, rad/s."""
    rows: NDArray[np.int64]
    """(rows,) samples whose innovations count."""
    index: NDArray[np.int64]
    """(n,) where the samples that were kept stood before."""
    short_problem: Problem | None = None
    """A short part of it, on which a search tries first what it has many of."""

    def __init__(self, data: AxisData, spans: Sequence[Span], *, whole: bool = False,
                 law: Part | None = None, zero_terms: Sequence[int] = ()) -> None:
        """law: of the user's, in the base; zero_terms: those of BASE that are zero beside it."""
        self.plain, self.zero_terms = Structure(law=law), list(zero_terms)
        self.data, self.spans = data, tuple(spans)
        self.index = np.arange(data.rate.size)
        if not whole:
            passes = passes_of(data, spans)
            self.index = np.concatenate([np.arange(a, b) for a, b in passes])
            self.data, self.spans = slice_of(data, passes), shifted_spans(sorted(spans), passes)
        self.flight = Flight(self.data, self.spans)
        self._sizes: dict[str, FloatArray] = {}
        counts, settle = np.zeros(self.data.rate.size, bool), round(SETTLE_S / self.data.dt)
        for start, stop in self.spans:
            counts[start:stop] = True
        for start, _ in self.flight.passes:
            counts[start : start + settle] = False
        counts &= np.isfinite(self.flight.measured) & ~self.flight.follows_gyro
        intact = counts & ~_behind_gaps(self.data)
        # of a log with gaps throughout all samples count
        self.rows = np.flatnonzero(intact if 2 * intact.sum() >= counts.sum() else counts)
        self.acceleration = typical_acceleration(self.data, self.spans)
        rates = self.flight.rate[self.rows]
        self.finest = FINEST * float(np.std(rates)) if rates.size else 0.0

    def shortened(self, rows: int, blocks: int) -> Problem:
        """The problem on so many rows only, in blocks spread evenly over the spans."""
        if self.rows.size <= rows:
            return self
        index = np.concatenate([np.arange(a, b) for a, b in self.spans])
        length = rows // blocks
        firsts = np.linspace(0, index.size - length, blocks).astype(int)
        used = np.zeros(self.data.rate.size, bool)
        for first in firsts:
            used[index[first : first + length]] = True
        spans = tuple(run for span in self.spans for run in finite_runs(used, span))
        return Problem(replace(self.data, train=spans), spans, law=self.plain.law,
                       zero_terms=self.zero_terms)

    def blocks(self, length_s: float) -> NDArray[np.int64]:
        """(rows,) number of the block of each row: of one pass, of this length in time."""
        length, rows = max(2, round(length_s / self.data.dt)), self.rows
        number = np.searchsorted([a for a, _ in self.flight.passes], rows, side='right')
        first = rows[np.searchsorted(number, number)]
        return np.unique(number * 10**9 + (rows - first) // length, return_inverse=True)[1]

    def measure(self, fitted: Fit) -> None:
        """Take the sizes of all later priors and of the innovations from this fit."""
        self.flight.variance, self._sizes = fitted.tail.variance, {}
        self._reference = self.flight.signals(fitted.structure, fitted.values, fitted.rate)

    def sizes_of(self, part: Part) -> FloatArray:
        """(q,) prior standard deviation of an effect's parameters, in coordinates of the fit."""
        effect = part.effect
        if effect.label not in self._sizes:
            sizes = np.array([spec.spread for spec in effect.parameters], dtype=float)
            free = np.flatnonzero(np.isnan(sizes))
            if free.size:
                s = self.flight.hidden(part, self._reference, effect.centre())
                # the values of a curve are of one size
                units = [effect.size(s, j, part.settings)[self.rows]
                         for j in (free[:1] if effect.kind == 'shape' else free)]
                sizes[free] = [0.5 * self.acceleration / high(unit) for unit in units]
            self._sizes[effect.label] = sizes
        return self._sizes[effect.label]

    def sizes(self, structure: Structure) -> FloatArray:
        """(p,) prior standard deviation of each parameter, in the coordinates of the fit."""
        rows, wide = self.rows, BASE_STD * self.acceleration
        base = [
            wide / high(self.data.command[rows]),
            BASE[1].spread if self.data.rotor_lag is None else self.data.rotor_lag.spread,
            BASE[2].spread, DAMPING, wide,
        ]
        effect_sizes = [size for part, _ in structure.placed for size in self.sizes_of(part)]
        out = np.array([*base, *effect_sizes, *(s.spread for s in structure.noise)], dtype=float)
        out[self.zero_terms] = FIXED_STD
        return out

    def steps(self, structure: Structure, theta: FloatArray) -> FloatArray:
        """(p,) steps of numerical derivatives at theta (p,).

        What repeats itself is moved by no more than TURN at the flight's end.
        """
        out, p = derivative_steps(self.sizes(structure)), structure.natural(theta)
        last = float(self.data.clock[-1])
        for part, where in structure.placed:
            phase = 2.0 * math.pi * part.effect.repeats_hz(p[where]) * last
            if phase > 0.0:  # by a frequency, whose coordinate is its logarithm
                out[where.start] = min(out[where.start], TURN / phase)
        return out

    def centres(self, structure: Structure) -> FloatArray:
        """(p,) prior mean of each parameter, in the coordinates of the fit."""
        out = np.array([s.centre for s in structure.specs])
        if self.data.rotor_lag is not None:
            out[1] = math.log(self.data.rotor_lag.seconds)
        out[self.zero_terms] = np.array(NULL_BASE)[self.zero_terms]
        return out

    def precision(self, structure: Structure, sizes: FloatArray) -> FloatArray:
        """(p, p) prior precision."""
        out = np.diag(sizes**-2.0)
        for part, where in structure.placed:
            out[where, where] = part.effect.precision(part.settings, sizes[where])
        return out


@dataclass(frozen=True, eq=False)
class Fit:
    """A fitted structure."""

    structure: Structure
    theta: FloatArray
    """(p,) in the coordinates of the fit."""
    tail: Tail
    log_posterior: float
    evidence: float
    """log p(data | structure) by Laplace's approximation, nats."""
    hessian: FloatArray
    precision: FloatArray
    converged: bool
    prediction: Prediction

    @property
    def rate(self) -> FloatArray:
        """(n,) the trajectory with which the fit ended, rad/s."""
        return self.prediction.rate

    @property
    def values(self) -> FloatArray:
        """(p,) in their units."""
        return self.structure.natural(self.theta)

    def value(self, name: str) -> float:
        """One parameter by its name."""
        return float(self.values[self.structure.names.index(name)])


def derivative_steps(sizes: FloatArray) -> FloatArray:
    """(p,) steps of numerical derivatives by parameters of these prior sizes."""
    return np.where(sizes > 1.0, 1e-4 * sizes, np.where(sizes < 1e-2, 1e-3 * sizes, 1e-4))


def start_of(problem: Problem) -> FloatArray:
    """(p,) start values of the base from the priors alone."""
    theta = problem.centres(problem.plain)
    command = problem.data.command[problem.rows]
    if 0 not in problem.zero_terms:
        theta[0] = problem.acceleration / max(float(np.std(command)), 1e-9)
    return theta


def fit(  # noqa: C901, PLR0915 - one loop, whose steps share all they have
    problem: Problem, structure: Structure, *starts: FloatArray, max_steps: int = MOST_STEPS,
    rate: FloatArray | None = None, fixed: tuple[int, ...] = (),
    tolerance_nats: float = SMALL_NATS,
) -> Fit:
    """The most probable parameters from the best of `starts` (coordinates of the fit).

    By Gauss-Newton, until a step gains no more than `tolerance_nats`; parameters in `fixed` stay
    where they start. Raises FloatingPointError where the fit diverges.
    """
    flight = problem.flight
    initial = flight.rate if rate is None else rate
    sizes = problem.sizes(structure)
    precision = problem.precision(structure, sizes)
    root = np.linalg.cholesky(precision).T
    centres = problem.centres(structure)
    positive = np.array([s.positive and not s.log for s in structure.specs])
    logs = structure.logs

    def evaluated(
        point: FloatArray, initial: FloatArray, sweeps: int, *, by: FloatArray | None = None
    ) -> tuple[Prediction | None, float, Tail]:
        """Prediction, log posterior and tail; minus infinity where the noise has no filter."""
        flight.rate, normal = initial, Tail(1.0, 1e4)
        try:
            predicted = flight.predict(structure, point, sweeps=sweeps, steps=by)
        except np.linalg.LinAlgError:
            return None, -math.inf, normal
        e = predicted.innovation[problem.rows]
        if not np.isfinite(e).all():
            return predicted, -math.inf, normal
        tail, from_prior = tail_of(e, problem.finest), root @ (point - centres)
        likelihood = float(np.sum(tail.log_density(e)))
        return predicted, likelihood - 0.5 * float(from_prior @ from_prior), tail

    theta = starts[0].astype(float)
    if len(starts) > 1:
        theta = max(starts, key=lambda start: evaluated(start, initial, 1)[1]).astype(float)
    steps = problem.steps(structure, theta)
    predicted, value, tail = evaluated(theta, initial, 3, by=steps)
    if predicted is None or not math.isfinite(value):
        raise FloatingPointError('the start runs away')
    damping, converged = 1e-3, False
    for _ in range(max_steps):
        e = predicted.innovation[problem.rows]
        j = required(predicted.jacobian).take(problem.rows, axis=0)
        j[:, list(fixed)] = 0.0
        w = np.sqrt(tail.weights(e)) / tail.scale
        from_prior = root @ (theta - centres)
        rows, column = j * w[:, None], e * w
        # a part that vanishes acts by its square: over its logarithm that curves by twice the
        # slope, of which the rows may see little
        curves = 2.0 * (column @ rows) - np.einsum('ij->j', rows**2)
        curvature = np.where(logs, np.sqrt(np.maximum(curves, 0.0)), 0.0)
        blocks = (rows, column), (root, from_prior), (np.diag(curvature), np.zeros(curvature.size))
        factor = upper(np.vstack([np.column_stack(pair) for pair in blocks]))[: theta.size]
        if not np.isfinite(factor).all():
            raise FloatingPointError('its derivatives run away')
        a, b = factor[:, :-1], factor[:, -1]
        moving = np.delete(b, list(fixed)) if fixed else b
        converged = 0.5 * float(moving @ moving) < SMALL_NATS
        if 0.5 * float(moving @ moving) < tolerance_nats:
            break
        scale = np.sqrt(np.sum(a**2, axis=0))
        for _ in range(12):
            damped = np.vstack([a, math.sqrt(damping) * np.diag(scale)])
            step = -np.linalg.lstsq(damped, np.r_[b, np.zeros(theta.size)], rcond=None)[0]
            step[list(fixed)] = 0.0
            trial = theta + limited(step, logs)
            trial = np.where(positive, np.maximum(trial, 0.0), trial)
            improved, new, improved_tail = evaluated(trial, predicted.rate, 2, by=steps)
            if new > value - 1e-9:
                break
            damping = max(damping * 8.0, 1e-4)
        else:
            break
        gained = new - value
        converged = gained < SMALL_NATS
        predicted, theta, value, tail = required(improved), trial, new, improved_tail
        if gained < tolerance_nats:
            break
        damping *= 0.15
    flight.rate = predicted.rate
    value += slowness(*structure.natural(theta)[[1, 3]])
    j = required(predicted.jacobian).take(problem.rows, axis=0)
    j *= math.sqrt(tail.information) / tail.scale
    r = upper(np.vstack([j, root]))
    evidence = (
        value + float(np.sum(np.log(np.diag(root)))) - float(np.sum(np.log(np.abs(np.diag(r)))))
        + math.log(2.0) * int(positive.sum())
    )
    return Fit(structure, theta, tail, value, evidence, r.T @ r, precision, converged, predicted)


def slowness(lag: float, damping: float) -> float:
    """Log prior of motors that are so slow beside the body, relative to that of usual ones.

    Lag and damping are two poles that could change places. Near one maximum the prior is flat
    beside the likelihood; between both it decides.
    """
    slow = max(lag * damping / LAG_DAMPING, 1.0)
    return -0.5 * (math.log(slow) / LAG_DAMPING_SPREAD) ** 2


def limited(step: NDArray[np.floating[Any]], logs: NDArray[np.bool_]) -> FloatArray:
    """A step (p,) of which no logarithm moves further than LONGEST_STEP; logs (p,): which are."""
    out: FloatArray = np.where(logs, np.clip(step, -LONGEST_STEP, LONGEST_STEP), step)
    return out


def stays_bounded(problem: Problem, fitted: Fit, prediction: Prediction) -> bool:
    """Whether its free runs stay near what was flown, also begun at twice the rate or against it.

    Within LARGEST_GROWTH times the largest measured rate: what runs away from there explains
    nothing, and would not hold on a livelier flight. prediction: of the fit along this flight.
    """
    data, flight = problem.data, problem.flight
    long = data.windows(problem.spans, BOUNDED_S)
    windows = long if long.count else data.windows(problem.spans)
    if not windows.count:
        return True
    largest = float(np.nanmax(np.abs(data.rate)))
    measured = data.rate[windows.cells]
    for offset in (-largest, 0.0, largest):
        states = prediction.states.copy()
        states[:, 0] += offset
        with np.errstate(all='ignore'):
            errors = flight.run(fitted.structure, fitted.theta, windows,
                                prediction=replace(prediction, states=states)).errors
            if not np.nanmax(np.nan_to_num(np.abs(errors + measured), nan=np.inf)
                             [np.isfinite(measured)], initial=0.0) <= LARGEST_GROWTH * largest:
                return False
    return True


def covariance(problem: Problem, fitted: Fit) -> FloatArray:
    """(p, p) of the coordinates of the fit, robust to innovations that are not white.

    The sandwich with scores summed over blocks (White 1982). No variance is below the model's own,
    as it might be by chance where blocks are few.
    """
    e = fitted.prediction.innovation[problem.rows]
    j = required(fitted.prediction.jacobian)[problem.rows]
    tail = fitted.tail
    score = j * (tail.weights(e) * e / tail.scale**2)[:, None]
    blocks = problem.blocks(INDEPENDENT_S)
    sums = np.add.reduceat(score, np.flatnonzero(np.diff(blocks, prepend=-1)))
    meat = sums.T @ sums + fitted.precision
    half = np.linalg.inv(fitted.hessian)
    sandwich = half @ meat @ half
    wider = np.sqrt(np.maximum(np.diag(half) / np.diag(sandwich), 1.0))
    return sandwich * np.outer(wider, wider)


def shift_by_form(problem: Problem, fitted: Fit) -> FloatArray:
    """(p,) change of the coordinates under another form of the same gyro filter.

    The cut-off of the gyro's filter is known, but not how it is computed. One Gauss-Newton step
    from the fit to the stepped filter (noise.sensor_of); zeros where no filter is known.
    """
    flight = problem.flight
    if not flight.sensor.noisy:
        return np.zeros(fitted.theta.size)
    rate, exact = flight.rate, flight.sensors
    flight.sensors = flight.gyro_sensors(stepped=True)
    coarse = flight.predict(fitted.structure, fitted.theta)
    flight.rate, flight.sensors = rate, exact
    e = fitted.prediction.innovation[problem.rows]
    j = required(fitted.prediction.jacobian)[problem.rows]
    change = (coarse.innovation[problem.rows] - e) * fitted.tail.weights(e) / fitted.tail.scale**2
    return -np.linalg.solve(fitted.hessian, j.T @ change)
