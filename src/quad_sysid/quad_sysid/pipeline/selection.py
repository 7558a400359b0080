"""The black-box part of one axis from its data to the selected model: the paper's two steps.

Only the order of the steps stands here; each is a module of its own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from quad_sysid.blackbox import Model, Table2Entry, fit_table2
from quad_sysid.errors import QuadSysidError
from quad_sysid.loop.cascade import CascadeGains
from quad_sysid.model.data import AxisData
from quad_sysid.pipeline import approaches, blackbox_part, preparation, step_b
from quad_sysid.pipeline.advice import Evidence, advice, rivalry
from quad_sysid.pipeline.answer import AxisAnswer, ModelRow, Selection
from quad_sysid.pipeline.assemble import band_of
from quad_sysid.pipeline.feedback import feedback, through_controller
from quad_sysid.pipeline.shared import box_jenkins
from quad_sysid.record import IOData, Record


def with_blackbox(
    answer: AxisAnswer, data: AxisData, records: Sequence[Record], *, table2: bool = False
) -> AxisAnswer:
    """Add the table of models, the selected one, its error in the metric, and what to know."""
    gains = {} if answer.model is None else answer.model.active_gains
    checks = preparation.checks(records[0], data.axis, gains)
    try:
        z = blackbox_part.io_data(data, data.train)
        fits = blackbox_part.fit_models(z)
        cascade, behind = _cascade(gains, data.axis), _behind_attitude(records, data.axis)
        closed = feedback(
            z, fits.search.model, cascade, behind_attitude=behind,
            through=through_controller(records, data.axis),
        )
        possible, known = approaches.approaches(
            z, cascade, behind_attitude=behind, one_loop=_one_loop(records, data.axis),
            closed=closed,
        )
        others, refused = approaches.fit_others(z, fits, possible, known)
        rows = blackbox_part.rows_of(data, fits.models + others)
    except QuadSysidError as error:
        return replace(
            answer, warnings=(*answer.warnings, f'no black-box model: {error}'),
            selection=Selection(checks=checks, advice=tuple(rivalry(answer.model))),
        )
    rows, why_not = _second_steps(rows, records, data.axis, closed=closed)
    selected = blackbox_part.select(rows, data)
    model = None if selected is None else rows[selected].step_a.model
    band = band_of(data, box_jenkins(rows) or model)
    axis_model = answer.model and replace(answer.model, trusted_band_rad_s=band)
    evidence = Evidence(
        z, fits, rows, selected, band, closed, axis_model, fits.refused + refused, why_not
    )
    free_run, horizons = _errors(data, model)
    return replace(
        answer, model=axis_model, rows=rows, selected=selected, blackbox_error=free_run,
        blackbox_horizons=horizons,
        train=z, validation=_validation(data),
        selection=Selection(
            approaches=possible, feedback=closed, checks=checks, advice=advice(evidence),
            table2=_table2(z, data) if table2 else (),
        ),
    )


def _cascade(gains: Mapping[str, float], axis: str) -> CascadeGains | None:
    return CascadeGains.from_mapping(gains, axis) if f'{axis}.rate.kp' in gains else None


def _behind_attitude(records: Sequence[Record], axis: str) -> bool:
    """Whether what drives the loop from outside is the attitude set-point."""
    return not any(
        s.injection in ('rate', 'control') for r in records for s in r.segments if s.axis == axis
    )


def _one_loop(records: Sequence[Record], axis: str) -> bool:
    """Whether all training segments were flown with one set of gains, as far as is known."""
    flown = {
        tuple(sorted(step_b.gains_of_axis(r, axis, s.start_s).items()))
        for r in records for s in r.segments if s.role == 'train' and s.axis == axis
    }
    return len(flown) <= 1


def _second_steps(
    rows: tuple[ModelRow, ...], records: Sequence[Record], axis: str, *, closed: bool | None
) -> tuple[tuple[ModelRow, ...], str]:
    """Step B of every row, or why there is none; an axis in open loop stands by step A."""
    if closed is False:
        return (
            tuple(step_b.open_loop_step(row) for row in rows),
            "the axis was flown without feedback, as the paper's yaw; the free run decides",
        )
    flights = step_b.flown(records, axis)
    if isinstance(flights, str):
        return rows, flights
    return tuple(step_b.second_step(row, flights) for row in rows), ''


def _errors(
    data: AxisData, model: Model | None
) -> tuple[float | None, dict[float, float]]:
    """The contract's error of the selected model, and that so long after a window's start."""
    if model is None:
        return None, {}
    return (
        blackbox_part.window_error(data, model, data.validation),
        blackbox_part.horizons(data, model, data.validation),
    )


def _table2(z: IOData, data: AxisData) -> tuple[Table2Entry, ...]:
    """The paper's rows on the same data; none where the data carry none of them."""
    try:
        return fit_table2(z, blackbox_part.validations(data))
    except QuadSysidError:
        return ()


def _validation(data: AxisData) -> IOData | None:
    return (
        blackbox_part.io_data(data, data.validation, external=False) if data.validation else None
    )
