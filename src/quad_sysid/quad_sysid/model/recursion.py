"""Compiled inner loops: motors behind a lag, and the Kalman predictor with its sensitivities.

Only arithmetic on arrays. The predictor's states are the rate, the torque disturbance and the two
states of the sensor. Physics enters as accelerations over the two halves of each cycle, already
evaluated along a trajectory, with their slope over the rate. So the recursion is linear, and one
loop serves every structure and all its derivatives (model/flight.py).
Numbers are handled one by one: whole arrays in an expression take numba seconds to compile.
"""

from __future__ import annotations

import math

import numpy as np

from quad_sysid.compiled import (
    BLOCK,
    BLOCKS,
    FLAG,
    FLAGS,
    LINE,
    NUMBER,
    TABLE,
    WHOLE,
    WHOLES,
    inner,
    kernel,
)


@inner
def between(x, knots, values):
    """A curve over x, linear between its values at the knots (k,) and constant beyond them."""
    if x <= knots[0]:
        return values[0]
    for i in range(1, knots.size):
        if x < knots[i]:
            share = (x - knots[i - 1]) / (knots[i] - knots[i - 1])
            return values[i - 1] + share * (values[i] - values[i - 1])
    return values[-1]


@inner
def uneven(factors):
    """Whether a motor's lag depends on how far it has to go, by its curve (2, k)."""
    bent = False
    for i in range(factors.shape[1]):
        bent = bent or factors[1, i] != 0.0
    return bent


@inner
def motor_step(w, new, before, tau, bent, factors, fraction, dt, solved, out):
    """A motor's lagged command w a cycle later, whose command changes after a `fraction` of it.

    tau s, where `bent` times the exponential of a curve over how far the motor has to go,
    factors (2, k) its knots and values. out (4,) receives the areas over both halves of the cycle,
    w and the command at its middle. solved (3, 3) holds lengths, lags and decays of the cycle
    before, most often the same. It is exact for a held command and a constant lag.
    """
    cut0, cut1 = min(fraction, 0.5), max(fraction, 0.5)
    older = 1 if fraction < 0.5 else 2  # lengths with the older command
    first = 3 - older  # lengths in the first half
    out[0] = out[1] = 0.0
    for i in range(3):
        h = cut0 * dt if i == 0 else (cut1 - cut0) * dt if i == 1 else (1.0 - cut1) * dt
        u = before if i < older else new
        if h > 0.0:
            lag = tau
            if bent:
                lag *= math.exp(between(u - w, factors[0], factors[1]))
            if lag != solved[1, i] or h != solved[0, i]:
                solved[0, i], solved[1, i], solved[2, i] = h, lag, math.exp(-h / lag)
            decay, difference = solved[2, i], w - u
            out[0 if i < first else 1] += u * h + difference * lag * (1.0 - decay)
            w = u + difference * decay
        if i == first - 1:
            out[2], out[3] = w, u
    return w


@inner
def sent(commands, k, age, start):
    """The command (n,) that was sent `age` cycles before the k-th, linear between two."""
    cycles = math.floor(age)
    new = commands[max(k - int(cycles), start)]
    if age == cycles:
        return new
    return new + (age - cycles) * (commands[max(k - int(cycles) - 1, start)] - new)


@inner
def motor_response(commands, weight, tau, older, newer, fraction, dt, start, stop, halves, states):
    """Add the response of one motor of constant lag and delay to `halves` and `states`.

    With both commands of a cycle held, all that motor_step solves is linear in w and these two.
    """
    solved, out, by = np.zeros((3, 3)), np.zeros(4), np.empty((5, 3))
    for i in range(3):  # w, the newer command and the older one
        by[4, i] = motor_step(1.0 * (i == 0), 1.0 * (i == 1), 1.0 * (i == 2), tau, False,
                              np.zeros((2, 1)), fraction, dt, solved, out)
        for j in range(4):
            by[j, i] = weight * out[j]
    keep, into, past = by[4, 0], by[4, 1], by[4, 2]
    w = commands[start]
    for k in range(start, stop):
        new, before = sent(commands, k, newer, start), sent(commands, k, older, start)
        halves[0, k] += by[0, 0] * w + by[0, 1] * new + by[0, 2] * before
        halves[1, k] += by[1, 0] * w + by[1, 1] * new + by[1, 2] * before
        states[0, k] += by[2, 0] * w + by[2, 1] * new + by[2, 2] * before
        states[1, k] += by[3, 0] * w + by[3, 1] * new + by[3, 2] * before
        w = keep * w + into * new + past * before


