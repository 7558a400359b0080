"""The same structure by its one-step errors: twice as sharp as the free run where noise is white.

The free-run error decides what a model is worth; but it weighs the data badly. Where a Kalman
filter's innovations are white, Gauss-Newton on them reaches the Cramer-Rao bound (Ljung 1999,
ch. 9), and an effect shows there long before it shows in the free run. They are low-passed first:
what the frame's vibration puts into gyro and command alike would look like an effect of the
command. Standard errors stay robust: blocks of time are clusters.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import signal

from quad_sysid.contract import FloatArray
from quad_sysid.greybox.covariance import BLOCK_S
from quad_sysid.greybox.fit import RUNAWAY, Fit
from quad_sysid.greybox.simulate import Simulator
from quad_sysid.greybox.structure import Structure

STEP = 1e-3
"""Share of a parameter's scale by which it is moved for its derivative."""
BAND_HZ = 12.0
"""Beyond this the one-step errors are vibration more than motion."""
AGREES = 1.01
"""The free-run error may grow by this much when the one-step estimates are taken."""
ABRUPT = ('time', 'duration')
"""Parameters on which the errors do not depend smoothly: these stay as the free run has them."""
ITERATIONS = 2
"""Gauss-Newton from the free run's optimum, which is near."""


@dataclass(frozen=True, eq=False)
class Linear:
    """Least squares of errors (m,) on columns (m, p), with robust standard errors."""

    shift: FloatArray
    """(p,) what is to be added to the parameters."""
    covariance: FloatArray
    """(p, p)"""
    blocks: int


@dataclass(frozen=True, eq=False)
class OneStep:
    """Estimates from the one-step errors of the training spans."""

    theta: FloatArray
    """(p,)"""
    covariance: FloatArray
    """(p, p) robust; NaN rows for parameters that a bound holds."""
    blocks: int

    @property
    def std(self) -> FloatArray:
        """(p,) standard errors."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def one_step(sim: Simulator, fit: Fit) -> OneStep:
    """Refine a free-run fit on the one-step errors of the simulator's spans."""
    specs = fit.structure.specs
    lower, upper = np.array([s.lower for s in specs]), np.array([s.upper for s in specs])
    bends = np.array([s.name not in ABRUPT for s in specs])
    free = np.flatnonzero(~fit.at_bound & bends)
    theta = fit.theta.copy()
    for _ in range(ITERATIONS):
        errors = slow_errors(sim, fit.structure, theta)
        jacobian = slow_jacobian(sim, fit.structure, theta, errors, free)
        found = least_squares(jacobian, errors, block_of_rows(sim), oversampling(sim))
        theta[free] = np.clip(theta[free] + found.shift, lower[free], upper[free])
    covariance = np.full((theta.size, theta.size), np.nan)
    covariance[np.ix_(free, free)] = found.covariance
    return OneStep(theta, covariance, found.blocks)


def sharpened(sim: Simulator, fit: Fit) -> Fit:
    """The fit with the one-step estimates, where the free run agrees with them; else as it is.

    Both are right where the structure is, and the one-step ones are sharper; where it is not they
    differ, and the free run's are kept (the idea of Hausman's test, 1978). A curve's prior belongs
    to the free run: such a fit stays as well.
    """
    if fit.prior.size:
        return fit
    found = one_step(sim, fit)
    errors = sim.run(fit.structure, found.theta).errors
    if not np.isfinite(errors).all() or np.sqrt(np.mean(errors**2)) > AGREES * fit.rms:
        return fit
    covariance = found.covariance.copy()
    kept = np.flatnonzero(np.isnan(np.diag(covariance)) & ~fit.at_bound)
    covariance[kept, kept] = np.diag(fit.covariance)[kept]
    apart = np.isnan(covariance) & ~(fit.at_bound[:, None] | fit.at_bound)
    covariance[apart] = 0.0
    unseen = ~fit.jacobian.any(axis=(0, 1))  # no sample depends on it: there is no error to quote
    covariance[unseen] = covariance[:, unseen] = np.nan
    return replace(fit, theta=found.theta, errors=errors, sharp=covariance)


def slow_errors(sim: Simulator, structure: Structure, theta: FloatArray) -> FloatArray:
    """(m,) low-passed one-step errors of all spans, one after the other."""
    return slow(sim, sim.run(structure, theta).innovations)


def slow(sim: Simulator, innovations: FloatArray) -> FloatArray:
    """The same of innovations (n,) that are there already."""
    tame = np.clip(np.nan_to_num(innovations), -RUNAWAY, RUNAWAY)
    parts = [tame[a + 1 : b] for a, b in sim.spans]
    if 0.4 / sim.data.dt <= BAND_HZ:
        return np.concatenate(parts)
    sections = signal.butter(4, BAND_HZ, fs=1.0 / sim.data.dt, output='sos')
    return np.concatenate([signal.sosfilt(sections, part) for part in parts])


def slow_jacobian(
    sim: Simulator, structure: Structure, theta: FloatArray, errors: FloatArray,
    free: np.ndarray,
) -> FloatArray:
    """(m, k) derivatives of the low-passed one-step errors by the parameters `free` (k,)."""
    specs = structure.specs
    out = np.empty((errors.size, free.size))
    for column, i in enumerate(free):
        scale = max(0.1 * abs(float(theta[0])), 1e-6) if i == 0 else specs[i].scale
        h = STEP * scale if theta[i] + STEP * scale <= specs[i].upper else -STEP * scale
        moved = theta.copy()
        moved[i] += h
        out[:, column] = (slow_errors(sim, structure, moved) - errors) / h
    return np.nan_to_num(out)


def block_of_rows(sim: Simulator) -> np.ndarray:
    """(m,) number of the block of time each one-step error lies in."""
    rows = np.concatenate([np.arange(a + 1, b) for a, b in sim.spans])
    block = (rows * sim.data.dt // BLOCK_S).astype(np.int64)
    return np.unique(block, return_inverse=True)[1].reshape(-1)


def oversampling(sim: Simulator) -> float:
    """How many low-passed samples hold what one independent sample would."""
    return max(1.0, 0.5 / (sim.data.dt * BAND_HZ))


def least_squares(
    jacobian: FloatArray, errors: FloatArray, block: np.ndarray, oversampled: float
) -> Linear:
    """One Gauss-Newton step from errors (m,) and jacobian (m, p); block (m,) as clusters.

    Each standard error is the larger one of the clustered one and that of noise that is white up
    to the low-pass (`oversampled` samples of it count as one).
    """
    p = jacobian.shape[1]
    size = np.linalg.norm(jacobian, axis=0)
    size[size == 0.0] = 1.0
    stacked = np.column_stack([jacobian / size, errors])
    triangle: FloatArray = np.asarray(np.linalg.qr(stacked, mode='r'))
    inverse = np.linalg.pinv(triangle[:p, :p]) / size[:, None]
    bread = inverse @ inverse.T
    shift = -(inverse * size[:, None] @ triangle[:p, p]) / size
    left = errors + jacobian @ shift
    white = oversampled * float(left @ left) / max(left.size - p, 1) * bread
    count = int(block.max()) + 1
    summed = np.stack(
        [np.bincount(block, jacobian[:, i] * left, minlength=count) for i in range(p)], axis=1
    )
    robust = count / max(count - p, 1) * bread @ (summed.T @ summed) @ bread
    larger = np.sqrt(np.maximum(np.diag(white) / np.maximum(np.diag(robust), 1e-30), 1.0))
    return Linear(shift, robust * np.outer(larger, larger), count)
