"""Gauss-Newton with exact gradients on the sum of squared one-step errors of any structure.

Roots of C and F may be pulled to the edge of stability: a drift that the command does not explain
pulls a pole of F there, and the least loss among stable models then lies on the edge. Which roots
are held, and what stays free, stands below the descent. No start values and no choice between
minima here (prediction_error.py).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from quad_sysid.blackbox.filters import filter_columns
from quad_sysid.blackbox.frequency import autocovariance
from quad_sysid.blackbox.innovations import errors_and_gradient, span
from quad_sysid.blackbox.polynomial import Model
from quad_sysid.blackbox.regression import upper
from quad_sysid.blackbox.residuals import AR_ORDER_MAX, whitener
from quad_sysid.blackbox.start_values import EDGE
from quad_sysid.contract import FloatArray
from quad_sysid.record import IOData

MAX_ITERATIONS = 60
DAMPINGS = (1e-13, 1e-6, 1e-2, 1.0)
"""Tried in turn where the plain Gauss-Newton direction gives no descent."""
TOLERANCE = 1e-3
"""Converged where the next step would lower N ln V by less than this."""
PATIENCE = 5
"""Iterations before a second descent is measured against the first."""
EXACT = 1e-18
"""Part of the output's power below which a residual is rounding, as with data free of noise."""
FLAT = 1e-13
"""Eigenvalue of a scaled Hessian, against the largest, below which it is rounding."""
SLOW = 0.2
"""Gauss-Newton is slow where a step leaves more than this part of what it promised."""


@dataclass(frozen=True)
class Point:
    """The criterion at one parameter vector: e, and what is left of J beside the nuisance."""

    errors: list[FloatArray]
    gradients: list[FloatArray]
    hessian: FloatArray
    slope: FloatArray


def sum_of_squares(point: Point) -> float:
    """Sum of squared errors; inf where it or its derivatives overflowed."""
    total = float(sum(e @ e for e in point.errors))
    known = np.isfinite(point.hessian).all() and np.isfinite(point.slope).all()
    return total if known and math.isfinite(total) else math.inf


def evaluate(model: Model, z: IOData) -> Point:
    """Errors, JᵀJ with the initial states eliminated, Jᵀe."""
    p = model.parameters.size
    hessian, slope = np.zeros((p, p)), np.zeros(p)
    errors, gradients = [], []
    with np.errstate(over='ignore', invalid='ignore'):
        for e, gradient, basis in errors_and_gradient(model, z):
            errors.append(e)
            gradients.append(gradient - basis @ (basis.T @ gradient) if basis.size else gradient)
            hessian += gradients[-1].T @ gradients[-1]
            slope += gradients[-1].T @ e
    return Point(errors, gradients, hessian, slope)


def without(gradient: FloatArray, states: FloatArray) -> FloatArray:
    """Columns `gradient` (m, p) without their part in the span of the initial states (m, nf)."""
    basis, _ = span(states)
    return np.asarray(gradient - basis @ (basis.T @ gradient))


def descend(model: Model, point: Point, z: IOData,
            bar: float = math.inf) -> tuple[Model, Point]:
    """Gauss-Newton with line search from `model` to the nearest minimum, and the criterion there.

    Given up early where even a multiple of what the next step promises stays above the loss `bar`.
    """
    converged, iteration, before = False, 0, math.inf
    curvature = np.zeros_like(point.hessian)
    rows = sum(e.size for e in point.errors)
    exact = EXACT * sum(float(z.y[start:stop] @ z.y[start:stop]) for start, stop in z.segments)
    if not math.isfinite(sum_of_squares(point)):
        return replace(model, converged=False, loss=math.inf, samples=rows), point
    while iteration < MAX_ITERATIONS:
        iteration += 1
        free = _free(model, point)
        local = _confined(point, free)
        promised = decrement(local)
        if rows * promised <= TOLERANCE * sum_of_squares(point) or sum_of_squares(point) <= exact:
            converged = True
            break
        if iteration > PATIENCE and sum_of_squares(point) - PATIENCE * promised > bar * rows:
            break
        onto = np.eye(curvature.shape[0]) if free is None else free @ free.T
        bent = None if promised <= SLOW * before else onto @ curvature @ onto
        ahead = _advance(model, local, z, bent)
        if ahead is None:
            converged = rows * promised <= 100.0 * TOLERANCE * sum_of_squares(point)
            break
        curvature = _secant(curvature, model, point, *ahead)
        before = promised
        model, point = ahead
    return replace(model, converged=converged, iterations=iteration, samples=rows,
                   loss=sum_of_squares(point) / rows), point


