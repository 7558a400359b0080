"""Compiled inner loops of the closed loop: a control cycle, and a plant's list of operations.

Only arithmetic on arrays; simulation.py says what the numbers mean, model/traced.py the list.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import from_dtype, types

from quad_sysid.compiled import BLOCK, BLOCKS, LINE, NUMBER, TABLE, WHOLE, WHOLES, inner, kernel
from quad_sysid.contract import FloatArray
from quad_sysid.model.laws import IntArray, operate
from quad_sysid.model.recursion import motor_step, uneven

INTEGRAL, LAST, D_PART, TARGET, ERROR, OUTPUT, NOTCH = range(7)
MEMORY = 8
"""Numbers that a controller remembers; the notch has the last two."""


class Constants(NamedTuple):
    """The cascade's numbers, as in CascadeGains; weights are of first-order filters, 1: none."""

    angle_kp: float
    rate_kp: float
    rate_ki: float
    rate_kd: float
    kff: float
    d_weight: float
    target_weight: float
    error_weight: float
    output_weight: float
    notch: float
    """b0 of the notch before D, whose b2 is the same; 1: there is none."""
    notch_turn: float
    """b1 and a1 of the notch, which are equal."""
    notch_keep: float
    """a2 of the notch."""
    d_on_error: float
    output_limit: float
    rate_limit: float
    integrator_limit: float
    dt: float


class Places(NamedTuple):
    """Registers of a plant's numbers."""

    split: int
    """Operations before the motors."""
    sent: int
    push: int
    motors: int
    """The first register of the four numbers that come from the motors."""
    state: int
    """The first register of the state."""
    following: IntArray
    """(states,) registers of the state a cycle later."""
    outputs: IntArray
    """(2,) measured rate and angle a cycle later."""
    commands: IntArray
    """(c,)."""
    lag: IntArray
    """(c,)."""
    when: IntArray
    """(3,) the two ages and the fraction, as in Drive."""


EACH = np.dtype([(name, float) for name in Constants._fields])
"""Constants in an array, those of a flight each."""
GAINS = types.NamedUniTuple(NUMBER, len(Constants._fields), Constants)
PLACES = types.NamedTuple((*[WHOLE] * 5, *[WHOLES] * 5), Places)


@inner
def filtered(memory: FloatArray, which: int, x: float, weight: float) -> float:
    """A first-order filter of x; with weight 1 there is none."""
    if weight >= 1.0:
        return x
    memory[which] += weight * (x - memory[which])
    return float(memory[which])


@inner
def control(gains: Constants, memory: FloatArray, reference: float, angle: float, rate: float,
            added: float) -> tuple[float, float]:
    """One cycle of C1/C2: (rate reference, u). `added` is a rate excitation; memory (MEMORY,)."""
    setpoint = gains.angle_kp * (reference - angle)
    setpoint = min(max(setpoint, -gains.rate_limit), gains.rate_limit) + added
    target = filtered(memory, TARGET, setpoint, gains.target_weight)
    error = filtered(memory, ERROR, target - rate, gains.error_weight)
    total = memory[INTEGRAL] + gains.rate_ki * error * gains.dt
    memory[INTEGRAL] = min(max(total, -gains.integrator_limit), gains.integrator_limit)
    now = -error if gains.d_on_error > 0.0 else rate
    if gains.notch < 1.0:
        notched = gains.notch * now + memory[NOTCH]
        memory[NOTCH] = gains.notch_turn * (now - notched) + memory[NOTCH + 1]
        memory[NOTCH + 1] = gains.notch * now - gains.notch_keep * notched
        now = notched
    slope = (now - memory[LAST]) / gains.dt
    memory[D_PART] += gains.d_weight * (slope - memory[D_PART])
    memory[LAST] = now
    u = gains.rate_kp * error + memory[INTEGRAL] - gains.rate_kd * memory[D_PART]
    u = filtered(memory, OUTPUT, u + gains.kff * target, gains.output_weight)
    return setpoint, min(max(u, -gains.output_limit), gains.output_limit)


