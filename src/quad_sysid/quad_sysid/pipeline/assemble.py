"""From a finished discovery to the model that is handed on: AxisModel and its effects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from quad_sysid.blackbox import Model, coherence, frequency_response
from quad_sysid.effects.curves import curve_of
from quad_sysid.effects.discover import Discovery
from quad_sysid.effects.judge import Judgement
from quad_sysid.errors import QuadSysidError
from quad_sysid.greybox.data import AxisData
from quad_sysid.greybox.fit import Fit
from quad_sysid.greybox.structure import BASE_PARAMETERS, Effect, ParameterSpec, Settings
from quad_sysid.model import AxisModel, EffectEstimate, Parameter
from quad_sysid.pipeline.blackbox_part import io_data
from quad_sysid.record import IOData

COHERENT = 0.6
CONFIDENT = 2.576
HALF_POWER = 0.41
"""A gain that is off by this part is off by 3 dB."""


def axis_model(
    found: Discovery,
    judgement: Judgement,
    gains: Mapping[str, float],
    band: tuple[float, float] | None,
) -> AxisModel:
    """The completed model where the effects stood the final test, the base where not."""
    data = found.data
    kept = judgement.verdict == 'effects_added'
    fit = found.chosen if kept else found.base
    noise = found.chosen_noise if kept else found.base_noise
    volts = data.battery_v
    return AxisModel(
        axis=data.axis,
        dt=data.dt,
        gyro_filter_hz=data.gyro_filter_hz,
        base=parameters(fit),
        effects=tuple(
            _estimate(effect, settings, where, fit, found, judgement)
            for effect, settings, where in zip(
                fit.structure.effects, fit.structure.settings, fit.structure.slices(), strict=True
            )
        ),
        parameter_names=fit.structure.names,
        covariance=fit.covariance * fit.quoted**2,
        active_gains=dict(gains),
        mean_battery_v=None if volts is None else float(
            np.mean(np.concatenate([volts[a:b] for a, b in data.train]))
        ),
        noise_rms=fit.noise_rms(noise),
        torque_noise=noise.torque,
        trusted_band_rad_s=band,
        realisation=data.realisation,
        correction=tuple(noise.correction.tolist()),
        plain=parameters(found.base),
        plain_correction=tuple(found.base_noise.correction.tolist()),
    )


def parameters(fit: Fit) -> tuple[Parameter, ...]:
    """The base's parameters of a fit with their standard errors (None at a bound)."""
    return _parameters(BASE_PARAMETERS, slice(0, len(BASE_PARAMETERS)), fit)


def _parameters(
    specs: Sequence[ParameterSpec], where: slice, fit: Fit
) -> tuple[Parameter, ...]:
    """Values with standard errors or, at a bound, with how far inside they may lie."""
    out = []
    for spec, value, deviation, reach in zip(
        specs, fit.theta[where], fit.quoted * fit.std[where], fit.quoted * fit.reach[where],
        strict=True,
    ):
        interval = None
        if not np.isfinite(deviation) and np.isfinite(reach):
            far = 1.96 * float(reach)
            at_lower = value - spec.lower <= spec.scale
            interval = (
                (float(value), float(value) + far) if at_lower
                else (float(value) - far, float(value))
            )
        out.append(Parameter(spec.name, float(value), _std(deviation), spec.unit, interval))
    return tuple(out)


def _estimate(
    effect: Effect, settings: Settings, where: slice, fit: Fit, found: Discovery,
    judgement: Judgement,
) -> EffectEstimate:
    p_value, growth = judgement.effect_tests[effect.name]
    rivals = found.rivals.get(effect.name, ())
    own = dict(rivals).get(effect.name, 1.0)
    extra: dict[str, object] = {}
    if effect.kind == 'shape':
        x, y = curve_of(effect, fit.theta[where], settings)
        extra = {'knots': tuple(x.tolist()), 'values': tuple(y.tolist())}
    return EffectEstimate(
        name=effect.name,
        kind=effect.kind,
        signals=effect.signals,
        parameters=_parameters(effect.parameters, where, fit),
        settings={**settings, **({'variant': effect.variant} if effect.variant else {}), **extra},
        p_value=p_value,
        error_reduction_pct=growth,
        probability=own,
        rivals=tuple((name, p) for name, p in rivals if name != effect.name and p > 0.0),
    )


def _std(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def lag_window(z: IOData) -> int:
    """Half-width of the lag window, samples: the longest stretch told in four."""
    return max(2, max(b - a for a, b in z.segments) // 4)


def resolution(z: IOData) -> float:
    """Lowest frequency of the band that these data can tell, rad/s."""
    return float(np.pi / (lag_window(z) * z.dt))


def band_of(data: AxisData, model: Model | None = None) -> tuple[float, float] | None:
    """Band in which the data support a model, rad/s: the widest unbroken one, None without any.

    There command and rate are coherent (squared coherence over 0.6; where the external reference
    is known, that of reference and rate, since feedback alone makes the first high), and the 99 %
    band of `model`'s gain, where it has one, is narrower than 3 dB to either side.
    """
    z = io_data(data, data.train)
    try:
        w, values = coherence(z, window=lag_window(z), joint=z.r is not None)
    except QuadSysidError:
        return None
    good = values > COHERENT
    if model is not None and model.covariance is not None:
        response = frequency_response(model, w)
        good &= CONFIDENT * response.magnitude_std < HALF_POWER * response.magnitude
    edges = np.flatnonzero(np.diff(np.concatenate(([False], good, [False])))).reshape(-1, 2)
    if not edges.size:
        return None
    a, b = max(edges, key=lambda e: np.log(w[e[1] - 1] / w[e[0]]))
    return float(w[a]), float(w[b - 1])
