"""A stored model on another flight: its errors, and its free run.

Evaluation is the contract's (Commands, `evaluate`); a free run has no noise and no feedback.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize_scalar

from quad_sysid.blackbox import Model
from quad_sysid.contract import FloatArray
from quad_sysid.craft import Craft
from quad_sysid.discover.accept import Horizon, Unseen, horizons, rms
from quad_sysid.errors import BadInputError, NotInformativeError
from quad_sysid.estimate import stored
from quad_sysid.estimate.stored import Stored, completed, plant_of
from quad_sysid.loop.cascade import CascadeGains
from quad_sysid.loop.from_model import usual_signals
from quad_sysid.loop.plant import Flying
from quad_sysid.loop.simulation import simulate_cascade
from quad_sysid.model import AxisModel, Outside
from quad_sysid.model.data import AxisData, Span, axis_data
from quad_sysid.model.effect import Signals
from quad_sysid.model.structure import coordinates
from quad_sysid.pipeline import blackbox_part
from quad_sysid.pipeline.assemble import outside_of
from quad_sysid.pipeline.usable import check_limits, same_craft, same_rate
from quad_sysid.record import Record, finite_runs
from quad_sysid.units import unit_and_factor

NO_GAINS = CascadeGains(0.0, 0.0, 0.0, 0.0)
MOTION = 1.5
"""Error of holding the last rate over the measurement noise, below which nothing moved."""
PHASES = 12
"""Starts of the search for the phase of a periodic effect."""
NEEDS = {'other angle': "the other axes' angles in /imu/data",
         'angle': 'an orientation in /imu/data', 'battery': '/battery',
         'other rate': "the other axes' rates", 'motors': 'the motors of its craft'}
"""Signals that a bag may lack, and their topics; the first whose name is in an effect's counts."""


@dataclass(frozen=True)
class Evaluation:
    """Errors of one axis on an unseen flight, in the unit of its model's arrays or axis."""

    axis: str
    before: float
    after: float
    one_step_before: float
    one_step_after: float
    hold: float
    windows: int
    own: tuple[float, float] | None = None
    """`after` and `hold` on the held-out segments of the model's own flight."""
    reference: float | None = None
    """The error of the model that predicts best, where that is not the answer."""
    rungs: tuple[tuple[tuple[str, ...], float, float, bool], ...] = ()
    """The explanation: names of the effects, percent of the training explained, error on this
    flight, whether it is the answer."""
    blackbox: float | None = None
    """Error of the black-box model; None without one, or where its predictions diverge."""
    horizons: tuple[Horizon, ...] = ()
    blackbox_horizons: dict[float, float] = field(default_factory=dict)
    outside: tuple[Outside, ...] = ()
    """Signals of the flight that leave the range of the training."""
    unit: str = 'rad/s'

    def __repr__(self) -> str:
        errors = {'hold the last value': self.hold, 'base (before)': self.before,
                  'completed (after)': self.after, 'reference': self.reference,
                  'black box': self.blackbox}
        lines = [f'  {name} {value:.4g}' for name, value in errors.items() if value is not None]
        head = f'{self.axis}: RMS error, {self.unit}, over {self.windows} free runs of 0.5 s'
        return '\n'.join([head, *lines, *(f'  {excess}' for excess in self.outside)])


