"""What is left of one model on the held-out segments: its one-step errors under test.

For the base, for the base with its effects, and for the black-box winner alike: whiteness,
correlation with the command, spectrum with peaks, and the torque that the model seems to lack over
time. Values and arrays; told in report/residual_tree.py, drawn elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from quad_sysid.blackbox import Model, ResidualTest, innovation_test, predict, residual_test
from quad_sysid.contract import FloatArray
from quad_sysid.effects.discover import Discovery
from quad_sysid.effects.judge import Judgement
from quad_sysid.errors import QuadSysidError
from quad_sysid.greybox.data import AxisData, Span
from quad_sysid.pipeline.answer import MissingTorque, Residual
from quad_sysid.pipeline.blackbox_part import io_data
from quad_sysid.pipeline.preparation import resonance_peaks, spectrum
from quad_sysid.record import IOData, finite_runs

LOWEST_PEAK_HZ = 1.0
"""Two lines of the spectrum below this there is no peak to tell from a slope."""
SMOOTH_S = 0.1
"""Over this time the implied missing torque is averaged."""


def of_grey_box(found: Discovery, judgement: Judgement) -> dict[str, Residual]:
    """`before`, the base, and `after`, with the effects that stood the test (else the base)."""
    data = found.data
    after_noise = (
        found.base_noise if judgement.after is judgement.before else found.chosen_noise
    )
    z = io_data(data, data.validation, external=False)
    out = {}
    for name, figures, noise in (
        ('before', judgement.before, found.base_noise), ('after', judgement.after, after_noise)
    ):
        one = residual(held_out(figures.run.innovations, data.validation), z)
        if one is not None:
            gain = float(noise.correction[0])
            torque = missing_torque(figures.run.innovations, data.validation, gain, data.dt)
            out[name] = replace(one, missing=torque)
    return out


def of_black_box(data: AxisData, model: Model) -> Residual | None:
    """The winner's one-step errors; None where the segments are too short to test them."""
    z = io_data(data, data.validation, external=False)
    try:
        test = residual_test(model, z)
    except QuadSysidError:
        return None
    return _with_spectrum(test, z.y - predict(model, z, 1), z)


def held_out(innovations: FloatArray, spans: Sequence[Span]) -> FloatArray:
    """(n,) one-step errors inside spans, NaN elsewhere and at each span's first sample."""
    out = np.full(innovations.size, np.nan)
    for a, b in spans:
        out[a + 1 : b] = innovations[a + 1 : b]
    return out


def residual(errors: FloatArray, z: IOData) -> Residual | None:
    """Tests and spectrum of one-step errors (n,), NaN where there are none; None if too few."""
    try:
        test = innovation_test(errors, z)
    except QuadSysidError:
        return None
    return _with_spectrum(test, errors, z)


def _with_spectrum(test: ResidualTest, errors: FloatArray, z: IOData) -> Residual:
    found = spectrum(errors, z.dt)
    f, density, _ = (np.zeros(0), np.zeros(0), 0) if found is None else found
    known = errors[np.isfinite(errors)]
    return Residual(
        test=test, rms=float(np.sqrt(np.mean(known**2))), frequency_hz=f, density=density,
        peaks=resonance_peaks(errors, z.dt, LOWEST_PEAK_HZ) or (),
    )


def missing_torque(
    innovations: FloatArray, spans: Sequence[Span], gain: float, dt: float
) -> MissingTorque | None:
    """What the filter adds to the rate a cycle, as an acceleration, smoothed; None if too short.

    innovations (n,) rad/s; gain: share of an innovation that is added to the model's rate.
    """
    size = max(1, round(SMOOTH_S / dt))
    times, values, total, count = [], [], 0.0, 0
    kept = held_out(innovations, spans)
    for a, b in finite_runs(np.isfinite(kept), (0, kept.size)):
        if b - a > size:
            pushed = gain / dt * kept[a:b]
            values.append(np.convolve(pushed, np.full(size, 1.0 / size), mode='valid'))
            times.append((np.arange(a, b - size + 1) + 0.5 * size) * dt)
            total += float(np.sum(pushed**2))
            count += b - a
    if not values:
        return None
    return MissingTorque(
        np.concatenate(times), np.concatenate(values), SMOOTH_S,
        float(np.sqrt(total / count / size)),
    )
