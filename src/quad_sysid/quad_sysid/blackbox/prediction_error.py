"""ARMAX, OE and BJ by the prediction error method: Gauss-Newton with exact gradients.

One start value, and a test of the minimum that it leads to: its loss is compared with what a
high-order ARX model reaches. Only where that is lower, other start values are tried
(start_values.py). Roots of C and F may be pulled to the edge of stability: a drift that the
command does not explain pulls a pole of F there, and the least loss among stable models then lies
on the edge.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import chain

import numpy as np

from quad_sysid.blackbox.constants import EXACT, ROUNDING
from quad_sysid.blackbox.innovations import errors_and_gradient
from quad_sysid.blackbox.model import Model
from quad_sysid.blackbox.regression import check_exciting, check_informative, check_orders
from quad_sysid.blackbox.residuals import spread_of
from quad_sysid.blackbox.start_values import (
    EDGE,
    HighOrder,
    armax_starts,
    bj_starts,
    high_order,
    oe_starts,
    reinserted,
)
from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.qr import upper
from quad_sysid.record import IOData

PATIENCE = 5
"""Iterations before a descent is measured against one before it."""
HOPE = 20.0
"""Multiple of what the next step promises that a descent may still lower the squares."""
TOLERANCE = 1e-3
"""Converged where the next step would lower N ln V by less than this."""
DAMPINGS = (1e-6, 1e-2, 1.0)
"""Tried in turn where the plain Gauss-Newton direction gives no descent."""
DOUBTFUL = 1.1
"""Loss of a start, against that of its minimum, from which another minimum may be lower."""
OVERSHOT = 0.2
"""Slope behind a full step, against that before it, from which a shorter one is tried."""
WANDERS = 0.02
"""Power of the residual's changes, against its own, below which it wanders as with a drift."""

EDGE_WARNINGS = {
    'F': 'a pole is held at the edge of stability (an integrator): the rate drifts in a way that '
    'the command does not explain',
    'C': 'a zero of the noise model is held at the unit circle: the residual lacks that frequency',
}
"""Polynomial → meaning of a root at the edge of stability."""


def armax(z: IOData, na: int, nb: int, nc: int, nk: int, *, start: Model | None = None) -> Model:
    """Fit A y = B u + C e over all segments.

    Orders as in MATLAB; `start` replaces the own start values. C is kept stable. Raises
    BadInputError for orders or data that cannot carry the fit; `converged` says how it ended.
    """
    orders = check_orders('armax', na=na, nb=nb, nc=nc, nk=nk)
    check_informative('armax', z, na + nb + nc, max(na, nk + nb - 1))
    check_exciting('armax', z, nb)
    return _fit('ARMAX', orders, z, start, lambda ho: armax_starts(ho, na, nb, nc))


def oe(z: IOData, nb: int, nf: int, nk: int, *, start: Model | None = None) -> Model:
    """Fit y = (B/F) u + e, the least free-run error, over all segments. F is kept stable.

    The covariance allows for a coloured residual. Otherwise as `armax`.
    """
    orders = check_orders('oe', nb=nb, nf=nf, nk=nk)
    check_informative('oe', z, nb + nf, nk + nb - 1 + nf)
    check_exciting('oe', z, nb + nf)
    return _fit('OE', orders, z, start, lambda ho: oe_starts(ho, nb, nf))


def bj(z: IOData, nb: int, nc: int, nd: int, nf: int, nk: int, *,
       start: Model | None = None) -> Model:
    """Fit y = (B/F) u + (C/D) e over all segments. C and F are kept stable. As `armax`."""
    orders = check_orders('bj', nb=nb, nc=nc, nd=nd, nf=nf, nk=nk)
    check_informative('bj', z, nb + nc + nd + nf, nk + nb - 1 + nd + nf)
    check_exciting('bj', z, nb + nf)
    return _fit('BJ', orders, z, start, lambda ho: bj_starts(ho, nb, nc, nd, nf))


