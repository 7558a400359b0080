"""What one evaluation of the likelihood costs, and a whole axis: `make bench-effects-speed`.

Beside it, in the same run, a plain Kalman filter of the same base in numpy, with derivatives by
differences, as one writes it in an afternoon; with `--peers PYTHON`, a Python that has them, also
the filters of statsmodels and filterpy, which give the likelihood without derivatives, and that of
dynamax. Ratios count, not seconds. Each call has parameters of its own, as in a search: the flight
keeps the drive that the last ones gave.
"""

from __future__ import annotations

import argparse
import itertools
import json
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import effects_scenarios as scenarios
import numpy as np
from threadpoolctl import threadpool_limits

from quad_sysid.discover.accept import Unseen, judge
from quad_sysid.discover.base import best_base
from quad_sysid.discover.screen import candidates
from quad_sysid.discover.search import search
from quad_sysid.effects import EFFECTS
from quad_sysid.estimate.fit import Fit, Problem
from quad_sysid.explain import explain
from quad_sysid.model.data import axis_data
from quad_sysid.model.noise import Filter

REPEATS = 5


def main() -> None:
    """Print the cost of one evaluation, and of flights with nothing and with friction."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--peers', metavar='PYTHON',
                        help='a Python with statsmodels, filterpy, dynamax')
    options = parser.parse_args()
    with threadpool_limits(limits=1):
        for flight in scenarios.draw(77_000, seeds=1, pairs=0, nothing=1, undeclared=0):
            if flight.planted in ((), ('coulomb_friction',)):
                axis(flight, options.peers)


def axis(flight: scenarios.Scenario, peers: str | None) -> None:
    """One flight: an evaluation beside its plain twin, then the whole answer."""
    data = axis_data([scenarios.flown(flight, unseen=False)], flight.axis)
    problem = Problem(data, data.train)
    base = best_base(problem)
    steps = np.full(base.theta.size, 1e-4)
    n = problem.data.rate.size
    points = itertools.cycle(base.theta + moved for moved in np.linspace(1e-6, 1e-4, 1000))
    ours = timed(
        lambda: problem.flight.predict(base.structure, next(points), sweeps=1, steps=steps)
    )
    plain = timed(lambda: plain_filter(problem, base, base.theta.size + 1), repeats=1)
    print(f'{flight.planted or "nothing"}: {n} samples at {1 / data.dt:.0f} Hz')
    print(f'  likelihood and gradient  {1e6 * ours / n:7.2f} us a sample')
    print(f'  the same in plain numpy  {1e6 * plain / n:7.2f} us a sample')
    print(f'  ratio                    {plain / ours:7.0f}')
    if peers and not problem.flight.sensor.behind:  # theirs is the model without a gyro filter
        value = timed(lambda: problem.flight.predict(base.structure, next(points), sweeps=1))
        left = problem.flight.predict(base.structure, base.theta, sweeps=1).innovation
        print(f'  likelihood alone         {1e6 * value / n:7.2f} us a sample; innovations '
              f'{float(np.sqrt(np.nanmean(left**2))):.5f} rad/s')
        for name, told in by_peers(problem, base, peers).items():
            if told:
                print(f'  {name:24} {told["us"]:7.2f} us a sample, ratio '
                      f'{told["us"] / (1e6 * value / n):.0f}; innovations {told["rms"]:.5f} rad/s')
            if 'us_derivatives' in told:
                print(f'  {name + " with derivatives":24} {told["us_derivatives"]:7.2f} us a '
                      f'sample, ratio {told["us_derivatives"] / (1e6 * ours / n):.0f}')
    began = time.process_time()
    found = search(problem, EFFECTS)
    ladder = explain(problem, found, candidates(problem, EFFECTS)[0])
    verdict = judge(Unseen(data, data.validation), problem, found, ladder)
    spent = time.process_time() - began
    print(f'  whole axis               {spent:7.2f} s of CPU, {len(found.all)} structures fitted, '
          f'{verdict.chosen.structure.labels}')


def timed(call: Callable[[], object], repeats: int = REPEATS) -> float:
    """The shortest of several runs, s."""
    call()
    spent = []
    for _ in range(repeats):
        began = time.perf_counter()
        call()
        spent.append(time.perf_counter() - began)
    return min(spent)


def linear(problem: Problem, base: Fit) -> tuple[Filter, np.ndarray]:
    """The base's steady filter, and (n,) what pushes its rate in each cycle, rad/s."""
    flight, p = problem.flight, base.values
    known = flight.pushed(base.structure, p, flight.rate).known.mean(axis=0)
    found, *_ = flight.filters_of(base.structure, base.theta, float(p[3]))
    return found, problem.data.dt * known


def plain_filter(problem: Problem, base: Fit, evaluations: int) -> float:
    """Sum of squared innovations, as often as differences over all parameters ask for."""
    found, pushes = linear(problem, base)
    f, gain = found.transition, found.gain
    total = 0.0
    for _ in range(evaluations):
        x = np.zeros(gain.size)
        for k in range(pushes.size):
            e = problem.data.rate[k] - found.output @ x
            x = f @ (x + gain * e)
            x[0] += pushes[k]
            total += e * e
    return total


def by_peers(problem: Problem, base: Fit, python: str) -> dict[str, dict[str, float]]:
    """Time per sample, µs, and RMS of the peers' filters on one linear model, in their Python."""
    used, pushes = linear(problem, base)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / 'model.npz'
        np.savez(file, y=problem.data.rate, f=used.transition, q=used.process, c=used.output,
                 r=np.array(used.after), pushes=pushes)
        done = subprocess.run([python, Path(__file__).with_name('effects_peers.py'), file],
                              capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


if __name__ == '__main__':
    main()
