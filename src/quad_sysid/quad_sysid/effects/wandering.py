"""Terms of the base that wander by themselves: what changes them was not recorded.

The coefficient is noise with a spread and a correlation time. The filter follows it along every
flight by a recursive prediction-error method, so that no curve of one flight is taken to the next.
A wandering torque is no effect: it is the disturbance that every model has.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.effects.curves import Shape
from quad_sysid.model.data import AxisData, high, typical_acceleration
from quad_sysid.model.effect import UNITS, Settings, Signals, Spec, per_unit

USUAL = {'gain': 1.0, 'lag': 1.0, 'delay': 0.01}
"""What counts as a large change of a term, in its unit; of damping and friction it is what adds
half of the axis' own acceleration."""


class Wandering(Shape):
    """One term of the base wanders by itself."""

    wanders = True
    parameters = (
        Spec('spread', '1', spread=1.0, centre=math.log(0.3), log=True, starts=(0.1, 0.3, 1.0)),
        Spec('correlation', 's', spread=1.0, centre=math.log(10.0), log=True, starts=(2.0, 10.0)),
    )
    excite = 'a long flight with excitation throughout'

    def __init__(self, term: str) -> None:
        self.shaped(term, 'time', 'wandering', 'history')
        self.physics = f"the {term} wanders: x' = -x / correlation + noise, of RMS `spread`"

    def prepare(self, data: AxisData) -> Settings | str:
        if self.term in USUAL:
            return {'unit': USUAL[self.term]}
        rate = high(data.training(data.rate)) if self.term == 'damping' else 1.0
        return {'unit': 0.5 * typical_acceleration(data, data.train) / rate}

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        if s.hidden is None:
            return np.zeros_like(s.rate)
        own: FloatArray = settings['unit'] * s.hidden[0] * per_unit(self.term, s)
        return own

    def advance(
        self, x: FloatArray, s: Signals, p: FloatArray, settings: Settings, dt: float
    ) -> FloatArray:
        return x * math.exp(-dt / float(p[1]))

    def readable(self, p: FloatArray, settings: Settings) -> dict[str, tuple[float, str]]:
        return {
            'spread': (float(p[0]) * settings['unit'], UNITS[self.term]),
            'correlation': (float(p[1]), 's'),
        }

    def fitted(self, values: Mapping[str, float], settings: Settings) -> FloatArray:
        return np.array([values['spread'] / settings['unit'], values['correlation']])


WANDERING = tuple(Wandering(term) for term in UNITS if term != 'torque')
