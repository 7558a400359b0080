"""The base and its effects along a flight: predicted with innovations, or as a free run.

    rate' = drive - damping rate + bias + effects + d
    lag drive' = gain u(t - delay) - drive

Physics is evaluated on whole arrays along the rate that the filter last estimated. The compiled
recursion takes it as known accelerations and their slope over the rate; a few passes converge.
This is Newton's method on the nonlinear filter: each step, and its derivatives, is linear.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from quad_sysid.contract import AXES, MIXER_INVERSE, FloatArray
from quad_sysid.model import recursion
from quad_sysid.model.data import AxisData, Span, Windows, at_limit
from quad_sysid.model.effect import Drive, Effect, Part, Signals, required
from quad_sysid.model.noise import Filter, Noise, Sensor, kalman, sensor_of
from quad_sysid.model.structure import NOISE, VIBRATION, Structure

LEAD_S = 1.0
"""The filter starts this long before each span, where the flight is unbroken."""
SLOPE_STEP = 1e-4
"""Step of the rate for the slope of a torque, rad/s."""
SLOPE_S = 0.02
"""An acceleration is the slope of the rate over this time to either side."""
PURSUIT_STEP = 1e-3
"""Step of a wandering coefficient's parameters for the derivatives of its gain."""
SHORTEST_S = 1e-5
"""A lag or delay below this counts as none."""


@dataclass(frozen=True)
class Pushed:
    """Accelerations along a trajectory, as recursion.predict takes them."""

    known: FloatArray
    slope: FloatArray


def slope_over_rate(part: Part, s: Signals, p: FloatArray) -> FloatArray:
    """Derivative of an effect's torque over the rate, 1/s."""
    ahead, back = (
        required(part.effect.torque(replace(s, rate=s.rate + step), p, part.settings))
        for step in (SLOPE_STEP, -SLOPE_STEP)
    )
    return (ahead - back) / (2.0 * SLOPE_STEP)


def per_coefficient(part: Part, s: Signals, p: FloatArray) -> FloatArray:
    """(n,) acceleration per unit of a wandering effect's coefficient, rad/s²."""
    one = replace(s, hidden=np.ones((1, s.rate.size)))
    return required(part.effect.torque(one, p, part.settings))


def passes_of(data: AxisData, spans: Sequence[Span]) -> tuple[Span, ...]:
    """What the filter runs over: each span with LEAD_S before it, where that is unbroken."""
    lead = round(LEAD_S / data.dt)
    seen = np.isfinite(data.rate) & ~at_limit(data.rate)
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


