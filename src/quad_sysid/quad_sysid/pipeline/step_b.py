"""Models in the simulated cascade against the recording: step B of the paper.

Every flight and every set of gains that it was flown with is a run of its own, so that a change
of gains tests the model as in the paper. The cascade itself stands in `loop`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from quad_sysid.axes import EVERY
from quad_sysid.blackbox import Model, fit_percent
from quad_sysid.contract import AXES, FloatArray
from quad_sysid.discover.accept import rms
from quad_sysid.errors import QuadSysidError
from quad_sysid.estimate.stored import plant_of
from quad_sysid.loop.cascade import NOTCH, CascadeGains
from quad_sysid.loop.from_model import schedule_factor
from quad_sysid.loop.plant import Flying
from quad_sysid.loop.simulation import angle_lead_s, simulate_cascade, simulate_polynomial_cascade
from quad_sysid.model import AxisModel
from quad_sysid.model.data import AxisData
from quad_sysid.model.effect import Signals
from quad_sysid.model.flight import Flight
from quad_sysid.pipeline.answer import ClosedLoop, LoopRun, ModelRow
from quad_sysid.record import UNNAMED, Record, Segment, finite_runs


@dataclass(frozen=True)
class Flown:
    """One flight under one set of gains."""

    bag: str
    gains: CascadeGains
    gains_changed: bool
    """Whether the gains differ from those of the training."""
    signals: tuple[str, ...]
    reference: FloatArray
    """(n,) attitude reference of the whole record, rad."""
    rate: FloatArray
    """(n,) measured, rad/s."""
    rows: FloatArray
    """(m,) indices that are compared."""
    injected: bool
    """Whether an excitation acted behind the attitude reference in the compared segments."""
    added: tuple[FloatArray, FloatArray] | None
    """(n,) each: excitation behind C1, rad/s, and behind C2; None where the bag lacks it."""
    held_out: bool
    """Whether the rows are validation segments."""
    offset: int
    """Index of the flight's first sample in the joined data."""
    angle_lead_s: float = 0.0
    """Lead of the recorded angle over the integral of the recorded rate, s."""
    start: float = 0.0
    """Angle at which the flight begins, rad; where none was measured, the reference's."""


@dataclass(frozen=True)
class Loop:
    """The loop around an axis, as the records describe it beside its data."""

    flights: tuple[Flown, ...]
    because: str
    """Why there is no flight to compare."""
    behind_attitude: bool
    """Whether the attitude set-point drives it, and nothing that was added behind C1 or C2."""
    through: bool
    """Whether training was excited in front of C1 or C2, so that a controller passed it on."""
    of_one_set: bool
    """Whether all training was flown with one set of gains, as far as is known."""


def loop_of(records: Sequence[Record], axis: str) -> Loop:
    """The loop as the records of a flight or several say.

    Compared are the validation segments; of a flight without any, all but its idle ones.
    """
    excited = [(r, s) for r in records for s in r.segments if s.excites(axis)]
    train_parts = [(r, s) for r, s in excited if s.role == 'train']
    flights, because = _flown(records, axis) if EVERY[axis].turns else (
        (), 'the loop around a speed is not in the bag')
    return Loop(
        flights, because,
        behind_attitude=not any(s.injection in ('rate', 'control') for _, s in excited),
        through=any(s.injection in ('attitude', 'rate') and s.signal not in UNNAMED
                    for _, s in train_parts),
        of_one_set=len({tuple(sorted(gains_of_axis(r, axis, s.start_s).items()))
                        for r, s in train_parts}) <= 1,
    )


