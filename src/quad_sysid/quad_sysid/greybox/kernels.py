"""Compiled inner loops of the grey box: exact feed-forward response, tracking, free run.

Only arithmetic on arrays; what the numbers mean stands in drive.py, simulate.py and
effects/table.py. The axis is

    rate' = K w(t) + x(t) - c rate + bias + terms(rate, angle)        angle' = rate

with w the lagged, delayed command and x what else is known over time. The part driven by inputs
alone is solved exactly (`feedforward`); the rest, v = rate - rate_d, is smooth within a cycle and
takes one classical Runge-Kutta step a cycle.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

(
    QUADRATIC, COULOMB, PENDULUM, CUBIC, RATE_CURVE, ANGLE_CURVE, RATE_TIMES, SIGNAL, HIDDEN,
    DRIVE_BY_RATE, DRIVE_BY_ANGLE, FRICTION_BY_ANGLE, FRICTION_SIGNAL, HYSTERESIS,
) = range(1, 15)

CURVES = (RATE_CURVE, ANGLE_CURVE, DRIVE_BY_RATE, DRIVE_BY_ANGLE, FRICTION_BY_ANGLE)
"""Terms whose values are a curve's."""

_OPTIONS = {
    'cache': True, 'nogil': True, 'error_model': 'numpy', 'fastmath': {'contract', 'nsz', 'arcp'},
}


@njit(inline='always', **_OPTIONS)
def _curve(values, j, x):
    """Value at x of a curve linear between knots: values[j] = [z0, 1/step, count, w, y0, ...].

    The knots are even in z = x / (|x| + w), dense around zero; in z = x where w is 0.
    """
    z = x if values[j, 3] == 0.0 else x / (abs(x) + values[j, 3])
    last = int(values[j, 2]) - 1
    position = (z - values[j, 0]) * values[j, 1]
    index = min(max(math.floor(position), 0), last - 1)
    fraction = min(max(position - index, -0.5), 1.5)
    low = values[j, 4 + index]
    return low + fraction * (values[j, 5 + index] - low)


@njit(inline='always', **_OPTIONS)
def _sign(rate, width):
    """The rate's sign, smooth within +-width."""
    reach = rate / width
    return 1.0 if reach > 8.0 else (-1.0 if reach < -8.0 else math.tanh(reach))


@njit(inline='always', **_OPTIONS)
def _torque(rate, angle, drive, k, codes, values, signals):
    """Sum of the feedback terms, rad/s²: codes (m,), values (m, q), signals (m, n).

    `drive` is the mean acceleration of this cycle by the motors.
    """
    total = 0.0
    for j in range(codes.size):
        code = codes[j]
        if code == QUADRATIC:
            total -= values[j, 0] * rate * abs(rate)
        elif code == COULOMB:
            total -= values[j, 0] * _sign(rate, values[j, 1])
        elif code == PENDULUM:
            total -= values[j, 0] * math.sin(angle)
        elif code == CUBIC:
            total -= values[j, 0] * angle * angle * angle
        elif code == RATE_CURVE:
            total += _curve(values, j, rate)
        elif code == ANGLE_CURVE:
            total += _curve(values, j, angle)
        elif code == RATE_TIMES:
            total -= values[j, 0] * rate * signals[j, k]
        elif code == SIGNAL:
            total += values[j, 0] * signals[j, k]
        elif code == DRIVE_BY_RATE:
            total += drive * _curve(values, j, rate)
        elif code == DRIVE_BY_ANGLE:
            total += drive * _curve(values, j, angle)
        elif code == FRICTION_BY_ANGLE:
            width = values[j, 4 + int(values[j, 2])]
            total -= _sign(rate, width) * _curve(values, j, angle)
        elif code == FRICTION_SIGNAL:
            total -= _sign(rate, values[j, 0]) * signals[j, k]
    return total


@njit(**_OPTIONS)
def feedforward(command, whole, matrices, inputs, pattern, gyro, start, stop, out):
    """Exact response of lag, integrators and gyro filter to a held command, for unit gain.

    command (n,) held from one cycle to the next; `whole` cycles of delay; the cycle is cut at
    the command's change and at its middle: matrices (s, 3, 3) and inputs (s, 3) step the state
    (lag, rate, angle) over each part, the new command rules where pattern[i] is 1, the half
    cycle lies after part pattern[s]. gyro (2, 5) as in `track`. out (5, n): rate, rate at half
    cycle, angle, angle at half cycle, gyro output; filled in [start, stop).
    """
    lag = command[start]
    rate = 0.0
    angle = 0.0
    g = 0.0
    d = 0.0
    parts = matrices.shape[0]
    half_after = pattern[parts]
    for k in range(start, stop):
        out[0, k] = rate
        out[2, k] = angle
        out[4, k] = g
        new = command[max(k - whole, start)]
        before = command[max(k - whole - 1, start)]
        for i in range(parts):
            u = new if pattern[i] == 1 else before
            a = matrices[i]
            b = inputs[i]
            angle += a[2, 1] * rate + a[2, 0] * lag + b[2] * u
            rate += a[1, 0] * lag + b[1] * u
            lag = a[0, 0] * lag + b[0] * u
            if i == half_after:
                out[1, k] = rate
                out[3, k] = angle
        rate0 = out[0, k]
        middle = out[1, k]
        new_g = (gyro[0, 0] * g + gyro[0, 1] * d + gyro[0, 2] * rate0 + gyro[0, 3] * middle
                 + gyro[0, 4] * rate)
        d = (gyro[1, 0] * g + gyro[1, 1] * d + gyro[1, 2] * rate0 + gyro[1, 3] * middle
             + gyro[1, 4] * rate)
        g = new_g


