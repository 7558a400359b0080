"""Time the same fits by other libraries, in a Python that has them; started by blackbox_speed.py.

    PYTHON bench/blackbox_peers.py RECORD.npz

Needs numpy and what it times: `sippy_unipi` and `sysidentpy`, each left out where it is missing.
Ends with one JSON object: milliseconds (the shortest of REPEATS calls behind one that loads, of
this thread's CPU time, as for ours; of what takes longer than LONG_MS the first alone), and the
variance of the one-step error where the peer tells it.
"""

from __future__ import annotations

import contextlib
import io
import json
import sys
import time
import warnings
from collections.abc import Callable

import numpy as np

REPEATS, LONG_MS = 7, 2000.0


def timed(call: Callable[[], object]) -> tuple[float, object]:
    """Milliseconds and result; the error in words where a peer fails."""
    times: list[float] = []
    result: object = None
    while len(times) <= REPEATS and not (times and times[0] > LONG_MS):
        begin = time.thread_time()
        try:
            with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
                warnings.simplefilter('ignore')
                result = call()
        except Exception as error:  # noqa: BLE001  a peer may fail in any way
            result = f'{type(error).__name__}: {error}'
        times.append(1e3 * (time.thread_time() - begin))
    return min(times[1:] or times), result


def sippy(u: np.ndarray, y: np.ndarray, dt: float) -> dict[str, object]:
    """ARX, ARMAX, OE and BJ; its delay counts from u(t - 1)."""
    try:
        from sippy_unipi import system_identification as identify
    except ImportError:
        return {}
    found: dict[str, object] = {}
    for name, key, orders in (
        ('ARX', 'arx_10_10_5', {'ARX_orders': [10, 10, 4]}),
        ('OE', 'oe_2_2_3', {'OE_orders': [2, 2, 2]}),
        ('ARMAX', 'armax_3_3_3_1', {'ARMAX_orders': [3, 3, 3, 0]}),
        ('BJ', 'bj_2_2_2_2_3', {'BJ_orders': [2, 2, 2, 2, 2]}),
    ):
        milliseconds, model = timed(lambda n=name, o=orders: identify(y, u, n, tsample=dt, **o))
        found[f'sippy_{key}'] = milliseconds
        if isinstance(model, str):
            found[f'sippy_{key}_error'] = model[:120]
        else:
            found[f'sippy_{key}_variance'] = float(np.squeeze(getattr(model, 'Vn', np.nan)))
    return found


def sysidentpy(u: np.ndarray, y: np.ndarray) -> dict[str, object]:
    """ARX 10 10 5 by forward selection of exactly its 20 terms."""
    try:
        from sysidentpy.basis_function import Polynomial
        from sysidentpy.model_structure_selection import FROLS
        from sysidentpy.parameter_estimation import LeastSquares
    except ImportError:
        return {}
    milliseconds, model = timed(
        lambda: FROLS(
            order_selection=False, n_terms=20, ylag=10, xlag=list(range(5, 15)),
            basis_function=Polynomial(degree=1), estimator=LeastSquares(),
        ).fit(X=u[:, None], y=y[:, None])
    )
    found: dict[str, object] = {'sysidentpy_arx_10_10_5': milliseconds}
    if isinstance(model, str):
        found['sysidentpy_arx_10_10_5_error'] = model[:120]
    return found


if __name__ == '__main__':
    with np.load(sys.argv[1]) as record:
        u_in, y_out, step = record['u'], record['y'], float(record['dt'])
    print(json.dumps(sippy(u_in, y_out, step) | sysidentpy(u_in, y_out)))
