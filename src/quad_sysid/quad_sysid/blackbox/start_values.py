"""Start values for the prediction error method from one high-order ARX model.

That model is consistent in closed loop; each structure is then reached by linear least squares:
Steiglitz-McBride on its noise-free response (MORSM, Everitt, Galrinho, Hjalmarsson 2018) for B
and F, regression on its innovations (Hannan, Rissanen 1982) for A, C and D. No iteration on the
criterion itself belongs here.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import numpy as np
from scipy.linalg import toeplitz

from quad_sysid.blackbox.filters import filter_columns, filter_signal, pulses
from quad_sysid.blackbox.innovations import one_step_errors
from quad_sysid.blackbox.polynomial import Model, delayed, monic, polynomial_model
from quad_sysid.blackbox.regression import arx_blocks, lagged, upper, usable_rows
from quad_sysid.contract import FloatArray
from quad_sysid.record import IOData

ROUNDS = 12
SETTLED = 1e-4
"""Change of a coefficient of F from which further rounds are left to the descent."""
NEAR = 0.4
"""Distance in the z plane within which a pole and a zero count as cancelling."""
PLACES = (-0.7, -0.2, 0.3, 0.6, 0.8, 0.95)
EDGE = 1.0 - 1e-7
RIDGE = 1e-13
"""Added to the scaled normal equations of the high-order model: data without noise leave its
coefficients open, and then any that explain the data will do."""
SLOW_FACTOR = np.array([1.0, -0.9999])
"""Factor of a cancelling pole and zero, which a drift can separate."""


@dataclass(frozen=True)
class HighOrder:
    """The high-order ARX model of a record and its innovations."""

    model: Model
    data: IOData
    innovations: FloatArray
    """(n,) zero outside segments and before their first error."""


def high_order(z: IOData, nk: int, parameters: int) -> HighOrder:
    """ARX of order 20, more for large models, less where the record is short; nk given."""
    longest = max(stop - start for start, stop in z.segments)
    order = max(20, parameters)
    while order > 1 and (nk + order > longest // 4 or usable_rows(z, nk + order) < 10 * order):
        order //= 2
    blocks = arx_blocks(z, range(1, order + 1), range(nk, nk + order),
                        max(order, nk + order - 1))
    gram = sum((x.T @ x for x in blocks), np.zeros((2 * order + 1, 2 * order + 1)))
    scale = np.sqrt(np.maximum(np.diag(gram), np.finfo(float).tiny))
    gram = gram / np.outer(scale, scale) + RIDGE * np.eye(scale.size)
    theta = np.linalg.solve(gram[:-1, :-1], gram[:-1, -1]) * scale[-1] / scale[:-1]
    model = polynomial_model(delayed(theta[order:], nk), A=monic(theta[:order]), nk=nk, dt=z.dt)
    innovations, parts = np.zeros(z.y.size), one_step_errors(model, z)
    for part in parts:
        innovations[part.start : part.start + part.errors.size] = part.errors
    samples = sum(part.errors.size for part in parts)
    loss = float(innovations @ innovations) / samples
    return HighOrder(replace(model, samples=samples, loss=loss), z, innovations)


def stabilised(model: Model) -> Model:
    """Reflect roots of C and F that are not inside the unit circle."""
    c, f = inside(model.C), inside(model.F)
    if c is model.C and f is model.F:
        return model
    return replace(model, C=c, F=f)


def inside(poly: FloatArray) -> FloatArray:
    """Return poly with its roots reflected into the unit circle; itself where they are."""
    if poly.size == 1 or not np.isfinite(poly).all():
        return poly
    roots = np.roots(poly)
    radius = np.abs(roots)
    if (radius < 1.0).all():
        return poly
    reflected = np.where(radius < 1.0, roots, roots / np.maximum(radius, 1.0) ** 2)
    new = np.abs(reflected)
    reflected = np.where(new > EDGE, reflected / np.maximum(new, EDGE) * EDGE, reflected)
    padded = np.zeros(poly.size)
    found = np.real(np.poly(reflected))
    padded[: found.size] = found
    return padded


def armax_starts(ho: HighOrder, na: int, nb: int, nc: int) -> Iterator[Model]:
    """Start values by the regression on innovations; then A from each plant denominator."""
    theta = _regress(_joined(ho, na, nb, nc))
    yield _model(ho, A=monic(theta[:na]), B=theta[na : na + nb], C=monic(theta[na + nb :]))
    plain = _regress([block[:, [*range(na + nb), -1]] for block in _joined(ho, na, nb, 0)])
    yield _model(ho, A=monic(plain[:na]), B=plain[na:], C=monic(np.zeros(nc)))
    for b, f in _plants(ho, nb, na):
        c = _moving_average(ho, b, f, na, nc)
        yield _model(ho, A=f, B=b, C=c)


def oe_starts(ho: HighOrder, nb: int, nf: int) -> Iterator[Model]:
    """Start values from the plants B/F alone, and from one in which a pole is left to a drift."""
    plants = _plants(ho, nb, nf)
    for b, f in islice(plants, 2):
        yield _model(ho, B=b, F=f)
    if nb > 1 and nf > 1:
        z = ho.data  # in its changes a drift is small
        changes = [np.diff(np.column_stack((z.y[i:j], z.u[i:j])), axis=0) for i, j in z.segments]
        b, f = _steiglitz_mcbride(changes, nb - 1, nf - 1, ho.model.nk)
        yield _model(ho, B=np.convolve(b, SLOW_FACTOR), F=np.convolve(f, SLOW_FACTOR))
    for b, f in plants:
        yield _model(ho, B=b, F=f)


def bj_starts(ho: HighOrder, nb: int, nc: int, nd: int, nf: int) -> Iterator[Model]:
    """Start values from the plants B/F, each with the noise model of what it leaves."""
    for b, f in _plants(ho, nb, nf):
        c, d = _noise(ho, b, f, nc, nd)
        yield _model(ho, B=b, F=f, C=c, D=d)


def reinserted(model: Model) -> Iterator[Model]:
    """Move a nearly cancelling pole and zero of B/F (B/A) or C/D elsewhere, to several places.

    Such a pair is what nearly all false minima have; where it stands matters little to the
    criterion, so that the descent does not find the place where it matters.
    """
    plant = 'A' if model.F.size == 1 else 'F'
    for zeros, poles in (('B', plant), ('C', 'D')):
        num, den = getattr(model, zeros), getattr(model, poles)
        lead = num[model.nk :] if zeros == 'B' else num
        if lead.size < 2 or den.size < 2 or lead[0] == 0.0:
            continue
        z_roots, p_roots = np.roots(lead), np.roots(den)
        pairs = np.abs(z_roots[:, None] - p_roots[None, :])
        pairs[np.ix_(np.abs(z_roots.imag) > 1e-9, np.arange(p_roots.size))] = np.inf
        pairs[:, np.abs(p_roots.imag) > 1e-9] = np.inf
        i, j = np.unravel_index(int(np.argmin(pairs)), pairs.shape)
        if pairs[i, j] > NEAR:
            continue
        rest_z = lead[0] * np.real(np.poly(np.delete(z_roots, i)))
        rest_p = np.real(np.poly(np.delete(p_roots, j)))
        for place in PLACES:
            top, bottom = np.convolve(rest_z, [1.0, -place]), np.convolve(rest_p, [1.0, -place])
            if zeros == 'C':
                yield replace(model, C=top, D=bottom)
            elif plant == 'A':
                yield replace(model, B=delayed(top, model.nk), A=bottom)
            else:
                yield replace(model, B=delayed(top, model.nk), F=bottom)


def _model(ho: HighOrder, *, B: FloatArray, **others: FloatArray) -> Model:
    """Put the polynomials (B without its delay; A, C, D, F of 1 where not given) into a model."""
    plain = replace(ho.model, structure='', orders={}, B=delayed(B, ho.model.nk), covariance=None)
    polynomials: dict[str, Any] = {name: others.get(name, np.ones(1)) for name in 'ACDF'}
    return stabilised(replace(plain, **polynomials))


def _plants(ho: HighOrder, nb: int, nf: int) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Return B (without delay) and F by Steiglitz-McBride, on the model and on the data."""
    yield _reduced(ho, nb, nf)
    if nf:
        z, nk = ho.data, ho.model.nk
        parts = [np.column_stack((z.y[start:stop], z.u[start:stop])) for start, stop in z.segments]
        yield _steiglitz_mcbride(parts, nb, nf, nk)
        yield _steiglitz_mcbride(parts, nb, nf, nk, rounds=1)


