"""The plants that a design must hold for: drawn from the model's covariance, with their effects.

Each rival replaces its effect in a share of the draws equal to its probability. A rival of the
same signal gets the strength that matches the effect over the flown range; for any other rival the
effect is left out. Each draw flies at a throttle and a voltage of its own, and is linear at one or
two amplitudes, so that a loop is judged both in wide motion and near rest.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.integrate import trapezoid

from quad_sysid.contract import FloatArray
from quad_sysid.estimate.stored import estimate_of, library
from quad_sysid.loop.cascade import (
    Controller,
    Margins,
    closed_loop_radius,
    frequency_grid,
    margins,
    open_loop,
)
from quad_sysid.loop.from_model import (
    acting_effect,
    gain_range,
    loop_plant,
    torque_at,
    usual_signals,
)
from quad_sysid.loop.likeness import Trim
from quad_sysid.loop.linear import ComplexArray, Loops, loops_of
from quad_sysid.loop.plant import Flying
from quad_sysid.model import AxisModel, EffectEstimate, Parameter
from quad_sysid.model.effect import ActingEffect, Effect, Part, Spec
from quad_sysid.model.noise import sensor_of

LEAST_PROBABILITY = 0.02
"""Probability below which a rival is ignored."""
FLOWN = {'rate': 1.5, 'angle': 0.25}
"""Amplitude of the signal over which two curves are matched, rad/s and rad."""
REST = {'throttle': 0.5, 'battery': 1.0}
"""What a curve's other signals are while two are compared: mid-range, and a full battery."""


def variants(model: AxisModel) -> tuple[tuple[float, AxisModel], ...]:
    """The model and those with a rival in the place of one effect; probabilities sum to 1."""
    out = [(float(np.prod([_own(effect) for effect in model.effects])), model)]
    for effect in model.effects:
        others = float(np.prod([_own(e) for e in model.effects if e is not effect]))
        for name, probability in effect.listed_rivals:
            if probability >= LEAST_PROBABILITY:
                out.append((probability * others, _with_rival(model, effect, name)))
    total = sum(weight for weight, _ in out)
    if not total > 0.0:
        return ((1.0, model),)
    return tuple((weight / total, variant) for weight, variant in out)


def shares(weights: tuple[float, ...], count: int) -> tuple[int, ...]:
    """The number of `count` draws for each weight, by the largest remainders."""
    exact = np.array(weights) / np.sum(weights) * count
    whole = np.floor(exact).astype(int)
    for index in np.argsort(whole - exact, kind='stable')[: count - int(whole.sum())]:
        whole[index] += 1
    return tuple(int(n) for n in whole)


def _own(effect: EffectEstimate) -> float:
    """Probability that it is in its place: whatever it is, it describes the motion."""
    return min(max(1.0 - sum(p for _, p in effect.listed_rivals), 0.0), 1.0)


def _with_rival(model: AxisModel, effect: EffectEstimate, name: str) -> AxisModel:
    rest = tuple(e for e in model.effects if e is not effect)
    matched = _matched(acting_effect(model, effect), name, model.own_effects)
    return _reduced(model, rest if matched is None else (*rest, matched))


def _matched(acting: ActingEffect, name: str, own: Sequence[Effect]) -> EffectEstimate | None:
    """The rival at the strength that matches the effect over a sine of the flown amplitude."""
    rival = next((e for e in library(own) if e.name == name), None)
    signal = acting.effect.signals[0]
    if rival is None or signal not in FLOWN or not (_simple(acting.effect) and _simple(rival)):
        return None
    if rival.signals != acting.effect.signals:
        return None
    x = FLOWN[signal] * np.sin((np.arange(256) + 0.5) * (2.0 * np.pi / 256))
    torque = torque_at(acting, REST, x.size, **{signal: x})
    shape = np.array([
        1.0 if spec.spread is None else math.exp(spec.centre) for spec in rival.parameters
    ])
    unit = torque_at(ActingEffect(Part(rival), shape), REST, x.size, **{signal: x})
    size = float(np.dot(unit, torque) / np.dot(unit, unit))
    return estimate_of(name, (size,), rival.variant, own=own)


