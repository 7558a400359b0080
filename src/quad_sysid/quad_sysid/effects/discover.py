"""Find what the base lacks, on the training segments alone: forward, backward, rivals.

The rule (contract, which data decide): every choice is made by blocked cross-validation on the
training windows; the validation segments are opened in judge.py, once, for what is chosen here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import stats

from quad_sysid.effects.candidate import (
    Candidate,
    candidate,
    without,
    without_effects,
)
from quad_sysid.effects.crossval import compare, selection_probabilities
from quad_sysid.effects.scan import Dependence, scan
from quad_sysid.effects.shapes import besides
from quad_sysid.greybox.data import AxisData
from quad_sysid.greybox.fit import (
    SHORT_WINDOW_S,
    Fit,
    fit_base,
    fit_with_effect,
    informative,
    settle,
)
from quad_sysid.greybox.noise import NoiseModel
from quad_sysid.greybox.simulate import Simulator
from quad_sysid.greybox.structure import Effect, Prepared

MOST_EFFECTS = 3
CHANCE = 0.01
"""Level of the cross-validated paired test, shared out over the candidates that were tried."""
SMALLEST_GAIN = 0.015
"""An effect that lowers the cross-validated error by less than this share is not worth a name."""
REFINEMENT_GAIN = 0.10
"""A curve on top of a named effect of the same signal must lower the error by this share."""
NAMED_SHARE = 0.8
"""A named effect that explains this share of what a curve explains is taken first."""
HIDDEN_SHARE = 0.9
"""The same for a hidden state, over named effects of any signal."""
FOREMOST = 3
"""So many trials are fitted again with the state correction that suits them."""
MOST_RIVALS = 4
"""So many of the nearest others are fitted in the place of a chosen effect."""
WHOLE_CYCLES = (0.1, 0.2)
"""A delay this near to whole cycles speaks for a realisation, this far against one."""

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
    base_simulator: Simulator
    chosen: Fit
    chosen_noise: NoiseModel
    chosen_simulator: Simulator
    rivals: dict[str, tuple[tuple[str, float], ...]] = field(default_factory=dict)
    """For each chosen effect: (name, probability) of all that could stand in its place."""
    tried: tuple[Tried, ...] = ()
    not_tested: tuple[tuple[str, str], ...] = ()
    dependence: tuple[Dependence, ...] = ()
    """What the base's residual depends on, foremost first."""
    informative: bool = True
    """False: half a second of free run says nothing; the base is fitted over 50 ms instead."""


def discover(
    data: AxisData,
    effects: Sequence[Effect],
    rng: np.random.Generator,
    progress: Progress = lambda _: None,
) -> Discovery:
    """Fit the base on the training segments, add what cross-validation asks for, or nothing."""
    base, base_noise, sim = fit_base(data, data.train)
    if not informative(base):
        base, base_noise, sim = fit_base(data, data.train, SHORT_WINDOW_S)
        return Discovery(data, base, base_noise, sim, base, base_noise, sim, informative=False)
    base_sim = sim
    prepared, not_tested = _prepare(data, effects)
    current, noise, sim, tried = _forward(sim, base, base_noise, prepared, progress)
    current = _backward(sim, current)
    if not current.names:
        current, noise = candidate(sim, base), base_noise
    other = _stepped(sim, current)
    if other is not None:
        current, noise, sim = other
        data = sim.data
        base, base_noise, base_sim = settle(replace(sim, _cache={}), without_effects(sim, current))
    rivals = {
        name: _rivals(sim, current, name, prepared, tried, rng) for name in current.names
    }
    return Discovery(
        data, base, base_noise, base_sim, current.fit, noise, sim, rivals, tried, not_tested,
        scan(base_sim, base),
    )


