"""Measured speeds of the rotors: each motor's lag, and a motor that lags, slips or stops. Pure.

Between command and speed lies the motor alone, so its lag is known without the airframe's damping,
with which it could be exchanged in a fit of the rate. What is made of it is model/data.py's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.record import ENOUGH_ROWS, INDEPENDENT_S, Record, finite_runs

LAGS_S = (0.003, 0.006, 0.012, 0.025, 0.05, 0.1, 0.2)
DELAYS_S = (0.0, 0.004, 0.008, 0.015, 0.025, 0.04)
"""Where the search for lag and delay (of the telemetry too) begins."""
MAX_LAG_S, MAX_DELAY_S = 1.0, 0.1
"""Bounds of the search; beyond them stamps or columns are wrong."""
MIN_S = 3.0
"""Least time with speed and command for a lag."""
MIN_FIT = 0.5
"""Share of the speed's variance that the lagged command must explain."""
FORM = 0.03
"""Part by which a lag of one size differs from how a motor really answers."""
LAGS, LAGS_SIGMAS = 1.3, 3.0
"""A motor lags where its lag is beyond the others' by this factor and these standard errors."""
UNEVEN = 0.1
"""Part by which a motor is slower or quicker than the others at one command, to be named."""
SLIPS, STOPS = 0.75, 0.2
"""Shares of the expected speed below which a motor slips, or stands still."""
SLIP_S = 0.1
"""Time that it must last."""
IDLE = 0.05
"""Command below which a motor may stand."""
SETTLE_S = 0.5
"""Time after a gap in which the lagged command forgets where it began: some ten lags."""


@dataclass(frozen=True)
class Rotor:
    """Lag and curve of one motor, by its measured speed."""

    lag_s: float
    spread: float
    """Standard error of the lag's logarithm."""
    fit: float
    """Share of the speed's variance that is explained."""
    curve: tuple[float, float, float]
    """Speed at rest: rad/s = c0 + c1 u + c2 u² of the command u."""


@dataclass(frozen=True)
class Rotors:
    """All motors of a flight."""

    rotors: tuple[Rotor | None, ...]
    """Each motor; None where its speed was not measured, or does not follow its command."""
    remarks: tuple[str, ...]
    """Motors that lag, slip, stop or differ, one line each."""
    lag_s: float | None
    """The lag that most motors have, s."""
    spread: float
    """Standard deviation of its logarithm, as a prior: errors, motors that differ, and FORM."""

    @property
    def lines(self) -> tuple[str, ...]:
        """The lag in words, where it is known, and the remarks."""
        if self.lag_s is None:
            return self.remarks
        lag = (f'the motors follow their commands with a lag of {1e3 * self.lag_s:.3g} ms ± '
               f'{100.0 * self.spread:.2g} %, by the measured speeds of their rotors')
        return (lag, *self.remarks)


NOTHING = Rotors((), (), None, math.inf)
"""Of a record without speeds or commands."""


def rotors_of(record: Record, *, training: bool = False) -> Rotors:
    """The motors of a record, from all of it or its training segments."""
    if record.speeds is None or record.motors is None:
        return NOTHING
    spans = [record.span(s) for s in record.segments if s.role == 'train'] if training else []
    chosen = np.zeros(record.n, dtype=bool)
    for start, stop in spans or [(0, record.n)]:
        chosen[start:stop] = True
    commands = record.motors
    is_finite = np.isfinite(record.speeds) & np.isfinite(commands) & chosen[:, None]
    rotors = tuple(_rotor(commands[:, i], record.speeds[:, i], is_finite[:, i], record.dt)
                   for i in range(commands.shape[1]))
    lags = np.array([(math.log(r.lag_s), r.spread) for r in rotors if r is not None])
    if not lags.size:
        return Rotors(rotors, tuple(_remarks(record, rotors, is_finite)), None, math.inf)
    middle = float(np.median(lags[:, 0]))
    differ = 1.4826 * float(np.median(np.abs(lags[:, 0] - middle)))
    error = float(np.median(lags[:, 1]))
    return Rotors(rotors, tuple(_remarks(record, rotors, is_finite)), math.exp(middle),
                  math.hypot(error, differ, FORM))