@njit(inline='always', **_OPTIONS)
def _step(v, s, k, gain, known, damping, bias, dt, codes, values, signals):
    """One Runge-Kutta step of v = rate - rate_d and s = angle - angle_d; also v at half cycle."""
    half = 0.5 * dt
    rate_d, middle_d, end_d = gain * known[0, k], gain * known[1, k], gain * known[0, k + 1]
    middle_angle = gain * known[3, k] + s
    drive = (end_d - rate_d) / dt
    rate = rate_d + v
    k1 = bias - damping * rate + _torque(
        rate, gain * known[2, k] + s, drive, k, codes, values, signals
    )
    v2 = v + half * k1
    rate = middle_d + v2
    k2 = bias - damping * rate + _torque(
        rate, middle_angle + half * v, drive, k, codes, values, signals
    )
    v3 = v + half * k2
    rate = middle_d + v3
    k3 = bias - damping * rate + _torque(
        rate, middle_angle + half * v2, drive, k, codes, values, signals
    )
    v4 = v + dt * k3
    rate = end_d + v4
    k4 = bias - damping * rate + _torque(
        rate, gain * known[2, k + 1] + s + dt * v3, drive, k, codes, values, signals
    )
    new_v = v + dt / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)
    new_s = s + dt / 6.0 * (v + 2.0 * (v2 + v3) + v4)
    # cubic Hermite value at the half cycle, for the gyro filter behind
    return new_v, new_s, 0.5 * (v + new_v) + 0.125 * dt * (k1 - k4)


@njit(inline='always', **_OPTIONS)
def _built_up(state, rate, share):
    """A friction's share (-1..1) after some motion: exact for a rate that is held."""
    way = 1.0 if rate > 0.0 else -1.0
    return way + (state - way) * math.exp(-abs(rate) * share)


@njit(inline='always', **_OPTIONS)
def _hidden(states, rate, codes, values):
    """Torque of the hidden states (m, 2) at half of the cycle, driven by the rate at its begin.

    A HIDDEN term is values[j] = [A (2, 2), B (2,) of a cycle, the same of half a cycle, C (2,)];
    a HYSTERESIS [torque, cycle over the angle of its build-up] (Dahl 1968).
    """
    total = 0.0
    for j in range(codes.size):
        if codes[j] == HIDDEN:
            x, y = states[j, 0], states[j, 1]
            total += values[j, 12] * (values[j, 6] * x + values[j, 7] * y + values[j, 10] * rate)
            total += values[j, 13] * (values[j, 8] * x + values[j, 9] * y + values[j, 11] * rate)
        elif codes[j] == HYSTERESIS:
            total -= values[j, 0] * _built_up(states[j, 0], rate, 0.5 * values[j, 1])
    return total


@njit(inline='always', **_OPTIONS)
def _advance(states, rate, codes, values):
    """Hidden states (m, 2) one cycle on, driven by the mean rate over it."""
    for j in range(codes.size):
        if codes[j] == HIDDEN:
            x, y = states[j, 0], states[j, 1]
            states[j, 0] = values[j, 0] * x + values[j, 1] * y + values[j, 4] * rate
            states[j, 1] = values[j, 2] * x + values[j, 3] * y + values[j, 5] * rate
        elif codes[j] == HYSTERESIS:
            states[j, 0] = _built_up(states[j, 0], rate, values[j, 1])


@njit(**_OPTIONS)
def _parted(bias, codes, values, signals, n, start, stop):
    """What is known before the run, (n,) filled in [start, stop), and the terms that feed back."""
    push = np.empty(n)
    push[start:stop] = bias
    for j in range(codes.size):
        if codes[j] == SIGNAL:
            push[start:stop] += values[j, 0] * signals[j, start:stop]
    fed = np.nonzero((codes != SIGNAL) & (codes != HIDDEN) & (codes != HYSTERESIS))[0]
    fed_codes, fed_values = codes[fed], values[fed]
    for j in range(fed.size):
        code = fed_codes[j]
        if code in CURVES:
            fed_values[j, 1] = 1.0 / fed_values[j, 1]  # multiplied by four times a cycle
    return push, fed_codes, fed_values, signals[fed] if signals.shape[0] else signals


