"""The same error figures of a stored model on a bag it has never seen (contract, evaluate)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from quad_sysid.blackbox import Model
from quad_sysid.contract import FloatArray
from quad_sysid.effects.judge import hold_error
from quad_sysid.effects.shapes import SHAPES
from quad_sysid.effects.table import EFFECTS
from quad_sysid.errors import BadInputError, NotInformativeError
from quad_sysid.greybox.data import AxisData, Span, axis_data
from quad_sysid.greybox.fit import fit_structure, simulator
from quad_sysid.greybox.simulate import Simulator
from quad_sysid.greybox.structure import Effect, Settings, Structure, equilibrium
from quad_sysid.model import AxisModel, EffectEstimate, Parameter
from quad_sysid.pipeline.blackbox_part import window_error
from quad_sysid.pipeline.together import same_rate
from quad_sysid.pipeline.usable import check_limits
from quad_sysid.record import Record, finite_runs

MOTION = 1.5
"""Error of holding the last rate over the measurement noise, below which nothing moved."""

KNOWN: Mapping[str, Sequence[Effect]] = {
    name: [e for e in EFFECTS + SHAPES if e.name == name]
    for name in dict.fromkeys(e.name for e in EFFECTS + SHAPES)
}


@dataclass(frozen=True)
class Evaluation:
    """Errors of one axis on an unseen flight, rad/s."""

    axis: str
    before: float
    after: float
    one_step_before: float
    one_step_after: float
    hold: float
    windows: int
    blackbox: float | None = None
    """None where none was given, or where its predictions run away."""


def evaluate(
    model: AxisModel, record: Record, spans_s: tuple[tuple[float, float], ...] = (),
    blackbox: Model | None = None,
) -> Evaluation:
    """Errors of the base and of the completed model, all parameters as stored.

    spans_s: parts of the record in s; empty: all of it but its idle segments. blackbox: the
    polynomial model of this axis, run about the stored base's equilibrium. The simulation runs
    at the record's own interval, which may differ by what two clocks differ (SAME_RATE).
    Raises BadInputError where the record does not fit the model, NotInformativeError where no
    window of 0.5 s is left, motors or gyro stand at their limits, or the rate does not move.
    """
    if not same_rate(record.dt, model.dt):
        raise BadInputError(
            record.source, "sample rate must be the model's",
            f'{1 / record.dt:.6g} Hz, model {1 / model.dt:.6g} Hz', 'identify at this rate',
        )
    data = replace(
        axis_data([record], model.axis), realisation=model.realisation,
        gyro_filter_hz=model.gyro_filter_hz,
    )
    spans = _spans(record, data, spans_s)
    if not data.windows(spans).count:
        raise NotInformativeError(
            f'{record.source}: {model.axis}: no window of 0.5 s to evaluate on; '
            'give a longer bag or --validate'
        )
    structure, theta = structure_of(model)
    theta = of_this_flight(simulator(data, spans, np.array(model.correction)), structure, theta)
    plain = vector(model.plain or model.base)
    before = simulator(data, spans, np.array(model.plain_correction or model.correction))
    after = simulator(data, spans, np.array(model.correction))
    hold = hold_error(before)
    _check_motion(model, record, data, spans, hold)
    run_before = before.run(Structure(), plain)
    run_after = after.run(structure, theta)

    def one_step(innovations: FloatArray) -> float:
        inside = np.concatenate([innovations[a + 1 : b] for a, b in spans])
        return float(np.sqrt(np.nanmean(inside**2)))

    return Evaluation(
        axis=model.axis,
        before=run_before.rms,
        after=run_after.rms,
        one_step_before=one_step(run_before.innovations),
        one_step_after=one_step(run_after.innovations),
        hold=hold,
        windows=before.windows.count,
        blackbox=None if blackbox is None else _blackbox_error(data, plain, blackbox, spans),
    )


def _blackbox_error(
    data: AxisData, plain: FloatArray, blackbox: Model, spans: tuple[Span, ...]
) -> float | None:
    about = replace(data, trim=equilibrium(plain), reference=None)
    return window_error(about, blackbox, spans)


def evaluate_or_say(
    model: AxisModel, record: Record, spans_s: tuple[tuple[float, float], ...] = (),
    blackbox: Model | None = None,
) -> Evaluation | str:
    """As `evaluate`, but why the flight says nothing of the model in words."""
    try:
        return evaluate(model, record, spans_s, blackbox)
    except NotInformativeError as reason:
        return str(reason)


def _check_motion(
    model: AxisModel, record: Record, data: AxisData, spans: tuple[Span, ...], hold: float
) -> None:
    """Raise NotInformativeError where no figure would say anything of the model."""
    check_limits(data, spans, f'{record.source}')
    if hold <= MOTION * (model.noise_rms or 0.0):
        noise = f', the noise is {model.noise_rms:.2g}' if model.noise_rms else ''
        raise NotInformativeError(
            f'{record.source}: {model.axis}: the rate does not move (it changes by {hold:.2g} '
            f'rad/s in half a second{noise}); is the axis held, or the aircraft at rest?'
        )


def of_this_flight(sim: Simulator, structure: Structure, theta: FloatArray) -> FloatArray:
    """The parameters with what belongs to the flight and not to the aircraft put right.

    The phase of a periodic disturbance is estimated again; after a step event the values after
    the event hold (contract, evaluate).
    """
    theta = theta.copy()
    names = structure.names
    for index, name in enumerate(names):
        if name == 'step_event.time':
            theta[index] = 0.0
        if name in ('event.torque', 'event.change'):
            theta[index] = 0.0  # it has passed
    free = np.array([name == 'periodic_disturbance.phase' for name in names])
    if not free.any():
        return theta
    fits = []
    for phase in np.arange(4) * np.pi / 2:
        start = np.where(free, phase, theta)
        fits.append(fit_structure(sim, structure, start, max_iterations=15, free=free))
    return min(fits, key=lambda fit: fit.rms).theta


def structure_of(model: AxisModel) -> tuple[Structure, FloatArray]:
    """The structure and parameter vector that a stored model names."""
    structure = Structure()
    theta = [vector(model.base)]
    for estimate in model.effects:
        parameters = [p.name for p in estimate.parameters]
        effect = next(
            (
                e for e in KNOWN.get(estimate.name, ())
                if [p.name for p in e.parameters][: len(parameters)] == parameters
                and e.variant == estimate.settings.get('variant', e.variant)
            ),
            None,
        )
        if effect is None:
            raise BadInputError(
                f'model: {model.axis}.effects', 'an effect this version does not know',
                f'{estimate.name} ({", ".join(parameters)})', 'identify again with this version',
            )
        # a curve that refines named effects has fewer parameters than one that stands alone
        effect = replace(effect, parameters=effect.parameters[: len(estimate.parameters)])
        structure = structure.with_effect(effect, _settings(estimate))
        theta.append(vector(estimate.parameters))
    return structure, np.concatenate(theta)


def vector(parameters: tuple[Parameter, ...]) -> FloatArray:
    """Values in the order given."""
    return np.array([p.value for p in parameters])


def _settings(estimate: EffectEstimate) -> Settings:
    """Settings as the effect prepared them, from what JSON made of them."""
    out: dict[str, float | str | tuple[float, ...] | tuple[str, ...]] = {}
    for key, value in estimate.settings.items():
        if isinstance(value, bool | int | float):
            out[key] = float(value)
        elif isinstance(value, str):
            out[key] = value
        elif isinstance(value, list | tuple):
            texts = all(isinstance(v, str) for v in value)
            out[key] = tuple(map(str, value)) if texts else tuple(float(v) for v in value)
    return out


def _spans(
    record: Record, data: AxisData, spans_s: tuple[tuple[float, float], ...]
) -> tuple[Span, ...]:
    good = np.isfinite(data.rate)
    if spans_s:
        wanted = [(round(a / data.dt), min(data.rate.size, round(min(b, 1e9) / data.dt)))
                  for a, b in spans_s]
    else:
        busy = [s for s in record.segments if s.role != 'idle']
        wanted = [record.span(s) for s in busy] if record.segments else [(0, record.n)]
    return tuple(run for span in wanted for run in finite_runs(good, span))
