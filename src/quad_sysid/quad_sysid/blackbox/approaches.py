"""The paper's Table 1: the joint and the indirect approach to identification under feedback.

The direct approach is any estimator on (u, y) as recorded. The joint one replaces u by one without
noise, out of the external reference. The indirect one fits the closed loop with the plant's
coefficients as its unknowns (tailor-made parametrisation, Van Donkelaar and Van den Hof 2000), so
that nothing has to be divided out of an estimated loop, which fails where feedback is strong; it
never looks at the recorded command.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial.polynomial import polyadd

from quad_sysid.blackbox.arx import arx
from quad_sysid.blackbox.filters import filter_columns, filter_lags, filter_signal, pulses
from quad_sysid.blackbox.frequency import cross_covariance
from quad_sysid.blackbox.innovations import lead_of, without
from quad_sysid.blackbox.model import Model
from quad_sysid.blackbox.prediction_error import (
    Point,
    bj,
    descend,
    evaluate,
    inverse_of,
    oe,
    point_of,
    with_covariance,
)
from quad_sysid.blackbox.regression import check_informative, check_order
from quad_sysid.blackbox.residuals import AR_ORDER_MAX, noise_filter
from quad_sysid.blackbox.simulate import predict
from quad_sysid.blackbox.start_values import inside
from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.record import IOData

COLOUR = 4
"""Order of C and D of the noise behind a loop; 3 to 6 give the same plant. Without a noise model,
or with 2, the part of u that r explains is so poorly known that the plant's gain comes out low."""
LOOP_NOISE_ORDER = 100
"""Highest order of the noise's filter behind a loop: its integrators leave hardly any noise below
the crossover, which a short autoregression cannot show."""
FORGETS = 0.9
"""Factor per cycle on the poles of a controller by which its start is forgotten: that of PID and
angle was estimated from 24 starts in flight without a failure, from 0.99 on with four and more."""
APART = 10
"""Samples by which one noise may come later in u than in y, or earlier."""


def joint(z: IOData, fit: Callable[[IOData], Model], *, order: int = 6) -> Model:
    """Joint input-output: u and y as outputs of r; `fit` runs on the part of u that r explains.

    The two-stage method (Van den Hof, Schrama 1993), right whatever the noise and unknown the
    controller. `order` is that of the loop's response from r. Fit an output error or BJ
    structure; one with A has no standard errors. Needs r, else BadInputError.
    """
    loop = _from_reference('joint', z, z.u)
    if np.array_equal(loop.u, loop.y):
        return replace(fit(z), approach='joint')
    first = _response('joint', loop, order)
    behind = replace(z, u=np.nan_to_num(predict(first, loop, np.inf)))
    model = replace(fit(behind), approach='joint')
    if model.covariance is None or model.A.size > 1:
        return replace(model, covariance=None)
    covariance, nf = np.array(model.covariance), model.F.size - 1
    is_plant = np.zeros(len(covariance), dtype=bool)
    is_plant[: model.B.size - model.nk] = is_plant[len(covariance) - nf :] = True
    covariance[is_plant] = covariance[:, is_plant] = 0.0  # noise and plant part are independent
    covariance[np.ix_(is_plant, is_plant)] = _of_two_stages(
        first, loop, model, behind)[np.ix_(is_plant, is_plant)]
    return replace(model, covariance=covariance)


def _of_two_stages(first: Model, loop: IOData, second: Model, behind: IOData) -> FloatArray:
    """(p, p) covariance of `second`, fitted behind the free run of `first`; both linearised.

    Noise enters by the errors of y in the second stage, and by those of u in the first: its
    parameters' errors pass through its free run and the plant into the errors of y. Feedback makes
    both of one noise, and where the loop gain is high they nearly cancel. The filters that make
    the errors white shape the weights of each, as in `spread_of`.
    """
    least = max(lead_of(model)[1] + model.F.size for model in (first, second))
    segments = tuple((a, b) for a, b in loop.segments if b - a > least)
    one, two = (evaluate(model, replace(z, segments=segments))
                for model, z in ((first, loop), (second, behind)))

    def whole(parts: list[FloatArray]) -> list[FloatArray]:
        return [np.pad(part, [(b - a - len(part), 0), *[(0, 0)] * (part.ndim - 1)])
                for part, (a, b) in zip(parts, segments, strict=True)]

    # how the free run of the first stage, and so the second one's slope, moves with its parameters
    ahead = np.convolve(np.convolve(second.D, second.B), first.C)
    feeding = np.convolve(np.convolve(second.C, second.F), first.D)
    passed_on = np.sum([
        after.T @ filter_columns(ahead, feeding, before)
        for before, after in zip(whole(one.gradients), whole(two.gradients), strict=True)], axis=0)
    inverse = inverse_of(two)
    turns = (-inverse_of(one) @ passed_on.T @ inverse, inverse)
    unit, weights, innovations, total = np.ones(1), [], [], np.zeros_like(inverse)
    for point, turn in zip((one, two), turns, strict=True):
        errors = whole(point.errors)
        ar, power = noise_filter(errors, LOOP_NOISE_ORDER, len(point.slope))
        weights.append([filter_columns(unit, ar, (g @ turn)[::-1])[::-1]
                        for g in whole(point.gradients)])
        innovations.append([filter_signal(ar, unit, e, ar.size - 1) for e in errors])
        total += power * sum(w.T @ w for w in weights[-1])
    common = cross_covariance(innovations[1], innovations[0], APART)
    for before, after in zip(*weights, strict=True):
        spread = filter_columns(common, unit, np.pad(before, [(0, APART), (0, 0)]))[APART:]
        total += after.T @ spread + spread.T @ after
    return total


