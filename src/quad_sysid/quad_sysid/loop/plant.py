"""The plant as the cascade sees it: one axis with its actuator, delay, sensors and curves.

    w' = (gain * f_command(u(t - delay)) - w) / lag          drive, rad/s²
    rate' = w - damping * rate + bias + f_rate(rate) + f_angle(angle)
    angle' = rate

Motors that are slower than the others have their own lag for their share of the drive. Memories
x' = A x + B inputs, any number of them, stand in the way of the command (lags, modes, play), or
add a torque that follows rate, angle and drive (springs on dampers, loads, drag of moved air).

u(t) is held over each control cycle and changes right after the measurement at its start. The
measured rate and angle are both filtered by the gyro's 2nd-order Butterworth filter (the attitude
filter integrates the filtered rate). cascade.py has the controller, simulation.py the simulation;
from_model.py turns identified effects into curves.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError

ComplexArray = npt.NDArray[np.complex128]

SHORTEST_LAG_S = 1e-5
"""A lag below this counts as none."""


@dataclass(frozen=True, eq=False)
class Curve:
    """A lookup table on a uniform grid, linear between its points.

    x, y are (m,), m >= 2, x ascending in equal steps. Outside it continues with the end slopes.
    """

    x: FloatArray
    y: FloatArray

    @classmethod
    def sampled(cls, function: Callable[[FloatArray], FloatArray], half_width: float,
                step: float) -> Curve:
        """Table of `function` on -half_width..half_width; zero is a grid point."""
        count = max(1, int(np.ceil(half_width / step)))
        x: FloatArray = np.arange(-count, count + 1, dtype=np.float64) * float(step)
        return cls(x, function(x))

    def __call__(self, x: npt.ArrayLike) -> FloatArray:
        """Values at `x`, any shape."""
        step = self.x[1] - self.x[0]
        position = (np.asarray(x, dtype=float) - self.x[0]) / step
        index = np.clip(np.floor(position).astype(int), 0, self.x.size - 2)
        values: FloatArray = self.y[index] + (position - index) * (
            self.y[index + 1] - self.y[index]
        )
        return values

    @property
    def steepest(self) -> float:
        """Largest absolute slope."""
        return float(np.max(np.abs(np.diff(self.y)))) / float(self.x[1] - self.x[0])

    def describing_gain(self, amplitude: float) -> float:
        """Gain for the first harmonic of a sine: the describing function at `amplitude`."""
        phase = (np.arange(256) + 0.5) * (2.0 * np.pi / 256)
        wave = np.sin(phase)
        return float(2.0 * np.mean(self(amplitude * wave) * wave) / amplitude)


@dataclass(frozen=True)
class SlowMotors:
    """The share of the drive, 0..1, from motors with a longer lag."""

    share: float
    lag_s: float


@dataclass(frozen=True, eq=False)
class Memory:
    """x' = a x + b inputs, output c x + d inputs; m states.

    In the way of the command the input is that; beside the drive the inputs are rate, angle and
    drive, and the output is a torque, rad/s².
    """

    a: FloatArray
    """(m, m)."""
    b: FloatArray
    """(m, inputs)."""
    c: FloatArray
    """(m,)."""
    d: FloatArray
    """(inputs,)."""

    @property
    def gain(self) -> float:
        """What a constant command becomes."""
        return float(self.d[0] - self.c @ np.linalg.solve(self.a, self.b[:, 0]))

    @property
    def delay_s(self) -> float:
        """By how much it delays a slow command, s."""
        back = np.linalg.solve(self.a, np.linalg.solve(self.a, self.b[:, 0]))
        return float(self.c @ back) / (self.gain or 1.0)


@dataclass(frozen=True)
class LoopPlant:
    """One axis from the normalised command to the measured rate and angle (module docstring)."""

    gain: float
    """rad/s² per unit command."""
    lag_s: float
    delay_s: float
    damping: float
    """1/s."""
    bias: float
    """rad/s²."""
    gyro_filter_hz: float | None
    dt: float
    """Control cycle, s."""
    rate_curve: Curve | None = None
    """Extra angular acceleration, rad/s², of the rate, rad/s (friction, drag)."""
    angle_curve: Curve | None = None
    """Extra angular acceleration, rad/s², of the angle, rad (pendulum)."""
    command_curve: Curve | None = None
    """Effective command over command (dead zone, thrust curve)."""
    slow: tuple[SlowMotors, ...] = ()
    before: tuple[Memory, ...] = ()
    """In the way of the command, one after the other."""
    beside: tuple[Memory, ...] = ()
    """Torques with a memory."""

    def __post_init__(self) -> None:
        """Check that all numbers are finite and times not negative; raises BadInputError."""
        numbers = (self.gain, self.lag_s, self.delay_s, self.damping, self.bias, self.dt)
        if not np.isfinite(numbers).all():
            raise BadInputError('LoopPlant', 'all parameters must be finite', numbers)
        if self.lag_s < 0 or self.delay_s < 0 or self.dt <= 0:
            raise BadInputError('LoopPlant',
                                'lag and delay must not be negative, dt must be positive',
                                (self.lag_s, self.delay_s, self.dt))
        filter_hz = self.gyro_filter_hz
        if filter_hz is not None and not (np.isfinite(filter_hz) and filter_hz > 0):
            raise BadInputError('LoopPlant', 'gyro_filter_hz must be positive or None', filter_hz)

    @property
    def remembers(self) -> bool:
        """Whether it has a memory, which is linear at some amplitude."""
        return bool(self.before or self.beside)

    @property
    def bends(self) -> bool:
        """Whether it answers to small motion otherwise than to wide."""
        curves = (self.rate_curve, self.angle_curve, self.command_curve)
        return self.remembers or any(curve is not None for curve in curves)

    @property
    def whole_delay(self) -> int:
        """Whole control cycles of the delay."""
        return int(np.floor(self.delay_s / self.dt + 1e-9))

    @property
    def rest_delay_s(self) -> float:
        """Remainder of the delay, 0 <= s < dt."""
        return max(0.0, self.delay_s - self.whole_delay * self.dt)


@dataclass(frozen=True)
class Slopes:
    """Gains in place of the three curves in a linear model (0, 0, 1: no curves)."""

    rate: float = 0.0
    angle: float = 0.0
    command: float = 1.0


def slopes_at(plant: LoopPlant, rate: float, angle: float, command: float) -> Slopes:
    """Describing gains of the plant's curves for sines of these amplitudes (rad/s, rad, 1)."""
    return Slopes(
        rate=0.0 if plant.rate_curve is None else plant.rate_curve.describing_gain(rate),
        angle=0.0 if plant.angle_curve is None else plant.angle_curve.describing_gain(angle),
        command=1.0
        if plant.command_curve is None
        else plant.command_curve.describing_gain(command),
    )


