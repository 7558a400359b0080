"""Times of the black-box fits on the reference record, beside a textbook's own and the peers'.

    OPENBLAS_NUM_THREADS=1 python bench/blackbox_speed.py [--peers PYTHON] [--bag BAG]

PYTHON is a Python that has `sippy_unipi` and `sysidentpy` (in a venv of its own: they pin other
packages); without it the peers are left out. The command `quad-sysid identify` is timed on the
roll axis of BAG, by default a simulated flight of 85 s, first with nothing compiled. The others
are the best of several calls, after one that loads. Ends with one JSON object on its last line.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import blackbox_plain as textbook
import numpy as np
from blackbox_flight import flight

from quad_sysid.bags.writer import write_bag
from quad_sysid.blackbox import Model, armax, arx, bj, clriv, iv4, oe, search_arx
from quad_sysid.blackbox.innovations import squares
from quad_sysid.record import IOData

sys.path.append(str(Path(__file__).resolve().parents[1] / 'test'))
from known_plants import reference_study


def best(call: Callable[[], object], repeat: int = 7) -> float:
    """Shortest processor time of a call in this thread, ms: another process does not add to it."""
    call()
    times = []
    for _ in range(repeat):
        begin = time.thread_time()
        call()
        times.append(time.thread_time() - begin)
    return 1e3 * min(times)


def thousand_lstsq(z: IOData) -> tuple[float, np.ndarray]:
    """Time (ms) and AIC of 1,000 plain least-squares fits over the shared rows."""
    lead, n = 18, z.y.size
    y_lags = np.column_stack([-z.y[lead - i : n - i] for i in range(1, 11)])
    u_lags = np.column_stack([z.u[lead - i : n - i] for i in range(19)])
    y, rows = z.y[lead:], n - lead
    values = np.empty((10, 10, 10))
    begin = time.thread_time()
    for na in range(1, 11):
        for nb in range(1, 11):
            for nk in range(10):
                x = np.hstack((y_lags[:, :na], u_lags[:, nk : nk + nb]))
                sse = np.linalg.lstsq(x, y, rcond=None)[1][0]
                values[na - 1, nb - 1, nk] = rows * np.log(sse / rows) + 2 * (na + nb)
    return 1e3 * (time.thread_time() - begin), values.ravel()


ORDERS: dict[str, tuple[int, ...]] = {
    'armax_3_3_3_1': (3, 3, 3, 0, 0, 1), 'oe_2_2_3': (0, 2, 0, 0, 2, 3),
    'bj_2_2_2_2_3': (0, 2, 2, 2, 2, 3),
}
"""na, nb, nc, nd, nf, nk of the fits that blackbox_plain.py descends to."""


def plain_fits(z: IOData, ours: dict[str, Model]) -> dict[str, float | str]:
    """Milliseconds of the same fits by blackbox_plain.py, and where they end.

    `plain_…_nats` is by how much its log-likelihood lies below that of our fit, on our rows.
    """
    found: dict[str, float | str] = {
        'plain_arx_10_10_5': best(lambda: textbook.arx(z.y, z.u, 10, 10, 5)),
    }
    for name, orders in ORDERS.items():
        found[f'plain_{name}'] = best(lambda o=orders: textbook.gauss_newton(z.y, z.u, *o))
        theta, _ = textbook.gauss_newton(z.y, z.u, *orders)
        n, sse = squares(ours[name].with_parameters(theta), z)
        found[f'plain_{name}_nats'] = 0.5 * n * float(np.log(sse / n / ours[name].loss))
    return found


def peers(z: IOData, python: str) -> dict[str, float | str]:
    """Milliseconds of the same fits by the libraries that `python` has."""
    with tempfile.TemporaryDirectory() as folder:
        record = Path(folder) / 'record.npz'
        np.savez(record, u=z.u, y=z.y, dt=z.dt)
        done = subprocess.run(
            [python, str(Path(__file__).with_name('blackbox_peers.py')), str(record)],
            capture_output=True, text=True, check=True,
        )
    found: dict[str, float | str] = json.loads(done.stdout.splitlines()[-1])
    return found


def identify_seconds(bag: str) -> dict[str, float | str]:
    """Seconds of the whole command on the roll axis, effects aside: first run, best of three."""
    times = []
    with tempfile.TemporaryDirectory() as folder:
        cache = {**os.environ, 'NUMBA_CACHE_DIR': f'{folder}/compiled'}
        for i in range(4):
            begin = time.perf_counter()
            subprocess.run(
                [sys.executable, '-m', 'quad_sysid.cli', 'identify', bag, '--axis', 'roll',
                 '--no-effects', '--quiet', '--out', f'{folder}/{i}'], check=True, env=cache,
            )
            times.append(time.perf_counter() - begin)
    return {'identify_first_run_s': times[0], 'identify_s': min(times[1:])}


def ratios(result: dict[str, float | str]) -> dict[str, float]:
    """Speed relative to each peer, and to the plain fits."""
    found = {'lstsq_1000 / search_1000_arx': result['lstsq_1000'] / result['search_1000_arx']}
    for name, value in result.items():
        peer, _, ours = name.partition('_')
        if peer in ('plain', 'sippy', 'sysidentpy') and ours in result:
            found[f'{name} / {ours}'] = value / result[ours]
    return found


def main() -> None:
    """Time everything and print table and JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--peers', metavar='PYTHON', help='a Python that has the peers')
    parser.add_argument('--bag', metavar='BAG', help='instead of the simulated flight')
    options = parser.parse_args()
    study = reference_study()
    z = study.record(np.random.default_rng(0))
    plain_ms, plain = thousand_lstsq(z)
    ours = search_arx(z, range(1, 11), range(1, 11), range(10)).values()
    result: dict[str, float | str] = {
        'search_1000_arx': best(lambda: search_arx(z, range(1, 11), range(1, 11), range(10))),
        'lstsq_1000': plain_ms,
        'criterion_largest_relative_difference': float(np.max(np.abs(ours / plain - 1.0))),
        'arx_10_10_5': best(lambda: arx(z, 10, 10, 5)),
        'armax_3_3_3_1': best(lambda: armax(z, 3, 3, 3, 1)),
        'oe_2_2_3': best(lambda: oe(z, 2, 2, 3)),
        'bj_2_2_2_2_3': best(lambda: bj(z, 2, 2, 2, 2, 3)),
        'iv4_2_2_3': best(lambda: iv4(z, 2, 2, 3)),
        'clriv_2_2_2_2_3': best(lambda: clriv(z, 2, 2, 2, 2, 3)),
    }
    result |= plain_fits(z, {
        'armax_3_3_3_1': armax(z, 3, 3, 3, 1), 'oe_2_2_3': oe(z, 2, 2, 3),
        'bj_2_2_2_2_3': bj(z, 2, 2, 2, 2, 3),
    })
    if options.peers:
        result |= peers(z, options.peers)
    for name, value in result.items():
        plain = name.endswith(('difference', 'variance', 'error', 'nats'))
        unit = '' if plain else ' ms'
        print(f'{name:40s} {value if isinstance(value, str) else f"{value:12.4g}"}{unit}')
    with tempfile.TemporaryDirectory() as folder:
        whole = identify_seconds(options.bag or str(write_bag(flight(), Path(folder) / 'flight')))
    for name, value in whole.items():
        print(f'{name:40s} {value:12.3g} s')
    result |= whole
    found = ratios(result)
    for name, value in found.items():
        print(f'{name:52s} {value:8.2g} x')
    print(json.dumps(result | {'ratios': found}))


if __name__ == '__main__':
    main()
