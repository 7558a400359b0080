"""Start values for the prediction error method from one high-order ARX model.

That model is consistent in closed loop; each structure is then reached by linear least squares:
Steiglitz-McBride on its noise-free response (MORSM, Everitt, Galrinho, Hjalmarsson 2018) for B
and F, regression on its innovations (Hannan, Rissanen 1982) for A, C and D. No iteration on the
criterion itself belongs here.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import toeplitz

from quad_sysid.blackbox.constants import ROUNDING
from quad_sysid.blackbox.filters import filter_columns, filter_signal, pulses
from quad_sysid.blackbox.innovations import one_step_errors
from quad_sysid.blackbox.model import Model, polynomial_model
from quad_sysid.blackbox.polynomial import delayed, monic
from quad_sysid.blackbox.regression import lagged, usable_rows
from quad_sysid.contract import FloatArray
from quad_sysid.qr import upper
from quad_sysid.record import IOData

ROUNDS = 12
"""Most rounds to a start value; the descent does the rest."""
CONVERGED = 1e-4
"""Change of a coefficient of F from which further rounds are left to the descent."""
NEAR = 0.4
"""Distance in the z plane within which a pole and a zero count as cancelling."""
NEARLY_REAL = 0.15
"""Imaginary part below which a pair of D's roots may stand for two real ones."""
SLOW_FACTOR = np.array([1.0, -0.9999])
"""Factor of a cancelling pole and zero, which a drift can separate."""
EDGE = 1.0 - 1e-7
"""Largest radius of a root that a fit keeps: an integrator, to the digits of a double."""


@dataclass(frozen=True)
class HighOrder:
    """The high-order ARX model of a record and its innovations."""

    model: Model
    data: IOData

    @cached_property
    def innovations(self) -> FloatArray:
        """(n,) zero outside segments and before their first error."""
        errors, unit = np.zeros(self.data.y.size), np.ones(1)
        lead = max(self.model.A.size, self.model.B.size) - 1
        for i, j in self.data.segments:
            errors[i:j] = (filter_signal(self.model.A, unit, self.data.y[i:j], lead)
                           - filter_signal(self.model.B, unit, self.data.u[i:j], lead))
        return errors

    def loss_of(self, parameters: int) -> float:
        """Loss that the right structure reaches with so many: chi-squared, within a sigma."""
        n = usable_rows(self.data, max(self.model.A.size, self.model.B.size) - 1)
        spare = max(self.model.parameters.size - parameters, 0)
        return float(self.innovations @ self.innovations) / n * math.exp(
            (spare + math.sqrt(2.0 * spare)) / n)


