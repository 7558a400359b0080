"""Nothing is missing and flying is hard: how often is an effect named, or something unexplained?

Gusts up to five times what the excitation does at low frequency, some with lulls, bursts of torque
noise, a battery anywhere between full and flat, sticks and throttle that move, doublets of the
other axes, coloured and quantised gyro noise, stamps that jitter: each flight draws its own.

    python bench/effects_hard.py --flights 300 --out bench/out
    python bench/effects_hard.py --flights 200 --kind gusts
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import as_completed
from dataclasses import dataclass, replace
from pathlib import Path

import effects_scenarios as scenarios
import numpy as np
import workers
from effects_answer import searched
from threadpoolctl import threadpool_limits
from virtual_flights import record_of

from quad_bridge.virtual.profile import load_profile
from quad_sysid.effects import EFFECTS
from quad_sysid.pipeline.assemble import axis_model
from quad_sysid.record import Record

STEP_S = 0.004
"""Grid of the gusts."""
EXCITED = 0.32
"""Density of the acceleration that the PRBS asks for at 0.3 Hz, (rad/s²)/√Hz."""
STEPS = (0.0, 0.00106, 0.0043, 0.01745)
"""Steps of quantised rates, rad/s: 1/16 to 1 degree a second."""


@dataclass(frozen=True)
class Hardship:
    """Disturbances and faults of one flight."""

    gust: float
    """Density of the gusts' acceleration over the excitation's, below their bandwidth."""
    gust_hz: float
    lulls: bool
    bursts_per_min: float
    colour: float
    """RMS of coloured gyro noise, rad/s."""
    colour_hz: float
    step: float
    """Step of the quantised rate, rad/s."""
    jitter_s: float
    doublets: bool
    """Other axes' manoeuvres, in hover."""
    one_gust: bool
    """Whether the same gust turns all axes, as one at an angle does."""


CALM = Hardship(0.0, 1.0, False, 0.0, 0.0, 1.0, 0.0, 0.0, False, False)
KINDS: dict[str, tuple[str, ...] | None] = {
    'mixed': None, 'white': (), 'gusts': ('gust', 'gust_hz', 'lulls'),
    'bursts': ('bursts_per_min',), 'shared': ('gust', 'gust_hz', 'one_gust'),
    'jitter': ('jitter_s',), 'quantised': ('step',), 'coloured gyro': ('colour', 'colour_hz'),
}
"""Kind of disturbance → the hardships that it keeps; all of them where mixed."""


def drawn(first_seed: int, number: int, kind: str = 'mixed'
          ) -> tuple[scenarios.Scenario, Hardship]:
    """Flight and hardships of a number; of one kind the first number that has it."""
    kept = KINDS[kind]
    for draw in range(100):
        scenario, hard = _drawn(first_seed, number + 1000 * draw, one_gust=kind == 'shared')
        if kept is None:
            return scenario, hard
        alone = replace(CALM, **{name: getattr(hard, name) for name in kept})
        if all(getattr(alone, name) for name in kept[:1]):
            return replace(scenario, torque_bandwidth_hz=0.0), alone
    raise ValueError(kind)


def _drawn(
    first_seed: int, number: int, *, one_gust: bool = False
) -> tuple[scenarios.Scenario, Hardship]:
    rng = np.random.default_rng([first_seed, number])

    def log_uniform(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(math.log(low), math.log(high))))

    axis, mount = (*scenarios.PLACES, ('yaw', 'rig'), ('yaw', 'hover'))[number % 6]
    width = log_uniform(0.3, 8.0)
    hardship = Hardship(
        gust=log_uniform(0.3, 5.0) * min(1.0, math.sqrt(2.0 / width)) * (rng.random() < 0.75),
        gust_hz=width, lulls=bool(rng.random() < 0.3),
        bursts_per_min=float(rng.uniform(4.0, 20.0)) * (rng.random() < 0.5),
        colour=float(rng.uniform(0.002, 0.012)) * (rng.random() < 0.5),
        colour_hz=log_uniform(0.05, 15.0), step=float(rng.choice(STEPS)),
        jitter_s=float(rng.uniform(0.2e-3, 1.2e-3)) * (rng.random() < 0.5),
        doublets=bool(mount == 'hover' and rng.random() < 0.6), one_gust=one_gust,
    )
    scenario = scenarios.Scenario(
        number=number, kind='nothing', planted=(), simulator='virtual', axis=axis, mount=mount,
        seed=first_seed + number, effects={'vibration': {}} if rng.random() < 0.3 else {},
        torque_bandwidth_hz=float(rng.choice([0.0, 2.0, 5.0])), stirred=bool(rng.random() < 0.7),
        start_charge=float(rng.choice([0.95, 0.4, 0.15])),
    )
    return scenario, hardship


def coloured(rng: np.random.Generator, count: int, bandwidth_hz: float) -> np.ndarray:
    """(count,) first-order noise of RMS 1 on the grid."""
    fade = math.exp(-2.0 * math.pi * bandwidth_hz * STEP_S)
    white = rng.standard_normal(count) * math.sqrt(1.0 - fade**2)
    out, last = np.empty(count), rng.standard_normal()
    for k in range(count):
        last = fade * last + white[k]
        out[k] = last
    return out


