"""Instrumental variables: IV4 and the refined closed-loop CL-RIV.

Instruments carry no noise: the signal behind them is the input, or, under feedback, the external
reference.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from quad_sysid.blackbox.approaches import noise_free, stabilised
from quad_sysid.blackbox.arx import arx
from quad_sysid.blackbox.constants import ROUNDING
from quad_sysid.blackbox.filters import filter_columns, pulses
from quad_sysid.blackbox.frequency import autocovariance
from quad_sysid.blackbox.innovations import one_step_errors, squares, without
from quad_sysid.blackbox.model import Model
from quad_sysid.blackbox.polynomial import delayed, monic
from quad_sysid.blackbox.prediction_error import evaluate
from quad_sysid.blackbox.regression import check_informative, check_orders, lagged
from quad_sysid.blackbox.residuals import spread_of, whitener
from quad_sysid.blackbox.simulate import initial_state, simulate
from quad_sysid.blackbox.start_values import bj_starts, high_order, inside
from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.record import IOData

CONVERGED = 0.02
"""Largest change of a parameter at convergence, in standard errors."""
SWINGING = 6
"""Rounds after which the rounds are averaged."""
UNSTABLE = 'the estimate is unstable; its instruments were made with reflected poles'


def iv4(z: IOData, na: int, nb: int, nk: int) -> Model:
    """Fit A y = B u + v by the four-stage instrumental variable method (Ljung 1999, eq. 15.26).

    The signal behind the instruments is the reference z.r where the data hold one, else u, which
    is right in open loop only. The covariance allows for errors that the filter leaves coloured.
    Raises BadInputError as `arx`.
    """
    orders = check_orders('iv4', na=na, nb=nb, nk=nk)
    check_informative('iv4', z, 2 * (na + nb), max(na, nk + nb - 1))
    source = z.u if z.r is None else noise_free('iv4', z, z.u)
    first = arx(z, na, nb, nk)
    theta, _ = _solve('iv4', _blocks(z, source, first, np.ones(1), np.ones(1)))
    second = replace(first, A=monic(theta[:na]), B=delayed(theta[na:], nk), covariance=None)
    errors = [part.errors - part.errors.mean() for part in one_step_errors(second, z)]
    n = sum(e.size for e in errors)
    ar = whitener(autocovariance(errors, min(na + nb, n // 10)), n)
    blocks = _blocks(z, source, second, ar, np.ones(1))
    theta, weights = _solve('iv4', blocks)
    model = replace(second, A=monic(theta[:na]), B=delayed(theta[na:], nk), structure='IV4',
                    orders=orders,
                    covariance=spread_of(weights, [y - x @ theta for x, _, y in blocks]))
    n, sse = squares(model, z)
    return replace(model, samples=n, loss=sse / n, noise_variance=sse / (n - na - nb),
                   warnings=() if model.stable else (UNSTABLE,))


def clriv(z: IOData, nb: int, nc: int, nd: int, nf: int, nk: int) -> Model:
    """Fit y = (B/F) u + (C/D) e by closed-loop refined instrumental variables.

    The noise-free input and output, both driven by the external reference z.r, are the
    instruments; data and instruments are filtered by D/(C F), renewed each round (Gilson,
    Garnier, Young, Van den Hof 2008). Raises BadInputError where there is no reference.
    """
    orders = check_orders('clriv', nb=nb, nc=nc, nd=nd, nf=nf, nk=nk)
    check_informative('clriv', z, 2 * (nb + nc + nd + nf), nk + nb - 1 + nd + nf)
    clean = noise_free('clriv', z, z.u)
    model = next(bj_starts(high_order(z, nk, nb + nc + nd + nf), nb, nc, nd, nf))
    model = replace(model, structure='CLRIV', orders=orders)
    converged, iteration, was_unstable = False, 0, False
    while iteration < 15:
        iteration += 1
        refined, variance, noise_spread = _noise_step(model, z)
        shape = np.convolve(refined.C, refined.F)
        theta, weights = _solve('clriv', _blocks(z, clean, refined, refined.D, shape, nf))
        spread = np.sum([w.T @ w for w in weights], axis=0)
        f = monic(theta[:nf])
        was_unstable = inside(f) is not f
        refined = replace(refined, B=delayed(theta[nf:], nk), F=inside(f))
        sigma = np.sqrt(np.maximum(np.diag(spread) * variance, 1e-300))
        change = np.concatenate((refined.F[1:] - model.F[1:],
                                refined.B[nk:] - model.B[nk:])) / sigma
        if iteration > SWINGING:  # poorly determined parameters oscillate about the solution
            share = 1.0 / (iteration - SWINGING + 1.0)
            f = inside(model.F + share * (refined.F - model.F))
            refined = replace(refined, B=model.B + share * (refined.B - model.B), F=f)
        covariance = np.zeros((nb + nc + nd + nf,) * 2)  # plant and noise part are independent
        plant = [*range(nb + nc + nd, nb + nc + nd + nf), *range(nb)]
        covariance[np.ix_(plant, plant)] = variance * spread
        covariance[nb : nb + nc + nd, nb : nb + nc + nd] = noise_spread
        model = replace(refined, covariance=covariance)
        if float(np.max(np.abs(change))) < CONVERGED:
            converged = True
            break
    n, sse = squares(model, z)
    return replace(model, converged=converged and not was_unstable, iterations=iteration,
                   samples=n, loss=sse / n, noise_variance=sse / (n - model.parameters.size),
                   warnings=(UNSTABLE,) if was_unstable else ())


Block = tuple[FloatArray, FloatArray, FloatArray]
"""Regressors (m, p), instruments (m, p), output (m,), all filtered."""


def _blocks(z: IOData, source: FloatArray, model: Model, num: FloatArray, den: FloatArray,
            starts: int = 0) -> list[Block]:
    """Rows of each segment for A F y = B u behind num/den, instruments from `model` and `source`.

    Regressors are the lags of -y, then of u. The filter's unknown start is left out with the
    first rows, and with the span of as many pulses behind it as it has `starts`.
    """
    runner, y_lags = stabilised(model), range(1, model.denominator.size)
    u_lags, lead = range(model.nk, model.B.size), max(len(y_lags), model.B.size - 1)
    blocks = []
    for start, stop in z.segments:
        if stop - start <= lead + num.size + den.size:
            continue
        y, s, n = z.y[start:stop], source[start:stop], stop - start
        x = simulate(runner, s, initial_state(runner, s, y) if starts else None)
        stack = np.column_stack(
            (-lagged(y, y_lags, lead, n), lagged(z.u[start:stop], u_lags, lead, n),
             -lagged(x, y_lags, lead, n), lagged(s, u_lags, lead, n), y[lead:],
             pulses(n - lead, starts)))
        smooth = filter_columns(num, den, stack)[num.size - 1 :]
        p = len(y_lags) + len(u_lags)
        residual = without(smooth[:, : 2 * p + 1], smooth[:, 2 * p + 1 :])
        blocks.append((residual[:, :p], residual[:, p : 2 * p], residual[:, -1]))
    return blocks


def _solve(where: str, blocks: list[Block]) -> tuple[FloatArray, list[FloatArray]]:
    """Return theta = (ZᵀX)⁻¹ Zᵀy, and by block the weights (m, p) of each row's y in it."""
    if not blocks:
        raise BadInputError(where, 'every segment is too short for the orders',
                            remedy='take lower orders or longer segments')
    scale = np.sqrt(sum(np.einsum('ij,ij->j', x, x) for x, _, _ in blocks))
    unit = np.sqrt(sum(np.einsum('ij,ij->j', w, w) for _, w, _ in blocks))
    if not ((scale > 0.0).all() and (unit > 0.0).all() and np.isfinite(unit).all()):
        raise BadInputError(where, 'an instrument is zero or diverges', remedy='lower the orders')
    cross = sum(((w / unit).T @ (x / scale) for x, w, _ in blocks), np.zeros((scale.size,) * 2))
    if ROUNDING * np.linalg.cond(cross) > 1.0:
        raise BadInputError(where, 'the instruments do not excite all parameters',
                            remedy='lower the orders')
    right = sum(((w / unit).T @ y for _, w, y in blocks), np.zeros(scale.size))
    inverse = np.linalg.inv(cross) / scale[:, None]
    return inverse @ right, [(w / unit) @ inverse.T for _, w, _ in blocks]


def _noise_step(model: Model, z: IOData) -> tuple[Model, float, FloatArray]:
    """One Gauss-Newton step on C and D, the plant held; variance of e, covariance of the step."""
    point = evaluate(model, z)
    first, count = model.B.size - model.nk, model.C.size + model.D.size - 2
    rows, n = slice(first, first + count), sum(e.size for e in point.errors)
    variance = point.squares / max(n - model.parameters.size, 1)
    inverse = np.linalg.pinv(point.hessian[rows, rows], rcond=1e-12, hermitian=True)
    theta = model.parameters.copy()
    theta[rows] -= inverse @ point.slope[rows]
    updated = model.with_parameters(theta)
    return replace(updated, C=inside(updated.C)), variance, np.asarray(variance * inverse)