def _forward(
    sim: Simulator, base: Fit, noise: NoiseModel, prepared: Sequence[Prepared],
    progress: Progress,
) -> tuple[Candidate, NoiseModel, Simulator, tuple[Tried, ...]]:
    """Add effects one by one as long as cross-validation asks for one."""
    current = candidate(sim, base)
    axis, dt = sim.data.axis, sim.data.dt
    tried: list[Tried] = []
    for step in range(1, MOST_EFFECTS + 1):
        trials: list[Candidate] = []
        for effect, settings in prepared:
            if effect.name in current.names:
                continue
            progress(f'{axis}: effect {step}, {effect.name}')
            put = _fitting(current, (effect, settings))
            trial = candidate(sim, fit_with_effect(sim, current.fit, *put))
            trials.append(trial)
            verdict = compare(current.errors, trial.errors, sim.windows, dt)
            tried.append(Tried(step, effect.name, trial.score, verdict.p_value))
        worthy = _worthy(current, trials, sim)
        if not worthy:
            break
        worthy += _pairs(sim, current, worthy, prepared)
        current, noise, sim = _strongest(sim, current, worthy)
    return current, noise, sim, tuple(tried)


def _fitting(current: Candidate, put: Prepared) -> Prepared:
    """A curve that refines named effects of its signal leaves out what they can say."""
    effect, settings = put
    names = tuple(
        e.name for e in current.fit.structure.effects
        if e.kind == 'named' and set(e.signals) & set(effect.signals)
    )
    return besides(effect, settings, names) if effect.kind == 'shape' and names else put


def _stepped(
    sim: Simulator, current: Candidate
) -> tuple[Candidate, NoiseModel, Simulator] | None:
    """The same structure for a far end that integrates in steps, where that speaks for itself.

    The errors hardly differ, but digital controllers delay by whole cycles: the realisation is
    taken under which the delay comes out whole, if it fits no worse.
    """
    data = sim.data
    if data.gyro_filter_hz is None:
        return None
    stepped = Simulator(
        replace(data, realisation='stepped'), sim.spans, sim.windows, sim.correction
    )
    fit, noise, stepped = settle(stepped, current.fit)
    off = [abs(x / data.dt - round(x / data.dt)) for x in (current.fit.theta[2], fit.theta[2])]
    if off[0] < WHOLE_CYCLES[1] or off[1] > WHOLE_CYCLES[0] or fit.rms > 1.005 * current.fit.rms:
        return None
    return candidate(stepped, fit), noise, stepped


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


def _worthy(current: Candidate, trials: Sequence[Candidate], sim: Simulator) -> list[Candidate]:
    """The trials that lower the error beyond chance and by enough, best first."""
    good = [
        trial
        for trial in trials
        if trial.score < (1.0 - _least(current, trial)) * current.score
        and _chance(current, trial, sim) < CHANCE / len(trials)
    ]
    return sorted(good, key=lambda one: one.score)


def _chance(current: Candidate, trial: Candidate, sim: Simulator) -> float:
    """p-value that the last effect of a trial is nothing: by error, or by its one parameter.

    An effect of one parameter that is many cluster-robust standard errors from zero is seen long
    before its share of the error is.
    """
    paired = compare(current.errors, trial.errors, sim.windows, sim.data.dt)
    where = trial.fit.structure.slices()[-1]
    if where.stop - where.start > 1:
        return paired.p_value
    size = abs(float(trial.fit.theta[where][0])) / float(trial.fit.std[where][0])
    freedom = max(paired.blocks - trial.fit.theta.size, 1)
    wald = 2.0 * float(stats.t.sf(size, freedom)) if np.isfinite(size) else 1.0
    return min(1.0, 2.0 * min(paired.p_value, wald))


def _least(current: Candidate, trial: Candidate) -> float:
    """Share of the error that a trial must take away: more where a curve refines a name."""
    signals = {s for e in current.fit.structure.effects for s in e.signals}
    added = trial.fit.structure.effects[-1]
    refines = added.kind == 'shape' and bool(signals & set(added.signals))
    return REFINEMENT_GAIN if refines else SMALLEST_GAIN


