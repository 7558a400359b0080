"""The black-box part of one axis from its data to the selected model: the paper's two steps.

Which approaches the signals allow (Table 1), whether the command depends on the rate, and the
order of the steps. A test that sees no feedback does not exclude it: with a fast controller or a
large command, the rate's noise is lost in the command. So the absence of feedback needs its own
evidence.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from quad_sysid.blackbox import (
    LinearController,
    Model,
    bj,
    cascade_controller,
    fit_percent,
    indirect,
    joint,
    residual_test,
)
from quad_sysid.blackbox.innovations import one_step_errors
from quad_sysid.blackbox.regression import lagged, solve_triangular_factor, triangular
from quad_sysid.contract import FloatArray
from quad_sysid.errors import QuadSysidError
from quad_sysid.loop.cascade import CascadeGains, weight_of
from quad_sysid.model.data import AxisData
from quad_sysid.model.effect import required
from quad_sysid.pipeline import blackbox_part, step_b
from quad_sysid.pipeline.advice import advice, rivalry
from quad_sysid.pipeline.answer import AxisAnswer, ModelRow, Selection, Use
from quad_sysid.pipeline.assemble import Support
from quad_sysid.pipeline.blackbox_part import ORDERS, Fits, successful_fits
from quad_sysid.record import IOData

KNOWN_CONTROLLER_PCT = 70.0
"""Least fit of the controller's computed command to the recorded one, %: the rest, an amplitude of
three tenths, is what limits and an outer loop may add."""


def approaches(z: IOData, gains: CascadeGains | None, *, behind_attitude: bool, one_loop: bool,
               closed: bool | None) -> tuple[tuple[Use, ...], LinearController | None]:
    """Judge each approach by the signals it needs; the controller where `indirect` is possible.

    `behind_attitude`: the external reference is the attitude set-point and not an excitation
    that was added behind C1 or C2. `one_loop`: all training was flown with the same gains.
    """
    no = ''
    if closed is False:
        no = 'no feedback in the data: the direct approach has nothing to avoid'
    elif z.r is None:
        no = 'no external reference that moves: record /setpoint/attitude or /excitation/applied'
    elif not one_loop:
        no = 'the training was flown with several sets of gains, which are several loops'
    controller, reason = None, no
    if not no and gains is None:
        reason = '/gains/active does not say the controller'
    elif not no and not behind_attitude:
        reason = 'the excitation acts behind C1 or C2, not on the attitude reference'
    elif not no and gains is not None:
        controller, reason = _known(z, gains)
    return (
        Use('direct', possible=True, because='command and rate are recorded'),
        Use('indirect', possible=controller is not None, because=reason),
        Use('joint', possible=not no,
            because=no or 'command, rate and reference are recorded'),
    ), controller


def _known(z: IOData, gains: CascadeGains) -> tuple[LinearController | None, str]:
    """The controller, if it reproduces the recorded command, and the finding in words."""
    controllers = [controller(gains, z.dt, trapezoid=trapezoid) for trapezoid in (True, False)]
    best = max(controllers, key=lambda way: reproduced(z, way))
    fit = reproduced(z, best)
    if fit < KNOWN_CONTROLLER_PCT:
        return None, (
            f'the controller of /gains/active gives only {max(fit, 0.0):.0f} % of the recorded '
            'command; limits or another loop act as well'
        )
    return best, f'reference and rate are recorded, {fit:.0f} % of the command is the controller'


def controller(gains: CascadeGains, dt: float, *, trapezoid: bool = True) -> LinearController:
    """C1 and C2 without limits; the firmware's angle by trapezoids or by rectangles."""
    return cascade_controller(angle_kp=gains.angle_kp, rate_kp=gains.rate_kp,
                              rate_ki=gains.rate_ki, rate_kd=gains.rate_kd,
                              d_weight=weight_of(gains.d_filter_hz, dt), dt=dt,
                              trapezoid=trapezoid)


