"""A plant as a linear loop sees it: every effect as the linear one that moves most like it.

On a motion of the amplitudes at which a loop is judged, each effect's law is fitted by least
squares: for a sine that is its describing function, and what is linear stays as it is. The plant
with these linear effects is flown by its own laws, a cycle from each unit of its states. Nothing
stands twice; from_model.py says which effects are in a loop, cascade.py what margins it has.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from quad_sysid.axes import TURNING, Level
from quad_sysid.contract import FloatArray
from quad_sysid.effects.actuators import Following, Steps
from quad_sysid.effects.hidden import Linear
from quad_sysid.loop.likeness import LinearChannels, LinearMap, LinearTorque
from quad_sysid.loop.plant import Flying
from quad_sysid.model.effect import SMALL, Drive, Effect, Part, Signals, required
from quad_sysid.model.plant import flat, unflat
from quad_sysid.model.structure import Structure

ComplexArray = npt.NDArray[np.complex128]
WIDE = TURNING.wide
"""Amplitudes of rate (rad/s), angle (rad) and command at which a loop is linearised."""
STILL: Level = (2e-7, 2e-8, 1e-8)
"""Next to none: the slope at rest."""
TONES = (0.41, 1.0, 2.17)
"""Frequencies of the motion that a memory sees, over rate / angle; one without a memory, 1."""
LEAST, MOST = 64, 2000
"""Cycles of the motion."""
FEW_STATES = 2
"""Up to so many, a memory is fitted on the motion; more of them by small steps."""


@dataclass(frozen=True, eq=False)
class Loops:
    """One control cycle of p linear plants: x+ = a x + b u; y = c x, measured rate and angle."""

    a: FloatArray
    """(p, n, n)."""
    b: FloatArray
    """(p, n)."""
    c: FloatArray
    """(p, 2, n)."""
    dt: float

    def response(self, omega: FloatArray) -> ComplexArray:
        """(2, p, f) frequency response at omega (f,), rad/s."""
        turns = np.exp(1j * omega * self.dt)[:, None, None] * np.eye(self.b.shape[1])
        # plant by plant, as the matrices of all would leave the cache
        return np.stack([c @ np.linalg.solve(turns - a, b[:, None])[..., 0].T
                         for a, b, c in zip(self.a, self.b, self.c, strict=True)], axis=1)

    def subset(self, index: npt.NDArray[np.int64]) -> Loops:
        """The loops of `index` alone."""
        return Loops(self.a[index], self.b[index], self.c[index], self.dt)


def loops_of(every: Sequence[tuple[Flying, Level]]) -> Loops:
    """Plants of one control cycle, each linear at its amplitudes."""
    cycles = [_cycle(linear(flying, level)) for flying, level in every]
    n = max(len(b) for _, b, _ in cycles)
    a, b, c = (np.zeros((len(cycles), *shape)) for shape in ((n, n), (n,), (2, n)))
    for i, (matrix, inputs, output) in enumerate(cycles):
        m = len(inputs)
        a[i, :m, :m], b[i, :m], c[i, :, :m] = matrix, inputs, output
    return Loops(a, b, c, every[0][0].dt)


def _cycle(flying: Flying) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A cycle of a plant that is linear, without the states that nothing asks for."""
    plant, start = flying.plant, flying.begin()
    still = flat(start)[:, 0]
    n = still.size
    start_states = np.column_stack([still[:, None] + np.eye(n), still, still])
    sent = np.r_[np.zeros(n), 1.0, 0.0]
    x = unflat(start_states, start)
    after = flat(plant.step(x, _many(flying.around, n + 2, sent)))
    after = after - after[:, -1:]
    outputs = np.stack([required(signal) for signal in plant.measured(x)])
    outputs = outputs - outputs[:, -1:]
    a, b, c = after[:, :n], after[:, n], outputs[:, :n]
    while True:
        inner = a - np.diag(np.diag(a))
        connected = (np.abs(inner).sum(axis=0) + np.abs(c).sum(axis=0)) > 0.0
        if connected.all():
            return a, b, c
        states = np.flatnonzero(connected)
        a, b, c = a[np.ix_(states, states)], b[states], c[:, states]


def _many(around: Signals, n: int, sent: FloatArray) -> Signals:
    """The signals around, of n plants, which are sent different commands."""
    return around.at(np.zeros(n, dtype=np.int64)).replaced(sent=sent)


