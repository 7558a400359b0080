"""New gains for the cascade of one axis: C1 P and C2 PID.

The objective is the tracking error of a square wave, with small shares of the deviation under a
torque step and of the noise at the motors, each relative to the flown gains; the margins of all
loops of the ensemble are constraints. A grid over all gains is judged at once on the binding loops
(linear tracking by Parseval's theorem, margins), its best points by the whole objective. SLSQP
continues from those that lie apart; violated loops are added as constraints until all hold
(cutting planes). Deterministic. assess.py has the figures.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize

from quad_sysid.beside import side_by_side
from quad_sysid.contract import FloatArray
from quad_sysid.loop.cascade import (
    TUNED,
    WORDS,
    CascadeGains,
    constants_of,
    contract_names,
    margins,
    responses,
    weight_of,
)
from quad_sysid.loop.linear import ComplexArray
from quad_sysid.loop.plant import Flying
from quad_tuning.assess import (
    LoopFigures,
    Requirements,
    assess,
    disturbance,
    meets,
    noise_gain,
    reference_square,
    tracking,
)
from quad_tuning.bounds import BOUNDS, CONSTANT, DESIGNED, check_finite
from quad_tuning.ensemble import Ensemble
from quad_tuning.errors import DesignRefusedError
from quad_tuning.gain_table import Bound

REACH = 16.0
"""Largest factor between flown and new gain; the bounds apply too."""
POWERS = {'rate_ki': 3.0, 'rate_kd': 2.0}
"""Power of the cube's coordinate for gains that may be 0; the others are logarithmic."""
DISTURBANCE_SHARE, NOISE_SHARE = 0.05, 0.005
"""Shares of the objective beside the tracking, each figure relative to the flown gains."""
NOMINAL = 4
"""Number of nominal requirements: overshoot, noise, crossover, disturbance."""
GRID = (9, 14, 3, 7, 3)
"""Points along angle kp, rate kp, ki, kd and the filter of D."""
KI_SHARES, KD_SHARES = (0.15, 0.6), (0.08, 0.8)
"""Range in the cube; not from 0, where the powers are flat and a search would stay."""
FILTER_HZ = (30.0, 55.0, 100.0)
SHORTLIST = 120
"""Number of grid points that are judged by the whole objective."""
STARTS = 5
"""Searches from the best grid points that are at least MIN_DISTANCE apart in SHAPE (angle kp, rate
kp, kd): a resonance can cause local optima."""
MIN_DISTANCE = 0.11
SHAPE = [0, 1, 3]
DIFFERENCE = 5e-4
STALLED = 2e-5
"""Way in the cube over two iterations of a search that stands before a kink, as it would until its
iterations are used up; a single step as short may be followed by longer ones."""
WORST = 6
"""Loops added per requirement and round."""
ROUNDS = 6
INFEASIBLE = 0.005
"""Relative violation after a search from which no further round is tried."""
OUTSIDE = 1.0 + 1e-6
"""Absolute value of a plant's pole from which it is unstable; integrals are at 1."""
CHUNK = 256  # sets of gains whose margins are computed at once, which bounds the memory


