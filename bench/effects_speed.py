"""What one candidate costs, beside scipy's solvers on the same physics, and what all of them do.

    OPENBLAS_NUM_THREADS=1 python bench/effects_speed.py [--quick]

One evaluation is the free run of a base with an effect over a whole flight of 85 s at 250 Hz: the
command held over each cycle, behind delay and lag, the gyro filter behind the rate. scipy's
solve_ivp and odeint get the same equations cycle by cycle (the command jumps in between), over a
stretch of it, and their time is scaled to the flight. Ours are the best of several calls, after
one that compiles. The command `quad-sysid identify` is timed from process start to the report, on
one axis of an 85 s bag with all effects, the best of two after one that compiles; times of the
processor stand beside, for a machine that is busy. Ends with one JSON object on its last line.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from quad_sysid.effects.discover import discover
from quad_sysid.effects.judge import judge
from quad_sysid.effects.shapes import SHAPES
from quad_sysid.effects.table import EFFECTS, by_name
from quad_sysid.greybox.data import AxisData, Windows, axis_data
from quad_sysid.greybox.levenberg import difference_jacobian
from quad_sysid.greybox.simulate import Simulator
from quad_sysid.greybox.structure import Structure
from scipy.integrate import odeint, solve_ivp
from threadpoolctl import threadpool_limits

from quad_bridge.virtual.flight_bag import write_bag
from quad_bridge.virtual.profile import load_profile
from quad_bridge.virtual.simulation import Excited, Flight, fly
from quad_sysid.bags import read_bag
from quad_sysid.effects.torques import STICTION_RATE
from quad_sysid.signals.prbs import prbs

DT, SECONDS, LAG_S, DELAY_CYCLES = 0.004, 85.0, 0.045, 2
BASE = (434.5, LAG_S, DELAY_CYCLES * DT, 0.4, 0.02)
GYRO_HZ = 42.0
TOLERANCE = {'rtol': 1e-11, 'atol': 1e-13}
STRETCH_S = 2.0
"""Of the flight that the solvers run; their time is scaled to all of it."""

CASES: Mapping[str, tuple[float, ...]] = {
    'quadratic_drag': (0.5,), 'pendulum_stiffness': (2.0,), 'coulomb_friction': (0.3,),
    'dead_zone': (0.003,),
}
"""Effect: its parameters."""


def torque(name: str, p: float, rate: float, angle: float) -> float:
    """The effect's equation, written out anew, rad/s²."""
    if name == 'quadratic_drag':
        return -p * rate * abs(rate)
    if name == 'pendulum_stiffness':
        return -p * np.sin(angle)
    if name == 'coulomb_friction':
        return -p * np.tanh(rate / max(STICTION_RATE, p * DT))
    return 0.0


def slope(name: str, p: float) -> Callable[..., list[float]]:
    """x' of (lag, rate, angle, gyro, its slope) for a held command."""
    gain, lag, _, damping, bias = BASE
    cut = 2.0 * np.pi * GYRO_HZ

    def of(_: float, x: np.ndarray, u: float) -> list[float]:
        w, rate, angle, g, d = x
        return [
            (u - w) / lag,
            gain * w - damping * rate + bias + torque(name, p, rate, angle),
            rate,
            d,
            cut**2 * (rate - g) - np.sqrt(2.0) * cut * d,
        ]

    return of


def commands(name: str, p: float, command: np.ndarray) -> np.ndarray:
    """What acts, delayed: the command of two cycles ago, its first before."""
    if name == 'dead_zone':
        command = np.sign(command) * np.maximum(np.abs(command) - p, 0.0)
    return np.concatenate([np.full(DELAY_CYCLES, command[0]), command[:-DELAY_CYCLES]])


def by_solver(name: str, p: float, command: np.ndarray, count: int, solver: str) -> np.ndarray:
    """(count,) gyro output, one solver call a cycle."""
    acting = commands(name, p, command)
    x = np.array([acting[0], 0.0, 0.0, 0.0, 0.0])
    out = np.empty(count)
    of = slope(name, p)
    for k in range(count):
        out[k] = x[3]
        if solver == 'solve_ivp':
            done = solve_ivp(of, (0.0, DT), x, args=(acting[k],), method='DOP853', **TOLERANCE)
            x = done.y[:, -1]
        else:
            x = odeint(of, x, (0.0, DT), args=(acting[k],), tfirst=True, **TOLERANCE)[-1]
    return out