@inner
def motor_responses(commands, channels, row, lag, factors, ages, fraction, dt, start, stop, halves,
                    states):
    """Add the responses of these channels to the arrays of `motors`, each as by motor_step.

    All of them take a part of a cycle before the next part, so that the processor does not wait
    for one exponential to begin another, which motor_step by motor_step takes half as long again.
    """
    m = channels.size
    w, new, before, bent = np.empty(m), np.empty(m), np.empty(m), np.empty(m, np.bool_)
    parts, sums = np.zeros((m, 3, 3)), np.empty(2)  # length, lag and decay as in motor_step
    for i in range(m):
        w[i], bent[i] = commands[channels[i], start], uneven(factors[channels[i]])
    for k in range(start, stop):
        cut0, cut1 = min(fraction[k], 0.5), max(fraction[k], 0.5)
        older = 1 if fraction[k] < 0.5 else 2
        first = 3 - older
        sums[0] = sums[1] = 0.0
        for i in range(m):
            new[i] = sent(commands[channels[i]], k, ages[1, k], start)
            before[i] = sent(commands[channels[i]], k, ages[0, k], start)
        for part in range(3):
            h = cut0 * dt if part == 0 else (cut1 - cut0) * dt if part == 1 else (1.0 - cut1) * dt
            current, area = before if part < older else new, 0.0
            if h > 0.0:
                for i in range(m):
                    c, u, tau = channels[i], current[i], lag[channels[i], k]
                    difference = w[i] - u
                    if bent[i]:
                        back = math.exp(-between(-difference, factors[c, 0], factors[c, 1]))
                        decay, tau = math.exp(-(h / tau) * back), tau / back
                    else:
                        if tau != parts[i, part, 1] or h != parts[i, part, 0]:
                            parts[i, part, 0], parts[i, part, 1] = h, tau
                            parts[i, part, 2] = math.exp(-h / tau)
                        decay = parts[i, part, 2]
                    area += row[c] * (u * h + difference * tau * (1.0 - decay))
                    w[i] = u + difference * decay
            sums[0 if part < first else 1] += area
            if part == first - 1:
                for i in range(m):
                    states[0, k] += row[channels[i]] * w[i]
                    states[1, k] += row[channels[i]] * current[i]
        halves[0, k] += sums[0]
        halves[1, k] += sums[1]


@kernel(TABLE, LINE, TABLE, BLOCK, TABLE, LINE, NUMBER, WHOLE, WHOLE, TABLE, TABLE)
def motors(commands, row, lag, factors, ages, fraction, dt, start, stop, halves, states):
    """Drive of one axis: each command after its delay and lag, mixed by `row`.

    commands (c, n) held over a cycle; row (c,); lag (c, n) s, and factors (c, 2, k) as in
    motor_step; ages (2, n) and fraction (n,) as in effect.Drive. halves (2, n), zeros before,
    receives the mean drive over both halves of each cycle in [start, stop), states (2, n) the
    drive and the delayed command at its middle.
    """
    others = np.empty(commands.shape[0], np.int64)
    count = 0
    for c in range(commands.shape[0]):
        even = not uneven(factors[c])
        for k in range(start + 1, stop):
            even = even and lag[c, k] == lag[c, start] and fraction[k] == fraction[start] \
                and ages[0, k] == ages[0, start] and ages[1, k] == ages[1, start]
        if even and row[c] != 0.0:
            motor_response(commands[c], row[c], lag[c, start], ages[0, start], ages[1, start],
                           fraction[start], dt, start, stop, halves, states)
        elif row[c] != 0.0:
            others[count] = c
            count += 1
    if count:
        motor_responses(commands, others[:count], row, lag, factors, ages, fraction, dt, start,
                        stop, halves, states)
    for k in range(start, stop):
        halves[0, k] *= 2.0 / dt
        halves[1, k] *= 2.0 / dt