def _reduced(ho: HighOrder, nb: int, nf: int) -> tuple[FloatArray, FloatArray]:
    """B, F nearest to the high-order model's response to the record's u, weighted by its A.

    The error (F Bho - B Aho) u / F has only as many unknowns as the polynomial in front of u has
    coefficients, so that the autocovariance of u / F stands for the record.
    """
    nk, b, f = ho.model.nk, np.zeros(nb), np.ones(1)
    size = max(ho.model.B.size + nf, ho.model.A.size + nk + nb - 1)
    columns = [_padded(ho.model.A, size, nk + i) for i in range(nb)]
    columns += [-_padded(ho.model.B, size, i) for i in range(1, nf + 1)]
    unknown = np.column_stack((*columns, _padded(ho.model.B, size)))
    for _ in range(ROUNDS if nf else 1):
        cov = np.zeros(size)
        for start, stop in ho.data.segments:
            u = filter_signal(np.ones(1), f, ho.data.u[start:stop])
            cov += np.correlate(np.append(u, np.zeros(size - 1)), u)
        values, vectors = np.linalg.eigh(toeplitz(cov))
        root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
        theta = _least_squares(root @ unknown)
        before, b, f = f, theta[:nb], inside(monic(theta[nb:]))
        if float(np.max(np.abs(_padded(before, nf + 1) - f), initial=0.0)) < SETTLED:
            break
    return b, f


