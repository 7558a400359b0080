"""A first look at candidates without a fit: where one enters linearly, its worth is known at once.

The Jacobians of what is there already are at hand; only the effect's columns are simulated. What
is screened out is reported with the score it had. Nothing is chosen here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from quad_sysid.contract import FloatArray
from quad_sysid.effects.crossval import linear_held_out
from quad_sysid.greybox.fit import RUNAWAY, Fit
from quad_sysid.greybox.one_step import (
    block_of_rows,
    least_squares,
    one_step,
    oversampling,
    slow,
    slow_errors,
    slow_jacobian,
)
from quad_sysid.greybox.simulate import Simulator
from quad_sysid.greybox.structure import Effect, Prepared, Settings

STEP = 0.05
"""Share of a parameter's scale by which it is moved for its column."""
BENT = ('dead_zone', 'backlash')
"""These vanish at zero, yet not along a straight line."""


@dataclass(frozen=True, eq=False)
class Columns:
    """What an effect's parameters change from zero on, to first order."""

    errors: FloatArray
    """(windows, length, k) of the free-run error."""
    slow: FloatArray
    """(m, k) of the low-passed one-step error."""


@dataclass(frozen=True, eq=False)
class FirstLook:
    """What effects that enter linearly would be worth."""

    errors: FloatArray
    """(windows,) held-out mean squared errors, to first order."""
    theta: FloatArray
    """(p,) parameters of the linear solution, to start a fit from."""
    p_value: float
    """That the least certain of the added parameters is nothing, by the one-step errors."""

    @property
    def score(self) -> float:
        """Cross-validated RMS error, rad/s."""
        return float(np.sqrt(np.mean(self.errors)))


def vanishes(effect: Effect) -> bool:
    """Whether the effect is absent where its parameters are zero, so that columns there exist."""
    if effect.starts is not None:
        return False
    single = len(effect.parameters) == 1 and effect.parameters[0].lower <= 0.0
    return single or all(spec.starts == (0.0,) for spec in effect.parameters)


def enters_linearly(effect: Effect) -> bool:
    """Whether its columns at zero say all that it can do."""
    return vanishes(effect) and effect.name not in BENT


def students_p(size: float, freedom: int) -> float:
    """Two-sided p-value of an estimate that lies `size` standard errors from zero."""
    return 2.0 * float(stats.t.sf(abs(size), freedom)) if np.isfinite(size) else 1.0


def sharp_p(sim: Simulator, fit: Fit) -> FloatArray:
    """(p,) p-values that each parameter of a fit is nothing, by the one-step errors."""
    found = one_step(sim, fit)
    freedom = max(found.blocks - fit.theta.size, 1)
    with np.errstate(divide='ignore', invalid='ignore'):
        sizes = found.theta / found.std
    return np.array([students_p(float(size), freedom) for size in sizes])


class Screen:
    """First looks at what could be added to one fit; what they share is computed once."""

    def __init__(self, sim: Simulator, fit: Fit) -> None:
        self.sim, self.fit = sim, fit
        free = np.flatnonzero(~fit.at_bound)
        self._run = slow_errors(sim, fit.structure, fit.theta)
        self._known = slow_jacobian(sim, fit.structure, fit.theta, self._run, free)
        self._block = block_of_rows(sim)
        self._free = free

    def columns(self, effect: Effect, settings: Settings) -> Columns | None:
        """What the effect's parameters change; None where a small one overflows."""
        structure = self.fit.structure.with_effect(effect, settings)
        known = self.fit.theta.size
        errors, slowly = [], []
        for i, spec in enumerate(effect.parameters):
            theta = np.r_[self.fit.theta, np.zeros(len(effect.parameters))]
            step = STEP * spec.scale
            theta[known + i] = step
            run = self.sim.run(structure, theta)
            errors.append((run.errors - self.fit.errors) / step)
            slowly.append((slow(self.sim, run.innovations) - self._run) / step)
        out = Columns(np.stack(errors, axis=2), np.stack(slowly, axis=1))
        tame = (np.abs(out.errors) < RUNAWAY / STEP).all() and np.isfinite(out.slow).all()
        return out if tame else None

    def look(self, puts: Sequence[Prepared], added: Sequence[Columns]) -> FirstLook:
        """The worth of adding effects that vanish at zero, from their columns."""
        fit, sim = self.fit, self.sim
        structure = fit.structure
        for put in puts:
            structure = structure.with_effect(*put)
        count = sum(one.slow.shape[1] for one in added)
        free = np.r_[self._free, fit.theta.size + np.arange(count)]
        jacobian = np.concatenate([fit.jacobian, *(one.errors for one in added)], axis=2)
        jacobian = jacobian[:, :, free]
        start = np.r_[fit.theta, np.zeros(count)]
        rows = fit.rms * structure.prior()
        prior, prior_error = rows[:, free], rows @ start
        errors = linear_held_out(
            jacobian, fit.errors, prior, prior_error, sim.windows, sim.data.dt
        )
        flat = np.vstack([jacobian.reshape(-1, free.size), prior])
        size = np.maximum(np.linalg.norm(flat, axis=0), 1e-300)
        right = np.concatenate([fit.errors.ravel(), prior_error])
        stacked = np.column_stack([flat / size, right])
        triangle: FloatArray = np.asarray(np.linalg.qr(stacked, mode='r'))
        start[free] -= np.linalg.lstsq(triangle[:, :-1], triangle[:, -1], rcond=1e-10)[0] / size
        specs = structure.specs
        start = np.clip(start, [s.lower for s in specs], [s.upper for s in specs])
        return FirstLook(errors, start, self._least_certain(added, count))

    def _least_certain(self, added: Sequence[Columns], count: int) -> float:
        if any(one.slow.shape[1] > 1 for one in added):
            return 1.0  # too few blocks to judge a curve's parameters one by one
        jacobian = np.column_stack([self._known, *(one.slow for one in added)])
        found = least_squares(jacobian, self._run, self._block, oversampling(self.sim))
        with np.errstate(divide='ignore', invalid='ignore'):
            sizes = found.shift[-count:] / np.sqrt(np.diag(found.covariance)[-count:])
        freedom = max(found.blocks - jacobian.shape[1], 1)
        return max(students_p(float(size), freedom) for size in sizes)