def gusts(rng: np.random.Generator, axis: int, count: int, hard: Hardship) -> np.ndarray:
    """(count, 3) accelerations from outside, rad/s²."""
    out = np.zeros((count, 3))
    rms = hard.gust * EXCITED * math.sqrt(0.5 * math.pi * hard.gust_hz)
    blown = [coloured(rng, count, hard.gust_hz) for _ in range(1 if hard.one_gust else 3)]
    for i, share in enumerate((1.0, 1.0, 0.3)):
        out[:, i] = rms * share * blown[i % len(blown)]
    if hard.lulls:
        out *= np.clip(1.0 + coloured(rng, count, 0.05), 0.0, 2.5)[:, None]
    for _ in range(rng.poisson(hard.bursts_per_min * count * STEP_S / 60.0)):
        first, length = int(rng.integers(0, count - 130)), int(rng.integers(20, 120))
        size = rng.uniform(0.4, 5.0) * math.sqrt(0.5 / STEP_S)
        out[first : first + length, :2] += 0.3 * size * rng.standard_normal((length, 2))
    for other in {0, 1, 2} - {axis} if hard.doublets else ():
        for _ in range(int(count * STEP_S / 6.0)):
            first, half = int(rng.integers(0, count - 100)), int(rng.integers(20, 50))
            size = float(rng.uniform(4.0, 14.0) * rng.choice([-1.0, 1.0]))
            out[first : first + half, other] += size
            out[first + half : first + 2 * half, other] -= size
    return out


def flown(scenario: scenarios.Scenario, hard: Hardship) -> Record:
    """The record of the flight, as a bag with all this would give it."""
    rng = np.random.default_rng([scenario.seed, 77])
    inertia = np.array(load_profile('plain').airframe.inertia_kg_m2)
    index = scenarios.AXES.index(scenario.axis)
    torque = gusts(rng, index, round(90.0 / STEP_S), hard) * inertia
    record = record_of(scenarios.flight_of(
        scenario, scenario.seed, unseen=False,
        effect=lambda t, *_: torque[min(int(t / STEP_S), len(torque) - 1)],
    ))
    rates = record.rates + hard.colour * np.stack(
        [coloured(rng, record.n, hard.colour_hz) for _ in range(3)], axis=1
    )
    if hard.step:
        rates = np.round(rates / hard.step) * hard.step
    if hard.jitter_s:  # resampled to the grid from stamps that are late
        grid = np.arange(record.n, dtype=float)
        late = np.abs(rng.standard_normal(record.n)) * hard.jitter_s / record.dt
        late[rng.random(record.n) < 0.003] += rng.uniform(1.0, 5.0)
        stamps = np.maximum.accumulate(grid + late)
        rates = np.stack([np.interp(grid, stamps, column) for column in rates.T], axis=1)
    return replace(record, rates=rates)


def answered(first_seed: int, number: int, kind: str) -> dict[str, object]:
    """The answer to one flight."""
    scenario, hard = drawn(first_seed, number, kind)
    with threadpool_limits(limits=1):
        found = searched(flown(scenario, hard), scenario.axis, EFFECTS)
        model = axis_model(found, {}, None)
    verdict = found.verdict
    return {
        'kind': kind, 'number': number, 'verdict': verdict.verdict,
        'named': [e.name for e in model.effects],
        'probabilities': [e.probability for e in model.effects], 'reason': verdict.reason,
        'before': verdict.before, 'after': verdict.after, 'predicted': verdict.predicted,
        'gain': verdict.chosen.value('gain'), **vars(hard),
    }


def answers(
    first_seed: int, count: int, jobs: int, kind: str
) -> Iterator[dict[str, object]]:
    """Answers of all flights, in the order in which they finish."""
    with workers.pool(jobs) as pool:
        waiting = [pool.submit(answered, first_seed, k, kind) for k in range(count)]
        for done, future in enumerate(as_completed(waiting), 1):
            print(f'\r{done}/{count} flights', end='', file=sys.stderr, flush=True)
            yield future.result()
    print(file=sys.stderr)


def main() -> int:
    """Fly, answer, count."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--flights', type=int, default=300)
    parser.add_argument('--first-seed', type=int, default=40_000)
    parser.add_argument('--kind', choices=KINDS, default='mixed', help='one disturbance alone')
    parser.add_argument('--jobs', type=int, default=os.cpu_count() or 1)
    parser.add_argument('--out', type=Path, default=Path('bench/out'), help='folder for rows')
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    verdicts: Counter[str] = Counter()
    with (options.out / f'hard_{options.kind}.jsonl').open('w') as file:
        for row in answers(options.first_seed, options.flights, options.jobs, options.kind):
            verdicts[str(row['verdict'])] += 1
            file.write(json.dumps(row) + '\n')
            file.flush()
            if row['named']:
                print(json.dumps(row))
    print(json.dumps(dict(verdicts)))
    return 0


if __name__ == '__main__':
    sys.exit(main())
