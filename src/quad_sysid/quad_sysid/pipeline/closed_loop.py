"""The completed model flown through the simulated cascade on what was recorded from outside.

Every flight with each set of gains that its held-out segments were flown with is a run of its own.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from quad_sysid.contract import AXES, FloatArray
from quad_sysid.errors import QuadSysidError
from quad_sysid.loop.from_model import loop_plant
from quad_sysid.loop.simulation import simulate_cascade
from quad_sysid.model import AxisModel
from quad_sysid.model.data import AxisData
from quad_sysid.pipeline.answer import AxisAnswer, ClosedLoop
from quad_sysid.pipeline.step_b import Flown, flown
from quad_sysid.record import Record


@dataclass(frozen=True)
class Run:
    """One flight under one set of gains."""

    flown: Flown
    at_rate: FloatArray
    """(n,) excitation behind C1, rad/s."""
    at_control: FloatArray
    """(n,) excitation behind C2, normalised."""
    offset: int
    """Of the flight's first sample in the joined data."""


def closed_loop(
    answer: AxisAnswer, records: Sequence[Record], data: AxisData
) -> ClosedLoop | None:
    """Simulated against measured rate on the validation segments of every flight; else None.

    The simulation runs on the recorded attitude reference and on the excitation that was applied
    behind C1 or C2, from the start of each record; a flight without them, or without gains, is
    left out.
    """
    model = answer.model
    if model is None:
        return None
    runs = tuple(_runs(records, model.axis))
    if not runs:
        return None
    plain = replace(model, base=model.plain or model.base, effects=(), noise=model.plain_noise)
    try:
        before, after = (
            np.concatenate([_simulated(one, run, data.dt) for run in runs])
            for one in (plain, model)
        )
    except QuadSysidError:
        return None
    if not (np.isfinite(before).all() and np.isfinite(after).all()):
        return None
    measured = np.concatenate([run.flown.rate[run.flown.rows] for run in runs])
    rows = np.concatenate([run.flown.rows + run.offset for run in runs])
    order = np.argsort(rows, kind='stable')
    return ClosedLoop(
        time_s=rows[order] * data.dt,
        measured=measured[order],
        before=before[order],
        after=after[order],
        rms_before=float(np.sqrt(np.mean((before - measured) ** 2))),
        rms_after=float(np.sqrt(np.mean((after - measured) ** 2))),
    )


def _runs(records: Sequence[Record], axis: str) -> Iterator[Run]:
    """What can be simulated of the flights that hold validation segments of the axis."""
    offset = 0
    for record in records:
        added = excitations(record, axis)
        held_out = any(s.axis == axis and s.role == 'validation' for s in record.segments)
        flights = flown([record], axis) if held_out and added is not None else ()
        if added is not None and not isinstance(flights, str):
            for one in flights:
                yield Run(one, *added, offset)
        offset += record.n


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


def _simulated(model: AxisModel, run: Run, dt: float) -> FloatArray:
    """(m,) the rate on the compared rows, rad/s."""
    flight = run.flown
    response = simulate_cascade(
        loop_plant(model), flight.gains, flight.reference, dt,
        rate_excitation=run.at_rate, control_excitation=run.at_control,
        angle_lead_s=flight.angle_lead_s,
    )
    rate: FloatArray = response.rate[flight.rows]
    return rate
