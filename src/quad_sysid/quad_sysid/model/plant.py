"""The base and its effects: Plant goes from one cycle to the next, Flight follows a measured one.

    rate' = drive - damping rate + bias + effects + d
    lag drive' = gain u(t - delay) - drive

Physics is evaluated on whole arrays along the rate that the filter last estimated. The compiled
recursion takes it as known accelerations and their slope over the rate; a few passes converge.
This is Newton's method on the nonlinear filter: each step, and its derivatives, is linear.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from quad_sysid.contract import AXES, FloatArray
from quad_sysid.model import recursion
from quad_sysid.model.angle import led_by_gyro
from quad_sysid.model.data import AxisData, Span, Windows, at_limit, filled
from quad_sysid.model.effect import Drive, Part, Signals, required
from quad_sysid.model.noise import Filter, Sensor, kalman, sensor_of
from quad_sysid.model.structure import Structure, natural

LEAD_S = 1.0
"""The filter starts this long before each span, where the flight is unbroken."""
SLOPE_STEP = 1e-4
"""Step of the rate for the slope of a torque, rad/s."""
SLOPE_S = 0.02
"""An acceleration is the slope of the rate over this time to either side."""
FOLLOWED_S = 0.05
"""Time after which an integral of the rate follows the measurement."""
FINER = 0.1
"""Share of a step by which a torque's parameter is moved, so that its curvature does not enter: an
event's edge, a frequency over a long flight."""
FILTER_STEP, PURSUIT_STEP = 1e-4, 1e-3
"""Steps of the noise's and of a wandering coefficient's parameters for derivatives of gains."""
SHORTEST_S = 1e-5
"""A lag or delay below this counts as none."""


class Pushed(NamedTuple):
    """Accelerations along a trajectory, as recursion.predict takes them."""

    known: FloatArray
    slope: FloatArray


Acting = tuple[Part, FloatArray, Signals]
"""An effect with its own parameters and the signals that it sees."""


def with_torques(start: FloatArray, acting: Sequence[Acting]) -> FloatArray:
    """An acceleration and those of the effects, rad/s²."""
    for part, p, s in acting:
        own = part.effect.torque(s, p, part.settings)
        if own is not None:
            start = start + own
    return start


def with_slopes(start: FloatArray, acting: Sequence[Acting]) -> FloatArray:
    """The slope of an acceleration over the rate and those of the effects' torques, 1/s."""
    for part, p, s in acting:
        if 'rate' in part.effect.signals:
            ahead, back = (
                with_torques(np.zeros(1), [(part, p, replace(s, rate=s.rate + step))])
                for step in (SLOPE_STEP, -SLOPE_STEP)
            )
            start = start + (ahead - back) / (2.0 * SLOPE_STEP)
    return start


Sending = Sequence[tuple[Part, FloatArray]]
"""Effects that act before the torque, each with its own parameters."""


def sent_on(
    sending: Sending, s: Signals, remembered: Callable[[int, Signals], FloatArray | None]
) -> Drive:
    """What becomes of a command s.sent before the motors; along a flight or in one cycle.

    remembered: the hidden states of the effect of this number, which sees these signals.
    """
    seen = []
    for i, (part, p) in enumerate(sending):
        s = replace(s, hidden=remembered(i, s))
        seen.append(s)
        s = replace(s, sent=part.effect.command(s, p, part.settings))
    sent = required(s.sent)
    drive = Drive(sent[None], np.ones(1), np.full((1, *sent.shape), s.lag))
    drive = drive.behind(np.full(sent.shape, s.delay / s.dt))
    for (part, p), own in zip(sending, seen, strict=True):
        drive = part.effect.actuate(drive, own, p, part.settings)
    return drive


def lag_and_delay(p: FloatArray) -> tuple[float, float]:
    """Of a base, s, as they are flown."""
    return max(float(p[1]), SHORTEST_S), min(max(float(p[2]), 0.0), 0.5)


class Turning(NamedTuple):
    """The axis at the start of a cycle; arrays of one shape (w,)."""

    rate: FloatArray
    """rad/s."""
    angle: FloatArray | None
    """rad."""
    seen: FloatArray
    """(2, w) the states of the gyro's filter."""
    hidden: tuple[FloatArray | None, ...]
    """Those of each effect that adds a torque."""


