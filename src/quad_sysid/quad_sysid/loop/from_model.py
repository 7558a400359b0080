"""From the identified AxisModel to the plant that one axis' loop sees.

Its effects fly by their own laws, at the flight's mean throttle and voltage, the other axes at
rest. `not_in_the_loop` names those that one axis' loop cannot hold; what changes by itself, or
swings whatever the loop does, is a range of the gain or a longer delay.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.optimize import least_squares

from quad_sysid.axes import EVERY, Level
from quad_sysid.contract import FloatArray
from quad_sysid.effects.hidden import Memory as Warming
from quad_sysid.errors import BadInputError
from quad_sysid.estimate.stored import fitted_of, part_of, plant_of
from quad_sysid.loop.cascade import CascadeGains, contract_names, reference_response
from quad_sysid.loop.likeness import Trim
from quad_sysid.loop.linear import loops_of
from quad_sysid.loop.plant import LATE_S, Flying, around, plant_like
from quad_sysid.model import AxisModel, EffectEstimate
from quad_sysid.model.effect import ActingEffect, Part, Signals
from quad_sysid.model.structure import Structure

if TYPE_CHECKING:
    from quad_sysid.blackbox import FrequencyResponse

LOOP_SIGNALS = {'rate', 'angle', 'command', 'throttle', 'battery', 'time', 'motors', 'history',
                'direction'}
"""Signals that one axis' loop contains or holds constant."""
NUDGE = 0.01
"""Step of a parameter for derivatives, standard errors."""
OTHER_AXES = 'it depends on the other axes'
NEEDS_HEIGHT = 'it depends on the height, and gains must hold at any height'
SLOW_HZ = 10.0
"""What repeats itself slower than this is no vibration to a loop: its worst case counts."""


def why_outside(acting: ActingEffect) -> str:
    """Why one axis' loop cannot hold an effect; '' where it does."""
    effect = acting.effect
    if not set(effect.signals) <= LOOP_SIGNALS:
        return OTHER_AXES
    if effect.repeats_hz(acting.p) and effect.term == 'torque':
        return 'it is a disturbance, whatever the loop does'
    return ''


def signals_at(
    acting: ActingEffect, usual: Mapping[str, float], n: int = 1, **signals: Any
) -> Signals:
    """Signals (n,) at these usual values, all but `moved` at rest, the effect's memory steady."""
    values = {'time': np.full(n, LATE_S), 'throttle': np.full(n, usual['throttle']),
              'battery_v': np.full(n, usual['battery']), 'sent': np.zeros(n)}
    s = Signals.at_rest(**(values | signals))
    return s if not acting.effect.states else s.replaced(
        hidden=acting.effect.steady(s, acting.p, acting.part.settings))


def torque_at(
    acting: ActingEffect, usual: Mapping[str, float], n: int = 1, **signals: FloatArray
) -> FloatArray:
    """(n,) acceleration by an effect, rad/s², there."""
    s = signals_at(acting, usual, n, **signals)
    torque = acting.effect.torque(s, acting.p, acting.part.settings)
    return np.zeros(n) if torque is None else np.broadcast_to(torque, (n,))


def _factor(
    acting: ActingEffect, usual: Mapping[str, float], **signals: FloatArray
) -> FloatArray:
    """Factor on the drive in small motion."""
    n = max((x.size for x in signals.values()), default=1)
    with_drive = torque_at(acting, usual, n, drive=np.ones(n), **signals)
    out: FloatArray = 1.0 + with_drive - torque_at(acting, usual, n, **signals)
    return out


def acting_effect(model: AxisModel, effect: EffectEstimate) -> ActingEffect:
    """An effect of a model. Raises BadInputError for one that this version does not know."""
    part = part_of(model, effect)
    return ActingEffect(part, fitted_of(part, effect))


def _outside(model: AxisModel, effect: EffectEstimate) -> tuple[ActingEffect, str]:
    """An effect, and why the loop of its axis leaves it out; '' where it does not."""
    acting = acting_effect(model, effect)
    anywhere = 'angle' in acting.effect.signals and not EVERY[model.axis].turns
    return acting, why_outside(acting) or (NEEDS_HEIGHT if anywhere else '')


def _inside(model: AxisModel) -> list[ActingEffect]:
    return [acting for acting, why in (_outside(model, e) for e in model.effects) if not why]


CYCLES_HZ = 20.0, 1000.0
"""Control cycles per second at which a firmware may close the loop of the climb."""


