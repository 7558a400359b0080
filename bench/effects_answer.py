"""One flight of bench/effects.py, answered by the analysis, then measured against the truth."""

from __future__ import annotations

import json
import math
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import effects_scenarios as scenarios
from threadpoolctl import threadpool_limits
from virtual_flights import record_of

from quad_bridge.virtual.profile import load_profile
from quad_sysid.bags import write_bag
from quad_sysid.discover.accept import Unseen, rms
from quad_sysid.discover.search import Scored, search
from quad_sysid.effects import EFFECTS
from quad_sysid.estimate.fit import Fit, Problem
from quad_sysid.estimate.stored import Stored
from quad_sysid.model import AxisModel
from quad_sysid.model.data import axis_data
from quad_sysid.model.effect import Effect
from quad_sysid.pipeline.answer import Findings
from quad_sysid.pipeline.assemble import axis_model
from quad_sysid.pipeline.evaluate import evaluate, of_this_flight
from quad_sysid.pipeline.identify import Options, findings_of
from quad_sysid.record import Record

Row = dict[str, Any]


def answered(scenario: scenarios.Scenario) -> Row:
    """The analysis' answer to one flight, and how near it came on a flight it has not seen."""
    with threadpool_limits(limits=1):
        record = scenarios.flown(scenario, unseen=False)
        began = time.perf_counter()
        found = searched(record, scenario.axis, EFFECTS)
        model = axis_model(found, {}, None)
        seconds = time.perf_counter() - began
        unseen = scenarios.flown(scenario, unseen=True)
        error = evaluate(model, unseen)
        # where nothing is missing the base is the true structure
        true = error.before if scenario.kind == 'nothing' else true_error(scenario, found, unseen)
    return {
        'number': scenario.number, 'verdict': found.verdict.verdict,
        'named': [e.name for e in model.effects],
        'probabilities': [e.probability for e in model.effects],
        'rivals': [
            [[e.name, e.probability], *[[n, p] for n, p in e.rivals]] for e in model.effects
        ],
        'parameters': {
            e.name: {p.name: [p.value, p.std] for p in e.parameters} for e in model.effects
        },
        'covered': covered(scenario, model),
        'before': error.before, 'after': error.after, 'true': true,
        'factor': error.before / true, 'lost': error.before / true,
        'reference': error.reference, 'seconds': seconds,
        'rungs': [[part.effect.name for part in rung.model.structure.parts]
                  for rung in found.ladder.rungs],
    }


def searched(record: Record, axis: str, effects: Sequence[Effect]) -> Findings:
    """Search and verdict on one axis of a record."""
    return findings_of(axis_data([record], axis), Options(effects=tuple(effects)))


def answered_by_command(scenario: scenarios.Scenario, folder: Path) -> Row:
    """The answer by a bag and the commands `identify` and `evaluate`, as a user gets it."""
    folder.mkdir(parents=True, exist_ok=True)
    bags = [folder / 'flight', folder / 'unseen']
    for bag, unseen in zip(bags, (False, True), strict=True):
        seed = scenario.seed + (500_000 if unseen else 0)
        flight = scenarios.flight_of(scenario, seed, unseen=unseen)
        write_bag(record_of(flight), bag)
    began = time.perf_counter()
    _run('identify', str(bags[0]), '--axis', scenario.axis, '--out', str(folder / 'out'))
    seconds = time.perf_counter() - began
    found = json.loads((folder / 'out' / 'report.json').read_text())['axes'][scenario.axis]
    said = _run('evaluate', str(folder / 'out' / 'model.json'), str(bags[1]), '--json')
    error = json.loads(said)['axes'][scenario.axis]['error']
    return {
        'number': scenario.number, 'verdict': found['verdict'],
        'named': [e['name'] for e in found['effects']],
        'before': error['before'], 'after': error['after'], 'seconds': seconds,
    }


def _run(*arguments: str) -> str:
    """Output of quad-sysid; raises where it fails."""
    command = [sys.executable, '-m', 'quad_sysid.cli', *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode not in (0, 3):
        raise RuntimeError(f'{" ".join(command)}: exit {done.returncode}: {done.stderr}')
    return done.stdout


def true_error(scenario: scenarios.Scenario, found: Findings, unseen: Record) -> float:
    """Error on the unseen flight of the true structure, refitted; floor where it has no name."""
    if scenario.kind == 'undeclared':
        return _floor(scenario)
    fitted = _true_structure(found.problem, set(scenario.planted))
    data = axis_data([unseen], scenario.axis)
    held = Unseen(data, data.validation)
    stored = Stored(fitted.structure, fitted.theta, fitted.tail)
    return rms(held.errors(of_this_flight(held, stored)))


def _true_structure(problem: Problem, planted: set[str]) -> Fit:
    """The most probable of the structures that hold most of what was planted, in any variant."""
    tried = search(problem, [e for e in EFFECTS if e.name in planted]).all

    def held(one: Scored) -> tuple[int, float]:
        names = {part.effect.name for part in one.fit.structure.parts}
        return len(names & planted), one.score

    return max(tried, key=held).fit


def _floor(scenario: scenarios.Scenario) -> float:
    """What the base reaches where nothing is missing: flown by the same aircraft without it."""
    plain = scenarios.without(scenario)
    found = searched(scenarios.flown(plain, unseen=False), scenario.axis, ())
    return evaluate(axis_model(found, {}, None), scenarios.flown(plain, unseen=True)).before


def covered(scenario: scenarios.Scenario, model: AxisModel) -> dict[str, bool]:
    """Whether the 95 % interval of each planted effect's parameters holds the truth."""
    out = {}
    for effect in model.effects:
        truth = truth_of(scenario, effect.name)
        for parameter in effect.parameters:
            if parameter.name in truth and parameter.std:
                off = abs(abs(parameter.value) - truth[parameter.name])
                out[f'{effect.name}.{parameter.name}'] = bool(off <= 1.96 * parameter.std)
    return out


def truth_of(scenario: scenarios.Scenario, name: str) -> dict[str, float]:
    """The planted parameters in the report's units, without their sign."""
    if name not in scenario.effects:
        return {}
    set_to = scenario.effects[name]
    if scenario.simulator == 'plain':
        keys = {'coulomb_friction': 'torque', 'quadratic_drag': 'coefficient',
                'dead_zone': 'half_width'}
        return {keys.get(name, 'stiffness'): float(set_to['strength'])}
    index = scenarios.AXES.index(scenario.axis)
    airframe = load_profile('plain').airframe
    inertia = airframe.inertia_kg_m2[index]
    value = float(set_to[scenarios.STRENGTHS[name][0]])
    per_inertia = {
        'coulomb_friction': 'torque', 'quadratic_drag': 'coefficient',
        'pendulum_stiffness': 'stiffness', 'cubic_stiffness': 'stiffness',
        'step_event': 'torque', 'gyroscopic_coupling': 'coefficient',
        'periodic_disturbance': 'amplitude',
    }
    out = {per_inertia[name]: value / inertia} if name in per_inertia else {}
    direct = {
        'dead_zone': 'half_width', 'backlash': 'half_width', 'saturation': 'upper',
        'motor_lag': 'slow_time_constant', 'battery_sag': 'exponent',
        'thrust_curve': 'curvature', 'cross_axis_input': 'fraction',
    }
    if name in direct:
        out[direct[name]] = value
    if 'frequency_hz' in set_to:
        out['frequency'] = float(set_to['frequency_hz'])
    if 'time_s' in set_to:
        out['time'] = float(set_to['time_s'])
    return {key: v for key, v in out.items() if math.isfinite(v)}
