"""Effects of our own invention that stand in no list: torques (3,) in N m, as --effect-module.

Frictions, springs, gains, hidden states and events of other shapes than the table's. Each answers
what it is to be called with: a name is wrong where it is not in `may_be`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

EffectFunction = Callable[..., np.ndarray]
Scalar = Callable[[float, float, float, float], float]
"""(t, rate, angle, drive) -> torque per size; drive: torque of the thrusts, in the same unit."""

LEVER = 0.225 * math.sqrt(0.5)


@dataclass(frozen=True)
class Undeclared:
    """One invention: `make()` gives a fresh scalar function with its own state."""

    make: Callable[[], Scalar]
    may_be: tuple[str, ...]
    """Names of the table that describe it truly; shapes, modes and events always do."""

    def torque(self, index: int, size: float) -> EffectFunction:
        """The function the virtual STM32's physics calls."""
        own = self.make()
        signs = np.array([[1, -1, -1, 1], [1, 1, -1, -1], [1, -1, 1, -1]][index]) * LEVER

        def effect(t, rates, angles, thrusts, battery_v):  # noqa: ARG001
            out = np.zeros(3)
            drive = float(signs @ np.asarray(thrusts)) / size
            out[index] = size * own(float(t), float(rates[index]), float(angles[index]), drive)
            return out

        return effect


def plain_torque(name: str, size: float) -> Callable[[float, float, float], float]:
    """The torque for the tests' simulator, which has no drive."""
    own = UNDECLARED[name].make()
    return lambda t, rate, angle: size * own(t, rate, angle, 0.0)


def _stribeck() -> Scalar:
    return lambda _t, w, _a, _d: -(0.5 + 1.0 / (1.0 + (w / 0.3) ** 2)) * math.tanh(w / 0.03)


def _one_sided_spring() -> Scalar:
    return lambda _t, _w, a, _d: -10.0 * max(0.0, a - 0.07)


def _friction_by_angle() -> Scalar:
    return lambda _t, w, a, _d: -min(3.0, abs(a) / 0.1) * math.tanh(w / 0.05)


def _relaxing_load() -> Scalar:
    state = [0.0, 0.0]

    def torque(t: float, _w: float, a: float, _d: float) -> float:
        dt = max(0.0, t - state[1])
        state[0] += (a - state[0]) * (1.0 - math.exp(-dt / 0.8))
        state[1] = t
        return -8.0 * (a - state[0])

    return torque


def _warming_bearing() -> Scalar:
    return lambda t, w, _a, _d: -2.0 * math.exp(-t / 25.0) * math.tanh(w / 0.05)


def _detents() -> Scalar:
    return lambda _t, _w, a, _d: -math.sin(a / 0.03)


def _one_way_bearing() -> Scalar:
    return lambda _t, w, _a, _d: -(1.6 if w > 0.0 else 0.3) * math.tanh(w / 0.03)


def _soft_stop() -> Scalar:
    return lambda _t, _w, a, _d: -8.0 * math.copysign(max(0.0, abs(a) - 0.1), a)


def _saturating_spring() -> Scalar:
    return lambda _t, _w, a, _d: -1.5 * math.tanh(a / 0.04)


def _gust() -> Scalar:
    return lambda t, _w, _a, _d: 3.0 if 20.0 < t % 31.0 < 23.0 else 0.0


def _dahl() -> Scalar:
    """Hysteresis of a cable: friction that builds up over 0.05 rad."""
    state = [0.0, 0.0]

    def torque(t: float, w: float, _a: float, _d: float) -> float:
        dt = max(0.0, t - state[1])
        state[0] += w * dt / 0.05 * (1.0 - state[0] * math.copysign(1.0, w))
        state[0] = min(1.0, max(-1.0, state[0]))
        state[1] = t
        return -1.5 * state[0]

    return torque


