"""The black-box side of one axis: the models that are tried, step A, the error in the metric.

Steps A and B are the two of the paper's selection (docs/theory.md). Step B stands in step_b.py,
the approaches of Table 1 in selection.py, advice in advice.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from quad_sysid.blackbox import (
    Model,
    OrderSearch,
    armax,
    bj,
    clriv,
    delay_estimate,
    horizon_errors,
    iv4,
    oe,
    residual_test,
    search_arx,
    step_a,
)
from quad_sysid.contract import FloatArray
from quad_sysid.discover.accept import HORIZONS_S, at_horizon, rms
from quad_sysid.errors import BadInputError, QuadSysidError
from quad_sysid.model.data import AxisData, Span, Windows
from quad_sysid.model.flight import DIVERGED
from quad_sysid.pipeline.answer import ModelRow
from quad_sysid.record import IOData, finite_runs

ORDERS = (2, 3, 4)
"""Orders of the plant B/F and of the noise C/D beside it, which has the poles of axis and filter:
with C and D of order 2 no residual behind a gyro's filter is white."""
SHORTEST = 100
"""Samples of a validation span that is worth a fit."""


def about_base(data: AxisData, gain: float, bias: float) -> AxisData:
    """The data with the equilibrium of a base of this gain and bias (rad/s²) as their trim."""
    return replace(data, trim=(-bias / gain if gain else 0.0, 0.0))


def io_data(data: AxisData, spans: tuple[Span, ...], *, external: bool = True) -> IOData:
    """Command and rate about their trim over spans, with the external reference where known.

    The trim is the base's equilibrium where it is known: an axis nearly integrates, and the means
    of a command and a rate that ends elsewhere than it began are no equilibrium. Otherwise the
    means of the training, for every segment alike. Spans are cut where the rate or the reference
    was lost; the reference is left out where most of it is missing or where it stands still.
    """

    def mean(x: FloatArray) -> float:
        parts = np.concatenate([x[a:b] for a, b in data.train])
        finite = parts[np.isfinite(parts)]
        return float(finite.mean()) if finite.size else 0.0

    command, rate = data.trim or (mean(data.command), mean(data.rate))
    is_finite = np.isfinite(data.rate)
    r = data.reference if external else None
    if r is not None:
        in_both = is_finite & np.isfinite(r)
        inside = np.concatenate([in_both[a:b] for a, b in spans])
        moves = any(np.ptp(r[a:b][in_both[a:b]]) > 0.0 for a, b in spans if in_both[a:b].any())
        # a reference that is known for less than nine tenths would cost more than it explains
        is_finite, r = (in_both, r) if inside.mean() > 0.9 and moves else (is_finite, None)
    return IOData(u=data.command - command, y=data.rate - rate, dt=data.dt,
                  r=None if r is None else r - mean(r),
                  segments=tuple(run for span in spans for run in finite_runs(is_finite, span)))


@dataclass(frozen=True)
class Fits:
    """The models of one axis, and the reasons why others could not be fitted."""

    models: tuple[Model, ...]
    search: OrderSearch
    """The search for ARX orders by AIC."""
    delay: int
    """Delay in samples by the lowest BIC."""
    order: int
    """Order of the plant B/F, BJ's."""
    nk: int
    """Delay of the other structures, alike: noise hides a small first coefficient from ARX."""
    refused: tuple[str, ...] = ()

    @property
    def surest(self) -> Model:
        """The model with the most reliable covariance: BJ, where it converged."""
        return next((m for m in self.models if m.structure == 'BJ' and m.converged),
                    self.search.model)


def fit_models(z: IOData) -> Fits:
    """Fit ARX by order search (AIC, BIC; the paper's ranges) and the other structures beside it.

    Their plant's order is BJ's.
    """
    searches = [search_arx(z, range(2, 11), range(1, 11), range(1, 9), criterion)
                for criterion in ('aic', 'bic')]
    models = [search.model for search in searches]
    if dict(models[0].orders) == dict(models[1].orders):
        models.pop()
    refused: list[str] = []
    latest = searches[1].model.nk  # a command that feels the rate of its cycle looks undelayed
    best = box_jenkins(refused, z, latest)
    n, nk = (ORDERS[0], latest) if best is None else (best.F.size - 1, best.nk)
    if best is not None:
        models.append(best)
    models += successful_fits(refused, lambda: armax(z, n, n, n, nk), lambda: oe(z, n, n, nk))
    models += _highest_stable(refused, n, lambda order: iv4(z, order, order, nk))
    if z.r is not None:
        models += _highest_stable(
            refused, n, lambda order: clriv(z, order, order, order, order, nk)
        )
    return Fits(tuple(models), searches[0], delay_estimate(z), n, nk, tuple(refused))


