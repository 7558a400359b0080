"""How strong a rival is taken to be where no model says it: as weak as is just found today.

Sizes are scaled until the base's error on a plain PRBS grows by GROWTH over the noise; what else
an effect has (a frequency, a time) stands in SHAPES_OF, which an effect need not have.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.greybox.data import AxisData
from quad_sysid.greybox.structure import Effect, Settings

GROWTH = 1.05
"""Error of the base over the noise, with the effect as strong as assumed."""
ROUNDS = 8

Vector = Callable[[float, AxisData], tuple[float, ...]]
"""(size, a plain flight) -> parameters in the effect's order."""


@dataclass(frozen=True)
class Rival:
    """An effect of a certain strength, or nothing (no effect)."""

    name: str
    effect: Effect | None = None
    settings: Settings | None = None
    parameters: tuple[float, ...] = ()

    def words(self) -> str:
        """Name and strength."""
        if self.effect is None:
            return 'nothing'
        if self.effect.kind == 'shape':
            return self.name
        told = (
            f'{spec.name} {value:.3g} {spec.unit if spec.unit != "1" else ""}'.strip()
            for spec, value in zip(self.effect.parameters, self.parameters, strict=True)
        )
        return f'{self.name} ({", ".join(told)})'


def _half_time(data: AxisData) -> float:
    return 0.5 * data.rate.size * data.dt


def _limits(size: float, data: AxisData) -> tuple[float, ...]:
    """The upper limit cuts off a share of what the motors are asked for above the throttle."""
    top, mean = float(np.max(data.motors)), float(np.mean(data.motors))
    return 0.0, top - min(size, 0.95) * (top - mean)


SHAPES_OF: Mapping[str, tuple[float, Vector]] = {
    'coulomb_friction': (0.1, lambda s, _: (s,)),
    'quadratic_drag': (0.2, lambda s, _: (s,)),
    'pendulum_stiffness': (0.5, lambda s, _: (s,)),
    'cubic_stiffness': (10.0, lambda s, _: (s,)),
    'dead_zone': (5e-4, lambda s, _: (s,)),
    'battery_sag': (1.0, lambda s, _: (s,)),
    'thrust_curve': (0.2, lambda s, _: (s,)),
    'saturation': (0.3, _limits),
    'motor_lag': (0.1, lambda s, _: (0.12, min(s, 1.0))),
    'motor_lag/motor': (0.06, lambda s, _: (0.045 + s,)),
    'backlash': (1e-3, lambda s, _: (s,)),
    'resonance': (0.05, lambda s, _: (5.0, 0.05, 0.0, s)),
    'cross_axis_input': (0.1, lambda s, _: (s,)),
    'gyroscopic_coupling': (0.5, lambda s, _: (s,)),
    'inertia_coupling': (0.5, lambda s, _: (s,)),
    'periodic_disturbance': (0.1, lambda s, _: (s, 1.0, 0.5)),
    'step_event/gain': (0.1, lambda s, data: (_half_time(data), s)),
    'step_event/torque': (0.1, lambda s, data: (_half_time(data), s)),
    'event/gain': (0.3, lambda s, data: (_half_time(data), 2.0, s)),
    'event/torque': (0.3, lambda s, data: (_half_time(data), 2.0, s)),
    'mode/hysteresis': (0.1, lambda s, _: (s, 0.05)),
    'mode/slow state': (0.5, lambda s, _: (s, 0.5)),
    'mode/oscillation': (0.05, lambda s, _: (2.0, 0.1, 0.0, s)),
}
"""Name, or name/variant, of an effect: a size to begin with, and its parameters for a size."""


def vector_of(effect: Effect) -> tuple[float, Vector]:
    """First size and parameters for a size; a curve, or what has no entry, bends at one knot."""
    family = effect.variant.rstrip(' 0123456789')
    for key in (effect.name, f'{effect.name}/{family}'):
        if key in SHAPES_OF and (effect.name != 'motor_lag' or not family or '/' in key):
            return SHAPES_OF[key]
    scales = tuple(spec.scale for spec in effect.parameters)
    return 1.0, lambda s, _: (s * scales[0], *(0.0 for _ in scales[1:]))


def sized(
    effect: Effect, plain: AxisData, growth_of: Callable[[tuple[float, ...]], float],
    growth: float = GROWTH,
) -> tuple[float, ...]:
    """Parameters with which `growth_of` them is `growth`, as near as bounds allow.

    growth_of: error of the base on a plain flight over the noise, 1 for no effect.
    """
    size, make = vector_of(effect)
    wanted = growth**2 - 1.0
    lower = np.array([spec.lower for spec in effect.parameters])
    upper = np.array([spec.upper for spec in effect.parameters])

    def bounded(s: float) -> tuple[float, ...]:
        return tuple(np.clip(make(s, plain), lower, upper).tolist())

    for _ in range(ROUNDS):
        found = growth_of(bounded(size)) ** 2 - 1.0
        if not np.isfinite(found):
            size *= 0.3
            continue
        if abs(found - wanted) < 0.05 * wanted:
            break
        # the error grows with the square of a small effect's size
        size *= float(np.clip(np.sqrt(wanted / max(found, 1e-9)), 0.2, 5.0))
    return bounded(size)


def theta_with(base: FloatArray, rival: Rival) -> FloatArray:
    """Parameters of an aircraft with the rival on top."""
    return np.concatenate([base, np.array(rival.parameters, dtype=np.float64)])
