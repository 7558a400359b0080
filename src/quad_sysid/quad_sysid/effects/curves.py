"""The matrix: each term of the base as a smooth curve of a signal; and what wanders by itself.

Terms are torque, gain, damping, friction, lag and delay; a cell is one entry of CURVES. A curve is
a Gaussian process at knots, linear between them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.effects.constants import SLOW_MOVES
from quad_sysid.model import laws
from quad_sysid.model.data import AxisData
from quad_sysid.model.effect import (
    TRANSITION,
    UNITS,
    Drive,
    Effect,
    Settings,
    Signals,
    Spec,
    per_unit,
    required,
    size_of_term,
)

COUNT, LENGTH = 6, 0.6
"""Number of knots, and correlation length as a share of their range."""
PLACES = np.linspace(-1.0, 1.0, COUNT)
"""Where the knots are, before they are placed over a signal."""
ACTS_ON: dict[str, tuple[str, ...]] = {
    'torque': (), 'gain': ('command',), 'damping': ('rate',), 'friction': ('rate',),
    'lag': ('command',), 'delay': ('command',),
}
"""Term → the signal that its acceleration is proportional to."""


def signal_of(s: Signals, name: str) -> FloatArray:
    """A signal in a matrix's word for it, along a flight or in a free run."""
    if name.startswith('other angle'):
        return required(s.other_angles)[int(name[-1]) - 1]
    return required({
        'rate': s.rate, 'angle': s.angle, 'throttle': s.throttle, 'battery': s.battery_v,
        'time': s.own_time, 'command': s.lagged,
    }[name])


def shape_name(term: str, signal: str) -> str:
    """The contract's name of a term that depends on a signal."""
    kind = signal.rstrip(' 12').replace(' ', '_')
    return f'shape:{kind}' if term in ('torque', 'friction') else f'shape:{term}:{kind}'


def over_knots(x: FloatArray, y: FloatArray, settings: Settings) -> FloatArray:
    """(n,) a curve over x (n,), linear between its values y at the knots, constant beyond them.

    Less its mean over the training, so that the base's parameters keep their meaning.
    """
    knots, mean = _arrays(settings['knots'], settings['mean'])
    return np.interp(x, knots, y - mean @ y)


@lru_cache(maxsize=1024)
def _arrays(*columns: tuple[float, ...]) -> list[FloatArray]:
    return [np.array(column) for column in columns]


def knot_settings(used: FloatArray, knots: FloatArray) -> dict[str, Any]:
    """Settings of a curve with these knots (k,) over a signal, whose mean over it is zero."""
    inside = np.clip(used[np.isfinite(used)], knots[0], knots[-1])
    mean = tuple(float(np.mean(np.interp(inside, knots, hat))) for hat in np.eye(knots.size))
    return {'knots': tuple(knots.tolist()), 'mean': mean}


def placed_around_zero(used: FloatArray, reach: float = 1.0) -> dict[str, Any]:
    """Settings as of `placed`, with knots that are dense around zero, where friction acts.

    They end at `reach` times the largest |used| (n,), apart from spikes.
    """
    far = np.max(np.abs(np.nanpercentile(used, [0.5, 99.5])))
    return knot_settings(used, reach * far * np.sign(PLACES) * np.abs(PLACES) ** 1.7)


class Shape(Effect):
    """A term of the base that varies with a signal, in the words of AxisData.signal."""

    kind = 'shape'
    size = size_of_term

    def shaped(self, term: str, signal: str, how: str, *more: str) -> None:
        """Take the names that follow from term, signal and how the term follows it."""
        self.term, self.signal, self.name = term, signal, shape_name(term, signal)
        variant = [how]
        if signal.startswith('other'):
            variant.append(signal[-1])
            self.others = (int(signal[-1]) - 1,)
        self.variant = ' '.join([*variant, *(['friction'] if term == 'friction' else [])])
        self.signals = (signal, *ACTS_ON[term], *more)


class Smooth(Shape):
    """A shape whose parameters from `first` on are the values of a curve at its knots."""

    first = 0

    def valued(self, spec: Spec) -> tuple[Spec, ...]:
        """The curve's values, each as `spec` says."""
        return tuple(replace(spec, name=f'{spec.name}{i}') for i in range(COUNT))

    def precision(self, settings: Settings, sizes: FloatArray) -> FloatArray:
        distance = (PLACES[:, None] - PLACES) / (2.0 * LENGTH)
        kernel = np.exp(-0.5 * distance**2) + 1e-3 * np.eye(COUNT)
        out, where = np.diag(sizes**-2.0), slice(self.first, self.first + COUNT)
        out[where, where] = np.linalg.inv(kernel) / sizes[self.first] ** 2
        return out

    @property
    def linear(self) -> list[int]:
        return list(range(self.first, self.first + COUNT))

    def readable(self, p: FloatArray, settings: Settings) -> Mapping[str, tuple[float, str]]:
        mean = np.zeros(p.size)
        mean[self.linear] = np.dot(settings['mean'], p[self.linear])
        return super().readable(p - mean, settings)


