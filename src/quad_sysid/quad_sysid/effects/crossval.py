"""Blocked cross-validation of fitted structures on the training windows, by linearised refits.

A fit's Jacobian at its optimum gives the parameters without one fold to first order, so leaving
out costs no simulation. Folds are contiguous with gaps longer than the system's memory.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import stats

from quad_sysid.contract import FloatArray
from quad_sysid.greybox.covariance import block_numbers
from quad_sysid.greybox.data import Windows
from quad_sysid.greybox.fit import RUNAWAY, Fit
from quad_sysid.greybox.one_step import ABRUPT

FOLDS = 6
STEEPEST = 1e100
"""Derivatives beyond this are no derivatives."""
GAP_S = 1.0
"""Training windows this near to a held-out fold are left out of its fit."""


@dataclass(frozen=True)
class Comparison:
    """Paired comparison of two error figures over blocks."""

    difference: float
    """Mean of (first - second) of the squared error, (rad/s)²; positive: the second is better."""
    standard_error: float
    p_value: float
    """One-sided, that the second is no better."""
    blocks: int


def held_out_errors(fit: Fit, windows: Windows, dt: float) -> FloatArray:
    """(windows,) mean squared free-run error of each window by models that did not see it.

    What is local in time (when an event sets in; all of one that passes) is taken as known: no
    other part of the flight could tell it.
    """
    local = np.array([spec.name in ABRUPT for spec in fit.structure.specs])
    for effect, where in zip(fit.structure.effects, fit.structure.slices(), strict=True):
        local[where] |= effect.kind == 'event'
    free = np.flatnonzero(~fit.at_bound & ~local)
    return linear_held_out(
        fit.jacobian[:, :, free], fit.errors, fit.prior[:, free], fit.prior @ fit.theta,
        windows, dt,
    )


def linear_held_out(
    jacobian: FloatArray, errors: FloatArray, prior: FloatArray, prior_error: FloatArray,
    windows: Windows, dt: float,
) -> FloatArray:
    """The same of a linear model: jacobian (windows, length, p), prior (r, p) with its error (r,).

    Each fold's parameters are those of the linear problem without it. A model that ran away is
    given RUNAWAY's error everywhere.
    """
    if not ((np.abs(errors) < RUNAWAY).all() and (np.abs(jacobian) < STEEPEST).all()):
        return np.full(windows.count, RUNAWAY**2)
    gram = np.einsum('wlp,wlq->wpq', jacobian, jacobian, optimize=True)
    score = np.einsum('wlp,wl->wp', jacobian, errors)
    # spread of each parameter, so that the solve is well scaled
    total = np.sqrt(np.maximum(np.einsum('wpp->p', gram), 1e-300))
    prior_gram, prior_score = prior.T @ prior, prior.T @ prior_error
    out = np.empty(windows.count)
    for held, kept in folds_of(windows, dt):
        left = gram[kept].sum(axis=0) + prior_gram
        left /= np.outer(total, total)
        right = (score[kept].sum(axis=0) + prior_score) / total
        shift = -np.linalg.lstsq(left, right, rcond=1e-12)[0] / total
        out[held] = np.mean((errors[held] + jacobian[held] @ shift) ** 2, axis=1)
    return out


def folds_of(windows: Windows, dt: float) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Masks (windows,) of each fold: held out, and kept for the fit with the gaps left out."""
    count = windows.count
    order = np.argsort(windows.starts, kind='stable')
    fold = np.empty(count, dtype=np.int64)
    folds = min(FOLDS, max(2, count // 4))
    fold[order] = np.arange(count) * folds // count
    gap = round(GAP_S / dt) + windows.length
    for number in range(folds):
        held = fold == number
        near = np.abs(windows.starts[:, None] - windows.starts[None, held]).min(axis=1) < gap
        yield held, ~held & ~near


def compare(first: FloatArray, second: FloatArray, windows: Windows, dt: float) -> Comparison:
    """Paired one-sided test over blocks that the second's squared errors (windows,) are smaller.

    Two statistics, the better one's p doubled: the mean difference, which sees an effect that
    acts in few blocks, and the mean log ratio, which sees one that acts in all of them.
    """
    blocks = block_numbers(windows, dt)
    count = int(blocks.max()) + 1
    sizes = np.bincount(blocks, minlength=count)
    a = np.bincount(blocks, first, minlength=count) / sizes
    b = np.bincount(blocks, second, minlength=count) / sizes
    tiny = 1e-300
    p_value = min(1.0, 2.0 * min(_one_sided(a - b), _one_sided(np.log((a + tiny) / (b + tiny)))))
    error = float(np.std(a - b, ddof=1) / np.sqrt(count)) if count > 1 else float('inf')
    return Comparison(float(np.mean(first - second)), error, p_value, count)


def _one_sided(sample: FloatArray) -> float:
    """p-value of Student's test that the mean of the sample is not above zero."""
    if sample.size < 3:
        return 1.0
    error = float(np.std(sample, ddof=1) / np.sqrt(sample.size))
    mean = float(np.mean(sample))
    if not np.isfinite(error) or error == 0.0:
        return 0.0 if mean > 0.0 and error == 0.0 else 1.0
    return float(stats.t.sf(mean / error, sample.size - 1))
