"""The plant along a measured flight, behind its Kalman filter.

Physics is evaluated on whole arrays along the rate that the filter last estimated. The compiled
recursion takes it as known accelerations and their slope over the rate; a few passes converge.
This is Newton's method on the nonlinear filter: each step, and its derivatives, is linear.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from quad_sysid.axes import EVERY
from quad_sysid.contract import FloatArray
from quad_sysid.model import laws, recursion
from quad_sysid.model.angle import led_by_gyro
from quad_sysid.model.data import (
    SETTLE_S,
    SLOPE_S,
    AxisData,
    Span,
    Windows,
    at_limit,
    filled,
    where_commands_were_lost,
)
from quad_sysid.model.effect import SMALL, ActingEffect, Part, Signals, required
from quad_sysid.model.noise import Filter, Sensor, kalman, sensor_of
from quad_sysid.model.plant import (
    EffectOnSignals,
    Plant,
    Turning,
    alike,
    drive_of,
    flat,
    lag_and_delay,
    leaves,
    unflat,
    with_drive,
    with_slopes,
    with_torques,
)
from quad_sysid.model.structure import Structure, logs_of, natural
from quad_sysid.model.traced import Listing, Untraceable

DIVERGED = 1e6
"""Rate, rad/s, from which a run counts as diverged: ten thousand times what any gyro measures."""
FOLLOWED_S = 0.05
"""Time after which an integral of the rate follows the measurement."""
SMOOTHED = 5
"""Cycles over which the gyro is averaged for the first trajectory."""
FINER = 0.1
"""Share of a step by which a torque's parameter is moved, so that its curvature does not enter: an
event's edge, a frequency over a long flight."""
PURSUIT_STEP = 1e-3
"""Step of a wandering coefficient's parameters for derivatives of its gain."""


class Pushed(NamedTuple):
    """Accelerations along a trajectory, as recursion.predict takes them."""

    known: FloatArray
    slope: FloatArray


def central(
    function: Callable[[FloatArray], FloatArray], x: FloatArray, j: int, step: float
) -> FloatArray:
    """Derivative of an array by one coordinate of x (p,), by central differences."""
    shift = step * np.eye(x.size)[j]
    return (function(x + shift) - function(x - shift)) / (2.0 * step)


def per_coefficient(part: Part, s: Signals, p: FloatArray) -> FloatArray:
    """(n,) acceleration per unit of a wandering effect's coefficient, rad/s²."""
    unit = s.replaced(hidden=np.ones((1, s.rate.size)))
    return required(part.effect.torque(unit, p, part.settings))


def unmeasured(data: AxisData) -> NDArray[np.bool_]:
    """(n,) whether the rate was lost, or stood at the gyro's limit."""
    is_lost = ~np.isfinite(data.rate) | at_limit(data.rate)
    return is_lost if data.lost is None else is_lost | data.lost


def passes_of(data: AxisData, spans: Sequence[Span]) -> tuple[Span, ...]:
    """The samples that the filter runs over: each span with SETTLE_S before it, where unbroken."""
    lead = round(SETTLE_S / data.dt)
    is_measured = ~unmeasured(data)
    merged: list[list[int]] = []
    for start, stop in sorted(spans):
        around = next(s for s in data.stretches if s[0] <= start < s[1])
        begin = max(around[0], start - lead)
        begin += int(np.argmax(is_measured[begin : around[1]]))
        if merged and begin <= merged[-1][1] and merged[-1][0] >= around[0]:
            merged[-1][1] = max(merged[-1][1], stop)
        else:
            merged.append([begin, stop])
    return tuple((a, b) for a, b in merged)


