"""The one compiled loop: a rational filter run over several columns at once.

Nothing statistical belongs here. Compiled once per installation and cached.
"""

from __future__ import annotations

import numba
import numpy as np

from quad_sysid.contract import FloatArray


@numba.njit('void(float64[::1], float64[::1], float64[:, ::1], int64, float64[:, ::1])',
            cache=True)
def _run(num, den, x, first, out):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """out(t) = Σ num_i x(t-i) - Σ den_i out(t-i) from t = first on, 0 before; x(<0) = 0."""
    n, p = x.shape
    for t in range(min(first, n)):
        for c in range(p):
            out[t, c] = 0.0
    for t in range(first, n):
        for c in range(p):
            out[t, c] = num[0] * x[t, c]
        for i in range(1, min(num.size, t + 1)):
            for c in range(p):
                out[t, c] += num[i] * x[t - i, c]
        for i in range(1, min(den.size, t - first + 1)):
            for c in range(p):
                out[t, c] -= den[i] * out[t - i, c]


def filter_columns(num: FloatArray, den: FloatArray, x: FloatArray, first: int = 0) -> FloatArray:
    """(n, p) columns of x behind num(q)/den(q), den monic, at rest at the start.

    The output is held at zero before row `first`, where the recursion starts; the numerator sees
    the rows of x before it.
    """
    x = np.require(x, dtype=float, requirements=['C', 'W'])
    out = np.empty_like(x)
    _run(np.array(num, dtype=float), np.array(den, dtype=float), x, first, out)
    return out


def filter_signal(num: FloatArray, den: FloatArray, x: FloatArray) -> FloatArray:
    """(n,) x behind num(q)/den(q), den monic, at rest at the start."""
    return filter_columns(num, den, np.asarray(x, dtype=float)[:, None])[:, 0]


def pulses(n: int, count: int, first: int = 0) -> FloatArray:
    """(n, count) unit pulses at rows first, first + 1, …: what initial conditions add."""
    out = np.zeros((n, count))
    for column in range(min(count, max(0, n - first))):
        out[first + column, column] = 1.0
    return out
