"""Named torques of rate and angle, divided by the axis' inertia: rad/s²."""

from __future__ import annotations

import math

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.model.data import AxisData
from quad_sysid.model.effect import Effect, Settings, Signals, Spec, required

TRANSITION = Spec('transition', 'rad/s', spread=1.0, centre=math.log(0.005), log=True,
                  starts=(0.003, 0.04))
"""Rate over which friction changes its sign."""


class CoulombFriction(Effect):
    """Dry friction, with a smooth transition through rest."""

    name = 'coulomb_friction'
    signals = ('rate',)
    parameters: tuple[Spec, ...] = (Spec('torque', 'rad/s²', positive=True), TRANSITION)
    physics = '-T sign(rate): dry friction of a bearing (Coulomb 1785)'
    excite = 'slow and fast motion with many reversals: a PRBS or a slow square wave'

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        return -p[0] * np.tanh(s.rate / max(p[1], 1e-4))


class StribeckFriction(CoulombFriction):
    """Dry friction that is larger near rest than in motion (Armstrong-Hélouvry et al. 1994)."""

    variant = 'stribeck'
    parameters = (
        *CoulombFriction.parameters, Spec('static', 'rad/s²', positive=True),
        Spec('stribeck_rate', 'rad/s', spread=1.5, centre=math.log(0.1), log=True,
             starts=(0.05, 0.4)),
    )
    physics = '-(T + S exp(-(rate/v)²)) sign(rate): dry friction that drops with the rate'

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        near = np.exp(-((s.rate / max(p[3], 1e-4)) ** 2))
        return -(p[0] + p[2] * near) * np.tanh(s.rate / max(p[1], 1e-4))


class QuadraticDrag(Effect):
    """Drag that grows with the square of the rate."""

    name = 'quadratic_drag'
    signals = ('rate',)
    parameters = (Spec('coefficient', 'rad/s² per (rad/s)²', positive=True),)
    physics = '-k rate |rate|: drag of arms and discs in turbulent flow'
    excite = 'high rates: a square wave of large amplitude, a chirp'

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        return -p[0] * s.rate * np.abs(s.rate)


class OnAngle(Effect):
    """A torque of the measured angle."""

    signals = ('angle',)

    def prepare(self, data: AxisData) -> Settings | str:
        return {} if data.angle is not None else 'the bag holds no orientation'


class PendulumStiffness(OnAngle):
    """The restoring torque of a centre of mass off the axis."""

    name = 'pendulum_stiffness'
    parameters = (Spec('stiffness', 'rad/s² per rad'),)
    physics = '-k sin(angle): centre of mass below (k > 0) or above the axis'
    excite = 'large slow angles: a square wave of long period, a slow chirp'

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        return -p[0] * np.sin(required(s.angle))


class CubicStiffness(OnAngle):
    """A spring that hardens or softens with the angle."""

    name = 'cubic_stiffness'
    parameters = (Spec('stiffness', 'rad/s² per rad³'),)
    physics = '-k angle³: a spring that hardens (k > 0), as cables do'
    excite = 'large angles'

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        return -p[0] * required(s.angle)**3


class Detents(OnAngle):
    """Wells at equal angles: cogging of magnets, dents of a bearing's race, teeth."""

    name = 'shape:angle'
    kind = 'shape'
    variant = 'periodic'
    parameters = (
        Spec('waves', '1/rad', spread=1.0, centre=math.log(40.0), log=True,
             starts=tuple(np.geomspace(10.0, 200.0, 30))),
        Spec('cosine', 'rad/s²'), Spec('sine', 'rad/s²'),
    )
    physics = 'C cos(n angle) + S sin(n angle): wells at equal angles, as of magnets or teeth'
    excite = 'slow motion over a large range of angles'

    def size(self, s: Signals, j: int, settings: Settings) -> FloatArray:
        return np.ones_like(s.rate)

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        phase = p[0] * required(s.angle)
        return p[1] * np.cos(phase) + p[2] * np.sin(phase)


TORQUES = (
    CoulombFriction(), StribeckFriction(), QuadraticDrag(), PendulumStiffness(), CubicStiffness(),
    Detents(),
)