def _flown(records: Sequence[Record], axis: str) -> tuple[tuple[Flown, ...], str]:
    """The runs that the records allow, or in words why there is none."""
    flights: list[Flown] = []
    reasons: list[str] = []
    trained: Mapping[str, float] | None = None
    offset = 0
    for record in records:
        segments_of_axis = [s for s in record.segments if s.axis == axis and s.role != 'idle']
        for segment in segments_of_axis:
            if segment.role == 'train' and trained is None:
                trained = gains_of_axis(record, axis, segment.start_s)
        chosen = [s for s in segments_of_axis if s.role == 'validation'] or segments_of_axis
        groups: dict[tuple[tuple[str, float], ...], list[Segment]] = {}
        for segment in chosen:
            gains = gains_of_axis(record, axis, segment.start_s)
            groups.setdefault(tuple(sorted(gains.items())), []).append(segment)
        for key, segments in groups.items():
            changed = dict(key) != (trained or dict(key))
            flight = _under_gains(record, axis, dict(key), segments, changed, offset)
            if isinstance(flight, str):
                reasons.append(flight)
            else:
                flights.append(flight)
        offset += record.n
    return tuple(flights), '; '.join(dict.fromkeys(reasons)) or 'no segment to compare'


def gains_of_axis(record: Record, axis: str, time_s: float) -> dict[str, float]:
    """The known gains and constants of one axis at a time."""
    gains = record.gains_at(time_s)
    return {name: value for name, value in gains.items()
            if name.startswith(f'{axis}.') or name in NOTCH.values()}


def _under_gains(record: Record, axis: str, values: Mapping[str, float],
                 segments: Sequence[Segment], changed: bool, offset: int) -> Flown | str:
    """One run, or why it cannot be simulated."""
    index = AXES.index(axis)
    if record.attitude_setpoint is None:
        return f'{record.source}: no /setpoint/attitude'
    if f'{axis}.rate.kp' not in values:
        return f'{record.source}: /gains/active does not say the gains of {axis}'
    reference = _without_gaps(record.attitude_setpoint[:, index])
    if reference is None:
        return f'{record.source}: /setpoint/attitude is not finite'
    angle = None if record.angles is None else record.angles[:, index]
    is_finite = np.isfinite(record.rates[:, index])
    runs = [run for s in segments for run in finite_runs(is_finite, record.span(s))]
    if not runs:
        return f'{record.source}: no rate in the segments to compare'
    return Flown(bag=record.source, gains=CascadeGains.from_mapping(values, axis),
                 gains_changed=changed, signals=tuple(dict.fromkeys(s.signal for s in segments)),
                 reference=reference, rate=record.rates[:, index],
                 rows=np.concatenate([np.arange(a, b) for a, b in runs]),
                 injected=any(s.injection in ('rate', 'control') for s in segments),
                 added=excitations(record, axis),
                 held_out=all(s.role == 'validation' for s in segments), offset=offset,
                 angle_lead_s=angle_lead_s(angle, record.rates[:, index], record.dt),
                 start=next((float(a) for a in (() if angle is None else angle)
                             if np.isfinite(a)), float(reference[0])))


def _without_gaps(reference: FloatArray) -> FloatArray | None:
    """The set-point with lost cycles held, as the firmware holds it; None where all are lost."""
    is_finite = np.isfinite(reference)
    if not is_finite.any():
        return None
    last = np.maximum.accumulate(np.where(is_finite, np.arange(reference.size), 0))
    last[: int(np.argmax(is_finite))] = int(np.argmax(is_finite))
    return np.asarray(reference[last])


def run(model: Model, flight: Flown) -> LoopRun:
    """The model's run beside the recorded rate; figures are None where it diverges or cannot."""
    failed = LoopRun(flight.bag, flight.gains_changed, flight.signals, None, None, None)
    if flight.injected:
        return replace(failed, because='the excitation acted behind the attitude reference')
    if model.B[0] != 0.0:
        return replace(failed, because='nk = 0: the command would act before it is known')
    try:
        rate = simulate_polynomial_cascade(model.denominator, model.B, flight.gains,
                                           flight.reference - flight.start, model.dt,
                                           angle_lead_s=flight.angle_lead_s).rate[flight.rows]
    except QuadSysidError as refusal:
        return replace(failed, because=str(refusal))
    if not np.isfinite(rate).all():
        return replace(failed, diverged=True, because='the simulated loop diverges')
    measured = flight.rate[flight.rows] - np.mean(flight.rate[flight.rows])
    error = measured - (rate - rate.mean())
    return replace(failed,
                   fit_pct=fit_percent(measured, measured - error) if measured.any() else None,
                   rmse=rms(error), mae=float(np.mean(np.abs(error))))