@kernel(TABLE, TABLE, TABLE, LINE, TABLE, BLOCK, LINE, NUMBER, TABLE)
def motors_step(w, new, before, row, lag, factors, fraction, dt, out):
    """One cycle of m flights: w (c, m) in place; new, before, lag (c, m), fraction (m,).

    out (4, m) receives the mean drive over both halves, the drive and the command at mid-cycle.
    """
    sums, solved = np.zeros(4), np.zeros((3, 3))
    for i in range(w.shape[1]):
        out[0, i] = out[1, i] = out[2, i] = out[3, i] = 0.0
    for c in range(w.shape[0]):
        bent = uneven(factors[c])
        for i in range(w.shape[1]):
            w[c, i] = motor_step(w[c, i], new[c, i], before[c, i], lag[c, i], bent, factors[c],
                                 fraction[i], dt, solved, sums)
            out[0, i] += row[c] * sums[0] * 2.0 / dt
            out[1, i] += row[c] * sums[1] * 2.0 / dt
            out[2, i] += row[c] * sums[2]
            out[3, i] += row[c] * sums[3]


@kernel(LINE, NUMBER, TABLE, LINE, LINE, LINE, TABLE, FLAG, NUMBER, FLAGS, WHOLE, WHOLE, TABLE,
        TABLE, WHOLES, TABLE, TABLE, BLOCK, BLOCKS, WHOLES, LINE, TABLE, LINE, TABLE)
