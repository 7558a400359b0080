"""Running a polynomial model: free run, prediction over a horizon, fit in percent.

The whole of a model's use on data but the statistics of its residual (residuals.py).
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from quad_sysid.blackbox.filters import filter_columns, filter_signal, pulses
from quad_sysid.blackbox.innovations import check_rate, one_step_errors
from quad_sysid.blackbox.polynomial import Polynomials
from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.qr import upper
from quad_sysid.record import IOData

SETTLE_ROWS = 4000
"""Most rows of a segment that determine its initial state."""


def simulate(model: Polynomials, u: FloatArray, x0: FloatArray | None = None) -> FloatArray:
    """Free run (n,) of the plant B/(A F) on u (n,), without noise.

    x0 is the state of the transposed direct form II (scipy.signal.lfilter's `zi`), of
    max(len(A F), len(B)) - 1 entries; None starts at rest.
    """
    u = np.asarray(u, dtype=float)
    if u.ndim != 1 or not np.isfinite(u).all():
        raise BadInputError('simulate', 'u must be 1-D and finite', u.shape)
    response = np.convolve(model.B, u)[: u.size] if u.size else u.copy()
    if x0 is not None:
        x0 = np.asarray(x0, dtype=float)
        size = max(model.denominator.size, model.B.size) - 1
        if x0.shape != (size,):
            raise BadInputError('simulate', f'x0 must have {size} entries', x0.shape)
        count = min(x0.size, u.size)
        response[:count] += x0[:count]
    with np.errstate(over='ignore', invalid='ignore'):
        return filter_signal(np.ones(1), model.denominator, response)


def initial_state(model: Polynomials, u: FloatArray, y: FloatArray) -> FloatArray:
    """State from which the free run on u (n,) comes nearest to y (n,), by least squares."""
    size = max(model.denominator.size, model.B.size) - 1
    rows = min(np.asarray(u).size, max(SETTLE_ROWS, 10 * size))
    residual = np.asarray(y, dtype=float)[:rows] - simulate(model, u[:rows])
    with np.errstate(over='ignore', invalid='ignore'):
        columns = filter_columns(np.ones(1), model.denominator, pulses(rows, size))
    if not (np.isfinite(columns).all() and np.isfinite(residual).all()):
        return np.zeros(size)
    r = upper(np.column_stack((columns, residual)))
    return np.asarray(np.linalg.lstsq(r[:size, :size], r[:size, size], rcond=1e-10)[0])


def predict(model: Polynomials, z: IOData, horizon: float = 1) -> FloatArray:
    """Predicted output (n,), `horizon` samples ahead; NaN where z has no segment or no past.

    math.inf is the free run, each segment from its best initial state. The k-step error is
    (h_0 + … + h_{k-1} q^{-(k-1)}) e, with h the impulse response of the noise model C/(A D)
    (Ljung 1999, eq. 3.31).
    """
    check_rate(model, z)
    number = isinstance(horizon, (int, float, np.number)) and not isinstance(horizon, bool)
    if not (number and (horizon == math.inf or (horizon >= 1 and horizon % 1 == 0))):
        raise BadInputError('predict', 'horizon must be an integer >= 1 or math.inf', horizon)
    yhat = np.full(z.y.size, np.nan)
    if horizon == math.inf:
        for start, stop in z.segments:
            u, y = z.u[start:stop], z.y[start:stop]
            yhat[start:stop] = simulate(model, u, initial_state(model, u, y))
        return yhat
    *_, errors = horizon_errors(model, z, int(horizon))
    return np.asarray(z.y - errors)


def horizon_errors(model: Polynomials, z: IOData, horizon: int) -> Iterator[FloatArray]:
    """Errors (n,) of `predict` for 1, 2, …, `horizon` samples ahead, NaN where none is made.

    One pass over the data for all horizons, since each adds one term to the one before.
    """
    parts = one_step_errors(model, z)
    h = filter_signal(model.C, np.convolve(model.A, model.D), np.eye(1, horizon)[0])
    error = np.full(z.y.size, np.nan)
    for part in parts:
        error[part.start : part.start + part.errors.size] = 0.0
    for k in range(horizon):
        for part in parts:
            stop = part.start + part.errors.size
            error[part.start + k : stop] += h[k] * part.errors[: max(part.errors.size - k, 0)]
        yield error.copy()


def fit_percent(y: FloatArray, yhat: FloatArray) -> float:
    """100 (1 - ||y - yhat|| / ||y - mean y||) over the rows where yhat is not NaN.

    -inf where the prediction has overflowed or y is constant and missed.
    """
    y, yhat = np.asarray(y, dtype=float), np.asarray(yhat, dtype=float)
    if y.shape != yhat.shape:
        raise BadInputError('fit_percent', 'y and yhat must have one length',
                            f'{y.shape}, {yhat.shape}')
    is_finite = ~np.isnan(yhat)
    if not is_finite.any():
        raise BadInputError('fit_percent', 'yhat holds no prediction', int(y.size))
    y, yhat = y[is_finite], yhat[is_finite]
    spread = float(np.linalg.norm(y - y.mean()))
    with np.errstate(over='ignore', invalid='ignore'):
        error = float(np.linalg.norm(y - yhat))
    if error == 0.0:
        return 100.0
    if spread == 0.0 or not math.isfinite(error):
        return -math.inf
    return 100.0 * (1.0 - error / spread)


def compare(z: IOData, *models: Polynomials, horizon: float = math.inf) -> tuple[float, ...]:
    """Fit in percent of each model on z, by default in the free run (MATLAB: compare)."""
    if isinstance(z, Polynomials):
        raise BadInputError('compare', 'the data come first', 'a model', 'compare(z, model, …)')
    return tuple(fit_percent(z.y, predict(model, z, horizon)) for model in models)
