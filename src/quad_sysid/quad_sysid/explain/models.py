"""Projected models as filters: with noise of their own they follow a flight.

A smaller model need not follow a flight at all: without the effect that holds another one it may
run away. It is no explanation then, and only that rung of the ladder falls away.
"""

from __future__ import annotations

import math

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.discover.base import fitted_from
from quad_sysid.discover.search import SearchResult
from quad_sysid.estimate.fit import Fit, stays_bounded
from quad_sysid.estimate.stored import Stored
from quad_sysid.explain.projection import Projected, Projection

DISTURBANCE = 1
"""Place of the disturbance among the parameters of the noise."""


class Models:
    """Projected models with the noise that the training gives them, each fitted once."""

    def __init__(self, searched: SearchResult, projection: Projection) -> None:
        self.problem, self.projection = projection.problem, projection
        self.best_fits = {(): searched.base} | {
            tuple(sorted(scored.fit.structure.labels)): scored.fit
            for scored in reversed(searched.all)}
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
            for i, columns in enumerate(model.structure.slices())
        ]
