"""From a fit to a stored model, and from a stored model to one that can be run.

Standard errors contain the sandwich (fit.covariance) and the uncertainty of the gyro filter's form
(fit.shift_by_form). The delta method converts logarithms and figures that follow from several
parameters.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from quad_sysid.axes import EVERY
from quad_sysid.contract import FloatArray
from quad_sysid.effects import EFFECTS
from quad_sysid.errors import BadInputError
from quad_sysid.estimate.fit import Fit, Problem, Tail, covariance, shift_by_form
from quad_sysid.model import AxisModel, EffectEstimate, NoiseEstimate, Parameter
from quad_sysid.model.effect import Effect, Part, Settings, required
from quad_sysid.model.flight import central
from quad_sysid.model.noise import sensor_of
from quad_sysid.model.plant import LEAST_LAG, Plant
from quad_sysid.model.structure import NOISE, Structure, coordinates

VAGUE = 1.0
"""Standard error above which a logarithm counts as undetermined."""


NO_BOUND = 1e3
"""A limit above this, in any unit, is none."""

UNKNOWN = NoiseEstimate({}, scale=1.0, degrees=1.0, gyro_rms=0.0, measured_rms=0.0)
"""What stands for the noise of a model that has none."""


def library(own_effects: Sequence[Effect] = ()) -> tuple[Effect, ...]:
    """All effects that a model may name: the caller's own, then the package's."""
    return (*(effect for effect in own_effects if effect not in EFFECTS), *EFFECTS)


def _named(name: str, variant: str, own_effects: Sequence[Effect]) -> Effect | None:
    return next((e for e in library(own_effects) if (e.name, e.variant) == (name, variant)), None)


@dataclass(frozen=True, eq=False)
class Stored:
    """A model that can be run: structure, parameters, distribution of the innovations."""

    structure: Structure
    theta: FloatArray
    """(p,) in the coordinates of the fit."""
    tail: Tail


@dataclass(frozen=True)
class Readings:
    """The parameters of a fit as a report shows them."""

    base: tuple[Parameter, ...]
    effects: tuple[tuple[Parameter, ...], ...]
    names: tuple[str, ...]
    """`gain`, …, then `<effect>.<parameter>`."""
    covariance: FloatArray
    """(p, p) of these for the filter as modelled; NaN rows for parameters without a standard
    error."""


def readings(problem: Problem, fitted: Fit, raw: FloatArray | None = None) -> Readings:
    """All parameters with their standard errors and joint covariance.

    raw (p, p): covariance of the coordinates of the fit; by default that of the likelihood.
    """
    raw = covariance(problem, fitted) if raw is None else raw
    structure, theta, dt = fitted.structure, fitted.theta, problem.data.dt
    groups = _readable(structure, theta)
    names = tuple(name for group in groups for name, _, _ in group)
    deviations = np.sqrt(np.diag(raw))
    jacobian = np.stack([
        central(partial(_values, structure), theta, j, step)
        for j, step in enumerate(1e-3 * np.clip(deviations, 1e-6, 1.0))
    ], axis=1)
    joint = jacobian @ raw @ jacobian.T
    form = jacobian @ shift_by_form(problem, fitted)
    # two effects may have one name, as two motors that lag
    owners = np.repeat(range(len(groups)), [len(structure.base), *(
        len(part.effect.parameters) for part in structure.parts)])
    vague: dict[tuple[int, str], tuple[float, float] | None] = {}
    for owner, name, spec, coordinate, value, deviation in zip(
        owners, structure.names, structure.specs, theta, fitted.values, deviations, strict=False
    ):  # what is at its bound or not determined: from nothing to where it may reach, 95 %
        if spec.log and (deviation > VAGUE or (spec.unit == 's' and value < LEAST_LAG * dt)):
            most = float(np.exp(min(coordinate + 1.645 * deviation, 40.0)))
            vague[owner, name] = (0.0, most) if most < NO_BOUND else None
        elif spec.positive and value <= 0.0:
            vague[owner, name] = None
    for i, key in enumerate((k, name) for k, group in enumerate(groups) for name, *_ in group):
        if key in vague or i in problem.zero_terms or not joint[i, i] > 0.0:
            joint[i, :] = joint[:, i] = np.nan
    errors = iter(np.sqrt(np.diag(joint) + form**2))  # from one group on to the next
    base, *effects = (
        tuple(
            Parameter(name if i == 0 else name.rpartition('.')[2], value,
                      float(std) if np.isfinite(std) else None, unit, vague.get((i, name)))
            for (name, value, unit), std in zip(group, errors, strict=False)
        ) for i, group in enumerate(groups)
    )
    base = tuple(Parameter(p.name, 0.0, None, p.unit) if i in problem.zero_terms else p
                 for i, p in enumerate(base))
    return Readings(base, tuple(effects), names, joint)


def _readable(structure: Structure, theta: FloatArray) -> list[list[tuple[str, float, str]]]:
    """Name, value and unit of the base's parameters, and as reports show them of each effect's."""
    p = structure.natural(theta)
    return [
        [(name, float(v), spec.unit) for name, spec, v in zip(
            structure.base_names, structure.base, p, strict=False)],
        *([(f'{part.effect.name}.{name}', value, unit) for name, (value, unit)
           in part.effect.readable(p[where], part.settings).items()]
          for part, where in structure.effects),
    ]


def _values(structure: Structure, theta: FloatArray) -> FloatArray:
    return np.array([value for group in _readable(structure, theta) for _, value, _ in group])


def noise_of(fitted: Fit) -> NoiseEstimate:
    """The noise that a fit ended with."""
    values = fitted.values[-fitted.structure.filtered :]
    steady, tail = fitted.prediction.filter, fitted.tail
    variance = tail.variance / steady.innovation
    return NoiseEstimate(
        ratios={spec.name: float(v) for spec, v in zip(NOISE, values, strict=False)},
        scale=tail.scale, degrees=tail.degrees,
        gyro_rms=float(np.sqrt(variance)), measured_rms=float(np.sqrt(variance * steady.floor)),
        lines=tuple(
            (float(a), float(f), float(w)) for a, f, w in values[len(NOISE) :].reshape(-1, 3)
        ),
        averaged=fitted.structure.averaged,
    )


def effects_of(
    fitted: Fit, readings: Readings, judged: Sequence[Mapping[str, Any]] = ()
) -> tuple[EffectEstimate, ...]:
    """The effects of a fit for the stored model; judged: of each, by fields of EffectEstimate."""
    return tuple(
        _estimate(part, parameters, **(judged[i] if judged else {}))
        for i, (part, parameters) in enumerate(
            zip(fitted.structure.parts, readings.effects, strict=True))
    )


def _estimate(part: Part, parameters: tuple[Parameter, ...], **judged: Any) -> EffectEstimate:
    effect = part.effect
    return EffectEstimate(effect.name, effect.kind, effect.signals, parameters, effect.variant,
                          dict(part.settings), **judged)


def estimate_of(
    name: str, fitted: Sequence[float], variant: str = '', *,
    settings: Settings | None = None, std: float | None = None,
    probability: float = 1.0, rivals: tuple[tuple[str, float], ...] = (),
    own: Sequence[Effect] = (),
) -> EffectEstimate:
    """An effect with parameters that were not fitted, in the units of its physics.

    Parameters left out at the end take the centres of their priors.
    """
    part = Part(required(_named(name, variant, own)), settings or {})
    p = np.array([*fitted, *part.effect.centre()[len(fitted) :]], dtype=float)
    readable = part.effect.readable(p, part.settings)
    parameters = tuple(Parameter(k, value, std, unit) for k, (value, unit) in readable.items())
    return _estimate(part, parameters, probability=probability, rivals=rivals)


def completed(model: AxisModel) -> Stored:
    """The model with its effects, ready to run. Raises BadInputError for an unknown effect."""
    parts = [part_of(model, effect) for effect in model.effects]
    fitted = [fitted_of(part, effect) for part, effect in zip(parts, model.effects, strict=True)]
    return _stored(model, model.base, parts, fitted, model.noise)


def plant_of(model: AxisModel) -> Plant:
    """The completed model as a plant that can be flown, cycle by cycle."""
    stored = completed(model)
    return Plant(
        stored.structure, stored.structure.natural(stored.theta), model.dt,
        sensor_of(model.gyro_filter_hz, None, model.dt),
        model.craft, EVERY[model.axis].index,
    )


def plain(model: AxisModel) -> Stored:
    """The base as fitted alone, ready to run."""
    return _stored(model, model.plain or model.base, [], [], model.plain_noise or model.noise)


def _stored(
    model: AxisModel, base: Sequence[Parameter], parts: Sequence[Part],
    effects: Sequence[FloatArray], noise: NoiseEstimate | None,
) -> Stored:
    values, noise = {p.name: p.value for p in base}, noise or UNKNOWN
    structure = Structure(tuple(parts), len(noise.lines), averaged=noise.averaged,
                          law=Part(model.law) if model.law else None)
    p = np.concatenate([
        [values[name] for name in structure.base_names], *effects,
        [noise.ratios.get(spec.name, np.exp(spec.centre)) for spec in NOISE], *noise.lines,
    ])
    theta = coordinates(structure.specs, p, 1e-17)
    return Stored(structure, theta, Tail(noise.scale, noise.degrees))


def part_of(model: AxisModel, effect: EffectEstimate) -> Part:
    """The physics of a stored effect. Raises BadInputError for an unknown one."""
    physics = _named(effect.name, effect.variant, model.own_effects)
    names = {p.name for p in effect.parameters}
    settings = {  # as the effect prepared them, from JSON values
        key: tuple(value) if isinstance(value, list) else value
        for key, value in effect.settings.items()
    }
    if physics is None or names != {*physics.readable(np.ones(len(physics.parameters)), settings)}:
        label = ' '.join([effect.name, *filter(None, (effect.variant,)),
                          f'({", ".join(sorted(names))})'])
        if effect.name.partition(':')[0] in ('shape', 'mode'):
            raise BadInputError(
                f'model: {model.axis}.effects', 'has an effect that only versions before the '
                'release of 0.2.0 write and read', label, 'identify again with this version')
        raise BadInputError(
            f'model: {model.axis}.effects', 'names an effect that is not known here', label,
            'one of your own is handed in, in Python as read_model(…, effects=(Mine(),)), to a '
            'command as --effects FILE.py; else identify again with this version',
        )
    return Part(physics, settings)


def fitted_of(part: Part, effect: EffectEstimate) -> FloatArray:
    """(p,) parameters of a stored effect as its physics takes them."""
    return part.effect.fitted({p.name: p.value for p in effect.parameters}, part.settings)
