"""The black-box fits as a textbook would write them: the yardstick of blackbox_speed.py.

ARX by `numpy.linalg.lstsq`; ARMAX, OE and BJ by Gauss-Newton with `scipy.signal.lfilter` and
`lstsq`, from an ARX model, halving a step that does not lower the loss; covariance from the last
gradient. No second start, no test for another minimum, no care for the start of w, for segments,
for coloured residuals, or for the edge of stability.
"""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

TOLERANCE = 1e-3
"""Ended where N ln V falls by less than this, as the package's own descent."""
HALVINGS = 20


def delayed(x: np.ndarray, lags: range) -> np.ndarray:
    """(n, len(lags)) of x(t - lag), zero before the start."""
    return np.column_stack([np.concatenate((np.zeros(k), x[: x.size - k])) for k in lags])


def arx(y: np.ndarray, u: np.ndarray, na: int, nb: int, nk: int) -> tuple[np.ndarray, float]:
    """Coefficients and loss of A y = B u + e."""
    lead = max(na, nk + nb - 1)
    rows = np.hstack((-delayed(y, range(1, na + 1)), delayed(u, range(nk, nk + nb))))[lead:]
    theta = np.linalg.lstsq(rows, y[lead:], rcond=None)[0]
    return theta, float(np.mean((y[lead:] - rows @ theta) ** 2))


def polynomials(
    theta: np.ndarray, orders: tuple[int, ...], nk: int
) -> tuple[np.ndarray, ...]:
    """A, B, C, D, F of the parameters in this order."""
    a, b, c, d, f = np.split(theta, np.cumsum(orders[:-1]))
    one = np.ones(1)
    return (
        np.r_[one, a], np.r_[np.zeros(nk), b], np.r_[one, c], np.r_[one, d], np.r_[one, f],
    )


def errors(
    y: np.ndarray, u: np.ndarray, theta: np.ndarray, orders: tuple[int, ...], nk: int
) -> tuple[np.ndarray, np.ndarray]:
    """One-step errors (n,) behind the lags' start, zero before it, and their gradient (n, p)."""
    na, nb, nc, nd, nf = orders
    A, B, C, D, F = polynomials(theta, orders, nk)
    lead = max(na, nk + nb - 1)
    w = lfilter(B, F, u)
    v = (lfilter(A, 1.0, y) - w)[lead:]
    e = lfilter(D, C, v)
    inside, left = lfilter(1.0, C, e), lfilter(1.0, C, v)
    driven, fed = lfilter(1.0, F, u), lfilter(1.0, F, w)
    shaped = [
        lfilter(sign * D, C, delayed(x, lags)[lead:], axis=0)
        for x, lags, sign in (
            (y, range(1, na + 1), 1), (driven, range(nk, nk + nb), -1), (fed, range(1, nf + 1), 1),
        )
        if len(lags)
    ]
    noise = [
        sign * delayed(x, range(1, count + 1))
        for x, count, sign in ((inside, nc, -1), (left, nd, 1)) if count
    ]
    plant = shaped if not nf else shaped[:-1]
    return e, np.hstack([*plant, *noise, *shaped[len(plant):]])


def stable(theta: np.ndarray, orders: tuple[int, ...], nk: int) -> bool:
    """Whether C and F have their roots inside the unit circle."""
    _, _, C, _, F = polynomials(theta, orders, nk)
    return all(np.abs(np.roots(p)).max(initial=0.0) < 1.0 for p in (C, F))


def gauss_newton(
    y: np.ndarray, u: np.ndarray, na: int, nb: int, nc: int, nd: int, nf: int, nk: int
) -> tuple[np.ndarray, np.ndarray]:
    """Parameters a, b, c, d, f of A y = (B/F) u + (C/D) e and their covariance."""
    orders = na, nb, nc, nd, nf
    start = arx(y, u, na + nf, nb, nk)[0]
    poles, zeros = start[: na + nf], start[na + nf :]
    theta = np.concatenate((poles[:na], zeros, np.zeros(nc + nd), poles[na:]))
    if not stable(theta, orders, nk):
        theta[-nf:] = 0.0
    e, gradient = errors(y, u, theta, orders, nk)
    for _ in range(60):
        step = np.linalg.lstsq(gradient, e, rcond=None)[0]
        loss = e @ e
        promised = e @ (gradient @ step)
        if y.size * promised < TOLERANCE * loss:
            break
        for halving in range(HALVINGS):
            trial = theta - step / 2**halving
            if stable(trial, orders, nk):
                ahead = errors(y, u, trial, orders, nk)
                if ahead[0] @ ahead[0] < loss:
                    theta, (e, gradient) = trial, ahead
                    break
        else:
            break
    return theta, e @ e / (e.size - theta.size) * np.linalg.inv(gradient.T @ gradient)