def evaluate(model: AxisModel, record: Record, spans_s: tuple[tuple[float, float], ...] = (),
             blackbox: Model | None = None) -> Evaluation:
    """Errors of the base and of the completed model, all parameters as stored.

    spans_s: parts of the record, s; default: all but its idle segments. blackbox: the polynomial
    model of this axis, about the stored base's equilibrium. The record's sample interval may
    differ by as much as two clocks do (SAME_RATE). Raises BadInputError where the record does not
    suit the model, NotInformativeError where there is no window of 0.5 s, motors or gyro are at
    their limits, or the rate does not move.
    """
    record, data = flight_of(model, record)
    spans = flown_spans(record, data, spans_s)
    if not data.windows(spans).count:
        raise NotInformativeError(
            f'{model.axis}: {record.source} has no window of 0.5 s to evaluate on; '
            'give a longer bag or --validate'
        )
    unseen = Unseen(data, spans)
    hold = rms(unseen.holding(unseen.windows))
    check_limits(data, spans, f'{record.source}')
    if hold <= MOTION * (model.noise_rms or 0.0):
        noise = f', the noise is {model.noise_rms:.2g}' if model.noise_rms else ''
        raise NotInformativeError(
            f'{model.axis}: the rate does not move in {record.source} (it changes by {hold:.2g} '
            f'rad/s in half a second{noise}); is the axis held, or the aircraft at rest?'
        )
    before, after = stored.plain(model), stored.completed(model)
    check_signals(record.source, unseen, after, model.craft)
    after = of_this_flight(unseen, after)
    base = {p.name: p.value for p in model.plain or model.base}
    blackbox_data = blackbox_part.about_base(
        replace(data, reference=None), base['gain'], base['bias'])
    unit, factor = unit_and_factor(model.units, 'rad/s')

    def error(model: AxisModel) -> float:
        return factor * rms(unseen.errors(of_this_flight(unseen, stored.completed(model))))

    blackbox_error = (None if blackbox is None
                      else blackbox_part.window_error(blackbox_data, blackbox, spans))
    grown = {} if blackbox is None else blackbox_part.horizons(blackbox_data, blackbox, spans)
    return Evaluation(
        axis=model.axis, unit=unit,
        before=factor * rms(unseen.errors(before)), after=factor * rms(unseen.errors(after)),
        one_step_before=factor * unseen.one_step(before),
        one_step_after=factor * unseen.one_step(after),
        hold=factor * hold,
        windows=unseen.windows.count,
        own=model.held_out and (factor * model.held_out[0], factor * model.held_out[1]),
        reference=error(model.predicting) if model.reference else None,
        rungs=tuple(
            (tuple(effect.name for effect in rung.effects), rung.explains_pct,
             error(replace(model, base=rung.base, effects=rung.effects, noise=rung.noise)),
             model.is_rung(rung))
            for rung in model.rungs
        ),
        blackbox=None if blackbox_error is None else factor * blackbox_error,
        horizons=tuple(
            Horizon(h.horizon_s, factor * h.hold, factor * h.before, factor * h.after)
            for h in horizons(unseen, before, after)),
        blackbox_horizons={horizon_s: factor * error for horizon_s, error in grown.items()},
        outside=outside_of(model, data, spans),
    )


def flight_of(model: AxisModel, record: Record) -> tuple[Record, AxisData]:
    """A record as the model's axis flew it, and its data behind the filter of its gyro.

    Raises BadInputError where its sample rate or the unit of its arrays is not the model's.
    """
    record = record.in_units(model.units, model.axis).for_axis(model.axis, model.dt)
    if not same_rate(record.dt, model.dt):
        raise BadInputError(record.source, "sample rate must be the model's",
                            f'{1 / record.dt:.6g} Hz, model {1 / model.dt:.6g} Hz',
                            f'import its log with --grid {1 / model.dt:.6g}, or identify anew')
    data = axis_data([record], model.axis)
    # a model without a filter holds it in its lag and delay; else the bag knows its own best
    cut_off = data.gyro_filter_hz if model.gyro_filter_hz else None
    return record, replace(data, gyro_filter_hz=cut_off or model.gyro_filter_hz,
                           gyro_filters_hz=data.gyro_filters_hz if cut_off else None)


def check_signals(source: str, unseen: Unseen, model: Stored, craft: Craft) -> None:
    """Raise BadInputError where an effect needs a signal that the flight lacks."""
    data = unseen.problem.data
    has_signal = {'other angle': data.other_angles is not None, 'angle': data.angle is not None,
                  'battery': data.battery_v is not None,
                  'other rate': unseen.problem.flight.others is not None,
                  'motors': bool(data.motors.shape[1]) and same_craft(data.craft, craft)}
    for part, _ in model.structure.placed:
        for signal in part.effect.signals:
            need = next((n for n in NEEDS if n in signal), '')
            if need and not has_signal[need]:
                raise BadInputError(source, f'{part.effect.name} of the model needs {NEEDS[need]}',
                                    None, 'evaluate on a bag that holds it')


