"""Figures of a step or a square wave, measured or simulated: rise, overshoot, settling, error.

Arrays in, frozen figures out. The response of a square wave is averaged over its edges (each
scaled by its step), so that noise and drift average out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError, NotInformativeError

SETTLED_BAND = 0.05
"""Settled: remaining within this share of the step around the final value."""
MIN_SAMPLES = 10
"""Samples of a response."""
MIN_REACHED = 0.1
"""Share of the step: what settles lower has no rise time, and its overshoot is noise."""
MAX_STANDING = 0.5
"""Share of the step: a response that was further off before it is not scaled by that."""
EDGE_SHARE = 0.25
"""Share of its range by which the reference changes within one sample at an edge."""


@dataclass(frozen=True)
class StepFigures:
    """Figures of a step response; NaN where a level is never reached."""

    rise_time_s: float
    """Time from 10 to 90 % of the settled value."""
    overshoot_pct: float
    """Overshoot beyond the settled value, % of that value; 0 without any."""
    settling_time_s: float
    """Time after which it stays within 5 % of the step around the settled value."""
    final_error_pct: float
    """Reference minus settled value, % of the step."""


@dataclass(frozen=True)
class SquareFigures(StepFigures):
    """Figures of a square wave: its mean step, and the error over the whole."""

    rms_error_rad: float
    """RMS of reference minus angle."""
    edges: int
    step_rad: float
    """Mean absolute step."""


def step_figures(response: npt.ArrayLike, dt: float) -> StepFigures:
    """Figures of a response (n,) to a unit step at its first sample, from 0.

    The settled value is the mean of the last fifth. Raises BadInputError unless the response has
    n >= 10 finite values.
    """
    y = np.asarray(response, dtype=float)
    if y.ndim != 1 or not np.isfinite(y).all():
        raise BadInputError('figures', 'response must be (n,) and finite', y.shape)
    if y.size < MIN_SAMPLES:
        raise BadInputError('step_figures', f'needs {MIN_SAMPLES} samples or more', y.size)
    settled = float(np.mean(y[-max(2, y.size // 5) :]))
    nan = float('nan')
    if settled < MIN_REACHED:
        return StepFigures(nan, nan, nan, 100.0 * (1.0 - settled))
    normalised = y / settled
    low, high = _first_crossing(normalised, 0.1), _first_crossing(normalised, 0.9)
    outside = np.flatnonzero(np.abs(y - settled) > SETTLED_BAND)
    last = int(outside[-1]) + 1 if outside.size else 0
    return StepFigures(rise_time_s=(high - low) * dt,
                       overshoot_pct=100.0 * max(0.0, float(np.max(normalised)) - 1.0),
                       settling_time_s=last * dt if last < y.size else nan,
                       final_error_pct=100.0 * (1.0 - settled))


def square_figures(reference: npt.ArrayLike, angle: npt.ArrayLike, dt: float) -> SquareFigures:
    """Figures of a square wave from its reference and response, (n,) each, rad.

    Samples where either is NaN do not count in the error, nor edges followed by one in the mean
    step. Raises NotInformativeError without any edge that is followed by a whole stretch.
    """
    r = np.asarray(reference, dtype=float)
    y = np.asarray(angle, dtype=float)
    if r.ndim != 1 or r.shape != y.shape:
        raise BadInputError('square_figures', 'reference and angle must be (n,) of one length',
                            f'{r.shape} and {y.shape}')
    is_finite = np.isfinite(r) & np.isfinite(y)
    if not is_finite.any():
        raise NotInformativeError('square wave: no finite samples of reference and angle')
    responses, steps = _edge_responses(r, y, is_finite)
    if not responses:
        raise NotInformativeError('square wave: no edge of the reference is followed by a whole '
                                  'stretch; record at least two edges')
    figures = step_figures(np.mean(responses, axis=0), dt)
    return SquareFigures(**vars(figures),
                         rms_error_rad=float(np.sqrt(np.mean((r - y)[is_finite] ** 2))),
                         edges=len(responses), step_rad=float(np.mean(np.abs(steps))))


def square_wave(amplitude: float, half_period_s: float, periods: int, dt: float) -> FloatArray:
    """A square wave (n,) between +-amplitude that starts with a half period at -amplitude."""
    half = max(1, round(half_period_s / dt))
    signs = np.where(np.arange(2 * periods + 1) % 2 == 0, -1.0, 1.0)
    return np.asarray(amplitude * np.repeat(signs, half))


def _edge_responses(r: FloatArray, y: FloatArray,
                    is_finite: npt.NDArray[np.bool_]) -> tuple[list[FloatArray], list[float]]:
    """Responses after each edge, divided by its step and cut to a common length."""
    jump = np.abs(np.diff(r, prepend=r[0]))
    jump[~np.isfinite(jump)] = 0.0
    spread = float(np.ptp(r[is_finite]))
    edges = np.flatnonzero(jump > EDGE_SHARE * spread) if spread > 0 else np.zeros(0, dtype=int)
    if edges.size == 0:
        return [], []
    ends = np.append(edges[1:], r.size)
    lengths = ends - edges
    usual = int(np.median(lengths[:-1])) if lengths.size > 1 else int(lengths[0])
    responses, steps = [], []
    for start in edges:
        stop = start + usual
        if start == 0 or stop > r.size or not is_finite[start - 1 : stop].all() or usual < 10:
            continue
        quiet = r[start:stop] - r[start]
        if np.max(np.abs(quiet)) > EDGE_SHARE * spread:
            continue
        step = float(r[start] - r[start - 1])
        lead = max(1, min(usual // 10, start))
        if not is_finite[start - lead : start].all():
            continue
        begin = float(np.mean(y[start - lead : start]))
        offset = (begin - float(r[start - 1])) / step
        # the step is scaled by where the response stood, so that a standing error is not a step
        scale = step * (1.0 - offset) if abs(offset) < MAX_STANDING else step
        responses.append((y[start:stop] - begin) / scale)
        steps.append(step)
    return responses, steps


def _first_crossing(response: FloatArray, level: float) -> float:
    """Sample (interpolated) at which `response` first reaches `level`."""
    index = int(np.argmax(response >= level))
    if response[index] < level:
        return float('nan')
    if index == 0:
        return 0.0
    low, high = float(response[index - 1]), float(response[index])
    return index - 1 + (level - low) / (high - low)