def box_jenkins(refused: list[str], z: IOData, nk: int) -> Model | None:
    """The BJ model of the lowest BIC, of those whose residual is white and free of past inputs.

    Or of all, where none is. Delays shrink while that makes it better, and orders rise alike.
    """

    def rank(model: Model) -> tuple[bool, bool, float]:
        passed = False
        with suppress(BadInputError):  # too few samples for a test
            test = residual_test(z, model, fitted=True)
            passed = test.residual_white and test.residual_uncorrelated_with_input
        # each fit has rows of its own: their number would count with the unit of the rate
        bic = z.n * math.log(model.loss) + model.parameters.size * math.log(z.n)
        return not model.converged, not passed, bic

    def ranked(order: int, delay: int, start: Model | None = None
               ) -> tuple[tuple[bool, bool, float], Model] | None:
        models = successful_fits(
            refused, lambda: bj(z, order, order, order, order, delay, start=start))
        return (rank(models[0]), models[0]) if models else None

    best = None
    for order in ORDERS:
        higher = ranked(order, nk if best is None else best[1].nk)
        while higher is not None and higher[1].nk > 1:
            start = replace(higher[1], B=higher[1].B[:-1], nk=higher[1].nk - 1)
            earlier = ranked(order, start.nk, start)
            if earlier is None or earlier[0] >= higher[0]:
                break
            higher = earlier
        if best is not None and (higher is None or higher[0] >= best[0]):
            break
        best = higher
    return None if best is None else best[1]


def _highest_stable(refused: list[str], order: int,
                    fit: Callable[[int], Model]) -> tuple[Model, ...]:
    """The instrumental variable fit of the order, or of the next lower one that settles.

    More coefficients than the plant has leave these estimators without an answer.
    """
    reasons: list[str] = []
    models: tuple[Model, ...] = ()
    for lower in range(order, ORDERS[0] - 1, -1):
        models = successful_fits(reasons, lambda lower=lower: fit(lower)) or models  # type: ignore[misc]
        if models and models[0].stable and models[0].converged:
            return models
    refused += reasons
    return models


def successful_fits(refused: list[str], *fits: Callable[[], Model]) -> tuple[Model, ...]:
    """The fits that succeed; the errors of the others are added to `refused`."""

    def attempt(fit: Callable[[], Model]) -> Model | None:
        try:
            return fit()
        except BadInputError as error:
            refused.append(str(error))
            return None

    return tuple(model for model in map(attempt, fits) if model is not None)


def validations(data: AxisData) -> dict[str, IOData]:
    """Validation data of the models, by the name of the segment's signal."""
    signals: dict[str, IOData] = {}
    for name in dict.fromkeys(data.validation_names):
        spans = tuple(
            s for s, n in zip(data.validation, data.validation_names, strict=True)
            if n == name and s[1] - s[0] > SHORTEST
        )
        if spans:
            signals[name] = io_data(data, spans, external=False)
    return signals


def rows_of(z: IOData, data: AxisData, models: tuple[Model, ...]) -> tuple[ModelRow, ...]:
    """Step A for every model, trained on z."""
    return tuple(map(ModelRow, step_a(models, z, validations(data))))


def select(rows: tuple[ModelRow, ...], data: AxisData) -> int | None:
    """Index of the lowest BIC among the rows that passed most; None where all are unstable.

    Where none with a white residual passed the first step the least error over windows of the
    training is taken, since then no model of the noise, on which BIC rests, holds. Training data
    alone decide between the rows: validation may reject a model but never rank it.
    """
    stable = [
        i for i, row in enumerate(rows)
        if row.step_a.model.stable and row.step_a.bic is not None
    ]
    first = [i for i in stable if rows[i].step_a.holds]
    second = [i for i in first if rows[i].passed_second_step]
    if first:
        return min(second or first, key=lambda i: rows[i].step_a.bic or 0.0)

    def error(i: int) -> float:
        rms = window_error(data, rows[i].step_a.model, data.train)
        return math.inf if rms is None else rms

    return min(stable, key=error, default=None)


def window_error(data: AxisData, model: Model, spans: tuple[Span, ...]) -> float | None:
    """The contract's error of a polynomial model: the i-th sample is its i-step prediction.

    A window's first sample is predicted one step ahead from what was measured before it, its
    second two steps, and so on: nothing measured inside the window is used.
    """
    errors = window_errors(data, model, data.windows(spans))
    return None if errors is None else float(np.sqrt(np.mean(errors**2)))


def window_errors(data: AxisData, model: Model, windows: Windows) -> FloatArray | None:
    """(windows, length) errors of a polynomial model; None without any, or where it runs away."""
    if not windows.count:
        return None
    z = io_data(data, data.stretches, external=False)
    out = np.empty((windows.count, windows.length))
    try:
        for i, errors in enumerate(horizon_errors(model, z, windows.length)):
            out[:, i] = errors[windows.starts + i]
    except QuadSysidError:
        return None
    return out if np.isfinite(out).all() and np.abs(out).max() < DIVERGED else None


def horizons(data: AxisData, model: Model, spans: tuple[Span, ...]) -> dict[float, float]:
    """Seconds after the start of a free run to the RMS error, rad/s; empty without any."""
    errors = window_errors(data, model, data.windows(spans, HORIZONS_S[-1]))
    if errors is None:
        return {}
    return {h: rms(errors[:, at_horizon(h, data.dt)]) for h in HORIZONS_S}
