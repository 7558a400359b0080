"""One-step prediction errors of any polynomial model on data, and their exact gradients.

e = (D/C)(A y - w), F w = B u, conditional on the first samples of each segment: the state of w
at its start is fitted with the parameters (a nuisance per segment), e is zero before its start
(Ljung 1999, section 10.3). No iteration and no start values belong here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quad_sysid.blackbox.filters import filter_columns, pulses
from quad_sysid.blackbox.polynomial import Model
from quad_sysid.blackbox.regression import lagged
from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.record import IOData

DEPENDENT = 1e-13
"""Relative singular value below which columns of initial states are taken as dependent."""


@dataclass(frozen=True)
class SegmentErrors:
    """Prediction errors of one segment."""

    start: int
    """Index of the first error in the record."""
    errors: FloatArray
    """(m,) one-step errors with the best initial state of w."""
    output: FloatArray
    """(m,) w = (B/F) u, with that initial state."""


def lead_of(model: Model) -> tuple[int, int]:
    """Rows of a segment before w starts, and before e starts."""
    first = max(model.A.size - 1, model.B.size - 1)
    return first, first + model.D.size - 1


def check_rate(model: Model, z: IOData) -> None:
    """Raise BadInputError where z was not sampled at the model's rate."""
    if abs(z.dt - model.dt) > 1e-6 * model.dt:
        raise BadInputError('z', f"must be sampled at the model's {1.0 / model.dt:.6g} Hz",
                            f'{1.0 / z.dt:.6g} Hz', 'resample it or identify at its rate')


def one_step_errors(model: Model, z: IOData) -> list[SegmentErrors]:
    """Errors of every segment that is long enough, in order."""
    check_rate(model, z)
    first, lead = lead_of(model)
    found = []
    for start, stop in z.segments:
        if stop - start > lead + model.F.size:
            begin = start + first
            w = filter_columns(np.ones(1), model.F, _driven(model, z, begin, stop))
            v = lagged(z.y, range(model.A.size), begin, stop) @ model.A - w[:, 0]
            stack = np.column_stack((v, w[:, 1:]))
            e = filter_columns(model.D, model.C, stack, lead - first)[lead - first :]
            basis, turn = span(e[:, 1:])
            state = turn @ (basis.T @ e[:, 0])
            found.append(
                SegmentErrors(start + lead, e[:, 0] - e[:, 1:] @ state,
                              (w[:, 0] + w[:, 1:] @ state)[lead - first :])
            )
    return found


def squares(model: Model, z: IOData) -> tuple[int, float]:
    """How many one-step errors there are, and the sum of their squares."""
    parts = one_step_errors(model, z)
    return sum(p.errors.size for p in parts), sum(float(p.errors @ p.errors) for p in parts)


def errors_and_gradient(model: Model,
                        z: IOData) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
    """Per segment e (m,), its gradient by `parameters` (m, p), and a basis (m, k) of the nuisance.

    The nuisance is w's initial state; e has it at its best, the basis spans its gradient.
    """
    first, lead = lead_of(model)
    skip = lead - first
    na, nc = model.A.size - 1, model.C.size - 1
    nb, nd, nf = model.B.size - model.nk, model.D.size - 1, model.F.size - 1
    found = []
    for start, stop in z.segments:
        if stop - start <= lead + nf:
            continue
        begin = start + first
        u_lags = range(model.nk, model.nk + nb)
        raw = np.hstack((_driven(model, z, begin, stop), lagged(z.u, u_lags, begin, stop)))
        w = filter_columns(np.ones(1), model.F, raw) if nf else raw
        y = lagged(z.y, range(na + 1), begin, stop)
        base = filter_columns(
            model.D, model.C, np.column_stack((y @ model.A - w[:, 0], w[:, 1 : nf + 1])), skip
        )[skip:]
        basis, turn = span(base[:, 1:])
        state = turn @ (basis.T @ base[:, 0])
        w0 = w[:, 0] + w[:, 1 : nf + 1] @ state
        e = base[:, 0] - base[:, 1:] @ state
        wf = filter_columns(np.ones(1), model.F, _shifts(w0, nf)) if nf else _shifts(w0, 0)
        slow = filter_columns(model.D, model.C, np.hstack((y[:, 1:], -w[:, nf + 1 :], wf)),
                              skip)[skip:]
        v = y @ model.A - w0
        e_all = np.concatenate((np.zeros(skip), e))
        fast = filter_columns(np.ones(1), model.C,
                              np.hstack((-_shifts(e_all, nc), _shifts(v, nd))), skip)[skip:]
        gradient = np.hstack((slow[:, : na + nb], fast[:, :nc], fast[:, nc:], slow[:, na + nb :]))
        found.append((e, gradient, basis))
    return found


def _driven(model: Model, z: IOData, begin: int, stop: int) -> FloatArray:
    """(m, 1 + nf) B u and the pulses of w's unknown start."""
    bu = lagged(z.u, range(model.nk, model.B.size), begin, stop) @ model.B[model.nk :]
    return np.column_stack((bu, pulses(stop - begin, model.F.size - 1)))


def _shifts(x: FloatArray, count: int) -> FloatArray:
    """(n, count) x(t-1), …, x(t-count), zero before the start."""
    out = np.zeros((x.size, count))
    for i in range(1, count + 1):
        out[i:, i - 1] = x[:-i]
    return out


def span(columns: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Orthonormal basis (m, k) of the few `columns` (m, n), and (n, k) from it to coefficients.

    Coefficients are of least norm where columns depend on each other. By orthogonal factors: slow
    poles make the columns so much alike that their products lose it.
    """
    n = columns.shape[1]
    scale = np.sqrt(np.einsum('ij,ij->j', columns, columns))
    if n == 0 or not np.isfinite(scale).all():
        return np.zeros((columns.shape[0], 0)), np.zeros((n, 0))
    scale[scale == 0.0] = 1.0
    q, r = np.linalg.qr(columns / scale)
    u, values, vt = np.linalg.svd(r)
    kept = values > DEPENDENT * values[0]
    return q @ u[:, kept], vt[kept].T / values[kept] / scale[:, None]