def _simple(effect: Effect) -> bool:
    """Whether it is a torque proportional to its first parameter, the others shaping it."""
    first, *form = (spec.spread is None for spec in effect.parameters)
    return effect.term == 'torque' and first and not any(form)


def _reduced(model: AxisModel, effects: tuple[EffectEstimate, ...]) -> AxisModel:
    """The model with other effects and the rows of the covariance that remain."""
    own = {f'{e.name}.{p.name}' for e in effects for p in e.parameters}
    keep = [i for i, name in enumerate(model.parameter_names) if '.' not in name or name in own]
    covariance = model.covariance
    return replace(
        model, effects=effects, parameter_names=tuple(model.parameter_names[i] for i in keep),
        covariance=None if covariance is None else np.asarray(covariance)[np.ix_(keep, keep)],
    )


DRAWS = 240
"""Number of drawn models, without the nominal one."""

FLOOR = {'gain': 0.015, 'lag': 0.01, 'damping': 0.1}
"""Least relative standard error of a draw, since a covariance contains only the noise. Of 100
identified airframes (bench/tuning.py) 95 were off by less than 0.9 % in lag, 0.03 cycles in delay
and, where another charge of the battery changed it, 3 % in gain (0.1 % in the median)."""
DELAY_FLOOR_CYCLES = 0.05


MOST_POWER = 2.0
"""Most by which the logarithm of an effect's parameter is drawn away: a factor of 7."""
VOLTAGE_RANGE = (0.9, 1.08)
"""Battery voltage of the next flight relative to this one's mean."""
THROTTLE_RANGE = (0.85, 1.15)
"""Throttle of the next flight relative to this one's mean."""


@dataclass(frozen=True)
class Ensemble:
    """p linear loops to judge: the nominal plant and the draws, at each amplitude.

    `nominal` (p,) marks the loops of the nominal plant. response (2, p, f) at omega (f,) rad/s.
    """

    cycle: Loops
    omega: FloatArray
    response: ComplexArray
    nominal: npt.NDArray[np.bool_]
    draws: int
    axis: str
    noise: FloatArray
    """(f,) power of the measured rate's noise, over its mean."""

    def loop(self, controller: Controller) -> ComplexArray:
        """(p, f) loop gain broken at the control."""
        return open_loop(controller, self.response, self.omega, self.cycle.dt)

    def margins(self, controller: Controller) -> Margins:
        """Margins (p,) with this controller."""
        return margins(self.loop(controller), self.omega)

    def unstable(self, controller: Controller) -> npt.NDArray[np.bool_]:
        """(p,) True where the closed loop is not stable."""
        return np.asarray(closed_loop_radius(controller, self.cycle) >= 1.0)

    def subset(self, index: npt.NDArray[np.int64]) -> Ensemble:
        """The loops of `index` alone."""
        return replace(self, cycle=self.cycle.subset(index), response=self.response[:, index],
                       nominal=self.nominal[index])


def draw_models(model: AxisModel, rng: np.random.Generator, count: int) -> list[AxisModel]:
    """`count` models whose parameters are drawn from N(estimate, covariance).

    Standard errors are at least FLOOR; a parameter whose row is NaN (at a bound) keeps its value.
    Gain, lag and delay keep their signs; so do an effect's parameters that were fitted by their
    logarithm, which are drawn by it, and those that cannot be negative.
    """
    names = model.parameter_names
    matrix = _bounded_covariance(model)
    values, vectors = np.linalg.eigh(matrix)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    offsets = rng.standard_normal((count, len(names))) @ root.T
    specs = {f'{effect.name}.{spec.name}': spec for effect in model.effects
             for spec in acting_effect(model, effect).effect.parameters}
    return [_shifted_model(model, dict(zip(names, row, strict=True)), specs) for row in offsets]


