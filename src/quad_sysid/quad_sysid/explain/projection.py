"""A smaller model fitted to what the reference does, instead of once more to the noisy data.

Projection predictive selection (Goutis, Robert 1998; Piironen, Paasiniemi, Vehtari 2020): the
reference runs freely over windows of the training, each from its own filtered state; a smaller
model is fitted to these runs by least squares. They hold no noise and no feedback, so that an
output error is unbiased there. What decides which model is kept is in ladder.py.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from quad_sysid.contract import FloatArray
from quad_sysid.estimate.fit import Fit, Problem, limited
from quad_sysid.model.data import Windows
from quad_sysid.model.effect import Part
from quad_sysid.model.flight import Prediction, Run
from quad_sysid.model.plant import LEAST_LAG
from quad_sysid.model.sensitivity import Sensitivity
from quad_sysid.model.structure import Structure
from quad_sysid.qr import upper

MOST_STEPS = 20
MOST_DAMPED = 1e4
ENOUGH = 1e-3
"""A step that lowers the sum of squares by a smaller share ends the projection."""
ROUGHLY = 2e-2
"""The same where candidates are compared."""
PARTS = 3
"""Parts of the training, each of which is judged with parameters of the others."""
RANGE = (-14.0, 8.0)
"""The least logarithm: what is smaller than e^-14 of its unit acts as nothing."""
HUGE = 1e6
"""rad/s that stand for a run that diverges."""


@dataclass(frozen=True, eq=False)
class Projected:
    """A structure with the parameters that come nearest to the reference."""

    structure: Structure
    theta: FloatArray
    """(p,) coordinates of the fit; the noise's are the reference's."""
    missed: FloatArray
    """(windows,) sum over the window of the squared difference to the reference, (rad/s)²."""

    @property
    def total(self) -> float:
        """Sum of `missed`."""
        return float(np.sum(self.missed))


class Projection:
    """What a reference does along the training segments, and how near smaller models come."""

    states: Prediction | None = None
    """Where runs start; None: the reference's states."""
    goal: FloatArray
    """(windows, length) rates of the reference's free runs less the measured ones, rad/s."""

    def __init__(self, problem: Problem, reference: Fit) -> None:
        self.problem, self.reference, self.flight = problem, reference, problem.flight
        self.windows: Windows = problem.data.windows(problem.spans)
        self.goal = self.run(reference.structure, reference.theta).errors
        self.noise = reference.theta[-len(reference.structure.noise) :]
        self.base = len(reference.structure.base)

    def structure(self, parts: Sequence[Part]) -> Structure:
        """The reference's noise with other effects."""
        return replace(self.reference.structure, parts=tuple(parts))

    def run(self, structure: Structure, theta: FloatArray) -> Run:
        """Runs from `states`, errors (windows, length) in rad/s, at most HUGE."""
        with np.errstate(all='ignore'):
            run = self.flight.run(structure, theta, self.windows,
                                  prediction=self.states or self._from(structure))
        return run._replace(errors=np.clip(np.nan_to_num(run.errors, nan=HUGE), -HUGE, HUGE))

    def _differences(self, structure: Structure, theta: FloatArray, run: Run,
                     steps: FloatArray) -> FloatArray:
        """(rows, own) derivatives of a run by the coordinates of base and effects."""
        with np.errstate(all='ignore'):
            return Sensitivity(self.flight, structure, theta, self.windows,
                               self._from(structure), run).derivatives(steps)

    def _from(self, structure: Structure) -> Prediction:
        """The reference's states; a coefficient that it lacks rests at zero."""
        prediction, own = self.reference.prediction, self.reference.structure
        end = 4 + 2 * own.lines
        wandering = [part.effect.label for part in own.parts if part.effect.wanders]
        states = np.column_stack([prediction.states, np.zeros(len(prediction.states))])
        labels = [part.effect.label for part in structure.parts if part.effect.wanders]
        columns = [end + wandering.index(label) if label in wandering else -1 for label in labels]
        return replace(prediction, states=states[:, [*range(end), *columns]])

    def alone(self, theta: FloatArray) -> FloatArray:
        """(p,) the base's coordinates of a fit, with the reference's noise."""
        return np.concatenate([theta[: self.base], self.noise])

    def project(self, structure: Structure, start: FloatArray, *, coarse: bool = False,
                most: int = MOST_STEPS) -> Projected:
        """The parameters with the least squares to the reference, by Levenberg and Marquardt.

        The priors of the fit count beside errors of the size of the reference's innovations, so
        that curves stay smooth. coarse: near enough to choose among candidates. most: steps.
        """
        theta = start.astype(float)
        count = theta.size - self.noise.size
        specs = structure.specs[:count]
        logs = np.array([spec.log for spec in specs])
        positive = np.array([spec.positive and not spec.log for spec in specs])
        root = self.reference.tail.scale * self._prior(structure)
        centres = self.problem.centres(structure)[:count]
        steps = self.steps(structure, theta)
        tolerance = ROUGHLY if coarse else ENOUGH

        def residuals(point: FloatArray) -> tuple[Run, FloatArray]:
            """The run; (rows,) difference to the reference, and the prior's rows."""
            run = self.run(structure, point)
            return run, np.r_[(run.errors - self.goal).ravel(), root @ (point[:count] - centres)]

        run, rows = residuals(theta)
        value, damping = float(rows @ rows), 1e-3
        for _ in range(min(most, MOST_STEPS // 2) if coarse else most):
            columns = np.vstack([self._differences(structure, theta, run, steps), root])
            factor = upper(np.column_stack([columns, rows]))[:count]
            a, b = factor[:, :-1], factor[:, -1]
            scale = np.maximum(np.sqrt(np.sum(a**2, axis=0)), 1e-9)
            while damping < MOST_DAMPED:
                damped = np.vstack([a, math.sqrt(damping) * np.diag(scale)])
                step = -np.linalg.lstsq(damped, np.r_[b, np.zeros(count)], rcond=None)[0]
                trial = theta.copy()
                trial[:count] += limited(step, logs)
                trial[:count] = np.where(positive, np.maximum(trial[:count], 0.0), trial[:count])
                trial[:count] = np.where(logs, np.clip(trial[:count], *RANGE), trial[:count])
                trial_run, trial_rows = residuals(trial)
                new = float(trial_rows @ trial_rows)
                if new < value:
                    break
                damping = 8.0 * max(damping, 1e-4)
            else:  # no step leads further
                break
            last = value - new < tolerance * value or new <= 0.0
            theta, run, rows, value, damping = trial, trial_run, trial_rows, new, 0.2 * damping
            if last:
                break
        difference = run.errors - self.goal
        return Projected(structure, theta, np.sum(difference**2, axis=1))

    def _prior(self, structure: Structure) -> FloatArray:
        """(own, own) upper triangular root of the prior's precision of base and effects."""
        count = len(structure.specs) - self.noise.size
        precision = self.problem.precision(structure, self.problem.sizes(structure))
        return np.asarray(np.linalg.cholesky(precision[:count, :count]).T)

    def disagreement(self, fitted: Fit, *, later: bool = False) -> FloatArray:
        """(windows,) what a model misses of windows that its parameters have not seen.

        It runs from its own estimates, as where its error is measured: its disturbance may hold
        what it lacks. Every third window is run with what the others give, one step from the
        parameters of all: a curve that holds only where it was fitted explains less of the rest.
        Windows of one part lie all over the training, for an event shows only after it. later: a
        part is a third of the training's time, so that what drifts is missed as in a later flight.
        """
        if fitted is self.reference:
            return np.zeros(self.windows.count)
        return self._cut(fitted, self.goal, later=later)

    def later_error(self, fitted: Fit) -> FloatArray:
        """(windows,) the same of the measured rates instead of the reference's, `later`."""
        return self._cut(fitted, np.zeros_like(self.goal), later=True)

    def _cut(self, fitted: Fit, goal: FloatArray, *, later: bool) -> FloatArray:
        """(windows,) what a model misses of a goal (windows, length) where it has not seen it.

        Arguments as of `disagreement`.
        """
        count, structure, theta = self.windows.count, fitted.structure, fitted.theta
        own = copy(self)
        own.goal, own.states, own.noise = goal, fitted.prediction, theta[-len(structure.noise) :]
        if count < PARTS:  # too short to be cut
            return own.project(structure, theta, most=0).missed
        missed = np.empty(count)
        part = np.arange(count) * PARTS // count if later else np.arange(count) % PARTS
        for k in range(PARTS):
            inside = part == k
            other = own.on(~inside).project(structure, theta, most=1)
            missed[inside] = own.on(inside).project(structure, other.theta, most=0).missed
        return missed

    def on(self, which: NDArray[np.bool_]) -> Projection:
        """The same on some of the windows (windows,)."""
        part = copy(self)
        part.windows = Windows(self.windows.starts[which], self.windows.length)
        part.goal = self.goal[which]
        return part

    def covariance(self, model: Projected, of_reference: FloatArray) -> FloatArray:
        """(p, p) of a model's coordinates, those of the noise zero.

        What the reference's own covariance (p', p') brings through the projection, what the
        windows scatter where the model cannot follow the reference (the sandwich of White 1982),
        and the prior's. A time of less than LEAST_LAG of a cycle acts as nothing: it has the
        prior's alone, for the slope by its logarithm says nothing of longer ones, and would take
        the gain with it.
        """
        reference = self.reference
        jacobian, other = (self._derivatives(candidate.structure, candidate.theta)
                           for candidate in (model, reference))
        (rows, count), other_count = jacobian.shape, other.shape[1]
        noise, shortest = reference.tail.scale, math.log(LEAST_LAG * self.problem.data.dt)
        jacobian[:, [spec.log and spec.unit == 's' and x < shortest for spec, x in zip(
            model.structure.specs[:count], model.theta[:count], strict=True)]] = 0.0
        columns = np.vstack([jacobian, noise * self._prior(model.structure)])
        scale = np.maximum(np.sqrt(np.sum(columns**2, axis=0)), 1e-12)
        inverse = np.linalg.pinv(columns / scale, rcond=1e-8) / scale[:, None]
        inverse, of_prior = inverse[:, :rows], noise * inverse[:, rows:]
        through = inverse @ other
        out = through @ of_reference[:other_count, :other_count] @ through.T
        out += of_prior @ of_prior.T
        residual = (self.run(model.structure, model.theta).errors - self.goal).ravel()
        scores = (inverse * residual).reshape(count, self.windows.count, -1).sum(axis=2)
        covariance = np.zeros((model.theta.size, model.theta.size))
        covariance[:count, :count] = out + scores @ scores.T
        return covariance

    def _derivatives(self, structure: Structure, theta: FloatArray) -> FloatArray:
        """(rows, own) derivatives of the runs by the coordinates of base and effects.

        None by those that are held, which a law of the user's may stand for.
        """
        out = self._differences(structure, theta, self.run(structure, theta),
                                self.steps(structure, theta))
        out[:, self.problem.zero_terms] = 0.0
        return out

    def steps(self, structure: Structure, theta: FloatArray) -> FloatArray:
        """(own,) steps of numerical derivatives."""
        count = theta.size - self.noise.size
        logs = structure.logs[:count]
        steps = self.problem.steps(structure, theta)
        return np.maximum(steps[:count], 1e-3 * np.abs(np.where(logs, 0.0, theta[:count])))

    @cached_property
    def motion(self) -> FloatArray:
        """(windows,) sum of squares of the reference's rates about where each run starts."""
        runs = self._rates
        return np.asarray(np.sum((runs - runs[:, :1]) ** 2, axis=1))

    @cached_property
    def _rates(self) -> FloatArray:
        """(windows, length) the reference's runs, rad/s."""
        return np.asarray(self.problem.flight.gyro[self.windows.cells] + self.goal)

    @cached_property
    def thirds(self) -> list[NDArray[np.int64]]:
        """The windows in which it turns slowest, those between, and those in which fastest."""
        order = np.argsort(np.mean(self._rates**2, axis=1))
        return [part for part in np.array_split(order, PARTS) if part.size]

    def ordered(self, structure: Structure) -> Projected:
        """The reference itself, which its own projection is, with its effects in another order."""
        values = {part.effect.label: self.reference.theta[where]
                  for part, where in self.reference.structure.effects}
        theta = np.concatenate([
            self.reference.theta[: self.base], *(values[label] for label in structure.labels),
            self.noise,
        ])
        return Projected(structure, theta, np.zeros(self.windows.count))