def in_flight(model: AxisModel) -> AxisModel:
    """The model in the loop of the firmware: at its cycle, behind the sensor that it has.

    A rotation was measured by that. A speed comes more rarely and from elsewhere, while the
    firmware integrates its accelerometer, and the noise of that is not in the model.
    """
    gains, axis = model.active_gains, EVERY[model.axis]
    if axis.turns or axis.outer or 'loop.rate_hz' not in gains:
        return model
    rate_hz, (low, high) = gains['loop.rate_hz'], CYCLES_HZ
    if not low <= rate_hz <= high:
        raise BadInputError(f'{model.axis}: loop.rate_hz', f'must be {low:g} to {high:g}', rate_hz,
                            'record /gains/active of the aircraft')
    return replace(model, dt=1.0 / rate_hz, noise=None,
                   gyro_filter_hz=gains.get('sensor.accel_filter_hz') or None)


def _usual(model: AxisModel, effects: list[ActingEffect]) -> dict[str, float]:
    """Throttle and battery voltage (V) at which the loop is judged: the flight's means.

    Where the model does not know them, those at which its effects count as usual.
    """
    usual = {'throttle': 0.5, 'battery': 1.0}
    for acting in reversed(effects):
        usual |= acting.effect.usual(acting.p, acting.part.settings)
    means = {'throttle': model.mean_throttle, 'battery': model.mean_battery_v}
    return usual | {name: value for name, value in means.items() if value is not None}


def usual_signals(model: AxisModel) -> dict[str, float]:
    """Throttle (`throttle`) and voltage (`battery`, V) at which a model counts as flown."""
    return _usual(model, [acting_effect(model, effect) for effect in model.effects])


def whole_plant(model: AxisModel) -> Flying:
    """The plant with all its effects, at the flight's mean throttle and voltage."""
    plant, usual = plant_of(model), usual_signals(model)
    return Flying(plant, around(usual['throttle'], usual['battery']))


def behind_lean(model: AxisModel, inner: AxisModel) -> AxisModel:
    """Surge or sway over the reference of the lean: behind the loop of pitch or roll (`inner`).

    That loop, with the gains of its flight, as the lag and the delay that answer most like it.
    Raises BadInputError where these gains are not known.
    """
    if contract_names(inner.axis)['angle_kp'] not in inner.active_gains:
        raise BadInputError(model.axis, f'needs the gains with which {inner.axis} was flown',
                            remedy='record /gains/active')
    gains = CascadeGains.from_mapping(inner.active_gains, inner.axis)
    # rad/s, where a loop around the lean works
    plant, omega = loop_plant(inner), np.geomspace(0.1, 4.0, 40)
    response = loops_of([(plant, plant.trial.wide)]).response(omega)
    answer = reference_response(gains, response, omega, inner.dt)[0]

    def error(p: FloatArray) -> FloatArray:
        approximation = np.exp(-1j * omega * p[1]) / (1.0 + 1j * omega * p[0])
        return np.concatenate([(approximation - answer).real, (approximation - answer).imag])

    lag, delay = least_squares(error, [0.2, 0.05], bounds=(0.0, 2.0)).x
    added = {'lag': lag - model.value('lag'), 'delay': delay + model.value('lag')}
    return replace(model, base=tuple(
        replace(parameter, value=parameter.value + added.get(parameter.name, 0.0))
        for parameter in model.base))


def loop_plant(model: AxisModel, moved: Mapping[str, float] | None = None) -> Flying:
    """The plant that the controller sees; `moved`: throttle or battery (V) of another flight.

    Raises BadInputError for effects that are not known and parameters that are not finite.
    """
    inside = _inside(model)
    flying = [acting for acting in inside
              if not acting.effect.repeats_hz(acting.p) and not acting.effect.wanders]
    law = Part(model.law) if model.law else None
    p = np.array([model.value(name) for name in Structure(law=law).base_names])
    usual = {**_usual(model, inside), **(moved or {})}
    p[0] *= schedule_factor(model, (moved or {}).get('battery'))
    p[2] = max(0.0, p[2]) + sum(
        acting.effect.longest_s(acting.p) for acting in inside
        if 0.0 < acting.effect.repeats_hz(acting.p) < SLOW_HZ
    )
    parts = tuple(acting.part for acting in flying)
    plant = plant_like(
        model.axis, np.concatenate([p, *(acting.p for acting in flying)]), model.dt,
        model.gyro_filter_hz, structure=Structure(parts, law=law),
        craft=model.craft, conditions=(usual['throttle'], usual['battery']),
    )
    return plant if EVERY[model.axis].turns else _about_trim(plant)


def _about_trim(flying: Flying) -> Flying:
    """The same about the command that holds it: a climb flies beside the throttle of the hover."""
    plant, trim = flying.plant, 0.0
    gain, out = float(plant.p[0]), flying
    for _ in range(4 if plant.structure.parts else 1):
        trim -= out.rest_acceleration / gain if gain else 0.0
        structure = replace(plant.structure, parts=(Part(Trim(trim)), *plant.structure.parts))
        out = replace(flying, plant=replace(plant, structure=structure))
    return out