@dataclass(frozen=True)
class Problem:
    """The constants of one search: plant, ensembles and requirements."""

    plant: Flying
    active: CascadeGains
    ensemble: Ensemble
    nominal: Ensemble
    needs: Requirements
    reference: FloatArray
    scale: tuple[float, float, float]
    low: FloatArray
    high: FloatArray

    def values(self, points: FloatArray) -> FloatArray:
        """(g, 5) what is designed, at points (g, 5) of the unit cube."""
        values = []
        for field, share, low, high in zip(DESIGNED, np.clip(points, 0.0, 1.0).T, self.low,
                                           self.high, strict=True):
            power = POWERS.get(field)
            values.append(low * (high / low) ** share if power is None
                          else low + share**power * (high - low))
        return np.stack(values, axis=1)

    def gains(self, points: FloatArray) -> list[CascadeGains]:
        """Gains at points (g, 5) of the unit cube."""
        return [replace(self.active, **dict(zip(DESIGNED, row, strict=True)))
                for row in self.values(points).tolist()]

    def constants(self, points: FloatArray) -> npt.NDArray[np.void]:
        """(g,) those of the controllers there."""
        values, dt = self.values(points), self.plant.dt
        each = np.repeat(constants_of([self.active], dt), len(points))
        for field, column in zip(TUNED, values.T, strict=False):
            each[field] = column
        each['d_weight'] = [weight_of(hz, dt) for hz in values[:, len(TUNED)].tolist()]
        return each

    def judged(self, loops: Ensemble, points: FloatArray) -> FloatArray:
        """(g, 1 + 4 + 3 p) at points (g, 5): objective, nominal constraints, the loops' reserve.

        Constraints are satisfied where >= 0.
        """
        sets, needs = self.gains(points), self.needs
        rms, beyond = tracking(self.plant, sets, self.reference)
        push = disturbance(self.plant, sets) / self.scale[1]
        noise = np.array([noise_gain(one, self.nominal) for one in sets]) / self.scale[2]
        value = rms / self.scale[0] + DISTURBANCE_SHARE * push + NOISE_SHARE * noise
        slower = np.ones(len(sets))
        if np.isfinite(needs.highest_crossover_rad_s):
            crossover = np.array([self.nominal.margins(one).crossover_rad_s[0] for one in sets])
            slower = np.nan_to_num(1.0 - crossover / needs.highest_crossover_rad_s, nan=1.0)
        slack = [(needs.overshoot_pct - beyond) / 100.0, 1.0 - noise / needs.noise_factor, slower,
                 1.0 - push / needs.disturbance_factor]
        out = np.column_stack([value, *np.clip(slack, -1.0, 1.0),
                               [self.reserve(loops, one) for one in sets]])
        out[~np.isfinite(value), : 1 + NOMINAL] = 1e3, *NOMINAL * [-1.0]
        return out

    def reserve(self, loops: Ensemble, gains: CascadeGains) -> FloatArray:
        """(3 p,) relative margin of every loop to each requirement, satisfied where >= 0.

        It has a slope everywhere up to instability, so that a search can start anywhere.
        """
        m, needs = loops.margins(gains), self.needs
        return np.concatenate(
            [np.clip(m.phase_margin_deg / needs.phase_margin_deg - 1.0, -1.0, 1.0),
             np.clip(m.gain_margin_db / needs.gain_margin_db - 1.0, -1.0, 1.0),
             np.clip(needs.peak_sensitivity / m.peak_sensitivity - 1.0, -1.0, 1.0)]
        )

    def holds(self, gains: CascadeGains) -> bool:
        """Whether every loop of the ensemble keeps its margins and is stable."""
        within = meets(self.ensemble.margins(gains), self.needs).all()
        return bool(within and not self.ensemble.unstable(gains).any())


def pose(plant: Flying, active: CascadeGains, ensemble: Ensemble, needs: Requirements,
         fixed: Collection[str] = (), bounds: Mapping[str, Bound] = BOUNDS) -> Problem:
    """The problem of one axis; raises DesignRefusedError where the flown loop diverges.

    `fixed` are fields of CascadeGains that do not change.
    """
    check_finite({f'flown.{WORDS[f]}': getattr(active, f) for f in DESIGNED})
    low, high = [], []
    for field in DESIGNED:
        name = contract_names(ensemble.axis)[field]
        bound, value = bounds.get(name, CONSTANT), getattr(active, field)
        if field in fixed:
            low.append(value)
            high.append(value)
            continue
        free = field in POWERS
        low.append(min(value, bound.lower if free else max(bound.lower, value / REACH)))
        high.append(max(value, bound.upper if free else min(bound.upper, value * REACH)))
    reference = reference_square(plant)
    nominal = ensemble.subset(np.flatnonzero(ensemble.nominal)[:1])
    scale = (float(tracking(plant, [active], reference)[0][0]),
             float(disturbance(plant, active)), noise_gain(active, nominal))
    if not np.isfinite(scale).all():
        raise DesignRefusedError('the simulated loop diverges with these gains; identify again')
    return Problem(plant, active, ensemble, nominal, needs, reference, scale,
                   np.array(low), np.array(high))


