"""The base and its effects from one cycle to the next.

    rate' = drive - damping rate + bias + effects + d
    lag drive' = gain u(t - delay) - drive

flight.py follows a measured flight with the same laws.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.craft import Craft
from quad_sysid.model import recursion
from quad_sysid.model.effect import SHORTEST_S, SMALL, ActingEffect, Drive, Part, Signals, required
from quad_sysid.model.noise import Sensor
from quad_sysid.model.structure import Structure

LEAST_LAG = 0.25
"""Share of a cycle below which a lag does not show; the drive's slope takes it for so long."""


EffectOnSignals = tuple[Part, FloatArray, Signals]
"""An effect with its own parameters and the signals that it sees."""


def with_torques(start: FloatArray, acting: Sequence[EffectOnSignals]) -> FloatArray:
    """An acceleration and those of the effects, rad/s²."""
    for part, p, s in acting:
        torque = part.effect.torque(s, p, part.settings)
        if torque is not None:
            start = start + torque
    return start


def with_slopes(start: FloatArray, acting: Sequence[EffectOnSignals]) -> FloatArray:
    """The slope of an acceleration over the rate and those of the effects' torques, 1/s."""
    for part, p, s in acting:
        if 'rate' in part.effect.signals:
            above, below = (
                with_torques(np.zeros(1), [(part, p, s.replaced(rate=s.rate + step))])
                for step in (SMALL, -SMALL)
            )
            start = start + (above - below) / (2.0 * SMALL)
    return start


def drive_of(
    command_effects: Sequence[ActingEffect], s: Signals,
    remembered: Callable[[int, Signals], FloatArray | None],
) -> Drive:
    """The commands that reach the motors for s.sent, along a flight (n,) or in one cycle.

    remembered: the hidden states of the effect of this number, which sees these signals.
    """
    inputs = []
    for i, (part, p) in enumerate(command_effects):
        s = s.replaced(hidden=remembered(i, s))
        inputs.append(s)
        s = s.replaced(sent=part.effect.command(s, p, part.settings))
    sent = required(s.sent)
    drive = Drive(sent[None], np.ones(1), np.full((1, *sent.shape), s.lag))
    drive = drive.behind(np.full(sent.shape, s.delay / s.dt))
    for (part, p), signals in zip(command_effects, inputs, strict=True):
        drive = part.effect.actuate(drive, signals, p, part.settings)
    return drive


def lag_and_delay(p: FloatArray) -> tuple[float, float]:
    """Lag and delay of a base, s, as they are simulated."""
    return max(float(p[1]), SHORTEST_S), min(max(float(p[2]), 0.0), 0.5)


def with_drive(s: Signals, p: FloatArray, halves: FloatArray, states: FloatArray) -> Signals:
    """The signals with the drive, which Flight.driven gives at unit gain."""
    gain, lagged, command = p[0], 0.5 * (halves[0] + halves[1]), p[0] * states[1]
    return s.replaced(drive=gain * lagged, lagged=lagged, command=command,
                      change=(command - gain * states[0]) / max(float(p[1]), LEAST_LAG * s.dt))


class Turning(NamedTuple):
    """The axis at the start of a cycle; arrays of one shape (w,)."""

    rate: FloatArray
    """rad/s."""
    angle: FloatArray | None
    """rad."""
    seen: FloatArray
    """(2, w) the states of the gyro's filter."""
    hidden: tuple[FloatArray | None, ...]
    """Hidden states of each effect that adds a torque."""


class State(NamedTuple):
    """The whole plant at the start of a cycle."""

    turning: Turning
    motors: FloatArray
    """(c, w) command of each channel behind its lag."""
    line: FloatArray
    """(d, c, w) commands that are under way, the newest first."""
    hidden: tuple[FloatArray | None, ...]
    """Hidden states of each effect that acts before the torque."""


Moving = TypeVar('Moving', State, Turning)