class State(NamedTuple):
    """The whole plant at the start of a cycle."""

    turning: Turning
    motors: FloatArray
    """(c, w) command of each channel behind its lag."""
    line: FloatArray
    """(d, c, w) commands that are under way, the newest first."""
    hidden: tuple[FloatArray | None, ...]
    """Those of each effect that acts before the torque."""


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
    share: FloatArray
    """(motors,) what a unit of each motor's command adds to that of the axis."""
    rounds: int = 1
    """Rounds of Newton's method in a cycle; one is enough where torques hardly bend in it."""

    @cached_property
    def sending(self) -> Sending:
        """The effects that act before the torque."""
        return [(part, self.p[at]) for part, at in self.structure.placed()
                if part.effect.moves_command]

    @cached_property
    def pushing(self) -> Sending:
        """The effects that add a torque."""
        return [(part, self.p[at]) for part, at in self.structure.placed()
                if not part.effect.moves_command]

    def _told(self, s: Signals) -> Signals:
        lag, delay = lag_and_delay(self.p)
        return replace(s, lag=lag, delay=delay, dt=self.dt, share=self.share)

    def begin(self, s: Signals, rate: FloatArray, angle: FloatArray | None) -> State:
        """The state in which the command s.sent has long been given, s the first cycle."""
        s = self._told(s)
        own: list[FloatArray | None] = []

        def remembered(i: int, seen: Signals) -> FloatArray | None:
            part, p = self.sending[i]
            own.append(part.effect.begin(seen, p, part.settings) if part.effect.states else None)
            return own[-1]

        drive = sent_on(self.sending, s, remembered)
        longest = s.delay + sum(part.effect.longest_s(p) for part, p in self.sending)
        line = np.repeat(drive.commands[None], 3 + math.ceil(longest / self.dt), axis=0)
        lagged = np.tensordot(drive.row, drive.commands, 1)
        moved = replace(s, rate=rate, angle=angle, drive=self.p[0] * lagged, lagged=lagged,
                        command=self.p[0] * lagged, change=np.zeros_like(lagged))
        hidden = tuple(part.effect.begin(moved, p, part.settings) if part.effect.states else None
                       for part, p in self.pushing)
        turning = Turning(rate, angle, np.stack([rate, np.zeros_like(rate)]), hidden)
        return State(turning, drive.commands.copy(), line, tuple(own))

    def step(self, x: State, s: Signals, push: FloatArray | float = 0.0) -> State:
        """The state a cycle later; push (w,): more acceleration over the cycle, rad/s²."""
        s = self._told(s)
        seen: list[Signals] = []

        def remembered(i: int, own: Signals) -> FloatArray | None:
            seen.append(own)
            return x.hidden[i]

        drive = sent_on(self.sending, s, remembered)
        hidden = tuple(
            None if known is None else part.effect.advance(known, own, p, part.settings)
            for known, own, (part, p) in zip(x.hidden, seen, self.sending, strict=True)
        )
        line = np.concatenate([drive.commands[None], x.line[:-1]])
        before, new = (_sent_before(line, age) for age in required(drive.ages))
        motors, out = x.motors.copy(), np.empty((4, s.time.size))
        recursion.motors_ahead(motors, new, before, drive.row, np.ascontiguousarray(drive.lag),
                               drive.factors, required(drive.fraction), self.dt, out)
        turning = self.turn(x.turning, s, out[:2], out[2:], push, self.sensor.step)
        return State(turning, motors, line, hidden)

    def turn(
        self, x: Turning, s: Signals, halves: FloatArray, states: FloatArray,
        push: FloatArray | float, step: FloatArray,
    ) -> Turning:
        """How the axis turns in a cycle; drive (2, w) as Flight.driven gives it, at unit gain.

        push: more acceleration, rad/s². step (2, 5) or (2, 5, w): of the gyro's filter.
        """
        p, dt, h, r = self.p, self.dt, 0.5 * self.dt, x.rate
        drive, command = p[0] * halves, p[0] * states[1]
        mean = 0.5 * (drive[0] + drive[1])
        s = replace(s, drive=mean, command=command, lagged=0.5 * (halves[0] + halves[1]),
                    change=(command - p[0] * states[0]) / max(float(p[1]), 0.25 * dt))
        middle = r + h * mean  # where physics is evaluated, then corrected by its slope
        for _ in range(self.rounds):
            s = replace(s, rate=middle, angle=None if x.angle is None else x.angle + h * middle)
            now = [(part, own, s if known is None else replace(s, hidden=known))
                   for (part, own), known in zip(self.pushing, x.hidden, strict=True)]
            force = with_torques(p[4] - p[3] * middle, now)
            slope = with_slopes(np.full(middle.size, -p[3]), now)
            a = h * slope
            new = ((1.0 + a) * r + dt * (mean + force - slope * middle + push)) / (1.0 - a)
            middle = 0.5 * (r + new)
        s = replace(s, rate=middle, angle=None if x.angle is None else x.angle + h * middle)
        hidden = tuple(
            None if known is None else part.effect.advance(known, s, own, part.settings)
            for known, (part, own) in zip(x.hidden, self.pushing, strict=True)
        )
        bent = middle + 0.25 * dt * (drive[0] - drive[1])
        inside = np.stack([*x.seen, r, bent, new])
        seen = step @ inside if step.ndim == 2 else np.sum(step * inside, axis=1)
        angle = None if x.angle is None else x.angle + dt / 6.0 * (r + 4.0 * bent + new)
        return Turning(new, angle, seen, hidden)

    def flat(self, x: State) -> FloatArray:
        """(states, w) all numbers of a state, one below the other."""
        turning = x.turning
        hidden = [known for known in (*turning.hidden, *x.hidden) if known is not None]
        angle = [] if turning.angle is None else [turning.angle[None]]
        parts = [turning.rate[None], *angle, turning.seen, x.motors, *x.line, *hidden]
        return np.concatenate(parts)

    def unflat(self, numbers: FloatArray, like: State) -> State:
        """The inverse, for states of the shapes of another."""
        rest = iter(numbers)

        def taken(shape: FloatArray | None) -> FloatArray | None:
            return None if shape is None else np.stack([next(rest) for _ in shape])

        turning = like.turning
        rate = next(rest)
        angle = None if turning.angle is None else next(rest)
        seen, motors = required(taken(turning.seen)), required(taken(like.motors))
        line = np.stack([required(taken(one)) for one in like.line])
        own, sent = (tuple(map(taken, one)) for one in (turning.hidden, like.hidden))
        return State(Turning(rate, angle, seen, own), motors, line, sent)

    def measured(self, x: State) -> tuple[FloatArray, FloatArray | None]:
        """Rate and angle as the gyro and what integrates it show them, without noise."""
        rate, angle, (g, slope), _ = x.turning
        if not self.sensor.noisy:
            return rate, angle
        late = self.sensor.late_s  # of a Butterworth filter, sqrt(2) / cut-off
        return g, None if angle is None else angle - late * g - 0.5 * late**2 * slope