def by_hand(name: str, p: float, command: np.ndarray, count: int) -> np.ndarray:
    """(count,) the same by a plain loop with numpy: classical Runge-Kutta, four steps a cycle."""
    acting = commands(name, p, command)
    x = np.array([acting[0], 0.0, 0.0, 0.0, 0.0])
    out, of, h = np.empty(count), slope(name, p), DT / 4.0
    for k in range(count):
        out[k] = x[3]
        for _ in range(4):
            a = np.array(of(0.0, x, acting[k]))
            b = np.array(of(0.0, x + 0.5 * h * a, acting[k]))
            c = np.array(of(0.0, x + 0.5 * h * b, acting[k]))
            d = np.array(of(0.0, x + h * c, acting[k]))
            x = x + h / 6.0 * (a + 2.0 * b + 2.0 * c + d)
    return out


def open_flight(seconds: float) -> AxisData:
    """A PRBS on the command without a loop: an input is all that a free run needs."""
    n = round(seconds / DT)
    control = np.zeros((n, 4))
    control[:, 1] = np.resize(prbs(9, 24, 0.002, 1), n)
    zero, whole = np.zeros(n), ((0, n),)
    return AxisData(
        axis='roll', dt=DT, rate=zero, angle=zero.copy(), control=control,
        motors=np.zeros((n, 4)), other_rates=np.zeros((n, 2)), battery_v=None,
        gyro_filter_hz=GYRO_HZ, stretches=whole, train=whole, validation=(),
    )


def one_run(data: AxisData) -> Simulator:
    """A simulator whose one window is the whole flight, from rest."""
    n = data.rate.size
    windows = Windows(np.zeros(1, dtype=np.int64), n, np.zeros(1, dtype=np.int64))
    return Simulator(data, ((0, n),), windows, np.zeros(4))


def best(call: Callable[[], object], repeat: int = 9) -> float:
    """Shortest time of a call, s, after one that compiles."""
    call()
    times = []
    for _ in range(repeat):
        begin = time.perf_counter()
        call()
        times.append(time.perf_counter() - begin)
    return min(times)


def evaluation(name: str) -> dict[str, float]:
    """Times (s, for the whole flight) and largest differences (rad/s) of one effect."""
    p = CASES[name]
    structure = Structure().with_effect(by_name(name), {})
    theta = np.array([*BASE, *p])
    data = open_flight(SECONDS)
    sim = one_run(data)
    specs = structure.specs
    lower, upper, scale = (
        np.array([getattr(s, key) for s in specs]) for key in ('lower', 'upper', 'scale')
    )

    def run() -> np.ndarray:
        sim._cache.clear()  # noqa: SLF001 - the drive response counts as well
        return sim.run(structure, theta).errors.ravel()

    def residual(at: np.ndarray) -> np.ndarray:
        return sim.run(structure, at).errors.ravel()

    def gradient() -> object:
        sim._cache.clear()  # noqa: SLF001
        return difference_jacobian(residual, theta, residual(theta), lower, upper, scale)

    ours = run()
    found = {'ours': best(run), 'ours_gradient': best(gradient, 5)}
    count = round(STRETCH_S / DT)
    whole = ours.size / count
    for solver in ('solve_ivp', 'odeint', 'plain_loop'):
        begin = time.perf_counter()
        if solver == 'plain_loop':
            theirs = by_hand(name, p[0], data.command, count)
        else:
            theirs = by_solver(name, p[0], data.command, count, solver)
        found[solver] = whole * (time.perf_counter() - begin)
        found[f'{solver}_difference'] = float(np.max(np.abs(theirs - ours[:count])))
        found[f'{solver}_times'] = found[solver] / found['ours']
    found['solve_ivp_gradient_times'] = (
        found['solve_ivp'] * (theta.size + 1) / found['ours_gradient']
    )
    return found


def lengths() -> dict[float, float]:
    """Seconds of one evaluation over flights of 10, 85 and 340 s."""
    structure = Structure().with_effect(by_name('coulomb_friction'), {})
    theta = np.array([*BASE, *CASES['coulomb_friction']])
    found = {}
    for seconds in (10.0, 85.0, 340.0):
        sim = one_run(open_flight(seconds))

        def run(sim: Simulator = sim) -> object:
            sim._cache.clear()  # noqa: SLF001
            return sim.run(structure, theta)

        found[seconds] = best(run)
    return found


