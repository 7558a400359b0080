"""From the identified AxisModel to the plant that one axis' loop sees.

Its effects fly by their own laws, at the flight's mean throttle and voltage, the other axes at
rest. `not_in_the_loop` names those that one axis' loop cannot hold; what changes by itself, or
swings whatever the loop does, is a range of the gain or a longer delay.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.effects.hidden import Memory as Warming
from quad_sysid.estimate.stored import fitted_of, part_of, plant_of
from quad_sysid.loop.plant import LATE_S, Flying, around, plant_like
from quad_sysid.model import AxisModel, EffectEstimate
from quad_sysid.model.effect import Effect, Part, Signals
from quad_sysid.model.structure import Structure

HERE = {'rate', 'angle', 'command', 'throttle', 'battery', 'time', 'motors', 'history',
        'direction'}
"""Signals that one axis' loop contains or holds constant."""
OTHER_AXES, BY_ITSELF = 'it depends on the other axes', 'it changes by itself'
SLOW_HZ = 10.0
"""What repeats itself slower than this is no vibration to a loop: its worst case counts."""


@dataclass(frozen=True)
class Placed:
    """An effect of a model with its parameters (p,), as on the next flight."""

    part: Part
    p: FloatArray

    @property
    def effect(self) -> Effect:
        """Its physics."""
        return self.part.effect

    @property
    def why_outside(self) -> str:
        """Why one axis' loop cannot hold it; '' where it does."""
        effect = self.effect
        if not set(effect.signals) <= HERE:
            return OTHER_AXES
        if effect.repeats_hz(self.p) and effect.term == 'torque':
            return 'it is a disturbance, whatever the loop does'
        if effect.wanders and effect.term != 'gain':
            return BY_ITSELF
        return ''

    def signals(self, at: Mapping[str, float], n: int = 1, **moved: Any) -> Signals:
        """Signals (n,) at the usual values `at`, all but `moved` at rest."""
        usual = {'time': np.full(n, LATE_S), 'throttle': np.full(n, at['throttle']),
                 'battery_v': np.full(n, at['battery']), 'sent': np.zeros(n)}
        return Signals.at_rest(**(usual | moved))

    def torque(self, at: Mapping[str, float], n: int = 1, **moved: FloatArray) -> FloatArray:
        """(n,) acceleration, rad/s², at the usual values `at`, all signals but `moved` at rest.

        What it remembers is settled.
        """
        s, settings = self.signals(at, n, **moved), self.part.settings
        if self.effect.states:
            s = replace(s, hidden=self.effect.settled(s, self.p, settings))
        own = self.effect.torque(s, self.p, settings)
        return np.zeros(n) if own is None else np.broadcast_to(own, (n,))

    def factor(self, at: Mapping[str, float], **moved: FloatArray) -> FloatArray:
        """Factor on the drive in small motion."""
        n = max((x.size for x in moved.values()), default=1)
        with_drive = self.torque(at, n, drive=np.ones(n), **moved)
        out: FloatArray = 1.0 + with_drive - self.torque(at, n, **moved)
        return out


def placed(model: AxisModel, effect: EffectEstimate) -> Placed:
    """An effect of a model. Raises BadInputError for one that this version does not know."""
    part = part_of(model, effect)
    return Placed(part, fitted_of(part, effect))


def _inside(model: AxisModel) -> list[Placed]:
    return [one for one in (placed(model, e) for e in model.effects) if not one.why_outside]


def _usual(model: AxisModel, effects: list[Placed]) -> dict[str, float]:
    """Throttle and battery voltage (V) at which the loop is judged: the flight's means.

    Where the model does not know them, those at which its effects count as usual.
    """
    at = {'throttle': 0.5, 'battery': 1.0}
    for one in reversed(effects):
        at |= one.effect.usual(one.p, one.part.settings)
    known = {'throttle': model.mean_throttle, 'battery': model.mean_battery_v}
    return at | {name: value for name, value in known.items() if value is not None}


def usual_signals(model: AxisModel) -> dict[str, float]:
    """Throttle (`throttle`) and voltage (`battery`, V) at which a model counts as flown."""
    return _usual(model, [placed(model, effect) for effect in model.effects])


def whole_plant(model: AxisModel) -> Flying:
    """The plant with all its effects, at the flight's mean throttle and voltage."""
    plant, at = plant_of(model), usual_signals(model)
    return Flying(plant, around(at['throttle'], at['battery']))


