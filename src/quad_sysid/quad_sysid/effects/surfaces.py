"""Cells of two signals: a torque as a smooth surface over what is, and what is or lately was.

Orthogonal polynomials of low degree, in both signals together: what no curve of one signal says.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
from numpy.polynomial.legendre import legvander

from quad_sysid.contract import FloatArray
from quad_sysid.effects.curves import SLOW_MOVES, Shape, signal_of
from quad_sysid.effects.hidden import Linear, System, followed, step_of
from quad_sysid.model.data import AxisData
from quad_sysid.model.effect import Settings, Signals, Spec, required

DEGREE = 4
"""Highest total degree of a surface."""
FADES = 0.7
"""Size of a coefficient beside one of a degree less."""
EDGE = 1.1
"""The surface goes on for a tenth of its half range, and is constant from there on."""
POWERS = tuple(
    (i, j) for i, j in itertools.product(range(DEGREE + 1), repeat=2) if 0 < i + j <= DEGREE
)


class Surface(Shape, Linear):
    """A torque as a smooth surface over two signals; `lately`: the second behind a lag."""

    free = True
    kind = 'shape'

    def __init__(self, first: str, second: str, *, lately: bool) -> None:
        past = f'past {second}' if lately else second
        self.shaped('torque', first, f'with {past}')
        self.second, self.states = second, int(lately)
        self.signals = (first, second, 'history') if lately else (first, second)
        self.integrates = lately and second == 'rate'
        lag = Spec('time_constant', 's', spread=1.0, centre=math.log(0.2), log=True,
                   starts=(0.05, 0.2, 0.8))
        self.parameters = (
            *((lag,) if lately else ()), *(Spec(f'c{i}{j}', 'rad/s²') for i, j in POWERS),
        )
        self.physics = f'torque sum of c_ij P_i({first}) P_j({past}), Legendre polynomials'
        self.excite = f'let {first} and {second} cover their ranges in all combinations'

    def prepare(self, data: AxisData) -> Settings | str:
        settings = {}
        for place, name in (('first', self.signal), ('second', self.second)):
            signal = data.signal(name)
            if isinstance(signal, str):
                return signal
            used = data.training(signal)
            low, high = np.nanpercentile(used, [0.5, 99.5])
            if not high - low > SLOW_MOVES * abs(high) + 1e-9:
                return f'{name} hardly moves during training'
            settings[place] = (0.5 * float(low + high), 0.5 * float(high - low))
        return settings

    def driver(self, s: Signals, settings: Settings) -> FloatArray:
        return _placed(signal_of(s, self.second), settings['second'])

    def system(self, p: FloatArray) -> System:  # type: ignore[override]
        return np.array([[-1.0 / p[0]]]), np.array([1.0 / p[0]])

    def trace(
        self, data: AxisData, s: Signals, p: FloatArray, settings: Settings
    ) -> FloatArray:
        moving = self.driver(s, settings)
        out = moving[None, :].copy()
        followed(data.stretches, moving, *step_of(*self.system(p), data.dt), out)
        return out

    def columns(
        self, s: Signals, p: FloatArray, linear: Sequence[int], settings: Settings
    ) -> FloatArray:
        """(n, len(POWERS)) accelerations per unit of each coefficient: no differences."""
        second = required(s.hidden)[0] if self.states else self.driver(s, settings)
        rows = [
            legvander(np.clip(z, -EDGE, EDGE), DEGREE)
            for z in (_placed(signal_of(s, self.signal), settings['first']), second)
        ]
        return np.stack([rows[0][..., i] * rows[1][..., j] for i, j in POWERS], axis=-1)

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        return self.columns(s, p, (), settings) @ p[self.states :]

    def size(self, s: Signals, j: int, settings: Settings) -> FloatArray:
        return np.ones_like(s.rate)

    def precision(self, settings: Settings, sizes: FloatArray) -> FloatArray:
        fading = [FADES ** (i + j - 1) for i, j in POWERS]
        return np.diag((sizes * np.r_[np.ones(self.states), fading]) ** -2.0)


def _placed(x: FloatArray, place: tuple[float, float]) -> FloatArray:
    """A signal in half ranges of its training."""
    return (x - place[0]) / place[1]


MOVING = ('rate', 'angle', 'command')
SURFACES = (
    *(Surface(first, second, lately=False)
      for first, second in itertools.combinations((*MOVING, 'throttle'), 2)),
    *(Surface(first, second, lately=True) for first, second in itertools.product(MOVING, MOVING)),
)