@dataclass(frozen=True, eq=False)
class Plant:
    """A structure with its parameters (p,) in their units, cycle by cycle.

    Everything it sees besides its states is in the Signals of a cycle: s.sent, what the controller
    gives, throttle, voltage, time, motors and the other axes; arrays (w,).
    """

    structure: Structure
    p: FloatArray
    dt: float
    sensor: Sensor
    craft: Craft
    """The airframe: place and spin of each motor."""
    index: int
    """0 roll or surge, 1 pitch or sway, 2 yaw; -1 climb."""
    rounds: int = 3
    """Rounds of Newton's method in a cycle; one is enough where torques hardly bend in it."""

    @cached_property
    def command_effects(self) -> list[ActingEffect]:
        """The effects that act before the torque."""
        return [ActingEffect(part, self.p[where])
                for part, where in self.structure.command_effects]

    @cached_property
    def torque_effects(self) -> list[ActingEffect]:
        """The effects that add a torque."""
        return [ActingEffect(part, self.p[where])
                for part, where in self.structure.torque_effects]

    @cached_property
    def bends(self) -> bool:
        """Whether a torque follows the motion within a cycle, so that one round may not do."""
        return any({'rate', 'angle'} & {*part.effect.signals} for part, _ in self.torque_effects)

    def with_own(self, s: Signals) -> Signals:
        """The signals with the plant's lag, delay and cycle, s, and the shares of its motors."""
        lag, delay = lag_and_delay(self.p)
        share = self.craft.inverse[self.index + 1]
        return s.replaced(lag=lag, delay=delay, dt=self.dt, share=share)

    def with_motors(self, s: Signals) -> Signals:
        """The signals (w,) with what s.sent and the other axes' commands are to each motor."""
        command = required(s.sent)
        commands = [s.throttle, *s.other_commands]
        if self.index < 0:  # of the climb the throttle is its own command
            commands = [command, *s.other_commands, np.zeros_like(command)]
        else:
            commands.insert(self.index + 1, command)
        motors = self.craft.commands(np.stack(commands, axis=-1))
        return s.replaced(motors=tuple(motors[..., i] for i in range(motors.shape[-1])))

    def begin(
        self, s: Signals, rate: FloatArray, angle: FloatArray | None, *, steady: bool = False
    ) -> State:
        """The state in which the command s.sent has long been given, s the first cycle.

        steady: in the middle of a flight, not at its start.
        """
        s = self.with_own(s)
        states: list[FloatArray | None] = []

        def remembered(i: int, signals: Signals) -> FloatArray | None:
            part, p = self.command_effects[i]
            effect = part.effect
            states.append(effect.begin(signals, p, part.settings) if effect.states else None)
            return states[-1]

        drive = drive_of(self.command_effects, s, remembered)
        longest = s.delay + sum(part.effect.longest_s(p) for part, p in self.command_effects)
        line = np.repeat(drive.commands[None], 3 + math.ceil(longest / self.dt), axis=0)
        level = np.tensordot(drive.row, drive.commands, 1)
        signals = s.replaced(rate=rate, angle=angle, drive=self.p[0] * level, lagged=level,
                        command=self.p[0] * level, change=np.zeros_like(level))
        hidden = tuple(
            None if not part.effect.states else
            (part.effect.steady if steady else part.effect.begin)(signals, p, part.settings)
            for part, p in self.torque_effects
        )
        turning = Turning(rate, angle, np.stack([rate, np.zeros_like(rate)]), hidden)
        return State(turning, drive.commands.copy(), line, tuple(states))

    def step(self, x: State, s: Signals, push: FloatArray | float = 0.0) -> State:
        """The state a cycle later; push (w,): more acceleration over the cycle, rad/s²."""
        s = self.with_own(s)
        drive, hidden = self.send(x.hidden, s)
        line = np.concatenate([drive.commands[None], x.line[:-1]])
        before, new = (_sent_before(line, age) for age in required(drive.ages))
        motors, out = x.motors.copy(), np.empty((4, s.time.size))
        recursion.motors_step(motors, new, before, drive.row, np.ascontiguousarray(drive.lag),
                              drive.factors, required(drive.fraction), self.dt, out)
        turning = self.turn(x.turning, s, out[:2], out[2:], push, self.sensor.step)
        return State(turning, motors, line, hidden)

    def send(
        self, hidden: tuple[FloatArray | None, ...], s: Signals
    ) -> tuple[Drive, tuple[FloatArray | None, ...]]:
        """Commands that reach the motors for s.sent, and the effects' hidden states a cycle later.

        s: as of `with_own`.
        """
        inputs: list[Signals] = []

        def remembered(i: int, signals: Signals) -> FloatArray | None:
            inputs.append(signals)
            return hidden[i]

        drive = drive_of(self.command_effects, s, remembered)
        return drive, tuple(
            None if states is None else part.effect.advance(states, signals, p, part.settings)
            for states, signals, (part, p)
            in zip(hidden, inputs, self.command_effects, strict=True)
        )

    def turn(
        self, x: Turning, s: Signals, halves: FloatArray, states: FloatArray,
        push: FloatArray | float, step: FloatArray,
    ) -> Turning:
        """The motion a cycle later; drive (2, w) as Flight.driven gives it, at unit gain.

        push: more acceleration, rad/s². step (2, 5) or (2, 5, w): of the gyro's filter.
        """
        p, dt, h, r = self.p, self.dt, 0.5 * self.dt, x.rate
        drive, s = p[0] * halves, with_drive(s, p, halves, states)
        mean = s.drive
        middle = r + h * mean  # where physics is evaluated, then corrected by its slope
        for _ in range(self.rounds if self.bends else 1):
            s = s.replaced(rate=middle, angle=None if x.angle is None else x.angle + h * middle)
            now = [(part, p, s if states is None else s.replaced(hidden=states))
                   for (part, p), states in zip(self.torque_effects, x.hidden, strict=True)]
            force = with_torques(p[4] - p[3] * middle, now)
            slope = with_slopes(np.full(middle.size, -p[3]), now)
            a = h * slope
            new = ((1.0 + a) * r + dt * (mean + force - slope * middle + push)) / (1.0 - a)
            middle = 0.5 * (r + new)
        s = s.replaced(rate=middle, angle=None if x.angle is None else x.angle + h * middle)
        hidden = tuple(
            None if states is None else
            part.effect.advance(states, s.replaced(hidden=states), p, part.settings)
            for states, (part, p) in zip(x.hidden, self.torque_effects, strict=True)
        )
        middle_rate = middle + 0.25 * dt * (drive[0] - drive[1])
        inside = np.stack([*x.seen, r, middle_rate, new])
        gyro_states = step @ inside if step.ndim == 2 else np.sum(step * inside, axis=1)
        angle = None if x.angle is None else x.angle + dt / 6.0 * (r + 4.0 * middle_rate + new)
        return Turning(new, angle, gyro_states, hidden)

    def measured(self, x: State | Turning) -> tuple[FloatArray, FloatArray | None]:
        """Rate and angle as the gyro and what integrates it show them, without noise."""
        rate, angle, (g, slope), _ = x.turning if isinstance(x, State) else x
        if not self.sensor.noisy:
            return rate, angle
        late = self.sensor.late_s  # of a Butterworth filter, sqrt(2) / cut-off
        return g, None if angle is None else angle - late * g - 0.5 * late**2 * slope


