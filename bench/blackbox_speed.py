"""Times of the black-box fits on the reference record, beside 1,000 plain lstsq calls.

    OPENBLAS_NUM_THREADS=1 python bench/blackbox_speed.py

Peers (`sippy_unipi`, `SysIdentPy`) are timed where they are installed. Best of several calls,
after one that compiles or loads. Ends with one JSON object on its last line.
"""

from __future__ import annotations

import importlib.util
import json
import time
from collections.abc import Callable

import numpy as np

from quad_sysid.blackbox import armax, arx, bj, clriv, fit_table2, iv4, n4sid, oe, search_arx
from quad_sysid.blackbox.studies import reference_study
from quad_sysid.record import IOData


def best(call: Callable[[], object], repeat: int = 7) -> float:
    """Shortest time of a call, ms."""
    call()
    times = []
    for _ in range(repeat):
        begin = time.perf_counter()
        call()
        times.append(time.perf_counter() - begin)
    return 1e3 * min(times)


def thousand_lstsq(z: IOData) -> tuple[float, np.ndarray]:
    """Time (ms) and AIC of 1,000 plain least-squares fits over the shared rows."""
    lead, n = 18, z.y.size
    y_lags = np.column_stack([-z.y[lead - i : n - i] for i in range(1, 11)])
    u_lags = np.column_stack([z.u[lead - i : n - i] for i in range(19)])
    y, rows = z.y[lead:], n - lead
    values = np.empty((10, 10, 10))
    begin = time.perf_counter()
    for na in range(1, 11):
        for nb in range(1, 11):
            for nk in range(10):
                x = np.hstack((y_lags[:, :na], u_lags[:, nk : nk + nb]))
                sse = np.linalg.lstsq(x, y, rcond=None)[1][0]
                values[na - 1, nb - 1, nk] = rows * np.log(sse / rows) + 2 * (na + nb)
    return 1e3 * (time.perf_counter() - begin), values.ravel()


def peers(z: IOData) -> dict[str, float]:
    """Milliseconds of the same fits by what else is installed."""
    found: dict[str, float] = {}
    if importlib.util.find_spec('sippy_unipi') is not None:
        from sippy_unipi import system_identification as identify

        for name, orders in (
            ('ARMAX', {'ARMAX_orders': [3, 3, 3, 1]}), ('OE', {'OE_orders': [2, 2, 3]}),
            ('BJ', {'BJ_orders': [2, 2, 2, 2, 3]}),
        ):
            begin = time.perf_counter()
            try:
                identify(z.y, z.u, name, **orders, tsample=z.dt)
            except Exception as error:  # noqa: BLE001  a peer may fail in any way
                print(f'sippy {name} failed: {error}')
            found[f'sippy_{name}'] = 1e3 * (time.perf_counter() - begin)
    if importlib.util.find_spec('sysidentpy') is not None:
        from sysidentpy.basis_function import Polynomial
        from sysidentpy.model_structure_selection import FROLS

        begin = time.perf_counter()
        FROLS(
            order_selection=False, n_terms=20, ylag=10, xlag=list(range(5, 15)),
            basis_function=Polynomial(degree=1),
        ).fit(X=z.u[:, None], y=z.y[:, None])
        found['sysidentpy_ARX_10_10_5'] = 1e3 * (time.perf_counter() - begin)
    return found


def main() -> None:
    """Time everything and print table and JSON."""
    study = reference_study()
    z = study.record(np.random.default_rng(0))
    others = {
        'prbs': study.record(np.random.default_rng(1)),
        'square': study.record(np.random.default_rng(2)),
    }
    plain_ms, plain = thousand_lstsq(z)
    ours = search_arx(z, range(1, 11), range(1, 11), range(10)).values()
    result: dict[str, float] = {
        'search_1000_arx': best(lambda: search_arx(z, range(1, 11), range(1, 11), range(10))),
        'lstsq_1000': plain_ms,
        'criterion_largest_relative_difference': float(np.max(np.abs(ours / plain - 1.0))),
        'arx_10_10_5': best(lambda: arx(z, 10, 10, 5)),
        'armax_3_3_3_1': best(lambda: armax(z, 3, 3, 3, 1)),
        'oe_2_2_3': best(lambda: oe(z, 2, 2, 3)),
        'bj_2_2_2_2_3': best(lambda: bj(z, 2, 2, 2, 2, 3)),
        'iv4_2_2_3': best(lambda: iv4(z, 2, 2, 3)),
        'clriv_2_2_2_2_3': best(lambda: clriv(z, 2, 2, 2, 2, 3)),
        'n4sid_6': best(lambda: n4sid(z, 6)),
        'table2_with_validations': best(lambda: fit_table2(z, others), 3),
    }
    result |= peers(z)
    for name, value in result.items():
        print(f'{name:40s} {value:12.4g}' + ('' if 'difference' in name else ' ms'))
    print(f'{"lstsq / search":40s} {plain_ms / result["search_1000_arx"]:12.0f} x')
    print(json.dumps(result))


if __name__ == '__main__':
    main()