def schedule_factor(model: AxisModel, battery_v: float | None = None) -> float:
    """The firmware's factor on commands at `battery_v` (V; None: the flight's mean).

    From its schedule on the voltage (`<axis>.sag.*`); 1 without one.
    """
    volts = model.mean_battery_v if battery_v is None else battery_v
    exponent, reference = (model.active_gains.get(f'{model.axis}.sag.{name}', 0.0)
                           for name in ('exponent', 'reference_v'))
    return float((reference / volts) ** exponent) if volts and reference > 0.0 else 1.0


def gain_range(model: AxisModel) -> tuple[float, float, float]:
    """Least, usual and largest factor on the gain by effects outside of the loop; 1 without.

    What it remembers, from cold on, what swings or wanders, and what changed over the flight.
    """
    low = usual = high = 1.0
    effects = _inside(model)
    conditions = _usual(model, effects)
    for acting in effects:
        effect = acting.effect
        if effect.term != 'gain' or effect.moves_command:
            continue
        if effect.wanders or effect.repeats_hz(acting.p):
            size = 2.0 * acting.p[0] if effect.wanders else np.hypot(*acting.p[1:3])
            factors = np.array([1.0 - size, 1.0 + size])
        elif isinstance(effect, Warming):
            factors = effect.factors(acting.p, acting.part.settings)
        elif 'knots' in acting.part.settings and effect.signals[0] == 'time':
            usual *= float(_factor(acting, conditions)[0])
            knots = np.array(acting.part.settings['knots'], dtype=float)
            factors = _factor(acting, conditions, time=knots)
        else:
            continue
        factors = np.maximum(factors, 0.1)
        low, high = low * float(factors.min()), high * float(factors.max())
    return low, usual, high


def not_in_the_loop(model: AxisModel) -> dict[str, str]:
    """The effects that the loop of one axis leaves out, and why."""
    return {e.name: why for e in model.effects if (why := _outside(model, e)[1])}


def share_outside(model: AxisModel) -> dict[str, float]:
    """The largest acceleration over the drive's, by name, of effects that depend on other axes.

    Both over the signals' ranges in the training; none where the model does not know these.
    """
    out: dict[str, float] = {}
    gain, command = model.value('gain'), np.abs(model.ranges.get('command', (0.0, 0.0))).max()
    usual = usual_signals(model)
    for effect in model.effects:
        acting = acting_effect(model, effect)
        if why_outside(acting) != OTHER_AXES or not gain * command > 0.0:
            continue
        extremes: dict[str, Any] = {}
        for name, field in (('other rate', 'other_rates'), ('other angle', 'other_angles'),
                            ('other command', 'other_commands')):
            ends = [np.array(model.ranges.get(f'{name} {i}', (0.0, 0.0))) for i in (1, 2)]
            extremes[field] = tuple(np.meshgrid(*ends)[i].ravel() for i in (0, 1))
        rate = np.repeat(np.abs(model.ranges.get('rate', (0.0, 0.0))).max(), 4)
        s = signals_at(acting, usual, 4, rate=rate, drive=np.repeat(gain * command, 4), **extremes)
        acceleration = acting.effect.torque(s, acting.p, acting.part.settings)
        if acceleration is None:
            acceleration = gain * acting.effect.command(s, acting.p, acting.part.settings)
        share = float(np.abs(acceleration).max() / (gain * command))
        out[effect.name] = share + out.get(effect.name, 0.0)
    return out


def response_of(model: AxisModel, w: FloatArray, amplitude: Level) -> FrequencyResponse:
    """Response from command to measured rate at w (m,) rad/s, linear at an amplitude, in SI.

    Its covariance is that of the base's parameters, first order; None where that is not known.
    """
    from quad_sysid.blackbox import FrequencyResponse

    of, names = model.covariance, model.parameter_names
    shared = [] if of is None else [i for i, name in enumerate(names) if np.isfinite(of[i, i])
                                    and name in {p.name for p in model.base}]
    steps = [] if of is None else [NUDGE * math.sqrt(of[i, i]) or 1e-9 for i in shared]
    models = [replace(model, base=tuple(replace(p, value=p.value + by * (p.name == names[i]))
                                        for p in model.base))
              for i, by in zip(shared, steps, strict=True)]
    here, *near = loops_of([(loop_plant(candidate), amplitude)
                            for candidate in (model, *models)]).response(w)[0]
    if of is None or not shared:
        return FrequencyResponse(w, here, None)
    gradient = (np.stack(near) - here) / np.array(steps)[:, None]
    slopes = np.stack([gradient.real, gradient.imag]).transpose(2, 0, 1)
    covariance = slopes @ of[np.ix_(shared, shared)] @ np.swapaxes(slopes, 1, 2)
    return FrequencyResponse(w, here, covariance)