def _pairs(
    sim: Simulator, current: Candidate, worthy: Sequence[Candidate], prepared: Sequence[Prepared]
) -> list[Candidate]:
    """Where a curve leads: the pairs of named effects of its signal, which it may stand for."""
    if not worthy or worthy[0].curves == current.curves:
        return []
    signals = set(worthy[0].fit.structure.effects[-1].signals)
    if len(current.names) + 2 > MOST_EFFECTS:
        return []
    named = [
        put for put in prepared
        if put[0].kind == 'named' and set(put[0].signals) == signals
        and put[0].name not in current.names
    ]
    out = []
    for i, first in enumerate(named):
        one = fit_with_effect(sim, current.fit, *first)
        out += [candidate(sim, fit_with_effect(sim, one, *second)) for second in named[i + 1 :]]
    return out


def _strongest(
    sim: Simulator, current: Candidate, worthy: Sequence[Candidate]
) -> tuple[Candidate, NoiseModel, Simulator]:
    """The best of the foremost, each with the state correction that suits it.

    A curve without a name gives way to a named effect of the same signal that explains nearly
    as much; what the name leaves can still be added as a curve in the next step.
    """
    settled = []
    named = sorted((one for one in worthy if not one.curves), key=lambda one: one.score)
    foremost = list(dict.fromkeys([*worthy[:FOREMOST], *named[:FOREMOST]]))
    for one in foremost:
        fit, noise, own = settle(sim, one.fit)
        settled.append((candidate(own, fit), noise, own))
    best = min(settled, key=lambda item: item[0].score)
    if best[0].curves > current.curves:
        gained = current.score**2 - best[0].score**2
        unnamed = best[0].fit.structure.effects[-1]
        hidden = unnamed.kind == 'mode'  # it can mimic what acts through any signal
        share = HIDDEN_SHARE if hidden else NAMED_SHARE
        enough = [
            item for item in settled
            if item[0].curves == current.curves
            and (hidden or set(unnamed.signals) & set(item[0].fit.structure.effects[-1].signals))
            and current.score**2 - item[0].score**2 >= share * gained
        ]
        if enough:
            return min(enough, key=lambda item: item[0].score)
    return best


def _backward(sim: Simulator, current: Candidate) -> Candidate:
    """Take out what the others made superfluous; a name never gives way to a curve."""
    while len(current.names) > 1:
        effects = current.fit.structure.effects
        curves = {signal for e in effects if e.kind != 'named' for signal in e.signals}
        optional = [
            e.name for e in effects if e.kind != 'named' or not curves & set(e.signals)
        ]
        reduced = [without(sim, current, name) for name in optional]
        if not reduced:
            break
        best = min(reduced, key=lambda one: one.score)
        lost = compare(best.errors, current.errors, sim.windows, sim.data.dt)
        if lost.p_value < CHANCE and current.score < (1.0 - SMALLEST_GAIN) * best.score:
            break
        current = best
    return current


def _rivals(
    sim: Simulator, current: Candidate, name: str, prepared: Sequence[Prepared],
    tried: Sequence[Tried], rng: np.random.Generator,
) -> tuple[tuple[str, float], ...]:
    """Probabilities over all that could stand in the place of `name`, itself included.

    Only those that came near when it was chosen are fitted in its place; the others count as
    ruled out.
    """
    own_curve = next(e.kind for e in current.fit.structure.effects if e.name == name) != 'named'
    step = max(t.step for t in tried if t.name == name)
    near = sorted((t for t in tried if t.step == step), key=lambda t: t.score)[: 1 + MOST_RIVALS]
    names = {t.name for t in near} - set(current.names)
    others = [
        _fitting(current, put) for put in prepared
        if put[0].name in names and (own_curve or put[0].kind == 'named')
    ]
    rest = without(sim, current, name)
    one_of = [current, *(candidate(sim, fit_with_effect(sim, rest.fit, *put)) for put in others)]
    weights = selection_probabilities(
        np.stack([one.errors for one in one_of]), sim.windows, sim.data.dt, rng
    )
    summed: dict[str, float] = {}
    for label, weight in zip([name, *(put[0].name for put in others)], weights, strict=True):
        summed[label] = summed.get(label, 0.0) + float(weight)
    return tuple(sorted(summed.items(), key=lambda pair: -pair[1]))