def build(model: AxisModel, rng: np.random.Generator, count: int = DRAWS) -> Ensemble:
    """The ensemble of an axis model, its rivals included, in the next flight."""
    choices, plants = variants(model), [loop_plant(model)]
    for number, (_, variant) in zip(shares(tuple(weight for weight, _ in choices), count), choices,
                                    strict=True):
        plants += [_next_flight(one, rng) for one in draw_models(variant, rng, number)]
    trial = plants[0].trial
    bends = any(not isinstance(part.effect, Trim) for one in plants
                for part in one.plant.structure.parts)
    levels = [trial.wide, trial.near_rest] if bends else [trial.wide]
    cycle = loops_of([(one, level) for level in levels for one in plants])
    omega = frequency_grid(model.dt, loops=cycle)
    return Ensemble(cycle=cycle, omega=omega, response=cycle.response(omega),
                    nominal=np.arange(len(levels) * len(plants)) % len(plants) == 0, draws=count,
                    axis=model.axis, noise=_noise_power(model, omega))


def _noise_power(model: AxisModel, omega: FloatArray) -> FloatArray:
    """As Ensemble.noise: white before the gyro filter; white behind it where it is not known."""
    sensor = sensor_of(model.gyro_filter_hz, None, model.dt)
    if model.noise is None or not sensor.noisy:
        return np.ones_like(omega)
    turns = np.exp(1j * omega * model.dt)[:, None, None] * np.eye(2)
    states = np.linalg.solve(turns - sensor.step[:, :2], sensor.step[:, 2:].sum(axis=1)[:, None])
    power = np.abs(states[:, 0, 0]) ** 2 + model.noise.ratios.get('after', 0.0) ** 2
    return np.asarray(power * (omega[-1] - omega[0]) / trapezoid(power, omega))


def _next_flight(drawn: AxisModel, rng: np.random.Generator) -> Flying:
    """The plant at another voltage and throttle, and along what changes its gain by itself."""
    conditions = {}
    if drawn.mean_battery_v:
        conditions['battery'] = drawn.mean_battery_v * rng.uniform(*VOLTAGE_RANGE)
    conditions['throttle'] = usual_signals(drawn)['throttle'] * rng.uniform(*THROTTLE_RANGE)
    low, usual, high = gain_range(drawn)
    flying = loop_plant(drawn, conditions)
    p = flying.plant.p.copy()
    p[0] *= rng.uniform(low, high) / usual
    return replace(flying, plant=replace(flying.plant, p=p))


def _bounded_covariance(model: AxisModel) -> FloatArray:
    names = model.parameter_names
    if model.covariance is None:
        matrix = np.zeros((len(names), len(names)))
    else:
        matrix = np.nan_to_num(np.array(model.covariance, dtype=float), nan=0.0)
    for i, name in enumerate(names):
        floor = 0.0
        if name in FLOOR:
            floor = FLOOR[name] * abs(model.value(name))
        elif name == 'delay':
            floor = DELAY_FLOOR_CYCLES * model.dt
        matrix[i, i] += max(0.0, floor**2 - matrix[i, i])
    return np.asarray(0.5 * (matrix + matrix.T))


def _shifted_model(model: AxisModel, offset: dict[str, float],
                   specs: Mapping[str, Spec]) -> AxisModel:
    def shifted(parameter: Parameter, name: str) -> Parameter:
        value, spec = parameter.value + offset.get(name, 0.0), specs.get(name)
        if name in ('gain', 'lag', 'delay'):
            value = max(value, 0.1 * parameter.value)
        elif spec is not None and spec.log and parameter.value > 0.0:
            power = offset.get(name, 0.0) / parameter.value
            value = parameter.value * math.exp(min(max(power, -MOST_POWER), MOST_POWER))
        elif spec is not None and spec.positive:
            value = max(value, 0.0)
        return replace(parameter, value=value)

    return replace(
        model,
        base=tuple(shifted(p, p.name) for p in model.base),
        effects=tuple(
            replace(e, parameters=tuple(shifted(p, f'{e.name}.{p.name}') for p in e.parameters))
            for e in model.effects
        ),
    )