def _fit(structure: str, orders: dict[str, int], z: IOData, start: Model | None,
         starts: Callable[[HighOrder], Iterator[Model]]) -> Model:
    """Fit from the given start, or from the own ones until the loss is as low as expected."""
    if start is not None:
        _check_start(structure, orders, start)
        best = descend(evaluate(start, z), lambda model: evaluate(model, z))
    else:
        ho = high_order(z, orders['nk'], sum(orders.values()) - orders['nk'])
        best = _lowest(starts(ho), ho)
    model = with_covariance(best)
    return replace(model, structure=structure, orders=orders, warnings=_warnings(best, model))


def _check_start(structure: str, orders: dict[str, int], start: Model) -> None:
    """Raise BadInputError where the start's polynomials do not have the orders asked for."""
    sizes = {'na': start.A.size - 1, 'nb': start.B.size - start.nk, 'nc': start.C.size - 1,
             'nd': start.D.size - 1, 'nf': start.F.size - 1, 'nk': start.nk}
    for name, size in sizes.items():
        if size != orders.get(name, 0):
            raise BadInputError(structure.lower(),
                                f'start must have {name} = {orders.get(name, 0)}', size)


def _warnings(point: Point, model: Model) -> tuple[str, ...]:
    """Warnings for the user of the fit."""
    warnings = [EDGE_WARNINGS[name] for name in point.on_edge]
    if not model.converged:
        warnings.insert(0, f'did not converge in {model.iterations} iterations')
    if model.covariance is None:
        warnings.append('the data do not determine all parameters: no standard errors')
    return tuple(warnings)


@dataclass(frozen=True)
class Point:
    """The criterion at one model: e, and what is left of J beside the nuisance, by segment."""

    model: Model
    errors: list[FloatArray]
    gradients: list[FloatArray]
    hessian: FloatArray
    """(p, p) JᵀJ."""
    slope: FloatArray
    """(p,) Jᵀe."""
    squares: float
    """Sum of squared errors; inf where there are none, or it or its derivatives overflowed."""
    rounding: float = 0.0
    """Sum of squares that rounding alone makes."""
    edge: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    """(m, p) how the radius of each root at the edge of stability grows with the parameters."""
    on_edge: tuple[str, ...] = ()
    """Names of the polynomials, of C and F, that have such a root."""


def point_of(model: Model, errors: list[FloatArray], gradients: list[FloatArray]) -> Point:
    """The criterion from its errors (m,) and gradients (m, p) by segment, without an edge."""
    p = model.parameters.size
    hessian, slope = np.zeros((p, p)), np.zeros(p)
    for e, gradient in zip(errors, gradients, strict=True):
        hessian += gradient.T @ gradient
        slope += gradient.T @ e
    total = float(sum(e @ e for e in errors))
    is_finite = math.isfinite(total) and np.isfinite(hessian).all() and np.isfinite(slope).all()
    if not errors or not is_finite:
        return Point(model, errors, gradients, np.zeros((p, p)), np.zeros(p), math.inf)
    return Point(model, errors, gradients, hessian, slope, total)


def evaluate(model: Model, z: IOData) -> Point:
    """The criterion with the initial states eliminated; C and F are made stable before."""
    p, nf, nd = model.parameters.size, model.F.size - 1, model.D.size - 1
    (c, at_c), (f, at_f) = _bounded(model.C), _bounded(model.F)
    if c is not model.C or f is not model.F:
        model = replace(model, C=c, F=f)
    errors, gradients = [], []
    with np.errstate(over='ignore', invalid='ignore'):
        for e, gradient, basis in errors_and_gradient(model, z):
            errors.append(e)
            gradients.append(gradient - (gradient.T @ basis @ basis.T).T)
        point = point_of(model, errors, gradients)
    edge = np.zeros((len(at_c) + len(at_f), p))
    edge[: len(at_c), p - nf - nd - c.size + 1 : p - nf - nd] = at_c
    edge[len(at_c) :, p - nf :] = at_f
    power = sum(float(z.y[start:stop] @ z.y[start:stop]) for start, stop in z.segments)
    return replace(point, rounding=EXACT * power, edge=edge,
                   on_edge=tuple(name for name, roots in (('C', at_c), ('F', at_f)) if len(roots)))


