"""The triangular factor of a tall matrix."""

from __future__ import annotations

import numpy as np

from quad_sysid.contract import FloatArray

SLICE = 8192
"""Numbers in one slice of a tall matrix."""
DISTINCT = 1e-4
"""Least pivot, relative to its column, of a Gram matrix whose factor keeps eight digits."""


def upper(x: FloatArray) -> FloatArray:
    """R of the QR factorisation of x (…, n, m), stacks of matrices included.

    That of a tall matrix is the Cholesky factor of its Gram matrix, which costs a quarter, unless
    its columns are nearly dependent. Then it is factored in slices that fit the cache, then their
    factors together.
    """
    if x.ndim == 2:
        rows, columns = x.shape
        if rows > 8 * columns and (factor := _of_gram(x)) is not None:
            return factor
        size = max(2 * columns, SLICE // max(columns, 1))
        count = rows // size
        if count >= 4:
            slices = x[: count * size].reshape(count, size, columns)
            factors = np.asarray(np.linalg.qr(slices, mode='r')).reshape(-1, columns)
            return upper(np.vstack((factors, x[count * size :])))
    return np.asarray(np.linalg.qr(x, mode='r'))


def _of_gram(x: FloatArray) -> FloatArray | None:
    with np.errstate(over='ignore', invalid='ignore'):  # which the next line refuses
        gram = x.T @ x
    size = np.sqrt(np.diag(gram))
    if not (np.isfinite(size).all() and (size > 0.0).all()):
        return None
    try:
        factor = np.linalg.cholesky(gram / size / size[:, None]).T
    except np.linalg.LinAlgError:
        return None
    return factor * size if np.diag(factor).min(initial=1.0) > DISTINCT else None
