"""What an effect is: its physics, written once, and the numbers that physics has.

The same `torque`, `command` or `actuate` serves the fit, the free run, the simulated loop, the
linearisation and the report. Arrays in, arrays out: along a flight they are (n,), in a free run
one value a window. Effects stand in quad_sysid.effects; nothing is fitted here.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.model.data import AxisData

Settings = Mapping[str, Any]
Present = TypeVar('Present')


def required(value: Present | None) -> Present:
    """What an earlier step has made sure of, such as a signal that `prepare` asked for."""
    if value is None:
        raise ValueError('what this effect or derivative needs was not provided')
    return value


SMALL = 1e-4
"""Of a parameter, for what it does to first order."""


@dataclass(frozen=True)
class Spec:
    """One parameter: its unit, its prior, and where a search starts.

    The prior is normal about `centre` with standard deviation `spread`; of the logarithm where
    `log`. Without a spread it is what makes the effect's acceleration, at the 97th percentile of
    the flight, as large as half of what the axis is accelerated by: `torque` is linear in it then.
    """

    name: str
    unit: str
    spread: float | None = None
    centre: float = 0.0
    log: bool = False
    positive: bool = False
    """Physics allows no negative value."""
    starts: tuple[float, ...] = ()
    """Values to search from; a parameter without a spread starts at none of its effect."""


@dataclass(frozen=True)
class Signals:
    """What physics may depend on, each an array of one shape; None where it was not measured."""

    rate: FloatArray
    """rad/s"""
    angle: FloatArray | None
    """rad"""
    drive: FloatArray
    """Acceleration by the motors, mean over the cycle, rad/s²."""
    command: FloatArray
    """The acceleration that the delayed command asks for, rad/s²."""
    change: FloatArray
    """How fast the drive changes, rad/s³."""
    lagged: FloatArray
    """The command behind delay and lag, normalised."""
    throttle: FloatArray
    """U1, normalised."""
    battery_v: FloatArray | None
    other_rates: tuple[FloatArray, FloatArray] | None
    """Of the other two axes, in the order of AXES, rad/s."""
    other_commands: tuple[FloatArray, FloatArray]
    """Normalised."""
    time: FloatArray
    """s from the first sample."""
    hidden: FloatArray | None = None
    """(states, …) of the effect itself, where it has any, at the begin of the cycle."""


@dataclass(frozen=True)
class Drive:
    """Commands on their way to the motors: each channel has its lag and its share of the axis."""

    commands: FloatArray
    """(c, n) normalised, held over a cycle."""
    row: FloatArray
    """(c,)"""
    lag: FloatArray
    """(c, n) s"""
    asymmetry: float = 0.0
    """A motor that slows down has the lag times exp(asymmetry), one that speeds up the inverse."""


@dataclass(frozen=True)
class Dynamics:
    """Linear dynamics before the motors: a lag, or a light mode that adds to the command.

    z'' + 2 d w z' + w² z = w² u; the mode adds in_phase z + quadrature z'/w. No mode where w is 0.
    """

    lag_s: float = 0.0
    frequency_rad_s: float = 0.0
    damping_ratio: float = 0.0
    in_phase: float = 0.0
    quadrature: float = 0.0


class Effect:
    """A physical effect that the base lacks; a subclass changes command, motors or torque."""

    name: str = ''
    kind: str = 'named'
    signals: tuple[str, ...] = ()
    """What it depends on; the first is what it is drawn over."""
    others: tuple[int, ...] = ()
    """Which of the other two axes (0, 1) it depends on."""
    term: str = 'torque'
    """What of the base it changes: torque, gain, damping, friction, lag or delay as a function of
    a signal, the command as a map of it, or the response of the motors."""
    physics: str = ''
    """The equation, with units, and its source."""
    excite: str = ''
    """Which test flight would show it."""
    variant: str = ''
    """Tells effects of one name apart, such as the other axis that couples in."""
    parameters: tuple[Spec, ...] = ()
    states: int = 0
    """Hidden states of its own, driven by the rate."""
    phased: bool = False
    """Whether each flight has a phase of its own, which `elsewhere` takes."""

    def prepare(self, data: AxisData) -> Settings | str:
        """Settings from the training data, or in words why it cannot be tested on them."""
        del data
        return {}

    def command(
        self, data: AxisData, command: FloatArray, p: FloatArray, settings: Settings
    ) -> FloatArray:
        """(n,) command of the axis after the effect."""
        del data, p, settings
        return command

    def actuate(self, data: AxisData, drive: Drive, p: FloatArray, settings: Settings) -> Drive:
        """The motors' lags after the effect."""
        del data, p, settings
        return drive

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray | None:
        """Acceleration that it adds, rad/s²; None where it adds none."""
        del s, p, settings
        return None

    def size(self, s: Signals, j: int, settings: Settings) -> FloatArray:
        """Acceleration per unit of a parameter without a spread, the others at their centre."""
        p = np.array([
            0.0 if spec.spread is None else (np.exp(spec.centre) if spec.log else spec.centre)
            for spec in self.parameters
        ])
        p[j] = 1.0
        own = self.torque(s, p, settings)
        if own is None:
            raise NotImplementedError(f'{self.label}.{self.parameters[j].name} needs a spread')
        return own

    def columns(
        self, s: Signals, p: FloatArray, linear: Sequence[int], settings: Settings
    ) -> FloatArray:
        """(n, len(linear)) acceleration per unit of parameters that are zero in p (units)."""
        out = np.empty((s.rate.size, len(linear)))
        for place, j in enumerate(linear):
            at = p.copy()
            at[j] = SMALL
            own = self.torque(s, at, settings)
            out[:, place] = required(own) / SMALL
        return out

    def starts(self, data: AxisData, settings: Settings) -> Sequence[FloatArray]:
        """Parameters to search from, in their units; those without a spread count for nothing."""
        del data, settings
        grid = [spec.starts or (0.0,) for spec in self.parameters]
        return [np.array(values) for values in itertools.product(*grid)]

    def readable(self, p: FloatArray, settings: Settings) -> Mapping[str, tuple[float, str]]:
        """What a report says of the parameters: name to value and unit."""
        del settings
        return {
            spec.name: (float(value), spec.unit)
            for spec, value in zip(self.parameters, p, strict=True)
        }

    def fitted(self, values: Mapping[str, float], settings: Settings) -> FloatArray:
        """The parameters that `readable` says so of, in their units."""
        del settings
        return np.array([values[spec.name] for spec in self.parameters])

    def elsewhere(self, p: FloatArray, settings: Settings, phase: float) -> FloatArray:
        """The parameters on another flight: of an event those after it; phase in rad."""
        del settings, phase
        return p

    def trace(
        self, data: AxisData, rate: FloatArray, p: FloatArray, settings: Settings
    ) -> FloatArray:
        """(states, n) hidden states along a flight, at rest at the begin of each stretch."""
        raise NotImplementedError

    def advance(
        self, x: FloatArray, rate: FloatArray, p: FloatArray, settings: Settings, dt: float
    ) -> FloatArray:
        """(states, w) hidden states a cycle later, for a rate (w,) held over it."""
        raise NotImplementedError

    def usual(self, p: FloatArray, settings: Settings) -> Mapping[str, float]:
        """Signal (`throttle`, `battery`) to the value around which a loop is judged."""
        del p, settings
        return {}

    def dynamics(self, p: FloatArray) -> Dynamics | None:
        """What a command effect with memory is to a linear loop; None where it is not linear."""
        del p
        return None

    def precision(self, settings: Settings, sizes: FloatArray) -> FloatArray:
        """(p, p) precision of the prior of its parameters, in the coordinates of the fit.

        sizes (p,): standard deviation of each.
        """
        del settings
        return np.diag(sizes**-2.0)

    @property
    def moves_command(self) -> bool:
        """Whether it acts before the torque."""
        kind = type(self)
        return kind.command is not Effect.command or kind.actuate is not Effect.actuate

    @property
    def label(self) -> str:
        """Name and variant."""
        return f'{self.name}/{self.variant}' if self.variant else self.name


@dataclass(frozen=True)
class Part:
    """An effect in a structure, with what the training data made of it."""

    effect: Effect
    settings: Settings = field(default_factory=dict)