def noise_free(where: str, z: IOData, x: FloatArray, order: int | None = None) -> FloatArray:
    """(n,) the part of x that the reference z.r explains: free run of a model from r to x.

    A high-order ARX model, or, with `order`, a BJ model of that order. Raises
    BadInputError, naming `where`, where the reference is missing or cannot serve.
    """
    loop = _from_reference(where, z, x)
    if np.array_equal(loop.u, x):
        return loop.u
    return np.asarray(np.nan_to_num(predict(_response(where, loop, order), loop, np.inf)))


def _from_reference(where: str, z: IOData, x: FloatArray) -> IOData:
    """The data from the reference z.r to x; BadInputError where it cannot serve."""
    if z.r is None:
        raise BadInputError(where, 'needs the external reference r', None, 'give IOData(…, r=…)')
    used = np.concatenate([z.r[start:stop] for start, stop in z.segments])
    if not np.isfinite(used).all():
        raise BadInputError(where, 'the reference r must be finite in all segments',
                            remedy='split the segments where it is not')
    if np.ptp(used) == 0.0:
        raise BadInputError(where, 'the reference r is constant, it drives nothing',
                            float(used[0]), 'use a stretch with excitation')
    return IOData(u=z.r, y=x, dt=z.dt, segments=z.segments)