def predict(y, begin, known, slope, gain, move, gyro, behind, dt, follows_gyro, start, stop,
            columns, bends, bent, filters, wander, pursuit, by_pursuit, place, rate, states,
            innovation, jacobian):
    """Innovations of the predictor over [start, stop) and their derivatives.

    y (n,) measured, begin the rate at the start. known (2, n) acceleration over the halves of each
    cycle, without what `slope` (n,) times the rate at half cycle adds. columns (n, m) derivatives
    of the mean acceleration of each cycle, bends (n, b) half the difference of its halves for
    those whose numbers are in bent (b,). States: rate, disturbance, the sensor's two, and two of
    each of the v lines in the noise. gain (4 + 2 v,) what the innovation adds to them; move (2 + 2
    v,): what is left of the disturbance after a cycle, its mean over the cycle, and the turn of
    each line (cosine and sine times what is left of it); filters (m, 6 + 4 v) the derivatives of
    both; nothing is added where y is NaN. gyro (2, 5) as in noise.Sensor.step, measured where
    `behind`. In cycles of `follows_gyro` (n,) rate and sensor are as measured, and nothing else is
    learnt. wander (n, w): acceleration per unit of each wandering term; pursuit (n, w, 2): what an
    innovation adds to it, and what is left of it after the cycle, by_pursuit (n, w, 2, 2) their
    derivatives by its two parameters, whose columns begin at place (w,). rate (n,) receives the
    rate at half cycle, states (n, 4 + 2 v + w) the prediction before the innovation, innovation
    (n,) and jacobian (n, m) what the name says. Each array of m numbers is one of its own and each
    loop over them plain, so that the compiler handles several at once.
    """
    m, wanders, first = columns.shape[1], wander.shape[1], gain.size
    g00, g01, g02, g03, g04 = gyro[0, 0], gyro[0, 1], gyro[0, 2], gyro[0, 3], gyro[0, 4]
    g10, g11, g12, g13, g14 = gyro[1, 0], gyro[1, 1], gyro[1, 2], gyro[1, 3], gyro[1, 4]
    c0, c1, c2, c3 = gain[0], gain[1], gain[2], gain[3]
    fade, hold, lines = move[0], move[1], first // 2 - 2
    n0, n1, n2, n3 = np.empty(m), np.empty(m), np.empty(m), np.empty(m)
    t0, t1 = np.empty(m), np.empty(m)
    into, turn = np.empty((lines, 2)), np.empty((lines, 2))
    by_into, by_turn = np.empty((lines, 2, m)), np.empty((lines, 2, m))
    for j in range(m):
        n0[j], n1[j], n2[j], n3[j] = filters[j, 0], filters[j, 1], filters[j, 2], filters[j, 3]
        t0[j], t1[j] = filters[j, first], filters[j, first + 1]
    for i in range(lines):
        for h in range(2):
            into[i, h], turn[i, h] = gain[4 + 2 * i + h], move[2 + 2 * i + h]
            for j in range(m):
                by_into[i, h, j] = filters[j, 4 + 2 * i + h]
                by_turn[i, h, j] = filters[j, first + 2 + 2 * i + h]
    r, d, g, q = begin, 0.0, y[start], 0.0
    v, x = np.zeros((lines, 2)), np.zeros(wanders)
    s0, s1, s2, s3 = np.zeros(m), np.zeros(m), np.zeros(m), np.zeros(m)
    sv, sx = np.zeros((lines, 2, m)), np.zeros((wanders, m))
    z, forced = np.empty(m), np.empty(m)
    for k in range(start, stop):
        states[k, 0], states[k, 1], states[k, 2], states[k, 3] = r, d, g, q
        e = y[k] - (g if behind else r)
        if behind:
            for j in range(m):
                z[j] = -s2[j]
        else:
            for j in range(m):
                z[j] = -s0[j]
        for i in range(lines):
            states[k, 4 + 2 * i], states[k, 5 + 2 * i] = v[i, 0], v[i, 1]
            e -= v[i, 0]
            for j in range(m):
                z[j] -= sv[i, 0, j]
        innovation[k] = e
        if not np.isfinite(y[k]):
            e = 0.0
            for j in range(m):
                z[j] = 0.0
        if follows_gyro[k]:
            r, g, e, innovation[k] = r + e, g + e, 0.0, np.nan
            for j in range(m):
                s0[j] += z[j]
                s2[j] += z[j]
                z[j] = 0.0
        for j in range(m):
            jacobian[k, j] = z[j]
            forced[j] = columns[k, j]
        r += c0 * e
        d += c1 * e
        g += c2 * e
        q += c3 * e
        for i in range(lines):
            a, b, c, s = into[i, 0], into[i, 1], turn[i, 0], turn[i, 1]
            v0, v1 = v[i, 0] + a * e, v[i, 1] + b * e
            for j in range(m):
                x0 = sv[i, 0, j] + a * z[j] + by_into[i, 0, j] * e
                x1 = sv[i, 1, j] + b * z[j] + by_into[i, 1, j] * e
                sv[i, 0, j] = c * x0 - s * x1 + by_turn[i, 0, j] * v0 - by_turn[i, 1, j] * v1
                sv[i, 1, j] = c * x1 + s * x0 + by_turn[i, 0, j] * v1 + by_turn[i, 1, j] * v0
            v[i, 0], v[i, 1] = c * v0 - s * v1, c * v1 + s * v0
        wander_sum = 0.0
        for i in range(wanders):
            states[k, first + i] = x[i]
            x[i] += pursuit[k, i, 0] * e
            wander_sum += wander[k, i] * x[i]
            for j in range(m):
                sx[i, j] += pursuit[k, i, 0] * z[j]
            for j in range(min(m, 2)):
                sx[i, place[i] + j] += by_pursuit[k, i, 0, j] * e
            for j in range(m):
                forced[j] += wander[k, i] * sx[i, j]
        a = 0.5 * dt * slope[k]
        factor = (1.0 + a) / (1.0 - a)
        input_gain = dt / (1.0 - a)
        mean = 0.5 * (known[0, k] + known[1, k])
        new = factor * r + input_gain * (mean + wander_sum + hold * d)
        middle = 0.5 * (r + new)
        rate[k] = middle
        curved = middle + 0.25 * dt * (known[0, k] - known[1, k])
        for j in range(m):
            x0 = s0[j] + c0 * z[j] + n0[j] * e
            x1 = s1[j] + c1 * z[j] + n1[j] * e
            x2 = s2[j] + c2 * z[j] + n2[j] * e
            x3 = s3[j] + c3 * z[j] + n3[j] * e
            x4 = factor * x0 + input_gain * (forced[j] + hold * x1 + t1[j] * d)
            mid = 0.5 * (x0 + x4)
            s0[j] = x4
            s1[j] = fade * x1 + t0[j] * d
            s2[j] = g00 * x2 + g01 * x3 + g02 * x0 + g03 * mid + g04 * x4
            s3[j] = g10 * x2 + g11 * x3 + g12 * x0 + g13 * mid + g14 * x4
        for i in range(wanders):
            for j in range(m):
                sx[i, j] *= pursuit[k, i, 1]
            for j in range(min(m, 2)):
                sx[i, place[i] + j] += by_pursuit[k, i, 1, j] * x[i]
            x[i] *= pursuit[k, i, 1]
        for j in range(bends.shape[1]):
            s2[bent[j]] += g03 * 0.5 * dt * bends[k, j]
            s3[bent[j]] += g13 * 0.5 * dt * bends[k, j]
        g, q = (g00 * g + g01 * q + g02 * r + g03 * curved + g04 * new,
                g10 * g + g11 * q + g12 * r + g13 * curved + g14 * new)
        r = new
        d *= fade