class Curve(Smooth):
    """One term of the base as a curve of one signal: an acceleration."""

    def __init__(self, term: str, signal: str) -> None:
        self.shaped(term, signal, 'smooth')
        spread = {'lag': 0.5, 'delay': 0.01}.get(term)
        self.parameters = (*self.valued(Spec('y', UNITS[term], spread=spread)),
                           *((TRANSITION,) * (term == 'friction')))

    def prepare(self, data: AxisData) -> Settings | str:
        signal = data.signal(self.signal)
        if isinstance(signal, str):
            return signal
        used = data.training(signal)
        low, high = np.nanpercentile(used, [0.5, 99.5])
        if self.signal in ('throttle', 'battery') and high - low < SLOW_MOVES * abs(high):
            return f'{self.signal} hardly moves during training'
        if not high - low > 1e-9 * max(1.0, abs(high)):
            return f'{self.signal} does not move during training'
        if self.signal in ('rate', 'command'):
            settings = placed_around_zero(used)
        else:
            settings = knot_settings(used, np.linspace(low, high, COUNT))
        if self.term == 'friction':  # the base has none
            settings['mean'] = (0.0,) * COUNT
        elif self.signal == 'time':  # the base is what the flight ends with
            settings['mean'] = (*[0.0] * (COUNT - 1), 1.0)
        return settings

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray | None:
        factor = per_unit(self.term, s, float(p[-1]))
        return factor * over_knots(signal_of(s, self.signal), p[:COUNT], settings)

    def columns(self, s: Signals, p: FloatArray, linear: Sequence[int],
                settings: Settings) -> FloatArray:
        factor, out = per_unit(self.term, s, float(p[-1])), np.empty((s.rate.size, COUNT))
        x, factor = (np.ascontiguousarray(y) for y in (signal_of(s, self.signal), factor))
        laws.hats(x, factor, *_arrays(settings['knots'], settings['mean']), out)
        return out[:, linear]

    def usual(self, p: FloatArray, settings: Settings) -> Mapping[str, float]:
        if self.signal not in ('throttle', 'battery'):
            return super().usual(p, settings)
        return {self.signal: 0.5 * float(settings['knots'][0] + settings['knots'][-1])}


class LagCurve(Curve):
    """The motors' lag as a curve of one signal."""

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> None:
        return None

    def actuate(self, drive: Drive, s: Signals, p: FloatArray, settings: Settings) -> Drive:
        signal = required(s.sent) if self.signal == 'command' else signal_of(s, self.signal)
        return replace(drive, lag=drive.lag * np.exp(over_knots(signal, p, settings)))


class Wandering(Shape):
    """The gain wanders by itself: what changes it was not recorded.

    The coefficient is noise with a spread and a correlation time. The filter follows it along
    every flight by a recursive prediction-error method, so that no curve of one flight is taken
    to the next. A wandering torque is no effect: it is the disturbance that every model has.
    """

    wanders = True
    parameters = (
        Spec('spread', '1', spread=1.0, centre=math.log(0.3), log=True, starts=(0.1, 0.3, 1.0)),
        Spec('correlation', 's', spread=1.0, centre=math.log(10.0), log=True, starts=(2.0, 10.0)),
    )

    def __init__(self) -> None:
        self.shaped('gain', 'time', 'wandering', 'history')

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        return np.zeros_like(s.rate) if s.hidden is None else s.hidden[0] * s.drive

    def advance(self, x: FloatArray, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        return x * math.exp(-s.dt / float(p[1]))


CELLS = {
    'torque': ('rate', 'angle', 'command', 'throttle', 'time'),
    'gain': ('rate', 'command', 'throttle', 'battery', 'time'),
    'damping': ('angle', 'command', 'throttle', 'time'),
    'friction': ('rate', 'throttle', 'time'),
    'lag': ('command', 'throttle', 'time'),
    'delay': ('throttle', 'time'),
}
"""Term → the signals that it may follow."""

CURVES: tuple[Effect, ...] = (
    *((LagCurve if term == 'lag' else Curve)(term, signal)
      for term, signals in CELLS.items() for signal in signals), Wandering(),
)