def _rotor(u: FloatArray, w: FloatArray, is_known: np.ndarray, dt: float) -> Rotor | None:
    """Lag, delay and curve of one motor by least squares."""
    from scipy.optimize import minimize  # slow to import

    rows = np.flatnonzero(is_known)
    if rows.size * dt < MIN_S:
        return None
    window = _liveliest(u, rows)
    u, w, is_known = u[window], w[window], is_known[window].copy()
    for start, _ in finite_runs(is_known, (0, is_known.size)):
        is_known[start : start + round(SETTLE_S / dt)] = False
    rows, known_at = np.flatnonzero(is_known), np.flatnonzero(np.isfinite(u))
    if rows.size * dt < 0.5 * MIN_S or np.ptp(w[rows]) <= 0.0 or np.ptp(u[rows]) <= 0.0:
        return None
    sampled = np.interp(np.arange(u.size), known_at, u[known_at])
    target = w[rows]

    def fitted(log_lag: float, delay: float) -> tuple[FloatArray, FloatArray]:
        """What a curve of the lagged command leaves, and the curve."""
        x = np.stack([_behind(sampled**k, math.exp(log_lag), delay, dt)[rows] for k in (0, 1, 2)])
        coefficients = np.linalg.lstsq(x @ x.T, x @ target, rcond=None)[0]
        return target - coefficients @ x, coefficients

    def inside(point: FloatArray) -> tuple[float, float]:
        return (float(np.clip(point[0], math.log(1e-4), math.log(MAX_LAG_S))),
                float(np.clip(0.01 * point[1], 0.0, MAX_DELAY_S)))

    def cost(point: FloatArray) -> float:
        log_lag, delay = inside(point)
        e = fitted(log_lag, delay)[0]
        beyond = abs(point[0] - log_lag) + abs(point[1] - 100.0 * delay)
        return float(math.log(float(e @ e) + 1e-300) + beyond)

    grid = [np.array([math.log(lag), 100.0 * delay]) for lag in LAGS_S for delay in DELAYS_S]
    best = minimize(cost, min(grid, key=cost), method='Nelder-Mead',
                    options={'xatol': 1e-3, 'fatol': 1e-6, 'maxiter': 120}).x
    log_lag, delay = inside(best)
    e, coefficients = fitted(log_lag, delay)
    fit = 1.0 - float(e @ e) / float(np.sum((target - target.mean()) ** 2))
    if fit < MIN_FIT:
        return None
    costs = [fitted(log_lag + sign * 0.02, delay)[0] for sign in (1.0, -1.0)]
    j = np.stack([(costs[0] - costs[1]) / 0.04,
                  (fitted(log_lag, delay + 5e-4)[0] - e) / 5e-4], axis=1)
    starts = np.arange(0, rows.size, max(1, round(INDEPENDENT_S / dt)))
    scores = np.add.reduceat(j * e[:, None], starts)
    inverse = np.linalg.pinv(j.T @ j)
    spread = math.sqrt(max(float((inverse @ (scores.T @ scores) @ inverse)[0, 0]), 0.0))
    curve = float(coefficients[0]), float(coefficients[1]), float(coefficients[2])
    return Rotor(math.exp(log_lag), spread, fit, curve)


