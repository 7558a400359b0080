"""The same task with other packages: what an axis is, from arrays, judged on arrays held out.

    make bench-peers ARGS='--peers PYTHON'

One axis of `make flight` (a drive, damping, a delay and a bearing that sticks and slips): 30 s
train, 15 s validate. PYTHON has `aeroid`, `pysindy` and `sippy_unipi`; each is left out where it
is missing. AeroID gets delay and friction by hand, pysindy the products in its library, SIPPY the
best of three orders: what their users would do. Ours gets the arrays, the held-out ones too, which
only confirm or withdraw its effects. Ends with a table: lines and seconds of each, gain and lag
beside the truth, the error of the free run over the held-out part, and what it says is missing.
"""

from __future__ import annotations

import argparse
import contextlib
import inspect
import io
import json
import os
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

DELAY = 2
"""Samples of 4 ms, which AeroID is given."""
PATIENCE_S = 1500
"""A package that takes longer has no answer."""
Arrays = Mapping[str, np.ndarray]
Answer = dict[str, Any]


def ours(train: Arrays, held: Arrays, dt: float) -> Answer:
    """Two calls."""
    import quad_sysid as qs

    keys = ('u', 'y', 'angle')
    both = {name: np.concatenate([train[name], held[name]]) for name in keys}
    n = train['u'].size
    found = qs.identify(**both, dt=dt, train=slice(0, n), validate=slice(n, None))
    model = found.model
    return {
        **{name: [model.parameters[name].value, model.parameters[name].std]
           for name in ('gain', 'lag')},
        'says': ', '.join(one.name for one in model.effects) or found.verdict,
        'rate': model.simulate(held['u'], (held['y'][0], held['angle'][0])),
    }


def aeroid(train: Arrays, held: Arrays, dt: float) -> Answer:
    """Output error of a model with friction, written by hand."""
    import aeroid as peer

    def dynamics(t: float, x: Any, u: Any, p: Mapping[str, float]) -> np.ndarray:
        del t
        _, rate, drive = x
        friction = p['friction'] * np.tanh(rate / 0.05)
        return np.array([rate, drive - p['damping'] * rate - friction + p['bias'],
                         (p['gain'] * u[0] - drive) / p['lag']])

    starts = {'gain': 300.0, 'lag': 0.05, 'damping': 1.0, 'friction': 0.5, 'bias': 0.0}
    model = peer.Model(states=['angle', 'rate', 'drive'], controls=['u'], parameters=starts,
                       dynamics=dynamics)
    data = [peer.FlightData(dt * np.arange(one['u'].size), {
        'u': np.concatenate([np.zeros(DELAY), one['u'][:-DELAY]]), 'rate': one['y'],
        'angle': one['angle'], 'drive': np.zeros(one['u'].size),
    }) for one in (train, held)]
    found = peer.identify(model, data[0], list(starts), outputs=['rate'],
                          simulate_options={'method': 'LSODA', 'rtol': 1e-6, 'atol': 1e-8},
                          bounds={
        'gain': (1.0, 5000.0), 'lag': (0.002, 0.5), 'damping': (0.0, 30.0),
        'friction': (0.0, 20.0), 'bias': (-20.0, 20.0)})
    fitted = peer.Model(states=['angle', 'rate', 'drive'], controls=['u'],
                        parameters=found.parameters, dynamics=dynamics)
    start = [held['angle'][0], held['y'][0], 0.0]
    run = fitted.simulate(data[1].time, {'u': data[1].channels['u']}, x0=start)
    return {'gain': [found.parameters['gain'], found.stderr['gain']],
            'lag': [found.parameters['lag'], found.stderr['lag']],
            'says': 'nothing: the friction was given', 'rate': run.states[:, 1]}


def pysindy(train: Arrays, held: Arrays, dt: float) -> Answer:
    """Sparse regression of the rate's derivative on products of rate, angle and command."""
    import pysindy as peer

    def late(u: np.ndarray) -> np.ndarray:
        return np.concatenate([np.zeros(DELAY), u[:-DELAY]])[:, None]

    library = peer.ConcatLibrary([
        peer.PolynomialLibrary(degree=1),
        peer.CustomLibrary([lambda x: np.tanh(x / 0.05), lambda x: x * np.abs(x)],
                           [lambda x: f'tanh({x}/0.05)', lambda x: f'{x}|{x}|']),
    ])
    model = peer.SINDy(optimizer=peer.STLSQ(threshold=0.1), feature_library=library,
                       differentiation_method=peer.SmoothedFiniteDifference())
    model.fit(train['y'][:, None], t=dt, u=late(train['u']), feature_names=['rate', 'u'])
    terms = dict(zip(model.get_feature_names(), model.coefficients()[0], strict=True))
    rate, u = held['y'].copy(), late(held['u'])
    for k in range(rate.size - 1):  # its own `simulate` takes more than eight minutes
        slope = model.predict(rate[k : k + 1, None], u=u[k : k + 1])
        rate[k + 1] = rate[k] + dt * slope[0, 0]
        if not abs(rate[k + 1]) < 1e3:  # it diverges
            rate[k + 1 :] = np.nan
            break
    return {'gain': [float(terms['u']), None], 'lag': None, 'rate': rate,
            'says': ' '.join(f'{v:+.3g} {n}' for n, v in terms.items() if v)}


