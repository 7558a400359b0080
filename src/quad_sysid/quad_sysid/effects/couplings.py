"""Couplings from the other two axes to this one."""

from __future__ import annotations

import numpy as np

from quad_sysid.contract import AXES, FloatArray
from quad_sysid.model.data import AxisData
from quad_sysid.model.effect import Effect, Settings, Signals, Spec, required

LEAST_SHARE = 0.05
"""Least size of another axis' command, relative to this axis'."""
MEASURED = 0.95
"""Least share of the training in which another axis' rate is known."""
LEAST_RATE = 0.05
"""Least RMS of another axis' rate beyond its gyro's noise, rad/s."""


def over_training(data: AxisData, signal: FloatArray) -> FloatArray:
    """The signal's samples in the training segments."""
    return np.concatenate([signal[a:b] for a, b in data.train])


def clock(data: AxisData) -> FloatArray:
    """(n,) time of each sample since the flight's first, s."""
    if data.time_s is not None:
        return data.time_s
    return np.arange(data.rate.size, dtype=np.float64) * data.dt


def is_measured(data: AxisData, which: int) -> bool:
    """Whether another axis' rate is known throughout training."""
    rate = over_training(data, data.other_rates[:, which])
    return bool(np.isfinite(rate).mean() >= MEASURED)


def turns(data: AxisData, which: int) -> str:
    """Why another axis' rate cannot be used; empty where it can."""
    if not is_measured(data, which):
        return f'the rate of {data.other_axes[which]} was not measured throughout'
    if np.nanstd(over_training(data, data.other_rates[:, which])) < LEAST_RATE:
        return f'{data.other_axes[which]} hardly turns during training'
    return ''


class OtherAxis(Effect):
    """An effect of one of the other two axes: the first or second in the order of AXES."""

    def __init__(self, which: int) -> None:
        self.which, self.others = which, (which,)
        self.variant = f'other axis {which + 1}'


class CrossAxisInput(OtherAxis):
    """A fraction of another axis' command that acts on this axis."""

    name = 'cross_axis_input'
    signals = ('other command',)
    term = 'command'
    parameters = (Spec('fraction', '1', spread=0.2),)
    physics = "a fraction of another axis' command acts here (motors out of line)"
    excite = 'both axes excited with different signals'

    def prepare(self, data: AxisData) -> Settings | str:
        name = data.other_axes[self.which]
        other = over_training(data, data.control[:, AXES.index(name) + 1])
        if np.std(other) < LEAST_SHARE * np.std(over_training(data, data.command)):
            return f'the command of {name} hardly moves during training; excite it as well'
        return {'other': name}

    def command(
        self, data: AxisData, command: FloatArray, p: FloatArray, settings: Settings
    ) -> FloatArray:
        return command + p[0] * data.control[:, AXES.index(str(settings['other'])) + 1]


class GyroscopicCoupling(OtherAxis):
    """A torque proportional to another axis' rate."""

    name = 'gyroscopic_coupling'
    signals = ('other rate',)
    parameters = (Spec('coefficient', '1/s'),)
    physics = "h times another axis' rate: spinning rotors (paper, eqs. 4 and 5)"
    excite = 'hover with all axes moving'

    def prepare(self, data: AxisData) -> Settings | str:
        return turns(data, self.which) or {'other': data.other_axes[self.which]}

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        return p[0] * required(s.other_rates)[self.which]


class InertiaCoupling(Effect):
    """A torque proportional to the product of the other two rates."""

    name = 'inertia_coupling'
    signals = ('product of other rates',)
    others = (0, 1)
    parameters = (Spec('coefficient', '1'),)
    physics = 'c times the product of the other two rates (Euler; paper, eqs. 4 to 6)'
    excite = 'hover with all axes moving fast'

    def prepare(self, data: AxisData) -> Settings | str:
        return turns(data, 0) or turns(data, 1) or {}

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        first, second = required(s.other_rates)
        return p[0] * first * second


COUPLINGS = (
    CrossAxisInput(0), CrossAxisInput(1), GyroscopicCoupling(0), GyroscopicCoupling(1),
    InertiaCoupling(),
)