@kernel(LINE, TABLE, TABLE, BLOCK, TABLE, TABLE, BLOCK, BLOCK, BLOCK, FLAG, NUMBER, WHOLE, TABLE)
def freely(slope, by_state, by_rate, onward, columns, bends, forward, initial, gyro, noisy, dt,
           length, out):
    """Derivatives of free runs, in windows of `length` cycles one behind the other.

    In each cycle an acceleration has its slope (n,) over the rate, by_state (n, m) over m hidden
    states, and columns (n, p) over the parameters; bends as in `predict`, for all of them. States
    move by by_rate (n, m) with the rate, onward (n, m, m) with each other and forward (n, m, p)
    with the parameters, and begin as initial (windows, m, p). gyro (windows, 2, 5): as in
    noise.Sensor.step. out (n, p) receives what the rate moves by, behind the gyro if noisy.
    """
    m, p = by_state.shape[1], columns.shape[1]
    r, g, q, mid = np.empty(p), np.empty(p), np.empty(p), np.empty(p)
    x, new = np.empty((m, p)), np.empty((m, p))
    for i in range(initial.shape[0]):
        for j in range(p):
            r[j] = g[j] = q[j] = 0.0
            for s in range(m):
                x[s, j] = initial[i, s, j]
        for k in range(i * length, (i + 1) * length):
            a = 0.5 * dt * slope[k]
            factor, input_gain = (1.0 + a) / (1.0 - a), dt / (1.0 - a)
            for j in range(p):
                out[k, j] = g[j] if noisy else r[j]
                mid[j] = columns[k, j]
            for s in range(m):
                for j in range(p):
                    mid[j] += by_state[k, s] * x[s, j]
            for j in range(p):
                end = factor * r[j] + input_gain * mid[j]
                mid[j] = 0.5 * (r[j] + end)
                middle_rate = mid[j] + 0.5 * dt * bends[k, j]
                g0, q0 = g[j], q[j]
                g[j] = gyro[i, 0, 0] * g0 + gyro[i, 0, 1] * q0 + gyro[i, 0, 2] * r[j] \
                    + gyro[i, 0, 3] * middle_rate + gyro[i, 0, 4] * end
                q[j] = gyro[i, 1, 0] * g0 + gyro[i, 1, 1] * q0 + gyro[i, 1, 2] * r[j] \
                    + gyro[i, 1, 3] * middle_rate + gyro[i, 1, 4] * end
                r[j] = end
            for s in range(m):
                for j in range(p):
                    new[s, j] = by_rate[k, s] * mid[j] + forward[k, s, j]
                for h in range(m):
                    for j in range(p):
                        new[s, j] += onward[k, s, h] * x[h, j]
            x, new = new, x


@kernel(LINE, NUMBER, NUMBER, WHOLE, WHOLE, TABLE)
def pursuit(psi, variance, spread, start, stop, out):
    """Gain of a wandering parameter per innovation into the first column of `out` (n, 2).

    psi (n,) derivative of the innovations by the parameter, variance of the innovations, spread
    the parameter's own; the second column says what is left of it after a cycle. The scalar
    Riccati equation of a recursive prediction-error method (Ljung and Söderström 1983, ch. 3).
    """
    p = spread * spread
    decay = out[start, 1]
    more = p * (1.0 - decay * decay)
    for k in range(start, stop):
        total = variance + psi[k] * psi[k] * p
        out[k, 0] = -p * psi[k] / total
        p = decay * decay * p * variance / total + more