@njit(**_OPTIONS)
def track(rate, angle, has_angle, known, gain, damping, bias, dt, codes, values, signals,
          filtered, gyro, correction, start, stop, starts, length, innovations, windows):
    """Follow the measured rate over [start, stop) and run free from each window's start.

    rate, angle (n,) measured; known (5, n) from `feedforward`; gyro (2, 5): state transition and
    weights of v at begin, half and end of the cycle; correction (4,): what the innovation adds
    to v, to the filter's two states, and to its second state one cycle later. starts (w,)
    ascending; innovations (n,) and windows (w, length) receive the one-step error and the
    free-run prediction. A window sees nothing measured at or after its first sample.
    """
    g00, g01, g02, g03, g04 = gyro[0, 0], gyro[0, 1], gyro[0, 2], gyro[0, 3], gyro[0, 4]
    g10, g11, g12, g13, g14 = gyro[1, 0], gyro[1, 1], gyro[1, 2], gyro[1, 3], gyro[1, 4]
    c0, c1, c2, c3 = correction[0], correction[1], correction[2], correction[3]
    v = rate[start] - gain * known[0, start]
    s = (angle[start] - gain * known[2, start]) if has_angle else 0.0
    g = rate[start] - gain * known[4, start]
    d = 0.0
    nxt = np.searchsorted(starts, start)
    first = nxt
    begin = np.empty((starts.size, 4))
    push, fed, fed_values, fed_signals = _parted(
        bias, codes, values, signals, rate.size, start, stop
    )
    stateful = np.any((codes == HIDDEN) | (codes == HYSTERESIS))
    hidden = np.zeros((codes.size, 2))
    hidden_begin = np.zeros((starts.size, codes.size, 2))
    for k in range(start, stop):
        if nxt < starts.size and starts[nxt] == k:
            begin[nxt, 0], begin[nxt, 1], begin[nxt, 2], begin[nxt, 3] = v, s, g, d
            hidden_begin[nxt] = hidden
            nxt += 1
        predicted = gain * known[4, k] + g if filtered else gain * known[0, k] + v
        e = rate[k] - predicted
        innovations[k] = e
        if k + 1 >= stop:
            break
        v += c0 * e
        g += c1 * e
        d += c2 * e
        if has_angle:
            s = angle[k] - gain * known[2, k]
        before = gain * known[0, k] + v
        torque = push[k]
        if stateful:
            torque += _hidden(hidden, before, codes, values)
        new_v, s, middle = _step(
            v, s, k, gain, known, damping, torque, dt, fed, fed_values, fed_signals
        )
        if stateful:
            _advance(hidden, 0.5 * (before + gain * known[0, k + 1] + new_v), codes, values)
        if filtered:
            new_g = (g00 * g + g01 * d + g02 * v + g03 * middle
                     + g04 * new_v)
            d = (g10 * g + g11 * d + g12 * v + g13 * middle
                 + g14 * new_v) + c3 * e
            g = new_g
        v = new_v
    for w in range(first, nxt):
        v, s, g, d = begin[w, 0], begin[w, 1], begin[w, 2], begin[w, 3]
        hidden[:] = hidden_begin[w]
        for i in range(length):
            k = starts[w] + i
            windows[w, i] = gain * known[4, k] + g if filtered else gain * known[0, k] + v
            if k + 1 >= stop:
                break
            before = gain * known[0, k] + v
            torque = push[k]
            if stateful:
                torque += _hidden(hidden, before, codes, values)
            new_v, s, middle = _step(
                v, s, k, gain, known, damping, torque, dt, fed, fed_values, fed_signals
            )
            if stateful:
                _advance(hidden, 0.5 * (before + gain * known[0, k + 1] + new_v), codes, values)
            if filtered:
                new_g = (g00 * g + g01 * d + g02 * v + g03 * middle
                         + g04 * new_v)
                d = (g10 * g + g11 * d + g12 * v + g13 * middle
                     + g14 * new_v)
                g = new_g
            v = new_v


@njit(**_OPTIONS)
def steady_covariance(f, q, c, r, iterations):
    """(n, n) predicted covariance of the stationary Kalman filter (Riccati, iterated).

    f (n, n) transition, q (n, n) its noise, c (n,) output, r its noise.
    """
    p = q.copy() + np.eye(f.shape[0])
    for _ in range(iterations):
        pc = p @ c
        s = c @ pc + r
        corrected = p - np.outer(pc, pc) / s
        new = f @ corrected @ f.T + q
        new = 0.5 * (new + new.T)
        change = np.max(np.abs(new - p))
        p = new
        if change <= 1e-12 * np.max(np.abs(p)):
            break
    return p