def reproduced(z: IOData, controller: LinearController) -> float:
    """Fit of the controller's computed command to the recorded one, %, without drift.

    The angle's start and the gyro's bias are not known to the running sum, so the recorded and
    the computed command are compared in their changes over a tenth of a second.
    """
    if z.r is None:
        return 0.0
    lag = max(1, round(0.1 / z.dt))
    recorded: list[FloatArray] = []
    computed: list[FloatArray] = []
    for a, b in z.segments:
        if b - a > 2 * lag:
            u = controller.command(z.r[a:b], z.y[a:b])
            recorded.append(z.u[a + lag : b] - z.u[a : b - lag])
            computed.append(u[lag:] - u[:-lag])
    if not recorded or not np.ptp(np.concatenate(recorded)):
        return 0.0
    return fit_percent(np.concatenate(recorded), np.concatenate(computed))


def fit_others(z: IOData, fits: Fits, possible: tuple[Use, ...],
               controller: LinearController | None) -> tuple[tuple[Model, ...], tuple[str, ...]]:
    """Fit the plant by every approach but the direct one that is possible; models and refusals."""
    reasons: list[str] = []
    nk, n = fits.nk, fits.order
    models: tuple[Model, ...] = ()
    start = next((m for m in fits.models if m.structure == 'BJ'), None)
    names = {approach.name for approach in possible if approach.possible}
    if 'joint' in names:
        models += successful_fits(
            reasons, lambda: joint(z, lambda data: bj(data, n, n, n, n, nk)))
    if controller is not None and 'indirect' in names:
        fitted = successful_fits(reasons, lambda: indirect(z, n, n, nk, controller, start=start))
        if n > ORDERS[0] and not any(model.converged for model in fitted):
            fitted = successful_fits(
                reasons, lambda: indirect(z, ORDERS[0], ORDERS[0], nk, controller)) or fitted
        models += fitted
    return models, tuple(reasons)


FEEDBACK_LEVEL = 0.01
"""Level at which past rates must explain the command for feedback to count as shown."""
FEW_LEVELS = 8
"""A command with at most this many values (PRBS, square, 3-2-1-1) has no feedback."""
SAME = 1e-4
"""Part of the command's spread within which two values are one."""
PAST = 30
"""Past samples of the command from which its next value is predicted."""
CYCLES = 3
"""Cycles within which a controller responds to the rate."""
NEGLIGIBLE = 0.2
"""Loop gain below which feedback neither biases the direct approach nor shapes the flight."""
SURE = 3.0
"""Standard errors added to the estimated feedback gain for its upper bound."""


def feedback(z: IOData, model: Model, gains: CascadeGains | None, *, behind_attitude: bool,
             through: bool) -> bool | None:
    """Whether the command depends on the rate; None where neither can be shown.

    True where the residual of `model` predicts the command, with nothing but the past of the
    command taken out (or the plant is not causal), or where the command is that of the known
    controller on the reference z.r (`behind_attitude`: the attitude's) and the rate. False where
    the command takes a few values only, or where no controller of the rate is stated and the loop
    gain that could have been missed is below NEGLIGIBLE; never where the excitation came `through`
    C1 or C2, which are feedback.
    """
    try:
        test = residual_test(replace(z, r=None), model)
        if test.p_causal < FEEDBACK_LEVEL:
            return True
        if (gains is not None and behind_attitude
                and reproduced(z, controller(gains, z.dt)) >= KNOWN_CONTROLLER_PCT):
            return True
        if through:
            return None
        has_gains = gains is not None and gains.rate_kp != 0.0
        excluded = _few_levels(z) or (
            not has_gains and largest_loop_gain(z, model) < NEGLIGIBLE)
    except QuadSysidError:
        return None
    return False if excluded else None


def _few_levels(z: IOData) -> bool:
    u = z.inside(z.u)
    spread = float(u.std())
    return spread > 0.0 and np.unique(np.round(u / (SAME * spread))).size <= FEW_LEVELS