@kernel(LINE, LINE, TABLE, WHOLE, WHOLE, LINE)
def pursued(e, psi, pursuit, start, stop, out):
    """Innovations e (n,) after such a parameter has followed them with this gain, into `out`."""
    x = 0.0
    for k in range(start, stop):
        out[k] = e[k] + psi[k] * x
        x = pursuit[k, 1] * (x + pursuit[k, 0] * out[k])


@inner
def product(a, b):
    """A matrix times another one."""
    out = np.zeros((a.shape[0], b.shape[1]))
    for i in range(a.shape[0]):
        for k in range(a.shape[1]):
            for j in range(b.shape[1]):
                out[i, j] += a[i, k] * b[k, j]
    return out


@inner
def transposed(a):
    """A matrix' rows as columns."""
    out = np.empty((a.shape[1], a.shape[0]))
    for i in range(a.shape[0]):
        for j in range(a.shape[1]):
            out[j, i] = a[i, j]
    return out


@inner
def inverse(a):
    """A matrix' inverse by Gauss and Jordan, the largest pivot of each column; `a` is used up."""
    n = a.shape[0]
    out = np.zeros((n, n))
    for i in range(n):
        out[i, i] = 1.0
    for k in range(n):
        pivot = k
        for i in range(k + 1, n):
            if abs(a[i, k]) > abs(a[pivot, k]):
                pivot = i
        for j in range(n):
            a[k, j], a[pivot, j] = a[pivot, j], a[k, j]
            out[k, j], out[pivot, j] = out[pivot, j], out[k, j]
        scale = 1.0 / a[k, k]
        for j in range(n):
            a[k, j] *= scale
            out[k, j] *= scale
        for i in range(n):
            share = a[i, k]
            if i != k and share != 0.0:
                for j in range(n):
                    a[i, j] -= share * a[k, j]
                    out[i, j] -= share * out[k, j]
    return out


@inner
def riccati(f, q, c, r):
    """Steady predicted covariance (n, n) of a Kalman filter, by doubling.

    f (n, n) transition, q (n, n) its noise, c (n,) output, r its noise variance. Anderson (1978).
    """
    n = c.size
    a, g, h = transposed(f), np.empty((n, n)), q.copy()
    for i in range(n):
        for j in range(n):
            g[i, j] = c[i] * c[j] / r
    for _ in range(60):
        mixed = product(g, h)
        for i in range(n):
            mixed[i, i] += 1.0
        w, back = inverse(mixed), transposed(a)
        more_h = product(product(product(back, h), w), a)
        doubled = product(a, w)
        more_g = product(product(doubled, g), back)
        a = product(doubled, a)
        change = largest = 0.0
        for i in range(n):
            for j in range(n):
                g[i, j] += more_g[i, j]
                change = max(change, abs(more_h[i, j]))
                more_h[i, j] += h[i, j]
        for i in range(n):
            for j in range(n):
                h[i, j] = 0.5 * (more_h[i, j] + more_h[j, i])
                largest = max(largest, abs(h[i, j]))
        if change <= 1e-13 * largest:
            break
    return h