def linear(flying: Flying, level: Level) -> Flying:
    """The plant with each effect replaced by its linear likeness in motion of these amplitudes."""
    plant = flying.plant
    by_law = plant.structure.law is not None and not plant.p[0]
    if by_law:  # which alone takes the command: at unit gain, less what that gain drives
        plant = replace(plant, p=np.r_[1.0, plant.p[1:]])
        flying = replace(flying, plant=plant)
    torques = [_torque(flying, part, p, level) for part, p in plant.torque_effects]
    if by_law:
        torques[0].rows[-1, torques[0].states + 2] -= 1.0
    parts = [*_commands(flying, level[2]), *map(Part, torques)]
    p = np.r_[plant.p[:4], 0.0]
    linearised = replace(plant, structure=Structure(tuple(parts)), p=p, rounds=1)
    return replace(flying, plant=linearised)


def linear_part(flying: Flying) -> Flying:
    """The plant with only those effects that respond alike in small and in wide motion."""
    plant, linear = flying.plant, []
    bare = replace(plant.structure, parts=())
    p = [plant.p[: len(bare.base)]]
    for part, where in plant.structure.effects:
        single = replace(flying, plant=replace(
            plant, structure=bare.plus(part), p=np.r_[p[0], plant.p[where]]))
        still, wide = (loops_of([(single, level)]) for level in (STILL, WIDE))
        if still.a.shape == wide.a.shape and np.allclose(
                still.a, wide.a, rtol=1e-3, atol=1e-6) and np.allclose(
                still.b, wide.b, rtol=1e-3, atol=1e-6):  # else one of them has states that rest
            linear.append(part)
            p.append(plant.p[where])
    return replace(flying, plant=replace(plant, structure=replace(bare, parts=tuple(linear)),
                                         p=np.concatenate(p)))


def _tones(dt: float, frequency: float, several: bool) -> tuple[FloatArray, FloatArray]:
    """Phases (n, tones) of a motion about a frequency, rad/s, and the tones' ratios to it."""
    tones = np.array(TONES if several else (1.0,))
    cycles = math.ceil(8.0 * np.pi / (frequency * tones[0] * dt))  # four swings of the slowest
    n = min(max(LEAST, cycles), MOST)
    return np.outer(dt * np.arange(n), frequency * tones), tones


def _fitted(
    x: FloatArray, steady: FloatArray, inputs: FloatArray, outputs: FloatArray
) -> FloatArray:
    """(states + outputs, states + inputs) by least squares on a motion: the columns' rows."""
    regressors = np.column_stack([(x - steady[:, None]).T, inputs.T, np.ones(inputs.shape[1])])
    sizes = np.maximum(np.linalg.norm(regressors, axis=0), 1e-300)
    slopes = np.linalg.lstsq(regressors / sizes, outputs.T, rcond=1e-9)[0] / sizes[:, None]
    return np.asarray(slopes[:-1].T)


def _torque(flying: Flying, part: Part, p: FloatArray, level: Level) -> LinearTorque:
    """A torque's likeness: what it remembers and gives on the motion, or by small steps."""
    effect, settings, plant = part.effect, part.settings, flying.plant
    m, gain, dt, lag = effect.states, plant.p[0], plant.dt, float(plant.p[1])
    around = plant.with_own(flying.around)

    def signals_of(rate: FloatArray, angle: FloatArray, drive: FloatArray,
                   change: FloatArray) -> Signals:
        """Where the command is that which moves the drive so."""
        command = drive + lag * change
        sent = command / gain
        s = _many(around, rate.size, sent)
        return plant.with_motors(s.replaced(rate=rate, angle=angle, drive=drive, change=change,
                                         command=command, lagged=drive / gain))

    def after(x: FloatArray, s: Signals) -> FloatArray:
        """(m + 1, n) the states a cycle later, and the torque meanwhile."""
        signals = s.replaced(hidden=x) if m else s
        torque = np.broadcast_to(required(effect.torque(signals, p, settings)), s.rate.shape)
        return np.vstack([effect.advance(x, signals, p, settings), torque]) if m else torque[None]

    zero = np.zeros(1)
    still = signals_of(zero, zero, zero, zero)
    steady = effect.steady(still, p, settings)[:, 0] if m else np.zeros(0)
    small = min(SMALL, level[2])
    rows = np.zeros((m + 1, m + 4))
    if m > FEW_STATES or isinstance(effect, Linear):
        steps = small * np.eye(m + 4)
        begin = after(steady[:, None], still)
        rows = (after(steady[:, None] + steps[:m], signals_of(*steps[m:])) - begin) / small
    if m <= FEW_STATES:
        w, several = level[0] / level[1], bool(m)
        phases, tones = _tones(dt, w, several)
        size = 1.0 / math.sqrt(tones.size)
        angle = level[1] * size * np.sin(phases).sum(axis=1)
        rate = level[0] * size * (np.cos(phases) * tones).sum(axis=1)
        inside = 1.13 if several else 1.5
        drive = gain * level[2] * size * np.sin(inside * phases + 1.0).sum(axis=1)
        change = gain * level[2] * size * inside * w * (
            np.cos(inside * phases + 1.0) * tones).sum(axis=1)
        s = signals_of(rate, angle, drive, change)
        n = len(phases)
        x = np.zeros((0, n))
        if m:
            initial = np.repeat(steady[:, None], n, axis=1)
            x = effect.trace(s, p, settings, ((0, n),), initial)
        inputs, later = np.stack([rate, angle, drive, change]), after(x, s)
        coefficients = _fitted(x, steady, inputs, later)
        first = m if isinstance(effect, Linear) else 0  # whose states are linear as they are
        rows[first:] = coefficients[first:]
        if m and not first:
            keep = np.stack([(after(x + step[:, None], s) - later)[:m] / SMALL
                             for step in SMALL * np.eye(m)], axis=1)
            if np.allclose(keep, keep[..., :1], rtol=1e-6, atol=1e-9):
                # a fit would give the angle what a linear memory makes of the bend of its inputs
                rows[:m, :m] = keep[..., 0]
                moved = later[:m] - rows[:m, :m] @ (x - steady[:, None])
                rows[:m, m:] = _fitted(x[:0], steady[:0], inputs, moved)
    return LinearTorque(m, rows, steady)