def loop_plant(model: AxisModel, moved: Mapping[str, float] | None = None) -> Flying:
    """The plant that the controller sees; `moved`: throttle or battery (V) of another flight.

    Raises BadInputError for effects that are not known and parameters that are not finite.
    """
    inside = _inside(model)
    flying = [one for one in inside
              if not one.effect.repeats_hz(one.p) and not one.effect.wanders]
    law = None if model.law is None else Part(model.law)
    p = np.array([model.value(name) for name in Structure(law=law).base_names])
    at = {**_usual(model, inside), **(moved or {})}
    p[0] *= schedule_factor(model, (moved or {}).get('battery'))
    p[2] = max(0.0, p[2]) + sum(
        one.effect.longest_s(one.p) for one in inside
        if 0.0 < one.effect.repeats_hz(one.p) < SLOW_HZ
    )
    return plant_like(
        model.axis, np.concatenate([p, *(one.p for one in flying)]), model.dt,
        model.gyro_filter_hz, structure=Structure(tuple(one.part for one in flying), law=law),
        craft=model.craft, at=(at['throttle'], at['battery']),
    )


def schedule_factor(model: AxisModel, battery_v: float | None = None) -> float:
    """The firmware's factor on commands at `battery_v` (V; None: the flight's mean).

    From its schedule on the voltage (`<axis>.sag.*`); 1 without one.
    """
    volts = model.mean_battery_v if battery_v is None else battery_v
    exponent, reference = (model.active_gains.get(f'{model.axis}.sag.{name}', 0.0)
                           for name in ('exponent', 'reference_v'))
    return float((reference / volts) ** exponent) if volts and reference > 0.0 else 1.0


def gain_range(model: AxisModel) -> tuple[float, float, float]:
    """Least, usual and largest factor on the gain by what no signal of a loop tells; 1 without.

    What it remembers, from cold on, what swings or wanders, and what changed over the flight.
    """
    low = usual = high = 1.0
    effects = _inside(model)
    at = _usual(model, effects)
    for one in effects:
        effect = one.effect
        if effect.term != 'gain' or effect.moves_command:
            continue
        if effect.repeats_hz(one.p):
            size = float(np.hypot(*one.p[1:3]))
            factors = np.array([1.0 - size, 1.0 + size])
        elif effect.wanders:
            size = 2.0 * float(one.p[0]) * float(one.part.settings['unit'])
            factors = np.array([1.0 - size, 1.0 + size])
        elif isinstance(effect, Warming):
            factors = effect.factors(one.p, one.part.settings)
        elif 'knots' in one.part.settings and effect.signals[0] == 'time':
            usual *= float(one.factor(at)[0])
            factors = one.factor(at, time=np.array(one.part.settings['knots'], dtype=float))
        else:
            continue
        factors = np.maximum(factors, 0.1)
        low, high = low * float(factors.min()), high * float(factors.max())
    return low, usual, high


def not_in_the_loop(model: AxisModel) -> dict[str, str]:
    """The effects that the loop of one axis leaves out, and why."""
    found = ((e.name, placed(model, e).why_outside) for e in model.effects)
    return {name: why for name, why in found if why}


def share_outside(model: AxisModel) -> dict[str, float]:
    """Of those that depend on more than disturbances, the largest acceleration over the drive's.

    Both over the signals' ranges in the training; none where the model does not know these.
    """
    out: dict[str, float] = {}
    gain, command = model.value('gain'), np.abs(model.ranges.get('command', (0.0, 0.0))).max()
    at = usual_signals(model)
    for found in model.effects:
        one = placed(model, found)
        if one.why_outside not in (OTHER_AXES, BY_ITSELF) or not gain * command > 0.0:
            continue
        moved: dict[str, Any] = {}
        for name, field in (('other rate', 'other_rates'), ('other angle', 'other_angles'),
                            ('other command', 'other_commands')):
            ends = [np.array(model.ranges.get(f'{name} {i}', (0.0, 0.0))) for i in (1, 2)]
            moved[field] = tuple(np.meshgrid(*ends)[i].ravel() for i in (0, 1))
        rate = np.repeat(np.abs(model.ranges.get('rate', (0.0, 0.0))).max(), 4)
        s = one.signals(at, 4, rate=rate, drive=np.repeat(gain * command, 4), **moved)
        if one.effect.wanders:
            s = replace(s, hidden=np.full((1, 4), 2.0 * float(one.p[0])))
        elif one.effect.states:
            continue
        pushed = one.effect.torque(s, one.p, one.part.settings)
        if pushed is None:
            pushed = gain * one.effect.command(s, one.p, one.part.settings)
        out[found.name] = float(np.abs(pushed).max() / (gain * command))
    return out