def _free(model: Model, point: Point) -> FloatArray | None:
    """(p, m) what may move where the plain step would carry a root across the edge; None: all."""
    if not on_edge(model):
        return None
    hessian, slope, scale = _scaled(point)
    return free_directions(model, -np.linalg.lstsq(hessian, slope, rcond=1e-13)[0] / scale)


def _confined(point: Point, free: FloatArray | None) -> Point:
    """The criterion as it is seen in the free directions (p, m) alone."""
    if free is None:
        return point
    onto = free @ free.T
    beside = np.eye(onto.shape[0]) - onto
    stiff = float(np.max(np.diag(point.hessian)))
    return replace(point, hessian=onto @ point.hessian @ onto + stiff * beside,
                   slope=onto @ point.slope)


def _advance(model: Model, point: Point, z: IOData,
             curvature: FloatArray | None) -> tuple[Model, Point] | None:
    """Go to a lower point: with the residual's curvature where given, else by Gauss-Newton."""
    if curvature is not None:
        _, slope, scale = _scaled(point)
        bent = _bent_step((point.hessian + curvature) / np.outer(scale, scale), slope)
        ahead = None if bent is None else _search(model, point, bent / scale, z)
        if ahead is not None:
            return ahead
    for damping in DAMPINGS:
        ahead = _search(model, point, _step(point, damping), z)
        if ahead is not None:
            return ahead
    return None


def _secant(curvature: FloatArray, model: Model, point: Point, ahead: Model,
            next_point: Point) -> FloatArray:
    """Update Σ e ∂²e, the part of the Hessian that Gauss-Newton leaves out.

    It matters where the structure cannot make the residual white (Dennis, Gay, Welsch 1981).
    """
    s = ahead.parameters - model.parameters
    y = next_point.slope - point.slope
    bent = next_point.slope - sum(
        (g.T @ e for g, e in zip(point.gradients, next_point.errors, strict=True)),
        np.zeros(s.size),
    )
    ys = float(y @ s)
    if ys <= 0.0:
        return curvature
    own = float(s @ curvature @ s)
    sized = curvature * min(1.0, abs(float(s @ bent)) / abs(own)) if own else curvature
    miss = bent - sized @ s
    turned = np.outer(miss, y) / ys
    return np.asarray(sized + turned + turned.T - float(miss @ s) / ys**2 * np.outer(y, y))


def _search(model: Model, point: Point, step: FloatArray, z: IOData) -> tuple[Model, Point] | None:
    """Lower the criterion along -step: shorten, or pull back a step that went too far."""
    sse, promised = sum_of_squares(point), float(point.slope @ step)
    length = 1.0
    while length > 1e-3:
        trial = pulled(model.with_parameters(model.parameters - length * step))
        ahead = evaluate(trial, z)
        if sum_of_squares(ahead) < sse:
            break
        rise = sum_of_squares(ahead) - sse + 2.0 * length * promised
        length *= min(max(length * promised / rise, 0.1), 0.6) if rise > 0.0 else 0.5
    else:
        return None
    beyond = -float(ahead.slope @ step) / promised
    if length == 1.0 and beyond > 0.2:
        middle = pulled(model.with_parameters(model.parameters - step / (1.0 + beyond)))
        back = evaluate(middle, z)
        if sum_of_squares(back) < sum_of_squares(ahead):
            return middle, back
    return trial, ahead