def second_step(row: ModelRow, flights: Sequence[Flown]) -> ModelRow:
    """The row with its runs, and whether it passed: none of them may fail."""
    runs = tuple(run(row.step_a.model, flight) for flight in flights)
    objections = []
    for simulated in runs:
        if simulated.diverged:
            objections.append(f'in the simulated loop of {simulated.bag} it diverges')
        elif simulated.fit_pct is not None and simulated.fit_pct <= 0.0:
            objections.append(f'its simulated loop fits {simulated.bag} no better than the mean')
    fits = [run.fit_pct for run in runs if run.fit_pct is not None]
    return replace(
        row, loop_runs=runs, closed_loop_fit_pct=fits[0] if fits else None,
        second_step_because='; '.join(objections),
        passed_second_step=bool(row.step_a.passed_first_step and fits and not objections),
    )


def closed_loop(model: AxisModel | None, loop: Loop, data: AxisData) -> ClosedLoop | None:
    """Simulated against measured rate on the validation segments of every flight; else None.

    The simulation runs on the recorded attitude reference and on the excitation that was applied
    behind C1 or C2, from the start of each record, with throttle, battery and the other axes as
    they were; a flight without them, or without gains, is left out.
    """
    runs = [flight for flight in loop.flights if flight.held_out and flight.added is not None]
    if model is None or not runs:
        return None
    plain = replace(model, base=model.plain or model.base, effects=(), noise=model.plain_noise)
    signals = Flight(data, data.stretches).commanded(np.array([p.value for p in model.base]))
    try:
        before, after = (np.concatenate([_simulated(candidate, run, signals) for run in runs])
                         for candidate in (plain, model))
    except QuadSysidError:
        return None
    if not (np.isfinite(before).all() and np.isfinite(after).all()):
        return None
    measured = np.concatenate([run.rate[run.rows] for run in runs])
    rows = np.concatenate([run.rows + run.offset for run in runs])
    order = np.argsort(rows, kind='stable')
    return ClosedLoop(time_s=rows[order] * data.dt, measured=measured[order], before=before[order],
                      after=after[order], rms_before=rms(before - measured),
                      rms_after=rms(after - measured))


def excitations(record: Record, axis: str) -> tuple[FloatArray, FloatArray] | None:
    """(n,) what was added behind C1 (rad/s) and behind C2 (normalised); zeros where nothing was.

    None where an excitation acted there and the record does not hold it.
    """
    added = {'rate': np.zeros(record.n), 'control': np.zeros(record.n)}
    for segment in record.segments:
        if segment.axis != axis or segment.injection not in added:
            continue
        if record.excitation is None:
            return None
        start, stop = record.span(segment)
        applied = record.excitation[start:stop, AXES.index(axis)]
        added[segment.injection][start:stop] = np.nan_to_num(applied)
    return added['rate'], added['control']


def _simulated(model: AxisModel, flight: Flown, flight_signals: Signals) -> FloatArray:
    """(m,) the rate on the compared rows, rad/s."""
    at_rate, at_control = flight.added or (None, None)
    plant = plant_of(model)
    p = plant.p.copy()
    p[0] *= schedule_factor(model)
    signals = flight_signals.at(flight.offset + np.arange(flight.reference.size))
    flying = Flying(replace(plant, p=p), signals, steady=False)
    return np.asarray(simulate_cascade(flying, flight.gains, flight.reference, plant.dt,
                                       rate_excitation=at_rate, control_excitation=at_control,
                                       initial_angle=flight.start,
                                       angle_lead_s=flight.angle_lead_s).rate[flight.rows])
