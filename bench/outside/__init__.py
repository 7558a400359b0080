"""Effects that people outside the project wrote from textbooks, by the family of their cause.

156 of them by thirteen writers who knew neither the code nor its candidates. A module holds the
physics of one family and ends with its `PLANTS`; with which set an effect was opened stands in its
entry, so that a set can be flown as it was. The physics is as its writer left it.
"""

from __future__ import annotations

from dataclasses import dataclass

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
        'greases', 'chains', 'governors', 'umbilicals')
"""In the order in which they were opened; all but the first were sealed until then."""
PLANTS = {plant.name: plant for family in FAMILIES.values() for plant in family}
STRENGTHS = (0.7, 1.3)


@dataclass(frozen=True)
class Case:
    """One effect at one strength: two flights, one to learn from and one to be judged by."""

    effect: str
    opened: str
    strength: float
    seed: int
    axis: int
    noise: float

    @property
    def plant(self) -> Plant:
        return PLANTS[self.effect]

    def flown(self, *, unseen: bool, there: bool = True) -> simulator.Flown:
        """A flight; with `there` false by the same aircraft without the effect."""
        return simulator.fly(
            self.plant.effect(self.strength) if there else simulator.Nothing(),
            self.seed + 500 * unseen, axis=self.axis, rig=self.plant.rig, noise=self.noise,
            plan=simulator.UNSEEN if unseen else simulator.TRAINING,
        )


def cases(opened: str, noise: float) -> list[Case]:
    """All cases of a set, or of all, in the order of their opening."""
    plants = sorted(PLANTS.values(), key=lambda one: (SETS.index(one.opened), one.place))
    return [
        Case(one.name, one.opened, strength, 100 + 10 * one.place + j, (one.place + j) % 2, noise)
        for one in plants if opened in ('', one.opened)
        for j, strength in enumerate(STRENGTHS)
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
