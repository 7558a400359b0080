"""A third simulator, for effects that people outside the project wrote: three axes at 1 kHz.

It shares no line with the analysis or with the virtual STM32. An effect is a class with a
`step(situation) -> Change`, called once per millisecond; it keeps its state in itself and is
deterministic, so that a deep copy of it goes on as it would have done. What its writer knew of the
aircraft is below: the data sheet.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

H = 0.001
CYCLE = 4
DT = H * CYCLE
MIX = np.array([[1.0, 1.0, 1.0, 1.0], [1.0, -1.0, 1.0, -1.0], [1.0, -1.0, -1.0, 1.0],
                [1.0, 1.0, -1.0, -1.0]])
"""(motor, U1..U4)."""
UNMIX = MIX.T / 4.0
SIDE = ((1.0, -1.0, -1.0, 1.0), (1.0, 1.0, -1.0, -1.0), (1.0, -1.0, 1.0, -1.0))
"""By axis: +1 where the thrust of the motor turns it up."""
GAIN_OF = (450.0, 400.0, 60.0)
"""rad/s² per unit command of roll, pitch, yaw."""
GAIN = np.array(GAIN_OF)
DAMPING = np.array([0.5, 0.5, 0.3])
LAG_S = 0.042
DELAY_CYCLES = 2
FILTER_HZ = 80.0
GYRO_NOISE = 0.05
"""White, before the filter, rad/s each millisecond."""
TORQUE_NOISE = 0.03
"""(rad/s²)/√Hz"""
GUST, GUST_S = 0.25, 0.4
"""RMS in rad/s² and correlation time in s of the slow disturbance."""
AXES = ('roll', 'pitch', 'yaw')
G = 9.81
MASS = 1.2
"""kg"""
INERTIA = 0.012
"""kg m², about roll or pitch."""
HOVER = 0.5
"""Command and thrust of a motor in hover."""


def drive(speed, axis):
    """Angular acceleration that the motors deliver about an axis, rad/s²."""
    a, b, c, d = speed.tolist()
    p, q, r, t = SIDE[axis]
    return 0.25 * GAIN_OF[axis] * (p * a + q * b + r * c + t * d)


@dataclass
class Situation:
    """The state that an effect may depend on, at one millisecond."""

    t: float
    """s from the start of the flight."""
    dt: float
    """0.001 s"""
    rate: np.ndarray
    """(3,) true body rates, rad/s: roll, pitch, yaw."""
    angle: np.ndarray
    """(3,) true roll, pitch, yaw, rad."""
    command: np.ndarray
    """(4,) motor commands 0..1 as they arrive at the motors now."""
    speed: np.ndarray
    """(4,) command behind the motors' lag (42 ms), 0..1. The
    thrust of a motor is proportional to it."""
    acceleration: np.ndarray
    """(3,) angular acceleration of the last millisecond, rad/s²."""
    throttle: float
    """Mean of the four commands; about 0.5 in hover."""
    battery_v: float
    """12.6 falling to 11.4 V."""
    axis: int
    """The axis that is excited: 0 roll, 1 pitch."""


@dataclass
class Change:
    """The changes that an effect makes during that millisecond; all are optional."""

    torque: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """(3,) angular acceleration that it adds, rad/s²."""
    command: np.ndarray | None = None
    """(4,) motor commands instead of those that arrived."""
    thrust: np.ndarray | None = None
    """(4,) factors of the motors' thrusts."""
    lag: np.ndarray | None = None
    """(4,) factors of the motors' lag."""
    gyro: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """(3,) error of the gyro, added before its filter, rad/s."""


@dataclass(frozen=True)
class Plant:
    """An effect and its origin."""

    name: str
    effect: Callable[[float], object]
    """Function that makes the effect at a strength."""
    opened: str
    """The set with which it was opened, of SETS."""
    place: int
    """Number in that set, from which the seed of its flights follows."""
    rig: bool
    """Whether it flies on a rig of one axis, and not freely."""
    may_be: tuple[str, ...] = ()
    """Names of the project's table that describe it truly, or cannot be distinguished from it."""


class Nothing:
    """No effect."""

    def step(self, s: Situation) -> Change:  # noqa: ARG002 - the interface of all effects
        return Change()


class Aircraft:
    """State of the aircraft; `step` moves it by a millisecond."""

    def __init__(self, effect, axis: int, rig: bool) -> None:
        self.effect, self.axis = effect, axis
        self.rate, self.angle, self.acceleration = np.zeros(3), np.zeros(3), np.zeros(3)
        self.speed = np.full(4, HOVER)
        self.seen, self.seen_slope = np.zeros(3), np.zeros(3)
        self.free = np.array([i == axis or not rig for i in range(3)], dtype=float)
        self.fade = math.exp(-H / LAG_S)
        self.w = 2.0 * math.pi * FILTER_HZ

    def step(self, t, command, volts, push, noise) -> None:
        """push (3,) disturbance rad/s², noise (3,) of the gyro, rad/s."""
        change = self.effect.step(Situation(
            t, H, self.rate, self.angle, command, self.speed, self.acceleration,
            float(command.mean()), volts, self.axis,
        ))
        if change.command is not None:
            command = change.command
        fade = self.fade if change.lag is None else np.exp(-H / (LAG_S * change.lag))
        before = self.speed
        self.speed = command + (before - command) * fade
        thrust = 0.5 * (before + self.speed)
        if change.thrust is not None:
            thrust = thrust * change.thrust
        known = GAIN * (UNMIX[1:] @ thrust) + push + change.torque
        # implicit midpoint of the damping
        new = (self.rate * (1.0 - 0.5 * H * DAMPING) + H * known * self.free) / (
            1.0 + 0.5 * H * DAMPING)
        self.acceleration = (new - self.rate) / H
        self.angle = self.angle + 0.5 * H * (self.rate + new)
        self.rate = new
        shown = new + change.gyro + noise
        for _ in range(4):
            self.seen_slope = self.seen_slope + 0.25 * H * self.w * (
                self.w * (shown - self.seen) - math.sqrt(2.0) * self.seen_slope)
            self.seen = self.seen + 0.25 * H * self.seen_slope