def stirred_flight(seed: int = 1) -> Flight:
    """85 s in hover, dry friction on roll, the other axes stirred: every effect can be tried."""
    profile = load_profile('hover')
    friction = replace(profile.effects.coulomb_friction, enabled=True)
    profile = replace(profile, effects=replace(profile.effects, coulomb_friction=friction))
    n = round(SECONDS / DT)
    t = np.arange(n) * DT
    schedule = []
    for role, signal, begin, end, bits in (
        ('train', 'prbs', 4.0, 47.0, 9), ('validation', 'prbs', 49.0, 65.0, 10),
        ('validation', 'square', 67.0, 84.0, 0),
    ):
        count = round((end - begin) / DT)
        samples = (
            np.resize(prbs(bits, 23, 0.2, bits), count) if bits
            else 0.2 * np.sign(np.sin(2.0 * np.pi * 0.4 * t[:count]))
        )
        schedule.append(Excited(begin, samples, role=role, signal=signal))
    sway = 0.1 * np.sin(2.0 * np.pi * 0.4 * t) + 0.1 * np.sin(2.0 * np.pi * 0.9 * t)
    schedule += [
        Excited(4.0, sway[:-1500], axis=axis, role='idle', signal='none')
        for axis in ('pitch', 'yaw')
    ]
    return fly(profile, schedule, SECONDS, seed)


def whole(quick: bool) -> dict[str, float]:
    """Seconds of discovery and judgement at array level, and of the command."""
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / 'flight'
        flown = stirred_flight()
        scheduled = tuple(part for part in flown.schedule if part.role != 'idle')
        write_bag(replace(flown, schedule=scheduled), bag)
        data = axis_data([read_bag(str(bag))], 'roll')
        rng = np.random.default_rng(0)
        with threadpool_limits(limits=1):
            for _ in range(2):
                begin, busy = time.perf_counter(), time.process_time()
                seen = discover(data, EFFECTS + SHAPES, rng)
                judge(seen, rng)
                found['discover_and_judge_s'] = time.perf_counter() - begin
                found['discover_and_judge_cpu_s'] = time.process_time() - busy
        found['candidates_tried'] = float(len(seen.tried))
        if not quick:
            found |= _command(bag, Path(folder))
    return found


def _command(bag: Path, folder: Path) -> dict[str, float]:
    times, busy = [], []
    for i in range(3):
        begin, before = time.perf_counter(), os.times().children_user
        subprocess.run(
            [sys.executable, '-m', 'quad_sysid.cli', 'identify', str(bag), '--axis', 'roll',
             '--quiet', '--out', str(folder / str(i))], check=True, env=dict(os.environ),
        )
        times.append(time.perf_counter() - begin)
        busy.append(os.times().children_user - before)
    return {
        'identify_first_run_s': times[0], 'identify_s': min(times[1:]),
        'identify_cpu_s': min(busy[1:]),
    }


def table(*, quick: bool = False) -> tuple[list[str], dict[str, object]]:
    """Lines to print, and the same as one tree."""
    tree: dict[str, object] = {}
    head = ('effect', 'ours', 'gradient', 'solve_ivp', 'odeint', 'loop', 'difference')
    lines = [
        'one free run over 85 s at 250 Hz: ms ours, how many times longer the others take,',
        'and the largest difference to them (rad/s)',
        '{:20}{:>7}{:>10}{:>11}{:>9}{:>8}{:>13}'.format(*head),
    ]
    for name in CASES:
        one = evaluation(name)
        tree[name] = one
        lines.append(
            f'{name:20}{1e3 * one["ours"]:7.2f}{1e3 * one["ours_gradient"]:10.1f}'
            f'{one["solve_ivp_times"]:10.0f}x{one["odeint_times"]:8.0f}x'
            f'{one["plain_loop_times"]:7.0f}x{one["solve_ivp_difference"]:13.1e}'
        )
    found = lengths()
    tree['seconds_by_length'] = found
    lines += ['', 'length of the flight: ' + ', '.join(
        f'{seconds:g} s {1e3 * spent:.2f} ms' for seconds, spent in found.items()
    )]
    rest = whole(quick)
    tree |= rest
    lines += [f'{name:24} {value:8.2f}' for name, value in rest.items()]
    return lines, tree


def main() -> None:
    """Time everything; print table and JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--quick', action='store_true', help='leave the command out')
    lines, tree = table(quick=parser.parse_args().quick)
    print('\n'.join(lines))
    print(json.dumps(tree))


if __name__ == '__main__':
    main()
