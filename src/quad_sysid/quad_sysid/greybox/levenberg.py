"""Levenberg-Marquardt with bounds for small problems with long residuals.

Column-scaled, steps from a QR factorisation of the Jacobian (never the normal equations of the
full problem), active bounds held and released by the sign of the gradient. Numbers only.
Source: J. J. More, The Levenberg-Marquardt algorithm: implementation and theory (1978).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from quad_sysid.contract import FloatArray

Residual = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class Minimum:
    """Where the search ended. residual (m,), jacobian (m, p) at `theta` (p,)."""

    theta: FloatArray
    residual: FloatArray
    jacobian: FloatArray
    cost: float
    """Sum of squares."""
    iterations: int
    evaluations: int
    converged: bool
    at_bound: np.ndarray
    """(p,) True where a bound holds the parameter."""


def minimise(
    residual: Residual,
    theta: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    scale: FloatArray,
    *,
    max_iterations: int = 40,
    tolerance: float = 1e-6,
) -> Minimum:
    """Minimise ||residual(theta)||² inside lower <= theta <= upper; all (p,).

    Converged when a full step promises less than `tolerance` of the cost or moves no parameter
    by more than `tolerance` of its scale.
    """
    theta = np.clip(theta, lower, upper)
    r = residual(theta)
    cost = float(r @ r)
    evaluations = 1
    damping = 1e-3
    converged = False
    jacobian = np.zeros((r.size, theta.size))
    held = np.zeros(theta.size, dtype=bool)
    iterations = 0
    while iterations < max_iterations:
        iterations += 1
        jacobian = difference_jacobian(residual, theta, r, lower, upper, scale)
        evaluations += theta.size
        gradient = jacobian.T @ r
        held = ((theta <= lower) & (gradient > 0)) | ((theta >= upper) & (gradient < 0))
        free = np.flatnonzero(~held)
        if free.size == 0:
            converged = True
            break
        q, triangle = np.linalg.qr(jacobian[:, free])
        norms = np.linalg.norm(triangle, axis=0)
        norms[norms == 0.0] = 1.0
        triangle = triangle / norms
        target = -(q.T @ r)
        improved = False
        for _ in range(12):
            stacked = np.vstack([triangle, np.sqrt(damping) * np.eye(free.size)])
            step = np.linalg.lstsq(stacked, np.r_[target, np.zeros(free.size)], rcond=None)[0]
            promised = float(target @ target - np.sum((target - triangle @ step) ** 2))
            trial = theta.copy()
            trial[free] = np.clip(theta[free] + step / norms, lower[free], upper[free])
            moved = np.max(np.abs(trial - theta) / scale)
            if promised <= tolerance * cost or moved <= tolerance:
                converged = True
                break
            trial_r = residual(trial)
            evaluations += 1
            trial_cost = float(trial_r @ trial_r)
            if np.isfinite(trial_cost) and trial_cost < cost:
                gain = (cost - trial_cost) / promised
                damping = max(damping * (0.2 if gain > 0.7 else 1.0 if gain > 0.3 else 3.0), 1e-9)
                small = cost - trial_cost <= tolerance * cost
                theta, r, cost = trial, trial_r, trial_cost
                improved = True
                converged = small and gain > 0.3
                break
            damping *= 8.0
        if converged or not improved:
            break
    return Minimum(theta, r, jacobian, cost, iterations, evaluations, converged, held)


def difference_jacobian(
    residual: Residual,
    theta: FloatArray,
    r: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    scale: FloatArray,
) -> FloatArray:
    """(m, p) Jacobian by one-sided differences that stay inside the bounds."""
    jacobian = np.empty((r.size, theta.size))
    for i in range(theta.size):
        step = 1e-4 * scale[i] + 1e-5 * abs(theta[i])
        if theta[i] + step > upper[i]:
            step = -step
        moved = theta.copy()
        moved[i] += step
        moved[i] = max(moved[i], lower[i])
        jacobian[:, i] = (residual(moved) - r) / (moved[i] - theta[i])
    return jacobian