def _response(where: str, loop: IOData, order: int | None) -> Model:
    """The model of `noise_free`."""
    try:
        if order is not None:
            return bj(loop, order, COLOUR, COLOUR, order, 0)
        longest = max(stop - start for start, stop in loop.segments)
        high = max(1, min(20, longest // 20))  # instruments need no exact model
        return stabilised(arx(loop, high, high, 0))
    except BadInputError as error:
        raise BadInputError(
            where, f'no response from the reference r can be fitted ({error})') from error


def stabilised(model: Model) -> Model:
    """Reflect the roots of A and F into the unit circle, so that the free run stays bounded."""
    return replace(model, A=inside(model.A), F=inside(model.F))


@dataclass(frozen=True)
class LinearController:
    """P(q) u = R(q) r - S(q) y, polynomials in q⁻¹, without limits."""

    P: FloatArray
    R: FloatArray
    S: FloatArray

    def command(self, r: FloatArray, y: FloatArray) -> FloatArray:
        """Return u (n,) for reference r (n,) and output y (n,), from rest."""
        return filter_signal(self.R, self.P, r) - filter_signal(self.S, self.P, y)


def cascade_controller(*, angle_kp: float, rate_kp: float, rate_ki: float, rate_kd: float,
                       d_weight: float, dt: float, trapezoid: bool = True) -> LinearController:
    """C1 and C2 as the contract writes them; r the angle reference, y the rate.

    `d_weight` of the new difference in the D filter, 0..1. The angle is the running sum of the
    rate, by trapezoids or (`trapezoid` False) by rectangles.
    """
    step, slow = np.array([1.0, -1.0]), np.array([1.0, d_weight - 1.0])
    angle = angle_kp * dt * (np.array([0.5, 0.5]) if trapezoid else np.array([1.0, 0.0]))
    if rate_ki:
        forward, common = rate_kp * step + np.array([rate_ki * dt, 0.0]), step
    else:  # the integrator would cancel and leave a root on the unit circle
        forward, common = np.array([rate_kp]), np.ones(1)
    derivative = rate_kd * d_weight / dt * np.convolve(np.convolve(step, step), common)
    characteristic = np.convolve(np.convolve(forward, angle + step), slow)
    return LinearController(P=np.convolve(np.convolve(common, step), slow),
                            R=angle_kp * np.convolve(np.convolve(forward, step), slow),
                            S=np.asarray(polyadd(characteristic, derivative), dtype=float))


def indirect(z: IOData, nb: int, nf: int, nk: int, controller: LinearController, *,
             start: Model | None = None) -> Model:
    """Fit y = (B/F) u behind the known controller to z.y and the reference z.r.

    Consistent whatever the noise. `start` replaces the own start values where it is stable behind
    the controller; its A, C and D do not count. Raises BadInputError where r is missing or no
    stable loop is found to start from.
    """
    nb, nf = check_order('indirect', 'nb', nb, 1), check_order('indirect', 'nf', nf, 0)
    nk = check_order('indirect', 'nk', nk, 1)
    if z.r is None:
        raise BadInputError('indirect', 'needs the external reference r', None,
                            'give IOData(…, r=…)')
    check_informative('indirect', z, nb + nf, nk + nb + nf + controller.P.size)
    model = _start(z, nb, nf, nk, controller, start)
    ar, iterations = np.ones(1), 0
    for _ in range(3):  # each round behind a filter that whitens what the one before left
        end = descend(_evaluate(model, z, controller, ar),
                      lambda model, ar=ar: _evaluate(model, z, controller, ar))  # type: ignore[misc]
        model, iterations = end.model, iterations + end.model.iterations
        raw = _evaluate(model, z, controller, np.ones(1))
        n = sum(e.size for e in raw.errors)
        ar, _ = noise_filter(raw.errors, AR_ORDER_MAX, nb + nf)
    return replace(with_covariance(end), iterations=iterations, samples=n, loss=raw.squares / n,
                   noise_variance=raw.squares / (n - nb - nf))


def _start(z: IOData, nb: int, nf: int, nk: int, controller: LinearController,
           start: Model | None) -> Model:
    """The given start, or the plant between noise-free output and the command that follows it.

    The first of them that is stable behind the controller. Command and output are both taken
    behind P and a filter that forgets the controller's unknown start, as its integrators do not.
    """
    unit, lead = np.ones(1), max(controller.P.size, controller.S.size)
    brief = controller.P * FORGETS ** np.arange(controller.P.size)
    plain = {'C': unit, 'D': unit, 'structure': 'OE', 'orders': {'nb': nb, 'nf': nf, 'nk': nk},
             'approach': 'indirect', 'warnings': ()}
    for order in (None, 6, 8, 4):
        model = start
        if order is not None:
            clean = noise_free('indirect', z, z.y, order)
            u, y = np.zeros_like(z.u), np.zeros_like(z.y)
            for a, b in z.segments:
                r, x = np.asarray(z.r)[a:b], clean[a:b]
                u[a:b] = filter_signal(controller.R, brief, r, lead)
                u[a:b] -= filter_signal(controller.S, brief, x, lead)
                y[a:b] = filter_signal(controller.P, brief, x, lead)
            model = oe(replace(z, u=u, y=y), nb, nf, nk)
        if model is None or (model.A.size, model.B.size - model.nk, model.F.size - 1,
                             model.nk) != (1, nb, nf, nk):
            continue
        model = replace(model, **plain)  # type: ignore[arg-type]
        if math.isfinite(_evaluate(model, z, controller, unit).squares):
            return model
    raise BadInputError('indirect', 'no plant was found that is stable behind this controller',
                        f'nf {nf}', 'check the gains, or use the direct or joint approach')


def _evaluate(model: Model, z: IOData, controller: LinearController, ar: FloatArray) -> Point:
    """Errors of the closed loop behind the filter `ar`, without the effect of its unknown start.

    Their sum of squares is inf where the loop is not stable or no segment is long enough.
    """
    loop = np.asarray(polyadd(np.convolve(model.F, controller.P),
                              np.convolve(model.B, controller.S)), dtype=float)
    if loop[0] != 1.0 or np.max(np.abs(np.roots(loop)), initial=0.0) >= 1.0:
        return point_of(model, [], [])
    nb, nf, states, unit = model.B.size - model.nk, model.F.size - 1, loop.size - 1, np.ones(1)
    errors, gradients = [], []
    for a, b in z.segments:
        n = b - a
        if n <= 2 * (states + ar.size):
            continue
        raw = np.column_stack((np.asarray(z.r)[a:b], pulses(n, states)))
        filtered = filter_columns(unit, loop, raw)
        y = filter_signal(np.convolve(model.B, controller.R), unit, filtered[:, 0])
        refiltered = filter_signal(unit, loop, y)
        u = filter_signal(controller.R, unit, filtered[:, 0])
        u -= filter_signal(controller.S, unit, refiltered)
        p = filter_signal(controller.P, unit, refiltered)
        columns = [-filter_lags(unit, unit, u, range(model.nk, model.nk + nb)),
                   filter_lags(unit, unit, p, range(1, nf + 1))]
        stack = np.column_stack((z.y[a:b] - y, *columns, filtered[:, 1:]))
        stack = filter_columns(ar, unit, stack)[ar.size - 1 :]
        residual = without(stack[:, : 1 + nb + nf], stack[:, 1 + nb + nf :])
        errors.append(residual[:, 0])
        gradients.append(residual[:, 1:])
    return point_of(model, errors, gradients)
