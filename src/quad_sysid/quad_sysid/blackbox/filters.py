"""The one compiled loop: a rational filter run over a signal, its lags, or several columns.

Nothing statistical belongs here.
"""

from __future__ import annotations

import numpy as np

from quad_sysid.compiled import LINE, WHOLE, kernel
from quad_sysid.contract import FloatArray


@kernel(LINE, LINE, LINE, WHOLE, WHOLE, LINE, fastmath={'contract'})
def _run(num, den, x, lag, first, out):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202, C901
    """out(t) = Σ num_i x(t-lag-i) - Σ den_i out(t-i) from t = first on, 0 before; x(<0) = 0.

    Where the last three outputs are enough they stay in registers; else the latest comes last in
    the sum, so that the processor need not wait for it.
    """
    for t in range(out.size):
        out[t] = 0.0
    for i in range(num.size):
        begin = max(first, lag + i)
        if num[i] != 0.0 and begin < out.size:
            share, later, source = num[i], out[begin:], x[begin - lag - i :]
            for t in range(later.size):
                later[t] += share * source[t]
    if den.size > 4:
        for t in range(first, out.size):
            value = out[t]
            for i in range(min(den.size - 1, t - first), 0, -1):
                value -= den[i] * out[t - i]
            out[t] = value
    elif den.size > 1:
        one, two, three = den[1], 0.0, 0.0
        if den.size > 2:
            two = den[2]
        if den.size > 3:
            three = den[3]
        last, before, oldest = 0.0, 0.0, 0.0
        for t in range(first, out.size):
            last, before, oldest = (
                (out[t] - three * oldest - two * before) - one * last, last, before)
            out[t] = last


def filter_columns(num: FloatArray, den: FloatArray, x: FloatArray, first: int = 0) -> FloatArray:
    """(n, p) columns of x behind num(q)/den(q), den monic, at rest at the start.

    The output is held at zero before row `first`, where the recursion starts; the numerator sees
    the rows of x before it.
    """
    x = np.asfortranarray(x, dtype=float)
    num, den, out = num.astype(float), den.astype(float), np.empty(x.shape, order='F')
    for column in range(x.shape[1]):
        _run(num, den, x[:, column], 0, first, out[:, column])
    return out


def filter_lags(num: FloatArray, den: FloatArray, x: FloatArray, lags: range, first: int = 0,
                *, out: FloatArray | None = None) -> FloatArray:
    """(n, len(lags)) x(t - lag) of x (n,) behind num(q)/den(q), as `filter_columns`; lags >= 0.

    `out`, of contiguous columns, takes them where given.
    """
    x = np.ascontiguousarray(x, dtype=float)
    out = np.empty((x.size, len(lags)), order='F') if out is None else out
    num, den = num.astype(float), den.astype(float)
    for column, lag in enumerate(lags):
        _run(num, den, x, lag, first, out[:, column])
    return out


def filter_signal(num: FloatArray, den: FloatArray, x: FloatArray, first: int = 0) -> FloatArray:
    """(n,) x behind num(q)/den(q), as `filter_columns`."""
    return filter_lags(num, den, x, range(1), first)[:, 0]


def pulses(n: int, count: int, first: int = 0) -> FloatArray:
    """(n, count) unit pulses at rows first, first + 1, …: what initial conditions add."""
    return np.eye(n, count, -first)
