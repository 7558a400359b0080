"""The firmware's second control mode, state feedback: its parameters and its loop.

    drive' = (gain u(t - delay) - drive) / lag,  rate' = drive - damping rate,  angle' = rate
    u = k_angle e - k_rate rate - k_drive drive + k_integral xi,  e = reference - angle, xi' = e

An observer corrects the model's rate by the measured one; the states are predicted over the delay
with the commands in it. The steps are those of the firmware. lqr.py finds the parameters.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.loop.cascade import CascadeGains, Dynamics, Linear
from quad_sysid.loop.linear import ComplexArray
from quad_sysid.loop.plant import Flying
from quad_sysid.loop.simulation import LoopResponse, running
from quad_tuning.bounds import check_bounds
from quad_tuning.errors import DesignRefusedError
from quad_tuning.gain_table import OPTIONAL

DRIVE, RATE, TOTAL, COMMANDS = range(4)

PARAMETERS = tuple(row.name.removeprefix('lqr.') for row in OPTIONAL
                   if row.name.startswith('lqr.') and row.name != 'lqr.share')
"""Fields of StateFeedback that the firmware has as gains."""


@dataclass(frozen=True)
class StateFeedback:
    """Parameters of one axis, names and units as on the wire (`<axis>.lqr.<name>`)."""

    k_angle: float
    """Command per rad."""
    k_rate: float
    """Command per rad/s."""
    k_drive: float
    """Command per rad/s²."""
    k_integral: float
    """Command per rad s."""
    gain: float
    """rad/s² per unit command."""
    lag_s: float
    delay_s: float
    """Whole control cycles; the gyro filter's delay is in it."""
    damping: float
    """1/s."""
    observer: float
    """Share of the difference between measured and predicted rate that corrects the rate."""
    dt: float
    output_limit: float

    @property
    def late(self) -> int:
        """The delay in control cycles."""
        return int(np.floor(self.delay_s / self.dt + 0.5))

    @property
    def size(self) -> int:
        """Number of states: drive, rate, integral, the commands in the delay."""
        return COMMANDS + self.late

    def to_mapping(self, axis: str) -> dict[str, float]:
        """Parameters by the contract's names; DesignRefusedError where one is out of bounds."""
        gains = {f'{axis}.lqr.{name}': float(getattr(self, name)) for name in PARAMETERS}
        try:
            check_bounds(gains)
        except DesignRefusedError as refusal:
            raise DesignRefusedError(f'{refusal}; take the cascade (--method pid)') from refusal
        return {**gains, f'{axis}.lqr.share': 1.0}

    def command(self, x: FloatArray, rate: float, error: float) -> tuple[float, FloatArray]:
        """The command before limits, and the states (size,) corrected by the measured rate."""
        x = x.copy()
        x[RATE] += self.observer * (rate - x[RATE])
        drive, speed, total = x[DRIVE], x[RATE], x[TOTAL]
        for j in range(self.late):
            following, after = self._moved(drive, speed, x[COMMANDS + self.late - 1 - j])
            total += self.dt * error
            error -= 0.5 * self.dt * (speed + after)
            drive, speed = following, after
        u = self.k_angle * error - self.k_rate * speed - self.k_drive * drive
        return float(u + self.k_integral * total), x

    def moved(self, x: FloatArray, error: float, u: float, *, limited: bool = False) -> FloatArray:
        """States (size,) of the next cycle; `limited`: the integral does not change."""
        commands = np.concatenate(([u], x[COMMANDS:]))
        following, after = self._moved(x[DRIVE], x[RATE], commands[self.late])
        total = x[TOTAL] + (0.0 if limited else self.dt * error)
        return np.concatenate(([following, after, total], commands[: self.late]))

    def _moved(self, drive: float, speed: float, command: float) -> tuple[float, float]:
        following = drive + -np.expm1(-self.dt / self.lag_s) * (self.gain * command - drive)
        slope = 0.5 * (drive + following) - self.damping * speed
        return following, speed + self.dt * slope

    def dynamics(self, dt: float = 0.0) -> Dynamics:
        """The linear controller, of its own cycle, from what each state and measurement does."""
        del dt
        n = self.size
        columns, outputs = [], []
        for unit in np.eye(n + 2):
            x, rate, angle = unit[:n], unit[n], unit[n + 1]
            u, corrected = self.command(x, rate, -angle)
            columns.append(self.moved(corrected, -angle, u))
            outputs.append(u)
        a, c = np.array(columns).T, np.array(outputs)[None]
        return a[:, :n], a[:, n:], c[:, :n], c[:, n:]

    def response(self, omega: FloatArray, dt: float) -> ComplexArray:
        """(2, f) from the measured rate and angle to u at omega, rad/s, at reference 0."""
        return Linear(self.dynamics()).response(omega, dt)


def beside(feedback: StateFeedback, gains: CascadeGains, share: float) -> Linear:
    """`share` of the feedback and the rest of the cascade, as the firmware mixes them.

    Only the feedback's integral runs; the cascade's follows it.
    """
    one, other = feedback.dynamics(), replace(gains, rate_ki=0.0).dynamics(feedback.dt)
    n, m = one[0].shape[0], other[0].shape[0]
    a, b = np.zeros((n + m, n + m)), np.vstack([one[1], other[1]])
    a[n:, n:] = other[0]
    c = np.hstack([share * one[2], (1.0 - share) * other[2]])
    c[0, TOTAL] += (1.0 - share) * feedback.k_integral
    d = share * one[3] + (1.0 - share) * other[3]
    # the observer hears of the command that is flown, not of its own
    of_measured = np.zeros((n, 1))
    of_measured[:, 0] = feedback.moved(np.zeros(n), 0.0, 1.0)
    a[:n, :n] = one[0] - of_measured @ one[2]
    b[:n] = one[1] - of_measured @ one[3] + of_measured @ d
    a[:n] += of_measured @ c
    return Linear((a, b, c, d))


def simulate(flying: Flying, controller: StateFeedback, reference: FloatArray,
             start_angle: float = 0.0, torque: float = 0.0,
             noise: FloatArray | None = None) -> LoopResponse:
    """Measured angle and rate, and the limited command, around a plant.

    torque, rad/s², acts all the time; noise (n,) rad/s is on the measured rate. There is no rate
    reference: it is NaN.
    """
    now, own = running(flying, angle=start_angle), np.zeros(controller.size)
    out = np.full((4, reference.size), np.nan)
    for k, angle_reference in enumerate(reference):
        angle, rate = now.angle, now.rate + (0.0 if noise is None else noise[k])
        error = angle_reference - angle
        raw, own = controller.command(own, rate, error)
        u = min(max(raw, -controller.output_limit), controller.output_limit)
        own = controller.moved(own, error, u, limited=u != raw)
        now.step(u, torque)
        out[:3, k] = angle, rate, u
    return LoopResponse(*out)
