"""Compiled inner loops of the closed loop: a control cycle, and a plant's list of operations.

Only arithmetic on arrays; simulation.py says what the numbers mean, model/traced.py the list.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import types

from quad_sysid.compiled import BLOCK, LINE, NUMBER, TABLE, WHOLE, WHOLES, inner, kernel
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
    """Its b1 and a1."""
    notch_keep: float
    """Its a2."""
    d_on_error: float
    output_limit: float
    rate_limit: float
    integrator_limit: float
    dt: float


class Places(NamedTuple):
    """Where a plant's numbers stand among the registers, and how its motors are mixed."""

    split: int
    """Operations before the motors."""
    given: int
    """The first register of the known signals of a cycle."""
    sent: int
    push: int
    motors: int
    """The first register of the four numbers that come from the motors."""
    state: int
    """The first register of the state."""
    following: IntArray
    """(states,) registers of the state a cycle later."""
    shown: IntArray
    """(2,) measured rate and angle a cycle later."""
    commands: IntArray
    """(c,)."""
    lag: IntArray
    """(c,)."""
    when: IntArray
    """(3,) the two ages and the fraction, as in Drive."""
    row: FloatArray
    """(c,)."""
    factors: FloatArray
    """(c, 2, k)."""


GAINS = types.NamedUniTuple(NUMBER, len(Constants._fields), Constants)
PLACES = types.NamedTuple(
    (*[WHOLE] * 6, *[WHOLES] * 5, LINE, BLOCK), Places)


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
    wanted = gains.angle_kp * (reference - angle)
    wanted = min(max(wanted, -gains.rate_limit), gains.rate_limit) + added
    target = filtered(memory, TARGET, wanted, gains.target_weight)
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
    return wanted, min(max(u, -gains.output_limit), gains.output_limit)


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
def before(line: FloatArray, newest: int, channel: int, age: float) -> float:
    """The command that was sent so many cycles ago, linear between two; `line` (d, c) turns."""
    whole = math.floor(age)
    new = line[(newest + whole) % line.shape[0], channel]
    share = age - whole
    if share > 0.0:
        new += share * (line[(newest + whole + 1) % line.shape[0], channel] - new)
    return float(new)


@inner
def driven(at: Places, r: FloatArray, line: FloatArray, w: FloatArray, newest: int, dt: float,
           lags: FloatArray, own: FloatArray) -> int:
    """The motors in a cycle, between the operations on what was sent and those on the axis.

    lags (c, 3, 3) and own (4,) are arrays of motor_step, the first kept from cycle to cycle.
    """
    newest = (newest + line.shape[0] - 1) % line.shape[0]
    r[at.motors] = r[at.motors + 1] = r[at.motors + 2] = r[at.motors + 3] = 0.0
    for c in range(w.size):
        line[newest, c] = r[at.commands[c]]
        w[c] = motor_step(
            w[c], before(line, newest, c, r[at.when[1]]), before(line, newest, c, r[at.when[0]]),
            r[at.lag[c]], uneven(at.factors[c]), at.factors[c], r[at.when[2]], dt, lags[c], own)
        r[at.motors] += at.row[c] * own[0] * 2.0 / dt
        r[at.motors + 1] += at.row[c] * own[1] * 2.0 / dt
        r[at.motors + 2] += at.row[c] * own[2]
        r[at.motors + 3] += at.row[c] * own[3]
    return newest


@inner
def step(at: Places, code: IntArray, more: IntArray, tables: FloatArray, r: FloatArray,
         line: FloatArray, w: FloatArray, newest: int, dt: float, lags: FloatArray,
         own: FloatArray, following: FloatArray) -> int:
    """One cycle of a plant by its operations: the state in the registers r a cycle later.

    The command, the acceleration and what is known of the cycle are in r already; line (d, c) and
    w (c,) commands under way, from `newest` on, and behind their lags. Gives the new `newest`.
    Through following (states,) they are copied, for a state may become another one.
    """
    operate(code, more, tables, r, 0, at.split)
    newest = driven(at, r, line, w, newest, dt, lags, own)
    operate(code, more, tables, r, at.split, code.shape[0])
    for i in range(following.size):
        following[i] = r[at.following[i]]
    for i in range(following.size):
        r[at.state + i] = following[i]
    return newest


