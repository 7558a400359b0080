"""Effects that people outside the project wrote from textbooks, by the family of their cause.

180 of them by fifteen writers who knew neither the code nor its candidates. A module holds the
physics of one family and ends with its `PLANTS`; with which set an effect was opened stands in its
entry, so that a set can be flown as it was. The physics is as its writer left it.
"""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from quad_sysid.contract import control_from_motors
from quad_sysid.record import GainChange, Record, Segment

from . import (
    air,
    cables,
    controllers,
    filters,
    joints,
    loads,
    motors,
    power,
    propellers,
    sensors,
    simulator,
    structures,
)
from .simulator import Plant

FAMILIES: dict[str, tuple[Plant, ...]] = {
    module.__name__.rpartition('.')[2]: module.PLANTS
    for module in (joints, cables, loads, structures, motors, propellers, air, power, sensors,
                   filters, controllers)
}
SETS = ('bearings', 'cables', 'rigs', 'hinges', 'arms', 'joints', 'hoses', 'gears', 'slings',
        'greases', 'chains', 'governors', 'umbilicals', 'workshop', 'field')
"""In the order in which they were opened; all but the first were sealed until then."""
PLANTS = {plant.name: plant for family in FAMILIES.values() for plant in family}
STRENGTHS = (0.7, 1.3)


@cache
def sealed(file: str) -> dict[str, Plant]:
    """Plants of a file that is no module here yet: it is flown before anybody reads it.

    It imports `simulator` and ends with its PLANTS.
    """
    sys.modules['simulator'] = simulator
    spec = importlib.util.spec_from_file_location(f'sealed_{Path(file).parent.name}', file)
    if spec is None or spec.loader is None:
        raise ImportError(file)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return {plant.name: plant for plant in module.PLANTS}


@dataclass(frozen=True)
class Case:
    """One effect at one strength: two flights, one to learn from and one to be judged by."""

    effect: str
    opened: str
    strength: float
    seed: int
    axis: int
    noise: float
    file: str = ''
    """File of a sealed set; empty for an open one."""

    @property
    def plant(self) -> Plant:
        return sealed(self.file)[self.effect] if self.file else PLANTS[self.effect]

    def flown(self, *, unseen: bool, there: bool = True) -> simulator.Flown:
        """A flight; with `there` false by the same aircraft without the effect."""
        return simulator.fly(
            self.plant.effect(self.strength) if there else simulator.Nothing(),
            self.seed + 500 * unseen, axis=self.axis, rig=self.plant.rig, noise=self.noise,
            plan=simulator.UNSEEN if unseen else simulator.TRAINING,
        )


def cases(opened: str, noise: float, file: str = '', drawn: int | None = None) -> list[Case]:
    """All cases of a set, or of all, in the order of their opening; or of a sealed set's file.

    drawn: a seed that draws one of both strengths for each effect.
    """
    own = sealed(file).values() if file else PLANTS.values()
    plants = sorted(own, key=lambda one: (one.opened not in SETS or SETS.index(one.opened),
                                          one.place))
    rng = np.random.default_rng(drawn)
    chosen = [range(len(STRENGTHS)) if drawn is None else [int(rng.integers(len(STRENGTHS)))]
              for _ in plants]
    return [
        Case(one.name, one.opened, STRENGTHS[j], 100 + 10 * one.place + j, (one.place + j) % 2,
             noise, file)
        for one, own_strengths in zip(plants, chosen, strict=True)
        if opened in ('', one.opened) for j in own_strengths
    ]


def record_of(flown: simulator.Flown, axis: str) -> Record:
    """The flight as the analysis gets it."""
    return Record(
        source='outside', dt=simulator.DT, t0_ns=10**18, rates=flown.rates, angles=flown.angles,
        control=control_from_motors(flown.motors), motors=flown.motors,
        battery_v=flown.battery_v, attitude_setpoint=flown.reference,
        segments=tuple(Segment(role, signal, axis, 'attitude', begin, end)
                       for role, signal, begin, end in flown.segments),
        gains=(GainChange(0.0, {'sensor.gyro_filter_hz': simulator.FILTER_HZ}),),
    )