def _sent_before(line: FloatArray, age: FloatArray) -> FloatArray:
    """(c, w) commands of a line (d, c, w) that were sent so many cycles ago (w,)."""
    whole = np.floor(age).astype(np.int64)
    each = np.arange(age.size)
    new = line[whole, :, each].T
    share = age - whole
    if share.any():
        new = new + share * (line[whole + 1, :, each].T - new)
    return np.ascontiguousarray(new)


def central(
    function: Callable[[FloatArray], FloatArray], x: FloatArray, j: int, step: float
) -> FloatArray:
    """Derivative of an array by one coordinate of x (p,), by central differences."""
    away = step * np.eye(x.size)[j]
    return (function(x + away) - function(x - away)) / (2.0 * step)


def per_coefficient(part: Part, s: Signals, p: FloatArray) -> FloatArray:
    """(n,) acceleration per unit of a wandering effect's coefficient, rad/s²."""
    one = replace(s, hidden=np.ones((1, s.rate.size)))
    return required(part.effect.torque(one, p, part.settings))


def unmeasured(data: AxisData) -> NDArray[np.bool_]:
    """(n,) whether the rate was lost, or stood at the gyro's limit."""
    lost = ~np.isfinite(data.rate) | at_limit(data.rate)
    return lost if data.lost is None else lost | data.lost


