"""Events at a time, and what repeats itself: both belong to one flight."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.effects.torques import Torque
from quad_sysid.model.data import AxisData
from quad_sysid.model.effect import (
    UNITS,
    Drive,
    Effect,
    FitResidual,
    Settings,
    Signals,
    Spec,
    per_unit,
    size_of_term,
)

EDGE_S = 1.0
"""Least distance of an event from the ends of the training segments."""
GRID_S = 0.5
"""Distance of the times that are tried; the fit moves the best of them. A change of torque shows
for a shorter time, until the filter takes it for a disturbance: its edges are tried as well."""
HARMONICS = 6
"""Harmonics of a delay that repeats itself: nine tenths of a saw's variance."""
FADING = 0.25
"""Share of a cycle over which one held command gives way to the next, for a smooth likelihood."""
ORDERS = np.arange(1.0, HARMONICS + 1.0)


def times(data: AxisData) -> FloatArray:
    """A grid of times inside the training segments, s."""
    now = data.clock
    parts = [np.arange(now[a] + EDGE_S, now[b - 1] - EDGE_S, GRID_S) for a, b in data.train]
    return np.concatenate([np.zeros(0), *parts])


def after(s: Signals, time_s: float) -> FloatArray:
    """0 before a time, 1 after it, with a smooth transition over a few cycles."""
    return 0.5 * (1.0 + np.tanh((s.time - time_s) / 0.02))


class Repeating(Effect):
    """An effect that repeats itself at a frequency, its first parameter, in Hz."""

    def starts_by_residual(self, fit: FitResidual, settings: Settings) -> Sequence[FloatArray]:
        starts = self.starts(fit.data, settings)
        return [np.r_[line, start[1:]] for line in fit.lines(self) for start in starts]

    def repeats_hz(self, p: FloatArray) -> float:
        return float(p[0])


class Event(Torque):
    """A torque that begins at a time, the first parameter."""

    happens = True
    size = size_of_term
    lengths: tuple[tuple[float, ...], ...] = ((),)
    """Start values of the parameters between the time and the size."""

    def prepare(self, data: AxisData) -> Settings | str:
        settings = super().prepare(data)
        return settings if isinstance(settings, str) else {
            **settings, 'until': float(data.clock[-1])}

    def precision(self, settings: Settings, sizes: FloatArray) -> FloatArray:
        # at any time of the flight, however late it began to be excited
        flown_s = max(float(sizes[0]), settings.get('until', 0.0))
        return super().precision(settings, np.r_[flown_s, sizes[1:]])

    def starts(self, data: AxisData, settings: Settings) -> Sequence[FloatArray]:
        return [np.array([t, *d, 0.0]) for d in self.lengths for t in times(data)]

    def starts_by_residual(self, fit: FitResidual, settings: Settings) -> Sequence[FloatArray]:
        starts, data = self.starts(fit.data, settings), fit.data
        if self.term != 'torque':
            return starts
        now = data.clock
        edges = sorted(t for t in fit.edges() if any(
            now[a] + EDGE_S <= t < now[b - 1] - EDGE_S for a, b in data.train))
        count = len(self.parameters) - 1  # begin, or begin and end
        return [*starts, *(np.array([t[0], *np.diff(t), 0.0])
                           for t in itertools.combinations(edges, count))]

    def in_another_flight(self, p: FloatArray, settings: Settings, phase: float) -> FloatArray:
        return np.array([-1e6, *p[1:]])  # it happened long before


class Periodic(Repeating, Torque):
    """A term that swings; its phase differs from flight to flight."""

    size = size_of_term

    def __init__(self, term: str, name: str, **more: str) -> None:
        self.term, unit = term, UNITS[term]
        parameters = (
            Spec('frequency', 'Hz', spread=1.3, centre=math.log(1.5), log=True),
            Spec('sine', unit), Spec('cosine', unit),
        )
        signals = ('time', *(['command'] if term == 'gain' else []))
        super().__init__(name, signals, parameters, self._swing, **more)

    def starts(self, data: AxisData, settings: Settings) -> Sequence[FloatArray]:
        return [np.zeros(3)]  # the frequency comes from what a fit leaves

    def _swing(self, s: Signals, p: FloatArray) -> FloatArray:
        phase = 2.0 * math.pi * p[0] * s.time
        return per_unit(self.term, s) * (p[1] * np.sin(phase) + p[2] * np.cos(phase))

    def in_another_flight(self, p: FloatArray, settings: Settings, phase: float) -> FloatArray:
        size = math.hypot(p[1], p[2])
        return np.array([p[0], size * math.cos(phase), size * math.sin(phase)])

    def readable(self, p: FloatArray, settings: Settings) -> dict[str, tuple[float, str]]:
        return {
            'amplitude': (math.hypot(p[1], p[2]), self.parameters[1].unit),
            'frequency': (float(p[0]), 'Hz'),
            'phase': (math.atan2(p[2], p[1]), 'rad'),
        }

    def fitted(self, values: Mapping[str, float], settings: Settings) -> FloatArray:
        size, phase = values['amplitude'], values['phase']
        return np.array([values['frequency'], size * math.cos(phase), size * math.sin(phase)])


