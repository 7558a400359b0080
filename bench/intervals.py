"""Gain, lag and damping of random axes: how often their 95 % intervals hold the truth.

    python bench/intervals.py --plants 24 --out bench/out

Each axis is flown at four amplitudes, bare and with dry friction and drag, in a P loop on steps of
the rate reference; simulated here in steps of 0.5 ms. Lag and damping are two poles that a wrong
answer exchanges. Friction or drag that is too small to be named acts as a damping, so that the
damping is compared twice: with the plant's own, and with what it is together with what is not
named. The candidates are friction and drag, or with `--all` every effect.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import time
from concurrent.futures import as_completed
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import workers
from numba import njit
from scipy.signal import lfilter
from threadpoolctl import threadpool_limits

from quad_sysid.effects import EFFECTS
from quad_sysid.model.data import AxisData, axis_alone
from quad_sysid.pipeline.assemble import axis_model
from quad_sysid.pipeline.identify import Options, findings_of

DT, SUBSTEPS = 0.004, 8
TRAINED_S, HELD_OUT_S = 40.0, 20.0
AMPLITUDES = (0.3, 0.8, 2.0, 5.0)
"""Of the rate reference, rad/s."""
LAWS = tuple(e for e in EFFECTS if e.name in ('coulomb_friction', 'quadratic_drag'))
ASKED = ('gain', 'lag', 'damping', 'with unnamed')
TRANSITION = 0.02
"""Of the friction, rad/s."""
WITHIN = 1.96


@dataclass(frozen=True)
class Plant:
    """A random axis; torques are divided by its inertia."""

    gain: float
    lag: float
    delay: float
    damping: float
    bias: float
    friction: float
    drag: float
    gyro: float
    """White noise, rad/s."""
    gusts: float
    """RMS of the disturbance, rad/s²."""
    kp: float


@dataclass(frozen=True)
class Case:
    """A flight of one of the axes."""

    number: int
    amplitude: float
    rough: bool
    """Whether friction and drag act."""


def drawn(number: int) -> Plant:
    """The axis of this number."""
    rng = np.random.default_rng([number, 46])

    def between(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(math.log(low), math.log(high))))

    gain, lag, delay = between(150.0, 900.0), between(0.015, 0.08), between(0.002, 0.015)
    return Plant(
        gain, lag, delay, between(0.3, 6.0), rng.uniform(-1.0, 1.0), between(0.2, 2.0),
        between(0.1, 1.0), between(0.003, 0.01), between(0.05, 1.0),
        rng.uniform(0.25, 0.4) / (gain * (lag + delay)),
    )


@njit(cache=True)
def _fly(reference, torque, gyro, gain, lag, delay, damping, bias, friction, drag, kp):
    """Commands (n,) and measured rates (n,), physics SUBSTEPS times a cycle."""
    n, h = reference.size, DT / SUBSTEPS
    fade, late = math.exp(-h / lag), round(delay / h)
    command, rate = np.zeros(n), np.zeros(n)
    fine = np.zeros(n * SUBSTEPS + late + 1)
    r = drive = 0.0
    for k in range(n):
        rate[k] = r + gyro[k]
        command[k] = min(max(kp * (reference[k] - rate[k]), -0.5), 0.5)
        for i in range(SUBSTEPS):
            m = k * SUBSTEPS + i
            fine[m + late] = command[k]
            before = drive
            drive = gain * fine[m] + (drive - gain * fine[m]) * fade
            push = 0.5 * (before + drive) + bias + torque[m]
            middle = r
            for _ in range(3):  # the midpoint rule, implicit
                middle = r + 0.5 * h * (push - damping * middle - drag * middle * abs(middle)
                                        - friction * math.tanh(middle / TRANSITION))
            r = 2.0 * middle - r
    return command, rate


def flight(case: Case) -> tuple[AxisData, Plant]:
    """Training and held-out part of a flight, and its axis."""
    plant, rng = drawn(case.number), np.random.default_rng(
        [case.number, AMPLITUDES.index(case.amplitude), case.rough])
    n = round((TRAINED_S + HELD_OUT_S) / DT)
    reference, k = np.zeros(n), 0
    while k < n:
        held = int(rng.integers(25, 125))
        reference[k : k + held] = case.amplitude * rng.choice([-1.0, 0.0, 1.0])
        k += held
    pole = math.exp(-DT / SUBSTEPS / 0.3)
    gusts = lfilter([math.sqrt(1.0 - pole**2)], [1.0, -pole],
                    rng.standard_normal(n * SUBSTEPS))
    acting = (plant.friction, plant.drag) if case.rough else (0.0, 0.0)
    command, rate = _fly(
        reference, plant.gusts * gusts, plant.gyro * rng.standard_normal(n), plant.gain, plant.lag,
        plant.delay, plant.damping, plant.bias, *acting, plant.kp,
    )
    cut = round(TRAINED_S / DT)
    whole = axis_alone(command, rate, DT, ((0, n),))
    return replace(whole, train=((0, cut),), validation=((cut, n),)), plant


def answered(case: Case, effects: tuple[Any, ...]) -> dict[str, Any]:
    """The analysis' answer to a flight, with the truth."""
    data, plant = flight(case)
    began = time.process_time()
    with threadpool_limits(limits=1):
        found = findings_of(data, Options(effects=effects))
        model = axis_model(found, {}, None)
    told = {p.name: (p.value, p.std) for p in model.base}
    named = [e.name for e in model.effects]
    truth = {**asdict(plant), 'with unnamed': plant.damping + unnamed(case, data, plant, named)}
    told['with unnamed'] = told['damping']
    return {
        **asdict(case), 'verdict': found.verdict.verdict, 'reason': found.verdict.reason,
        'named': named, 'seconds': round(time.process_time() - began, 2),
        'truth': {name: float(f'{truth[name]:.5g}') for name in ASKED},
        'told': {name: [x if x is None else float(f'{x:.5g}') for x in told[name]]
                 for name in ASKED},
    }