def of_this_flight(unseen: Unseen, model: Stored) -> Stored:
    """The parameters for this flight.

    A phase is estimated again by its likelihood; after an event its new values apply (contract,
    evaluate).
    """
    structure, p = model.structure, model.structure.natural(model.theta)

    def at(phase: float) -> Stored:
        theta = model.theta.copy()
        for part, where in structure.effects:
            other = part.effect.in_another_flight(p[where], part.settings, phase)
            theta[where] = coordinates(part.effect.parameters, other, 1e-17)
        return replace(model, theta=theta)

    if not any(part.effect.repeats_hz(p[where]) for part, where in structure.placed):
        return at(0.0)

    def unlikely(phase: float) -> float:
        return -float(np.sum(unseen.log_likelihood(at(phase))))

    grid = 2.0 * np.pi * np.arange(PHASES) / PHASES
    best = float(min(grid, key=unlikely))
    step = 2.0 * np.pi / PHASES
    optimum = minimize_scalar(unlikely, bounds=(best - step, best + step), method='bounded',
                              options={'xatol': 1e-4})
    return at(float(optimum.x))


def flown_spans(record: Record, data: AxisData,
                spans_s: tuple[tuple[float, float], ...] = ()) -> tuple[Span, ...]:
    """Samples (from, to) without gaps of `spans_s`, s; default: all but idle segments."""
    is_finite = np.isfinite(data.rate)
    if spans_s:
        spans = [(round(a / data.dt), min(data.rate.size, round(min(b, 1e9) / data.dt)))
                 for a, b in spans_s]
    else:
        busy = [s for s in record.segments if s.role != 'idle']
        spans = [record.span(s) for s in busy] if record.segments else [(0, record.n)]
    return tuple(run for span in spans for run in finite_runs(is_finite, span))


def simulate(model: AxisModel, u: npt.ArrayLike, x0: tuple[float, float] = (0.0, 0.0), *,
             throttle: npt.ArrayLike | None = None,
             battery_v: npt.ArrayLike | None = None) -> FloatArray:
    """(n,) rate as the gyro would measure it, rad/s, for commands `u` (n,), one per cycle.

    `x0` is the rate (rad/s) and the angle (rad) at the first command; motors and filter are at
    rest there. `throttle` (U1) and `battery_v` (V), one value or (n,), matter to effects that
    depend on them; by default they are the means of the flight. The other axes stand still.
    Raises BadInputError for signals that do not fit.
    """
    command = np.asarray(u, dtype=np.float64)
    if command.ndim != 1 or command.size < 2 or not np.isfinite(command).all():
        raise BadInputError('simulate', 'u must be (n,) finite commands, n at least 2',
                            f'shape {command.shape}')
    stored, usual = completed(model), usual_signals(model)
    for part, _ in stored.structure.placed:
        if 'battery' in part.effect.signals and battery_v is None and not model.mean_battery_v:
            raise BadInputError('simulate', f'{part.effect.name} needs battery_v',
                                remedy='give battery_v in V, one value for each command')
    n = command.size
    flying = Flying(plant_of(model), Signals.at_rest(
        model.dt * (np.arange(n, dtype=np.float64) + 0.5),
        _like(throttle, n, 'throttle', usual['throttle']),
        battery_v=_like(battery_v, n, 'battery_v', usual['battery']),
    ), steady=False)
    return simulate_cascade(flying, NO_GAINS, np.zeros(n), model.dt, control_excitation=command,
                            initial_rate=x0[0], initial_angle=x0[1]).rate


def _like(value: npt.ArrayLike | None, n: int, name: str, usual: float) -> FloatArray:
    """One value, or (n,), as (n,)."""
    values = np.asarray(usual if value is None else value, dtype=np.float64)
    if values.shape not in ((), (n,)) or not np.isfinite(values).all():
        raise BadInputError('simulate', f'{name} must be one finite value or as long as u',
                            values.shape)
    return np.full(n, values)