def search(problem: Problem) -> list[tuple[float, FloatArray]]:
    """Objective and point of each search that satisfied all requirements, best first.

    Empty where nothing in the box is feasible.
    """
    grid = _grid(problem)
    loops = problem.ensemble.subset(_binding(problem))
    best = grid[_ranked(problem, loops, grid)[:SHORTLIST]]
    best = best[np.argsort(_merits(problem, loops, best), kind='stable')]
    starts = _distinct(best)
    ends = side_by_side([partial(_polish, problem, start) for start in starts[:2]])
    if any(end is not None for end in ends):  # else two searches from afar satisfied none
        ends += side_by_side([partial(_polish, problem, start) for start in starts[2:]])
    ends = [end for end in ends if end is not None]
    return sorted(ends, key=lambda item: item[0])


def _grid(problem: Problem) -> FloatArray:
    """(g, 5) points of the unit cube; one value of the filter where it is fixed."""
    axes = [(np.arange(n) + 0.5) / n for n in GRID]
    axes[2] = np.linspace(*KI_SHARES, GRID[2])
    axes[3] = np.linspace(*KD_SHARES, GRID[3])
    low, high = problem.low[-1], problem.high[-1]
    axes[4] = np.zeros(1) if low == high else np.unique(
        np.clip(np.log(np.array(FILTER_HZ) / low) / np.log(high / low), 0.0, 1.0))
    return np.stack(np.meshgrid(*axes, indexing='ij'), axis=-1).reshape(-1, len(DESIGNED))


def _binding(problem: Problem) -> npt.NDArray[np.int64]:
    """Worst loops at the flown gains, and at half and twice their rate gains."""
    worst = [np.flatnonzero(problem.ensemble.nominal)[:1]]
    for factor in (0.5, 1.0, 2.0):
        gains = replace(problem.active, rate_kp=factor * problem.active.rate_kp,
                        rate_kd=factor * problem.active.rate_kd)
        worst.append(_worst(problem, gains, 1))
    return np.unique(np.concatenate(worst)).astype(np.int64)


def _ranked(problem: Problem, loops: Ensemble, grid: FloatArray) -> npt.NDArray[np.int64]:
    """Indices of the grid, best first, by linear tracking with a penalty on margins."""
    thin = replace(loops, omega=loops.omega[::2], response=loops.response[..., ::2])
    dt = problem.plant.dt
    half = problem.plant.trial.half_period_s
    harmonics: FloatArray = np.pi / half * np.arange(1.0, 240.0, 2.0)
    harmonics = harmonics[harmonics < 0.9 * np.pi / dt]
    nominal = problem.nominal.cycle.response(harmonics)
    rows = problem.constants(grid)
    merits = []
    for start in range(0, len(rows), CHUNK):
        part = rows[start : start + CHUNK]
        short = _margin_reserve(problem, part, thin)
        merits.append(_linear_tracking(part, nominal, harmonics, half) - 3.0 * short)
    return np.argsort(np.concatenate(merits), kind='stable')


def _loops_of(rows: npt.NDArray[np.void], response: ComplexArray,
              omega: FloatArray) -> tuple[ComplexArray, ComplexArray]:
    """Loop gain (g, p, f) and forward path of the angle reference (g, p, f)."""
    rate, angle = responses(rows, omega)
    forward = -angle[:, None] * response[1]
    return np.asarray(forward - rate[:, None] * response[0]), forward


