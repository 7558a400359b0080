"""ARMAX, OE and BJ by the prediction error method: Gauss-Newton with exact gradients.

Start values come from start_values.py, the descent from descent.py; here they are put together.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

from quad_sysid.blackbox.descent import (
    Point,
    decrement,
    descend,
    evaluate,
    on_edge,
    sum_of_squares,
    with_covariance,
)
from quad_sysid.blackbox.polynomial import Model
from quad_sysid.blackbox.regression import check_exciting, check_informative, check_orders
from quad_sysid.blackbox.start_values import (
    HighOrder,
    armax_starts,
    bj_starts,
    high_order,
    oe_starts,
    reinserted,
    stabilised,
)
from quad_sysid.errors import BadInputError
from quad_sysid.record import IOData

AGREED = 0.5
"""Difference of N ln V below which two descents have found the same minimum."""

REINSERTED = 3
"""Places of a nearly cancelling pair from which the descent is tried again."""

EDGE_TOLD = {
    'F': 'a pole is held at the edge of stability (an integrator): the rate drifts in a way that '
    'the command does not explain',
    'C': 'a zero of the noise model is held at the unit circle: the residual lacks that frequency',
}
"""Polynomial → meaning of a root at the edge of stability."""

Starts = Callable[[HighOrder], Iterator[Model]]
Descent = tuple[Model, Point]
"""Where a descent ended: the model, without its covariance, and the criterion there."""


def armax(z: IOData, na: int, nb: int, nc: int, nk: int, *, start: Model | None = None) -> Model:
    """Fit A y = B u + C e over all segments.

    Orders as in MATLAB; `start` replaces the own start values. C is kept stable. Raises
    BadInputError for orders or data that cannot carry the fit; `converged` says how it ended.
    """
    orders = check_orders('armax', na=na, nb=nb, nc=nc, nk=nk)
    check_informative('armax', z, na + nb + nc, max(na, nk + nb - 1))
    check_exciting('armax', z, nb)
    return _best('ARMAX', orders, z, start, lambda ho: armax_starts(ho, na, nb, nc))


def oe(z: IOData, nb: int, nf: int, nk: int, *, start: Model | None = None) -> Model:
    """Fit y = (B/F) u + e, the least free-run error, over all segments. F is kept stable.

    The covariance allows for a coloured residual. Otherwise as `armax`.
    """
    orders = check_orders('oe', nb=nb, nf=nf, nk=nk)
    check_informative('oe', z, nb + nf, nk + nb - 1 + nf)
    check_exciting('oe', z, nb + nf)
    return _best('OE', orders, z, start, lambda ho: oe_starts(ho, nb, nf))


def bj(z: IOData, nb: int, nc: int, nd: int, nf: int, nk: int, *, start: Model | None = None,
       thorough: bool = True) -> Model:
    """Fit y = (B/F) u + (C/D) e over all segments. C and F are kept stable. As `armax`.

    Not `thorough`, the minimum that the best start value leads to will do.
    """
    orders = check_orders('bj', nb=nb, nc=nc, nd=nd, nf=nf, nk=nk)
    check_informative('bj', z, nb + nc + nd + nf, nk + nb - 1 + nd + nf)
    check_exciting('bj', z, nb + nf)
    return _best('BJ', orders, z, start, lambda ho: bj_starts(ho, nb, nc, nd, nf),
                 thorough=thorough)


def _best(structure: str, orders: dict[str, int], z: IOData, start: Model | None, starts: Starts,
          *, thorough: bool = True) -> Model:
    """Fit from the given start, or from several until the loss is as low as expected."""
    if start is not None:
        _check_start(structure, orders, start)
        first = stabilised(start)
        best = descend(first, evaluate(first, z), z)
    else:
        ho = high_order(z, orders['nk'], sum(orders.values()) - orders['nk'])
        spare = max(ho.model.parameters.size - sum(orders.values()) + orders['nk'], 0)
        goal = ho.model.loss * math.exp((spare + math.sqrt(2.0 * spare)) / ho.model.samples)
        found = starts(ho)
        first = next(found)
        best = descend(first, evaluate(first, z), z)
        if thorough:
            best = _without_false_pair(_best_of(best, found, z, goal), z)
    model = with_covariance(*best)
    return replace(model, structure=structure, orders=orders, warnings=_warnings(model))


def _best_of(best: Descent, others: Iterator[Model], z: IOData, goal: float) -> Descent:
    """Descend from other starts too, until the loss is as low as `goal` or two of them agree."""
    while not (best[0].converged and best[0].loss <= goal):
        start = next(others, None)
        if start is None:
            break
        point = evaluate(start, z)
        if _agree(best[0], sum_of_squares(point) - decrement(point)):
            break
        other = descend(start, point, z, best[0].loss)
        agreed = other[0].converged and _agree(best[0], sum_of_squares(other[1]))
        best = _better(best, other)
        if agreed:
            break
    return best


def _agree(model: Model, squares: float) -> bool:
    """Whether a sum of squares that another start has, or promises, is the converged model's."""
    if not (model.converged and 0.0 < squares < math.inf):
        return False
    return abs(math.log(squares / model.samples / model.loss)) * model.samples < AGREED


def _without_false_pair(best: Descent, z: IOData) -> Descent:
    """Descend again from the most promising places of a nearly cancelling pair."""
    moved = [(model, evaluate(model, z)) for model in reinserted(best[0])]
    moved.sort(key=lambda item: sum_of_squares(item[1]) - decrement(item[1]))
    for model, point in moved[:REINSERTED]:
        best = _better(best, descend(model, point, z, best[0].loss))
    return best


def _better(one: Descent, other: Descent) -> Descent:
    """The converged one of two; if both or none converged, that with the lower loss."""
    return min(one, other, key=lambda end: (not end[0].converged, end[0].loss))


def _check_start(structure: str, orders: dict[str, int], start: Model) -> None:
    """Raise BadInputError where the start's polynomials do not have the orders asked for."""
    sizes = {'na': start.A.size - 1, 'nb': start.B.size - start.nk, 'nc': start.C.size - 1,
             'nd': start.D.size - 1, 'nf': start.F.size - 1, 'nk': start.nk}
    for name, size in sizes.items():
        if size != orders.get(name, 0):
            raise BadInputError(structure.lower(),
                                f'start must have {name} = {orders.get(name, 0)}', size)


def _warnings(model: Model) -> tuple[str, ...]:
    """Warnings for the user of the fit."""
    told = [EDGE_TOLD[name] for name in on_edge(model)]
    if not model.converged:
        told.insert(0, f'did not converge in {model.iterations} iterations')
    if model.covariance is None:
        told.append('the data do not determine all parameters: no standard errors')
    return tuple(told)