@kernel(GAINS, TABLE, TABLE, LINE, LINE, LINE)
def control_each(gains: Constants, memory: FloatArray, inputs: FloatArray, angle: FloatArray,
                 rate: FloatArray, out: FloatArray) -> None:
    """One cycle of f cascades: u (f,) with the excitation after C2.

    memory (f, MEMORY); inputs (f, 3): angle reference, excitation of the rate, of the control;
    angle and rate (f,).
    """
    for i in range(angle.size):
        _, u = control(gains, memory[i], inputs[i, 0], angle[i], rate[i], inputs[i, 1])
        out[i] = u + inputs[i, 2]


@inner
def before(line: FloatArray, newest: int, channel: int, i: int, age: float) -> float:
    """The command that was sent so many cycles ago, linear between two; `line` (d, c, f) turns."""
    whole = math.floor(age)
    new = line[(newest + whole) % line.shape[0], channel, i]
    share = age - whole
    if share > 0.0:
        new += share * (line[(newest + whole + 1) % line.shape[0], channel, i] - new)
    return float(new)


@inner
def driven(at: Places, row: FloatArray, factors: FloatArray, r: FloatArray, line: FloatArray,
           w: FloatArray, newest: int, dt: float, lags: FloatArray, own: FloatArray) -> int:
    """The motors in a cycle, between the operations on what was sent and those on the axis.

    line (d, c, f) and w (c, f): commands under way, from `newest` on, and behind their lags; row
    and factors as in Program, of each flight. lags (f, c, 3, 3) and own (4,) are arrays of
    motor_step, the first kept from cycle to cycle. Gives the new `newest`.
    """
    newest = (newest + line.shape[0] - 1) % line.shape[0]
    for i in range(r.shape[1]):
        area0 = area1 = filtered_command = command = 0.0
        for c in range(w.shape[0]):
            line[newest, c, i] = r[at.commands[c], i]
            w[c, i] = motor_step(
                w[c, i], before(line, newest, c, i, r[at.when[1], i]),
                before(line, newest, c, i, r[at.when[0], i]), r[at.lag[c], i],
                uneven(factors[i, c]), factors[i, c], r[at.when[2], i], dt, lags[i, c], own)
            area0 += row[i, c] * own[0]
            area1 += row[i, c] * own[1]
            filtered_command += row[i, c] * own[2]
            command += row[i, c] * own[3]
        r[at.motors, i], r[at.motors + 1, i] = area0 * 2.0 / dt, area1 * 2.0 / dt
        r[at.motors + 2, i], r[at.motors + 3, i] = filtered_command, command
    return newest


@kernel(PLACES, TABLE, BLOCKS, TABLE, BLOCK, TABLE, WHOLE, NUMBER)
def motors(at: Places, row: FloatArray, factors: FloatArray, r: FloatArray, line: FloatArray,
           w: FloatArray, newest: int, dt: float) -> int:
    """`driven`, for a controller or laws in Python."""
    lags = np.zeros((w.shape[1], w.shape[0], 3, 3))
    return int(driven(at, row, factors, r, line, w, newest, dt, lags, np.zeros(4)))


@kernel(from_dtype(EACH)[::1], PLACES, WHOLE[:, ::1], WHOLES, TABLE, TABLE, BLOCKS, TABLE, TABLE,
        BLOCK, TABLE, WHOLES, BLOCK, BLOCK, BLOCK, NUMBER)
