"""Find what the base lacks, on the training segments alone: forward, backward, rivals.

The rule (contract, which data decide): every choice is made by blocked cross-validation on the
training windows; the validation segments are opened in judge.py, once, for what is chosen here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from quad_sysid.effects.candidate import Candidate, candidate, without_effects
from quad_sysid.effects.choice import (
    MOST_EFFECTS,
    backward,
    couples,
    fitted,
    fitting,
    looked_at,
    pairs,
    promising,
    renamed,
    strongest,
)
from quad_sysid.effects.crossval import compare
from quad_sysid.effects.rivals import MOST_RIVALS, Shares, less_named, outdone, settled
from quad_sysid.effects.scan import Dependence, scan
from quad_sysid.effects.screening import Screen
from quad_sysid.effects.worth import worthy
from quad_sysid.greybox.data import AxisData
from quad_sysid.greybox.fit import SHORT_WINDOW_S, Fit, fit_base, informative, settle
from quad_sysid.greybox.noise import NoiseModel
from quad_sysid.greybox.one_step import sharpened
from quad_sysid.greybox.simulate import Simulator
from quad_sysid.greybox.structure import Effect, Prepared, equilibrium

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
    screened: bool = False
    """True: told by its first-order worth alone, never fitted."""
    variant: str = ''


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

    @property
    def trim(self) -> tuple[float, float] | None:
        """Command and rate at which the base rests; None where it says nothing of that."""
        return equilibrium(self.base.theta) if self.informative else None


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
    current = less_named(sim, renamed(sim, current, prepared), prepared, rng)
    current = backward(sim, current)
    if not current.names:
        current, noise = candidate(sim, base), base_noise
    other = _stepped(sim, current)
    if other is not None:
        current, noise, sim = other
        data = sim.data
        base, base_noise, base_sim = settle(replace(sim, _cache={}), without_effects(sim, current))
    rivals: dict[str, Shares] = {}
    for chosen_name in current.names:
        near = _near(chosen_name, tried, current, prepared)
        current, name, shares = settled(sim, current, chosen_name, prepared, near, rng)
        unnamed = _nearer_unnamed(name, tried, prepared)
        better = outdone(sim, current, name, unnamed, rng) if unnamed else current
        if better is not current:
            name = better.names[-1]
            near = _near(name, tried, better, prepared)
            current, name, shares = settled(sim, better, name, prepared, near, rng)
        if name:
            rivals[name] = shares
    chosen = sharpened(sim, current.fit) if current.names else current.fit
    return Discovery(
        data, base, base_noise, base_sim, chosen, noise, sim, rivals, tried, not_tested,
        scan(base_sim, base),
    )


def _forward(
    sim: Simulator, base: Fit, noise: NoiseModel, prepared: Sequence[Prepared],
    progress: Progress,
) -> tuple[Candidate, NoiseModel, Simulator, tuple[Tried, ...]]:
    """Add effects one by one, or two at once, as long as cross-validation asks for one."""
    current = candidate(sim, base)
    tried: list[Tried] = []
    for step in range(1, MOST_EFFECTS + 1):
        puts = [fitting(current, put) for put in prepared if put[0].name not in current.names]
        screen = Screen(sim, current.fit)
        looks = [looked_at(screen, put) for put in puts]
        bar = promising(looks)
        trials: list[Candidate] = []
        for one in looks:
            effect = one.put[0]
            progress(f'{sim.data.axis}: effect {step}, {effect.name}')
            found = fitted(screen, current, one, bar)
            screened = not isinstance(found, Candidate)
            if isinstance(found, Candidate):
                trials.append(found)
            p_value = compare(current.errors, found.errors, sim.windows, sim.data.dt).p_value
            tried.append(
                Tried(step, effect.name, found.score, p_value, screened, effect.variant)
            )
        alone = min((one.score for one in trials), default=current.score)
        twos, count = couples(screen, current, looks, min(alone, current.score))
        good = worthy(current, trials, sim, len(puts)) + worthy(current, twos, sim, count)
        if not good:
            break
        good.sort(key=lambda one: one.score)
        good += pairs(sim, current, good, prepared)
        current, noise, sim = strongest(sim, current, good)
    return current, noise, sim, tuple(tried)


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
    tested = {effect.name for effect, _ in ready}  # in another variant
    return ready, tuple(dict.fromkeys(m for m in missing if m[0] not in tested))


def _near(
    name: str, tried: Sequence[Tried], current: Candidate, prepared: Sequence[Prepared]
) -> set[str]:
    """The names that came nearest in the step in which `name` was chosen.

    A name is contested by names alone: curves that came nearer do not shield it.
    """
    names = _named(prepared)
    step = _step_of(name, tried)
    fitted = [
        t for t in tried
        if t.step == step and not t.screened and (name not in names or t.name in names)
    ]
    near = sorted(fitted, key=lambda t: t.score)[: 1 + MOST_RIVALS]
    return {t.name for t in near} - set(current.names)


def _nearer_unnamed(
    name: str, tried: Sequence[Tried], prepared: Sequence[Prepared]
) -> list[Prepared]:
    """Curves and hidden states that were before a name in the step in which it was chosen."""
    named = _named(prepared)
    if name not in named:
        return []
    step = _step_of(name, tried)
    mine = min(t.score for t in tried if t.name == name and t.step == step)
    nearer = sorted(
        (
            t for t in tried
            if t.step == step and not t.screened and t.score < mine and t.name not in named
        ),
        key=lambda t: t.score,
    )
    wanted = [(t.name, t.variant) for t in nearer[:MOST_RIVALS]]
    return [put for put in prepared if (put[0].name, put[0].variant) in wanted]


def _named(prepared: Sequence[Prepared]) -> set[str]:
    return {effect.name for effect, _ in prepared if effect.kind == 'named'}


def _step_of(name: str, tried: Sequence[Tried]) -> int:
    mine = [t.step for t in tried if t.name == name and not t.screened]
    return max(mine or [t.step for t in tried if t.name == name])