def leaves(x: Any) -> list[Any]:
    """The arrays of a state, or of a part of it, in order."""
    if isinstance(x, tuple):
        return [leaf for item in x for leaf in leaves(item)]
    return [] if x is None else [x]


def alike(x: Any, by: Callable[[Any], Any]) -> Any:
    """A state, or a part of it, with what `by` makes of each of its arrays."""
    if isinstance(x, tuple):
        items = [alike(item, by) for item in x]
        return type(x)(*items) if isinstance(x, State | Turning) else tuple(items)
    return None if x is None else by(x)


def flat(x: State | Turning) -> FloatArray:
    """(states, w) all numbers of a state, one below the other."""
    return np.concatenate([array.reshape(math.prod(array.shape[:-1]), array.shape[-1])
                           for array in leaves(x)])


def unflat(numbers: FloatArray, like: Moving) -> Moving:
    """The inverse: numbers (states, …) as a state of the shapes of another, but for its w."""
    rows = iter(numbers)

    def filled(array: FloatArray) -> FloatArray:
        filled_rows = np.stack([next(rows) for _ in range(math.prod(array.shape[:-1]))])
        return filled_rows.reshape(*array.shape[:-1], *numbers.shape[1:])

    return alike(like, filled)


def _sent_before(line: FloatArray, age: FloatArray) -> FloatArray:
    """(c, w) commands of a line (d, c, w) that were sent so many cycles ago (w,)."""
    cycles = np.floor(age).astype(np.int64)
    each = np.arange(age.size)
    new = line[cycles, :, each].T
    share = age - cycles
    if share.any():
        new = new + share * (line[cycles + 1, :, each].T - new)
    return np.ascontiguousarray(new)
