"""Does the watch over new gains cry wolf, and does it catch gains that deserve it?

    python bench/watch.py [--count 100] [--models DIR] [--gains FILE]

Good updates: the airframes of bench/tuning.py with the gains that are designed for them, sent in
flight in the designer's steps, under gusts (a third of them begin with the update), noise, stick
movements and, for some, an excitation in the watch. Bad ones: gains forced past any design. Both
also as `first` flights: the gains take off, and no flight before says how the aircraft moves. An
alarm brings the old gains back 60 ms later. The last line is one JSON object; exit status 1 where
a good update was taken back or a bad one oscillated beyond 20 degrees.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from tuning_airframes import Airframe, draw, first_flight, identified, profile_of

from quad_bridge.gains.table import AXES
from quad_bridge.gains.watch import GainWatch
from quad_bridge.virtual.aircraft import Aircraft
from quad_bridge.virtual.cycle import COLUMNS
from quad_bridge.virtual.profile import Profile
from quad_bridge.virtual.receiver import Event, Receiver
from quad_bridge.virtual.simulation import Excited, inputs
from quad_sysid.report.model_file import load_models
from quad_tuning.designer import design

RATE_HZ = 250.0
UPDATE_S, STEP_S, WATCH_S = 12.0, 3.0, 10.0
REACTION_CYCLES = 15
LARGEST_DEG = 20.0
RESTLESS_RAD_S = 0.5
EXCITATIONS = {'attitude': 0.2, 'rate': 0.5, 'control': 0.015}
BAD = ('rate.kp', 'angle.kp', 'rate.kd')


class Gusts:
    """Torque in the air: coloured noise and four steps, in units of the inertia (rad/s^2)."""

    def __init__(self, rng: np.random.Generator, inertia: Sequence[float], begin_s: float) -> None:
        self._rng, self._begin_s = rng, begin_s
        self._scale = rng.uniform(0.3, 2.0) * np.array(inertia) * (1.0, 1.0, 0.3)
        self._state = np.zeros(3)
        self._steps = [
            (rng.uniform(3.0, 25.0), rng.uniform(0.3, 2.0), 2.0 * rng.normal(size=3))
            for _ in range(4)
        ]

    def __call__(self, t_s: float, *_: object) -> np.ndarray:
        dt, memory_s = 0.001, 0.5
        noise = self._rng.normal(size=3) * np.sqrt(2.0 * dt / memory_s)
        self._state = self._state * (1.0 - dt / memory_s) + noise
        total = self._state + sum(
            (push for at, long, push in self._steps if at < t_s < at + long), np.zeros(3)
        )
        return self._scale * total * (t_s >= self._begin_s)


@dataclass(frozen=True)
class Watched:
    """The watch's reaction to one update."""

    alarm: str | None
    after_s: float
    peak_deg: float
    """Largest angle away from the reference, roll or pitch, after the update."""
    restless: bool
    """Still oscillating at the end."""


def fly(
    profile: Profile, seed: int, before: Mapping[str, float], steps: Sequence[Mapping[str, float]],
    gusts: Gusts | None = None, schedule: Sequence[Excited] = (), update_s: float = UPDATE_S,
) -> Watched:  # fmt: skip
    """Update in flight, or before it, watched as the bridge does."""
    aircraft, watch = Aircraft(profile, seed=seed, effect=gusts), GainWatch(RATE_HZ)
    aircraft.set_gains(before)
    marks = {round((update_s + STEP_S * k) * RATE_HZ): dict(s) for k, s in enumerate(steps)}
    count = max(marks) + round(WATCH_S * RATE_HZ)
    given = inputs(aircraft, schedule, count)
    alarm, back, peak, rest, after = None, None, 0.0, [], float('nan')
    for k in range(count):
        if k in marks and alarm is None:
            aircraft.set_gains(marks[k])
            if k == min(marks):
                watch.begin(axes={name.partition('.')[0] for name in marks[k]})
        if k == back:
            aircraft.set_gains(before)
        row = aircraft.run(given[k : k + 1])[0]
        reference, angles = row[COLUMNS['attitude_setpoint']], row[COLUMNS['angles']]
        added, injection = given[k, 2:5], given[k, 1]
        kp = np.array([aircraft.gains[f'{axis}.rate.kp'] for axis in AXES])
        inside = {2: added, 3: added / kp}.get(int(injection), np.zeros(3))
        watch.step(row[COLUMNS['rates']], angles, reference, inside)
        if k < min(marks):
            continue
        if alarm is None and (alarm := watch.alarm()) is not None:
            after, back = (k - min(marks)) / RATE_HZ, k + REACTION_CYCLES
            watch.end()
        if not given[k, 5:7].any() and not injection:
            away = np.abs(row[COLUMNS['true_angles']] - reference)[:2]
            peak = max(peak, float(np.degrees(away.max())))
        if k > count - 500:
            rest.append(float(np.sum(row[COLUMNS['true_rates']] ** 2)))
    return Watched(alarm, after, peak, bool(np.sqrt(np.mean(rest)) > RESTLESS_RAD_S))


