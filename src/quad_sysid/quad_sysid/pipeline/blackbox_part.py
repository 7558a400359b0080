"""The black-box side of one axis: order search, both steps of the paper, error in the metric."""

from __future__ import annotations

import math

import numpy as np

from quad_sysid.blackbox import Model, predict, search_arx, select, step_a
from quad_sysid.contract import FloatArray
from quad_sysid.errors import QuadSysidError
from quad_sysid.greybox.data import AxisData, Span
from quad_sysid.loop.cascade import CascadeGains
from quad_sysid.loop.simulation import simulate_polynomial_cascade
from quad_sysid.pipeline.answer import ModelRow
from quad_sysid.record import IOData, Record

SECOND_STEP_PCT = 0.0
"""A model whose simulated closed loop fits the recording no better than its mean is out."""


def io_data(data: AxisData, spans: tuple[Span, ...]) -> IOData:
    """Input and output over spans, as the black-box room takes them."""
    return IOData(u=data.command, y=data.rate, dt=data.dt, segments=spans)


def fit_models(data: AxisData) -> tuple[Model, ...]:
    """ARX by order search (AIC and BIC; the paper's ranges), as far as the data carry it."""
    z = io_data(data, data.train)
    models: list[Model] = []
    for criterion in ('aic', 'bic'):
        found = search_arx(z, range(2, 11), range(1, 11), range(1, 9), criterion).model
        if all(dict(found.orders) != dict(m.orders) for m in models):
            models.append(found)
    return tuple(models)


def rows_of(data: AxisData, models: tuple[Model, ...]) -> tuple[tuple[ModelRow, ...], int | None]:
    """Step A for every model, and the index of the one that the training data select."""
    validations: dict[str, IOData] = {}
    for name in dict.fromkeys(data.validation_names):
        spans = tuple(
            s for s, n in zip(data.validation, data.validation_names, strict=True)
            if n == name and s[1] - s[0] > 100
        )
        if spans:
            validations[name] = io_data(data, spans)
    rows = step_a(models, io_data(data, data.train), validations)
    return tuple(ModelRow(row) for row in rows), select(rows)


def window_error(data: AxisData, model: Model, spans: tuple[Span, ...]) -> float | None:
    """The contract's error of a polynomial model: the i-th sample is its i-step prediction.

    A window's first sample is predicted one step ahead from what was measured before it, its
    second two steps, and so on: nothing measured inside the window is used.
    """
    windows = data.windows(spans)
    if not windows.count:
        return None
    z = io_data(data, data.stretches)
    total = 0.0
    for i in range(windows.length):
        at = windows.starts + i
        error: FloatArray = predict(model, z, i + 1)[at] - data.rate[at]
        total += float(np.sum(error**2))
    value = math.sqrt(total / (windows.count * windows.length))
    return value if math.isfinite(value) else None


def second_step(
    row: ModelRow, data: AxisData, record: Record, gains: CascadeGains | None
) -> ModelRow:
    """Step B: the model in the simulated cascade with the recorded attitude reference."""
    if gains is None or record.attitude_setpoint is None:
        return row
    reference = record.attitude_setpoint[:, data.index]
    model = row.step_a.model
    if model.structure not in ('ARX', 'ARMAX') or not np.isfinite(reference).all():
        return row
    try:
        response = simulate_polynomial_cascade(
            model.A, model.B, gains, reference, data.dt
        )
    except QuadSysidError:
        return row
    inside = np.concatenate([np.arange(a, b) for a, b in data.validation])
    y, simulated = data.rate[inside], response.rate[inside]
    if not np.isfinite(simulated).all():
        return ModelRow(row.step_a, None, passed_second_step=False)
    fit = 100.0 * (1.0 - np.linalg.norm(y - simulated) / np.linalg.norm(y - y.mean()))
    passed = bool(row.step_a.passed_first_step and fit > SECOND_STEP_PCT)
    return ModelRow(row.step_a, float(fit), passed_second_step=passed)
