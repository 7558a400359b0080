"""A plant as a loop sees it, with all that goes on around it.

simulation.py flies the cascade around it, linear.py says how it answers to motion of some size;
from_model.py makes it of an identified model.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from quad_sysid.axes import EVERY, TURNING, Trial
from quad_sysid.contract import FloatArray
from quad_sysid.craft import Craft, X
from quad_sysid.errors import BadInputError
from quad_sysid.model.effect import Signals
from quad_sysid.model.noise import sensor_of
from quad_sysid.model.plant import Plant, State
from quad_sysid.model.structure import Structure

LATE_S = 1e9
"""A time after all events of the flight: the next flight begins there."""


@dataclass(frozen=True)
class Flying:
    """A plant as a loop sees it: with the signals around it."""

    plant: Plant
    around: Signals
    """The signals around the axis, constant (1,) or per cycle (n,); the loop replaces those that
    it moves itself."""
    steady: bool = True
    """Whether it begins in the middle of a flight, not at its start."""
    trial: Trial = TURNING
    """The motion by which its loop is judged."""

    @property
    def dt(self) -> float:
        """Control cycle, s."""
        return self.plant.dt

    @cached_property
    def first(self) -> Signals:
        """The signals of the first cycle, without a command."""
        return self.plant.with_motors(self.around.at(np.arange(1)).replaced(sent=np.zeros(1)))

    def begin(self, rate: float = 0.0, angle: float = 0.0) -> State:
        """The state with motors at rest, at a rate and an angle, rad/s and rad."""
        return self.plant.begin(self.first, np.array([rate]), np.array([angle]),
                                steady=self.steady)

    @cached_property
    def rest_acceleration(self) -> float:
        """The acceleration by which it turns from rest at angle 0 without a command, rad/s²."""
        x, push = self.begin(), 0.0
        for _ in range(4):
            push -= float(self.plant.step(x, self.first, push).turning.rate[0]) / self.dt
        return -push


def plant_like(
    axis: str, p: FloatArray, dt: float, gyro_filter_hz: float | None, *,
    structure: Structure | None = None, craft: Craft = X,
    conditions: tuple[float, float | None] = (0.5, None),
) -> Flying:
    """An axis by its numbers: p as in Structure, at a throttle and a voltage (V).

    Raises BadInputError for numbers that are not finite or negative times.
    """
    if not (np.isfinite(p).all() and np.isfinite(dt)):
        raise BadInputError('plant', 'all parameters must be finite', p.tolist())
    if dt <= 0.0 or min(p[1], p[2]) < 0.0:
        raise BadInputError('plant', 'lag and delay must not be negative, dt must be positive',
                            (float(p[1]), float(p[2]), dt))
    if gyro_filter_hz is not None and not (np.isfinite(gyro_filter_hz) and gyro_filter_hz > 0):
        raise BadInputError('plant', 'gyro_filter_hz must be positive or None', gyro_filter_hz)
    plant = Plant(structure or Structure(), p, dt, sensor_of(gyro_filter_hz, None, dt), craft,
                  EVERY[axis].index)
    return Flying(plant, around(*conditions), trial=EVERY[axis].trial)


def around(throttle: float, battery_v: float | None = None) -> Signals:
    """The signals around an axis at constant throttle and voltage (V), after all events."""
    volts = None if battery_v is None else np.full(1, battery_v)
    return Signals.at_rest(np.full(1, LATE_S), np.full(1, throttle), battery_v=volts)
