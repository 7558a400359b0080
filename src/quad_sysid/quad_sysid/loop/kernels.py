"""Compiled inner loops of the closed loop: one control cycle, the plant between two cycles.

Only arithmetic on arrays; simulation.py says what the numbers mean.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import types

from quad_sysid.compiled import BLOCK, LINE, NUMBER, TABLE, WHOLE, WHOLES, inner, kernel
from quad_sysid.contract import FloatArray

IntArray = npt.NDArray[np.int64]
INTEGRAL, LAST_RATE, D_PART = 0, 1, 2
EMPTY = 3
"""Size of an empty table."""


class Constants(NamedTuple):
    """The cascade's numbers, as in CascadeGains; d_weight from derivative_weight."""

    angle_kp: float
    rate_kp: float
    rate_ki: float
    rate_kd: float
    d_weight: float
    output_limit: float
    rate_limit: float
    integrator_limit: float
    dt: float


class Cycle(NamedTuple):
    """The plant over one control cycle in two parts: before and after the command changes."""

    phi: FloatArray
    """(2, n, n) transition over one step of a part."""
    drive: FloatArray
    """(2, n) effect of the held command."""
    push: FloatArray
    """(2, n) effect of a held torque."""
    split: IntArray
    """(2,) steps in each part."""
    whole: int
    """Whole cycles of delay."""
    rate_output: int
    angle_output: int
    rate_table: FloatArray
    angle_table: FloatArray
    command_table: FloatArray
    """Tables are (x0, step, y0, y1, …), or of size EMPTY."""


GAINS = types.NamedUniTuple(NUMBER, len(Constants._fields), Constants)
CYCLE = types.NamedTuple(
    (BLOCK, TABLE, TABLE, WHOLES, WHOLE, WHOLE, WHOLE, LINE, LINE, LINE), Cycle)


@inner
def look_up(table: FloatArray, x: float) -> float:
    """Value of a table at x, outside it along the end slopes; 0 if empty."""
    if table.size == EMPTY:
        return 0.0
    last = table.size - 3
    position = (x - table[0]) / table[1]
    index = min(max(math.floor(position), 0), last - 1)
    low = table[2 + index]
    return float(low + (position - index) * (table[3 + index] - low))


@inner
def control(gains: Constants, memory: FloatArray, reference: float, angle: float, rate: float,
            added: float) -> tuple[float, float]:
    """One cycle of C1/C2: (rate reference, u). `added` is a rate excitation; memory (3,)."""
    wanted = gains.angle_kp * (reference - angle)
    wanted = min(max(wanted, -gains.rate_limit), gains.rate_limit) + added
    error = wanted - rate
    total = memory[INTEGRAL] + gains.rate_ki * error * gains.dt
    memory[INTEGRAL] = min(max(total, -gains.integrator_limit), gains.integrator_limit)
    slope = (rate - memory[LAST_RATE]) / gains.dt
    memory[D_PART] += gains.d_weight * (slope - memory[D_PART])
    memory[LAST_RATE] = rate
    u = gains.rate_kp * error + memory[INTEGRAL] - gains.rate_kd * memory[D_PART]
    return wanted, min(max(u, -gains.output_limit), gains.output_limit)


@kernel(GAINS, TABLE, TABLE, LINE, LINE, LINE)
def control_each(gains: Constants, memory: FloatArray, inputs: FloatArray, angle: FloatArray,
                 rate: FloatArray, out: FloatArray) -> None:
    """One cycle of f cascades: u (f,) with the excitation after C2.

    memory (f, 3); inputs (f, 3): angle reference, excitation of the rate, of the control; angle
    and rate (f,).
    """
    for i in range(angle.size):
        _, u = control(gains, memory[i], inputs[i, 0], angle[i], rate[i], inputs[i, 1])
        out[i] = u + inputs[i, 2]


@inner
def advance(cycle: Cycle, part: int, v: float, torque: float, state: FloatArray) -> None:
    """One step of `part` in place: exact linear part, Heun for the curves."""
    n = state.size
    phi, drive, push = cycle.phi[part], cycle.drive[part], cycle.push[part]
    x = torque + look_up(cycle.rate_table, state[1]) + look_up(cycle.angle_table, state[2])
    free = np.empty(n)
    for i in range(n):
        total = drive[i] * v
        for j in range(n):
            total += phi[i, j] * state[j]
        free[i] = total
    if cycle.rate_table.size > EMPTY or cycle.angle_table.size > EMPTY:
        then = torque + look_up(cycle.rate_table, free[1] + push[1] * x)
        then += look_up(cycle.angle_table, free[2] + push[2] * x)
        x = 0.5 * (x + then)
    for i in range(n):
        state[i] = free[i] + push[i] * x


@kernel(GAINS, CYCLE, TABLE, LINE, TABLE, NUMBER)
def run_plant(gains: Constants, cycle: Cycle, signals: FloatArray, state: FloatArray,
              out: FloatArray, lead: float) -> None:
    """The cascade around the plant; `lead`: of the measured angle over the rate's integral, s.

    signals (5, n): angle reference, noise of the rate, torque, rate and control excitation;
    out (4, n): angle, rate, control, rate reference. `state` ends where the run ends.
    """
    memory = np.zeros(3)
    memory[LAST_RATE] = state[cycle.rate_output]
    for k in range(signals.shape[1]):
        rate = state[cycle.rate_output] + signals[1, k]
        angle = state[cycle.angle_output] + lead * rate
        wanted, u = control(gains, memory, signals[0, k], angle, rate, signals[3, k])
        out[0, k], out[1, k], out[2, k], out[3, k] = angle, rate, u + signals[4, k], wanted
        for part in range(2):
            source = k - cycle.whole - 1 + part
            v = out[2, source] if source >= 0 else 0.0
            if cycle.command_table.size > EMPTY:
                v = look_up(cycle.command_table, v)
            for _ in range(cycle.split[part]):
                advance(cycle, part, v, signals[2, k], state)


@kernel(GAINS, TABLE, LINE, LINE, TABLE, NUMBER)
def run_polynomial(gains: Constants, signals: FloatArray, a: FloatArray, b: FloatArray,
                   out: FloatArray, lead: float) -> None:
    """The cascade around A(q) rate = B(q) u with a[0] = 1, b[0] = 0; the angle is its sum."""
    memory = np.zeros(3)
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
        seen = angle + lead * rate
        wanted, u = control(gains, memory, signals[0, k], seen, rate, 0.0)
        out[0, k], out[1, k], out[2, k], out[3, k] = seen, rate, u, wanted
