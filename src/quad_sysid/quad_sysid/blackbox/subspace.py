"""State-space models by a subspace method that is consistent under feedback (n4sid).

No iteration: its result may start one elsewhere.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from quad_sysid.blackbox.filters import filter_signal
from quad_sysid.blackbox.innovations import squares
from quad_sysid.blackbox.polynomial import Model
from quad_sysid.blackbox.regression import check_informative, check_order, lagged, upper
from quad_sysid.blackbox.start_values import high_order, inside
from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.record import IOData


def n4sid(z: IOData, order: int, *, horizon: int | None = None) -> Model:
    """Fit x(t+1) = A x + B u + K e, y = C x + e of the given order, by SSARX (Jansson 2003).

    A high-order ARX model takes the future inputs and outputs out of the future outputs before
    the projection on the past, so that feedback does not bias it. Returned as the equivalent
    ARMAX polynomials, without covariance; nk is 1. `horizon` is the rows of the past and future.
    """
    order = check_order('n4sid', 'order', order, 1)
    rows = max(2 * order + 2, 15) if horizon is None else check_order('n4sid', 'horizon', horizon,
                                                                      order + 1)
    check_informative('n4sid', z, 4 * rows, 2 * rows)
    ho = high_order(z, 1, 3 * order).model
    past, future, now = _projection(z, ho, rows)
    scale = np.linalg.norm(past, axis=0)
    r = upper(np.hstack((past / scale, future)))
    m = past.shape[1]
    gains = np.linalg.lstsq(r[:m, :m], r[:m, m:], rcond=1e-12)[0]
    gram = r[:, m:].T @ r[:, m:]
    tiny = 1e-13 * np.trace(gram) * np.eye(gram.shape[0])  # only mends rounding
    weight = np.linalg.cholesky(gram + tiny)
    left, values, _ = np.linalg.svd(r[:m, :m] @ gains @ np.linalg.inv(weight).T)
    if values[order - 1] < 1e-12 * values[0]:
        raise BadInputError('n4sid', f'the data do not show {order} states', order,
                            'lower the order')
    basis = np.linalg.lstsq(r[:m, :m], left[:, :order], rcond=1e-12)[0]
    a, b, c, k = _state_space((past / scale) @ basis, now)
    return _as_model(z, order, a, b, c, k)


def _projection(z: IOData, ho: Model,
                rows: int) -> tuple[FloatArray, FloatArray, list[tuple[int, FloatArray]]]:
    """Past (m, 2 rows), corrected future (m, rows), and per segment its row count and [u, y]."""
    u_gain = np.pad(ho.B, (0, max(0, rows - ho.B.size)))[:rows]
    y_gain = np.pad(-ho.A, (0, max(0, rows - ho.A.size)))[:rows]
    past, future, now = [], [], []
    for start, stop in z.segments:
        first, last = start + rows, stop - rows
        if last - first < 2:
            continue
        lags = range(1, rows + 1)
        past.append(np.hstack((lagged(z.u, lags, first, last), lagged(z.y, lags, first, last))))
        ahead = np.column_stack([z.y[first + i : last + i] for i in range(rows)])
        for i in range(rows):
            for j in range(1, i + 1):
                ahead[:, i] -= u_gain[j] * z.u[first + i - j : last + i - j]
                ahead[:, i] -= y_gain[j] * z.y[first + i - j : last + i - j]
        future.append(ahead)
        now.append((last - first, np.column_stack((z.u[first:last], z.y[first:last]))))
    if not past:
        raise BadInputError('n4sid', f'no segment is longer than {2 * rows + 2} samples',
                            remedy='take a lower order or longer segments')
    return np.vstack(past), np.vstack(future), now


def _state_space(
    states: FloatArray, now: list[tuple[int, FloatArray]]
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """A (n, n), B (n,), C (n,), K (n,) by regression on the states of successive rows."""
    n = states.shape[1]
    data = np.vstack([part for _, part in now])
    c = np.linalg.lstsq(states, data[:, 1], rcond=None)[0]
    e = data[:, 1] - states @ c
    ends = np.cumsum([count for count, _ in now]) - 1
    keep = np.ones(states.shape[0], dtype=bool)
    keep[ends] = False
    rows = np.flatnonzero(keep)
    regressors = np.column_stack((states[rows], data[rows, 0], e[rows]))
    theta = np.asarray(np.linalg.lstsq(regressors, states[rows + 1], rcond=None)[0])
    return theta[:n].T, theta[n], np.asarray(c), theta[n + 1]


def _as_model(z: IOData, order: int, a: FloatArray, b: FloatArray, c: FloatArray,
              k: FloatArray) -> Model:
    """ARMAX polynomials of (A, B, C, K): A = det(qI - A), C = det(qI - A + K C)."""
    den = np.real(np.poly(a))
    noise = inside(np.real(np.poly(a - np.outer(k, c))))
    impulse = np.zeros(order + 1)
    state = b.copy()
    for i in range(1, order + 1):
        impulse[i] = c @ state
        state = a @ state
    model = Model(structure='N4SID', orders={'order': order}, A=den,
                  B=filter_signal(den, np.ones(1), impulse), C=noise, D=np.ones(1), F=np.ones(1),
                  nk=1, dt=z.dt, noise_variance=1.0)
    n, sse = squares(model, z)
    return replace(model, noise_variance=sse / max(n - 3 * order, 1), samples=n, loss=sse / n)
