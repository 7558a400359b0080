"""The cascade retuned without changing its structure: C1 P and C2 PID of one axis.

Minimised: tracking error of a square wave, deviation under a torque step and noise at the motors,
each relative to the gains that flew. Subject to margins of every loop of the ensemble. The
problem is smooth in the logarithms of the gains, so SLSQP solves it; the worst loops are taken up
one after the other until all hold (cutting planes), and several starts must agree.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize

from quad_sysid.contract import FloatArray
from quad_sysid.loop.cascade import TUNED, CascadeGains, Margins
from quad_sysid.loop.plant import LoopPlant
from quad_tuning.assess import (
    LoopFigures,
    assess,
    disturbance,
    noise_gain,
    reference_square,
    tracking,
)
from quad_tuning.bounds import reachable
from quad_tuning.ensemble import Ensemble
from quad_tuning.errors import DesignRefusedError

STARTS = 4
"""Searches, begun at the best points of a lattice that lie at least APART from each other."""
LATTICE = (0.12, 0.37, 0.62, 0.87)
APART = 0.45
DIFFERENCE = 2e-3
WORST = 6
"""Loops taken up per requirement and round."""
ROUNDS = 5
INFEASIBLE = 0.005
"""Relative shortfall after a search beyond which no further round is tried."""


@dataclass(frozen=True)
class Requirements:
    """What every loop of the ensemble, or the nominal one, must keep."""

    phase_margin_deg: float = 45.0
    gain_margin_db: float = 8.0
    peak_sensitivity: float = 1.8
    overshoot_pct: float = 10.0
    """Nominal square wave."""
    noise_factor: float = 3.0
    """Noise at the motors, of what the flown gains gave."""
    highest_crossover_rad_s: float = float('inf')
    """Nominal."""


@dataclass(frozen=True)
class Weights:
    """Shares of the objective, each figure relative to the flown gains."""

    tracking: float = 1.0
    disturbance: float = 0.2
    noise: float = 0.05


@dataclass(frozen=True)
class PidDesign:
    """Gains found, what they give, what the flown ones gave, and how sure the optimum is."""

    gains: CascadeGains
    figures: LoopFigures
    before: LoopFigures
    objective: float
    spread_pct: float
    """Largest difference of a gain that matters (angle kp, rate kp) between the starts."""
    objective_spread_pct: float
    starts: int


@dataclass(frozen=True)
class _Problem:
    """Everything that does not change while one design is sought."""

    plant: LoopPlant
    active: CascadeGains
    ensemble: Ensemble
    nominal: Ensemble
    needs: Requirements
    weights: Weights
    reference: FloatArray
    scale: tuple[float, float, float]
    low: FloatArray
    high: FloatArray
    log: npt.NDArray[np.bool_]

    def gains(self, x: FloatArray) -> CascadeGains:
        """Gains at a point of the unit cube."""
        share = np.clip(x, 0.0, 1.0)
        safe = np.where(self.log, self.low, 1.0)
        ratio = np.where(self.log, self.high, 1.0) / safe
        values = np.where(self.log, safe * ratio**share, self.low + share * (self.high - self.low))
        return replace(self.active, **{f: float(v) for f, v in zip(TUNED, values, strict=True)})


def retune(
    plant: LoopPlant,
    active: CascadeGains,
    ensemble: Ensemble,
    needs: Requirements | None = None,
    weights: Weights | None = None,
) -> PidDesign:
    """The best gains within one update of `active` that hold for every loop of the ensemble.

    Deterministic. Raises DesignRefusedError where no gains within reach meet the requirements.
    """
    problem = _problem(plant, active, ensemble, needs or Requirements(), weights or Weights())
    found: list[tuple[float, FloatArray]] = []
    for attempt, start in enumerate(_starts(problem)):
        point = _search(problem, start)
        if point is not None:
            found.append(point)
        elif attempt and not found:
            break  # two searches from afar found none
    if not found:
        raise DesignRefusedError(_why_not(problem))
    best = min(found, key=lambda item: item[0])
    gains = [problem.gains(x) for _, x in found]
    chosen = problem.gains(best[1])
    spread = max(abs(getattr(g, f) / getattr(chosen, f) - 1.0) for g in gains for f in TUNED[:2])
    objectives = [value for value, _ in found]
    return PidDesign(
        gains=chosen,
        figures=assess(plant, chosen, ensemble),
        before=assess(plant, active, ensemble),
        objective=best[0],
        spread_pct=100.0 * spread,
        objective_spread_pct=100.0 * (max(objectives) / min(objectives) - 1.0),
        starts=len(found),
    )


def meets(margins: Margins, needs: Requirements) -> npt.NDArray[np.bool_]:
    """(p,) True where a loop keeps phase margin, gain margin and peak sensitivity."""
    return np.asarray(
        (margins.phase_margin_deg >= needs.phase_margin_deg)
        & (margins.gain_margin_db >= needs.gain_margin_db)
        & (margins.peak_sensitivity <= needs.peak_sensitivity)
    )


def _problem(
    plant: LoopPlant,
    active: CascadeGains,
    ensemble: Ensemble,
    needs: Requirements,
    weights: Weights,
) -> _Problem:
    limits = np.array([reachable(field, getattr(active, field)) for field in TUNED])
    reference = reference_square(plant.dt)
    nominal = ensemble.subset(np.flatnonzero(ensemble.nominal)[:1])
    scale = (
        tracking(plant, active, reference)[0],
        disturbance(plant, active),
        noise_gain(active, nominal),
    )
    if not np.isfinite(scale).all():
        raise DesignRefusedError('the simulated loop with the flown gains diverges')
    return _Problem(
        plant, active, ensemble, nominal, needs, weights, reference, scale,
        limits[:, 0], limits[:, 1], limits[:, 0] > 0.0,
    )  # fmt: skip


def _objective(problem: _Problem, gains: CascadeGains) -> tuple[float, FloatArray]:
    """The objective, and the nominal constraints (3,), kept where >= 0."""
    rms, beyond = tracking(problem.plant, gains, problem.reference)
    noise = noise_gain(gains, problem.nominal) / problem.scale[2]
    w = problem.weights
    value = (
        w.tracking * rms / problem.scale[0]
        + w.disturbance * disturbance(problem.plant, gains) / problem.scale[1]
        + w.noise * noise
    )
    crossover = float(problem.nominal.margins(gains).crossover_rad_s[0])
    highest = problem.needs.highest_crossover_rad_s
    room = 1.0 if np.isinf(highest) or np.isnan(crossover) else 1.0 - crossover / highest
    kept = [
        (problem.needs.overshoot_pct - beyond) / 100.0,
        1.0 - noise / problem.needs.noise_factor,
        room,
    ]
    if not np.isfinite(value):
        return 1e3, np.full(3, -1.0)
    return float(value), np.clip(kept, -1.0, 1.0)


def _shortfall(problem: _Problem, loops: Ensemble, gains: CascadeGains) -> FloatArray:
    """(3 p,) relative room of every loop to each requirement, kept where >= 0."""
    m = loops.margins(gains)
    needs = problem.needs
    return np.concatenate(
        [
            np.clip(m.phase_margin_deg / needs.phase_margin_deg - 1.0, -1.0, 1.0),
            np.clip(m.gain_margin_db / needs.gain_margin_db - 1.0, -1.0, 1.0),
            np.clip(1.0 - m.peak_sensitivity / needs.peak_sensitivity, -1.0, 1.0),
        ]
    )


def _starts(problem: _Problem) -> list[FloatArray]:
    """The best lattice points of the unit cube that lie apart, judged with a penalty."""
    cube = np.stack(np.meshgrid(*[np.array(LATTICE)] * 3, indexing='ij'), axis=-1).reshape(-1, 3)
    points = np.insert(cube, TUNED.index('rate_ki'), 0.5, axis=1)
    loops = problem.ensemble.subset(_worst(problem, np.full(len(TUNED), 0.5)))
    merits = []
    for point in points:
        gains = problem.gains(point)
        value, kept = _objective(problem, gains)
        short = np.concatenate((kept, _shortfall(problem, loops, gains)))
        merits.append(value - 20.0 * min(0.0, float(np.min(short))))
    chosen: list[FloatArray] = []
    for index in np.argsort(merits, kind='stable'):
        point = points[index]
        if all(np.linalg.norm(point - other) >= APART for other in chosen):
            chosen.append(point)
        if len(chosen) == STARTS:
            break
    return chosen


def _search(problem: _Problem, start: FloatArray) -> tuple[float, FloatArray] | None:
    """Objective and point of the best gains from this start; None where none hold."""
    chosen = np.zeros(0, dtype=np.int64)
    x = start
    for _ in range(ROUNDS):
        wider = np.union1d(chosen, _worst(problem, x))
        if wider.size == chosen.size:
            return None  # the loops that fall short were all taken up already
        chosen = wider
        loops = problem.ensemble.subset(chosen)

        def judged(point: FloatArray, loops: Ensemble = loops) -> FloatArray:
            gains = problem.gains(point)
            value, kept = _objective(problem, gains)
            # 0.2 % are kept back, so that the optimiser's tolerance does not break a margin
            margins = _shortfall(problem, loops, gains) - 2e-3
            return np.concatenate(([value], kept, margins))

        x = _slsqp(judged, x)
        gains = problem.gains(x)
        value, kept = _objective(problem, gains)
        short = min(np.min(kept), np.min(_shortfall(problem, loops, gains)))
        if short < -INFEASIBLE:
            return None  # what a part of the loops forbids, all of them forbid
        if np.min(kept) < -1e-3:
            continue
        every = problem.ensemble
        if meets(every.margins(gains), problem.needs).all() and not every.unstable(gains).any():
            return value, x
    return None


def _slsqp(judged: Callable[[FloatArray], FloatArray], start: FloatArray) -> FloatArray:
    """Minimise judged(x)[0] subject to judged(x)[1:] >= 0 in the unit cube."""
    known: dict[bytes, FloatArray] = {}
    slopes: dict[bytes, FloatArray] = {}

    def at(x: FloatArray) -> FloatArray:
        key = x.tobytes()
        if key not in known:
            known[key] = judged(x)
        return known[key]

    def slope(x: FloatArray) -> FloatArray:
        key = x.tobytes()
        if key not in slopes:
            columns = []
            for i in range(x.size):
                h = DIFFERENCE if x[i] < 0.5 else -DIFFERENCE
                other = x.copy()
                other[i] += h
                columns.append((at(other) - at(x)) / h)
            slopes[key] = np.stack(columns, axis=1)
        return slopes[key]

    result = minimize(
        lambda x: at(x)[0],
        start,
        jac=lambda x: slope(x)[0],
        bounds=[(0.0, 1.0)] * start.size,
        constraints={
            'type': 'ineq',
            'fun': lambda x: at(x)[1:],
            'jac': lambda x: slope(x)[1:],
        },
        method='SLSQP',
        options={'maxiter': 40, 'ftol': 1e-6},
    )
    return np.asarray(np.clip(result.x, 0.0, 1.0))


def _worst(problem: _Problem, x: FloatArray) -> npt.NDArray[np.int64]:
    """Loops that fall shortest of each requirement at x."""
    room = _shortfall(problem, problem.ensemble, problem.gains(x)).reshape(3, -1)
    return np.unique(np.argsort(room, axis=1, kind='stable')[:, :WORST]).astype(np.int64)


def _why_not(problem: _Problem) -> str:
    figures = assess(problem.plant, problem.active, problem.ensemble)
    return (
        'no gains within one update of the flown ones keep the margins over '
        f'{problem.ensemble.draws} draws (flown: phase margin '
        f'{figures.worst_phase_margin_deg:.0f} deg, gain margin '
        f'{figures.worst_gain_margin_db:.1f} dB, sensitivity '
        f'{figures.worst_peak_sensitivity:.2f} at worst); identify with more excitation, or '
        'lower the gains by hand first'
    )