@kernel(LINE, NUMBER, TABLE, FLAG, FLAG, FLAG, NUMBER)
def steady_filter(noise, damping, step, behind, noisy, averaged, dt):
    """The fields of noise.Filter, its floor excepted, for a sensor that measures the rate.

    Arguments: as noise.kalman and noise.Sensor name them; noise (4 + 3 v,).
    """
    white, disturbance, correlation, after = noise[0], noise[1], noise[2], noise[3]
    lines = (noise.size - 4) // 3
    fade = math.exp(-dt / correlation)
    hold = correlation / dt * (1.0 - fade)
    a = -0.5 * damping * dt
    factor, input_gain = (1.0 + a) / (1.0 - a), dt / (1.0 - a)
    size = 4 + 2 * lines
    # last, beside the states: the gyro's noise of the cycle before, where it is averaged
    padded = size + 1 if noisy and averaged else size
    rows = np.zeros((padded, padded))
    rows[0, 0], rows[0, 1], rows[1, 1] = factor, input_gain * hold, fade
    by_halves = np.zeros((padded, 2))  # of accelerations over the two halves
    by_halves[0, 0] = by_halves[0, 1] = 0.5 * input_gain
    move, inside = np.empty(2 + 2 * lines), np.empty(2)
    move[0], move[1] = fade, hold
    for i in range(2):
        begin, half, end = step[i, 2], step[i, 3], step[i, 4]
        by_mean = 0.5 * half + end
        inside[i] = begin + half + end
        rows[2 + i, 0] = begin + half * 0.5 * (1.0 + factor) + end * factor
        rows[2 + i, 1] = by_mean * input_gain * hold
        rows[2 + i, 2], rows[2 + i, 3] = step[i, 0], step[i, 1]
        by_halves[2 + i, 0] = by_mean * 0.5 * input_gain + 0.25 * dt * half
        by_halves[2 + i, 1] = by_mean * 0.5 * input_gain - 0.25 * dt * half
    process = product(by_halves, transposed(by_halves))
    for i in range(padded):
        for j in range(padded):
            process[i, j] *= white * white * 2.0 / dt
    process[1, 1] += disturbance * disturbance * (1.0 - fade * fade)
    c = np.zeros(padded)
    c[2 if behind else 0] = 1.0
    for i in range(lines):
        rms, frequency, width = noise[4 + 3 * i], noise[5 + 3 * i], noise[6 + 3 * i]
        decay = math.exp(-math.pi * dt * width)  # after a cycle, in which it turns by an angle
        angle = 2.0 * math.pi * dt * frequency
        along, across = decay * math.cos(angle), decay * math.sin(angle)
        k = 4 + 2 * i
        c[k] = 1.0
        move[2 + 2 * i], move[3 + 2 * i] = along, across
        rows[k, k] = rows[k + 1, k + 1] = along
        rows[k, k + 1], rows[k + 1, k] = -across, across
        process[k, k] = process[k + 1, k + 1] = rms * rms * (1.0 - decay * decay)
    r = adds = 1.0
    if noisy:
        r = adds = after * after
        if averaged:
            # Noise enters over two cycles, with equal shares. The second share is put in with the
            # first, as the states would have to be for it to end where it does; what they then
            # show too early is taken from the output.
            inside[0] *= math.sqrt(0.5)
            inside[1] *= math.sqrt(0.5)
            area = step[0, 0] * step[1, 1] - step[0, 1] * step[1, 0]
            early = (step[1, 1] * inside[0] - step[0, 1] * inside[1]) / area
            inside[1] += (step[0, 0] * inside[1] - step[1, 0] * inside[0]) / area
            inside[0] += early
            process[size, size], c[size] = 1.0, -early
            for i in range(2):
                process[2 + i, size] = process[size, 2 + i] = inside[i]
            adds += early * early - 2.0 * inside[0] * early
        for i in range(2):
            for j in range(2):
                process[2 + i, 2 + j] += inside[i] * inside[j]
    covariance = riccati(rows, process, c, r)
    gain, output, s = np.zeros(size), np.empty(size), r
    for i in range(padded):
        for j in range(padded):
            s += c[i] * covariance[i, j] * c[j]
    for i in range(size):
        output[i] = c[i]
        for j in range(padded):
            gain[i] += covariance[i, j] * c[j] / s
    return (gain, move, s, rows[:size, :size].copy(), process[:size, :size].copy(),
            covariance[:size, :size].copy(), output, adds)


@kernel(LINE, LINE, NUMBER, WHOLE, WHOLE, LINE)
def led(measured, increments, gain, start, stop, out):
    """A measured angle, followed with this gain and carried on by what was turned since, rad.

    It begins as the mean of what was measured so far; lost samples are NaN.
    """
    x, count = 0.0, 0
    for k in range(start, stop):
        if np.isfinite(measured[k]):
            count += 1
            x += max(gain, 1.0 / count) * (measured[k] - x)
        out[k] = x
        x += increments[k]