def _padded(poly: FloatArray, size: int, lag: int = 0) -> FloatArray:
    """(size,) the coefficients of poly behind `lag` zeros."""
    return np.pad(poly, (lag, size - lag - poly.size))


def _steiglitz_mcbride(parts: list[FloatArray], nb: int, nf: int, nk: int,
                       rounds: int = ROUNDS) -> tuple[FloatArray, FloatArray]:
    """B, F that minimise the error of y = (B/F) u over parts (n, 2) of y, u, by fixed point.

    Each part's unknown start is fitted along, as pulses behind 1/F. One round is the ARX model.
    """
    one = f = np.ones(1)
    b = np.zeros(nb)
    lead = max(nf, nk + nb - 1)
    parts = [part for part in parts if part.shape[0] > lead]  # a shorter one holds no row
    if not parts:
        return b, monic(np.zeros(nf))
    for _ in range(rounds if nf else 1):
        factors = []
        for part in parts:
            n = part.shape[0]
            y, u, kick = filter_columns(one, f, np.column_stack((part, pulses(n, 1, lead)))).T
            rows = np.hstack((lagged(kick, range(f.size - 1), lead, n),
                              lagged(u, range(nk, nk + nb), lead, n),
                              -lagged(y, range(1, nf + 1), lead, n), y[lead:, None]))
            factors.append(upper(rows)[f.size - 1 :, f.size - 1 :])
        theta = _least_squares(np.vstack(factors))
        new = inside(monic(theta[nb:]))
        b, change = theta[:nb], float(np.max(np.abs(np.pad(f, (0, nf + 1 - f.size)) - new)))
        f = new
        if change < SETTLED:
            break
    return b, f


def _noise(ho: HighOrder, b: FloatArray, f: FloatArray, nc: int,
           nd: int) -> tuple[FloatArray, FloatArray]:
    """C, D of v = y - (B/F) u by regression on the high-order innovations."""
    rows = []
    lead = max(nc, nd)
    for part in one_step_errors(_model(ho, B=b, F=f), ho.data):
        e = ho.innovations[part.start : part.start + part.errors.size]
        v, n = part.errors, part.errors.size
        begin = lead + ho.model.A.size
        if n > begin:
            d_columns, c_columns = (-lagged(v, range(1, nd + 1), begin, n),
                                    lagged(e, range(1, nc + 1), begin, n))
            rows.append(np.hstack((d_columns, c_columns, (v - e)[begin:, None])))
    theta = _least_squares(np.vstack(rows)) if rows else np.zeros(nc + nd)
    return inside(monic(theta[nd:])), inside(monic(theta[:nd]))


def _moving_average(ho: HighOrder, b: FloatArray, f: FloatArray, na: int, nc: int) -> FloatArray:
    """C of F y - B u = C e by regression on the high-order innovations."""
    rows = []
    for block in _joined(ho, na, b.size, nc):
        rest = block[:, -1] - block[:, :na] @ f[1:] - block[:, na : na + b.size] @ b
        rows.append(np.column_stack((block[:, na + b.size : -1], rest)))
    return inside(monic(_regress(rows)))


def _joined(ho: HighOrder, na: int, nb: int, nc: int) -> list[FloatArray]:
    """Blocks [-y lags | u lags | e lags | y - e] behind the first innovations."""
    z, nk = ho.data, ho.model.nk
    lead = max(ho.model.A.size - 1, ho.model.B.size - 1) + nc
    lead = max(lead, na, nk + nb - 1)
    return [
        np.hstack(
            (-lagged(z.y, range(1, na + 1), start + lead, stop),
             lagged(z.u, range(nk, nk + nb), start + lead, stop),
             lagged(ho.innovations, range(1, nc + 1), start + lead, stop),
             (z.y - ho.innovations)[start + lead : stop, None])
        )
        for start, stop in z.segments
        if stop - start > lead
    ]


def _regress(blocks: list[FloatArray]) -> FloatArray:
    """Least squares of the last column on the others, zeros where there are no rows."""
    if not blocks:
        return np.zeros(0)
    return _least_squares(np.vstack([upper(block) for block in blocks]))


def _least_squares(rows: FloatArray) -> FloatArray:
    """Coefficients of the last column on the others, scaled, minimal norm where dependent."""
    x, target = rows[:, :-1], rows[:, -1]
    if x.shape[1] == 0:
        return np.zeros(0)
    scale = np.linalg.norm(x, axis=0)
    scale[~(scale > 0.0)] = 1.0
    if not (np.isfinite(x).all() and np.isfinite(target).all()):
        return np.zeros(x.shape[1])
    return np.asarray(np.linalg.lstsq(x / scale, target, rcond=1e-12)[0] / scale)
