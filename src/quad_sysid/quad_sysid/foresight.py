"""Whether commands predict a rate, before any model is fitted: two linear regressions. Pure.

The verdict's criterion (discover/accept.py) where nothing is fitted: at some horizon the error of
a prediction with commands must be smaller by DIFFERS than that of one by past rates alone. Both
know commands up to the prediction's start only, since a feedback's later ones contain the very
rates that are to be predicted. A verdict on fitted models asks for more: where these commands do
not predict the rate, no model does.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.discover.constants import DIFFERS
from quad_sysid.record import ENOUGH_ROWS

HORIZONS_S = (0.02, 0.05, 0.1, 0.2)
"""Those of the verdict over which the motors answer; later the unknown commands rule."""
LAGS, PAST_S = 20, 0.1
"""Number and span of the past samples: the motors' lag and delay lie within it."""
ROWS_EACH = 2
"""Least number of rows for each coefficient."""
FLAT = 0.02
"""Share of its RMS below which a difference counts as none."""
DRAWN = 0.6
"""Share of a moving command's samples on straight lines from which it was interpolated."""
REGULAR, MIN_INTERVAL = 0.7, 3
"""Least share of the lines' ends that come at one interval, or a multiple, of so many samples."""


def predictive(
    rate: FloatArray, commands: FloatArray, spans: Sequence[tuple[int, int]], dt: float
) -> bool:
    """Whether commands (n, k) predict the rate (n,), rad/s, over spans without gaps; dt in s."""
    return improvement(rate, commands, spans, dt) >= DIFFERS


def improvement(
    rate: FloatArray, commands: FloatArray, spans: Sequence[tuple[int, int]], dt: float
) -> float:
    """Error of the prediction by past rates over that with commands as well, at the best horizon.

    1 where there are too few samples.
    An axis may answer to the commands of others, so all of them count.
    """
    step = max(1, round(PAST_S / LAGS / dt))
    horizons = {max(1, round(horizon / dt)) for horizon in HORIZONS_S}
    return max(_ratio(rate, commands, spans, step, samples) for samples in horizons)


def _ratio(rate: FloatArray, commands: FloatArray, spans: Sequence[tuple[int, int]], step: int,
           horizon: int) -> float:
    rows = np.concatenate([np.zeros(0, dtype=np.int64), *(
        np.arange(a + (LAGS - 1) * step, b - horizon) for a, b in spans)])
    if rows.size <= ROWS_EACH * ((1 + commands.shape[1]) * LAGS + 1):
        return 1.0
    rows = rows[:: -(-rows.size // ENOUGH_ROWS)]
    past_rows = rows[:, None] - step * np.arange(LAGS)
    rates = np.column_stack([np.ones(rows.size), rate[past_rows]])
    both = np.column_stack([rates, commands[past_rows].reshape(rows.size, -1)])
    future_rate = rate[rows + horizon]

    def error(regressors: FloatArray) -> float:
        theta = np.linalg.lstsq(regressors, future_rate, rcond=None)[0]
        residual = future_rate - regressors @ theta
        return float(np.sqrt(residual @ residual / (rows.size - regressors.shape[1])))

    alone, together = error(rates), error(both)
    return alone / together if together > 0.0 else 1.0


def drawn_hz(commands: FloatArray, dt: float) -> float:
    """Rate, Hz, between whose samples commands (n, k) were interpolated linearly; 0 if not.

    Such a command moves and yet hardly ever bends, and it bends at regular intervals. One that is
    held does not move between its samples.
    """
    rates = [rate for column in commands.T if (rate := _drawn(column)) is not None]
    return float(np.median(rates)) / dt if rates and min(rates) > 0.0 else 0.0


def _drawn(command: FloatArray) -> float | None:
    """The rate of one command's samples, per sample; 0 if it is as logged, None if it rests."""
    slope = np.diff(command)
    bend = np.diff(slope)
    is_finite = np.isfinite(bend)
    if is_finite.sum() < ROWS_EACH * LAGS or not np.ptp(bend[is_finite]) > 0.0:
        return None
    flat = np.abs(bend) < FLAT * float(np.sqrt(np.mean(bend[is_finite] ** 2)))
    usual = float(np.sqrt(np.nanmean(slope**2)))
    moving = is_finite & (np.abs(slope[1:]) > FLAT * usual) & (np.abs(slope[:-1]) > FLAT * usual)
    ends = np.diff(np.flatnonzero(is_finite & ~flat))
    if moving.sum() < ROWS_EACH * LAGS or ends.size < LAGS or flat[moving].mean() < DRAWN:
        return 0.0
    interval = float(np.median(ends))
    off = np.abs(ends / interval - np.maximum(np.round(ends / interval), 1.0))
    regular = float(np.mean(off * interval <= 1.0))
    return 1.0 / interval if interval >= MIN_INTERVAL and regular >= REGULAR else 0.0
