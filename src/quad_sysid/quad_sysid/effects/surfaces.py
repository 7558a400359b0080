"""Cells of two signals: a torque as a smooth surface over what is, and what is or lately was.

Products of orthogonal polynomials of low degree: what no curve over one signal can say.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.polynomial.legendre import leg2poly

from quad_sysid.contract import FloatArray
from quad_sysid.effects.curves import SLOW_MOVES, Shape, signal_of
from quad_sysid.effects.hidden import DEGREE, EDGE, FADES, Linear, behind_lag, polynomials
from quad_sysid.model.data import AxisData
from quad_sysid.model.effect import Settings, Signals, Spec, required

BESIDE = {
    'rate': ('angle', 'throttle', 'past rate', 'past angle'),
    'angle': ('throttle', 'past rate', 'past angle'),
}
"""First signal of a surface → its second ones; what is past is behind a lag. None is the command:
the base's gain is such a surface."""
POWERS = tuple(
    (i, j) for i, j in itertools.product(range(DEGREE + 1), repeat=2) if 0 < i + j <= DEGREE
)
FIRST, SECOND = np.array(POWERS).T
IN_POWERS = np.array([np.pad(leg2poly(np.eye(DEGREE + 1)[k, : k + 1]), (0, DEGREE - k))
                      for k in range(DEGREE + 1)])
"""Coefficients of each Legendre polynomial by powers."""


class Surface(Shape, Linear):
    """A torque as a smooth surface over two signals."""

    free = True
    system = staticmethod(behind_lag)

    def __init__(self, first: str, second: str) -> None:
        self.shaped('torque', first, f'with {second}')
        self.second = second.removeprefix('past ')
        self.states = int(second != self.second)
        self.signals = (first, self.second, *(('history',) * self.states))
        lag = Spec('time_constant', 's', spread=1.0, centre=math.log(0.2), log=True,
                   starts=(0.05, 0.2, 0.8))
        self.parameters = (
            *((lag,) * self.states), *(Spec(f'c{i}{j}', 'rad/s²') for i, j in POWERS),
        )
        self.physics = f'torque sum of c_ij P_i({first}) P_j({second}), Legendre polynomials'
        self.excite = f'let {first} and {self.second} cover their ranges in all combinations'

    def prepare(self, data: AxisData) -> Settings | str:
        settings = {}
        for place, name in (('first', self.signal), ('second', self.second)):
            signal = data.signal(name)
            if isinstance(signal, str):
                return signal
            low, high = np.nanpercentile(data.training(signal), [0.5, 99.5])
            if not high - low > SLOW_MOVES * abs(high) + 1e-9:
                return f'{name} hardly moves during training'
            settings[place] = (0.5 * float(low + high), 0.5 * float(high - low))
        return settings

    def seen_along(
        self, s: Signals, followed: Callable[[FloatArray], FloatArray]
    ) -> Signals:
        return replace(s, rate=followed(s.rate)) if self.second == 'rate' else s

    def driver(self, s: Signals, settings: Settings) -> FloatArray:
        return _in_half_ranges(signal_of(s, self.second), settings['second'])

    def begin(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        return self.driver(s, settings)[None] if self.states else np.zeros((0, *s.time.shape))

    def _places(self, s: Signals, settings: Settings) -> tuple[FloatArray, FloatArray]:
        """(n,) either signal from the middle of its range, in halves of that."""
        first = _in_half_ranges(signal_of(s, self.signal), settings['first'])
        return first, required(s.hidden)[0] if self.states else self.driver(s, settings)

    def columns(
        self, s: Signals, p: FloatArray, linear: Sequence[int], settings: Settings
    ) -> FloatArray:
        one, other = map(polynomials, self._places(s, settings))
        return one[..., FIRST] * other[..., SECOND]

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        one, other = (np.clip(x, -EDGE, EDGE) for x in self._places(s, settings))
        coefficients = np.zeros((DEGREE + 1, DEGREE + 1))
        coefficients[FIRST, SECOND] = p[self.states :]
        coefficients = IN_POWERS.T @ coefficients @ IN_POWERS
        total = coefficients[DEGREE, 0]
        for i in reversed(range(DEGREE)):  # Horner's scheme in both
            inner = coefficients[i, DEGREE - i]
            for j in reversed(range(DEGREE - i)):
                inner = coefficients[i, j] + other * inner
            total = inner + one * total
        return total

    def precision(self, settings: Settings, sizes: FloatArray) -> FloatArray:
        fading = [FADES ** (i + j - 1) for i, j in POWERS]
        return np.diag((sizes * np.r_[np.ones(self.states), fading]) ** -2.0)

    def usual(self, p: FloatArray, settings: Settings) -> Mapping[str, float]:
        return {'throttle': settings['second'][0]} if self.second == 'throttle' else {}


def _in_half_ranges(x: FloatArray, place: tuple[float, float]) -> FloatArray:
    """A signal from the middle of its range in the training."""
    return (x - place[0]) / place[1]


SURFACES = tuple(Surface(first, second) for first, others in BESIDE.items() for second in others)
