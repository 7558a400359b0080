"""The triangular factor of a tall matrix."""

from __future__ import annotations

import numpy as np

from quad_sysid.contract import FloatArray

SLICE = 8192
"""Numbers in one slice of a tall matrix."""


def upper(x: FloatArray) -> FloatArray:
    """R of the QR factorisation of x (…, n, m), stacks of matrices included.

    A tall matrix is factored in slices that fit the cache, then their factors together.
    """
    if x.ndim == 2:
        rows, columns = x.shape
        size = max(2 * columns, SLICE // max(columns, 1))
        count = rows // size
        if count >= 4:
            slices = x[: count * size].reshape(count, size, columns)
            factors = np.asarray(np.linalg.qr(slices, mode='r')).reshape(-1, columns)
            return upper(np.vstack((factors, x[count * size :])))
    return np.asarray(np.linalg.qr(x, mode='r'))