def _margin_reserve(problem: Problem, rows: npt.NDArray[np.void],
                    loops: Ensemble) -> FloatArray:
    """(g,) smallest relative margin over the loops, 0 where all are satisfied."""
    loop, _ = _loops_of(rows, loops.response, loops.omega)
    g, p, f = loop.shape
    m, needs = margins(loop.reshape(g * p, f), loops.omega), problem.needs
    reserve = np.minimum(
        np.minimum(m.phase_margin_deg / needs.phase_margin_deg,
                   m.gain_margin_db / needs.gain_margin_db) - 1.0,
        1.0 - m.peak_sensitivity / needs.peak_sensitivity,
    )
    poles = np.abs(np.linalg.eigvals(loops.cycle.a))
    turns = _turns(loop.reshape(g * p, f), np.tile(np.sum(poles > OUTSIDE, axis=1), g))
    reserve = np.where(turns == 0, np.clip(reserve, -2.0, 0.0), -2.0)
    return np.asarray(np.min(reserve.reshape(g, p), axis=1))


def _turns(loop: ComplexArray, outside: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """(p,) turns of 1 + loop gain (p, f) about 0: not 0 where the closed loop is unstable.

    Nyquist's criterion for plants with `outside` (p,) unstable poles, each of which turns the
    phase by -180 degrees; without any it lies in -270..90 degrees at the lowest frequency.
    """
    phase = np.angle(1.0 + loop)
    change = np.diff(phase)
    total = np.sum(change - 2.0 * np.pi * np.rint(change / (2.0 * np.pi)), axis=1)
    least = -np.pi * (1.5 + outside)
    start = np.mod(phase[:, 0] - least, 2.0 * np.pi) + least
    return np.asarray(np.rint((start + total) / (2.0 * np.pi)), dtype=np.int64)


def _linear_tracking(rows: npt.NDArray[np.void], nominal: ComplexArray, harmonics: FloatArray,
                     half_period_s: float) -> FloatArray:
    """(g,) RMS error of a square wave of amplitude 1 without limits, by Parseval."""
    loop, forward = _loops_of(rows, nominal, harmonics)
    error = np.abs(1.0 - (forward / (1.0 + loop))[:, 0]) ** 2
    k = harmonics * half_period_s / np.pi
    total = np.sum(error * 0.5 * (4.0 / (np.pi * k)) ** 2, axis=1)
    return np.asarray(np.sqrt(total))


def _merits(problem: Problem, loops: Ensemble, points: FloatArray) -> FloatArray:
    figures = problem.judged(loops, points)
    unstable = [loops.unstable(one).any() for one in problem.gains(points)]
    short = np.minimum(np.min(figures[:, 1:], axis=1), np.where(unstable, -1.0, 0.0))
    return np.asarray(figures[:, 0] - 20.0 * short)


def _distinct(points: FloatArray) -> list[FloatArray]:
    chosen: list[FloatArray] = []
    for point in points:
        if all(np.linalg.norm((point - other)[SHAPE]) >= MIN_DISTANCE for other in chosen):
            chosen.append(point)
        if len(chosen) == STARTS:
            break
    return chosen


def _polish(problem: Problem, start: FloatArray) -> tuple[float, FloatArray] | None:
    """Objective and point of the best gains from this start; None if infeasible."""
    chosen = np.zeros(0, dtype=np.int64)
    x = start
    for _ in range(ROUNDS):
        (gains,) = problem.gains(x[None])
        wider = np.union1d(chosen, _worst(problem, gains, WORST))
        if wider.size == chosen.size:
            return None  # the loops that fall short were all taken up already
        chosen = wider
        loops = problem.ensemble.subset(chosen)
        # a little is kept back, so that the optimiser's tolerance does not break a margin
        slack = np.repeat([0.0, 1e-3, 2e-3], [1, NOMINAL, 3 * chosen.size])
        x = _slsqp(partial(problem.judged, loops), x, slack)
        value, *reserves = problem.judged(loops, x[None])[0]
        if min(reserves) < -INFEASIBLE:
            return None  # what a part of the loops forbids, all of them forbid
        if min(reserves[:NOMINAL]) < -1e-3:
            continue
        if problem.holds(*problem.gains(x[None])):
            return value, x
    return None


class _StalledError(Exception):
    """A search stands still."""


def _slsqp(judged: Callable[[FloatArray], FloatArray], start: FloatArray,
           slack: FloatArray) -> FloatArray:
    """Minimise judged[:, 0] subject to judged >= slack, of points (g, 5) of the unit cube."""
    path: list[FloatArray] = []

    def within(x: FloatArray) -> bytes:
        return bytes(np.clip(x, 0.0, 1.0))

    @cache
    def at(key: bytes) -> FloatArray:
        return np.asarray(judged(np.frombuffer(key)[None])[0] - slack)

    @cache
    def slopes(key: bytes) -> FloatArray:
        x = np.frombuffer(key)
        if len(path) > 1 and np.max(np.abs(x - path[-2])) < STALLED:
            raise _StalledError
        path.append(x)
        steps = np.where(x < 0.5, DIFFERENCE, -DIFFERENCE)
        # in one piece, since the compiled search reads a row as it lies
        return np.ascontiguousarray((judged(x + np.diag(steps)) - slack - at(key)).T / steps)

    try:
        x = minimize(
            lambda x: at(within(x))[0], start, jac=lambda x: slopes(within(x))[0],
            bounds=[(0.0, 1.0)] * start.size, method='SLSQP',
            options={'maxiter': 40, 'ftol': 1e-4},
            constraints={'type': 'ineq', 'fun': lambda x: at(within(x))[1:],
                         'jac': lambda x: slopes(within(x))[1:]},
        ).x
    except _StalledError:
        x = path[-1]
    return np.asarray(np.clip(x, 0.0, 1.0))


def _worst(problem: Problem, gains: CascadeGains, count: int) -> npt.NDArray[np.int64]:
    """The worst loops for each requirement with these gains."""
    reserve = problem.reserve(problem.ensemble, gains).reshape(3, -1)
    return np.unique(np.argsort(reserve, axis=1, kind='stable')[:, :count]).astype(np.int64)


AGREED = 0.01
RELAXED_DISTURBANCE = 1.5
"""Factor of lost torque rejection that is allowed if there is no design without it."""


@dataclass(frozen=True)
class PidDesign:
    """New gains, their figures and the flown ones', and how certain the optimum is."""

    gains: CascadeGains
    figures: LoopFigures
    before: LoopFigures
    agreeing: int
    """Searches that ended within AGREED of the best objective."""
    searches: int
    """Searches that satisfied all requirements."""
    disturbance_kept: bool
    """Whether torque is rejected no worse than with the flown gains."""


def retune(plant: Flying, active: CascadeGains, ensemble: Ensemble,
           needs: Requirements | None = None,
           fixed: Collection[str] = (), bounds: Mapping[str, Bound] = BOUNDS) -> PidDesign:
    """The best gains within the bounds that satisfy every loop of the ensemble.

    `fixed` are fields of CascadeGains that do not change. Deterministic. Raises DesignRefusedError
    where no gains in the box meet the requirements.
    """
    needs = needs or Requirements()
    problem = pose(plant, active, ensemble, needs, fixed, bounds)
    points, rejects_disturbance = search(problem), True
    if not points:
        rejects_disturbance = False
        factor = RELAXED_DISTURBANCE * needs.disturbance_factor
        problem = replace(problem, needs=replace(needs, disturbance_factor=factor))
        points = search(problem)
    before = assess(plant, active, ensemble)
    if not points:
        raise DesignRefusedError(
            f'no gains within the hard bounds keep the margins over {ensemble.draws} draws '
            f'(flown: phase margin {before.worst_phase_margin_deg:.0f} deg, gain margin '
            f'{before.worst_gain_margin_db:.1f} dB, sensitivity '
            f'{before.worst_peak_sensitivity:.2f} at worst); identify with more excitation, or '
            'lower the gains by hand first'
        )
    objective, best = points[0]
    (chosen,) = problem.gains(best[None])
    return PidDesign(gains=chosen, figures=assess(plant, chosen, ensemble), before=before,
                     agreeing=sum(value <= (1.0 + AGREED) * objective for value, _ in points),
                     searches=len(points), disturbance_kept=rejects_disturbance)