def fly(gains: npt.NDArray[np.void], at: Places, code: IntArray, more: IntArray,
        tables: FloatArray, row: FloatArray, factors: FloatArray, r: FloatArray,
        first: FloatArray, line: FloatArray, w: FloatArray, moving: IntArray, known: FloatArray,
        signals: FloatArray, out: FloatArray, lead: float) -> None:
    """The cascades around f plants by their operations; `lead`: of the angle over the sum, s.

    gains (f,); r (registers, f), with the state and what stays at the start; first (f, 2) rate and
    angle as they are measured there; line and w as in `driven`; known (f, s, n) of each cycle, for
    the registers `moving`; signals (f, 5, n): angle reference, noise of the rate, acceleration,
    excitation of rate and control; out (f, 4, n): angle, rate, control, rate reference.
    """
    f, states, newest, own = r.shape[1], at.following.size, 0, np.zeros(4)
    memory, lags = np.zeros((f, MEMORY)), np.zeros((f, w.shape[0], 3, 3))
    following, measured = np.empty((states, f)), np.empty((f, 2))
    for i in range(f):
        measured[i, 0], measured[i, 1] = first[i, 0], first[i, 1]
        if gains[i].d_on_error == 0.0:
            memory[i, LAST] = first[i, 0]
            memory[i, NOTCH] = memory[i, NOTCH + 1] = (1.0 - gains[i].notch) * first[i, 0]
    for k in range(signals.shape[2]):
        for i in range(f):
            rate = measured[i, 0] + signals[i, 1, k]
            angle = measured[i, 1] + lead * rate
            setpoint, u = control(gains[i], memory[i], signals[i, 0, k], angle, rate,
                                  signals[i, 3, k])
            u += signals[i, 4, k]
            out[i, 0, k], out[i, 1, k], out[i, 2, k], out[i, 3, k] = angle, rate, u, setpoint
            for j in range(moving.size):
                r[moving[j], i] = known[i, j, k]
            r[at.sent, i], r[at.push, i] = u, signals[i, 2, k]
        operate(code, more, tables, r, 0, at.split)
        newest = driven(at, row, factors, r, line, w, newest, gains[0].dt, lags, own)
        operate(code, more, tables, r, at.split, code.shape[0])
        for j in range(states):  # a state may become another one
            for i in range(f):
                following[j, i] = r[at.following[j], i]
        for j in range(states):
            for i in range(f):
                r[at.state + j, i] = following[j, i]
        for i in range(f):
            measured[i, 0], measured[i, 1] = r[at.outputs[0], i], r[at.outputs[1], i]


@kernel(GAINS, LINE, LINE, LINE, TABLE, NUMBER)
def run_polynomial(gains: Constants, reference: FloatArray, a: FloatArray, b: FloatArray,
                   out: FloatArray, lead: float) -> None:
    """The cascade around A(q) rate = B(q) u with a[0] = 1, b[0] = 0; the angle is its sum."""
    memory = np.zeros(MEMORY)
    clean = np.zeros(reference.size)
    angle = 0.0
    for k in range(reference.size):
        total = 0.0
        for i in range(1, min(b.size, k + 1)):
            total += b[i] * out[2, k - i]
        for i in range(1, min(a.size, k + 1)):
            total -= a[i] * clean[k - i]
        clean[k] = total
        if k > 0:
            angle += 0.5 * gains.dt * (clean[k] + clean[k - 1])
        predicted = angle + lead * total
        setpoint, u = control(gains, memory, reference[k], predicted, total, 0.0)
        out[0, k], out[1, k], out[2, k], out[3, k] = predicted, total, u, setpoint


@kernel(types.complex128[:, ::1], LINE, TABLE)
def margins(loop: npt.NDArray[np.complex128], log_omega: FloatArray, out: FloatArray) -> None:
    """The fields of cascade.Margins of loop gains (p, f) into `out` (4, p).

    Between two frequencies the logarithm of the gain and the phase, the shorter way round, are
    linear over the logarithm of the frequency.
    """
    whole = 2.0 * math.pi
    for i in range(loop.shape[0]):
        nearest = least = np.inf
        least_gain, crossover = np.inf, -np.inf
        low = phase = lost = 0.0
        for k in range(log_omega.size):
            x, y = loop[i, k].real, loop[i, k].imag
            lost += 0.0 * (x + y)  # NaN once one of them is
            nearest = min(nearest, (1.0 + x) * (1.0 + x) + y * y)
            high, later = 0.5 * math.log(max(x * x + y * y, 1e-300)), math.atan2(y, x)
            if k > 0:
                change = later - phase
                change -= whole * np.rint(change / whole)
                if (low > 0.0) != (high > 0.0):
                    share = low / (low - high)
                    least = min(least, abs((phase + share * change) % whole - math.pi))
                    if low > 0.0:
                        step = log_omega[k] - log_omega[k - 1]
                        crossover = max(crossover, log_omega[k - 1] + share * step)
                turns, step = (phase - math.pi) / whole, change / whole
                floor, beyond = math.floor(turns), math.floor(turns + step)
                if floor != beyond:
                    part = (max(floor, beyond) - turns) / step
                    least_gain = min(least_gain, abs(low + part * (high - low)))
            low, phase = high, later
        out[0, i], out[1, i] = math.degrees(least), 20.0 / math.log(10.0) * least_gain
        out[2, i] = 1.0 / math.sqrt(nearest + lost)
        out[3, i] = math.exp(crossover) if crossover > -np.inf else np.nan