@dataclass
class Flight:
    """One axis of a flight as the filter follows it.

    Only `spans` count; the filter starts LEAD_S before each. The trajectory on which physics is
    evaluated is kept between calls.
    """

    data: AxisData
    spans: tuple[Span, ...]
    passes: tuple[Span, ...] = ()
    rate: FloatArray = field(default_factory=lambda: np.zeros(0))
    """(n,) rate at the middle of each cycle by the last estimate of the filter, rad/s."""
    sensor: Sensor = field(init=False)
    disturbances: FloatArray = field(init=False)
    """(n, 2) acceleration of the other two axes that their bases do not explain, rad/s²; zero
    until discover.base.shares sets it."""
    measured: FloatArray = field(init=False)
    """(n,) the measurement that is predicted, rad/s: the rate, or angle / dt where only the angle
    was measured; NaN where it was lost or at its limit."""

    def __post_init__(self) -> None:
        data = self.data
        self.passes = passes_of(data, self.spans)
        self.sensor = sensor_of(data.gyro_filter_hz, data.derived_s, data.dt)
        self.late = self.sensor.late_s
        output = required(data.angle) / data.dt if self.sensor.derived else data.rate
        lost = ~np.isfinite(data.rate) | at_limit(data.rate)
        self.measured = np.where(lost, np.nan, output)
        n = data.rate.size
        self.row = np.ascontiguousarray(MIXER_INVERSE[data.index + 1])
        grid = np.arange(n, dtype=np.float64)
        time = grid * data.dt if data.time_s is None else data.time_s
        self.time = time + 0.5 * data.dt
        self.angle = None if data.angle is None else np.nan_to_num(data.angle)
        self.others: tuple[FloatArray, FloatArray] | None = None
        if np.isfinite(data.other_rates).mean() > 0.5:
            ahead = grid + (0.5 + self.late / data.dt)
            first, second = (
                np.interp(ahead, grid, np.nan_to_num(column)) for column in data.other_rates.T
            )
            self.others = first, second
        self.leans: tuple[FloatArray, FloatArray] | None = None
        if data.other_angles is not None:
            first, second = np.ascontiguousarray(data.other_angles.T)
            self.leans = first, second
        one, other = (
            np.ascontiguousarray(data.control[:, AXES.index(name) + 1])
            for name in data.other_axes
        )
        self.other_commands = one, other
        self.throttle = np.ascontiguousarray(data.control[:, 0])
        self.disturbances = np.zeros((n, 2))
        self.variance = 0.0  # of the innovations, (rad/s)²; 0: not known yet
        self._drives: dict[bytes, tuple[FloatArray, FloatArray]] = {}
        if self.rate.size != n:
            self.rate = self._first_guess()

    def _first_guess(self) -> FloatArray:
        """The measured rate, smoothed over five cycles and advanced by the filter's delay."""
        known = np.flatnonzero(np.isfinite(self.data.rate))
        measured = np.interp(np.arange(self.data.rate.size), known, self.data.rate[known])
        smooth = np.convolve(measured, np.full(5, 0.2), mode='same')
        shift = 0.5 + self.late / self.data.dt
        grid = np.arange(measured.size, dtype=np.float64)
        return np.interp(grid + shift, grid, smooth).astype(np.float64)

    # -------------------------------------------------------------------------- physics

    def driven(self, structure: Structure, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Drive at unit gain: (2, n) means over half cycles; (2, n) drive and command mid-cycle.

        p: parameters in their units.
        """
        acting = [
            (part, where) for part, where in zip(structure.parts, structure.slices(), strict=True)
            if part.effect.moves_command
        ]
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
        command = data.command
        for part, where in acting:
            command = part.effect.command(data, command, p[where], part.settings)
        n = command.size
        lag = np.full((1, n), max(float(p[1]), SHORTEST_S))
        drive = Drive(command[None, :], np.ones(1), lag)
        for part, where in acting:
            drive = part.effect.actuate(data, drive, p[where], part.settings)
        delay = min(max(float(p[2]), 0.0), 0.5) / data.dt
        whole = math.floor(delay + 1e-9)
        halves, states = np.zeros((2, n)), np.zeros((2, n))
        for start, stop in data.stretches if remembered else self.passes:
            recursion.motors(
                np.ascontiguousarray(drive.commands), np.ascontiguousarray(drive.row),
                np.ascontiguousarray(drive.lag), float(drive.asymmetry), whole,
                min(max(delay - whole, 0.0), 1.0), data.dt, start, stop, halves, states,
            )
        if len(self._drives) > 40:
            self._drives.clear()
        self._drives[key] = halves, states
        return halves, states

    def signals(
        self, p: FloatArray, halves: FloatArray, states: FloatArray, rate: FloatArray
    ) -> Signals:
        """All signals along the flight for a rate (n,) at mid-cycle."""
        data, gain = self.data, p[0]
        angle = None
        if self.angle is not None:
            angle = self.angle + (0.5 * data.dt + self.late) * rate
        drive = gain * 0.5 * (halves[0] + halves[1])
        command = gain * states[1]
        return Signals(
            rate=rate, angle=angle, drive=drive, command=command,
            change=(command - gain * states[0]) / max(float(p[1]), 0.25 * data.dt),
            lagged=0.5 * (halves[0] + halves[1]), throttle=self.throttle,
            battery_v=data.battery_v, other_rates=self.others,
            other_commands=self.other_commands, other_angles=self.leans, time=self.time,
        )

    def hidden(self, part: Part, s: Signals, p: FloatArray) -> Signals:
        """The signals with the effect's hidden states along the flight."""
        if not part.effect.states:
            return s
        return replace(s, hidden=part.effect.trace(self.data, s, p, part.settings))

    def pushed(self, structure: Structure, p: FloatArray, rate: FloatArray) -> Pushed:
        """Accelerations along the trajectory `rate` (n,), and their slope over it."""
        halves, states = self.driven(structure, p)
        s = self.signals(p, halves, states, rate)
        torque = p[4] - p[3] * rate
        slope = np.full(rate.size, -p[3])
        for part, where in zip(structure.parts, structure.slices(), strict=True):
            with_states = self.hidden(part, s, p[where])
            own = part.effect.torque(with_states, p[where], part.settings)
            if own is None:
                continue
            torque = torque + own
            if 'rate' in part.effect.signals or 'angle' in part.effect.signals:
                slope = slope + slope_over_rate(part, with_states, p[where])
        for which, share in zip(structure.shared, p[-len(structure.noise) :], strict=False):
            torque = torque + share * self.disturbances[:, which]
        rest = torque - slope * rate
        return Pushed(p[0] * halves + rest, slope)

    def columns(
        self, structure: Structure, theta: FloatArray, rate: FloatArray, steps: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """(n, m) derivatives of the acceleration, (n, b) of half its difference over the cycle.

        In the coordinates of the fit, by central differences of `steps` (p,) along a fixed
        trajectory.
        """
        n, m = rate.size, theta.size - structure.filtered
        effects_end = theta.size - len(structure.noise)
        first = [0, 1, 2]
        for part, where in zip(structure.parts, structure.slices(), strict=True):
            if part.effect.moves_command:
                first += range(where.start, where.stop)
        order = first + [j for j in range(m) if j not in first]
        out, bends = np.empty((n, m)), np.empty((n, len(first)))
        centre = structure.natural(theta)
        halves, states = self.driven(structure, centre)
        s = self.signals(centre, halves, states, rate)
        follows_drive = any(
            'command' in part.effect.signals and type(part.effect).torque is not Effect.torque
            for part in structure.parts
        )
        owner = {
            j: (part, where)
            for part, where in zip(structure.parts, structure.slices(), strict=True)
            for j in range(where.start, where.stop)
        }
        for place, j in enumerate(order):
            if j == 3:
                out[:, place] = -rate
            elif j == 4:
                out[:, place] = 1.0
            elif j >= effects_end:
                out[:, place] = self.disturbances[:, structure.shared[j - effects_end]]
            elif j not in first:
                part, where = owner[j]
                up, down = self._stepped(structure, theta, j, steps[j])
                ahead, back = (
                    required(part.effect.torque(self.hidden(part, s, p), p, part.settings))
                    for p in (up[where], down[where])
                )
                out[:, place] = (ahead - back) / (2.0 * steps[j])
            else:
                up, down = self._stepped(structure, theta, j, steps[j])
                if follows_drive:
                    difference = (
                        self.pushed(structure, up, rate).known
                        - self.pushed(structure, down, rate).known
                    ) / (2.0 * steps[j])
                elif j == 0:
                    difference = halves
                else:
                    difference = (
                        self.driven(structure, up)[0] - self.driven(structure, down)[0]
                    ) * (centre[0] / (2.0 * steps[j]))
                out[:, place] = 0.5 * (difference[0] + difference[1])
                bends[:, place] = 0.5 * (difference[0] - difference[1])
        self.order = order
        return out, bends

    @staticmethod
    def _stepped(
        structure: Structure, theta: FloatArray, j: int, step: float
    ) -> tuple[FloatArray, FloatArray]:
        up, down = theta.copy(), theta.copy()
        up[j] += step
        down[j] -= step
        return structure.natural(up), structure.natural(down)

    def unexplained(self, p: FloatArray) -> FloatArray:
        """(n,) acceleration that the base does not explain, rad/s², from the slope of the rate.

        p: parameters in their units, the base's first.
        """
        rate, dt = self.data.rate, self.data.dt
        known = np.isfinite(rate)
        reach = max(1.0, SLOPE_S / dt)
        grid = np.arange(rate.size, dtype=np.float64)
        back, here, ahead = (
            np.interp(grid + 0.5 + self.late / dt + shift, grid[known], rate[known])
            for shift in (-reach, 0.0, reach)
        )
        halves = self.driven(Structure(), p)[0]
        explained = p[0] * 0.5 * (halves[0] + halves[1]) - p[3] * here + p[4]
        left: FloatArray = (ahead - back) / (2.0 * reach * dt) - explained
        return left

    # ------------------------------------------------------------------------ the filter

    def filter_of(self, structure: Structure, theta: FloatArray, damping: float) -> Filter:
        """The steady Kalman filter at these parameters."""
        p = structure.natural(theta)[-structure.filtered :]
        white, disturbance, correlation, after = (float(v) for v in p[: len(NOISE)])
        lines = p[len(NOISE) :].reshape(-1, len(VIBRATION))
        noise = Noise(
            white, disturbance, correlation, after,
            tuple((float(size), float(centre), float(width)) for size, centre, width in lines),
        )
        return kalman(noise, damping, self.sensor, self.data.dt)

    def predict(
        self, structure: Structure, theta: FloatArray, *, sweeps: int = 2,
        steps: FloatArray | None = None,
    ) -> Prediction:
        """Innovations after `sweeps` passes along the flight; with `steps` their derivatives."""
        data, n = self.data, self.data.rate.size
        p = structure.natural(theta)
        rate = self.rate
        nothing = np.zeros((n, 0))
        innovation = np.full(n, np.nan)
        states = np.zeros((n, structure.states))
        for sweep in range(sweeps):
            push = self.pushed(structure, p, rate)
            damping = -float(np.mean(push.slope))
            found = self.filter_of(structure, theta, damping)
            columns, bends = nothing, nothing
            gains = np.zeros((0, 4 + 2 * structure.lines))
            moves = np.zeros((0, 2 + 2 * structure.lines))
            if steps is not None and sweep == sweeps - 1:
                physics, bends = self.columns(structure, theta, rate, steps)
                count = theta.size - physics.shape[1]
                columns = np.ascontiguousarray(np.hstack([physics, np.zeros((n, count))]))
                gains, moves = self._noise_columns(structure, theta, damping, count)
            follow = self._follow(structure, theta, push.slope, found, rate, columns.shape[1])
            new_rate = rate.copy()
            jacobian = np.zeros((n, columns.shape[1]))
            for start, stop in self.passes:
                recursion.predict(
                    self.measured, float(data.rate[start]), push.known, push.slope, columns,
                    bends, found.gain, gains, found.move, moves, self.sensor.step,
                    self.sensor.behind, *follow, data.dt, start, stop, new_rate, states,
                    innovation, jacobian,
                )
            if not self.variance:
                self.variance = float(np.nanmedian(np.abs(innovation)) / 0.6745) ** 2
            if not np.isfinite(new_rate).all() or np.abs(new_rate).max() > 1e6:
                return Prediction(np.full(n, np.inf), None, states, found, rate)
            rate = new_rate
        self.rate = rate
        if steps is not None:
            put = np.empty_like(jacobian)
            put[:, self.order] = jacobian[:, : len(self.order)]
            put[:, len(self.order) :] = jacobian[:, len(self.order) :]
            jacobian = put
        return Prediction(innovation, jacobian if steps is not None else None, states, found, rate)

    def _follow(
        self, structure: Structure, theta: FloatArray, slope: FloatArray, found: Filter,
        rate: FloatArray, columns: int,
    ) -> tuple[FloatArray | NDArray[np.int64], ...]:
        """What recursion.predict takes of wandering effects, from `wander` to `place`."""
        n = rate.size
        parts = [
            (part, where) for part, where in zip(structure.parts, structure.slices(), strict=True)
            if part.effect.wanders
        ]
        wander = self.wander(structure, structure.natural(theta), rate)
        follow, left = np.zeros_like(wander), np.zeros(len(parts))
        by_follow = np.zeros((n if columns else 0, len(parts), 2))
        by_left, place = np.zeros((len(parts), 2)), np.zeros(len(parts), dtype=np.int64)
        psi = self.responses(wander, slope, found) if parts else wander
        for i, (_, where) in enumerate(parts):
            left[i], follow[:, i] = self.pursuit(psi[:, i], theta[where])
            if not columns:
                continue
            # the gain's dependence on all other parameters is neglected: white innovations make
            # its mean effect on the likelihood zero
            place[i] = self.order.index(where.start)
            for j, step in enumerate(PURSUIT_STEP * np.eye(2)):
                up, down = (
                    self.pursuit(psi[:, i], theta[where] + way * step) for way in (1.0, -1.0)
                )
                by_left[i, j] = (up[0] - down[0]) / (2.0 * PURSUIT_STEP)
                by_follow[:, i, j] = (up[1] - down[1]) / (2.0 * PURSUIT_STEP)
        return wander, follow, left, by_follow, by_left, place

    def pursuit(self, psi: FloatArray, logs: FloatArray) -> tuple[float, FloatArray]:
        """What is left of a coefficient after a cycle, and (n,) what an innovation adds to it.

        psi (n,): derivative of the innovations by it; logs (2,): of its spread and correlation.
        """
        spread, correlation = np.exp(logs)
        left, follow = math.exp(-self.data.dt / correlation), np.zeros(psi.size)
        for start, stop in self.passes if self.variance else ():
            recursion.pursuit(psi, self.variance, spread, left, start, stop, follow)
        return left, follow

    def wander(self, structure: Structure, p: FloatArray, rate: FloatArray) -> FloatArray:
        """(n, w) acceleration per unit of each wandering coefficient, rad/s²."""
        acting = [
            (part, p[where])
            for part, where in zip(structure.parts, structure.slices(), strict=True)
            if part.effect.wanders
        ]
        if not acting:
            return np.zeros((rate.size, 0))
        s = self.signals(p, *self.driven(structure, p), rate)
        return np.stack([per_coefficient(part, s, own) for part, own in acting], axis=1)

    def responses(self, columns: FloatArray, slope: FloatArray, found: Filter) -> FloatArray:
        """(n, m) response of the innovations to accelerations (n, m)."""
        out = np.zeros_like(columns)
        for start, stop in self.passes:
            recursion.respond(
                self.measured, columns, slope, found.gain, found.move, self.sensor.step,
                self.sensor.behind, self.data.dt, start, stop, out,
            )
        return out

    def _noise_columns(
        self, structure: Structure, theta: FloatArray, damping: float, count: int
    ) -> tuple[FloatArray, FloatArray]:
        """Derivatives of Filter.gain (p, 4 + 2 v) and Filter.move (p, 2 + 2 v)."""
        more = 2 * structure.lines
        gains, moves = np.zeros((theta.size, 4 + more)), np.zeros((theta.size, 2 + more))
        step = 1e-4

        def difference(up: Filter, down: Filter, at: int) -> None:
            gains[at] = (up.gain - down.gain) / (2.0 * step)
            moves[at] = (up.move - down.move) / (2.0 * step)

        # the base's damping comes fourth in the vector, and fourth among the columns only where
        # no effect acts on the command
        difference(
            self.filter_of(structure, theta, damping + step),
            self.filter_of(structure, theta, damping - step), self.order.index(3),
        )
        for at in range(theta.size - count, theta.size):
            up, down = theta.copy(), theta.copy()
            up[at] += step
            down[at] -= step
            difference(
                self.filter_of(structure, up, damping), self.filter_of(structure, down, damping),
                at,
            )
        return gains, moves

    # ---------------------------------------------------------------------- the free run

    def free_run(
        self, structure: Structure, theta: FloatArray, windows: Windows, *,
        prediction: Prediction | None = None,
    ) -> FloatArray:
        """(windows, length) error of the rate, rad/s, run freely from each predicted start."""
        data, dt = self.data, self.data.dt
        p = structure.natural(theta)
        prediction = prediction or self.predict(structure, theta)
        found = prediction.filter
        halves, states = self.driven(structure, p)
        x = prediction.states[windows.starts]
        r, d, g, q = (x[:, i].copy() for i in range(4))
        end = 4 + 2 * structure.lines
        v = x[:, 4:end:2] + 1j * x[:, 5:end:2]
        followed = iter(x[:, end:].T)
        turn = found.move[2::2] + 1j * found.move[3::2]
        fade, hold = found.move[:2]
        angle = None if self.angle is None else self.angle[windows.starts] + self.late * r
        out = np.full((windows.count, windows.length), np.nan)
        last = data.rate.size - 1
        gyro = self.sensor.step
        acting = [
            (part, p[where])
            for part, where in zip(structure.parts, structure.slices(), strict=True)
        ]
        along = self.signals(p, halves, states, prediction.rate)
        hidden = [
            next(followed)[None, :] if part.effect.wanders else
            part.effect.trace(data, along, values, part.settings)[:, windows.starts]
            if part.effect.states else None for part, values in acting
        ]
        for i in range(windows.length):
            k = np.minimum(windows.starts + i, last)
            out[:, i] = (g if self.sensor.noisy else r) - data.rate[k]
            if not self.sensor.derived:
                out[:, i] += v.real.sum(axis=1)
            drive = p[0] * halves[:, k]
            mean = 0.5 * (drive[0] + drive[1])
            middle = r + 0.5 * dt * mean  # where physics is evaluated, then corrected by its slope
            s = self._at(k, p, middle, angle, mean, states)
            force, slope = _force(acting, hidden, p, s)
            a = 0.5 * dt * slope
            push = mean + force - slope * middle + hold * d
            new = ((1.0 + a) * r + dt * push) / (1.0 - a)
            half = 0.5 * (r + new)
            s = replace(s, rate=half)
            hidden = [
                None if x is None else part.effect.advance(x, s, values, part.settings, dt)
                for x, (part, values) in zip(hidden, acting, strict=True)
            ]
            bent = half + 0.25 * dt * (drive[0] - drive[1])
            g, q = (
                gyro[0, 0] * g + gyro[0, 1] * q + gyro[0, 2] * r + gyro[0, 3] * bent
                + gyro[0, 4] * new,
                gyro[1, 0] * g + gyro[1, 1] * q + gyro[1, 2] * r + gyro[1, 3] * bent
                + gyro[1, 4] * new,
            )
            if angle is not None:
                angle = angle + dt * half
            r, d = new, d * fade
            v = v * turn
        return out

    def _at(
        self, k: NDArray[np.int64], p: FloatArray, rate: FloatArray, angle: FloatArray | None,
        drive: FloatArray, states: FloatArray,
    ) -> Signals:
        """The signals at mid-cycle of the samples k, where a free run has come."""
        data = self.data
        command = p[0] * states[1, k]
        return Signals(
            rate=rate, angle=None if angle is None else angle + 0.5 * data.dt * rate,
            drive=drive, command=command,
            change=(command - p[0] * states[0, k]) / max(float(p[1]), 0.25 * data.dt),
            lagged=drive / p[0] if p[0] else 0.0 * drive, throttle=self.throttle[k],
            battery_v=None if data.battery_v is None else data.battery_v[k],
            other_rates=None if self.others is None else (self.others[0][k], self.others[1][k]),
            other_commands=(self.other_commands[0][k], self.other_commands[1][k]),
            other_angles=None if self.leans is None else (self.leans[0][k], self.leans[1][k]),
            time=self.time[k],
        )


def _force(
    acting: Sequence[tuple[Part, FloatArray]], hidden: Sequence[FloatArray | None],
    p: FloatArray, s: Signals,
) -> tuple[FloatArray, FloatArray]:
    """Acceleration without the drive, and its slope over the rate."""
    force, slope = p[4] - p[3] * s.rate, np.full(s.rate.size, -p[3])
    for (part, values), x in zip(acting, hidden, strict=True):
        s = replace(s, hidden=x)
        own = part.effect.torque(s, values, part.settings)
        if own is None:
            continue
        force = force + own
        if 'rate' in part.effect.signals:
            slope = slope + slope_over_rate(part, s, values)
    return force, slope


@dataclass(frozen=True)
class Prediction:
    """The filter's result along a flight."""

    innovation: FloatArray
    """(n,) rad/s; NaN outside the passes."""
    jacobian: FloatArray | None
    """(n, p) derivatives by the coordinates of the fit."""
    states: FloatArray
    """(n, Structure.states) predicted states of the filter, before each measurement."""
    filter: Filter
    rate: FloatArray
