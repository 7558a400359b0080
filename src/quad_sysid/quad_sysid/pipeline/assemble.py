"""From a finished discovery to the model that is handed on: AxisModel and its effects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.signal.windows import tukey

from quad_sysid.axes import EVERY
from quad_sysid.blackbox import Model, coherence, frequency_response
from quad_sysid.contract import FloatArray
from quad_sysid.effects import EFFECTS
from quad_sysid.errors import QuadSysidError
from quad_sysid.estimate import stored
from quad_sysid.estimate.fit import Fit, covariance
from quad_sysid.explain.projection import Projected
from quad_sysid.model import AxisModel, EffectEstimate, Outside, RungModel
from quad_sysid.model.data import AxisData, Span
from quad_sysid.model.effect import Effect, Part
from quad_sysid.pipeline.answer import Findings
from quad_sysid.pipeline.constants import COHERENT, Z99
from quad_sysid.record import IOData, finite_runs
from quad_sysid.units import Units

BEYOND = 0.05
"""Share of its range in the training by which a signal must leave it to be named."""
HALF_POWER = 0.41
"""Part by which a gain may be off in the trusted band, 3 dB."""
ENDS = 0.1
"""Share of a segment over which it fades in and out for the coherence, both ends together."""


def axis_model(findings: Findings, gains: Mapping[str, float], band: tuple[float, float] | None,
               candidates: Sequence[Effect] = EFFECTS, units: Units | None = None,
               no_gains_because: str = '') -> AxisModel:
    """The completed model where the effects were accepted, the base where not."""
    data, verdict, problem = findings.data, findings.verdict, findings.problem
    ladder, searched, law = findings.ladder, findings.search, problem.plain.law
    reference, best_covariance = ladder.predicting, covariance(problem, searched.best)

    def read(fitted: Fit) -> stored.Readings:
        if fitted is searched.best:
            cov = best_covariance
        elif any(fitted is scored.fit for scored in searched.all) or (
                fitted is verdict.base and not verdict.claims):
            cov = covariance(problem, fitted)  # what is not confirmed widens nothing
        else:
            projected = Projected(fitted.structure, fitted.theta, np.zeros(0))
            cov = ladder.projection.covariance(projected, best_covariance)
        return stored.readings(problem, fitted, cov + searched.disagreement(fitted))

    def effects(fitted: Fit, answer: stored.Readings,
                judged: Sequence[Mapping[str, Any]] = ()) -> tuple[EffectEstimate, ...]:
        """The effects of a fit, the main cause first."""
        named = zip(fitted.structure.labels, stored.effects_of(fitted, answer, judged),
                    strict=True)
        return tuple(effect for _, effect in sorted(named, key=lambda pair: ladder.rank(pair[0])))

    best = read(reference)
    chosen = verdict.chosen
    readings, plain = read(chosen), read(verdict.base)
    judged = [
        {'p_value': claim.p_value, 'probability': probability, 'rivals': rivals,
         'error_reduction_pct': claim.error_reduction_pct,
         'explains_pct': ladder.explains(part.effect.label)}
        for claim, probability, rivals, part in zip(
            verdict.claims, verdict.probabilities, verdict.rivals, chosen.structure.parts,
            strict=True)
    ]
    volts = data.battery_v
    shared = AxisModel(
        axis=data.axis, dt=data.dt, gyro_filter_hz=data.gyro_filter_hz, base=best.base,
        effects=effects(reference, best), parameter_names=best.names,
        covariance=best.covariance, active_gains=dict(gains),
        mean_battery_v=None if volts is None else float(
            np.mean(np.concatenate([volts[a:b] for a, b in data.train]))
        ),
        mean_throttle=float(np.mean(data.training(data.control[:, 0]))),
        ranges=ranges_of(data, (*reference.structure.parts, *chosen.structure.parts)),
        noise=stored.noise_of(reference), trusted_band_rad_s=band,
        craft=data.craft, units=units, no_gains_because=no_gains_because,
        own_effects=(*([] if law is None else [law.effect]),
                     *(effect for effect in candidates if effect not in EFFECTS)),
    )
    explained = zip(ladder.rungs[1:], verdict.rung_fits[1:], verdict.rungs[1:], strict=True)
    # what predicts the held-out segments worse than the base is no reference for gains
    distinct = (chosen is not reference and bool(verdict.claims)
                and verdict.reference <= verdict.before)
    return replace(
        shared, base=readings.base, effects=effects(chosen, readings, judged),
        parameter_names=readings.names, covariance=readings.covariance,
        noise=stored.noise_of(chosen),
        plain=plain.base, plain_noise=stored.noise_of(verdict.base),
        rungs=tuple(
            RungModel(answer.base, effects(fit, answer), stored.noise_of(fit),
                      rung.explains_pct, error)
            for rung, fit, error in explained for answer in (read(fit),)
        ) if verdict.claims else (),
        held_out=(verdict.after, verdict.hold) if np.isfinite(verdict.after) else None,
        reference=shared if distinct else None,
    )


def ranges_of(data: AxisData, parts: Sequence[Part]) -> dict[str, tuple[float, float]]:
    """Least and largest value in the training of rate, command and what the effects depend on."""
    out = {}
    for name in ('rate', 'command', *(n for part in parts for n in part.effect.signal_names)):
        signal = data.signal(name)
        if not isinstance(signal, str):
            used = data.training(signal)
            out[name] = float(np.nanmin(used)), float(np.nanmax(used))
    return out


def outside_of(model: AxisModel, data: AxisData, spans: Sequence[Span]) -> tuple[Outside, ...]:
    """The signals that leave their range of the training in these spans, the longest first."""
    signals = []
    for name, (low, high) in model.ranges.items():
        signal = data.signal(name)
        if isinstance(signal, str):
            continue
        in_training = np.concatenate([signal[a:b] for a, b in spans])
        beyond = np.maximum(low - in_training, in_training - high)
        out = int(np.count_nonzero(beyond > BEYOND * (high - low)))
        if out:
            least, most = float(np.nanmin(in_training)), float(np.nanmax(in_training))
            bounds = (least, most, low, high)
            converted = bounds if model.units is None else (
                model.units.signal_in(name, end) for end in bounds)
            signals.append(Outside(name, out * data.dt, *converted))
    return tuple(sorted(signals, key=lambda signal: -signal.seconds))


@dataclass(frozen=True)
class Support:
    """The frequencies at which the training supports a model of an axis."""

    band: tuple[float, float] | None
    """The widest unbroken band, rad/s; None without any."""
    lowest: float
    """Lowest frequency that the longest stretch can resolve, rad/s."""

    @classmethod
    def of(cls, z: IOData, axis: str, model: Model | None = None) -> Support:
        """The frequencies that the training of an axis supports, and a `model` of it determines.

        In the band command and rate are coherent (squared coherence over COHERENT; where the
        external reference is known, that of reference and rate, since feedback alone makes the
        first high), and the 99 % interval of the model's gain, where it has one, is narrower than
        3 dB to either side. The ends of each segment are tapered: the same edge in two signals
        is coherent where nothing was excited.
        """
        window = max(2, max(b - a for a, b in z.segments) // 4)  # half-width, samples
        lowest = float(np.pi / (window * z.dt))
        if not EVERY[axis].turns:  # a speed is all slow motion, of which a window sees nothing
            change = np.diff(z.y, prepend=z.y[:1])
            change[[a for a, _ in z.segments]] = 0.0
            z = replace(z, y=change)
        try:
            w, values = coherence(_tapered(z), window=window, joint=z.r is not None)
        except QuadSysidError:  # the segments are too short
            return cls(None, lowest)
        trusted = values > COHERENT
        if model is not None and model.covariance is not None and w.size:
            response = frequency_response(model, w)
            trusted = trusted & (
                Z99 * response.magnitude_std < HALF_POWER * response.magnitude)
        bands = finite_runs(trusted, (0, trusted.size))
        if not bands:
            return cls(None, lowest)
        a, b = max(bands, key=lambda e: np.log(w[e[1] - 1] / w[e[0]]))
        return cls((float(w[a]), float(w[b - 1])), lowest)


def _tapered(z: IOData) -> IOData:
    """The signals about each segment's means, faded in and out over ENDS of its length."""
    def faded(x: FloatArray) -> FloatArray:
        out = np.zeros(x.size)
        for a, b in z.segments:
            out[a:b] = tukey(b - a, ENDS) * (x[a:b] - x[a:b].mean())
        return out

    return replace(z, u=faded(z.u), y=faded(z.y), r=None if z.r is None else faded(z.r))
