"""What is left of one model on the held-out segments: its one-step errors under test.

For the base, for the base with its effects, and for the black-box winner alike: whiteness,
correlation with the command, spectrum with peaks, and the torque that the model seems to lack over
time. Values and arrays; told in report/residual_tree.py, drawn elsewhere.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from quad_sysid.blackbox import Model, ResidualTest, innovation_test, predict, residual_test
from quad_sysid.contract import FloatArray
from quad_sysid.errors import QuadSysidError
from quad_sysid.estimate import stored
from quad_sysid.model.data import AxisData
from quad_sysid.pipeline.answer import Findings, HeldOut, MissingTorque, Residual
from quad_sysid.pipeline.blackbox_part import io_data
from quad_sysid.pipeline.preparation import resonance_peaks, spectrum
from quad_sysid.record import IOData

LOWEST_PEAK_HZ = 1.0
"""Two lines of the spectrum below this there is no peak to tell from a slope."""


def of_grey_box(data: AxisData, told: Findings) -> dict[str, Residual]:
    """`before`, the base, and `after`, with the effects that were accepted (else the base)."""
    z = io_data(data, data.validation, external=False)
    out = {}
    for name, held in (('before', told.before), ('after', told.after)):
        one = residual(held.innovations, z)
        if one is not None:
            out[name] = replace(one, missing=missing_torque(held, data.dt))
    return out


def of_black_box(data: AxisData, model: Model) -> Residual | None:
    """The winner's one-step errors; None where the segments are too short to test them."""
    z = io_data(data, data.validation, external=False)
    try:
        test = residual_test(model, z)
    except QuadSysidError:
        return None
    return _with_spectrum(test, z.y - predict(model, z, 1), z)


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


def missing_torque(held: HeldOut, dt: float) -> MissingTorque:
    """The torque disturbance that the filter sees, beside what its own noise lets one expect."""
    known = np.flatnonzero(np.isfinite(held.disturbance))
    noise, found = stored.noise_of(held.fit), held.fit.prediction.filter
    seen = max(noise.ratios['disturbance'] ** 2 - float(found.covariance[1, 1]), 0.0)
    return MissingTorque(
        known.astype(np.float64) * dt, held.disturbance[known],
        noise.gyro_rms * float(np.sqrt(seen)),
    )
