"""Effects that people outside the project wrote: is half of what the truth gains found?

156 effects in 52 families, from textbooks, by thirteen writers who knew neither the code nor its
candidates, flown by a simulator of its own (outside_simulator.py) at two strengths and two
levels of noise. The gap is that between the base's error on a second flight and what the true
equations foresee of that flight from its commands alone, scaled by what the base reaches beside
them where the effect is off. Where the truth gains less than a factor of 1.5 there is little to
find, and a flight does not count.

    python bench/outside.py --noise 0.3 --only cables --out bench/out
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import outside_arms_loads_supply_blades as fifth
import outside_bearings_motors_air_sensors as first
import outside_cables_frames_loads_power as second
import outside_chains_stands_wakes_mixers as eleventh
import outside_gears_windings_cushions_mounts as eighth
import outside_governors_grips_inflow_filters as twelfth
import outside_greases_stators_discs_observers as tenth
import outside_hinges_controllers_wake_sensing as fourth
import outside_hoses_frames_power_schedules as seventh
import outside_joints_escs_rotors_estimators as sixth
import outside_rigs_air_software_blades as third
import outside_simulator as simulator
import outside_slings_dampers_connectors_schedules as thirteenth
import outside_slings_fasteners_packs_drivers as ninth
from effects_answer import searched
from effects_judge import SPOILED, UNNAMED, WORTH
from threadpoolctl import threadpool_limits

from quad_sysid.contract import control_from_motors
from quad_sysid.effects import EFFECTS
from quad_sysid.pipeline.assemble import axis_model
from quad_sysid.pipeline.evaluate import evaluate
from quad_sysid.record import GainChange, Record, Segment

SETS = {'bearings': first, 'cables': second, 'rigs': third, 'hinges': fourth, 'arms': fifth,
        'joints': sixth, 'hoses': seventh, 'gears': eighth, 'slings': ninth,
        'greases': tenth, 'chains': eleventh, 'governors': twelfth,
        'umbilicals': thirteenth}
STRENGTHS = (0.7, 1.3)
MAY_BE = {name: names for one in SETS.values() for name, names in one.MAY_BE.items()}
"""Effect → names of the table that are no lie."""


@dataclass(frozen=True)
class Case:
    """One effect at one strength: two flights, one to learn from and one to be judged by."""

    effect: str
    family: str
    strength: float
    seed: int
    axis: int
    noise: float

    def flown(self, *, unseen: bool, there: bool = True) -> simulator.Flown:
        """A flight; with `there` false by the same aircraft without the effect."""
        make, rig = _effects()[self.effect]
        return simulator.fly(
            make(self.strength) if there else simulator.Nothing(),
            self.seed + 500 * unseen, axis=self.axis, rig=rig, noise=self.noise,
            plan=simulator.UNSEEN if unseen else simulator.TRAINING,
        )


@lru_cache
def _effects() -> dict[str, Any]:
    return {name: entry for module in SETS.values() for name, entry in module.EFFECTS.items()}


def cases(only: str, noise: float) -> list[Case]:
    """All cases of a set, or of all."""
    return [
        Case(name, family, strength, 100 + 10 * i + j, (i + j) % 2, noise)
        for key, module in SETS.items() if only in ('', key)
        for i, (name, family) in enumerate(
            (name, family) for family, names in module.FAMILIES.items() for name in names
        )
        for j, strength in enumerate(STRENGTHS)
    ]


def record_of(flown: simulator.Flown, axis: str) -> Record:
    """The flight as the analysis gets it."""
    return Record(
        source='outside', dt=simulator.DT, t0_ns=10**18, rates=flown.rates, angles=flown.angles,
        control=control_from_motors(flown.motors), motors=flown.motors,
        battery_v=flown.battery_v, attitude_setpoint=flown.reference,
        segments=tuple(Segment(role, signal, axis, 'attitude', begin, end)
                       for role, signal, begin, end in flown.segments),
        gains=(GainChange(0.0, {'sensor.gyro_filter_hz': simulator.FILTER_HZ}),),
    )


def answered(case: Case) -> dict[str, Any]:
    """The answer to one case, beside the truth."""
    axis = simulator.AXES[case.axis]
    unseen, off = case.flown(unseen=True), case.flown(unseen=True, there=False)
    with threadpool_limits(limits=1):
        found = searched(record_of(case.flown(unseen=False), axis), axis, EFFECTS)
        model = axis_model(found, {}, None)
        error = evaluate(model, record_of(unseen, axis))
        learnt = record_of(case.flown(unseen=False, there=False), axis)
        plain = axis_model(searched(learnt, axis, ()), {}, None)
        floor = evaluate(plain, record_of(off, axis)).before
    beside = floor / simulator.foreseen(off, case.axis)
    true = simulator.foreseen(unseen, case.axis) * beside
    wrong = [
        e.name for e in model.effects
        if e.probability > 0.5 and not e.name.startswith(UNNAMED)
        and e.name not in MAY_BE.get(case.effect, ())
    ]
    return {
        **vars(case), 'verdict': found.verdict.verdict, 'wrong': wrong,
        'effects': [[e.name, e.variant, e.probability] for e in model.effects],
        'before': error.before, 'after': error.after, 'true': true,
        'gap': (error.before - error.after) / (error.before - true),
        'counts': error.before >= WORTH * true,
    }


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, int]:
    """The figures of the table in docs/results.md."""
    counted = [row for row in rows if row['counts']]
    return {
        'flights': len(rows), 'counted': len(counted),
        'half_of_the_gap': sum(row['gap'] >= 0.5 for row in counted),
        'silent': sum(row['verdict'] == 'no_missing_effect' for row in counted),
        'wrong_names': sum(bool(row['wrong']) for row in counted),
        'made_worse': sum(row['after'] > SPOILED * row['before'] for row in rows),
    }


def main() -> int:
    """Fly, answer, compare."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--only', choices=('', *SETS), default='', help='one of the sets')
    parser.add_argument('--noise', type=float, default=1.0, help='of gyro and gusts, a factor')
    parser.add_argument('--jobs', type=int, default=os.cpu_count() or 1)
    parser.add_argument('--out', type=Path, default=Path('bench/out'), help='folder for rows')
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    rows = []
    with ProcessPoolExecutor(options.jobs, mp_context=get_context('spawn')) as pool:
        waiting = [pool.submit(answered, case) for case in cases(options.only, options.noise)]
        for future in as_completed(waiting):
            row = future.result()
            rows.append(row)
            said = ', '.join(f'{name} {variant} {p:.2f}' for name, variant, p in row['effects'])
            errors = ' '.join(f'{1e3 * row[key]:6.1f}' for key in ('before', 'after', 'true'))
            print(f'{row["effect"]:34} {row["strength"]} {errors} {100 * row["gap"]:5.0f} % '
                  f'{"" if row["counts"] else "does not count "}{row["verdict"]} {said}',
                  flush=True)
    path = options.out / f'outside_{options.only or "all"}_{options.noise:g}.jsonl'
    path.write_text(''.join(json.dumps(row) + '\n' for row in rows))
    print(json.dumps(summary(rows)))
    return 0


if __name__ == '__main__':
    sys.exit(main())
