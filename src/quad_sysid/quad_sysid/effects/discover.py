"""Find what the base lacks, on the training segments alone: forward, backward, rivals.

The rule (contract, which data decide): every choice is made by blocked cross-validation on the
training windows; the validation segments are opened in judge.py, once, for what is chosen here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from quad_sysid.effects.candidate import (
    Candidate,
    Prepared,
    candidate,
    exchanged,
    refitted,
    without,
)
from quad_sysid.effects.crossval import compare, selection_probabilities
from quad_sysid.greybox import drive
from quad_sysid.greybox.data import AxisData
from quad_sysid.greybox.fit import Fit, fit_base, fit_with_effect, settle
from quad_sysid.greybox.noise import NoiseModel
from quad_sysid.greybox.simulate import Simulator
from quad_sysid.greybox.structure import Effect

MOST_EFFECTS = 3
CHANCE = 0.01
"""Level of the cross-validated paired test, shared out over the candidates that were tried."""
SMALLEST_GAIN = 0.015
"""An effect that lowers the cross-validated error by less than this share is not worth a name."""
CURVE_MARGIN = 0.02
"""A curve without a name must beat every named effect by this share of the error."""

Progress = Callable[[str], None]


@dataclass(frozen=True)
class Tried:
    """What cross-validation said of adding one effect at one step."""

    step: int
    name: str
    score: float
    p_value: float


@dataclass(frozen=True)
class Discovery:
    """What the training data chose."""

    data: AxisData
    base: Fit
    base_noise: NoiseModel
    chosen: Fit
    chosen_noise: NoiseModel
    chosen_simulator: Simulator
    rivals: dict[str, tuple[tuple[str, float], ...]] = field(default_factory=dict)
    """For each chosen effect: (name, probability) of all that could stand in its place."""
    tried: tuple[Tried, ...] = ()
    not_tested: tuple[tuple[str, str], ...] = ()


def discover(
    data: AxisData,
    effects: Sequence[Effect],
    rng: np.random.Generator,
    progress: Progress = lambda _: None,
) -> Discovery:
    """Fit the base on the training segments, add what cross-validation asks for, or nothing."""
    data, base, base_noise, sim = best_base(data)
    prepared, not_tested = _prepare(data, effects)
    current = candidate(sim, base)
    noise = base_noise
    tried: list[Tried] = []
    for step in range(1, MOST_EFFECTS + 1):
        trials: list[Candidate] = []
        for effect, settings in prepared:
            if effect.name in current.names:
                continue
            progress(f'{data.axis}: effect {step}, {effect.name}')
            trial = candidate(sim, fit_with_effect(sim, current.fit, effect, settings))
            trials.append(trial)
            verdict = compare(current.errors, trial.errors, sim.windows, data.dt)
            tried.append(Tried(step, effect.name, trial.score, verdict.p_value))
        best = _best(current, trials, sim)
        if best is None:
            break
        fit, noise, sim = settle(sim, best.fit)
        current = candidate(sim, fit)
        current = _strongest(sim, current, trials)
    current = _backward(sim, current)
    if not current.names:
        return Discovery(data, base, base_noise, base, base_noise, sim, {}, tuple(tried),
                         not_tested)
    rivals = {
        name: _rivals(sim, current, name, prepared, rng) for name in current.names
    }
    return Discovery(data, base, base_noise, current.fit, noise, sim, rivals, tuple(tried),
                     not_tested)


def best_base(data: AxisData) -> tuple[AxisData, Fit, NoiseModel, Simulator]:
    """The base in the realisation of the far end's integration that the training data prefer."""
    found = []
    for realisation in drive.REALISATIONS if data.gyro_filter_hz else ('continuous',):
        kind = replace(data, realisation=realisation)
        found.append((kind, *fit_base(kind, kind.train)))
    return min(found, key=lambda item: item[1].rms)


def _prepare(
    data: AxisData, effects: Sequence[Effect]
) -> tuple[list[Prepared], tuple[tuple[str, str], ...]]:
    """Effects with their settings, and what cannot be tested with why."""
    ready: list[Prepared] = []
    missing: list[tuple[str, str]] = []
    for effect in effects:
        settings = effect.prepare(data) if effect.prepare else {}
        if isinstance(settings, str):
            missing.append((effect.name, settings))
        else:
            ready.append((effect, settings))
    return ready, tuple(missing)


def _best(current: Candidate, trials: Sequence[Candidate], sim: Simulator) -> Candidate | None:
    """The trial to add: significant beyond the number tried, and worth its name."""
    good = [
        trial
        for trial in trials
        if trial.score < (1.0 - SMALLEST_GAIN) * current.score
        and compare(current.errors, trial.errors, sim.windows, sim.data.dt).p_value
        < CHANCE / len(trials)
    ]
    return min(good, key=_rank) if good else None


def _rank(one: Candidate) -> float:
    """Score, with the margin that a curve without a name has to overcome."""
    return one.score * (1.0 + CURVE_MARGIN * one.curves)


def _strongest(sim: Simulator, current: Candidate, trials: Sequence[Candidate]) -> Candidate:
    """With the sharper state correction, look again whether a close rival is the better one."""
    near = sorted(trials, key=_rank)[:4]
    return min([current, *(refitted(sim, trial) for trial in near)], key=_rank)


def _backward(sim: Simulator, current: Candidate) -> Candidate:
    """Take out what the others made superfluous."""
    while len(current.names) > 1:
        reduced = [without(sim, current, name) for name in current.names]
        best = min(reduced, key=_rank)
        lost = compare(best.errors, current.errors, sim.windows, sim.data.dt)
        if lost.p_value < CHANCE and current.score < (1.0 - SMALLEST_GAIN) * best.score:
            break
        current = best
    return current


def _rivals(
    sim: Simulator, current: Candidate, name: str, prepared: Sequence[Prepared],
    rng: np.random.Generator,
) -> tuple[tuple[str, float], ...]:
    """Probabilities over all that could stand in the place of `name`, itself included."""
    own_curve = next(e.kind for e in current.fit.structure.effects if e.name == name) == 'shape'
    others = [
        put for put in prepared
        if put[0].name not in current.names and (own_curve or put[0].kind != 'shape')
    ]
    field_ = [current, *(exchanged(sim, current, name, put) for put in others)]
    weights = selection_probabilities(
        np.stack([one.errors for one in field_]), sim.windows, sim.data.dt, rng
    )
    names = [name, *(put[0].name for put in others)]
    pairs = sorted(zip(names, weights.tolist(), strict=True), key=lambda pair: -pair[1])
    return tuple(pairs)