@kernel(PLACES, WHOLE[:, ::1], WHOLES, LINE, LINE, TABLE, LINE, WHOLE, NUMBER)
def cycle(at: Places, code: IntArray, more: IntArray, tables: FloatArray, r: FloatArray,
          line: FloatArray, w: FloatArray, newest: int, dt: float) -> int:
    """`step`, for a controller in Python."""
    return int(step(at, code, more, tables, r, line, w, newest, dt, np.zeros((w.size, 3, 3)),
                    np.zeros(4), np.empty(at.following.size)))


@kernel(WHOLE[:, ::1], WHOLES, LINE, LINE, WHOLE, WHOLE)
def part(code: IntArray, more: IntArray, tables: FloatArray, r: FloatArray, begin: int,
         end: int) -> None:
    """Some operations, where laws in Python stand between them."""
    operate(code, more, tables, r, begin, end)


@kernel(PLACES, LINE, TABLE, LINE, WHOLE, NUMBER)
def motors(at: Places, r: FloatArray, line: FloatArray, w: FloatArray, newest: int,
           dt: float) -> int:
    """`driven`, alike."""
    return int(driven(at, r, line, w, newest, dt, np.zeros((w.size, 3, 3)), np.zeros(4)))


@kernel(GAINS, PLACES, WHOLE[:, ::1], WHOLES, LINE, LINE, LINE, TABLE, LINE, TABLE, TABLE, TABLE,
        NUMBER)
def fly(gains: Constants, at: Places, code: IntArray, more: IntArray, tables: FloatArray,
        r: FloatArray, first: FloatArray, line: FloatArray, w: FloatArray, known: FloatArray,
        signals: FloatArray, out: FloatArray, lead: float) -> None:
    """The cascade around a plant by its operations; `lead`: of the angle over the rate's sum, s.

    r: registers, with the state at the start; first (2,) rate and angle as they are measured
    there; line and w as in `step`; known (n, s) of each cycle; signals (5, n): angle reference,
    noise of the rate, acceleration, excitation of rate and control; out (4, n): angle, rate,
    control, rate reference.
    """
    memory, shown, angle_shown, newest = np.zeros(MEMORY), first[0], first[1], 0
    lags, own, following = np.zeros((w.size, 3, 3)), np.zeros(4), np.empty(at.following.size)
    if gains.d_on_error == 0.0:
        memory[LAST] = shown
        memory[NOTCH] = memory[NOTCH + 1] = (1.0 - gains.notch) * shown
    for k in range(signals.shape[1]):
        rate = shown + signals[1, k]
        angle = angle_shown + lead * rate
        wanted, u = control(gains, memory, signals[0, k], angle, rate, signals[3, k])
        u += signals[4, k]
        out[0, k], out[1, k], out[2, k], out[3, k] = angle, rate, u, wanted
        for i in range(known.shape[1]):
            r[at.given + i] = known[k, i]
        r[at.sent], r[at.push] = u, signals[2, k]
        newest = step(at, code, more, tables, r, line, w, newest, gains.dt, lags, own, following)
        shown, angle_shown = r[at.shown[0]], r[at.shown[1]]


@kernel(GAINS, TABLE, LINE, LINE, TABLE, NUMBER)
def run_polynomial(gains: Constants, signals: FloatArray, a: FloatArray, b: FloatArray,
                   out: FloatArray, lead: float) -> None:
    """The cascade around A(q) rate = B(q) u with a[0] = 1, b[0] = 0; the angle is its sum."""
    memory = np.zeros(MEMORY)
    clean = np.zeros(signals.shape[1])
    angle = 0.0
    for k in range(signals.shape[1]):
        total = 0.0
        for i in range(1, min(b.size, k + 1)):
            total += b[i] * out[2, k - i]
        for i in range(1, min(a.size, k + 1)):
            total -= a[i] * clean[k - i]
        clean[k] = total
        if k > 0:
            angle += 0.5 * gains.dt * (clean[k] + clean[k - 1])
        rate = total + signals[1, k]
        predicted = angle + lead * rate
        wanted, u = control(gains, memory, signals[0, k], predicted, rate, 0.0)
        out[0, k], out[1, k], out[2, k], out[3, k] = predicted, rate, u, wanted
