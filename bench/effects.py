"""Which planted effect is named, how often nothing is, and what it buys: `make bench-effects`.

Flights from the virtual STM32's physics; what was planted is known only to the judge here, after
the answer is there. The last line of the output is one JSON object.

    python bench/effects.py --seeds 3 --nothing 40 --out bench/out
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter, defaultdict
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import effects_scenarios as scenarios
import numpy as np
from effects_undeclared import UNDECLARED
from threadpoolctl import threadpool_limits

from quad_sysid.effects.discover import discover
from quad_sysid.effects.judge import judge
from quad_sysid.effects.shapes import SHAPES
from quad_sysid.effects.table import EFFECTS, by_name
from quad_sysid.greybox.data import axis_data
from quad_sysid.greybox.fit import fit_with_effect, settle, simulator
from quad_sysid.pipeline.assemble import axis_model
from quad_sysid.pipeline.evaluate import evaluate, of_this_flight

WORTH = 1.5
NAMES = (*scenarios.STRENGTHS, 'nothing', *UNDECLARED)


def judged(scenario: scenarios.Scenario) -> dict[str, object]:
    """Answer one scenario, then compare with what was planted."""
    with threadpool_limits(limits=1):
        record = scenarios.flown(scenario, scenarios.PLAN, scenario.seed)
        unseen = scenarios.flown(scenario, scenarios.UNSEEN, scenario.seed + 50_000)
        began = time.perf_counter()
        data = axis_data([record], scenario.axis)
        rng = np.random.default_rng(0)
        found = discover(data, EFFECTS + SHAPES, rng)
        answer = judge(found, rng)
        seconds = time.perf_counter() - began
        model = axis_model(found, answer, {}, None)
        error = evaluate(model, unseen)
        true = _true_structure(scenario, found, unseen)
    return {
        'planted': scenario.name, 'axis': scenario.axis, 'mount': scenario.mount,
        'seed': scenario.seed, 'verdict': answer.verdict,
        'named': [e.name for e in model.effects],
        'probabilities': [e.probability for e in model.effects],
        'before': error.before, 'after': error.after, 'true': true,
        'factor': error.before / true if true else None,
        'depends_on': found.dependence[0].name if found.dependence else '',
        'seconds': seconds,
    }


def _true_structure(scenario, found, unseen) -> float | None:
    """Error on the unseen flight of the true structure refitted, where it stands in the table."""
    if scenario.name not in scenarios.STRENGTHS:
        return None
    effect = by_name(scenario.name)
    if scenario.name == 'step_event':
        effect = next(e for e in EFFECTS if e.name == 'step_event' and e.variant == 'torque')
    settings = effect.prepare(found.data) if effect.prepare else {}
    if isinstance(settings, str):
        return None
    fit = fit_with_effect(found.base_simulator, found.base, effect, settings)
    fit, noise, _ = settle(found.base_simulator, fit)
    data = axis_data([unseen], scenario.axis)
    sim = simulator(data, data.validation, noise.correction)
    theta = of_this_flight(sim, fit.structure, fit.theta)
    return sim.run(fit.structure, theta).rms


def drawn(options: argparse.Namespace) -> list[scenarios.Scenario]:
    """All scenarios of the run, from fixed seeds."""
    rng = np.random.default_rng(options.first_seed)
    places = [(a, m) for m in ('rig', 'hover') for a in ('roll', 'pitch')]
    out = []
    for name in scenarios.STRENGTHS:
        for k in range(options.seeds):
            axis, mount = places[k % len(places)]
            out.append(scenarios.named(rng, name, options.first_seed + k, axis, mount))
    places += [('yaw', 'rig'), ('yaw', 'hover')]
    for k in range(options.nothing):
        axis, mount = places[k % len(places)]
        out.append(scenarios.nothing(rng, options.first_seed + 1000 + k, axis, mount))
    for name, factory in UNDECLARED.items():
        for k in range(options.undeclared):
            size = float(np.exp(rng.uniform(np.log(0.002), np.log(0.008))))
            out.append(
                scenarios.Scenario(
                    name, 'roll', 'rig', options.first_seed + 2000 + k, {},
                    factory(0, size, k),
                )
            )
    return out


def summary(rows: list[dict[str, object]]) -> dict[str, object]:
    """The figures of the table, over scenarios whose true structure is worth WORTH or more."""
    known = [r for r in rows if r['planted'] in scenarios.STRENGTHS]
    worth = [r for r in known if r['factor'] and r['factor'] >= WORTH]
    right = [r for r in worth if r['planted'] in r['named']]
    extra = [r for r in worth if len(r['named']) > 1]
    none = [r for r in rows if r['planted'] == 'nothing']
    odd = [r for r in rows if r['planted'] in UNDECLARED]
    gaps = [
        (r['before'] - r['after']) / (r['before'] - r['true'])
        for r in worth if r['before'] > r['true']
    ]
    return {
        'worth': len(worth), 'right_name': len(right), 'extra_name': len(extra),
        'gap_closed_median': float(np.median(gaps)) if gaps else None,
        'nothing': len(none),
        'false_effects': sum(r['verdict'] == 'effects_added' for r in none),
        'false_unexplained': sum(r['verdict'] == 'unexplained_residual' for r in none),
        'undeclared': len(odd),
        'undeclared_silent': sum(r['verdict'] == 'no_missing_effect' for r in odd),
        'undeclared_lowered_median': float(
            np.median([1 - r['after'] / r['before'] for r in odd])
        ) if odd else None,
        'seconds_median': float(np.median([r['seconds'] for r in rows])),
    }


def matrix(rows: list[dict[str, object]]) -> str:
    """Planted against named, as text."""
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    for r in rows:
        counts[str(r['planted'])][' + '.join(r['named']) or str(r['verdict'])] += 1
    lines = []
    for name in NAMES:
        for answer, count in counts[name].most_common():
            lines.append(f'{name:<22} {count:>4}  {answer}')
    return '\n'.join(lines)


def main() -> int:
    """Run all scenarios and print matrix and figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--seeds', type=int, default=4, help='flights per named effect')
    parser.add_argument('--nothing', type=int, default=36, help='flights with nothing missing')
    parser.add_argument('--undeclared', type=int, default=3, help='flights per unnamed effect')
    parser.add_argument('--first-seed', type=int, default=100)
    parser.add_argument('--jobs', type=int, default=2)
    parser.add_argument('--out', type=Path, default=None, help='folder for rows as JSON lines')
    options = parser.parse_args()
    todo = drawn(options)
    rows = []
    began = time.monotonic()
    if options.jobs > 1 and not options.undeclared:
        with ProcessPoolExecutor(options.jobs) as pool:
            results = pool.map(judged, todo)
            rows = _collect(results, len(todo), began)
    else:
        rows = _collect(map(judged, todo), len(todo), began)
    if options.out:
        options.out.mkdir(parents=True, exist_ok=True)
        text = '\n'.join(json.dumps(row) for row in rows) + '\n'
        (options.out / 'effects.jsonl').write_text(text)
    print(matrix(rows))
    print(json.dumps(summary(rows)))
    return 0


def _collect(results, total: int, began: float) -> list[dict[str, object]]:
    rows = []
    for row in results:
        rows.append(row)
        left = (time.monotonic() - began) / len(rows) * (total - len(rows))
        print(
            f'{len(rows)}/{total} {row["planted"]}: {row["verdict"]} {row["named"]} '
            f'({left:.0f} s left)', file=sys.stderr, flush=True,
        )
    return rows


if __name__ == '__main__':
    sys.exit(main())
