"""Score candidates beside a fitted structure without fitting them: one linear step each.

A candidate's columns pass through the same filter as the fit's derivatives; what of the innovations
they explain beyond these, priced by their prior, is the score. It only chooses what is fitted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from quad_sysid.contract import FloatArray
from quad_sysid.estimate.fit import Fit, Problem
from quad_sysid.model import recursion
from quad_sysid.model.effect import Part

STEP = 1e-4
PER_NONLINEAR = 2.0
"""Nats that a parameter chosen from a grid costs, about."""
LINES = 4
LINE_BAND_HZ = (0.1, 16.0)


@dataclass(frozen=True)
class Score:
    """What one linear step says of a candidate."""

    part: Part
    starts: tuple[FloatArray, ...]
    """Each (q,): coordinates of the fit to start its parameters from."""
    nats: float


@dataclass
class _Block:
    part: Part
    p: FloatArray
    """Coordinates with the linear parameters at zero."""
    linear: list[int]
    first: int
    count: int
    shift: int = -1
    """Column of what it does at `p` already; -1: nothing."""


def _spectrum(problem: Problem, fitted: Fit) -> tuple[FloatArray, FloatArray]:
    """Frequency (Hz) and power of the innovations over the longest segment."""
    e = np.where(np.isfinite(fitted.prediction.innovation), fitted.prediction.innovation, 0.0)
    start, stop = max(problem.spans, key=lambda span: span[1] - span[0])
    part = e[start:stop] - e[start:stop].mean()
    size = 4 * part.size
    power = np.abs(np.fft.rfft(part * np.hanning(part.size), size)) ** 2
    return np.fft.rfftfreq(size, problem.data.dt), power


def lines(problem: Problem, fitted: Fit) -> FloatArray:
    """Frequencies (Hz) of the strongest lines in the innovations that may be motion."""
    frequency, power = _spectrum(problem, fitted)
    power[(frequency < LINE_BAND_HZ[0]) | (frequency > LINE_BAND_HZ[1])] = 0.0
    found = []
    for _ in range(LINES):
        peak = int(np.argmax(power))
        found.append(float(frequency[peak]))
        power[max(peak - 12, 0) : peak + 13] = 0.0
    return np.array(found)


def vibration_line(problem: Problem, fitted: Fit) -> float | None:
    """Frequency (Hz) of the strongest line above that band; None where the rate is too low."""
    frequency, power = _spectrum(problem, fitted)
    above = frequency > LINE_BAND_HZ[1]
    if above.sum() < 100:
        return None
    smooth = np.convolve(power, np.full(25, 1.0 / 25.0), mode='same')
    smooth[~above] = 0.0
    return float(frequency[int(np.argmax(smooth))])


def coordinates(part: Part, values: FloatArray) -> FloatArray:
    """Parameters in their units as coordinates of the fit."""
    return np.array([
        math.log(max(v, 1e-12)) if spec.log else v
        for spec, v in zip(part.effect.parameters, values, strict=True)
    ])


def screen(problem: Problem, fitted: Fit, parts: Sequence[Part]) -> list[Score]:
    """The best start and score of each candidate, best first."""
    flight = problem.flight
    flight.rate = fitted.rate
    structure, theta = fitted.structure, fitted.theta
    base = theta.size - len(structure.noise)
    values = structure.natural(theta)
    push = flight.pushed(structure, values, fitted.rate)
    halves, states = flight.driven(structure, values)
    signals = flight.signals(values, halves, states, fitted.rate)
    n = problem.data.rate.size
    columns: list[FloatArray] = []
    blocks: list[_Block] = []

    def driven(part: Part, p: FloatArray) -> FloatArray:
        more = structure.plus(part)
        whole = more.natural(np.r_[theta[:base], p, theta[base:]])
        own = flight.driven(more, whole)[0]
        return values[0] * 0.5 * (own[0] + own[1])

    plain = values[0] * 0.5 * (halves[0] + halves[1])
    for part in parts:
        effect = part.effect
        specs = effect.parameters
        linear = [
            j for j, spec in enumerate(specs)
            if not spec.log and not spec.starts
            and (spec.spread is None or (spec.centre == 0.0 and spec.name != 'time'))
        ]
        if getattr(effect, 'from_lines', False):
            starts = [np.array([f, 0.0, 0.0]) for f in lines(problem, fitted)]
        else:
            starts = list(effect.starts(problem.data, part.settings))
        for start in starts:
            p = coordinates(part, start)
            block = _Block(part, p, linear, len(columns), len(linear))
            if effect.moves_command:
                for j in linear:
                    up = p.copy()
                    up[j] += STEP
                    columns.append((driven(part, up) - plain) / STEP)
                if not linear:
                    block.shift = len(columns)
                    columns.append(driven(part, p) - plain)
            else:
                logs = np.array([s.log for s in specs])
                at = np.where(logs, np.exp(np.where(logs, p, 0.0)), p)
                own = flight.hidden(part, signals, at)
                columns.extend(effect.columns(own, at, linear, part.settings).T)
            blocks.append(block)
    if not columns:
        return []
    inputs = np.ascontiguousarray(np.stack(columns, axis=1))
    out = np.zeros_like(inputs)
    found = fitted.prediction.filter
    for start, stop in flight.passes:
        recursion.respond(
            inputs, push.slope, found.gain, found.move, flight.gyro, flight.filtered,
            problem.data.dt, start, stop, out,
        )
    e = fitted.prediction.innovation[problem.rows]
    w = np.sqrt(fitted.tail.weights(e)) / fitted.tail.scale
    assert fitted.prediction.jacobian is not None
    own = fitted.prediction.jacobian[problem.rows] * w[:, None]
    root = np.linalg.cholesky(fitted.precision).T
    q = np.linalg.qr(np.vstack([own, root]))[0]
    q = q[: problem.rows.size]
    c = out[problem.rows] * w[:, None]
    r = e * w
    # beside what the fit's own parameters can take up; their priors lie in the rows that are cut
    qc, qr = q.T @ c, q.T @ r
    score: dict[str, Score] = {}
    for block in blocks:
        where = slice(block.first, block.first + block.count)
        residual, before = r, float(r @ r - qr @ qr)
        q_residual = qr
        price = PER_NONLINEAR * (len(block.part.effect.parameters) - block.count)
        if block.shift >= 0:
            residual = r + c[:, block.shift]
            q_residual = qr + qc[:, block.shift]
        left = float(residual @ residual - q_residual @ q_residual)
        nats = 0.5 * (before - left) - price
        start = block.p.copy()
        if block.count:
            cc, qcc = c[:, where], qc[:, where]
            gram = cc.T @ cc - qcc.T @ qcc
            b = -(cc.T @ residual - qcc.T @ q_residual)
            sizes = problem.sizes_of(block.part)
            full = block.part.effect.precision(block.part.settings, sizes)
            precision = full[np.ix_(block.linear, block.linear)]
            factor = cho_factor(gram + precision)
            x = cho_solve(factor, b)
            logdet = 2.0 * float(np.sum(np.log(np.diag(factor[0]))))
            nats += 0.5 * float(b @ x) - 0.5 * (logdet - np.linalg.slogdet(precision)[1])
            if any(block.part.effect.parameters[j].positive and v < 0.0
                   for j, v in zip(block.linear, x, strict=True)):
                continue
            start[block.linear] = x
        label = block.part.effect.label
        if label not in score or nats > score[label].nats:
            starts = (start,)
            if block.count and block.count < start.size:
                # a linear step may overshoot what is not linear
                gentle = start.copy()
                gentle[block.linear] *= 0.3
                starts = (start, gentle)
            score[label] = Score(block.part, starts, nats)
    return sorted(score.values(), key=lambda s: -s.nats)


def candidates(problem: Problem, effects) -> tuple[list[Part], dict[str, str]]:  # type: ignore[no-untyped-def]  # noqa: ANN001
    """What these data can show, and why not the rest."""
    parts, reasons = [], {}
    for effect in effects:
        settings = effect.prepare(problem.data)
        if isinstance(settings, str):
            reasons[effect.label] = settings
        else:
            parts.append(Part(effect, settings))
    return parts, reasons
