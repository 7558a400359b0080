"""Compiled closed loop around the grey box with any effect: controller, command maps, plant.

Only arithmetic on arrays; what the numbers mean stands in flight.py and stages.py. Drive, torques
and hidden states advance exactly as in greybox/kernels.py, whose steps are called here.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from quad_sysid.greybox.kernels import _advance, _hidden, _parted, _step
from quad_sysid.loop.kernels import control

AFFINE, TABLE, LIMITS, PLAY, SLOW, SLOW_MOTOR, MODE, THRUST = range(1, 9)

# not cached on disk: numba would not see that the steps in the other files have changed
_OPTIONS = {'nogil': True, 'error_model': 'numpy'}


@njit(**_OPTIONS)
def _bent(at, rest, count, p):
    """A curve between knots p[3:3 + count], y behind them, and its slope times `rest`."""
    if at < p[3]:
        return p[3 + count]
    for i in range(3, 2 + count):
        if at < p[i + 1]:
            slope = (p[i + 1 + count] - p[i + count]) / (p[i + 1] - p[i])
            return p[i + count] + slope * (at - p[i] + rest)
    return p[2 + 2 * count]


@njit(**_OPTIONS)
def _staged(u, k, codes, values, signals, states):
    """The command behind the effects that act on it; states (m, 2) advance by one cycle."""
    flown = u  # what the motors are told
    for j in range(codes.size):
        code, p, x = codes[j], values[j], states[j]
        if k == 0:
            x[0] = u
        if code == AFFINE:
            u = u * signals[j, 0, k] + signals[j, 1, k]
        elif code == TABLE:
            last = int(p[2]) - 1
            position = (u - p[0]) / p[1]
            index = min(max(math.floor(position), 0), last - 1)
            u = p[3 + index] + (position - index) * (p[4 + index] - p[3 + index])
        elif code == THRUST:
            mean = u + (x[0] - u) * p[1]
            x[0] = u + (x[0] - u) * p[0]
            u += _bent(mean, u - mean, int(p[2]), p)
        elif code == LIMITS:
            lost = 0.0
            for i in range(4):
                motor = min(max(signals[j, i, k] + flown * p[2 + i], 0.0), 1.0)
                lost += 0.25 * p[2 + i] * (min(max(motor, p[0]), p[1]) - motor)
            u += lost
        elif code == PLAY:
            x[0] = min(max(x[0], u - p[0]), u + p[0])
            u = x[0]
        elif code == SLOW:
            mean = u + (x[0] - u) * p[1]
            x[0] = u + (x[0] - u) * p[0]
            u = (1.0 - p[2]) * u + p[2] * (p[3] * u + (1.0 - p[3]) * mean)
        elif code == SLOW_MOTOR:
            motor = min(max(signals[j, 0, k] + flown * p[4], 0.0), 1.0)
            if k == 0:
                x[0] = motor
            u += p[2] * (1.0 - p[3]) * (x[0] - motor) * p[1]
            x[0] = motor + (x[0] - motor) * p[0]
        elif code == MODE:
            z, v = x[0], x[1]
            half_z = p[6] * z + p[7] * v + p[10] * u
            half_v = p[8] * z + p[9] * v + p[11] * u
            x[0] = p[0] * z + p[1] * v + p[4] * u
            x[1] = p[2] * z + p[3] * v + p[5] * u
            u += p[12] * half_z + p[13] * half_v
    return u


@njit(**_OPTIONS)
def staged(command, codes, values, signals):
    """(n,) a given command (n,) behind the effects that act on it, from rest at its first."""
    states = np.zeros((codes.size, 2))
    out = np.empty_like(command)
    for k in range(command.size):
        out[k] = _staged(command[k], k, codes, values, signals, states)
    return out


@njit(**_OPTIONS)
def fly(constants, excitation, whole, matrices, inputs, pattern, gyro, filtered, base, terms,
        stages, out):
    """The cascade around the plant from rest; out (4, n): angle, rate, control, rate reference.

    excitation (3, n): angle reference, rate and control excitation; base (gain, damping, bias);
    terms (codes, values, signals) as greybox/kernels.track takes them, stages alike for the
    command; the rest as in greybox/kernels.feedforward.
    """
    gain, damping, bias = base
    codes, values, signals = terms
    stage_codes, stage_values, stage_signals = stages
    n = excitation.shape[1]
    dt = constants.dt
    known = np.zeros((5, n + 1))
    acting = np.zeros(n)
    stage_states = np.zeros((stage_codes.size, 2))
    push, fed, fed_values, fed_signals = _parted(bias, codes, values, signals, n, 0, n)
    hidden = np.zeros((codes.size, 2))
    memory = np.zeros(3)
    lag = rate_d = angle_d = g_d = d_d = 0.0
    v = s = g = d = 0.0
    half_after = pattern[matrices.shape[0]]
    for k in range(n):
        rate = gain * g_d + g if filtered else gain * rate_d + v
        angle = gain * angle_d + s
        wanted, u = control(constants, memory, excitation[0, k], angle, rate, excitation[1, k])
        u += excitation[2, k]
        out[0, k], out[1, k], out[2, k], out[3, k] = angle, rate, u, wanted
        acting[k] = _staged(u, k, stage_codes, stage_values, stage_signals, stage_states)
        new = acting[max(k - whole, 0)]
        last = acting[max(k - whole - 1, 0)]
        for i in range(matrices.shape[0]):
            held = new if pattern[i] == 1 else last
            a, b = matrices[i], inputs[i]
            angle_d += a[2, 1] * rate_d + a[2, 0] * lag + b[2] * held
            rate_d += a[1, 0] * lag + b[1] * held
            lag = a[0, 0] * lag + b[0] * held
            if i == half_after:
                known[1, k], known[3, k] = rate_d, angle_d
        begin, middle = known[0, k], known[1, k]
        g_d, d_d = (
            gyro[0, 0] * g_d + gyro[0, 1] * d_d + gyro[0, 2] * begin + gyro[0, 3] * middle
            + gyro[0, 4] * rate_d,
            gyro[1, 0] * g_d + gyro[1, 1] * d_d + gyro[1, 2] * begin + gyro[1, 3] * middle
            + gyro[1, 4] * rate_d,
        )
        known[0, k + 1], known[2, k + 1], known[4, k + 1] = rate_d, angle_d, g_d
        before = gain * begin + v
        torque = push[k] + _hidden(hidden, before, codes, values)
        new_v, s, middle = _step(
            v, s, k, gain, known, damping, torque, dt, fed, fed_values, fed_signals
        )
        _advance(hidden, 0.5 * (before + gain * rate_d + new_v), codes, values)
        g, d = (
            gyro[0, 0] * g + gyro[0, 1] * d + gyro[0, 2] * v + gyro[0, 3] * middle
            + gyro[0, 4] * new_v,
            gyro[1, 0] * g + gyro[1, 1] * d + gyro[1, 2] * v + gyro[1, 3] * middle
            + gyro[1, 4] * new_v,
        )
        v = new_v