def _scaled(point: Point) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Unit-diagonal Hessian, slope in the same units, and the scale."""
    scale = np.sqrt(np.diag(point.hessian))
    scale[~(scale > 0.0)] = 1.0
    return point.hessian / np.outer(scale, scale), point.slope / scale, scale


def _step(point: Point, damping: float) -> FloatArray:
    """Damped Gauss-Newton step (p,), to be subtracted."""
    hessian, slope, scale = _scaled(point)
    values, vectors = np.linalg.eigh(hessian)
    raised = np.maximum(values, 0.0) + max(damping, FLAT * values[-1])
    return np.asarray(vectors @ ((vectors.T @ slope) / raised) / scale)


def _bent_step(full: FloatArray, slope: FloatArray) -> FloatArray | None:
    """Newton step of a Hessian (p, p) with curvature; None where it bends down or is flat.

    Flat is judged against its largest eigenvalue: a curvature far above the Gauss-Newton part
    leaves the small ones to rounding.
    """
    if not np.isfinite(full).all():
        return None
    values, vectors = np.linalg.eigh(full)
    if values[0] <= FLAT * max(values[-1], 1.0):
        return None
    return np.asarray(vectors @ ((vectors.T @ slope) / values))


def decrement(point: Point) -> float:
    """Decrease of the sum of squares that the undamped step promises."""
    hessian, slope, _ = _scaled(point)
    values, vectors = np.linalg.eigh(hessian)
    kept = values > FLAT * values[-1]
    return float(np.sum((vectors[:, kept].T @ slope) ** 2 / values[kept]))


def with_covariance(model: Model, point: Point) -> Model:
    """Attach noise variance and covariance (Ljung 1999, eq. 9.42) to what a descent has reached.

    Roots at the edge of stability have no spread: the covariance is that of the rest.
    """
    n, p = sum(e.size for e in point.errors), model.parameters.size
    sse = sum_of_squares(point)
    free = _free(model, point)
    kept = np.eye(p) if free is None else free
    own = [g @ kept for g in point.gradients]
    scale = np.sqrt(sum(np.einsum('ij,ij->j', g, g) for g in own))
    scale[scale == 0.0] = 1.0
    r = upper(np.vstack([upper(g / scale) for g in own]))
    covariance = None
    if r.shape[0] == kept.shape[1] and np.linalg.cond(r) < 1e12:
        inverse = kept @ (np.linalg.solve(r, np.eye(r.shape[0])) / scale[:, None])
        covariance = sse / (n - p) * inverse @ inverse.T
        if model.C.size == model.D.size == model.A.size == 1:
            covariance = _sandwich(point, inverse @ inverse.T)
    return replace(model, noise_variance=sse / (n - p), covariance=covariance)


def _sandwich(point: Point, bread: FloatArray) -> FloatArray:
    """Covariance under a coloured residual: the gradient shaped by the residual's own filter."""
    n = sum(e.size for e in point.errors)
    cov = autocovariance(point.errors, min(AR_ORDER_MAX, n // 10))
    ar = whitener(cov, n)
    power = float(ar @ cov[: ar.size]) * n / (n - bread.shape[0])
    shaped = [filter_columns(np.ones(1), ar, g) for g in point.gradients]
    filling = sum((g.T @ g for g in shaped), np.zeros_like(bread))
    return np.asarray(power * bread @ filling @ bread)


ON_EDGE = 1.0 - 2.0 * (1.0 - EDGE)
"""Radius from which a root counts as held at EDGE, where it was pulled to."""


def pulled(model: Model) -> Model:
    """The model with roots of C and F beyond EDGE pulled back to it; itself where there are none.

    Not reflected as by `stabilised`, so that a step too far ends at the edge.
    """
    c, f = _pulled(model.C), _pulled(model.F)
    if c is model.C and f is model.F:
        return model
    return replace(model, C=c, F=f)


def on_edge(model: Model) -> tuple[str, ...]:
    """Names of the polynomials, of C and F, that have a root at the edge."""
    return tuple(
        name for name in 'CF' if np.max(np.abs(_roots(getattr(model, name))), initial=0) > ON_EDGE
    )


def free_directions(model: Model, step: FloatArray) -> FloatArray | None:
    """(p, m) orthonormal directions in which the parameters may still move; None: in all.

    `step` (p,) is what the descent would go without the edge. A root that it would carry outside
    is held at the radius it has; one that it carries inside is let go.
    """
    names = on_edge(model)
    if not names:
        return None
    p, nf, nd = model.parameters.size, model.F.size - 1, model.D.size - 1
    ends = {'F': p, 'C': p - nf - nd}
    columns = np.eye(p)
    for name in names:
        poly, end = getattr(model, name), ends[name]
        rows = slice(end - poly.size + 1, end)
        kept = _kept(poly, step[rows])
        if kept is None:
            continue
        columns[rows] = 0.0
        columns[rows, rows.start : rows.start + kept.shape[1]] = kept
    columns = columns[:, np.any(columns != 0.0, axis=0)]
    return None if columns.shape[1] == p else columns


def _kept(poly: FloatArray, step: FloatArray) -> FloatArray | None:
    """(n, m) orthonormal directions of a monic polynomial's tail; None where no root is held."""
    roots = _roots(poly)
    edge = roots[(np.abs(roots) > ON_EDGE) & (roots.imag >= 0.0)]
    factors = [_factor(root) for root in edge]
    fixed = np.ones(1)
    for factor, _ in factors:
        fixed = np.convolve(fixed, factor)
    free = [_tail(fixed, poly.size, shift) for shift in range(1, poly.size - fixed.size + 1)]
    outward = []
    for i, root in enumerate(edge):
        rest = np.ones(1)
        for factor, _ in factors[:i] + factors[i + 1 :]:
            rest = np.convolve(rest, factor)
        inside = [z for z in roots if z not in edge and np.conj(z) not in edge]
        inner = np.real(np.poly(inside))
        rest = np.convolve(rest, np.atleast_1d(inner))
        outward.append(_tail(np.convolve(rest, factors[i][1]), poly.size))
        if root.imag > 0.0:
            turn = np.array([0.0, 2.0 * abs(root) * np.sin(np.angle(root)), 0.0])
            free.append(_tail(np.convolve(rest, turn), poly.size))
    basis = np.column_stack(free + outward)
    moves = np.linalg.lstsq(basis, step, rcond=None)[0][len(free) :]
    released = [column for column, move in zip(outward, moves, strict=True) if move < 0.0]
    if len(released) == len(outward):
        return None
    if not free and not released:
        return np.zeros((poly.size - 1, 0))
    return np.asarray(np.linalg.qr(np.column_stack(free + released))[0])


def _factor(root: complex) -> tuple[FloatArray, FloatArray]:
    """Real factor of a root (with its conjugate) and the factor's derivative by the radius."""
    radius, turn = abs(root), np.cos(np.angle(root))
    if root.imag == 0.0:
        return np.array([1.0, -root.real]), np.array([0.0, -np.sign(root.real)])
    return (np.array([1.0, -2.0 * radius * turn, radius**2]),
            np.array([0.0, -2.0 * turn, 2.0 * radius]))


def _tail(poly: FloatArray, size: int, shift: int = 0) -> FloatArray:
    """(size - 1,) coefficients of q⁻¹, q⁻², … of poly behind `shift` samples."""
    out = np.zeros(size)
    out[shift : shift + poly.size] = poly[: size - shift]
    return out[1:]


def _pulled(poly: FloatArray) -> FloatArray:
    roots = _roots(poly)
    radius = np.abs(roots)
    if (radius <= EDGE).all():
        return poly
    back = np.minimum(1.0, EDGE / np.maximum(radius, EDGE))
    moved = np.real(np.poly(roots * back))
    padded = np.zeros(poly.size)
    padded[: moved.size] = moved
    return padded


def _roots(poly: FloatArray) -> FloatArray:
    """Roots in the z plane, none where the coefficients overflowed."""
    if poly.size == 1 or not np.isfinite(poly).all():
        return np.zeros(0)
    return np.asarray(np.roots(poly))
