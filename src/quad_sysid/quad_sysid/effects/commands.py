"""What happens to the command between controller and torque: maps of (n,) arrays, per effect.

Each takes (data, command, parameters, settings, base's parameters) and gives the command that
then passes delay and lag; a command is held over each cycle, so inner states advance exactly.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from quad_sysid.contract import MIXER_INVERSE, FloatArray
from quad_sysid.greybox.data import AxisData
from quad_sysid.greybox.structure import Settings


def dead_zone(
    _: AxisData, command: FloatArray, p: FloatArray, __: Settings, ___: FloatArray
) -> FloatArray:
    """sign(u) max(|u| - w, 0)."""
    out: FloatArray = np.sign(command) * np.maximum(np.abs(command) - p[0], 0.0)
    return out


def battery_sag(
    data: AxisData, command: FloatArray, p: FloatArray, settings: Settings, _: FloatArray
) -> FloatArray:
    """The gain follows (V / V_ref)^n; the voltage changes slowly beside the lag."""
    reference = settings['reference_v']
    if data.battery_v is None or not isinstance(reference, float):
        return command
    out: FloatArray = command * (data.battery_v / reference) ** p[0]
    return out


def thrust_curve(
    data: AxisData, command: FloatArray, p: FloatArray, settings: Settings, _: FloatArray
) -> FloatArray:
    """Thrust (1 - k) m + k m² of each motor, through the mixer: U1 and the other axes come in.

    Divided by the slope at the mean throttle, so that the gain keeps its meaning.
    """
    others = [i for i in range(3) if i != data.index]
    u1 = data.control[:, 0]
    product = data.control[:, others[0] + 1] * data.control[:, others[1] + 1]
    k, mean = p[0], settings['throttle']
    if not isinstance(mean, float):
        return command
    slope = max(1.0 - k + 2.0 * k * mean, 1e-3)
    out: FloatArray = (command * (1.0 - k + 2.0 * k * u1) + 2.0 * k * product) / slope
    return out


def saturation(
    data: AxisData, command: FloatArray, p: FloatArray, _: Settings, __: FloatArray
) -> FloatArray:
    """The motors' own limits, narrower than what /motors/command shows."""
    row = MIXER_INVERSE[data.index + 1]
    lost: FloatArray = (np.clip(data.motors, p[0], p[1]) - data.motors) @ row
    return command + lost


def cross_axis(
    data: AxisData, command: FloatArray, p: FloatArray, settings: Settings, _: FloatArray
) -> FloatArray:
    """A fraction of another axis' command acts here."""
    column = settings['column']
    if not isinstance(column, float):
        return command
    out: FloatArray = command + p[0] * data.control[:, int(column)]
    return out


def backlash(
    data: AxisData, command: FloatArray, p: FloatArray, _: Settings, __: FloatArray
) -> FloatArray:
    """Play of +-w between command and torque."""
    out = np.empty_like(command)
    for start, stop in data.stretches:
        _play(command, float(p[0]), start, stop, out)
    return out


def slow_motors(
    data: AxisData, command: FloatArray, p: FloatArray, _: Settings, base: FloatArray
) -> FloatArray:
    """A share of the motors has a longer lag: (tau s + 1) / (tau_slow s + 1) on that share."""
    slow, share = max(float(p[0]), 1e-3), float(p[1])
    ratio = float(base[1]) / slow
    lagged = np.empty_like(command)
    for start, stop in data.stretches:
        _lag(command, slow, data.dt, start, stop, lagged)
    out: FloatArray = (1.0 - share) * command + share * (
        ratio * command + (1.0 - ratio) * lagged
    )
    return out


def one_slow_motor(
    data: AxisData, command: FloatArray, p: FloatArray, settings: Settings, base: FloatArray
) -> FloatArray:
    """One motor has a longer lag: what it owes of all axes' commands acts on this one too."""
    motor = settings['motor']
    if not isinstance(motor, float):
        return command
    wanted = data.motors[:, int(motor)]
    slow = max(float(p[0]), 1e-3)
    lagged = np.empty_like(wanted)
    for start, stop in data.stretches:
        _lag(wanted, slow, data.dt, start, stop, lagged)
    share = MIXER_INVERSE[data.index + 1, int(motor)]
    out: FloatArray = command + share * (1.0 - float(base[1]) / slow) * (lagged - wanted)
    return out