def largest_loop_gain(z: IOData, model: Model) -> float:
    """Loop gain that the data do not exclude: feedback gain times rate over command.

    The feedback gain is that from the one-step errors (of the last CYCLES) to the command beyond
    what the command's past predicts, plus SURE standard errors; inf where the record is too short.
    Raises BadInputError where that past is linearly dependent.
    """
    blocks: list[FloatArray] = []
    for part in one_step_errors(model, z):
        e = np.zeros(z.u.size)
        e[part.start : part.start + part.errors.size] = part.errors
        start, stop = part.start + max(PAST, CYCLES), part.start + part.errors.size
        if start < stop:
            blocks.append(np.column_stack((lagged(e, range(CYCLES), start, stop),
                                           lagged(z.u, range(1, PAST + 1), start, stop),
                                           np.ones(stop - start), z.u[start:stop])))
    n, columns = sum(map(len, blocks)), CYCLES + PAST + 1
    if n <= 2 * (columns + 1):
        return float('inf')
    theta, sse, inverse = solve_triangular_factor('feedback', triangular(blocks))
    spread = np.sqrt(sse / (n - columns) * np.diag(inverse))
    gain = float(np.max((np.abs(theta) + SURE * spread)[:CYCLES]))
    u = z.inside(z.u)
    y = z.inside(z.y)
    return gain * float(y.std() / u.std()) if u.std() > 0.0 else float('inf')


def with_blackbox(answer: AxisAnswer, fits: Fits | str, data: AxisData, loop: step_b.Loop,
                  support: Support) -> AxisAnswer:
    """Add the table of models, the selected one, its error in the metric, and what to know.

    fits: the models, or why there are none.
    """
    completed, z = required(answer.model), required(answer.train)
    if isinstance(fits, str):
        return replace(answer, warnings=(*answer.warnings, f'no black-box model: {fits}'),
                       selection=Selection(advice=tuple(rivalry(completed))))
    gains = completed.active_gains
    cascade = CascadeGains.from_mapping(gains, data.axis) \
        if f'{data.axis}.rate.kp' in gains else None
    try:
        closed = feedback(z, fits.search.model, cascade, behind_attitude=loop.behind_attitude,
                          through=loop.through)
        possible, controlled_by = approaches(z, cascade, behind_attitude=loop.behind_attitude,
                                             one_loop=loop.of_one_set, closed=closed)
        further, reasons = fit_others(z, fits, possible, controlled_by)
        rows = blackbox_part.rows_of(z, data, fits.models + further)
    except QuadSysidError as error:
        return with_blackbox(answer, str(error), data, loop, support)
    rows, why_not = _second_steps(rows, loop, closed=closed)
    selected = blackbox_part.select(rows, data)
    model = None if selected is None else rows[selected].step_a.model
    answer = replace(answer, rows=rows, selected=selected, selection=Selection(possible, closed))
    if model is not None:
        answer = replace(
            answer, blackbox_error=blackbox_part.window_error(data, model, data.validation),
            blackbox_horizons=blackbox_part.horizons(data, model, data.validation))
    lines = *advice(answer, fits, support, why_not), *fits.refused, *reasons
    return replace(answer, selection=replace(answer.selection, advice=lines))


def _second_steps(rows: tuple[ModelRow, ...], loop: step_b.Loop, *,
                  closed: bool | None) -> tuple[tuple[ModelRow, ...], str]:
    """Step B of every row, or why there is none; an axis in open loop stands by step A."""
    if closed is False:
        return (
            tuple(replace(row, passed_second_step=row.step_a.passed_first_step) for row in rows),
            "the axis was flown without feedback, as the paper's yaw; the free run decides",
        )
    if not loop.flights:
        return rows, loop.because
    return tuple(step_b.second_step(row, loop.flights) for row in rows), ''
