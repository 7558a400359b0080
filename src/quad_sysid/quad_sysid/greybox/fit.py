"""Fit a structure by its free run over training windows, with standard errors that hold.

The criterion is the contract's own error, so a base fitted here is the best base in that metric.
The state correction (Kalman gain) is chosen on the training data too, by the same criterion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
from scipy import stats

from quad_sysid.contract import FloatArray
from quad_sysid.errors import NotInformativeError
from quad_sysid.greybox import levenberg, noise
from quad_sysid.greybox.covariance import block_numbers, robust_covariance
from quad_sysid.greybox.data import WINDOW_S, AxisData, Span, Windows
from quad_sysid.greybox.simulate import N_BASE, Simulator
from quad_sysid.greybox.structure import BASE_PARAMETERS, Effect, Settings, Structure

RUNAWAY = 1e6
"""A free run this far off has left the aircraft behind, rad/s; nothing beyond it is told apart."""
FIRST_STEPS = 3
"""Iterations from each of several starts."""
SETTLED_S = 1.0
"""Each span begins with a guess of the state: innovations count from here on."""
SAME_AS_NONE = 0.25
"""A lag or delay of less than this share of a cycle is told as none."""
LEAST_WINDOWS = 8
CLEAR_GAIN = 4.0
"""A gain of fewer standard errors than this is no answer."""
SHORT_WINDOW_S = 0.05
"""Windows for data in which half a second of free run drowns in noise: delay still shows."""

RATIOS = np.logspace(-1.0, 4.0, 11)
"""Torque noise over measurement noise tried for the state correction, (rad/s²)/√Hz per rad/s."""


@dataclass(frozen=True, eq=False)
class Fit:
    """A fitted structure on training windows."""

    structure: Structure
    theta: FloatArray
    """(p,) in the order of structure.names."""
    jacobian: FloatArray
    """(windows, length, p) of the free-run error."""
    errors: FloatArray
    """(windows, length) free-run error on the training windows, rad/s."""
    converged: bool
    iterations: int
    at_bound: np.ndarray
    prior: FloatArray
    """(r, p) rows of the effects' priors, in the unit of the errors."""
    windows: Windows
    dt: float
    sharp: FloatArray | None = None
    """(p, p) covariance of a fit that the one-step errors have sharpened (one_step.py)."""

    @property
    def rms(self) -> float:
        """Training RMS of the free-run error, rad/s."""
        return float(np.sqrt(np.mean(self.errors**2)))

    @cached_property
    def covariance(self) -> FloatArray:
        """(p, p) robust; NaN rows and columns for parameters held at a bound."""
        return self._covariance(self.at_bound) if self.sharp is None else self.sharp

    @cached_property
    def reach(self) -> FloatArray:
        """(p,) standard errors as if no bound held anything: how far one at a bound may lie."""
        full = self._covariance(np.zeros_like(self.at_bound))
        return np.sqrt(np.maximum(np.diag(full), 0.0))

    def _covariance(self, held: np.ndarray) -> FloatArray:
        return robust_covariance(
            self.jacobian, self.errors, held, self.windows, self.dt, self.prior
        )

    @property
    def std(self) -> FloatArray:
        """(p,) standard errors, NaN at a bound."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    def noise_rms(self, model: noise.NoiseModel) -> float:
        """RMS of the measurement noise, rad/s; by the innovations where windows are too short."""
        found = noise.measured_noise(self.errors, self.dt)
        return model.measurement_rms if found is None else found

    @property
    def freedom(self) -> int:
        """Blocks of windows less free parameters: what the standard errors rest on."""
        blocks = int(block_numbers(self.windows, self.dt).max(initial=0)) + 1
        return max(blocks - int((~self.at_bound).sum()), 2)

    @property
    def quoted(self) -> float:
        """Factor on standard errors with which +-1.96 of them hold 95 % (Student's t)."""
        return float(stats.t.ppf(0.975, self.freedom) / stats.norm.ppf(0.975))


def simulator(
    data: AxisData, spans: Sequence[Span], correction: FloatArray, length_s: float = WINDOW_S
) -> Simulator:
    """A simulator over the windows of `spans`."""
    return Simulator(data, tuple(spans), data.windows(spans, length_s), correction)


def fit_structure(
    sim: Simulator,
    structure: Structure,
    start: FloatArray,
    *,
    max_iterations: int = 40,
    free: np.ndarray | None = None,
    tolerance: float = 1e-6,
) -> Fit:
    """Least squares of the free-run error from `start` (p,); `free` (p,) False holds a value.

    `tolerance` of the sum of squares ends it.
    """
    specs = structure.specs
    lower = np.array([s.lower for s in specs])
    upper = np.array([s.upper for s in specs])
    scale = np.array([s.scale for s in specs])
    scale[0] = max(abs(start[0]) * 0.1, 1e-6)
    index = np.arange(start.size) if free is None else np.flatnonzero(free)
    full = np.array(start, dtype=float)
    rows = structure.prior()
    weight = sim.run(structure, full).rms if rows.size else 0.0
    prior = rows * (weight if np.isfinite(weight) else 1.0)

    def residual(part: FloatArray) -> FloatArray:
        theta = full.copy()
        theta[index] = part
        errors: FloatArray = sim.run(structure, theta).errors.ravel()
        if not (np.abs(errors) < RUNAWAY).all():  # NaN included
            return np.full(errors.size + prior.shape[0], RUNAWAY)
        return np.concatenate([errors, prior @ theta]) if prior.size else errors

    found = levenberg.minimise(
        residual, full[index], lower[index], upper[index], scale[index],
        max_iterations=max_iterations, tolerance=tolerance,
    )
    theta = full.copy()
    theta[index] = found.theta
    # so near a bound no ordinary standard error exists
    near = 1e-3 * scale
    near[1:3] = np.maximum(near[1:3], SAME_AS_NONE * sim.data.dt)
    close = (theta - lower <= near) | (upper - theta <= near)
    theta = np.where(theta - lower <= near, lower, theta)
    shape = (sim.windows.count, sim.windows.length)
    count = shape[0] * shape[1]
    flat = np.zeros((count, theta.size))
    flat[:, index] = found.jacobian[:count]
    at_bound = np.ones(theta.size, dtype=bool)
    at_bound[index] = found.at_bound | close[index]
    if free is None and (at_bound & ~found.at_bound)[1:3].any():
        # lag and delay are one where they are short: without the one, fit the other again
        return fit_structure(sim, structure, theta, max_iterations=max_iterations, free=~at_bound)
    jacobian = flat.reshape(*shape, theta.size)
    errors = found.residual[:count].reshape(shape)
    if at_bound.any():
        jacobian[:, :, at_bound] = _inside(sim, structure, theta, at_bound, lower, scale)
    return Fit(
        structure=structure,
        theta=theta,
        jacobian=jacobian,
        errors=errors,
        converged=found.converged,
        iterations=found.iterations,
        at_bound=at_bound,
        prior=prior,
        windows=sim.windows,
        dt=sim.data.dt,
    )


def _inside(
    sim: Simulator, structure: Structure, theta: FloatArray, held: np.ndarray,
    lower: FloatArray, scale: FloatArray,
) -> FloatArray:
    """(windows, length, k) derivatives by parameters at a bound, a step to its inside."""
    base = sim.run(structure, theta).errors
    columns = []
    for i in np.flatnonzero(held):
        moved = theta.copy()
        step = 0.1 * scale[i] * (1.0 if theta[i] - lower[i] <= scale[i] else -1.0)
        moved[i] += step
        column = (sim.run(structure, moved).errors - base) / step
        columns.append(column if (np.abs(column) < RUNAWAY).all() else np.zeros_like(column))
    return np.stack(columns, axis=2)


def fit_base(
    data: AxisData, spans: Sequence[Span], length_s: float = WINDOW_S
) -> tuple[Fit, noise.NoiseModel, Simulator]:
    """The contract's base on `spans`, from several starts, with its state correction.

    `length_s` of the free-run windows: the contract's, or shorter where noise has the better of
    them (`informative`). Raises NotInformativeError where the spans are too short or not excited.
    """
    check_training(data, spans, length_s)
    base = Structure()
    model = noise.white_noise_model(3.0, 0.3, data, before_filter=False)
    sim = simulator(data, spans, model.correction, length_s)
    best: Fit | None = None
    short = length_s < WINDOW_S
    # short windows cannot tell a lag from a delay: there the lag stays at none
    free = np.arange(len(BASE_PARAMETERS)) != 1 if short else None
    for lag in (0.0,) if short else BASE_PARAMETERS[1].starts:
        for delay in BASE_PARAMETERS[2].starts:
            start = np.array([1.0, lag, delay, 0.5, 0.0])
            start[[0, 3, 4]] = _linear_start(sim, base, start)
            fit = fit_structure(sim, base, start, max_iterations=6, free=free)
            if best is None or fit.rms < best.rms:
                best = fit
    assert best is not None  # noqa: S101 - both start lists hold values
    return settle(sim, best, free)


def check_training(
    data: AxisData, spans: Sequence[Span], length_s: float = WINDOW_S
) -> None:
    """Refuse, by NotInformativeError, what no fit can answer: too short, or nothing moves."""
    count = data.windows(spans, length_s).count
    if count < LEAST_WINDOWS:
        raise NotInformativeError(
            f'{data.axis}: training holds {count} windows of {length_s:g} s, at least '
            f'{LEAST_WINDOWS} are needed; fly a longer excitation or widen --train'
        )
    command = np.concatenate([data.command[a:b] for a, b in spans])
    rate = np.concatenate([data.rate[a:b] for a, b in spans])
    if np.ptp(command) < 1e-9:
        raise NotInformativeError(
            f'{data.axis}: the command never moves during training; excite this axis'
        )
    if np.ptp(rate) < 1e-9:
        raise NotInformativeError(
            f'{data.axis}: the measured rate is constant during training; '
            'check the gyro and that the axis is free to turn'
        )


def informative(fit: Fit) -> bool:
    """Whether the data say at least that the command turns the axis, and which way.

    A delay or damping at its upper bound is what feedback read backwards looks like.
    """
    upper = np.array([spec.upper for spec in BASE_PARAMETERS])
    bounded = [2, 3]
    if (fit.theta[bounded] >= 0.99 * upper[bounded]).any():
        return False
    return abs(float(fit.theta[0])) > CLEAR_GAIN * float(fit.std[0])


def settle(
    sim: Simulator, fit: Fit, free: np.ndarray | None = None
) -> tuple[Fit, noise.NoiseModel, Simulator]:
    """Choose the state correction for a structure, then finish the fit with it; twice."""
    model = best_correction(sim, fit)
    for _ in range(2):
        sim = sim.corrected(model.correction)
        fit = fit_structure(sim, fit.structure, fit.theta, free=free)
        again = best_correction(sim, fit)
        if np.allclose(again.correction, model.correction, rtol=0.05):
            break
        model = again
    return fit, model, sim


def best_correction(sim: Simulator, fit: Fit) -> noise.NoiseModel:
    """The Kalman gain with the smallest free-run error on the training windows."""
    data = sim.data
    lead = round(SETTLED_S / data.dt)

    def score(exponent: float, before_filter: bool) -> tuple[float, noise.NoiseModel]:
        model = noise.white_noise_model(
            10.0**exponent, float(fit.theta[3]), data, before_filter=before_filter
        )
        run = sim.corrected(model.correction).run(fit.structure, fit.theta)
        rms = run.rms
        if not np.isfinite(rms):
            return rms, model
        parts = [run.innovations[a + lead : b] for a, b in sim.spans]
        settled = np.concatenate([part for part in parts if part.size] or [run.innovations])
        settled = settled[np.isfinite(settled)]
        return rms, noise.scaled(model, float(np.sqrt(np.mean(settled**2))))

    # where the noise enters hardly shows in the free run, but clearly in the one-step error
    kinds: list[tuple[float, float, bool]] = []
    for kind in (False, True) if data.gyro_filter_hz else (False,):
        coarse = [(score(float(x), kind), float(x)) for x in np.log10(RATIOS)]
        finite = [(found, x) for found, x in coarse if np.isfinite(found[0])]
        smallest = min(found[1].innovation_rms for found, _ in finite)
        centre = min(finite, key=lambda item: item[0][0])[1]
        kinds.append((smallest, centre, kind))
    _, centre, kind = min(kinds)
    fine = [score(centre + shift, kind) for shift in (-0.33, -0.17, 0.0, 0.17, 0.33)]
    return min(fine, key=lambda item: item[0])[1]


def fit_with_effect(
    sim: Simulator, base: Fit, effect: Effect, settings: Settings, *, max_iterations: int = 30,
    start: FloatArray | None = None, hopeless: float = float('inf'), tolerance: float = 1e-6,
) -> Fit:
    """Base and one more effect fitted together, from `start` (p,) or every start it names.

    Several starts are tried for a few steps only; the best is carried to its minimum, unless its
    RMS is still above `hopeless`.
    """
    structure = base.structure.with_effect(effect, settings)

    def refined(theta: FloatArray, iterations: int) -> Fit:
        return fit_structure(
            sim, structure, theta, max_iterations=iterations, tolerance=tolerance
        )

    if start is not None:
        return refined(start, max_iterations)
    if effect.starts is not None:
        starts = effect.starts(sim, base, effect)
    else:
        starts = tuple(product(*(spec.starts for spec in effect.parameters)))
    short = FIRST_STEPS if len(starts) > 1 else max_iterations
    tried = [
        refined(np.r_[base.theta, values], short)
        for values in starts
    ]
    best = min(tried, key=lambda fit: fit.rms)
    if len(starts) > 1 and not best.converged and best.rms <= hopeless:
        best = refined(best.theta, max_iterations)
    return best


def _linear_start(sim: Simulator, base: Structure, start: FloatArray) -> FloatArray:
    """Gain, damping and bias for given lag and delay, by one linear solve from small values."""
    theta = start.copy()
    theta[[0, 3, 4]] = [0.0, 0.3, 0.0]
    zero = sim.run(base, theta).errors.ravel()
    columns = []
    for index, step in ((0, 1.0), (4, 1e-3)):
        moved = theta.copy()
        moved[index] += step
        columns.append((sim.run(base, moved).errors.ravel() - zero) / step)
    solution = np.linalg.lstsq(np.stack(columns, axis=1), -zero, rcond=None)[0]
    return np.array([solution[0], 0.3, solution[1]])


__all__ = [
    'N_BASE', 'SHORT_WINDOW_S', 'Fit', 'best_correction', 'check_training', 'fit_base',
    'fit_structure', 'fit_with_effect', 'informative', 'settle', 'simulator',
]