def high_order(z: IOData, nk: int, parameters: int) -> HighOrder:
    """Fit an ARX model of order 20, more for large models, less for a short record; delay nk."""
    longest = max(stop - start for start, stop in z.segments)
    order = max(20, parameters)
    while order > 1 and (nk + order > longest // 4 or usable_rows(z, nk + order) < 10 * order):
        order //= 2
    lead = nk + order + 1
    gram = sum((_lag_gram((z.y[i:j], np.append(np.zeros(nk), z.u[i : j - nk])), order + 1, lead)
                for i, j in z.segments if j - i > lead), np.zeros((2 * order + 2, 2 * order + 2)))
    scale = np.sqrt(np.maximum(np.diag(gram), np.finfo(float).tiny))
    # without noise, or with few frequencies, any coefficients that explain the data will do
    gram = gram / np.outer(scale, scale) + ROUNDING * np.eye(scale.size)
    theta = np.linalg.solve(gram[1:-1, 1:-1], gram[1:-1, 0]) * scale[0] / scale[1:-1]
    model = polynomial_model(delayed(theta[::2], nk), A=monic(-theta[1::2]), nk=nk, dt=z.dt)
    return HighOrder(model, z)


def _lag_gram(signals: tuple[FloatArray, ...], lags: int, first: int) -> FloatArray:
    """Gram matrix of the lags 0, 1, … of k signals (n,) over the rows from `first` >= lags on.

    By lag, then by signal. Each block follows from the one a lag before in both, by the row that
    enters and the one that leaves; only the first `k` rows are sums over the record.
    """
    k, n = len(signals), signals[0].size
    gram = np.empty((lags * k, lags * k))
    for row, x in enumerate(signals):
        for column, other in enumerate(signals):
            sums = np.correlate(other[first - lags + 1 :], x[first:], 'valid')
            gram[row, column::k] = sums[::-1]
    both = np.column_stack(signals)
    enters, leaves = both[first - lags : first][::-1].ravel(), both[n - lags :][::-1].ravel()
    change = np.outer(enters, enters) - np.outer(leaves, leaves)
    for row in range(k, lags * k):
        gram[row, :k] = gram[:k, row]
        gram[row, k:] = gram[row - k, :-k] + change[row - k, :-k]
    return gram


def inside(poly: FloatArray) -> FloatArray:
    """Return poly with its roots reflected into the unit circle; itself where they are."""
    if poly.size == 1 or not np.isfinite(poly).all():
        return poly
    roots = np.roots(poly)
    radius = np.abs(roots)
    if (radius < 1.0).all():
        return poly
    back = np.where(radius < 1.0, 1.0, np.minimum(1.0 / radius, EDGE) / np.maximum(radius, 1.0))
    return np.asarray(np.real(np.poly(roots * back)))


def armax_starts(ho: HighOrder, na: int, nb: int, nc: int) -> Iterator[Model]:
    """Start values by regression on the innovations, and from the plants B/F without a C."""
    z, nk, e = ho.data, ho.model.nk, ho.innovations
    lead = max(max(ho.model.A.size, ho.model.B.size) - 1 + nc, na, nk + nb - 1)
    theta = _regress([
        np.hstack((-lagged(z.y, range(1, na + 1), start + lead, stop),
                   lagged(z.u, range(nk, nk + nb), start + lead, stop),
                   lagged(e, range(1, nc + 1), start + lead, stop),
                   (z.y - e)[start + lead : stop, None]))
        for start, stop in z.segments if stop - start > lead
    ])
    yield _model(ho, A=monic(theta[:na]), B=theta[na : na + nb], C=monic(theta[na + nb :]))
    for b, f in _plants(ho, nb, na):
        yield _model(ho, A=f, B=b, C=monic(np.zeros(nc)))


def oe_starts(ho: HighOrder, nb: int, nf: int) -> Iterator[Model]:
    """Start values from the plants B/F alone, and from one in which a pole is left to a drift."""
    plants = _plants(ho, nb, nf)
    b, f = next(plants)
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
    """Move a nearly cancelling pole and zero of B/F (B/A) or C/D to several other places.

    Such a pair is what nearly all false minima have; where it stands matters little to the
    criterion, so that the descent does not find the place where it matters.
    """
    for zeros, poles in (('B', 'A' if model.F.size == 1 else 'F'), ('C', 'D')):
        lead = getattr(model, zeros)[model.nk if zeros == 'B' else 0 :]
        if lead[0] == 0.0:
            continue
        z_roots, p_roots = np.roots(lead), np.roots(getattr(model, poles))
        if zeros == 'C':
            p_roots = np.where(np.abs(p_roots.imag) < NEARLY_REAL, p_roots.real, p_roots)
        distance = np.abs(z_roots[:, None] - p_roots)
        distance[(z_roots.imag != 0.0)[:, None] | (p_roots.imag != 0.0)] = np.inf
        if zeros == 'B':  # no plant sampled from continuous time has a pole below 0
            distance[:, (p_roots.imag == 0.0) & (p_roots.real < 0.0)] *= 1e-3
        if distance.min(initial=np.inf) > NEAR:
            continue
        i, j = np.unravel_index(int(np.argmin(distance)), distance.shape)
        for place in (-0.7, -0.2, 0.3, 0.6, 0.8, 0.95):  # all over the real axis
            top = lead[0] * np.real(np.poly([*np.delete(z_roots, i), place]))
            bottom = np.real(np.poly([*np.delete(p_roots, j), place]))
            polynomials: dict[str, Any] = {
                zeros: delayed(top, model.nk) if zeros == 'B' else top, poles: bottom}
            yield replace(model, **polynomials)


def _model(ho: HighOrder, *, B: FloatArray, **others: FloatArray) -> Model:
    """Put the polynomials (B without its delay; A, C, D, F of 1 where not given) into a model."""
    polynomials: dict[str, Any] = {name: others.get(name, np.ones(1)) for name in 'ACDF'}
    return replace(ho.model, B=delayed(B, ho.model.nk), **polynomials)


def _plants(ho: HighOrder, nb: int, nf: int) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Return B (without delay) and F by Steiglitz-McBride, on the model and on the data."""
    yield _reduced(ho, nb, nf)
    if nf:
        z = ho.data
        parts = [np.column_stack((z.y[start:stop], z.u[start:stop])) for start, stop in z.segments]
        yield _steiglitz_mcbride(parts, nb, nf, ho.model.nk)


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
        cov[0] *= 1.0 + ROUNDING * size
        theta = _least_squares(np.linalg.cholesky(toeplitz(cov)).T @ unknown)
        before, b, f = f, theta[:nb], inside(monic(theta[nb:]))
        if float(np.max(np.abs(_padded(before, nf + 1) - f), initial=0.0)) < CONVERGED:
            break
    return b, f


def _padded(poly: FloatArray, size: int, lag: int = 0) -> FloatArray:
    """(size,) the coefficients of poly behind `lag` zeros."""
    out = np.zeros(size)
    out[lag : lag + poly.size] = poly
    return out


def _steiglitz_mcbride(parts: list[FloatArray], nb: int, nf: int,
                       nk: int) -> tuple[FloatArray, FloatArray]:
    """B, F that minimise the error of y = (B/F) u over parts (n, 2) of y, u, by fixed point.

    Each part's unknown start is fitted with it, as pulses behind 1/F. Round one is the ARX model.
    """
    unit = f = np.ones(1)
    b = np.zeros(nb)
    lead = max(nf, nk + nb - 1)
    parts = [part for part in parts if part.shape[0] > lead]  # a shorter one holds no row
    for _ in range(ROUNDS if parts else 0):
        factors = []
        for part in parts:
            n = part.shape[0]
            y, u, kick = filter_columns(unit, f, np.column_stack((part, pulses(n, 1, lead)))).T
            rows = np.hstack((lagged(kick, range(f.size - 1), lead, n),
                              lagged(u, range(nk, nk + nb), lead, n),
                              -lagged(y, range(1, nf + 1), lead, n), y[lead:, None]))
            factors.append(upper(rows)[f.size - 1 :, f.size - 1 :])
        theta = _least_squares(np.vstack(factors))
        before, b, f = f, theta[:nb], inside(monic(theta[nb:]))
        if float(np.max(np.abs(_padded(before, nf + 1) - f))) < CONVERGED:
            break
    return b, _padded(f, nf + 1)


def _noise(ho: HighOrder, b: FloatArray, f: FloatArray, nc: int,
           nd: int) -> tuple[FloatArray, FloatArray]:
    """C, D of v = y - (B/F) u by regression on the high-order innovations."""
    blocks = []
    begin = max(nc, nd) + ho.model.A.size
    for part in one_step_errors(_model(ho, B=b, F=f), ho.data):
        v, n = part.errors, part.errors.size
        e = ho.innovations[part.start : part.start + n]
        if n > begin:
            blocks.append(np.hstack((-lagged(v, range(1, nd + 1), begin, n),
                                     lagged(e, range(1, nc + 1), begin, n),
                                     (v - e)[begin:, None])))
    theta = _regress(blocks) if blocks else np.zeros(nc + nd)
    return inside(monic(theta[nd:])), inside(monic(theta[:nd]))


def _regress(blocks: list[FloatArray]) -> FloatArray:
    """Least squares of the last column on the others, over blocks of rows."""
    return _least_squares(np.vstack([upper(block) for block in blocks]))


def _least_squares(rows: FloatArray) -> FloatArray:
    """Coefficients of the last column on the others, scaled, minimal norm where dependent."""
    x, target = rows[:, :-1], rows[:, -1]
    if not (np.isfinite(x).all() and np.isfinite(target).all()):
        return np.zeros(x.shape[1])
    scale = np.linalg.norm(x, axis=0)
    scale[~(scale > 0.0)] = 1.0
    return np.asarray(np.linalg.lstsq(x / scale, target, rcond=1e-12)[0] / scale)
