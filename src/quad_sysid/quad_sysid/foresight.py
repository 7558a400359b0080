"""Whether commands tell what a rate will be, before any model: two linear regressions. Pure.

The verdict's criterion (discover/accept.py) for those who fit nothing: at some horizon the error
of a prediction with commands must be smaller by DIFFERS than that of one by past rates alone. Both
know commands up to the prediction's start only, since a feedback's later ones contain the very
rates that are to be predicted. A verdict on fitted models asks for more: where these commands do
not tell, it cannot either.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.discover.constants import DIFFERS

HORIZONS_S = (0.02, 0.05, 0.1, 0.2)
"""Those of the verdict over which the motors answer; later the unknown commands rule."""
LAGS, PAST_S = 20, 0.1
"""Number and span of the past samples: the motors' lag and delay lie within it."""
MOST_ROWS = 20_000
"""At most so many samples are predicted, spread over the recording."""
ROWS_EACH = 2
"""Least number of rows for each coefficient."""


def tell(
    rate: FloatArray, commands: FloatArray, spans: Sequence[tuple[int, int]], dt: float
) -> bool:
    """Whether commands (n, k) tell the rate (n,), rad/s, over spans without gaps; dt in s."""
    return improvement(rate, commands, spans, dt) >= DIFFERS


def improvement(
    rate: FloatArray, commands: FloatArray, spans: Sequence[tuple[int, int]], dt: float
) -> float:
    """Error of the prediction by past rates over that with commands as well, at the best horizon.

    1 where there are too few samples.
    An axis may answer to the commands of others, so all of them count.
    """
    step = max(1, round(PAST_S / LAGS / dt))
    ahead = {max(1, round(horizon / dt)) for horizon in HORIZONS_S}
    return max(_ratio(rate, commands, spans, step, samples) for samples in ahead)


def _ratio(rate: FloatArray, commands: FloatArray, spans: Sequence[tuple[int, int]], step: int,
           ahead: int) -> float:
    at = np.concatenate([np.zeros(0, dtype=np.int64), *(
        np.arange(a + (LAGS - 1) * step, b - ahead) for a, b in spans)])
    if at.size <= ROWS_EACH * ((1 + commands.shape[1]) * LAGS + 1):
        return 1.0
    at = at[:: -(-at.size // MOST_ROWS)]
    past = at[:, None] - step * np.arange(LAGS)
    rates = np.column_stack([np.ones(at.size), rate[past]])
    both = np.column_stack([rates, commands[past].reshape(at.size, -1)])
    wanted = rate[at + ahead]

    def error(known: FloatArray) -> float:
        left = wanted - known @ np.linalg.lstsq(known, wanted, rcond=None)[0]
        return float(np.sqrt(left @ left / (at.size - known.shape[1])))

    alone, together = error(rates), error(both)
    return alone / together if together > 0.0 else 1.0