@dataclass
class Flown:
    """One flight, sampled at 250 Hz."""

    rates: np.ndarray
    angles: np.ndarray
    motors: np.ndarray
    battery_v: np.ndarray
    reference: np.ndarray
    segments: tuple
    """(role, signal, start, end) in s."""
    copies: dict
    """Cycle → the aircraft as it was at its start."""


TRAINING = (('train', 'prbs', 40.0), ('validation', 'prbs', 18.0), ('validation', 'square', 16.0))
UNSEEN = (('validation', 'prbs', 20.0), ('validation', 'square', 15.0))


def references(rng, plan, axis, rig):
    """(n, 3) attitude references, rad, and the segments."""
    pieces, segments, time = [np.zeros(500)], [('idle', 'none', 0.0, 2.0)], 2.0
    for role, signal, seconds in plan:
        n = round(seconds / DT)
        if signal == 'square':
            wave = 0.2 * np.where((np.arange(n) // 375) % 2 == 0, 1.0, -1.0)
        else:
            wave = np.empty(0)
            while wave.size < n:
                held = int(rng.integers(20, 175))
                wave = np.r_[wave, np.full(held, 0.2 * rng.choice([-1.0, -0.4, 0.4, 1.0]))]
        pieces += [wave[:n], np.zeros(250)]
        segments.append((role, signal, time, time + seconds))
        segments.append(('idle', 'none', time + seconds, time + seconds + 1.0))
        time += seconds + 1.0
    own = np.concatenate(pieces)
    out = np.zeros((own.size, 3))
    out[:, axis] = own
    for other in range(3):
        k = 500
        while other != axis and not rig and k < own.size:
            held = int(rng.integers(60, 400))
            out[k : k + held, other] = rng.uniform(-0.15, 0.15)
            k += held
    return out, tuple(segments)


def fly(
    effect, seed: int, *, axis: int = 0, rig: bool = True, plan=TRAINING, noise: float = 1.0
) -> Flown:
    """One flight; the same seed gives the same noise (times `noise`), reference and throttle."""
    rng = np.random.default_rng([seed, len(plan)])
    reference, segments = references(rng, plan, axis, rig)
    n = reference.shape[0]
    gyro = noise * GYRO_NOISE * rng.standard_normal((n * CYCLE, 3))
    white = noise * TORQUE_NOISE / math.sqrt(H) * rng.standard_normal((n * CYCLE, 3))
    keep = math.exp(-H / GUST_S)
    steps = noise * GUST * math.sqrt(1.0 - keep**2) * rng.standard_normal((n * CYCLE, 3))
    throttle = np.full(n, 0.5)
    k = 500
    while k < n:
        held = int(rng.integers(200, 1200))
        throttle[k : k + held] = rng.uniform(0.42, 0.6)
        k += held
    throttle = np.convolve(np.r_[np.full(125, 0.5), throttle], np.full(125, 1 / 125), 'valid')[:n]
    volts = np.linspace(12.6, 11.4, n) - 1.5 * (throttle - 0.5)
    aircraft = Aircraft(copy.deepcopy(effect), axis, rig)
    gust, integral = np.zeros(3), np.zeros(3)
    rates, angles, motors = np.zeros((n, 3)), np.zeros((n, 3)), np.full((n, 4), 0.5)
    kp = np.array([0.06, 0.065, 0.3])
    starts = {round(t / DT) for role, _, a, b in segments if role == 'validation'
              for t in np.arange(a + 1.0, b - 0.5, 0.5)}
    copies = {}
    for k in range(n):
        if k in starts:
            copies[k] = copy.deepcopy(aircraft)
        rates[k], angles[k] = aircraft.seen, aircraft.angle
        wanted = np.clip(3.0 * (reference[k] - angles[k]), -4.0, 4.0)
        e = wanted - rates[k]
        integral = np.clip(integral + DT * 0.02 * kp * e, -0.05, 0.05)
        u = np.clip(kp * e + integral, -0.3, 0.3) * aircraft.free
        motors[k] = np.clip(MIX @ np.r_[throttle[k], u], 0.0, 1.0)
        arrived = motors[max(k - DELAY_CYCLES, 0)]
        for i in range(CYCLE):
            j = k * CYCLE + i
            gust = keep * gust + steps[j]
            aircraft.step(j * H, arrived, float(volts[k]), gust + white[j], gyro[j])
    return Flown(rates, angles, motors, volts, reference, segments, copies)


def foreseen(flown: Flown, axis: int) -> float:
    """RMS error, rad/s, of the true equations over windows of 0.5 s from the commands alone."""
    length, errors = round(0.5 / DT), []
    zero = np.zeros(3)
    for start, kept in flown.copies.items():
        aircraft = copy.deepcopy(kept)
        for k in range(start, start + length):
            if k >= flown.rates.shape[0]:
                break
            errors.append(aircraft.seen[axis] - flown.rates[k, axis])
            arrived = flown.motors[max(k - DELAY_CYCLES, 0)]
            for i in range(CYCLE):
                aircraft.step((k * CYCLE + i) * H, arrived, float(flown.battery_v[k]), zero, zero)
    return math.sqrt(float(np.mean(np.square(errors))))
