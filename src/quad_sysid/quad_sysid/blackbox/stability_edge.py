"""The edge of stability in a descent: roots of C and F that the data pull onto the unit circle.

A drift that the command does not explain pulls a pole of F there, and the least loss among stable
models then lies on the edge. Here: which roots are held, and what stays free. The descent itself
stands in descent.py.
"""

from __future__ import annotations

import numpy as np

from quad_sysid.blackbox.polynomial import Model
from quad_sysid.blackbox.start_values import EDGE
from quad_sysid.contract import FloatArray

ON_EDGE = 1.0 - 2.0 * (1.0 - EDGE)
"""Radius from which a root counts as held at EDGE, where it was pulled to."""


def pulled(model: Model) -> Model:
    """The model with roots of C and F beyond EDGE pulled back to it; itself where there are none.

    Not reflected as by `stabilised`, so that a step too far ends at the edge.
    """
    c, f = _pulled(model.C), _pulled(model.F)
    if c is model.C and f is model.F:
        return model
    theta = np.concatenate((model.A[1:], model.B[model.nk :], c[1:], model.D[1:], f[1:]))
    return model.with_parameters(theta)


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
        inner = np.real(np.poly([z for z in roots if _elsewhere(z, edge)]))
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
    return (
        np.array([1.0, -2.0 * radius * turn, radius**2]),
        np.array([0.0, -2.0 * turn, 2.0 * radius]),
    )


def _elsewhere(root: complex, edge: FloatArray) -> bool:
    """Whether the root is none of those at the edge, nor the conjugate of one."""
    return not any(root in (one, np.conj(one)) for one in edge)


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