def _commands(flying: Flying, size: float) -> list[Part]:
    """The likeness of all that acts before the torque."""
    plant, dt = flying.plant, flying.dt
    if not plant.command_effects:
        return []
    several = any(part.effect.states for part, _ in plant.command_effects)
    phases, tones = _tones(dt, 2.0 * np.pi, several)
    n = len(phases)
    u = size / math.sqrt(tones.size) * np.sin(phases).sum(axis=1)
    s = plant.with_own(plant.with_motors(_many(flying.around, n, u)))
    sideways = size / math.sqrt(tones.size) * np.cos(1.13 * phases).sum(axis=1)
    drive = Drive(sideways[None], np.ones(1), np.full((1, n), s.lag))
    drive = drive.behind(np.full(n, s.delay / dt))
    parts: list[Part] = []
    for part, p in plant.command_effects:
        effect, settings = part.effect, part.settings
        if effect.states:
            x = effect.begin(s, p, settings)  # in steady state
            drive = effect.actuate(drive, replace(s, hidden=x), p, settings)
            s = replace(s, hidden=effect.trace(s, p, settings, ((0, n),)))
        else:
            drive = effect.actuate(drive, s, p, settings)
        if type(effect).command is not Effect.command:
            likeness = _map(part, p, s)
            parts.append(Part(likeness))
            s = replace(s, sent=effect.command(s, p, settings), hidden=None)
    regressors = np.column_stack([sideways, u, np.ones(n)])
    slopes = np.linalg.lstsq(regressors / size, drive.commands.T, rcond=None)[0][:2].T / size
    ends = np.linspace(-size, size, 41)
    longer = [float(np.max(np.interp(ends, *curve))) for curve in drive.factors]
    lag = drive.lag.mean(axis=1, keepdims=True) * np.exp(longer)[:, None]
    return [Part(LinearChannels(slopes, replace(drive, lag=lag))), *parts]


def _map(part: Part, p: FloatArray, s: Signals) -> LinearMap:
    """A map's likeness on a motion: as it is where it is linear, else of one state or none."""
    effect, settings, m = part.effect, part.settings, part.effect.states
    if isinstance(effect, Following):
        eye, zero = np.eye(m, m + 1), np.eye(1, m + 1, m)[0]
        unit = replace(s.at(np.zeros(m + 1, dtype=np.int64)), sent=zero, hidden=eye)
        rows = np.vstack([effect.advance(eye, unit, p, settings),
                          effect.command(unit, p, settings)])
        return LinearMap(m, rows, np.zeros(m))
    u, out = required(s.sent), effect.command(s, p, settings)
    sizes = max(float(np.abs(u).max()), 1e-300)
    if m and not isinstance(effect, Steps):
        regressors = np.column_stack([out[:-1], u[1:]]) / sizes
        keep, into = np.linalg.lstsq(regressors, out[1:] / sizes, rcond=None)[0]
        keep = float(np.clip(keep, 0.0, 1.0 - 1e-6))
        row = np.array([keep, into])
        return LinearMap(1, np.stack([row, row]), np.zeros(1))
    regressors = np.column_stack([u / sizes, np.ones(u.size)])
    slope = np.linalg.lstsq(regressors, out / sizes, rcond=None)[0][0]
    return LinearMap(0, np.array([[slope]]), np.zeros(0))