def unnamed(case: Case, data: AxisData, plant: Plant, named: list[str]) -> float:
    """Damping, 1/s, that comes nearest to the friction and drag that an answer does not name."""
    rate = data.training(data.rate)
    torque = np.zeros_like(rate)
    if case.rough and 'coulomb_friction' not in named:
        torque += plant.friction * np.tanh(rate / TRANSITION)
    if case.rough and 'quadratic_drag' not in named:
        torque += plant.drag * rate * np.abs(rate)
    return float(torque @ rate / (rate @ rate))


def away(row: dict[str, Any], name: str) -> float:
    """Distance from the truth in standard errors; NaN where the row has none."""
    value, std = row['told'][name]
    return math.nan if std is None else (value - row['truth'][name]) / std


def main() -> int:
    """Fly, answer, write, sum up."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--plants', type=int, default=24)
    parser.add_argument('--first', type=int, default=0)
    parser.add_argument('--all', action='store_true', help='every effect is a candidate')
    parser.add_argument('--jobs', type=int, default=os.cpu_count() or 1)
    parser.add_argument('--out', type=Path, default=Path('bench/out'), help='folder for rows')
    options = parser.parse_args()
    cases = [Case(number, amplitude, rough)
             for number in range(options.first, options.first + options.plants)
             for amplitude in AMPLITUDES for rough in (False, True)]
    options.out.mkdir(parents=True, exist_ok=True)
    rows = []
    with workers.pool(options.jobs) as pool, \
            (options.out / 'intervals.jsonl').open('w') as file:
        effects = EFFECTS if options.all else LAWS
        for future in as_completed([pool.submit(answered, case, effects) for case in cases]):
            row = future.result()
            rows.append(row)
            file.write(json.dumps(row) + '\n')
            file.flush()
            print(f'{row["number"]:3} {row["amplitude"]:4} {"rough" if row["rough"] else "bare "}',
                  f'{row["verdict"]:20} {"+".join(row["named"]):33}',
                  *(f'{name} {away(row, name):+.1f}' for name in ASKED),
                  flush=True)
    for name in ASKED:
        z = np.array([away(row, name) for row in rows if row['verdict'] != 'cannot_tell'])
        known = np.isfinite(z)
        print(f'{name}: {np.mean(np.abs(z[known]) < WITHIN):.3f} of {known.sum()} intervals')
    return 0


if __name__ == '__main__':
    sys.exit(main())