def dynamics(plant: LoopPlant, slopes: Slopes) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Continuous state matrices of the delay-free plant.

    States (drive, rate, angle[, filtered rate, filtered angle], slow drives, memories), the filter
    a Butterworth; returns A (n, n), B (n, 2) for the inputs (f_command(u), torque in rad/s²) and
    C (2, n) for (measured rate, angle).
    """
    filtered = plant.gyro_filter_hz is not None
    core = 5 if filtered else 3
    at = core + len(plant.slow)
    n = at + sum(one.c.size for one in (*plant.before, *plant.beside))
    a, b, c, unit = np.zeros((n, n)), np.zeros((n, 2)), np.zeros((2, n)), np.eye(n)
    way, given = np.zeros(n), np.array([1.0, 0.0])  # the command so far, by states and inputs
    for one in plant.before:
        own = slice(at, at + one.c.size)
        a[own, own] = one.a
        a[own] += np.outer(one.b[:, 0], way)
        b[own] += np.outer(one.b[:, 0], given)
        way, given = one.d[0] * way, one.d[0] * given
        way[own] += one.c
        at += one.c.size
    usual = SlowMotors(1.0 - sum(one.share for one in plant.slow), plant.lag_s)
    drives = [0, *range(core, core + len(plant.slow))]
    for i, motors in zip(drives, (usual, *plant.slow), strict=True):
        lag = max(motors.lag_s, SHORTEST_LAG_S)
        push = plant.gain * slopes.command * motors.share / lag
        a[i], b[i] = push * way, push * given
        a[i, i] -= 1.0 / lag
    a[1, drives], a[1, 1], a[1, 2] = 1.0, slopes.rate - plant.damping, slopes.angle
    b[1, 1], a[2, 1] = 1.0, 1.0
    inputs = np.stack([unit[1], unit[2], unit[drives].sum(axis=0)])
    for one in plant.beside:
        own = slice(at, at + one.c.size)
        a[own, own] = one.a
        a[own] += one.b @ inputs
        a[1] += one.d @ inputs
        a[1, own] += one.c
        at += one.c.size
    c[0, 3 if filtered else 1] = 1.0
    c[1, 4 if filtered else 2] = 1.0
    if plant.gyro_filter_hz is not None:
        cutoff = 2.0 * np.pi * plant.gyro_filter_hz
        a[3, 2], a[3, 3], a[3, 4] = cutoff**2, -np.sqrt(2.0) * cutoff, -(cutoff**2)
        a[4, 3] = 1.0
    return a, b, c


def exact_step(a: FloatArray, b: FloatArray, step_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Transition (..., n, n) and input (..., n, m) matrices over step_s (...) of held inputs."""
    n, m = b.shape[-2:]
    steps = np.asarray(step_s, dtype=float)
    block = np.zeros((*np.broadcast_shapes(a.shape[:-2], steps.shape), n + m, n + m))
    block[..., :n, :n] = a
    block[..., :n, n:] = b
    exact = _exponential(block * steps[..., None, None])
    return exact[..., :n, :n].copy(), exact[..., :n, n:].copy()


