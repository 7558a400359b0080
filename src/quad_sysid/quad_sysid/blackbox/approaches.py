"""The paper's Table 1: the joint and the indirect approach to identification under feedback.

The direct approach is any estimator on (u, y) as recorded. The joint one replaces u by one without
noise, out of the external reference. The indirect one fits the closed loop with the plant's
coefficients as its unknowns (tailor-made parametrisation, Van Donkelaar and Van den Hof 2000), so
that nothing has to be divided out of an estimated loop, which fails where feedback is strong; it
never looks at the recorded command.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.optimize import least_squares

from quad_sysid.blackbox.arx import arx
from quad_sysid.blackbox.filters import filter_columns, filter_signal, pulses
from quad_sysid.blackbox.frequency import autocovariance
from quad_sysid.blackbox.innovations import without
from quad_sysid.blackbox.polynomial import Model, delayed, monic
from quad_sysid.blackbox.prediction_error import oe
from quad_sysid.blackbox.regression import check_informative, check_order
from quad_sysid.blackbox.residuals import AR_ORDER_MAX, whitener
from quad_sysid.blackbox.simulate import predict
from quad_sysid.blackbox.start_values import inside
from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.record import IOData

LOOP_ORDER = 20
"""Order of the ARX model for instruments, which need not be exact."""
STAGE_ORDER = 6
"""Order of the output error model of the loop, whose errors bias the plant."""

Fit = Callable[[IOData], Model]


def joint(z: IOData, fit: Fit, *, order: int = STAGE_ORDER) -> Model:
    """Joint input-output: u and y as outputs of r; `fit` runs on the part of u that r explains.

    The two-stage method (Van den Hof, Schrama 1993), right whatever the noise and unknown the
    controller. `order` is that of the loop's response from r. Fit an output error or BJ
    structure. Needs r, else BadInputError.
    """
    clean = noise_free('joint', z, z.u, z.r, order)
    return replace(fit(replace(z, u=clean)), approach='joint')


def noise_free(where: str, z: IOData, x: FloatArray, external: FloatArray | None,
               order: int | None = None) -> FloatArray:
    """(n,) the part of x that the external signal explains: free run of a model from r to x.

    A high-order ARX model, or, with `order`, an output error model of that order. Raises
    BadInputError, naming `where`, where the signal is missing or cannot serve.
    """
    if external is None:
        raise BadInputError(where, 'needs the external reference r', None, 'give IOData(…, r=…)')
    r = np.asarray(external, dtype=float)
    if r.shape != z.u.shape:
        raise BadInputError(where, f'the reference r must have {z.u.size} samples', r.shape)
    inside = np.concatenate([r[start:stop] for start, stop in z.segments])
    if not np.isfinite(inside).all():
        raise BadInputError(where, 'the reference r must be finite in all segments',
                            remedy='split the segments where it is not')
    if np.ptp(inside) == 0.0:
        raise BadInputError(where, 'the reference r is constant, it drives nothing',
                            float(inside[0]), 'use a stretch with excitation')
    if np.array_equal(r, x):
        return r
    try:
        loop = IOData(u=r, y=x, dt=z.dt, segments=z.segments)
        model = _loop_model(loop, order)
    except BadInputError as error:
        raise BadInputError(
            where, f'no response from the reference r can be fitted ({error})') from error
    return np.asarray(np.nan_to_num(predict(model, loop, np.inf)))


def _loop_model(loop: IOData, order: int | None) -> Model:
    if order is not None:
        return oe(loop, order, order, 0)
    longest = max(stop - start for start, stop in loop.segments)
    high = max(1, min(LOOP_ORDER, longest // 20))
    return stabilised_plant(arx(loop, high, high, 0))


def stabilised_plant(model: Model) -> Model:
    """Reflect the roots of A and F into the unit circle, so that the free run stays bounded."""
    return replace(model, A=inside(model.A), F=inside(model.F))


STAGE_ORDERS = (6, 8, 4)
"""Of the loop's output error model that gives start values; the next where the first fails."""
WHITENED = 3
"""Rounds of fitting, each behind a filter that whitens what the one before left."""
MAX_ITERATIONS = 40
TOLERANCE = 1e-3
"""Of N ln V, by which the last step of a descent may still have lowered it."""
BEYOND = 1e6
"""Error, rad/s, that stands for an unstable loop."""


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
    own = np.convolve(np.convolve(forward, angle + step), slow)
    return LinearController(P=np.convolve(np.convolve(common, step), slow),
                            R=angle_kp * np.convolve(np.convolve(forward, step), slow),
                            S=_sum(own, derivative))


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
    model = _given(start, z, nb, nf, nk, controller) or _start(z, nb, nf, nk, controller)
    ar, converged, iterations = np.ones(1), False, 0
    for _ in range(WHITENED):
        model, converged, count = _descend(model, z, controller, ar)
        iterations += count
        errors = [e for e, _ in _errors(model, z, controller, np.ones(1)) or ()]
        n = sum(e.size for e in errors)
        ar = whitener(autocovariance(errors, min(AR_ORDER_MAX, n // 10)), n)
    parts = _errors(model, z, controller, ar) or ()
    e, gradient = (np.concatenate(part) for part in zip(*parts, strict=True))
    scale = np.linalg.norm(gradient, axis=0)
    spread = np.linalg.pinv(gradient.T @ gradient / np.outer(scale, scale), hermitian=True,
                            rcond=1e-14)
    return replace(model, converged=converged, iterations=iterations, samples=n,
                   covariance=float(e @ e) / (e.size - nb - nf) * spread / np.outer(scale, scale),
                   loss=sum(float(e @ e) for e in errors) / n,
                   noise_variance=sum(float(e @ e) for e in errors) / (n - nb - nf))


def _given(start: Model | None, z: IOData, nb: int, nf: int, nk: int,
           controller: LinearController) -> Model | None:
    """The given start as an output error model; None where it cannot serve."""
    if start is None or start.A.size > 1:
        return None
    if (start.B.size - start.nk, start.F.size - 1, start.nk) != (nb, nf, nk):
        return None
    one = np.ones(1)
    model = replace(start, C=one, D=one, structure='OE', orders={'nb': nb, 'nf': nf, 'nk': nk},
                    approach='indirect', warnings=())
    return None if _errors(model, z, controller, one) is None else model


def _start(z: IOData, nb: int, nf: int, nk: int, controller: LinearController) -> Model:
    """Plant between the noise-free output and the command that the controller gives for it."""
    for order in STAGE_ORDERS:
        clean = noise_free('indirect', z, z.y, z.r, order)
        u = np.zeros_like(z.u)
        for a, b in z.segments:
            u[a:b] = controller.command(z.r[a:b], clean[a:b]) if z.r is not None else 0.0
        model = replace(oe(replace(z, u=u), nb, nf, nk), approach='indirect')
        if _errors(model, z, controller, np.ones(1)) is not None:
            return model
    raise BadInputError('indirect', 'no plant was found that is stable behind this controller',
                        f'nf {nf}', 'check the gains, or use the direct or joint approach')


Errors = list[tuple[FloatArray, FloatArray]]
"""Per segment e (m,) and its gradient (m, nb + nf), the unknown start of the loop taken out."""


def _errors(model: Model, z: IOData, controller: LinearController,
            ar: FloatArray) -> Errors | None:
    """Errors of the closed loop behind the filter `ar`; None where it is not stable."""
    loop = _sum(np.convolve(model.F, controller.P), np.convolve(model.B, controller.S))
    if z.r is None or loop[0] != 1.0 or np.max(np.abs(np.roots(loop)), initial=0.0) >= 1.0:
        return None
    nb, nf, states, one = model.B.size - model.nk, model.F.size - 1, loop.size - 1, np.ones(1)
    found: Errors = []
    for a, b in z.segments:
        n = b - a
        if n <= 2 * (states + ar.size):
            continue
        raw = np.column_stack((z.r[a:b], pulses(n, states)))
        driven = filter_columns(one, loop, raw)
        y = filter_signal(np.convolve(model.B, controller.R), one, driven[:, 0])
        again = filter_signal(one, loop, y)
        u = filter_signal(controller.R, one, driven[:, 0])
        u -= filter_signal(controller.S, one, again)
        p = filter_signal(controller.P, one, again)
        columns = [
            -_behind(u, model.nk + i) for i in range(nb)
        ] + [_behind(p, i) for i in range(1, nf + 1)]
        stack = np.column_stack((z.y[a:b] - y, *columns, driven[:, 1:]))
        stack = filter_columns(ar, one, stack)[ar.size - 1 :]
        rest = without(stack[:, : 1 + nb + nf], stack[:, 1 + nb + nf :])
        found.append((rest[:, 0], rest[:, 1:]))
    return found or None


def _descend(model: Model, z: IOData, controller: LinearController,
             ar: FloatArray) -> tuple[Model, bool, int]:
    """The model at the nearest minimum, whether that was reached, and in how many steps."""
    nb = model.B.size - model.nk

    def at(theta: FloatArray) -> Model:
        return replace(model, B=delayed(theta[:nb], model.nk), F=monic(theta[nb:]))

    @lru_cache(maxsize=4)
    def judged(theta: bytes) -> tuple[FloatArray, FloatArray]:
        parts = _errors(at(np.frombuffer(theta)), z, controller, ar)
        if parts is None:  # an unstable loop: a step that is taken back
            return np.full(rows, BEYOND), np.zeros((rows, model.parameters.size))
        return np.concatenate([e for e, _ in parts]), np.concatenate([j for _, j in parts])

    start = model.parameters
    rows = sum(e.size for e, _ in _errors(model, z, controller, ar) or ())
    found = least_squares(lambda x: judged(x.tobytes())[0], start,
                          lambda x: judged(x.tobytes())[1], method='trf', x_scale='jac',
                          ftol=TOLERANCE / max(rows, 1), xtol=None, gtol=None,
                          max_nfev=MAX_ITERATIONS)
    return at(found.x), bool(found.status > 0), int(found.nfev)


def _sum(a: FloatArray, b: FloatArray) -> FloatArray:
    """Sum of two polynomials in q⁻¹."""
    size = max(a.size, b.size)
    return np.pad(a, (0, size - a.size)) + np.pad(b, (0, size - b.size))


def _behind(x: FloatArray, lag: int) -> FloatArray:
    """Return x (n,) delayed by `lag` samples, zero before its start."""
    return np.concatenate((np.zeros(lag), x[: x.size - lag]))
