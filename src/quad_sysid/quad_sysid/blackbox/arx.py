"""ARX by least squares, and the search over whole ranges of its orders from one factorisation.

No iterative estimator belongs here (prediction_error.py), nor instruments (instruments.py).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from quad_sysid.blackbox.constants import EXACT
from quad_sysid.blackbox.model import Model
from quad_sysid.blackbox.polynomial import delayed, monic
from quad_sysid.blackbox.regression import (
    arx_blocks,
    check_informative,
    check_order,
    check_orders,
    solve_triangular_factor,
    triangular,
    usable_rows,
)
from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.qr import upper
from quad_sysid.record import IOData

IntArray = npt.NDArray[np.int64]
CRITERIA = ('aic', 'bic')


def arx(z: IOData, na: int, nb: int, nk: int) -> Model:
    """Fit A y = B u + e by least squares over all segments (Ljung 1999, eq. 7.34).

    Rows start max(na, nk + nb - 1) samples into each segment. Covariance is
    noise_variance (XᵀX)⁻¹. Raises BadInputError for orders or data that cannot carry the fit.
    """
    orders = check_orders('arx', na=na, nb=nb, nk=nk)
    lead = max(na, nk + nb - 1)
    check_informative('arx', z, na + nb, lead)
    blocks = arx_blocks(z, range(1, na + 1), range(nk, nk + nb), lead)
    rows = usable_rows(z, lead)
    theta, sse, gram_inverse = solve_triangular_factor('arx', triangular(blocks))
    variance = sse / (rows - na - nb)
    return Model(structure='ARX', orders=orders, A=monic(theta[:na]), B=delayed(theta[na:], nk),
                 C=np.ones(1), D=np.ones(1), F=np.ones(1), nk=nk, dt=z.dt, noise_variance=variance,
                 covariance=variance * gram_inverse, samples=rows, loss=sse / rows)


@dataclass(frozen=True)
class OrderSearch:
    """All compared ARX orders, one entry per model, over the rows that they share."""

    na: IntArray
    nb: IntArray
    nk: IntArray
    loss: FloatArray
    """V = SSE/N."""
    samples: int
    """N, the shared rows."""
    criterion: str
    model: Model
    """The best by `criterion`, fitted on all rows that its own orders allow."""

    @property
    def parameters(self) -> IntArray:
        """Number of parameters k of each model."""
        return self.na + self.nb

    def values(self, criterion: str | None = None) -> FloatArray:
        """Value of `aic` or `bic` of each model (lower is better)."""
        return criterion_values(criterion or self.criterion, self.loss, self.parameters,
                                self.samples)

    @property
    def best(self) -> tuple[int, int, int]:
        """(na, nb, nk) with the lowest value; the fewest parameters where values tie."""
        i = _first_best(self.values(), self.parameters)
        return int(self.na[i]), int(self.nb[i]), int(self.nk[i])

    @property
    def at_edge(self) -> tuple[str, ...]:
        """Names of the orders that ended at the upper edge of their range."""
        ranges = {'na': self.na, 'nb': self.nb, 'nk': self.nk}
        return tuple(
            name for (name, values), order in zip(ranges.items(), self.best, strict=True)
            if values.max() > values.min() and order == values.max()
        )


def criterion_values(criterion: str, loss: FloatArray, k: IntArray, n: int) -> FloatArray:
    """N ln V + penalty per parameter: 2 of aic, ln N of bic."""
    if criterion not in CRITERIA:
        raise BadInputError('search_arx', f'criterion must be one of {", ".join(CRITERIA)}',
                            criterion)
    return np.asarray(n * np.log(loss) + (2.0 if criterion == 'aic' else np.log(n)) * k)


def search_arx(z: IOData, na: int | Iterable[int] = range(1, 11),
               nb: int | Iterable[int] = range(1, 11), nk: int | Iterable[int] = range(1, 9),
               criterion: str = 'aic') -> OrderSearch:
    """Fit every (na, nb, nk) of the ranges at once and pick the best by `criterion`.

    One QR of the widest regressor over the rows that all models share; every model's residual
    sum then comes from that small factor: for each (na, nk) the factor of its columns gives the
    losses of all nb together. Raises BadInputError as `arx` does.
    """
    nas, nbs = _orders('na', na, 0), _orders('nb', nb, 1)
    nks = _orders('nk', nk, 0)
    lead = max(nas[-1], nks[-1] + nbs[-1] - 1)
    check_informative('search_arx', z, nas[-1] + nbs[-1], lead)
    u_lags = range(nks[0], nks[-1] + nbs[-1])
    blocks = arx_blocks(z, range(1, nas[-1] + 1), u_lags, lead)
    rows = usable_rows(z, lead)
    r = triangular(blocks)
    floor = EXACT * float(np.sum(r[:, -1] ** 2))
    sse = np.maximum(_losses(r, nas, nbs, nks), floor)
    grid = np.meshgrid(nas, nbs, nks, indexing='ij')
    k = (grid[0] + grid[1]).ravel()
    best = _first_best(criterion_values(criterion, sse.ravel() / rows, k, rows), k)
    orders = [int(axis.ravel()[best]) for axis in grid]
    return OrderSearch(na=grid[0].ravel(), nb=grid[1].ravel(), nk=grid[2].ravel(),
                       loss=sse.ravel() / rows, samples=rows, criterion=criterion,
                       model=arx(z, *orders))


def delay_estimate(z: IOData, na: int = 8, nb: int = 4, nk_min: int = 0, nk_max: int = 20) -> int:
    """Delay in samples: nk of the ARX model with the lowest BIC, of orders up to na and nb."""
    nk_min = check_order('delay_estimate', 'nk_min', nk_min, 0)
    nk_max = check_order('delay_estimate', 'nk_max', nk_max, nk_min)
    na, nb = (check_order('delay_estimate', k, v, 1) for k, v in (('na', na), ('nb', nb)))
    check_informative('delay_estimate', z, na + nb, max(na, nk_max + nb - 1))
    search = search_arx(z, range(1, na + 1), range(1, nb + 1), range(nk_min, nk_max + 1),
                        criterion='bic')
    return search.model.nk


def _first_best(values: FloatArray, k: IntArray) -> int:
    """Index of the lowest value; the fewest parameters where values tie."""
    tied = np.flatnonzero(values == values.min())
    return int(tied[np.argmin(k[tied])])


def _orders(name: str, value: int | Iterable[int], least: int) -> list[int]:
    """Sorted distinct orders of one range."""
    orders = [value] if isinstance(value, (int, np.integer)) else list(value)
    if not orders:
        raise BadInputError('search_arx', f'{name} must not be empty', orders)
    return sorted({check_order('search_arx', name, order, least) for order in orders})


def _losses(r: FloatArray, nas: list[int], nbs: list[int], nks: list[int]) -> FloatArray:
    """(len(nas), len(nbs), len(nks)) residual sums of squares from R of [y lags | u lags | y].

    The y lags stand first, so behind `na` of them the rows na.. of R carry what is left of every
    other column; a stack of small QRs in the order u_nk, u_nk+1, …, y gives all nb at once.
    """
    m, na_max, nb_max = r.shape[0], nas[-1], nbs[-1]
    stack = np.zeros((len(nas), len(nks), m, nb_max + 1))
    for i, na in enumerate(nas):
        for j, nk in enumerate(nks):
            first = na_max + nk - nks[0]
            stack[i, j, : m - na, :nb_max] = r[na:, first : first + nb_max]
            stack[i, j, : m - na, nb_max] = r[na:, -1]
    last = upper(stack)[..., :, nb_max]
    tails = np.cumsum(last[..., ::-1] ** 2, axis=-1)[..., ::-1]
    return np.asarray(np.moveaxis(tails[..., nbs], -1, 1))
