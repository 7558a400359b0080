"""Standard errors of a free-run fit that hold where errors are coloured. No fitting here.

Free-run errors grow and hang together inside a window, so white-noise formulas promise too much.
Two estimates that allow for that are put together: blocks of windows as clusters (Liang and Zeger
1986), and one error covariance over the window, pooled over all windows. The first fails where few
blocks tell a parameter (the time of an event), the second where blocks hang together.
"""

from __future__ import annotations

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.greybox.data import Windows

BLOCK_S = 2.0
"""Windows closer than this are not counted as independent in standard errors."""
ROUNDING = 1e-12
"""A clustered variance below this share of the pooled one is rounding."""


def block_numbers(windows: Windows, dt: float, block_s: float = BLOCK_S) -> np.ndarray:
    """(windows,) number of the block of `block_s` s each window lies in; spans never share one."""
    if not windows.count:
        return np.zeros(0, dtype=np.int64)
    position = windows.starts * dt
    key = windows.spans * 10**9 + (position // block_s).astype(np.int64)
    return np.unique(key, return_inverse=True)[1].reshape(-1)


def robust_covariance(
    jacobian: FloatArray, errors: FloatArray, held: np.ndarray, windows: Windows, dt: float,
    prior: FloatArray,
) -> FloatArray:
    """(p, p) sandwich covariance of the parameters; NaN where `held` (p,) or not seen.

    jacobian (windows, length, p), errors (windows, length), prior (r, p). Each standard error is
    the larger one of the clustered and the pooled estimate; correlations are the clustered ones.
    """
    p = jacobian.shape[2]
    out = np.full((p, p), np.nan)
    index = np.flatnonzero(~held)
    index = index[np.any(jacobian[:, :, index], axis=(0, 1))] if windows.count else index
    if not index.size or not windows.count or not np.isfinite(jacobian).all():
        return out
    j = jacobian[:, :, index]
    bread = _bread(j, prior[:, index])
    clustered = bread @ _between_blocks(j, errors, windows, dt) @ bread
    pooled = bread @ _pooled(j, errors) @ bread
    whole = np.diag(pooled)
    if np.any(np.diag(clustered) <= ROUNDING * whole):  # blocks that agree to the last digit
        out[np.ix_(index, index)] = pooled
        return out
    larger = np.sqrt(np.maximum(whole / np.diag(clustered), 1.0))
    out[np.ix_(index, index)] = clustered * np.outer(larger, larger)
    return out


def _bread(j: FloatArray, prior: FloatArray) -> FloatArray:
    """Inverse of J'J with the prior's rows, by QR of the scaled columns."""
    triangle = np.linalg.qr(np.vstack([j.reshape(-1, j.shape[2]), prior]), mode='r')
    norms = np.linalg.norm(triangle, axis=0)
    norms[norms == 0] = 1.0
    inverse = np.linalg.pinv(triangle / norms) / norms[:, None]
    return np.asarray(inverse @ inverse.T)


def _between_blocks(
    j: FloatArray, errors: FloatArray, windows: Windows, dt: float
) -> FloatArray:
    """(p, p) covariance of the score from the spread between blocks of windows."""
    scores = np.einsum('wlp,wl->wp', j, errors)
    blocks = block_numbers(windows, dt)
    count = int(blocks.max()) + 1
    summed = np.zeros((count, j.shape[2]))
    np.add.at(summed, blocks, scores)
    small_sample = count / max(count - j.shape[2], 1)
    return np.asarray(small_sample * summed.T @ summed)


def _pooled(j: FloatArray, errors: FloatArray) -> FloatArray:
    """(p, p) covariance of the score from one error covariance (length, length) of all windows."""
    count, length, p = j.shape
    if count < length:
        weighed = np.tensordot(j, errors, axes=(1, 1)).reshape(count, p, count)
        meat = np.einsum('wpv,wqv->pq', weighed, weighed, optimize=True) / count
    else:
        common = errors.T @ errors / count
        meat = np.tensordot(j, common @ j, axes=((0, 1), (0, 1)))
    return np.asarray(count / max(count - p, 1) * meat)