def _exponential(matrix: FloatArray) -> FloatArray:
    """Matrix exponential of a stack (..., n, n): Taylor to order 14, scaled and squared.

    scipy's expm handles one matrix at a time, which is 100 times slower on a busy machine.
    Source: Moler and Van Loan, SIAM Review 45 (2003), method 3.
    """
    norm = np.max(np.sum(np.abs(matrix), axis=-1), axis=-1, initial=0.0)
    squarings = max(0, int(np.ceil(np.log2(max(float(np.max(norm)), 1e-300)))) + 1)
    scaled = matrix / 2.0**squarings
    one = np.eye(matrix.shape[-1])
    total = np.broadcast_to(one, matrix.shape)
    for order in range(14, 0, -1):
        total = one + scaled @ total / order
    for _ in range(squarings):
        total = total @ total
    return np.asarray(total)


@dataclass(frozen=True)
class Step:
    """One control cycle of several plants: x+ = phi x + now u[k-d] + before u[k-d-1].

    phi (p, n, n); now, before (p, n); c (p, 2, n); whole (p,) is d. Exact for a held command and
    any delay; the linear part only, curves by `slopes`.
    """

    phi: FloatArray
    now: FloatArray
    before: FloatArray
    c: FloatArray
    whole: npt.NDArray[np.int64]
    dt: float

    def with_delay(self) -> tuple[FloatArray, FloatArray]:
        """(p, m, m) and (p, m) of a cycle with the commands under way as states behind the n."""
        p, n = self.phi.shape[:2]
        depth = int(self.whole.max()) + 1
        a, b = np.zeros((p, n + depth, n + depth)), np.zeros((p, n + depth))
        a[:, :n, :n], b[:, n] = self.phi, 1.0
        a[:, n + 1 :, n:-1] = np.eye(depth - 1)
        for i, late in enumerate(self.whole.tolist()):
            a[i, :n, n + late] = self.before[i]
            if late:
                a[i, :n, n + late - 1] = self.now[i]
            else:
                b[i, :n] = self.now[i]
        return a, b

    def response(self, omega: FloatArray) -> ComplexArray:
        """(2, p, f) discrete frequency response of measured rate and angle at omega, rad/s."""
        z = np.exp(1j * omega * self.dt)
        n = self.phi.shape[-1]
        delay = z[None, :] ** -self.whole[:, None].astype(float)
        right = (
            self.now[:, None, :] * delay[..., None]
            + self.before[:, None, :] * (delay / z)[..., None]
        )
        left = z[None, :, None, None] * np.eye(n) - self.phi[:, None]
        states = np.linalg.solve(left, right[..., None])[..., 0]
        return np.asarray(np.einsum('pon,pfn->opf', self.c, states))


def exact_cycles(plants: Sequence[LoopPlant], slopes: Sequence[Slopes]) -> Step:
    """Exact control cycle of plants with one dt and filter; missing states are added, at rest."""
    dt = plants[0].dt
    if len({(p.dt, p.gyro_filter_hz is None) for p in plants}) > 1:
        raise BadInputError('exact_cycles', 'plants must share dt and filter')
    parts = [dynamics(p, s) for p, s in zip(plants, slopes, strict=True)]
    n = max(len(part[0]) for part in parts)
    a, b = np.zeros((len(parts), n, n)), np.zeros((len(parts), n, 1))
    a[:, range(n), range(n)] = -1.0
    for i, (own, into, _) in enumerate(parts):
        a[i, : len(own), : len(own)], b[i, : len(own)] = own, into[:, :1]
    rest = np.array([p.rest_delay_s for p in plants])
    _, late = exact_step(a, b, rest)
    remain, now = exact_step(a, b, dt - rest)
    phi, _ = exact_step(a, b, np.full(len(plants), dt))
    return Step(phi=phi, now=now[..., 0], before=np.einsum('pij,pj->pi', remain, late[..., 0]),
                c=np.stack([np.pad(part[2], ((0, 0), (0, n - part[2].shape[1])))
                            for part in parts]),
                whole=np.array([p.whole_delay for p in plants], dtype=np.int64), dt=dt)


@dataclass(frozen=True)
class StateSpace:
    """x+ = a x + b u, y = c x; y = (measured rate, measured angle); delay states at the end."""

    a: FloatArray
    b: FloatArray
    c: FloatArray
    dt: float


def state_space(plant: LoopPlant, slopes: Slopes | None = None) -> StateSpace:
    """The linearised plant with its delay as states (n + d + 1): core, u[k-1], ..., u[k-d-1].

    `slopes` stand for the curves (None: no curves). Source: Franklin, Powell, Workman, Digital
    Control of Dynamic Systems, 3rd ed., section 4.3 (delay that is not a whole number of cycles).
    """
    cycle = exact_cycles([plant], [slopes or Slopes()])
    a, b = cycle.with_delay()
    n = cycle.phi.shape[-1]
    c = np.pad(cycle.c[0], ((0, 0), (0, a.shape[-1] - n)))
    return StateSpace(a[0], b[0][:, None], c, plant.dt)