def _sloshing() -> Scalar:
    """A tank: an oscillation at 1.6 Hz that the rate drives."""
    state = [0.0, 0.0, 0.0]
    omega = 2.0 * math.pi * 1.6

    def torque(t: float, w: float, _a: float, _d: float) -> float:
        dt = max(0.0, t - state[2])
        state[1] += dt * (omega * w - 0.16 * omega * state[1] - omega**2 * state[0])
        state[0] += dt * state[1]
        state[2] = t
        return 4.0 * omega * state[0]

    return torque


def _inflow() -> Scalar:
    return lambda _t, w, _a, d: -0.5 * d * min(1.0, abs(w))


def _fading_blade() -> Scalar:
    return lambda t, _w, _a, d: -0.25 * d * min(1.0, t / 60.0)


def _weak_side() -> Scalar:
    return lambda _t, _w, _a, d: -0.12 * max(0.0, d)


def _one_way_drag() -> Scalar:
    return lambda _t, w, _a, _d: -3.0 * w * w if w > 0.0 else 0.0


def _thick_grease() -> Scalar:
    return lambda t, w, _a, _d: -4.0 * w * math.exp(-t / 20.0)


def _slung_load() -> Scalar:
    """A load on a cord: 0.7 Hz, driven by the angle."""
    state = [0.0, 0.0, 0.0]
    omega = 2.0 * math.pi * 0.7

    def torque(t: float, _w: float, a: float, _d: float) -> float:
        dt = max(0.0, t - state[2])
        state[1] += dt * (omega**2 * (a - state[0]) - 0.16 * omega * state[1])
        state[0] += dt * state[1]
        state[2] = t
        return -9.0 * (a - state[0])

    return torque


def _missing_motor() -> Scalar:
    return lambda t, _w, _a, d: -0.3 * d if 15.0 < t < 24.0 or 52.0 < t < 58.0 else 0.0


def _jumping_wind() -> Scalar:
    """It jumps to and fro at random, every 4 s on average."""
    jumps = np.cumsum(np.random.default_rng(4).exponential(4.0, 200))
    return lambda t, _w, _a, _d: 1.5 * (-1.0) ** int(np.searchsorted(jumps, t))


UNDECLARED: dict[str, Undeclared] = {
    'stribeck': Undeclared(_stribeck, ('coulomb_friction',)),
    'one_sided_spring': Undeclared(_one_sided_spring, ('pendulum_stiffness', 'cubic_stiffness')),
    'friction_by_angle': Undeclared(_friction_by_angle, ('coulomb_friction',)),
    'relaxing_load': Undeclared(_relaxing_load, ('pendulum_stiffness',)),
    'warming_bearing': Undeclared(_warming_bearing, ('coulomb_friction',)),
    'detents': Undeclared(_detents, ()),
    'one_way_bearing': Undeclared(_one_way_bearing, ('coulomb_friction',)),
    'soft_stop': Undeclared(_soft_stop, ('cubic_stiffness',)),
    'saturating_spring': Undeclared(_saturating_spring, ('pendulum_stiffness',)),
    'gust': Undeclared(_gust, ('step_event', 'periodic_disturbance')),
    'dahl': Undeclared(_dahl, ('coulomb_friction', 'backlash')),
    'sloshing': Undeclared(_sloshing, ('resonance',)),
    'inflow': Undeclared(_inflow, ()),
    'fading_blade': Undeclared(_fading_blade, ()),
    'weak_side': Undeclared(_weak_side, ('thrust_curve',)),
    'one_way_drag': Undeclared(_one_way_drag, ('quadratic_drag',)),
    'thick_grease': Undeclared(_thick_grease, ()),
    'slung_load': Undeclared(_slung_load, ('resonance',)),
    'missing_motor': Undeclared(_missing_motor, ('step_event',)),
    'jumping_wind': Undeclared(_jumping_wind, ('step_event', 'periodic_disturbance')),
}
NEEDS_DRIVE = ('inflow', 'fading_blade', 'weak_side', 'missing_motor')
