"""Compiled laws row after row: `carried` repeats the operations of any law (model/traced.py).

Linear states have a loop of their own, and what takes many steps in a cycle (a load with play, a
part that yields) is one operation. Only arithmetic on arrays, one by one as in recursion.py.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from quad_sysid.compiled import BLOCK, LINE, NUMBER, TABLE, WHOLE, WHOLES, inner, kernel
from quad_sysid.model.traced import CODES

IntArray = NDArray[np.int64]
(ADD, SUBTRACT, MULTIPLY, DIVIDE, MAXIMUM, MINIMUM, POWER, GREATER, GREATER_EQUAL, LESS,
 LESS_EQUAL, NEGATIVE, ABSOLUTE, SIGN, EXP, LOG, SQRT, SIN, COS, TANH, FLOOR, RINT, WHERE, INTERP,
 LOOSE, YIELDED, _) = CODES.values()


@kernel(LINE, LINE, LINE, LINE, TABLE)
def hats(x, factor, knots, mean, out):
    """Derivatives of factor (n,) times a curve at x (n,) by its values at the knots: (n, k) `out`.

    Linear between the knots and constant beyond them, less its mean.
    """
    last = knots.size - 1
    for i in range(x.size):
        for j in range(knots.size):
            out[i, j] = -factor[i] * mean[j]
        at = min(max(x[i], knots[0]), knots[last])
        j = 0
        while j < last - 1 and at >= knots[j + 1]:
            j += 1
        share = (at - knots[j]) / (knots[j + 1] - knots[j])
        out[i, j] += factor[i] * (1.0 - share)
        out[i, j + 1] += factor[i] * share


@kernel(LINE, TABLE, LINE, WHOLE, WHOLE, TABLE)
def linear_states(moving, a, b, start, stop, out):
    """States x of x+ = a x + b moving, at the start of each cycle: (m, n) into `out`.

    They begin as out[:, start].
    """
    m = b.size
    x, new = np.empty(m), np.empty(m)
    for i in range(m):
        x[i] = out[i, start]
    for k in range(start, stop - 1):
        for i in range(m):
            total = b[i] * moving[k]
            for j in range(m):
                total += a[i, j] * x[j]
            new[i] = total
            out[i, k + 1] = total
        x, new = new, x


@inner
def loose_ahead(pull, moved, spring, damping, dt, z, q):
    """A loose mass a cycle later: its place z and own speed q, and its acceleration f meanwhile.

    z' = q - moved, q' = pull + f, f = -spring² z / (1 - z²) - damping z'; at |z| = 1 it stops
    dead. By the trapezoidal rule in steps of about 1 ms.
    """
    parts = max(1, round(dt / 0.001))
    h, previous = dt / parts, q
    for _ in range(parts):
        stiff = spring**2 / max(1.0 - z * z, 0.02)
        v, back = q - moved, 0.5 * h * damping + 0.25 * h * h * stiff
        new = ((1.0 - back) * v + h * (pull - stiff * z)) / (1.0 + back)
        z += 0.5 * h * (v + new)
        if abs(z) > 1.0:
            z, new = math.copysign(1.0, z), 0.0
        q = new + moved
    return z, q, (q - previous) / dt - pull


@kernel(LINE, LINE, LINE, LINE, NUMBER, NUMBER, NUMBER, TABLE)
def all_loose_ahead(pull, moved, z, q, spring, damping, dt, out):
    """`loose_ahead` of w flights: place, own speed and acceleration, into `out` (3, w)."""
    for i in range(pull.size):
        out[0, i], out[1, i], out[2, i] = loose_ahead(
            pull[i], moved[i], spring, damping, dt, z[i], q[i]
        )


@inner
def yielded(x, push, slope, lean, flow, dt):
    """A state x a cycle later: x' = push - flow (slope x + lean x² + x³).

    The steps are of 1 ms; what draws x back is implicit, x³ by one step of Newton's method.
    """
    parts = max(1, round(dt / 0.001))
    h = dt / parts
    flows, back = h * flow, max(slope, 0.0)
    for _ in range(parts):
        cube = x * x * x
        explicit = x + h * push - flows * ((slope - back) * x + lean * x * x - 2.0 * cube)
        x = explicit / (1.0 + flows * (back + 3.0 * x * x))
    return x


@kernel(LINE, LINE, NUMBER, NUMBER, NUMBER, NUMBER, TABLE)
def all_yielded(x, push, slope, lean, flow, dt, out):
    """The states (w,) a cycle later, into `out` (1, w)."""
    for i in range(x.size):
        out[0, i] = yielded(x[i], push[i], slope, lean, flow, dt)


@inner
def over(tables, at, n, i, x):
    """numpy.interp over n knots, which stand at a place of table i with their values behind."""
    if x <= tables[at, i]:
        return float(tables[at + n, i])
    for j in range(1, n):
        if x < tables[at + j, i]:
            low = tables[at + n + j - 1, i]
            slope = (tables[at + n + j, i] - low) / (tables[at + j, i] - tables[at + j - 1, i])
            return float(slope * (x - tables[at + j - 1, i]) + low)
    return float(tables[at + 2 * n - 1, i])


@inner
def value(what, x, y):  # noqa: PLR0911 - a table
    """The result of one of the rarer operations on x, or on x and y."""
    if what == POWER:
        return x ** y
    if what == GREATER:
        return 1.0 if x > y else 0.0
    if what == GREATER_EQUAL:
        return 1.0 if x >= y else 0.0
    if what == LESS:
        return 1.0 if x < y else 0.0
    if what == LESS_EQUAL:
        return 1.0 if x <= y else 0.0
    if what == SIGN:
        return 1.0 if x > 0.0 else -1.0 if x < 0.0 else x
    if what == LOG:
        return math.log(x)
    if what == SQRT:
        return math.sqrt(x)
    if what == SIN:
        return math.sin(x)
    if what == COS:
        return math.cos(x)
    if what == FLOOR:
        return np.floor(x)
    return np.rint(x)


@inner
def operate(code, more, tables, r, begin, end):
    """Do the operations [begin, end) of `code` (m, 4) on the registers r (registers, w)."""
    for k in range(begin, end):
        what, to, a, b = code[k, 0], code[k, 1], code[k, 2], code[k, 3]
        if what == ADD:
            for i in range(r.shape[1]):
                r[to, i] = r[a, i] + r[b, i]
        elif what == SUBTRACT:
            for i in range(r.shape[1]):
                r[to, i] = r[a, i] - r[b, i]
        elif what == MULTIPLY:
            for i in range(r.shape[1]):
                r[to, i] = r[a, i] * r[b, i]
        elif what == DIVIDE:
            for i in range(r.shape[1]):
                r[to, i] = r[a, i] / r[b, i]
        elif what == MAXIMUM:
            for i in range(r.shape[1]):
                r[to, i] = max(r[a, i], r[b, i])
        elif what == MINIMUM:
            for i in range(r.shape[1]):
                r[to, i] = min(r[a, i], r[b, i])
        elif what == NEGATIVE:
            for i in range(r.shape[1]):
                r[to, i] = -r[a, i]
        elif what == ABSOLUTE:
            for i in range(r.shape[1]):
                r[to, i] = abs(r[a, i])
        elif what == EXP:
            for i in range(r.shape[1]):
                r[to, i] = math.exp(r[a, i])
        elif what == TANH:
            for i in range(r.shape[1]):
                r[to, i] = math.tanh(r[a, i])
        elif what == WHERE:
            for i in range(r.shape[1]):
                r[to, i] = r[more[a + 1], i] if r[more[a], i] != 0.0 else r[more[a + 2], i]
        elif what == INTERP:
            for i in range(r.shape[1]):
                r[to, i] = over(tables, int(r[more[a + 1], i]), int(r[more[a + 2], i]), i,
                                r[more[a], i])
        elif what == LOOSE:
            for i in range(r.shape[1]):
                r[to, i], r[to + 1, i], r[to + 2, i] = loose_ahead(
                    r[more[a], i], r[more[a + 1], i], r[more[a + 4], i], r[more[a + 5], i],
                    r[more[a + 6], i], r[more[a + 2], i], r[more[a + 3], i])
        elif what == YIELDED:
            for i in range(r.shape[1]):
                r[to, i] = yielded(
                    r[more[a], i], r[more[a + 1], i], r[more[a + 2], i], r[more[a + 3], i],
                    r[more[a + 4], i], r[more[a + 5], i])
        else:
            for i in range(r.shape[1]):
                r[to, i] = value(what, r[a, i], r[b, i])


@kernel(WHOLE[:, ::1], WHOLES, TABLE, TABLE, BLOCK, WHOLES, WHOLES, WHOLE, WHOLE, BLOCK)
def carried(code, more, tables, r, known, at, following, begin, end, out):
    """States by their operations over the cycles [begin, end): `out` (m, n, w) at their starts.

    r (registers, w) and tables (t, w) of w runs side by side; known (s, n, w) is known of each
    cycle, its registers are `at` (s,); the state of m numbers stands in the first registers, those
    of a cycle later in `following` (m,).
    """
    m, w = following.size, r.shape[1]
    new = np.empty((m, w))
    for k in range(begin, end):
        for i in range(m):
            for j in range(w):
                out[i, k, j] = r[i, j]
        for i in range(at.size):
            for j in range(w):
                r[at[i], j] = known[i, k, j]
        operate(code, more, tables, r, 0, code.shape[0])
        for i in range(m):  # a state may become another one
            for j in range(w):
                new[i, j] = r[following[i], j]
        for i in range(m):
            for j in range(w):
                r[i, j] = new[i, j]