def _bounded(poly: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Poly with its roots pulled back to EDGE, and how the radii of those at the edge grow.

    The second is (m, n) by the coefficients of q⁻¹, q⁻², …, scaled; one row for a pair of roots.
    """
    n = poly.size - 1
    if not n or not np.isfinite(poly).all():
        return poly, np.zeros((0, n))
    roots = np.roots(poly)
    radius = np.abs(roots)
    if (radius > EDGE).any():
        roots = roots * np.minimum(1.0, EDGE / np.maximum(radius, EDGE))
        poly = np.real(np.poly(roots))
    edge_roots = roots[(1.0 - radius < 2.0 * (1.0 - EDGE)) & (roots.imag >= 0.0)]
    if not edge_roots.size:
        return poly, np.zeros((0, n))
    turn = np.conj(edge_roots * np.polyval(np.polyder(poly), edge_roots))
    growth = -np.real(turn[:, None] * edge_roots[:, None] ** np.arange(n - 1, -1, -1))
    size = np.linalg.norm(growth, axis=1, keepdims=True)
    return poly, growth / np.where(size > 0.0, size, 1.0)


def descend(point: Point, at: Callable[[Model], Point], bar: float = math.inf) -> Point:
    """Gauss-Newton with line search from `point` to the nearest minimum of the criterion `at`.

    Given up where even a multiple of what the next step promises stays above the squares `bar`.
    """
    converged, iteration = False, 0
    rows = sum(e.size for e in point.errors)
    while iteration < 60 and math.isfinite(point.squares):
        iteration += 1
        free = _free(point)
        plain = _step(point, free)
        promised = float(point.slope @ plain)
        if rows * promised <= TOLERANCE * point.squares or point.squares <= point.rounding:
            converged = True
            break
        if iteration > PATIENCE and point.squares - HOPE * promised > bar:
            break
        steps = chain([plain], (_step(point, free, damping) for damping in DAMPINGS))
        candidates = (_search(point, step, at) for step in steps)
        lower = next((fit for fit in candidates if fit is not None), None)
        if lower is None:
            converged = rows * promised <= 100.0 * TOLERANCE * point.squares
            break
        point = lower
    return replace(point, model=replace(point.model, converged=converged, iterations=iteration,
                                        samples=rows, loss=point.squares / max(rows, 1)))


def _free(point: Point) -> FloatArray:
    """(p, m) orthonormal directions that carry no root across the edge of stability.

    A root that the plain step would carry outside keeps its radius; another is let go.
    """
    p = point.slope.size
    if not point.edge.size:
        return np.eye(p)
    fixed = point.edge[point.edge @ _step(point) < 0.0]
    if not fixed.size:
        return np.eye(p)
    _, sizes, turn = np.linalg.svd(fixed)
    return np.asarray(turn[int(np.sum(sizes > ROUNDING * sizes[0])) :].T)


def _step(point: Point, free: FloatArray | None = None, damping: float = 0.0) -> FloatArray:
    """Damped Gauss-Newton step (p,) along the `free` directions (p, m), to be subtracted."""
    free = np.eye(point.slope.size) if free is None else free
    hessian = free.T @ point.hessian @ free
    scale = _scale(hessian)
    values, vectors = np.linalg.eigh(hessian / np.outer(scale, scale))
    steep = values > ROUNDING * max(values[-1:], default=0.0)
    basis = vectors[:, steep]
    return np.asarray(
        free @ (basis @ ((basis.T @ (free.T @ point.slope / scale)) / (values[steep] + damping))
                / scale))


def inverse_of(point: Point) -> FloatArray:
    """(p, p) inverse of the Hessian, in the directions that are free and that the data show."""
    free = _free(point)
    hessian = free.T @ point.hessian @ free
    units = np.outer(_scale(hessian), _scale(hessian))
    inverse = np.linalg.pinv(hessian / units, rcond=ROUNDING, hermitian=True) / units
    return np.asarray(free @ inverse @ free.T)


def _scale(hessian: FloatArray) -> FloatArray:
    """(m,) units in which a Hessian (m, m) has a diagonal of ones."""
    scale = np.sqrt(np.diag(hessian))
    return np.asarray(np.where(scale > 0.0, scale, 1.0))


def _search(point: Point, step: FloatArray, at: Callable[[Model], Point]) -> Point | None:
    """Lower the criterion along -step: shorten by a parabola, or pull back where it went too far.

    None where no length lowers it.
    """
    theta, promised = point.model.parameters, float(point.slope @ step)
    length = 1.0
    while length > 1e-3:
        trial = at(point.model.with_parameters(theta - length * step))
        if trial.squares < point.squares:
            break
        rise = trial.squares - point.squares + 2.0 * length * promised
        length *= min(max(length * promised / rise, 0.1), 0.6) if rise > 0.0 else 0.5
    else:
        return None
    beyond = -float(trial.slope @ step) / promised
    if length < 1.0 or beyond < OVERSHOT:
        return trial
    return min(trial, at(point.model.with_parameters(theta - step / (1.0 + beyond))), key=_squares)


def _lowest(starts: Iterator[Model], ho: HighOrder) -> Point:
    """Descend from the first start, and from the others where its minimum is in doubt.

    In doubt is one that lies far below its start, or leaves a drift, unless its loss is as low as
    that of the high-order model. Then a nearly cancelling pair is tried in other places.
    """
    def at(model: Model) -> Point:
        return evaluate(model, ho.data)

    first = at(next(starts))
    best = descend(first, at)
    is_poor = not best.model.converged or first.squares > DOUBTFUL * best.squares or _wanders(best)
    if is_poor and best.model.loss > ho.loss_of(best.slope.size):
        for start in starts:
            best = min(best, descend(at(start), at, best.squares), key=_squares)
    trials = sorted((at(model) for model in reinserted(best.model)),
                    key=lambda trial: trial.squares - trial.slope @ _step(trial))
    for trial in trials[:3]:
        best = min(best, descend(trial, at, best.squares), key=_squares)
    return best


def _squares(point: Point) -> float:
    return point.squares


def _wanders(point: Point) -> bool:
    """Whether the residual is mostly a drift, which a pole near the edge may explain."""
    changes = [np.diff(e) for e in point.errors]
    return sum(float(d @ d) for d in changes) < WANDERS * point.squares


def with_covariance(point: Point) -> Model:
    """Attach noise variance and covariance (Ljung 1999, eq. 9.42) to what a descent has reached.

    Roots at the edge of stability have no spread: the covariance is that of the rest. Without a
    noise model it allows for a coloured residual: the gradient is shaped by the residual's filter.
    """
    n, p, free = sum(e.size for e in point.errors), point.slope.size, _free(point)
    model = replace(point.model, noise_variance=point.squares / (n - p), covariance=None)
    if not math.isfinite(point.squares):
        return model
    gradients = [g @ free for g in point.gradients]
    scale = _scale(free.T @ point.hessian @ free)
    r = upper(np.vstack([upper(g / scale) for g in gradients]))
    if r.shape[0] != free.shape[1] or ROUNDING * np.linalg.cond(r) > 1.0:
        return model
    inverse = free @ (np.linalg.solve(r, np.eye(r.shape[0])) / scale[:, None])
    if not model.C.size == model.D.size == model.A.size == 1:
        return replace(model, covariance=model.noise_variance * inverse @ inverse.T)
    weights = [g @ inverse @ inverse.T for g in point.gradients]
    return replace(model, covariance=spread_of(weights, point.errors))