class Clocked(Repeating):
    """The delay of the command repeats itself, as another clock has it."""

    name = 'shape:delay:time'
    kind = 'shape'
    term = 'delay'
    signals = ('command', 'time', 'history')

    def later(self, time: FloatArray, p: FloatArray) -> FloatArray:
        """(n,) what is added to the delay at a time (n,), both in s."""
        raise NotImplementedError


class PeriodicDelay(Clocked):
    """Two clocks that beat, a task that blocks another: a Fourier series.

    Its phase is that of its first harmonic.
    """

    variant = 'periodic'
    parameters = (
        Spec('frequency', 'Hz', spread=1.3, centre=math.log(1.5), log=True),
        *(Spec(f'{wave}_{k}', 's', spread=0.02 / k)  # those of a saw fall as 1 / k
          for k in range(1, HARMONICS + 1) for wave in ('sine', 'cosine')),
    )

    def later(self, time: FloatArray, p: FloatArray) -> FloatArray:
        turns = 2.0 * math.pi * p[0] * np.multiply.outer(ORDERS, time)
        return np.tensordot(p[1::2], np.sin(turns), 1) + np.tensordot(p[2::2], np.cos(turns), 1)

    def longest_s(self, p: FloatArray) -> float:
        return float(np.sum(np.hypot(p[1::2], p[2::2])))

    def actuate(self, drive: Drive, s: Signals, p: FloatArray, settings: Settings) -> Drive:
        return drive.behind((s.delay + self.later(s.time - s.delay, p)) / s.dt)

    def in_another_flight(self, p: FloatArray, settings: Settings, phase: float) -> FloatArray:
        turn = phase - math.atan2(p[2], p[1])
        rotated = (p[1::2] + 1j * p[2::2]) * np.exp(1j * turn * ORDERS)
        return np.r_[p[0], rotated.view(np.float64)]


class SampleAndHold(Clocked):
    """The motors take a command less often than it is computed, and hold it.

    Half a period counts as part of the base's delay.
    """

    variant = 'held'
    parameters = (
        Spec('frequency', 'Hz', spread=1.0, centre=math.log(40.0), log=True),
        Spec('phase', 'rad', spread=2.0, starts=tuple(math.pi * np.arange(-8, 8) / 8.0)),
    )

    def later(self, time: FloatArray, p: FloatArray) -> FloatArray:
        turns = p[0] * time - p[1] / (2.0 * math.pi)
        return (turns - np.round(turns)) / p[0]

    def longest_s(self, p: FloatArray) -> float:
        return 1.5 / float(p[0])

    def actuate(self, drive: Drive, s: Signals, p: FloatArray, settings: Settings) -> Drive:
        begin, phase = s.time - 0.5 * s.dt - s.delay, p[1] / (2.0 * math.pi)
        count = np.floor(p[0] * (begin + s.dt) - phase + 0.5)  # of what is held at its end
        fraction = np.clip(((count + phase - 0.5) / p[0] - begin) / s.dt, 0.0, 1.0)

        def age(count: FloatArray) -> FloatArray:
            cycle = ((count + phase) / p[0] - begin - s.delay) / s.dt - 0.5
            cell = np.floor(cycle)
            return -cell - np.clip((cycle - cell - 0.5) / FADING + 0.5, 0.0, 1.0)

        ages = np.maximum(np.stack([age(count - 1.0), age(count)]), 0.0)
        return replace(drive, ages=ages, fraction=fraction)

    def in_another_flight(self, p: FloatArray, settings: Settings, phase: float) -> FloatArray:
        return np.array([p[0], phase])


BEGINS = Spec('time', 's', spread=30.0, starts=(0.0,))
EVENTS: tuple[Effect, ...] = (
    Event(
        'step_event', ('time',), (BEGINS, Spec('torque', 'rad/s²')),
        lambda s, p: p[1] * after(s, p[0]), variant='torque'),
    Event(
        'step_event', ('time', 'command'), (BEGINS, Spec('change', '1', spread=0.3)),
        lambda s, p: p[1] * s.drive * after(s, p[0]), variant='gain', term='gain'),
    Event(
        'event', ('time',),
        (
            BEGINS, Spec('duration', 's', spread=1.0, centre=math.log(1.0), log=True),
            Spec('torque', 'rad/s²'),
        ),
        lambda s, p: p[2] * (after(s, p[0]) - after(s, p[0] + p[1])),
        lengths=((0.4,), (2.0,)), kind='event', variant='torque for a while'),
    Periodic('torque', 'periodic_disturbance'),
    Periodic('gain', 'shape:gain:time', kind='shape', variant='periodic'),
    PeriodicDelay(), SampleAndHold(),
)
