"""Score candidates beside a fitted structure without fitting them: one linear step each.

A candidate's columns pass through the same filter as the fit's derivatives; what they explain of
the innovations beyond these, priced by their prior, is the score. It only chooses what is fitted.
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
from quad_sysid.model.effect import Effect, Part, required

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
    """One candidate from one start, and where its columns are."""

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
    return np.fft.rfftfreq(size, problem.data.dt).astype(np.float64), power


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
    columns, blocks = _columns(problem, fitted, parts)
    if not columns:
        return []
    inputs = np.ascontiguousarray(np.stack(columns, axis=1))
    out = np.zeros_like(inputs)
    found = fitted.prediction.filter
    slope = flight.pushed(
        fitted.structure, fitted.structure.natural(fitted.theta), fitted.rate
    ).slope
    for start, stop in flight.passes:
        recursion.respond(
            inputs, slope, found.gain, found.move, flight.sensor.step, flight.sensor.behind,
            problem.data.dt, start, stop, out,
        )
    rows = _Rows(problem, fitted, out)
    best: dict[str, Score] = {}
    for block in blocks:
        score = rows.score(problem, block)
        if score is None:
            continue
        label = block.part.effect.label
        if label not in best or score.nats > best[label].nats:
            best[label] = score
    return sorted(best.values(), key=lambda s: -s.nats)


def _columns(
    problem: Problem, fitted: Fit, parts: Sequence[Part]
) -> tuple[list[FloatArray], list[_Block]]:
    """(n,) mean acceleration of each cycle per unit of each linear parameter, at each start."""
    flight = problem.flight
    structure, theta = fitted.structure, fitted.theta
    base = theta.size - len(structure.noise)
    values = structure.natural(theta)
    halves, states = flight.driven(structure, values)
    signals = flight.signals(values, halves, states, fitted.rate)
    plain = values[0] * 0.5 * (halves[0] + halves[1])
    columns: list[FloatArray] = []
    blocks: list[_Block] = []

    def driven(part: Part, p: FloatArray) -> FloatArray:
        more = structure.plus(part)
        whole = more.natural(np.r_[theta[:base], p, theta[base:]])
        own = flight.driven(more, whole)[0]
        drive: FloatArray = values[0] * 0.5 * (own[0] + own[1])
        return drive

    for part in parts:
        effect = part.effect
        specs = effect.parameters
        linear = [
            j for j, spec in enumerate(specs)
            if not spec.log and not spec.starts
            and (spec.spread is None or (spec.centre == 0.0 and spec.name != 'time'))
        ]
        for start in _starts(problem, fitted, part):
            p = coordinates(part, start)
            block = _Block(part, p, linear, len(columns), len(linear))
            if not effect.moves_command:
                logs = np.array([s.log for s in specs])
                at = np.where(logs, np.exp(np.where(logs, p, 0.0)), p)
                own = flight.hidden(part, signals, at)
                columns.extend(effect.columns(own, at, linear, part.settings).T)
            elif linear:
                for j in linear:
                    up = p.copy()
                    up[j] += STEP
                    columns.append((driven(part, up) - plain) / STEP)
            else:
                block.shift = len(columns)
                columns.append(driven(part, p) - plain)
            blocks.append(block)
    return columns, blocks


def _starts(problem: Problem, fitted: Fit, part: Part) -> Sequence[FloatArray]:
    """Values of a candidate's parameters to search from, in their units."""
    if getattr(part.effect, 'from_lines', False):
        return [np.array([f, 0.0, 0.0]) for f in lines(problem, fitted)]
    return part.effect.starts(problem.data, part.settings)


class _Rows:
    """Weighted innovations and columns, less what the fit's own parameters can take up.

    The priors of the fit's parameters are the last rows.
    """

    def __init__(self, problem: Problem, fitted: Fit, out: FloatArray) -> None:
        e = fitted.prediction.innovation[problem.rows]
        w = np.sqrt(fitted.tail.weights(e)) / fitted.tail.scale
        own = required(fitted.prediction.jacobian)[problem.rows] * w[:, None]
        root = np.linalg.cholesky(fitted.precision).T
        q = np.linalg.qr(np.vstack([own, root]))[0]
        ahead = q[: e.size].T
        columns, weighted = out[problem.rows] * w[:, None], e * w
        self.c = -(q @ (ahead @ columns))
        self.c[: e.size] += columns
        self.r = -(q @ (ahead @ weighted))
        self.r[: e.size] += weighted

    def score(self, problem: Problem, block: _Block) -> Score | None:
        """What a candidate's linear step gains, nats; None where physics forbids its sign."""
        part, parameters = block.part, block.part.effect.parameters
        residual = self.r
        if block.shift >= 0:
            residual = residual + self.c[:, block.shift]
        nats = 0.5 * float(self.r @ self.r - residual @ residual)
        nats -= PER_NONLINEAR * (len(parameters) - block.count)
        start = block.p.copy()
        if not block.count:
            return Score(part, (start,), nats)
        where = slice(block.first, block.first + block.count)
        c = self.c[:, where]
        b = -(c.T @ residual)
        precision = part.effect.precision(part.settings, problem.sizes_of(part))
        precision = precision[np.ix_(block.linear, block.linear)]
        factor = cho_factor(c.T @ c + precision)
        x = cho_solve(factor, b)
        logdet = 2.0 * float(np.sum(np.log(np.diag(factor[0]))))
        nats += 0.5 * float(b @ x) - 0.5 * (logdet - float(np.linalg.slogdet(precision)[1]))
        if any(parameters[j].positive and v < 0.0 for j, v in zip(block.linear, x, strict=True)):
            return None
        start[block.linear] = x
        if block.count == start.size:
            return Score(part, (start,), nats)
        gentle = start.copy()  # a linear step may overshoot what is not linear
        gentle[block.linear] *= 0.3
        return Score(part, (start, gentle), nats)


def candidates(
    problem: Problem, effects: Sequence[Effect]
) -> tuple[list[Part], dict[str, str]]:
    """What these data can show, and why not the rest."""
    parts, reasons = [], {}
    for effect in effects:
        settings = effect.prepare(problem.data)
        if isinstance(settings, str):
            reasons[effect.label] = settings
        else:
            parts.append(Part(effect, settings))
    return parts, reasons
