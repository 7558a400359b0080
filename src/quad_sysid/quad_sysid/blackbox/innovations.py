"""One-step prediction errors of any polynomial model on data, and their exact gradients.

e = (D/C)(A y - w), F w = B u, conditional on the first samples of each segment: the state of w
at its start is fitted with the parameters (a nuisance per segment), e is zero before its start
(Ljung 1999, section 10.3). No iteration and no start values belong here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from quad_sysid.blackbox.constants import ROUNDING
from quad_sysid.blackbox.filters import filter_columns, filter_lags, filter_signal, pulses
from quad_sysid.blackbox.polynomial import Polynomials
from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.record import IOData


@dataclass(frozen=True)
class SegmentErrors:
    """Prediction errors of one segment."""

    start: int
    """Index of the first error in the record."""
    errors: FloatArray
    """(m,) one-step errors with the best initial state of w."""


def lead_of(model: Polynomials) -> tuple[int, int]:
    """Rows of a segment before w starts, and before e starts."""
    first = max(model.A.size - 1, model.B.size - 1)
    return first, first + model.D.size - 1


def check_rate(model: Polynomials, z: IOData) -> None:
    """Raise BadInputError where z was not sampled at the model's rate."""
    if abs(z.dt - model.dt) > 1e-6 * model.dt:
        raise BadInputError('z', f"must be sampled at the model's {1.0 / model.dt:.6g} Hz",
                            f'{1.0 / z.dt:.6g} Hz', 'resample it or identify at its rate')


def _response(model: Polynomials, u: FloatArray, y: FloatArray) -> tuple[FloatArray, ...]:
    """(n,) e, w and A y - w of one segment of n samples, w's initial state at its best.

    Last a basis (n, k), orthonormal, of what that state adds to e. e is zero before its first row.
    """
    first, lead = lead_of(model)
    w = filter_signal(model.B, model.F, u, first)
    kick = filter_columns(np.ones(1), model.F, pulses(u.size, 1, first))[:, 0]
    kicks = filter_lags(np.ones(1), np.ones(1), kick, range(model.F.size - 1))
    v = filter_signal(model.A, np.ones(1), y, first) - w
    e = filter_signal(model.D, model.C, v, lead)
    states = filter_columns(model.D, model.C, kicks, lead)
    basis, turn = span(states)
    state = turn @ (basis.T @ e)
    free = kicks @ state
    return e - states @ state, w + free, v - free, basis


def one_step_errors(model: Polynomials, z: IOData) -> list[SegmentErrors]:
    """Errors of every segment that is long enough, in order."""
    check_rate(model, z)
    _, lead = lead_of(model)
    errors = []
    for start, stop in z.segments:
        if stop - start > lead + model.F.size:
            e, *_ = _response(model, z.u[start:stop], z.y[start:stop])
            errors.append(SegmentErrors(start + lead, e[lead:]))
    return errors


def squares(model: Polynomials, z: IOData) -> tuple[int, float]:
    """Number of one-step errors, and the sum of their squares."""
    parts = one_step_errors(model, z)
    return sum(p.errors.size for p in parts), sum(float(p.errors @ p.errors) for p in parts)


def errors_and_gradient(model: Polynomials,
                        z: IOData) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
    """Per segment e (m,), its gradient by `parameters` (m, p), and a basis (m, k) of the nuisance.

    The nuisance is w's initial state; e has it at its best, the basis spans its gradient, and the
    gradient by B and F is exact up to that.
    """
    first, lead = lead_of(model)
    unit = np.ones(1)
    responses = []
    for start, stop in z.segments:
        if stop - start <= lead + model.F.size - 1:
            continue
        u, y = z.u[start:stop], z.y[start:stop]
        e, w, v, basis = _response(model, u, y)
        filtered_u = filter_signal(unit, model.F, u)
        filtered_w = filter_signal(unit, model.F, w, first)
        columns = (  # in the order of `parameters`
            (model.D, model.C, y, range(1, model.A.size)),
            (-model.D, model.C, filtered_u, range(model.nk, model.B.size)),
            (-unit, model.C, e, range(1, model.C.size)),
            (unit, model.C, v, range(1, model.D.size)),
            (model.D, model.C, filtered_w, range(1, model.F.size)),
        )
        gradient = np.empty((u.size, model.parameters.size), order='F')
        done = 0
        for num, den, x, lags in columns:
            filter_lags(num, den, x, lags, lead, out=gradient[:, done : done + len(lags)])
            done += len(lags)
        responses.append((e[lead:], gradient[lead:], basis[lead:]))
    return responses


def span(columns: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Orthonormal basis (m, k) of the few `columns` (m, n), and (n, k) from it to coefficients.

    By Gram and Schmidt, each column twice: slow poles make the columns so much alike that one
    pass or their products lose it. A column that depends on those before it is left out.
    """
    basis, independent = list[FloatArray](), list[int]()
    for j, column in enumerate(columns.T):
        residual = column.copy()
        for direction in basis * 2:
            residual -= (direction @ residual) * direction
        remaining, size = math.sqrt(residual @ residual), math.sqrt(column @ column)
        if math.isfinite(size) and remaining > ROUNDING * size:
            basis.append(residual / remaining)
            independent.append(j)
    turn = np.zeros((columns.shape[1], len(independent)))
    orthonormal = np.array(basis).T if basis else np.zeros((columns.shape[0], 0))
    turn[independent] = np.linalg.inv(orthonormal.T @ columns[:, independent])
    return orthonormal, turn


def without(columns: FloatArray, states: FloatArray) -> FloatArray:
    """(m, p) `columns` without their part in the span of the initial states (m, k)."""
    basis, _ = span(states)
    return np.asarray(columns - basis @ (basis.T @ columns))
