"""What fitted models make of the held-out segments: errors, innovations, disturbance.

The verdict on them is discover/accept.py's; here is what reports draw and test.
"""

from __future__ import annotations

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.discover.accept import Unseen, Verdict
from quad_sysid.discover.search import Found
from quad_sysid.estimate.fit import Fit, Problem
from quad_sysid.model.data import AxisData
from quad_sysid.pipeline.answer import Findings, HeldOut


def findings(data: AxisData, problem: Problem, found: Found, verdict: Verdict) -> Findings:
    """Base and chosen model on the validation segments."""
    unseen = Unseen(data, data.validation)
    before = _held_out(unseen, found.base)
    after = before if verdict.chosen is found.base else _held_out(unseen, verdict.chosen)
    return Findings(data, problem, found, verdict, before, after)


def _held_out(unseen: Unseen, fitted: Fit) -> HeldOut:
    flight = unseen.problem.flight
    predicted = flight.predict(fitted.structure, fitted.theta, sweeps=3)
    inside = np.zeros(unseen.problem.data.rate.size, dtype=bool)
    for start, stop in unseen.problem.spans:
        inside[start:stop] = True
    with np.errstate(over='ignore', invalid='ignore'):
        errors = flight.free_run(
            fitted.structure, fitted.theta, unseen.windows, prediction=predicted
        )
        return HeldOut(
            fitted, errors, interval(errors),
            np.where(inside, predicted.innovation, np.nan),
            np.where(inside, predicted.states[:, 1], np.nan),
        )


def interval(errors: FloatArray) -> tuple[float, float]:
    """95 % of the RMS over windows (windows, length) that are independent of each other."""
    square = np.mean(errors**2, axis=1)
    mean = float(np.mean(square))
    if square.size < 2 or not mean > 0.0:
        return 0.0, float('inf')
    spread = 1.96 * float(np.std(square, ddof=1)) / np.sqrt(square.size) / mean
    low, high = np.sqrt(mean) * np.exp(0.5 * np.array([-spread, spread]))
    return float(low), float(high)
