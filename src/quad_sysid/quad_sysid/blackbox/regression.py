"""Rows of linear regressions over several segments, their triangular factor, what they can carry.

What every estimator here begins with: checks of orders and data, persistence of excitation,
removal of means. No model structure is decided here.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from quad_sysid.blackbox.constants import ROUNDING
from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.qr import upper
from quad_sysid.record import IOData

BLOCK_ROWS = 1 << 11
"""Rows factored at once, so that memory grows with the columns and not with the record."""


def check_order(where: str, name: str, value: int, least: int) -> int:
    """`value` as an int >= least, or BadInputError naming the argument."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
        raise BadInputError(where, f'{name} must be an integer of at least {least}', value)
    return int(value)


def check_orders(where: str, **orders: int) -> dict[str, int]:
    """The orders of a structure as ints: nb of at least 1, the others of at least 0."""
    return {name: check_order(where, name, value, int(name == 'nb'))
            for name, value in orders.items()}


def check_informative(where: str, z: IOData, parameters: int, lead: int) -> None:
    """Raise BadInputError where z is too short or constant for this number of parameters."""
    if not isinstance(z, IOData):
        raise BadInputError(where, 'z must be an IOData', type(z).__name__)
    rows = usable_rows(z, lead)
    if rows < 2 * parameters + 1:
        raise BadInputError(
            where,
            f'too few samples: {parameters} parameters need at least {2 * parameters + 1} rows '
            f'behind the first {lead} of each segment',
            rows, 'lower the orders or give a longer record',
        )
    for name, x in (('u', z.u), ('y', z.y)):
        lows = [float(np.min(x[i:j])) for i, j in z.segments]
        highs = [float(np.max(x[i:j])) for i, j in z.segments]
        if min(lows) == max(highs):
            raise BadInputError(where, f'{name} is constant, nothing can be fitted', lows[0],
                                'use a stretch with excitation')


def check_exciting(where: str, z: IOData, count: int) -> None:
    """Raise BadInputError where u has not `count` independent lags (Ljung 1999, def. 13.2).

    So many coefficients of B and F together need them; only what rounding alone makes different
    counts as dependent.
    """
    if not any(stop - start >= count for start, stop in z.segments):
        return
    r = np.zeros((0, count))
    for start, stop in z.segments:
        for begin in range(start + count - 1, stop, BLOCK_ROWS):
            block = lagged(z.u, range(count), begin, min(stop, begin + BLOCK_ROWS))
            r = upper(np.vstack((r, block)))
            scale = np.linalg.norm(r, axis=0)
            full = len(r) == count and (scale > 0.0).all()
            if full and ROUNDING * np.linalg.cond(r / scale) <= 1.0:
                return
    raise BadInputError(
        where, f'u does not excite {count} parameters (its lags are linearly dependent)',
        remedy='lower the orders or excite more richly',
    )


def excitation_order(u: FloatArray | IOData, max_order: int = 100, tolerance: float = 1e-6) -> int:
    """Order to which u is persistently exciting: rank of its Hankel matrix (Ljung 1999, 13.2).

    A constant has order 1, a sine 2, noise `max_order` (or what the length allows). Singular
    values below `tolerance` times the largest count as zero.
    """
    max_order = check_order('excitation_order', 'max_order', max_order, 1)
    if isinstance(u, IOData):
        parts = [u.u[start:stop] for start, stop in u.segments]
    else:
        parts = [np.asarray(u, dtype=float)]
    if any(part.ndim != 1 or not np.isfinite(part).all() for part in parts):
        raise BadInputError('excitation_order', 'u must be 1-D and finite')
    longest = max(part.size for part in parts)
    if longest < 2:
        raise BadInputError('excitation_order', 'u must have at least 2 samples', longest)
    order = min(max_order, (longest + 1) // 2)
    blocks = (lagged(part, range(order), start, min(part.size, start + BLOCK_ROWS))
              for part in parts
              for start in range(order - 1, part.size, BLOCK_ROWS))
    values = np.linalg.svd(triangular(blocks), compute_uv=False)
    return int(np.sum(values > tolerance * values[0])) if values[0] > 0.0 else 0


def detrend(z: IOData, about: IOData | None = None) -> IOData:
    """Take from u and y (and r) the common mean over all segments: their own, or those of `about`.

    An axis nearly integrates: of two parts of a flight, each about means of its own, the second
    drifts away from a model of the first. So give the data of the model to those it is judged by.
    """
    about = z if about is None else about

    def centred(x: FloatArray, regressors: FloatArray) -> FloatArray:
        mean = np.concatenate([regressors[start:stop] for start, stop in about.segments]).mean()
        return np.asarray(x - mean)

    return IOData(u=centred(z.u, about.u), y=centred(z.y, about.y), dt=z.dt,
                  r=None if z.r is None or about.r is None else centred(z.r, about.r),
                  segments=z.segments)


def usable_rows(z: IOData, lead: int) -> int:
    """Rows left when the first `lead` of each segment only feed the lags."""
    return sum(max(0, stop - start - lead) for start, stop in z.segments)


def lagged(x: FloatArray, lags: Sequence[int], start: int, stop: int) -> FloatArray:
    """(stop - start, len(lags)) with x(t - lag) in the columns, t = start..stop-1."""
    out = np.empty((stop - start, len(lags)), order='F')
    for column, lag in enumerate(lags):
        out[:, column] = x[start - lag : stop - lag]
    return out


def arx_blocks(z: IOData, y_lags: Sequence[int], u_lags: Sequence[int],
               lead: int) -> Iterator[FloatArray]:
    """Row blocks [-y(t-i) …, u(t-j) …, y(t)] of all segments, each behind its first `lead`."""
    for first, stop in z.segments:
        for start in range(first + lead, stop, BLOCK_ROWS):
            end = min(stop, start + BLOCK_ROWS)
            yield np.hstack(
                (-lagged(z.y, y_lags, start, end), lagged(z.u, u_lags, start, end),
                 z.y[start:end, None])
            )


def triangular(blocks: Iterable[FloatArray]) -> FloatArray:
    """R (m, m) of the QR factorisation of the stacked blocks (·, m), by Householder, blockwise."""
    factors = [upper(block) for block in blocks]
    columns = factors[0].shape[1]
    r = factors[0] if len(factors) == 1 else upper(np.vstack(factors))
    if r.shape[0] < columns:
        r = np.vstack((r, np.zeros((columns - r.shape[0], columns))))
    return r


def solve_triangular_factor(where: str, r: FloatArray) -> tuple[FloatArray, float, FloatArray]:
    """Least squares from R of [X | y]: theta (p,), SSE, (XᵀX)⁻¹ (p, p).

    Raises BadInputError where X has not full column rank.
    """
    p = r.shape[1] - 1
    scale = np.linalg.norm(r[:, :p], axis=0)
    if p and (scale == 0.0).any():
        raise BadInputError(where, 'a regressor is zero throughout', remedy='lower the orders')
    x = r[:p, :p] / scale
    if p and ROUNDING * np.linalg.cond(x) > 1.0:
        raise BadInputError(
            where, f'the data do not excite {p} parameters (regressors linearly dependent)',
            remedy='lower the orders or excite more richly',
        )
    inverse = np.linalg.solve(x, np.eye(p)) / scale[:, None]
    theta = inverse @ r[:p, p]
    return theta, float(r[p, p] ** 2), inverse @ inverse.T
