"""Effects with a state that moves by a law of its own that is not linear: a load, what yields."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.model import laws
from quad_sysid.model.data import AxisData, Span
from quad_sysid.model.effect import Effect, Settings, Signals, Spec, required, size_of_term
from quad_sysid.model.traced import Traced, noted


def along(
    stretches: Sequence[Span], signal: FloatArray, kernel: Callable[..., None], *numbers: float
) -> FloatArray:
    """(n,) a compiled kernel with memory, run along each unbroken stretch of a signal (n,)."""
    signal = np.ascontiguousarray(signal)
    out = np.array(signal, dtype=float)
    for start, stop in stretches:
        kernel(signal, *numbers, start, stop, out)
    return out


def each_ahead(
    name: str, arrays: Sequence[FloatArray], numbers: Sequence[float], results: int
) -> FloatArray:
    """(results, …) a compiled law of one cycle on arrays (…) of one shape, or it is noted."""
    if any(isinstance(x, Traced) for x in arrays):
        return np.stack(noted(name, arrays, numbers, results))
    rows = np.broadcast_arrays(*arrays)
    out = np.empty((results, rows[0].size))
    AHEAD[name](*(np.ascontiguousarray(x.ravel()) for x in rows), *numbers, out)
    return out.reshape(results, *rows[0].shape)


AHEAD = {'loose': laws.all_loose_ahead, 'yielded': laws.all_yielded}


PULL = Spec('pull', '1/s²', spread=1.0, centre=math.log(60.0), log=True,
            starts=(20.0, 60.0, 180.0))
REACH = Spec('reach', 'rad', spread=1.2, centre=math.log(0.1), log=True,
             starts=(0.02, 0.07, 0.2, 0.6))
SPRING = Spec('frequency', 'Hz', spread=1.0, centre=0.0, log=True,
              starts=(0.1, 0.5, 1.0, 2.0, 4.0, 8.0))
DAMPER = Spec('damping', '1/s', spread=1.0, centre=math.log(2.0), log=True, starts=(0.7, 3.0))
WEIGHT, INERTIA = Spec('weight', 'rad/s²'), Spec('inertia', '1', spread=0.3)
LOADS = {
    'leaning': (('rate', 'history', 'angle'), (SPRING, DAMPER, PULL, WEIGHT, INERTIA)),
    'turning': (('rate', 'history'), (SPRING, DAMPER, REACH, WEIGHT, INERTIA)),
    'driven': (('command', 'history'), (  # a mount: stiffer, and of all the drive
        replace(SPRING, centre=math.log(8.0), starts=(4.0, 8.0, 16.0)),
        replace(DAMPER, centre=math.log(10.0), starts=(7.0, 30.0)),
        replace(REACH, centre=math.log(0.01), starts=(0.003, 0.01, 0.03)), WEIGHT,
        replace(INERTIA, spread=1.0),
    )),
}
"""What moves the load → the signals and the parameters."""


class Load(Effect):
    """A mass on a damped spring between two stops, by its weight and what it does to its mount.

    Gravity pulls it to the side as the aircraft leans (rig), or the aircraft turns beneath it.
    The spring hardens towards the stops, w² z / (1 - z²) with z = -1 to 1, as finitely extensible
    ones do (Warner 1972); without a spring it is a loose load. What the drive moves behind such a
    spring, a gyro on its pads or an arm, gets its acceleration through it.
    """

    kind = 'mode'
    states = 2
    size = size_of_term

    def __init__(self, moved: str) -> None:
        self.moved = moved
        self.name, self.variant = ('mode:soft_mount', '') if moved == 'driven' \
            else ('mode:loose_load', moved)
        self.signals, self.parameters = LOADS[moved]

    def _inputs(self, s: Signals, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """What pulls the mass and how its mount moves, per unit of z."""
        nothing, reach = np.zeros_like(s.rate), max(float(p[2]), 1e-4)
        if self.moved == 'leaning':
            return -p[2] * np.sin(required(s.angle)), nothing
        return (nothing, s.rate / reach) if self.moved == 'turning' else (s.drive / reach, nothing)

    def begin(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        moved = self._inputs(s, p)[1]
        return np.stack([np.zeros_like(moved), moved])

    def trace(
        self, s: Signals, p: FloatArray, settings: Settings, stretches: Sequence[Span],
        begun: FloatArray | None = None,
    ) -> FloatArray:
        pull, moved = self._inputs(s, p)
        out = np.stack([np.zeros_like(moved), moved]) if begun is None else begun.copy()
        w = 2.0 * math.pi * float(p[0])
        for start, stop in stretches:
            laws.loose(pull, moved, w, float(p[1]), s.dt, start, stop, out)
        return np.vstack([out, self._ahead(out, s, p)[2:]])  # what pushed too, along a flight

    def _ahead(self, x: FloatArray, s: Signals, p: FloatArray) -> FloatArray:
        """(3, …) the states a cycle later, and what pushed the mass meanwhile."""
        w = 2.0 * math.pi * float(p[0])
        pull, moved = self._inputs(s, p)
        return each_ahead('loose', (pull, moved, x[0], x[1]), (w, float(p[1]), s.dt), 3)

    def advance(
        self, x: FloatArray, s: Signals, p: FloatArray, settings: Settings
    ) -> FloatArray:
        return self._ahead(x, s, p)[:2]

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        hidden = required(s.hidden)
        z, pushed = hidden[0], (hidden if len(hidden) == 3 else self._ahead(hidden, s, p))[2]
        turned = float(p[2]) if self.moved != 'leaning' else 1.0 / float(p[2])
        directly = s.drive if self.moved == 'driven' else 0.0
        return p[3] * z - p[4] * (directly + turned * pushed)  # turned: rad or s² per unit of z


class Yielding(Effect):
    """A state that flows off by a cubic law: the simplest that yields, leaks to one side or snaps.

    x' = push - (slope x + lean x² + x³) / time_constant; its torque is -T x.
    The cusp's normal form (Thom 1972; Strogatz, Nonlinear Dynamics and Chaos, 3.6). With slope > 0
    a spring on a damper that gives way, with lean a valve, with slope < 0 two places of rest.
    """

    name = 'mode:yielding'
    kind = 'mode'
    states = 1
    size = size_of_term

    def __init__(self, moved: str) -> None:
        self.moved = self.variant = moved
        drive, unit, usual = {'turning': ('rate', 'rad', 0.1), 'leaning': ('angle', 'rad', 0.1),
                              'driven': ('command', '1', 0.05)}[moved]
        self.signals = (drive, 'history')
        self.parameters = (
            Spec('reach', unit, spread=1.2, centre=math.log(usual), log=True,
                 starts=(0.2 * usual, 0.7 * usual, 2.0 * usual)),
            Spec('time_constant', 's', spread=1.5, centre=math.log(0.3), log=True,
                 starts=(0.03, 0.2, 1.2)),
            # pairs: yields, snaps, leaks to either side
            Spec('slope', '1', spread=2.0, starts=(0.3, -1.0, 1.0, 1.0)),
            Spec('lean', '1', spread=1.0, starts=(0.0, 0.0, 1.5, -1.5)),
            Spec('torque', 'rad/s²'),
        )

    def starts(self, data: AxisData, settings: Settings) -> Sequence[FloatArray]:
        reach, time_constant, *shape = (spec.starts for spec in self.parameters[:4])
        return [
            np.array([*begun, *pair, 0.0])
            for begun in itertools.product(reach, time_constant)
            for pair in zip(*shape, strict=True)
        ]

    def _flow(self, s: Signals, p: FloatArray) -> tuple[FloatArray, float, float, float]:
        """Push, slope, lean and 1 / time constant, as the recursion takes them."""
        reach, flow = max(float(p[0]), 1e-4), 1.0 / max(float(p[1]), 1e-3)
        push = s.rate / reach if self.moved == 'turning' else flow / reach * (
            required(s.angle) if self.moved == 'leaning' else s.lagged
        )
        return push, float(p[2]), float(p[3]), flow

    def trace(
        self, s: Signals, p: FloatArray, settings: Settings, stretches: Sequence[Span],
        begun: FloatArray | None = None,
    ) -> FloatArray:
        push, *law = self._flow(s, p)
        return along(stretches, push, laws.yielding, *law, s.dt)[None, :]

    def advance(
        self, x: FloatArray, s: Signals, p: FloatArray, settings: Settings
    ) -> FloatArray:
        push, *law = self._flow(s, p)
        return each_ahead('yielded', (x[0], push), (*law, s.dt), 1)

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        return -p[4] * required(s.hidden)[0]
