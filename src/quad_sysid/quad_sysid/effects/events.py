"""Events at a time, and periodic disturbances."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.effects.couplings import clock
from quad_sysid.model.data import AxisData
from quad_sysid.model.effect import Effect, Settings, Signals, Spec

EDGE_S = 1.0
"""Least distance of an event from the ends of the training segments."""
GRID_S = 0.5
LONG_AGO_S = -1e6
"""Time of an event that happened before this flight."""


def times(data: AxisData) -> FloatArray:
    """A grid of times inside the training segments, s."""
    now = clock(data)
    parts = [np.arange(now[a] + EDGE_S, now[b - 1] - EDGE_S, GRID_S) for a, b in data.train]
    return np.concatenate([np.zeros(0), *parts])


def after(s: Signals, time_s: float) -> FloatArray:
    """0 before a time, 1 after it, with a smooth transition over a few cycles."""
    return 0.5 * (1.0 + np.tanh((s.time - time_s) / 0.02))


class StepTorque(Effect):
    """A constant torque that begins at one time."""

    name = 'step_event'
    variant = 'torque'
    signals = ('time',)
    parameters = (Spec('time', 's', spread=30.0), Spec('torque', 'rad/s²'))
    physics = 'from a time on a constant torque acts (a load shifts)'
    excite = 'any; the event itself must fall into the training segments'

    def starts(self, data: AxisData, settings: Settings) -> Sequence[FloatArray]:
        return [np.array([t, 0.0]) for t in times(data)]

    def size(self, s: Signals, j: int, settings: Settings) -> FloatArray:
        return np.ones_like(s.time)

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        return p[1] * after(s, p[0])

    def elsewhere(self, p: FloatArray, settings: Settings, phase: float) -> FloatArray:
        return np.array([LONG_AGO_S, p[1]])


class Pulse(Effect):
    """A constant torque that acts for a limited time."""

    name = 'event'
    kind = 'event'
    variant = 'torque for a while'
    signals = ('time',)
    parameters = (
        Spec('time', 's', spread=30.0),
        Spec('duration', 's', spread=1.0, centre=math.log(1.0), log=True),
        Spec('torque', 'rad/s²'),
    )
    physics = 'a constant torque acts for a while (a touch, a cable that catches)'
    excite = 'any; the event itself must fall into the training segments'

    def starts(self, data: AxisData, settings: Settings) -> Sequence[FloatArray]:
        return [np.array([t, d, 0.0]) for d in (0.3, 1.0, 3.0) for t in times(data)]

    def size(self, s: Signals, j: int, settings: Settings) -> FloatArray:
        return np.ones_like(s.time)

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        return p[2] * (after(s, p[0]) - after(s, p[0] + p[1]))

    def elsewhere(self, p: FloatArray, settings: Settings, phase: float) -> FloatArray:
        return np.array([LONG_AGO_S, p[1], p[2]])


class StepGain(Effect):
    """A gain that changes at one time."""

    name = 'step_event'
    variant = 'gain'
    signals = ('time', 'command')
    term = 'gain'
    parameters = (Spec('time', 's', spread=30.0), Spec('change', '1', spread=0.3))
    physics = 'from a time on the gain is scaled by 1 + change (a blade chips)'
    excite = 'any; the event itself must fall into the training segments'

    def starts(self, data: AxisData, settings: Settings) -> Sequence[FloatArray]:
        return [np.array([t, 0.0]) for t in times(data)]

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        return p[1] * s.drive * after(s, p[0])

    def elsewhere(self, p: FloatArray, settings: Settings, phase: float) -> FloatArray:
        return np.array([LONG_AGO_S, p[1]])


class PeriodicDisturbance(Effect):
    """A sinusoidal torque whose phase differs from flight to flight."""

    name = 'periodic_disturbance'
    signals: tuple[str, ...] = ('time',)
    parameters = (
        Spec('frequency', 'Hz', spread=1.3, centre=math.log(1.5), log=True),
        Spec('sine', 'rad/s²'),
        Spec('cosine', 'rad/s²'),
    )
    physics = 'A sin(2 pi f t + phase): an unbalanced part, a swinging load'
    excite = 'any flight of many periods'
    phased = True

    def size(self, s: Signals, j: int, settings: Settings) -> FloatArray:
        return np.ones_like(s.time)

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        phase = 2.0 * math.pi * p[0] * s.time
        return p[1] * np.sin(phase) + p[2] * np.cos(phase)

    def elsewhere(self, p: FloatArray, settings: Settings, phase: float) -> FloatArray:
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


class PeriodicGain(PeriodicDisturbance):
    """A gain that swings, such as the beat of two motors or of a filter with its line."""

    name = 'shape:gain:time'
    kind = 'shape'
    variant = 'periodic'
    signals = ('time', 'command')
    term = 'gain'
    parameters = (PeriodicDisturbance.parameters[0], Spec('sine', '1'), Spec('cosine', '1'))
    physics = 'gain times 1 + A sin(2 pi f t + phase)'
    excite = 'excitation over many periods'

    def size(self, s: Signals, j: int, settings: Settings) -> FloatArray:
        return s.drive

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        return s.drive * super().torque(s, p, settings)


EVENTS = (StepTorque(), StepGain(), Pulse(), PeriodicDisturbance(), PeriodicGain())