def behind_lag(
    data: AxisData, command: FloatArray, tau: float, x: FloatArray, y: FloatArray
) -> FloatArray:
    """The command that makes the lagged motors give m + y(m), y linear between knots x.

    With m' = (u - m) / tau, v = m + y(m) follows v' = (c - v) / tau where c is
    u + y(m) + y'(m) (u - m).
    """
    lagged = np.empty_like(command)
    for start, stop in data.stretches:
        _lag(command, max(tau, 1e-3), data.dt, start, stop, lagged)
    slopes = np.r_[0.0, np.diff(y) / np.diff(x), 0.0]
    out: FloatArray = (
        command + np.interp(lagged, x, y)
        + slopes[np.searchsorted(x, lagged, side='right')] * (command - lagged)
    )
    return out


def resonance(
    data: AxisData, command: FloatArray, p: FloatArray, _: Settings, __: FloatArray
) -> FloatArray:
    """A light mode in the drive: adds `in_phase` z + `quadrature` z'/w to the command u.

    z'' + 2 d w z' + w² z = w² u.
    """
    omega, damping = 2.0 * math.pi * float(p[0]), float(p[1])
    a = np.array([[0.0, 1.0], [-(omega**2), -2.0 * damping * omega]])
    step, drive = held_step(a, np.array([0.0, omega**2]), data.dt)
    half, half_drive = held_step(a, np.array([0.0, omega**2]), 0.5 * data.dt)
    weights = np.array([float(p[2]), float(p[3]) / omega])
    out = np.empty_like(command)
    for start, stop in data.stretches:
        _mode(command, step, drive, half, half_drive, weights, start, stop, out)
    return out


def held_step(a: FloatArray, b: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
    """Exact step of x' = a x + b u (2 states) for a held input: series of the exponential."""
    block = np.zeros((3, 3))
    block[:2, :2], block[:2, 2] = a * dt, b * dt
    scale = max(0, math.ceil(math.log2(max(float(np.abs(block).sum()), 1e-12))) + 4)
    block = block / 2.0**scale
    e = np.eye(3)
    term = np.eye(3)
    for i in range(1, 9):
        term = term @ block / i
        e = e + term
    for _ in range(scale):
        e = e @ e
    return np.ascontiguousarray(e[:2, :2]), np.ascontiguousarray(e[:2, 2])


@njit(cache=True, nogil=True)
def _play(command, width, start, stop, out):  # type: ignore[no-untyped-def] # noqa: ANN001, ANN202
    held = command[start]
    for k in range(start, stop):
        held = min(max(held, command[k] - width), command[k] + width)
        out[k] = held


@njit(cache=True, nogil=True)
def _lag(command, tau, dt, start, stop, out):  # type: ignore[no-untyped-def] # noqa: ANN001, ANN202
    """Mean over each cycle of a first-order lag of the held command."""
    decay = math.exp(-dt / tau)
    mean = tau / dt * (1.0 - decay)
    state = command[start]
    for k in range(start, stop):
        u = command[k]
        out[k] = u + (state - u) * mean
        state = u + (state - u) * decay


@njit(cache=True, nogil=True)
def _mode(command, step, drive, half, half_drive, weights, start, stop, out):  # type: ignore[no-untyped-def] # noqa: ANN001, ANN202
    """Command plus the mode's answer at half of each cycle."""
    x = command[start]
    v = 0.0
    for k in range(start, stop):
        u = command[k]
        mx = half[0, 0] * x + half[0, 1] * v + half_drive[0] * u
        mv = half[1, 0] * x + half[1, 1] * v + half_drive[1] * u
        out[k] = u + weights[0] * mx + weights[1] * mv
        x, v = (
            step[0, 0] * x + step[0, 1] * v + drive[0] * u,
            step[1, 0] * x + step[1, 1] * v + drive[1] * u,
        )