def _liveliest(u: FloatArray, rows: np.ndarray) -> slice:
    """At most ENOUGH_ROWS samples, those in which the command moves most."""
    moves = np.zeros(u.size)
    moves[rows[1:]] = np.nan_to_num(np.abs(np.diff(u)))[rows[1:] - 1]
    total = np.concatenate([[0.0], np.cumsum(moves)])
    last = max(u.size - ENOUGH_ROWS, 0)
    start = max(range(0, last + 1, max(1, ENOUGH_ROWS // 4)),
                key=lambda a: total[min(a + ENOUGH_ROWS, u.size)] - total[a])
    return slice(start, start + ENOUGH_ROWS)


def _behind(u: FloatArray, lag: float, delay: float, dt: float) -> FloatArray:
    """(n,) a command held over each cycle, behind a delay and a lag, s, at its start."""
    from scipy.signal import lfilter  # slow to import

    keep = math.exp(-dt / lag)
    out = lfilter([0.0, 1.0 - keep], [1.0, -keep], u - u[0]) + u[0]
    grid = np.arange(u.size)
    return np.asarray(np.interp(grid - delay / dt, grid, out), dtype=np.float64)


def _remarks(record: Record, rotors: Sequence[Rotor | None], is_finite: np.ndarray) -> list[str]:
    out: list[str] = []
    usable = [r for r in rotors if r is not None]
    for i, rotor in enumerate(rotors):
        others = [r for r in usable if r is not rotor]
        name, measured = f'motor_{i + 1}', is_finite[:, i]
        if not measured.any():
            out.append(f'{name}: its speed was not measured')
            continue
        out += [f'{name} {line}' for line in _failures(record, i, others or usable, measured)]
        if rotor is None or not others:
            continue
        usual = math.log(float(np.median([r.lag_s for r in others])))
        deviation, error = math.log(rotor.lag_s) - usual, math.hypot(
            rotor.spread, float(np.median([r.spread for r in others])))
        if deviation > max(math.log(LAGS), LAGS_SIGMAS * error):
            out.append(f'{name} lags: it answers with {1e3 * rotor.lag_s:.3g} ms, the others with '
                       f'{1e3 * math.exp(usual):.3g} ms')
        level = np.nanmedian(np.asarray(record.motors)[:, i], keepdims=True)
        own = float(_speed(rotor, level)[0])
        normal = float(np.median([_speed(r, level)[0] for r in others]))
        if normal > 0.0 and abs(own / normal - 1.0) > UNEVEN:
            out.append(f'{name} turns {100.0 * abs(own / normal - 1.0):.0f} % '
                       f'{"slower" if own < normal else "quicker"} than the others at one command')
    return out


def _speed(rotor: Rotor, u: FloatArray) -> FloatArray:
    return rotor.curve[0] + rotor.curve[1] * u + rotor.curve[2] * u**2


def _failures(
    record: Record, i: int, others: Sequence[Rotor], measured: np.ndarray
) -> list[str]:
    """When a motor stood still or slipped while it was commanded to turn."""
    if record.motors is None or record.speeds is None or not others:
        return []
    lag = float(np.median([r.lag_s for r in others]))
    u = np.nan_to_num(record.motors[:, i])
    delayed = _behind(u, lag, 0.0, record.dt)
    expected: FloatArray = np.median([_speed(r, delayed) for r in others], axis=0)
    turning = measured & (u > IDLE) & (expected > 0.0)
    share = np.where(turning, record.speeds[:, i] / np.where(turning, expected, 1.0), 1.0)
    usual = float(np.median(share[turning])) if turning.any() else 1.0
    lines = []
    for word, low in (('stands still', share < STOPS),
                      ('slips', (share < SLIPS * min(usual, 1.0)) & (share >= STOPS))):
        runs = [(a, b) for a, b in finite_runs(low & turning, (0, record.n))
                if (b - a) * record.dt >= SLIP_S]
        if runs:
            total = sum(b - a for a, b in runs) * record.dt
            what = 'while it is commanded to turn' if word == 'stands still' else \
                'far below the speed of its command'
            lines.append(f'{word} for {total:.2g} s from {runs[0][0] * record.dt:.1f} s on, '
                         f'{what}')
    return lines
