"""One model for roll and pitch where their confidence bands agree (the paper's choice)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from quad_sysid.blackbox import Model, bj, compare, frequency_response
from quad_sysid.errors import QuadSysidError
from quad_sysid.pipeline.answer import AxisAnswer, ModelRow, SharedModel
from quad_sysid.record import IOData

CONFIDENT = 2.576
"""Standard errors of a 99 % band."""
FREQUENCIES = 30
DEFAULT_BAND = (1.0, 20.0)
"""rad/s, where no band of trust is known."""


def share(answers: Mapping[str, AxisAnswer]) -> dict[str, AxisAnswer]:
    """The answers, those of roll and pitch with what the comparison of the two says."""
    found = dict(answers)
    if not {'roll', 'pitch'} <= set(answers):
        return found
    outcome = compare_axes(answers['roll'], answers['pitch'])
    if outcome is None:
        return found
    for axis in ('roll', 'pitch'):
        answer = answers[axis]
        found[axis] = replace(answer, selection=replace(answer.selection, shared=outcome))
    return found


def compare_axes(roll: AxisAnswer, pitch: AxisAnswer) -> SharedModel | None:
    """Whether both axes' Box-Jenkins models agree within their 99 % bands; None without them."""
    models = [box_jenkins(roll.rows), box_jenkins(pitch.rows)]
    data = [roll.train, pitch.train]
    if any(m is None or z is None for m, z in zip(models, data, strict=True)):
        return None
    orders = dict(max((m for m in models if m is not None), key=lambda m: int(m.F.size)).orders)
    try:
        same = [_fit(z, orders) for z in data if z is not None]
        gap = largest_gap(same[0], same[1], _band(roll, pitch))
        if gap is None:
            return SharedModel(agree=False, because='a model has no confidence band to compare')
        what, w, sigmas, percent = gap
        words = (
            f'{what} at {w:.2g} rad/s differ by {percent:.2g} %, {sigmas:.1f} times what their '
            '99 % bands span'
        )
        if sigmas > 1.0:
            return SharedModel(agree=False, because=words)
        joined = _joined([z for z in data if z is not None])
        model = _fit(joined, orders)
    except QuadSysidError as error:
        return SharedModel(agree=False, because=str(error))
    fits = {a.axis: compare(z, model)[0]
            for a, z in ((roll, roll.validation), (pitch, pitch.validation)) if z is not None}
    return SharedModel(agree=True, because=words, model=model, fit_validation_pct=fits)


def largest_gap(one: Model, other: Model,
                band: tuple[float, float]) -> tuple[str, float, float, float] | None:
    """Return where two responses lie furthest apart: what, rad/s, gap over bands, gap in %.

    The gap in magnitude or phase is measured in the sum of both 99 % half-widths, so that bands
    that touch give 1. None where a model has no covariance.
    """
    w = np.geomspace(*band, FREQUENCIES)
    a, b = frequency_response(one, w), frequency_response(other, w)
    if a.covariance is None or b.covariance is None:
        return None
    tiny = np.finfo(float).tiny
    size = np.abs(a.magnitude - b.magnitude)
    sizes = size / np.maximum(CONFIDENT * (a.magnitude_std + b.magnitude_std), tiny)
    turn = np.abs(np.angle(a.response / b.response))
    turns = turn / np.maximum(CONFIDENT * (a.phase_std + b.phase_std), tiny)
    i, j = int(np.argmax(sizes)), int(np.argmax(turns))
    if sizes[i] >= turns[j]:
        mean = 0.5 * (a.magnitude[i] + b.magnitude[i])
        return 'magnitudes', float(w[i]), float(sizes[i]), float(100.0 * size[i] / mean)
    return 'phases', float(w[j]), float(turns[j]), float(100.0 * turn[j])


def _fit(z: IOData, orders: Mapping[str, int]) -> Model:
    return bj(z, *(orders[name] for name in ('nb', 'nc', 'nd', 'nf', 'nk')))


def box_jenkins(rows: Sequence[ModelRow]) -> Model | None:
    """The direct Box-Jenkins model, whose covariance is the best that is known; None without."""
    for row in rows:
        model = row.step_a.model
        if model.structure == 'BJ' and model.approach == 'direct' and model.converged:
            return model
    return None


def _band(roll: AxisAnswer, pitch: AxisAnswer) -> tuple[float, float]:
    """Where both axes are trusted, if that is any wider than an octave."""
    bands = [
        a.model.trusted_band_rad_s for a in (roll, pitch)
        if a.model is not None and a.model.trusted_band_rad_s is not None
    ]
    low = max((b[0] for b in bands), default=DEFAULT_BAND[0])
    high = min((b[1] for b in bands), default=DEFAULT_BAND[1])
    return (low, high) if high > 2.0 * low else DEFAULT_BAND


def _joined(data: list[IOData]) -> IOData:
    """Several records as the segments of one, their ends not joined."""
    shift, segments = 0, []
    for z in data:
        segments += [(a + shift, b + shift) for a, b in z.segments]
        shift += z.y.size
    return IOData(u=np.concatenate([z.u for z in data]), y=np.concatenate([z.y for z in data]),
                  dt=data[0].dt, segments=segments)
