"""Derivatives of free runs by all parameters at once.

Instead of a run for each parameter the physics of all cycles is differentiated along a run that
was made, in whole arrays; the rest is linear, and compiled.
"""

from __future__ import annotations

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.model import recursion
from quad_sysid.model.data import Windows
from quad_sysid.model.effect import SMALL, Signals, required
from quad_sysid.model.flight import Flight, Prediction, Run
from quad_sysid.model.plant import lag_and_delay, with_drive, with_torques
from quad_sysid.model.structure import Structure

Passed = tuple[FloatArray, Signals]
"""What the cycles of all windows saw, one window behind the other: (2, n) acceleration by the
drive over the halves of each cycle, rad/s², and the signals."""


class Sensitivity:
    """Derivatives by its parameters of a structure's runs that start in a reference's states."""

    def __init__(self, flight: Flight, structure: Structure, theta: FloatArray,
                 windows: Windows, prediction: Prediction, run: Run) -> None:
        self.flight, self.structure, self.theta, self.windows = flight, structure, theta, windows
        self.prediction, self.run, self.dt = prediction, run, flight.data.dt
        self.cells = windows.cells.ravel()
        self.middle = run.rate.ravel()
        self.angle = None if run.angle is None else \
            run.angle.ravel() + 0.5 * self.dt * self.middle
        self.torque_effects = structure.torque_effects
        self.hidden = [x.reshape(x.shape[0], -1) for x in run.hidden if x is not None]
        self.around = flight.commanded(np.zeros(3)).at(self.cells)

    def derivatives(self, steps: FloatArray) -> FloatArray:
        """(windows * length, len(steps)) by the first coordinates of the fit."""
        dt, structure, turns = self.dt, self.structure, self.angle is not None
        p = structure.natural(self.theta)
        count, first, n = steps.size, int(turns), self.middle.size
        size = first + sum(x.shape[0] for x in self.hidden)
        halves, s = here = self._passed(p)
        force, following = self._forces(here, p)
        by_state, by_rate = np.zeros((n, size)), np.zeros((n, size))
        onward = np.zeros((n, size, size))

        def slopes(signals: Signals, step: float) -> tuple[FloatArray, FloatArray]:
            torque, moved = self._forces((halves, signals), p)
            return (torque - force) / step, (moved - following).T / step

        (slope, moves), (slope_back, moves_back) = (
            slopes(s.replaced(rate=self.middle + step), step)
            for step in (SMALL, -SMALL)
        )
        slope, by_rate[:, first:] = 0.5 * (slope + slope_back), 0.5 * (moves + moves_back)
        if turns:
            by_state[:, 0], onward[:, first:, 0] = slopes(
                s.replaced(angle=required(self.angle) + SMALL), SMALL)
            slope = slope + 0.5 * dt * by_state[:, 0]
            by_rate[:, first:] += 0.5 * dt * onward[:, first:, 0]
            by_rate[:, 0], onward[:, 0, 0] = dt, 1.0
        k = first
        for x in self.hidden:
            for i, value in enumerate(x.copy()):
                step = SMALL * float(np.sqrt(np.mean(value**2))) or 1e-9
                x[i] = value + step
                by_state[:, k], onward[:, first:, k] = slopes(s, step)
                x[i] = value
                k += 1
        columns, bends = np.empty((n, count)), np.zeros((n, count))
        forward, initial = np.zeros((n, size, count)), np.zeros((self.windows.count, size, count))
        bent = [*range(3), *(j for _, where in structure.command_effects
                             for j in range(where.start, where.stop))]
        started = self._initial(p, range(count), bent)
        for j, step in enumerate(steps):
            perturbed_theta = self.theta.copy()
            perturbed_theta[j] += step
            q = structure.natural(perturbed_theta)
            perturbed = self._passed(q) if j in bent else here
            more, later = self._forces(perturbed, q)
            columns[:, j] = (more - force) / step
            forward[:, first:, j] = (later - following).T / step
            initial[:, first:, j] = ((self._initial(q, [j], bent) - started) / step).T
            if j in bent:
                difference = (perturbed[0] - halves) / step
                bends[:, j] = 0.5 * (difference[0] - difference[1])
        if turns:
            forward[:, 0] = dt * dt / 3.0 * bends
        out = np.empty((n, count))
        recursion.freely(
            slope, by_state, by_rate, onward, columns, bends, forward, initial,
            self.flight.sensor_steps(self.windows.starts), self.flight.sensor.noisy, dt,
            self.windows.length, out,
        )
        return np.nan_to_num(out, nan=0.0, posinf=0.0, neginf=0.0)

    def _passed(self, p: FloatArray) -> Passed:
        """What the cycles see at parameters p in their units, along the run."""
        flight = self.flight
        halves, states = (x[:, self.cells] for x in flight.driven(self.structure, p))
        lag, delay = lag_and_delay(p)
        s = with_drive(self.around.replaced(lag=lag, delay=delay), p, halves, states)
        return p[0] * halves, s.replaced(rate=self.middle, angle=self.angle)

    def _forces(self, passed: Passed, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n,) acceleration; (states, n) all hidden states a cycle later."""
        (halves, s), hidden, acting, following = passed, iter(self.hidden), [], []
        for (part, where), start in zip(self.torque_effects, self.run.hidden, strict=True):
            states = None if start is None else next(hidden)
            acting.append((part, p[where], s if states is None else s.replaced(hidden=states)))
            if states is not None:
                following.append(part.effect.advance(states, s, p[where], part.settings))
        force = with_torques(np.mean(halves, axis=0) + p[4] - p[3] * s.rate, acting)
        return force, np.concatenate(following) if following else np.zeros((0, s.rate.size))

    def _initial(self, p: FloatArray, which: range | list[int], bent: list[int]) -> FloatArray:
        """(states, windows) hidden states at the starts, as far as these parameters move them."""
        flight, out, signals = self.flight, [], None
        for (part, where), x in zip(self.torque_effects, self.run.hidden, strict=True):
            if x is None:
                continue
            commanded = 'command' in part.effect.signals
            moves = any(where.start <= j < where.stop or (j in bent and commanded) for j in which)
            if part.effect.wanders or not moves:
                out.append(x[:, :, 0])
                continue
            if signals is None:
                signals = flight.signals(self.structure, p, self.prediction.rate)
            states = required(flight.hidden(part, signals, p[where]).hidden)
            out.append(states[:, self.windows.starts])
        return np.concatenate(out) if out else np.zeros((0, self.windows.count))