def sippy(train: Arrays, held: Arrays, dt: float) -> Answer:
    """Output error of order 2, 3, 4; the free run over the training chooses."""
    import control
    from sippy_unipi import system_identification as identify

    best: tuple[float, Any] = (np.inf, None)
    for order in (2, 3, 4):
        found = identify(train['y'], train['u'], 'OE', OE_orders=[order, order, DELAY], tsample=dt)
        run = control.forced_response(found.G, U=train['u']).outputs
        error = float(np.sqrt(np.mean((np.squeeze(run) - train['y']) ** 2)))
        best = min(best, (error, found), key=lambda one: one[0])
    run = control.forced_response(best[1].G, U=held['u']).outputs
    return {'gain': None, 'lag': None, 'says': 'nothing', 'rate': np.squeeze(run)}


TASKS: dict[str, Callable[[Arrays, Arrays, float], Answer]] = {
    'quad_sysid': ours, 'AeroID': aeroid, 'pysindy': pysindy, 'SIPPY': sippy,
}


def cpu_s() -> float:
    """Seconds of CPU of this process and of those that it has ended."""
    used = os.times()
    return used.user + used.system + used.children_user + used.children_system


def solved(name: str, arrays: Path) -> Answer:
    """Run one package's task, in this process."""
    stored = np.load(arrays)
    train, held = ({key: stored[f'{part}_{key}'] for key in ('u', 'y', 'angle')}
                   for part in ('train', 'held'))
    began = cpu_s()
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter('ignore')
        try:
            answer = TASKS[name](train, held, float(stored['dt']))
        except ImportError as missing:
            return {'missing': str(missing)}
        except Exception as error:  # noqa: BLE001  a peer may fail in any way
            return {'missing': f'{type(error).__name__}: {error}'}
    seconds = cpu_s() - began
    error = answer.pop('rate') - held['y']
    code = inspect.getsource(TASKS[name]).splitlines()
    return {**answer, 'seconds': seconds, 'lines': sum(bool(line.strip()) for line in code) - 2,
            'error_percent': 100.0 * float(np.sqrt(np.mean(error**2)) / np.std(held['y']))}


def arrays_of_a_flight(folder: Path) -> Path:
    """The roll axis of `make flight` as one file."""
    import quad_sysid as qs

    made = Path(__file__).parent.parent / 'tools/flight.py'
    subprocess.run([sys.executable, str(made), str(folder)], check=True, capture_output=True)
    record = qs.read_bag(folder / 'my_flight')
    parts = {}
    for role, name in (('train', 'train'), ('validation', 'held')):
        segment = next(one for one in record.segments if one.role == role)
        rows = slice(round(segment.start_s / record.dt), round(segment.end_s / record.dt))
        parts |= {f'{name}_u': record.control[rows, 1], f'{name}_y': record.rates[rows, 0],
                  f'{name}_angle': record.angles[rows, 0]}
    path = folder / 'arrays.npz'
    np.savez(path, dt=record.dt, **parts)
    return path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--peers', default=sys.executable, help='the Python that has the others')
    parser.add_argument('--solve', nargs=2, metavar=('NAME', 'ARRAYS'), help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.solve:
        print(json.dumps(solved(given.solve[0], Path(given.solve[1]))))
        return
    rows = {}
    with tempfile.TemporaryDirectory() as folder:
        arrays = arrays_of_a_flight(Path(folder))
        for name in TASKS:
            python = sys.executable if name == 'quad_sysid' else given.peers
            try:
                done = subprocess.run([python, __file__, '--solve', name, str(arrays)],
                                      check=False, capture_output=True, text=True,
                                      timeout=PATIENCE_S)
            except subprocess.TimeoutExpired:
                rows[name] = {'missing': f'no answer in {PATIENCE_S // 60} minutes'}
                continue
            said = done.stdout.splitlines()
            rows[name] = json.loads(said[-1]) if said else {'missing': done.stderr[-200:]}
    print('| package | lines | CPU seconds | gain | lag, s | free run, error | says |')
    print('|---|---|---|---|---|---|---|')
    for name, row in rows.items():
        if 'missing' in row:
            print(f'| {name} | | | | | | {row["missing"]} |')
            continue
        gain, lag = (told(row[key]) for key in ('gain', 'lag'))
        print(f'| {name} | {row["lines"]} | {row["seconds"]:.1f} | {gain} | {lag} |'
              f' {row["error_percent"]:.2f} % | {row["says"]} |')


def told(value: list[float | None] | None) -> str:
    """A parameter with its standard error, where there is one."""
    if value is None:
        return '-'
    number, error = value
    return f'{number:.4g}' + (f' ± {error:.2g}' if error else '')


if __name__ == '__main__':
    main()
