"""Effects of our own invention that stand in no list: torques (3,) in N m for --effect-module.

Frictions, springs, gains, hidden states and events of other shapes than the table's. Each
factory takes (axis index, strength in N m, seed) and gives the function the physics calls.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

EffectFunction = Callable[..., np.ndarray]
Factory = Callable[[int, float, int], EffectFunction]


def _on(index: int, value: float) -> np.ndarray:
    out = np.zeros(3)
    out[index] = value
    return out


def stribeck(index: int, size: float, _: int) -> EffectFunction:
    """Friction that is higher near standstill."""

    def effect(t, rates, angles, thrusts, battery_v):  # noqa: ARG001
        w = float(rates[index])
        level = 0.5 * size + size / (1.0 + (w / 0.3) ** 2)
        return _on(index, -level * math.tanh(w / 0.03))

    return effect


def one_sided_spring(index: int, size: float, _: int) -> EffectFunction:
    """A cable that only pulls beyond 4 degrees to one side."""

    def effect(t, rates, angles, thrusts, battery_v):  # noqa: ARG001
        return _on(index, -size * 10.0 * max(0.0, float(angles[index]) - 0.07))

    return effect


def friction_by_angle(index: int, size: float, _: int) -> EffectFunction:
    """A bent shaft: friction that grows with the angle."""

    def effect(t, rates, angles, thrusts, battery_v):  # noqa: ARG001
        level = size * min(3.0, abs(float(angles[index])) / 0.1)
        return _on(index, -level * math.tanh(float(rates[index]) / 0.05))

    return effect


def relaxing_load(index: int, size: float, _: int) -> EffectFunction:
    """A load on a viscous strap: a hidden state that follows the angle with 0.8 s."""
    state = [0.0, 0.0]

    def effect(t, rates, angles, thrusts, battery_v):  # noqa: ARG001
        dt = max(0.0, float(t) - state[1])
        state[0] += (float(angles[index]) - state[0]) * (1.0 - math.exp(-dt / 0.8))
        state[1] = float(t)
        return _on(index, -size * 8.0 * (float(angles[index]) - state[0]))

    return effect


def growing_friction(index: int, size: float, _: int) -> EffectFunction:
    """A bearing that warms: friction fades with time."""

    def effect(t, rates, angles, thrusts, battery_v):  # noqa: ARG001
        level = 2.0 * size * math.exp(-float(t) / 25.0)
        return _on(index, -level * math.tanh(float(rates[index]) / 0.05))

    return effect


def detents(index: int, size: float, _: int) -> EffectFunction:
    """Cogging: a torque periodic in the angle."""

    def effect(t, rates, angles, thrusts, battery_v):  # noqa: ARG001
        return _on(index, -size * math.sin(float(angles[index]) / 0.03))

    return effect


UNDECLARED: dict[str, Factory] = {
    'stribeck': stribeck,
    'one_sided_spring': one_sided_spring,
    'friction_by_angle': friction_by_angle,
    'relaxing_load': relaxing_load,
    'growing_friction': growing_friction,
    'detents': detents,
}