class Flight:
    """One axis of a flight as the filter follows it.

    Only `spans` count; the filter starts SETTLE_S before each. The trajectory on which physics is
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
    follows_gyro: NDArray[np.bool_]
    """(n,) whether the filter takes the rate as measured: where commands were lost the motors do
    what nobody knows, which is no disturbance."""
    variance: float
    """Variance of the innovations, (rad/s)²; 0 before the first pass."""

    def __init__(self, data: AxisData, spans: Sequence[Span]) -> None:
        self.data, self.passes = data, passes_of(data, spans)
        self.sensors = self.gyro_sensors()
        late, cut_offs = np.array([sensor.late_s for sensor in self.sensors]), data.gyro_filters_hz
        self.late = np.full(data.rate.size, late[0] if late.size else 0.0)
        for hz in () if cut_offs is None else np.unique(cut_offs):
            self.late[cut_offs == hz] = sensor_of(float(hz), data.derived_s, data.dt).late_s
        output = required(data.angle) / data.dt if self.sensor.derived else data.rate
        self.measured = np.where(unmeasured(data), np.nan, output)
        self.follows_gyro = where_commands_were_lost(data, np.isfinite(self.measured), self.passes)
        self.gyro = filled(data.rate)
        self.angle = None
        if data.angle is not None:
            derived = self.sensor.derived
            self.angle = np.nan_to_num(data.angle) if derived else led_by_gyro(data, self.gyro)
        self.others: tuple[FloatArray, ...] | None = None
        if np.isfinite(data.other_rates).mean() > 0.5:
            self.others = tuple(self._advanced(np.nan_to_num(x)) for x in data.other_rates.T)
        columns = [EVERY[name].index + 1 for name in data.other_axes]
        self._measured = Signals.at_rest(
            data.clock + 0.5 * data.dt, np.ascontiguousarray(data.control[:, 0]), angle=None,
            battery_v=data.battery_v, other_rates=self.others,
            since_start=data.since_start + 0.5 * data.dt,
            other_commands=tuple(np.ascontiguousarray(data.control[:, columns].T)),
            motors=tuple(np.ascontiguousarray(data.motors.T)),
            other_angles=None if data.other_angles is None
            else tuple(np.ascontiguousarray(data.other_angles.T)),
            sent=data.command, share=data.share, dt=data.dt,
        )
        self.disturbances, self.variance = np.zeros((data.rate.size, 2)), 0.0
        self._drives: dict[bytes, tuple[FloatArray, FloatArray]] = {}
        # smoothed, and advanced by the filter's delay
        smooth = np.full(SMOOTHED, 1.0 / SMOOTHED)
        self.rate = self._advanced(np.convolve(self.gyro, smooth, mode='same'))

    def gyro_sensors(self, *, stepped: bool = False) -> tuple[Sensor, ...]:
        """The sensor of each pass, as its flight was flown."""
        data, cut_offs = self.data, self.data.gyro_filters_hz
        return tuple(
            sensor_of(data.gyro_filter_hz if cut_offs is None else float(cut_offs[start]),
                      data.derived_s, data.dt, stepped=stepped) for start, _ in self.passes
        )

    @property
    def sensor(self) -> Sensor:
        """The sensor of the first pass, for properties that all passes share."""
        return self.sensors[0]

    def sensor_steps(self, at: NDArray[np.int64]) -> FloatArray:
        """(w, 2, 5) step of the sensor (Sensor.step) in the passes of these samples (w,)."""
        number = np.searchsorted([a for a, _ in self.passes], at, side='right') - 1
        return np.stack([sensor.step for sensor in self.sensors])[np.maximum(number, 0)]

    def _advanced(self, measured: FloatArray, cycles: float = 0.0) -> FloatArray:
        """(n,) a measured rate at mid-cycle, or some cycles later, without the filter's delay."""
        is_measured, grid = np.isfinite(measured), np.arange(measured.size, dtype=np.float64)
        later = grid + (0.5 + self.late / self.data.dt) + cycles
        return np.interp(later, grid[is_measured], measured[is_measured])

    # -------------------------------------------------------------------------- physics

    def driven(self, structure: Structure, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Drive at unit gain: (2, n) means over half cycles; (2, n) drive and command mid-cycle.

        p: parameters in their units.
        """
        acting = structure.command_effects
        # what remembers the drive needs it from the start, all others from a pass to its end
        remembered = any(part.effect.remembers_command for part, _ in structure.placed)
        key = p[1:3].tobytes() + bytes([remembered]) + b''.join(
            part.effect.label.encode() + p[where].tobytes() + repr(part.settings).encode()
            for part, where in acting
        )
        stored = self._drives.get(key)
        if stored is not None:
            return stored
        data = self.data
        command_effects = [ActingEffect(part, p[where]) for part, where in acting]

        def hidden(i: int, s: Signals) -> FloatArray | None:
            part, p = command_effects[i]
            return self.hidden(part, s, p).hidden if part.effect.states else None

        drive = drive_of(command_effects, self.commanded(p), hidden)
        halves, states = np.zeros((2, 2, data.rate.size))
        channels = [np.ascontiguousarray(x) for x in (drive.commands, drive.row, drive.lag)]
        when = [np.ascontiguousarray(required(x)) for x in (drive.ages, drive.fraction)]
        for start, stop in data.stretches if remembered else self.passes:
            recursion.motors(*channels, drive.factors, *when, data.dt, start, stop, halves, states)
        if len(self._drives) > 40:  # the steps of all derivatives, not those of a whole search
            self._drives.clear()
        self._drives[key] = halves, states
        return halves, states

    def commanded(self, p: FloatArray) -> Signals:
        """The signals (n,) for effects that act before the torque: commands and measurements."""
        lag, delay = lag_and_delay(p)
        return self._measured.replaced(lag=lag, delay=delay)

    def signals(self, structure: Structure, p: FloatArray, rate: FloatArray) -> Signals:
        """Signals for a rate (n,) at mid-cycle, all along the flight."""
        ahead = 0.5 * self.data.dt + self.late
        return with_drive(self.commanded(p), p, *self.driven(structure, p)).replaced(
            rate=rate, angle=None if self.angle is None else self.angle + ahead * rate)

    def hidden(self, part: Part, s: Signals, p: FloatArray) -> Signals:
        """The signals with the effect's hidden states, (states, n), if any, along the flight."""
        effect, data = part.effect, self.data
        if not effect.states:
            return s
        inputs = effect.inputs_in_flight(s, self.followed)
        start_states = effect.states_at_start(data, p, part.settings)
        return s.replaced(
            hidden=effect.trace(inputs, p, part.settings, data.stretches, start_states))

    def followed(self, rate: FloatArray) -> FloatArray:
        """A rate (n,) that is the measured one in all that is slower than FOLLOWED_S.

        In what integrates the rate errors of an estimate would add up, from pass to pass too.
        """
        if self.sensor.derived:
            return rate
        dt, grid = self.data.dt, np.arange(rate.size)
        keep = math.exp(-dt / FOLLOWED_S)
        remainder = self.gyro - np.interp(grid - 0.5 - self.late / dt, grid, rate)
        return rate + lfilter([1.0 - keep], [1.0, -keep], remainder)

    def pushed(self, structure: Structure, p: FloatArray, rate: FloatArray) -> Pushed:
        """Accelerations along the trajectory `rate` (n,), and their slope over it."""
        drive, acting = self._acting(structure, p, rate, structure.torque_effects)
        torque = with_torques(p[4] - p[3] * rate, acting)
        for axis, share in zip(structure.shared, p[-len(structure.noise) :], strict=False):
            torque = torque + share * self.disturbances[:, axis]
        slope = with_slopes(np.full(rate.size, -p[3]), acting)
        return Pushed(drive + (torque - slope * rate), slope)

    def _acting(
        self, structure: Structure, p: FloatArray, rate: FloatArray,
        torque_effects: Sequence[tuple[Part, slice]],
    ) -> tuple[FloatArray, list[EffectOnSignals]]:
        """Acceleration by the drive (2, n), and those effects with what they see."""
        drive = p[0] * self.driven(structure, p)[0]
        if not torque_effects:
            return drive, []
        s = self.signals(structure, p, rate)
        return drive, [(part, p[where], self.hidden(part, s, p[where]))
                       for part, where in torque_effects]

    def columns(
        self, structure: Structure, theta: FloatArray, rate: FloatArray, steps: FloatArray
    ) -> tuple[FloatArray, FloatArray, NDArray[np.int64]]:
        """(n, p) derivatives of the acceleration; (n, b) of half its difference over the cycle.

        In the coordinates of the fit along a fixed trajectory, by differences of `steps` (p,)
        where a torque is not linear. The third, (b,), says for which of the p the second is.
        """
        torque_effects, p = structure.torque_effects, structure.natural(theta)
        derived = np.array([*range(3), *(j for _, where in structure.command_effects
                                         for j in range(where.start, where.stop))])
        out, bends = np.zeros((rate.size, theta.size)), np.empty((rate.size, derived.size))
        out[:, 3], out[:, 4] = -rate, 1.0
        for place, axis in enumerate(structure.shared, theta.size - len(structure.noise)):
            out[:, place] = self.disturbances[:, axis]
        if torque_effects:
            s = self.signals(structure, p, rate)
        for part, where in torque_effects:
            out[:, where] = self._by_parameters(part, s, theta[where], steps[where])
        follow_drive = [(part, where) for part, where in torque_effects
                        if 'command' in part.effect.signals]

        def driven(theta: FloatArray) -> FloatArray:
            """(2, n) acceleration of all that follows the command."""
            p = structure.natural(theta)
            return with_torques(*self._acting(structure, p, rate, follow_drive))

        here = driven(theta)
        for i, j in enumerate(derived):
            begin, end = (driven(theta + np.diag(steps)[j]) - here) / steps[j]
            out[:, j], bends[:, i] = 0.5 * (begin + end), 0.5 * (begin - end)
        return out, bends, derived

    def _by_parameters(
        self, part: Part, s: Signals, theta: FloatArray, steps: FloatArray
    ) -> FloatArray:
        """(n, q) derivatives of an effect's torque by its coordinates of the fit."""
        effect, settings, linear = part.effect, part.settings, part.effect.linear
        logs = logs_of(effect.parameters)
        p = natural(logs, theta)
        signals = self.hidden(part, s, p)  # which those in which the torque is linear do not move
        torque = required(effect.torque(signals, p, settings))
        out = np.empty((s.rate.size, theta.size))
        for j in set(range(theta.size)) - set(linear):
            shift = FINER * np.diag(steps)[j]
            perturbed = natural(logs, theta + shift)
            after = effect.torque(self.hidden(part, s, perturbed), perturbed, settings)
            out[:, j] = (required(after) - torque) / shift[j]
        if linear:
            p[linear] = 0.0
            out[:, linear] = effect.columns(signals, p, linear, settings)
        return out

    def unexplained(self, p: FloatArray) -> FloatArray:
        """(n,) acceleration that the base does not explain, rad/s², from the slope of the rate.

        p: parameters in their units, the base's first.
        """
        dt = self.data.dt
        reach = max(1.0, SLOPE_S / dt)
        earlier, here, later = (self._advanced(self.data.rate, sign * reach)
                                for sign in (-1.0, 0.0, 1.0))
        halves = self.driven(Structure(), p)[0]
        modelled = p[0] * 0.5 * (halves[0] + halves[1]) - p[3] * here + p[4]
        return (later - earlier) / (2.0 * reach * dt) - modelled

    # ------------------------------------------------------------------------ the filter

    def filters_of(
        self, structure: Structure, theta: FloatArray, damping: float
    ) -> tuple[Filter, ...]:
        """The steady Kalman filter of each pass at these parameters."""
        noise = structure.natural(theta)[-structure.filtered :]
        arrays = {
            sensor: kalman(noise, damping, sensor, self.data.dt, averaged=structure.averaged)
            for sensor in dict.fromkeys(self.sensors)
        }
        return tuple(arrays[sensor] for sensor in self.sensors)

    def predict(
        self, structure: Structure, theta: FloatArray, *, sweeps: int = 2,
        steps: FloatArray | None = None,
    ) -> Prediction:
        """Innovations after `sweeps` passes along the flight; with `steps` their derivatives."""
        n, p, rate = self.data.rate.size, structure.natural(theta), self.rate
        if not structure.torque_effects:
            sweeps = 1  # the physics is linear in the rate
        for sweep in range(sweeps):
            push = self.pushed(structure, p, rate)
            damping = -float(np.mean(push.slope))
            steady = self.filters_of(structure, theta, damping)
            by = _Inputs.none(steady[0], self.wander(structure, p, rate))
            derived, filters = steps if sweep == sweeps - 1 else None, [by.filters] * len(steady)
            if by.place.size:
                self._follow(structure, theta, push.slope, steady, by, derived is not None)
            if derived is not None:
                columns, bends, bent = self.columns(structure, theta, rate, derived)
                by = by._replace(columns=columns, bends=bends, bent=bent)
                filters = self._by_filter(structure, theta, damping, steady)
            ran = self._run(push, steady, by, filters)
            if not self.variance:
                self.variance = (1.4826 * float(np.nanmedian(np.abs(ran.innovation)))) ** 2
            if not np.isfinite(ran.rate).all() or np.abs(ran.rate).max() > DIVERGED:
                return Prediction(np.full(n, np.inf), None, ran.states, steady, rate)
            rate = ran.rate
        self.rate = rate
        return ran if steps is not None else replace(ran, jacobian=None)

    def _run(
        self, push: Pushed, steady: tuple[Filter, ...], by: _Inputs, filters: Sequence[FloatArray]
    ) -> Prediction:
        """The compiled filter along all passes; of each its own filter, and its derivatives."""
        n, rate = self.data.rate.size, self.rate.copy()
        states = np.zeros((n, steady[0].gain.size + by.place.size))
        innovation, jacobian = np.full(n, np.nan), np.zeros(by.columns.shape)
        for (start, stop), sensor, filtered, more in zip(
            self.passes, self.sensors, steady, filters, strict=True
        ):
            recursion.predict(
                self.measured, float(self.data.rate[start]), *push, filtered.gain, filtered.move,
                sensor.step, sensor.behind, self.data.dt, self.follows_gyro, start, stop,
                *by._replace(filters=more), rate, states, innovation, jacobian,
            )
        return Prediction(innovation, jacobian, states, steady, rate)

    def _by_filter(
        self, structure: Structure, theta: FloatArray, damping: float, steady: tuple[Filter, ...]
    ) -> list[FloatArray]:
        """(p, 6 + 4 v) derivatives of Filter.gain and Filter.move, of each pass."""
        def flat(filters: tuple[Filter, ...]) -> FloatArray:
            return np.stack([np.concatenate([one.gain, one.move]) for one in filters])

        out = np.zeros((len(self.passes), theta.size, 6 + 4 * structure.lines))
        filters_here, point = flat(steady), np.r_[theta, damping]
        for j in range(theta.size - structure.filtered, point.size):
            perturbed = point + SMALL * (np.arange(point.size) == j)
            perturbed_filters = flat(self.filters_of(structure, perturbed[:-1], perturbed[-1]))
            out[:, j if j < theta.size else 3] = (perturbed_filters - filters_here) / SMALL
        return [*out]

    def _follow(
        self, structure: Structure, theta: FloatArray, slope: FloatArray,
        steady: tuple[Filter, ...], by: _Inputs, derived: bool,
    ) -> None:
        """Put in how the filter follows wandering effects, with derivatives where `derived`."""
        psi = self.responses(by.wander, slope, steady)
        wandering = [where for part, where in structure.placed if part.effect.wanders]
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
        acting = [(part, p[where]) for part, where in structure.placed if part.effect.wanders]
        if not acting:
            return np.zeros((rate.size, 0))
        s = self.signals(structure, p, rate)
        return np.stack([per_coefficient(part, s, values) for part, values in acting], axis=1)

    def responses(
        self, columns: FloatArray, slope: FloatArray, steady: tuple[Filter, ...]
    ) -> FloatArray:
        """(n, m) response of the innovations to accelerations (n, m); a filter for each pass."""
        by = _Inputs.none(steady[0], np.zeros((slope.size, 0)), columns)
        push = Pushed(np.zeros((2, slope.size)), slope)
        return required(self._run(push, steady, by, [by.filters] * len(steady)).jacobian)

    # ---------------------------------------------------------------------- the free run

    def run(
        self, structure: Structure, theta: FloatArray, windows: Windows, *,
        prediction: Prediction | None = None, rounds: int = 1,
    ) -> Run:
        """Free runs of the windows from each predicted start; rounds: as in Plant."""
        dt, p = self.data.dt, structure.natural(theta)
        prediction = prediction or self.predict(structure, theta)
        steady, starts = prediction.filter, windows.starts
        plant = Plant(structure, p, dt, self.sensor, self.data.craft, self.data.index, rounds)
        x = prediction.states[starts]
        r, d, g, q = x[:, :4].T
        end = 4 + 2 * structure.lines
        v = x[:, 4:end:2] + 1j * x[:, 5:end:2]
        followed = iter(x[:, end:].T)
        turn = steady.move[2::2] + 1j * steady.move[3::2]
        fade, hold = steady.move[:2]
        signals = self.signals(structure, p, prediction.rate)
        angle = None if self.angle is None else self.angle[starts] + self.late[starts] * r
        turning = Turning(r, angle, np.stack([g, q]), tuple(
            next(followed)[None, :] if part.effect.wanders else
            required(self.hidden(part, signals, values).hidden)[:, starts]
            if part.effect.states else None for part, values in plant.torque_effects
        ))
        cycle = np.arange(windows.length)[:, None]
        went = turned(plant, turning, self.commanded(p), self.driven(structure, p), starts + cycle,
                      hold * d * fade**cycle, np.moveaxis(self.sensor_steps(starts), 0, -1))
        start: Turning = alike(went, lambda each: np.ascontiguousarray(
            np.swapaxes(each[..., :-1, :], -1, -2)))
        errors = (start.seen[0] if self.sensor.noisy else start.rate) \
            - self.data.rate[windows.cells]
        if not self.sensor.derived:
            errors += (v @ (turn**cycle).T).real
        return Run(self.data.where_measured(errors, windows),
                   0.5 * (went.rate[:-1] + went.rate[1:]).T, start.angle, start.hidden)


def turned(plant: Plant, x: Turning, s: Signals, driven: tuple[FloatArray, FloatArray],
           cells: NDArray[np.int64], push: FloatArray, step: FloatArray) -> Turning:
    """How an axis turns from x (w,) in the cycles `cells` (l, w) of a flight: (l + 1, w).

    What happens in a cycle is noted once and repeated by compiled code. s: signals (n,) of the
    flight, and what drives it as Flight.driven gives it; push (l, w) more acceleration, rad/s²;
    step (2, 5, w) of the gyro's filter.
    """
    (length, w), listing, path = cells.shape, Listing(s.time.size), [flat(x)]
    start = alike(x, lambda array: listing.inputs(*array.shape[:-1], 1))
    more, each = listing.inputs(1), listing.inputs(2, 5, 1)
    try:
        later: Any = plant.turn(start, s, driven[0], driven[1],
                                more, each)  # type: ignore[arg-type]
        following = np.concatenate([listing.places(one).ravel() for one in leaves(later)])
    except (Untraceable, TypeError, IndexError, ValueError):
        for now, acceleration in zip(cells, push, strict=True):
            x = plant.turn(x, s.at(now), driven[0][:, now], driven[1][:, now], acceleration, step)
            path.append(flat(x))
        return unflat(np.stack(path, axis=1), x)
    code, inputs, places = listing.repeated(following)
    m, registers = following.size, np.repeat(np.array(listing.start)[:, None], w, axis=1)
    registers[:m], registers[each.at.ravel()] = path[0], step.reshape(-1, w)
    out = np.empty((m, length + 1, w))
    # indexing and joining keep the order in memory that they meet
    known = np.ascontiguousarray(np.concatenate([push[None], inputs[:, cells]]))
    laws.carried(code, *listing.numbers(w), registers, known, np.r_[more.at, places], following,
                 0, length, out)
    out[:, -1] = registers[:m]
    return unflat(out, x)


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
    def none(steady: Filter, wander: FloatArray, columns: FloatArray | None = None) -> _Inputs:
        """The columns (n, m) of the physics alone, and no pursuit of what wanders, (n, w)."""
        n, w = wander.shape
        columns = np.zeros((n, 0)) if columns is None else columns
        return _Inputs(
            columns, np.zeros((n, 0)), np.zeros(0, np.int64),
            np.zeros((columns.shape[1], steady.gain.size + steady.move.size)),
            wander, np.zeros((n, w, 2)), np.zeros((n, w, 2, 2)), np.zeros(w, np.int64),
        )


class Run(NamedTuple):
    """Free runs from the starts of windows."""

    errors: FloatArray
    """(windows, length) of the rate, rad/s."""
    rate: FloatArray
    """(windows, length) at the middle of each cycle, rad/s."""
    angle: FloatArray | None
    """(windows, length) at its start, rad."""
    hidden: tuple[FloatArray | None, ...]
    """(states, windows, length) of each effect that adds a torque, at its start."""


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
    """The filter of each pass."""
    rate: FloatArray

    @property
    def filter(self) -> Filter:
        """The filter of the first pass; passes with the same gyro filter have the same one."""
        return self.filters[0]