def sticks(rng: np.random.Generator, airframe: Airframe, seconds: float) -> tuple[Event, ...]:
    """A pilot who moves about."""
    axes = ('roll', 'pitch', 'yaw') if airframe.mount == 'hover' else (airframe.axis,)
    events, at = [], 1.0
    while at < seconds:
        axis = str(rng.choice(axes))
        events.append(Event(at, axis, float(rng.uniform(-0.6, 0.6))))
        at += float(rng.uniform(0.2, 1.5))
        if rng.random() < 0.5:
            events.append(Event(at, axis, 0.0))
            at += float(rng.uniform(0.2, 2.0))
    return tuple(events)


def good(
    airframe: Airframe, steps: Sequence[Mapping[str, float]], update_s: float = UPDATE_S
) -> Watched:
    """An update as it should be, under all that flying brings."""
    rng = np.random.default_rng([airframe.seed, 3])
    profile = profile_of(airframe, later=True)
    begin_s = update_s if rng.random() < 0.3 else 0.0
    gusts = Gusts(rng, profile.airframe.inertia_kg_m2, begin_s)
    end_s = update_s + STEP_S * len(steps) + WATCH_S
    if rng.random() < 0.8:
        profile = replace(profile, receiver=Receiver(sticks(rng, airframe, end_s)))
    schedule = []
    if rng.random() < 0.4:
        kind = str(rng.choice(list(EXCITATIONS)))
        signal = np.repeat(rng.choice([-1.0, 1.0], 97), 23) * EXCITATIONS[kind]
        at = update_s + STEP_S * (len(steps) - 1) + 0.5
        schedule = [Excited(at, signal, airframe.axis, kind)]
    return fly(profile, airframe.seed, {}, steps, gusts, schedule, update_s)


def bad(
    airframe: Airframe, steps: Sequence[Mapping[str, float]], update_s: float = UPDATE_S
) -> Watched:
    """The designed gains, then one of them several times too large at once."""
    rng = np.random.default_rng([airframe.seed, 4])
    name = f'{airframe.axis}.{BAD[airframe.number % 3]}'
    last = dict(steps[-1])
    last[name] = last.get(name, 1e-3) * float(rng.uniform(3.0, 8.0))
    profile = profile_of(airframe, later=True)
    return fly(profile, airframe.seed, {**steps[-1]}, [last], update_s=update_s)


def designed(airframe: Airframe, models: Path | None) -> list[dict[str, float]]:
    """The designer's steps, none where it refuses."""
    path = None if models is None else models / f'{airframe.number:03d}.json'
    if path is not None and path.exists():
        model = load_models(path)[airframe.axis]
    else:
        model = identified(first_flight(airframe), airframe.axis)
    if isinstance(model, str):
        return []
    return [dict(step) for step in design(model).steps]


def summed(name: str, fine: Sequence[Watched], forced: Sequence[Watched]) -> dict[str, float]:
    """The figures of good and forced sets."""
    missed = [w for w in forced if w.peak_deg > LARGEST_DEG or (w.restless and w.alarm is None)]
    figures: dict[str, float] = {
        'good_updates': len(fine),
        'good_taken_back': sum(w.alarm is not None for w in fine),
        'forced_sets': len(forced),
        'forced_taken_back': sum(w.alarm is not None for w in forced),
        'forced_missed': len(missed),
        'largest_deg': round(max(w.peak_deg for w in forced), 1),
    }
    return {f'{name}{key}': value for key, value in figures.items()}


def main() -> int:
    """Print a line per airframe and the figures as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--count', type=int, default=100)
    parser.add_argument('--seed', type=int, default=1000)
    parser.add_argument('--models', type=Path, help='take identified models from there')
    parser.add_argument('--gains', type=Path, help='keep designed gains there, and use them')
    given = parser.parse_args()
    kept = json.loads(given.gains.read_text()) if given.gains and given.gains.exists() else {}
    fine, forced = list[Watched](), list[Watched]()
    first, first_forced = list[Watched](), list[Watched]()
    for airframe in draw(given.count, given.seed):
        key = str(airframe.number)
        if key not in kept:
            kept[key] = designed(airframe, given.models)
            if given.gains:
                given.gains.write_text(json.dumps(kept))
        if not kept[key]:
            continue
        fine.append(good(airframe, kept[key]))
        forced.append(bad(airframe, kept[key]))
        first.append(good(airframe, kept[key], 0.0))
        first_forced.append(bad(airframe, kept[key], 0.0))
        print(f'{airframe.number:3d} {airframe.axis:5} {airframe.mount:5} {airframe.effect:20} '
              f'good: {fine[-1].alarm or "confirmed"}; bad: {forced[-1].alarm or "confirmed"} '
              f'({forced[-1].peak_deg:.1f} deg); first: {first[-1].alarm or "confirmed"}; bad: '
              f'{first_forced[-1].alarm or "confirmed"} ({first_forced[-1].peak_deg:.1f} deg)',
              flush=True)  # fmt: skip
    figures = {**summed('', fine, forced), **summed('first_', first, first_forced)}
    print(json.dumps(figures))
    wrong = ('good_taken_back', 'forced_missed', 'first_good_taken_back', 'first_forced_missed')
    return int(any(figures[name] for name in wrong))


if __name__ == '__main__':
    sys.exit(main())