def passes_of(data: AxisData, spans: Sequence[Span]) -> tuple[Span, ...]:
    """What the filter runs over: each span with LEAD_S before it, where that is unbroken."""
    lead = round(LEAD_S / data.dt)
    seen = ~unmeasured(data)
    merged: list[list[int]] = []
    for start, stop in sorted(spans):
        home = next(s for s in data.stretches if s[0] <= start < s[1])
        begin = max(home[0], start - lead)
        begin += int(np.argmax(seen[begin : home[1]]))
        if merged and begin <= merged[-1][1] and merged[-1][0] >= home[0]:
            merged[-1][1] = max(merged[-1][1], stop)
        else:
            merged.append([begin, stop])
    return tuple((a, b) for a, b in merged)


class Flight:
    """One axis of a flight as the filter follows it.

    Only `spans` count; the filter starts LEAD_S before each. The trajectory on which physics is
    evaluated is kept between calls.
    """

    rate: FloatArray
    """(n,) rate at the middle of each cycle by the last estimate of the filter, rad/s."""
    gyro: FloatArray
    """(n,) the rate as it was measured, or derived from the angle, without gaps, rad/s."""
    measured: FloatArray
    """(n,) the measurement that is predicted, rad/s: the rate, or angle / dt where only the angle
    was measured; NaN where it was lost or at its limit."""
    disturbances: FloatArray
    """(n, 2) acceleration of the other two axes that their bases do not explain, rad/s²; zero
    until discover.base.shares sets it."""
    variance: float
    """Variance of the innovations, (rad/s)²; 0: not known yet."""

    def __init__(self, data: AxisData, spans: Sequence[Span]) -> None:
        self.data, self.passes = data, passes_of(data, spans)
        self.sensors = self.seen_through()
        late, own = np.array([one.late_s for one in self.sensors]), data.gyro_filters_hz
        self.late = np.full(data.rate.size, late[0] if late.size else 0.0)
        for one in () if own is None else np.unique(own):
            self.late[own == one] = sensor_of(float(one), data.derived_s, data.dt).late_s
        output = required(data.angle) / data.dt if self.sensor.derived else data.rate
        self.measured = np.where(unmeasured(data), np.nan, output)
        self.gyro = filled(data.rate)
        self.angle = None
        if data.angle is not None:
            derived = self.sensor.derived
            self.angle = np.nan_to_num(data.angle) if derived else led_by_gyro(data, self.gyro)
        self.others: list[FloatArray] | None = None
        if np.isfinite(data.other_rates).mean() > 0.5:
            self.others = [self._ahead(np.nan_to_num(column)) for column in data.other_rates.T]
        columns = [AXES.index(name) + 1 for name in data.other_axes]
        self.share = data.share
        self._known: dict[str, Any] = {
            'throttle': np.ascontiguousarray(data.control[:, 0]), 'battery_v': data.battery_v,
            'time': data.clock + 0.5 * data.dt, 'other_rates': self.others,
            'other_commands': [*np.ascontiguousarray(data.control[:, columns].T)],
            'motors': [*np.ascontiguousarray(data.motors.T)],
            'other_angles': None if data.other_angles is None
            else [*np.ascontiguousarray(data.other_angles.T)],
        }
        self.disturbances, self.variance = np.zeros((data.rate.size, 2)), 0.0
        self._drives: dict[bytes, tuple[FloatArray, FloatArray]] = {}
        # smoothed over five cycles and advanced by the filter's delay
        self.rate = self._ahead(np.convolve(self.gyro, np.full(5, 0.2), mode='same'))

    def seen_through(self, *, stepped: bool = False) -> tuple[Sensor, ...]:
        """The sensor of each pass, as its flight was flown."""
        data, own = self.data, self.data.gyro_filters_hz
        return tuple(
            sensor_of(data.gyro_filter_hz if own is None else float(own[start]), data.derived_s,
                      data.dt, stepped=stepped) for start, _ in self.passes
        )

    @property
    def sensor(self) -> Sensor:
        """That of the first pass, for what all have in common."""
        return self.sensors[0]

    def _ahead(self, measured: FloatArray, cycles: float = 0.0) -> FloatArray:
        """(n,) a measured rate at mid-cycle, or some cycles later, without the filter's delay."""
        known, grid = np.isfinite(measured), np.arange(measured.size, dtype=np.float64)
        later = grid + (0.5 + self.late / self.data.dt) + cycles
        return np.interp(later, grid[known], measured[known])

    # -------------------------------------------------------------------------- physics

    def driven(self, structure: Structure, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Drive at unit gain: (2, n) means over half cycles; (2, n) drive and command mid-cycle.

        p: parameters in their units.
        """
        acting = [one for one in structure.placed() if one[0].effect.moves_command]
        # what remembers the drive needs it from the start, all others from a pass to its end
        remembered = any({'command', 'history'} <= {*part.effect.signals}
                         for part in structure.parts)
        key = p[1:3].tobytes() + bytes([remembered]) + b''.join(
            part.effect.label.encode() + p[where].tobytes() + repr(part.settings).encode()
            for part, where in acting
        )
        found = self._drives.get(key)
        if found is not None:
            return found
        data = self.data
        sending = [(part, p[where]) for part, where in acting]

        def along(i: int, s: Signals) -> FloatArray | None:
            part, own = sending[i]
            return self.hidden(part, s, own).hidden if part.effect.states else None

        drive = sent_on(sending, self.commanded(p), along)
        halves, states = np.zeros((2, 2, data.rate.size))
        channels = [np.ascontiguousarray(x) for x in (drive.commands, drive.row, drive.lag)]
        when = [np.ascontiguousarray(required(x)) for x in (drive.ages, drive.fraction)]
        for start, stop in data.stretches if remembered else self.passes:
            recursion.motors(*channels, drive.factors, *when, data.dt, start, stop, halves, states)
        if len(self._drives) > 40:
            self._drives.clear()
        self._drives[key] = halves, states
        return halves, states

    def commanded(self, p: FloatArray) -> Signals:
        """What acts before the torque sees: the commands, and what else was measured."""
        lag, delay = lag_and_delay(p)
        known: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value
            for name, value in self._known.items()
        }
        return Signals.at_rest(**known, angle=None, sent=self.data.command, share=self.share,
                               lag=lag, delay=delay, dt=self.data.dt)

    def signals(
        self, p: FloatArray, halves: FloatArray, states: FloatArray, rate: FloatArray
    ) -> Signals:
        """Signals for a rate (n,) at mid-cycle, all along the flight."""
        data, gain = self.data, p[0]
        lagged, command = 0.5 * (halves[0] + halves[1]), gain * states[1]
        return replace(
            self.commanded(p), rate=rate, drive=gain * lagged, command=command, lagged=lagged,
            angle=None if self.angle is None else self.angle + (0.5 * data.dt + self.late) * rate,
            change=(command - gain * states[0]) / max(float(p[1]), 0.25 * data.dt),
        )

    def hidden(self, part: Part, s: Signals, p: FloatArray) -> Signals:
        """The signals with the effect's hidden states, (states, n), if any, along the flight.

        What integrates the rate takes the measured one at all that is slower than FOLLOWED_S:
        errors of an estimated rate would add up in it, and from one pass to the next.
        """
        effect, data = part.effect, self.data
        if not effect.states:
            return s
        rate = s.rate
        if effect.integrates and not self.sensor.derived:
            dt, grid = data.dt, np.arange(rate.size)
            keep = math.exp(-dt / FOLLOWED_S)
            away = self.gyro - np.interp(grid - 0.5 - self.late / dt, grid, rate)
            rate = rate + lfilter([1.0 - keep], [1.0, -keep], away)
        seen = replace(s, rate=rate)
        begun = effect.begun(data, p, part.settings)
        return replace(s, hidden=effect.trace(seen, p, part.settings, data.stretches, begun))

    def pushed(self, structure: Structure, p: FloatArray, rate: FloatArray) -> Pushed:
        """Accelerations along the trajectory `rate` (n,), and their slope over it."""
        drive, acting = self._acting(structure, p, rate, structure.placed())
        torque = with_torques(p[4] - p[3] * rate, acting)
        for which, share in zip(structure.shared, p[-len(structure.noise) :], strict=False):
            torque = torque + share * self.disturbances[:, which]
        slope = with_slopes(np.full(rate.size, -p[3]), acting)
        return Pushed(drive + (torque - slope * rate), slope)

    def _acting(
        self, structure: Structure, p: FloatArray, rate: FloatArray,
        placed: Sequence[tuple[Part, slice]],
    ) -> tuple[FloatArray, list[Acting]]:
        """Acceleration by the drive (2, n), and those effects with what they see."""
        driven = self.driven(structure, p)
        if not placed:
            return p[0] * driven[0], []
        s = self.signals(p, *driven, rate)
        return p[0] * driven[0], [
            (part, p[where], self.hidden(part, s, p[where])) for part, where in placed
            if not part.effect.moves_command
        ]

    def columns(
        self, structure: Structure, theta: FloatArray, rate: FloatArray, steps: FloatArray
    ) -> tuple[FloatArray, FloatArray, NDArray[np.int64]]:
        """(n, p) derivatives of the acceleration; (n, b) of half its difference over the cycle.

        In the coordinates of the fit along a fixed trajectory, by differences of `steps` (p,)
        where a torque is not linear. The third, (b,), says for which of the p the second is.
        """
        placed, p = structure.placed(), structure.natural(theta)
        moving = slice(3), *(where for part, where in placed if part.effect.moves_command)
        bent = np.r_[moving]
        out, bends = np.zeros((rate.size, theta.size)), np.empty((rate.size, bent.size))
        out[:, 3], out[:, 4] = -rate, 1.0
        for place, which in enumerate(structure.shared, theta.size - len(structure.noise)):
            out[:, place] = self.disturbances[:, which]
        pushing = [(part, where) for part, where in placed if not part.effect.moves_command]
        if pushing:
            s = self.signals(p, *self.driven(structure, p), rate)
        for part, where in pushing:
            out[:, where] = self._by_parameters(part, s, theta[where], steps[where])
        follow_drive = [one for one in placed if 'command' in one[0].effect.signals]

        def driven(theta: FloatArray) -> FloatArray:
            """(2, n) acceleration of all that follows the command."""
            p = structure.natural(theta)
            return with_torques(*self._acting(structure, p, rate, follow_drive))

        here = driven(theta)
        for i, j in enumerate(bent):
            begin, end = (driven(theta + np.diag(steps)[j]) - here) / steps[j]
            out[:, j], bends[:, i] = 0.5 * (begin + end), 0.5 * (begin - end)
        return out, bends, bent

    def _by_parameters(
        self, part: Part, s: Signals, theta: FloatArray, steps: FloatArray
    ) -> FloatArray:
        """(n, q) derivatives of an effect's torque by its coordinates of the fit."""
        effect, settings, linear = part.effect, part.settings, part.effect.linear
        p = natural(effect.parameters, theta)
        own = self.hidden(part, s, p)  # which those in which the torque is linear do not move
        out, here = np.empty((s.rate.size, theta.size)), required(effect.torque(own, p, settings))
        for j in set(range(theta.size)) - set(linear):
            ahead = FINER * np.diag(steps)[j]
            moved = natural(effect.parameters, theta + ahead)
            there = required(effect.torque(self.hidden(part, s, moved), moved, settings))
            out[:, j] = (there - here) / ahead[j]
        if linear:
            p[linear] = 0.0
            out[:, linear] = effect.columns(own, p, linear, settings)
        return out

    def unexplained(self, p: FloatArray) -> FloatArray:
        """(n,) acceleration that the base does not explain, rad/s², from the slope of the rate.

        p: parameters in their units, the base's first.
        """
        dt = self.data.dt
        reach = max(1.0, SLOPE_S / dt)
        back, here, ahead = (self._ahead(self.data.rate, way * reach) for way in (-1.0, 0.0, 1.0))
        halves = self.driven(Structure(), p)[0]
        explained = p[0] * 0.5 * (halves[0] + halves[1]) - p[3] * here + p[4]
        return (ahead - back) / (2.0 * reach * dt) - explained

    # ------------------------------------------------------------------------ the filter

    def filters_of(
        self, structure: Structure, theta: FloatArray, damping: float
    ) -> tuple[Filter, ...]:
        """The steady Kalman filter of each pass at these parameters."""
        noise = structure.natural(theta)[-structure.filtered :]
        known = {
            sensor: kalman(noise, damping, sensor, self.data.dt, averaged=structure.averaged)
            for sensor in dict.fromkeys(self.sensors)
        }
        return tuple(known[sensor] for sensor in self.sensors)

    def predict(
        self, structure: Structure, theta: FloatArray, *, sweeps: int = 2,
        steps: FloatArray | None = None,
    ) -> Prediction:
        """Innovations after `sweeps` passes along the flight; with `steps` their derivatives."""
        n, p, rate = self.data.rate.size, structure.natural(theta), self.rate
        for sweep in range(sweeps):
            push = self.pushed(structure, p, rate)
            damping = -float(np.mean(push.slope))
            found = self.filters_of(structure, theta, damping)
            by = _Inputs.none(found[0], self.wander(structure, p, rate))
            derived, filters = steps if sweep == sweeps - 1 else None, [by.filters] * len(found)
            if by.place.size:
                self._follow(structure, theta, push.slope, found, by, derived is not None)
            if derived is not None:
                columns, bends, bent = self.columns(structure, theta, rate, derived)
                by = by._replace(columns=columns, bends=bends, bent=bent)
                filters = self._by_filter(structure, theta, damping)
            ran = self._run(push, found, by, filters)
            if not self.variance:
                self.variance = float(np.nanmedian(np.abs(ran.innovation)) / 0.6745) ** 2
            if not np.isfinite(ran.rate).all() or np.abs(ran.rate).max() > 1e6:
                return Prediction(np.full(n, np.inf), None, ran.states, found, rate)
            rate = ran.rate
        self.rate = rate
        return ran if steps is not None else replace(ran, jacobian=None)

    def _run(
        self, push: Pushed, found: tuple[Filter, ...], by: _Inputs, filters: Sequence[FloatArray]
    ) -> Prediction:
        """The compiled filter along all passes; of each its own filter, and its derivatives."""
        n, rate = self.data.rate.size, self.rate.copy()
        states = np.zeros((n, found[0].gain.size + by.place.size))
        innovation, jacobian = np.full(n, np.nan), np.zeros(by.columns.shape)
        for (start, stop), sensor, own, more in zip(
            self.passes, self.sensors, found, filters, strict=True
        ):
            recursion.predict(
                self.measured, float(self.data.rate[start]), *push, own.gain, own.move,
                sensor.step, sensor.behind, self.data.dt, start, stop,
                *by._replace(filters=more), rate, states, innovation, jacobian,
            )
        return Prediction(innovation, jacobian, states, found, rate)

    def _by_filter(
        self, structure: Structure, theta: FloatArray, damping: float
    ) -> list[FloatArray]:
        """(p, 6 + 4 v) derivatives of Filter.gain and Filter.move, of each pass."""
        def steady(at: FloatArray) -> FloatArray:
            found = self.filters_of(structure, at[:-1], at[-1])
            return np.stack([np.concatenate([one.gain, one.move]) for one in found])

        at = np.r_[theta, damping]
        out = np.zeros((len(self.passes), theta.size, 6 + 4 * structure.lines))
        for j in range(theta.size - structure.filtered, at.size):
            out[:, j if j < theta.size else 3] = central(steady, at, j, FILTER_STEP)
        return [*out]

    def _follow(
        self, structure: Structure, theta: FloatArray, slope: FloatArray,
        found: tuple[Filter, ...], by: _Inputs, derived: bool,
    ) -> None:
        """Put in how the filter follows wandering effects, with derivatives where `derived`."""
        psi = self.responses(by.wander, slope, found)
        wandering = [where for part, where in structure.placed() if part.effect.wanders]
        for i, where in enumerate(wandering):
            # the gain's dependence on all other parameters is neglected: white innovations make
            # its mean effect on the likelihood zero
            pursuit, by.place[i] = partial(self.pursuit, psi[:, i]), where.start
            by.pursuit[:, i] = pursuit(theta[where])
            for j in range(2) if derived else ():
                by.by_pursuit[:, i, :, j] = central(pursuit, theta[where], j, PURSUIT_STEP)

    def pursuit(self, psi: FloatArray, logs: FloatArray) -> FloatArray:
        """(n, 2) what an innovation adds to a coefficient, and what is left of it after a cycle.

        psi (n,): derivative of the innovations by it; logs (2,): of its spread and correlation.
        """
        spread, correlation = np.exp(logs)
        psi = np.ascontiguousarray(psi)
        out = np.zeros((psi.size, 2))
        out[:, 1] = math.exp(-self.data.dt / correlation)
        for start, stop in self.passes if self.variance else ():
            recursion.pursuit(psi, self.variance, spread, start, stop, out)
        return out

    def wander(self, structure: Structure, p: FloatArray, rate: FloatArray) -> FloatArray:
        """(n, w) acceleration per unit of each wandering coefficient, rad/s²."""
        acting = [(part, p[at]) for part, at in structure.placed() if part.effect.wanders]
        if not acting:
            return np.zeros((rate.size, 0))
        s = self.signals(p, *self.driven(structure, p), rate)
        return np.stack([per_coefficient(part, s, own) for part, own in acting], axis=1)

    def responses(
        self, columns: FloatArray, slope: FloatArray, found: tuple[Filter, ...]
    ) -> FloatArray:
        """(n, m) response of the innovations to accelerations (n, m); a filter for each pass."""
        by = _Inputs.none(found[0], np.zeros((slope.size, 0)), columns)
        push = Pushed(np.zeros((2, slope.size)), slope)
        return required(self._run(push, found, by, [by.filters] * len(found)).jacobian)

    # ---------------------------------------------------------------------- the free run

    def free_run(
        self, structure: Structure, theta: FloatArray, windows: Windows, *,
        prediction: Prediction | None = None, rounds: int = 1,
    ) -> FloatArray:
        """(windows, length) error of the rate, rad/s, run freely from each predicted start.

        rounds: as in Plant.
        """
        dt, p = self.data.dt, structure.natural(theta)
        prediction = prediction or self.predict(structure, theta)
        found = prediction.filter
        halves, states = self.driven(structure, p)
        plant = Plant(structure, p, dt, self.sensor, self.share, rounds)
        x = prediction.states[windows.starts]
        r, d, g, q = x[:, :4].T
        end = 4 + 2 * structure.lines
        v = x[:, 4:end:2] + 1j * x[:, 5:end:2]
        followed = iter(x[:, end:].T)
        turn = found.move[2::2] + 1j * found.move[3::2]
        fade, hold = found.move[:2]
        late = self.late[windows.starts]
        own = np.searchsorted([a for a, _ in self.passes], windows.starts, side='right') - 1
        step = np.stack([one.step for one in self.sensors], axis=2)[:, :, np.maximum(own, 0)]
        out = np.full((windows.count, windows.length), np.nan)
        along = self.signals(p, halves, states, prediction.rate)
        angle = None if self.angle is None else self.angle[windows.starts] + late * r
        turning = Turning(r, angle, np.stack([g, q]), tuple(
            next(followed)[None, :] if part.effect.wanders else
            required(self.hidden(part, along, values).hidden)[: part.effect.states, windows.starts]
            if part.effect.states else None for part, values in plant.pushing
        ))
        around = self.commanded(p)
        for i in range(windows.length):
            k = windows.starts + i
            out[:, i] = (turning.seen[0] if self.sensor.noisy else turning.rate) \
                - self.data.rate[k]
            if not self.sensor.derived:
                out[:, i] += v.real.sum(axis=1)
            turning = plant.turn(turning, around.at(k), halves[:, k], states[:, k], hold * d, step)
            d, v = d * fade, v * turn
        return out


class _Inputs(NamedTuple):
    """What enters the filter besides known accelerations, as recursion.predict takes it."""

    columns: FloatArray
    bends: FloatArray
    bent: NDArray[np.int64]
    filters: FloatArray
    wander: FloatArray
    pursuit: FloatArray
    by_pursuit: FloatArray
    place: NDArray[np.int64]

    @staticmethod
    def none(found: Filter, wander: FloatArray, columns: FloatArray | None = None) -> _Inputs:
        """Of (n, m) columns the physics alone, and no pursuit of what wanders, (n, w)."""
        n, w = wander.shape
        columns = np.zeros((n, 0)) if columns is None else columns
        return _Inputs(
            columns, np.zeros((n, 0)), np.zeros(0, np.int64),
            np.zeros((columns.shape[1], found.gain.size + found.move.size)),
            wander, np.zeros((n, w, 2)), np.zeros((n, w, 2, 2)), np.zeros(w, np.int64),
        )


@dataclass(frozen=True)
class Prediction:
    """The filter's result along a flight."""

    innovation: FloatArray
    """(n,) rad/s; NaN outside the passes."""
    jacobian: FloatArray | None
    """(n, p) derivatives by the coordinates of the fit."""
    states: FloatArray
    """(n, Structure.states) predicted states of the filter, before each measurement."""
    filters: tuple[Filter, ...]
    """Of each pass."""
    rate: FloatArray

    @property
    def filter(self) -> Filter:
        """That of the first pass; all of one gyro filter are alike."""
        return self.filters[0]
