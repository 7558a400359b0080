"""What turns the axis besides the drive: terms of rate, angle, other axes and time, per effect."""

from __future__ import annotations

import math

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.effects.commands import held_step
from quad_sysid.greybox import kernels
from quad_sysid.greybox.data import AxisData
from quad_sysid.greybox.structure import Settings, Term

STICTION_RATE = 0.01
"""Rate over which a friction torque changes its sign, rad/s: below any gyro's noise."""


def drag(_: AxisData, p: FloatArray, __: Settings) -> Term:
    """-k rate |rate|."""
    return Term(kernels.QUADRATIC, (p[0],))


def coulomb(data: AxisData, p: FloatArray, _: Settings) -> Term:
    """-T sign(rate)."""
    # the slope at rest must not outrun the integration step of one cycle
    return Term(kernels.COULOMB, (p[0], max(STICTION_RATE, abs(p[0]) * data.dt)))


def pendulum(_: AxisData, p: FloatArray, __: Settings) -> Term:
    """-k sin(angle)."""
    return Term(kernels.PENDULUM, (p[0],))


def cubic(_: AxisData, p: FloatArray, __: Settings) -> Term:
    """-k angle³."""
    return Term(kernels.CUBIC, (p[0],))


def other_rate(data: AxisData, p: FloatArray, settings: Settings) -> Term:
    """H times another axis' rate."""
    column = settings['column']
    signal = data.other_rates[:, int(column) if isinstance(column, float) else 0]
    return Term(kernels.SIGNAL, (p[0],), _mid(signal))


def rate_product(data: AxisData, p: FloatArray, _: Settings) -> Term:
    """C times the product of the other two rates (Euler's equations)."""
    return Term(kernels.SIGNAL, (p[0],), _mid(data.other_rates[:, 0] * data.other_rates[:, 1]))


def periodic(data: AxisData, p: FloatArray, _: Settings) -> Term:
    """A sin(2 pi f t + phase), t from the record's first sample."""
    t = (np.arange(data.rate.size) + 0.5) * data.dt
    return Term(kernels.SIGNAL, (p[0],), np.sin(2.0 * math.pi * p[1] * t + p[2]))


def step_torque(data: AxisData, p: FloatArray, _: Settings) -> Term:
    """A torque that sets in at a time."""
    return Term(kernels.SIGNAL, (p[1],), after(data, float(p[0])))


def slow_state(data: AxisData, p: FloatArray, _: Settings) -> Term:
    """A spring on a damper: y' = -k rate - y / tau."""
    a = np.array([[-1.0 / max(float(p[1]), data.dt), 0.0], [0.0, -1.0]])
    return _hidden(a, np.array([-float(p[0]), 0.0]), np.array([1.0, 0.0]), data.dt)


def swinging(data: AxisData, p: FloatArray, _: Settings) -> Term:
    """Something that swings along: z'' + 2 d w z' + w² z = w rate; torque a w z + b z'."""
    omega, damping = 2.0 * math.pi * float(p[0]), float(p[1])
    a = np.array([[0.0, 1.0], [-(omega**2), -2.0 * damping * omega]])
    weights = np.array([float(p[2]) * omega, float(p[3])])
    return _hidden(a, np.array([0.0, omega]), weights, data.dt)


def hysteresis(data: AxisData, p: FloatArray, _: Settings) -> Term:
    """-T z, z' = rate / reach (1 - z sign(rate)): friction that builds up over an angle (Dahl)."""
    return Term(kernels.HYSTERESIS, (float(p[0]), data.dt / max(float(p[1]), 1e-4)))


def pulse_torque(data: AxisData, p: FloatArray, _: Settings) -> Term:
    """A torque that acts from a time on for a while."""
    shape = after(data, float(p[0])) - after(data, float(p[0]) + float(p[1]))
    return Term(kernels.SIGNAL, (p[2],), shape)


def _hidden(a: FloatArray, b: FloatArray, c: FloatArray, dt: float) -> Term:
    """A hidden state x' = a x + b rate with torque c x, exact for a rate held over the step."""
    whole, drive = held_step(a, b, dt)
    half, half_drive = held_step(a, b, 0.5 * dt)
    values = np.concatenate([whole.ravel(), drive, half.ravel(), half_drive, c])
    return Term(kernels.HIDDEN, tuple(values.tolist()))


def after(data: AxisData, time_s: float) -> FloatArray:
    """(n,) share of each cycle that lies after a time, 0..1."""
    k = np.arange(data.rate.size)
    out: FloatArray = np.clip(k + 1.0 - time_s / data.dt, 0.0, 1.0)
    return out


def _mid(signal: FloatArray) -> FloatArray:
    """The value at half of each cycle, from both its ends; zero where not measured."""
    following = np.append(signal[1:], signal[-1:])
    out: FloatArray = np.nan_to_num(0.5 * (signal + following))
    return out
