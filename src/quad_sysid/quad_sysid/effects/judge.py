"""Open the validation segments, once: the paired test, the error figures, the verdict.

Everything here takes a finished Discovery; nothing chosen before is chosen again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.effects.consistency import inconsistency
from quad_sysid.effects.crossval import Comparison, compare
from quad_sysid.effects.discover import Discovery
from quad_sysid.effects.scan import Dependence, confirmed, strongest
from quad_sysid.greybox.covariance import block_numbers
from quad_sysid.greybox.data import AxisData, Span
from quad_sysid.greybox.fit import Fit, fit_structure, simulator
from quad_sysid.greybox.noise import NoiseModel
from quad_sysid.greybox.simulate import Run, Simulator

HARDLY_BETTER = 0.95
"""A base whose error exceeds this share of the error of holding the last rate is no model."""
CLEARLY_LESS = 0.8
"""Share of the training error that effects leave where, unconfirmed, they are not passed over."""
WORTH_SAYING = 0.99
"""What takes less from the held-out error is not called missing, however certain it is."""
LEVEL = 0.05
"""Level of the one final test per axis (contract, which data decide)."""


@dataclass(frozen=True)
class Figures:
    """Errors of one model on held-out windows, rad/s."""

    free_run: float
    one_step: float
    interval: tuple[float, float]
    """95 % of the free-run error, by resampled blocks."""
    run: Run


@dataclass(frozen=True)
class Judgement:
    """The answer for one axis."""

    verdict: str
    reason: str
    before: Figures
    after: Figures
    test: Comparison
    noise_floor: float
    hold: float
    """Error of holding the last filtered rate instead of any model, rad/s."""
    effect_tests: dict[str, tuple[float, float]]
    """For each effect: p-value and growth of the error in % when it alone is left out."""
    dependence: tuple[Dependence, ...] = ()
    """What the base's residual depends on, over the training windows, foremost first."""


def figures(
    data: AxisData, spans: Sequence[Span], fit: Fit, noise: NoiseModel,
    rng: np.random.Generator,
) -> tuple[Figures, Simulator]:
    """The contract's error of a fitted model on spans it has not seen."""
    sim = simulator(data, spans, noise.correction)
    run = sim.run(fit.structure, fit.theta)
    inside = np.concatenate([run.innovations[a + 1 : b] for a, b in spans])
    inside = inside[np.isfinite(inside)]
    squared = np.mean(run.errors**2, axis=1)
    return Figures(
        free_run=run.rms,
        one_step=float(np.sqrt(np.mean(inside**2))),
        interval=_interval(squared, block_numbers(sim.windows, data.dt), rng),
        run=run,
    ), sim


def _interval(
    squared: FloatArray, blocks: np.ndarray, rng: np.random.Generator, draws: int = 1000
) -> tuple[float, float]:
    """95 % interval of the RMS by resampling blocks of windows with replacement."""
    count = int(blocks.max()) + 1
    sums = np.bincount(blocks, squared, minlength=count)
    sizes = np.bincount(blocks, minlength=count)
    pick = rng.integers(0, count, size=(draws, count))
    rms = np.sqrt(sums[pick].sum(axis=1) / sizes[pick].sum(axis=1))
    low, high = np.percentile(rms, [2.5, 97.5])
    return float(low), float(high)


def judge(found: Discovery, rng: np.random.Generator) -> Judgement:
    """Test the chosen model against the base on the validation segments; say what follows."""
    data = found.data
    before, sim = figures(data, data.validation, found.base, found.base_noise, rng)
    after, _ = figures(data, data.validation, found.chosen, found.chosen_noise, rng)
    test = compare(
        np.mean(before.run.errors**2, axis=1), np.mean(after.run.errors**2, axis=1),
        sim.windows, data.dt,
    )
    effects = bool(found.chosen.structure.effects)
    hold = hold_error(sim)
    less = after.free_run < WORTH_SAYING * before.free_run
    passed = effects and test.p_value < LEVEL and less
    left = None if passed or not found.informative else _dependence(found, sim)
    odd = '' if passed or not found.informative else inconsistency(
        np.mean(found.base.errors**2, axis=1), found.base.windows,
        np.mean(before.run.errors**2, axis=1), sim.windows, data.dt,
    )
    verdict, reason = _verdict(found, before, left, hold, test, odd=odd, passed=passed)
    if found.informative and found.base.theta[0] < 0.0:
        reason += (
            '; a positive command lowers the rate: check the order of the motors, the mixer and '
            'the sign of the gyro before anything else'
        )
    tests = _leave_one_out(found, after, rng) if passed else {}
    reason += _unconfirmed(tests)
    fit, noise = (
        (found.chosen, found.chosen_noise) if passed else (found.base, found.base_noise)
    )
    return Judgement(
        verdict=verdict, reason=reason, before=before, after=after if passed else before,
        test=test, noise_floor=fit.noise_rms(noise), hold=hold, effect_tests=tests,
        dependence=found.dependence,
    )


def _verdict(
    found: Discovery, before: Figures, left: Dependence | None, hold: float,
    test: Comparison, *, odd: str, passed: bool,
) -> tuple[str, str]:
    """One of the contract's four verdicts, with the reason in words."""
    if not found.informative or before.free_run > HARDLY_BETTER * hold:
        seen = 'even its sign is uncertain' if not found.informative else 'no better than holding'
        return 'cannot_tell', (
            f'{found.data.axis}: the commands of this flight do not show what half a second of '
            f'motion owes them ({seen}: free-run error {before.free_run:.3g} rad/s, holding the '
            f'last rate {hold:.3g} rad/s); fly a PRBS on this axis (quad-sysid design-excitation)'
        )
    if passed:
        names = ' and '.join(e.name for e in found.chosen.structure.effects)
        return 'effects_added', (
            f'{names} lowers the held-out error (p = {test.p_value:.2g} over {test.blocks} blocks)'
        )
    if left is not None:
        return 'unexplained_residual', (
            f'the residual depends on {left.name}: following it would lower the training error '
            f'from {found.base.rms:.3g} to {left.score:.3g} rad/s, held-out data agree, yet no '
            'effect that was tried mends it'
        )
    if odd:
        return 'unexplained_residual', f'{odd}; no effect that was tried mends it{_failed(found)}'
    if found.chosen.rms < CLEARLY_LESS * found.base.rms:
        return 'unexplained_residual', (
            'the training segments clearly lack something that the held-out ones do not confirm'
            + _failed(found)
        )
    return 'no_missing_effect', (
        'nothing lowers the error beyond chance, and the residual depends on no signal at hand'
        + _failed(found)
    )


def _failed(found: Discovery) -> str:
    """What the training segments alone would have said, where the unseen ones say otherwise."""
    effects = found.chosen.structure.effects
    if not effects or found.chosen.rms > WORTH_SAYING * found.base.rms:
        return ''
    names = ' and '.join(f'{e.name} ({e.variant})' if e.variant else e.name for e in effects)
    return (
        f'; {names} would lower the error of the training segments from {found.base.rms:.3g} to '
        f'{found.chosen.rms:.3g} rad/s, which the held-out ones do not bear out'
    )


def _unconfirmed(tests: Mapping[str, tuple[float, float]]) -> str:
    """Effects that the training asked for beside others, and whose part unseen data deny."""
    return ''.join(
        f'; {name} does not add to that: without it the held-out error is {-grown:.2g} % smaller, '
        'take it as uncertain'
        for name, (_, grown) in tests.items() if grown < 0.0
    )


def _leave_one_out(
    found: Discovery, after: Figures, rng: np.random.Generator
) -> dict[str, tuple[float, float]]:
    """p-value and growth of the held-out error (%) when one effect alone is taken out."""
    out: dict[str, tuple[float, float]] = {}
    structure = found.chosen.structure
    full = np.mean(after.run.errors**2, axis=1)
    for effect, where in zip(structure.effects, structure.slices(), strict=True):
        keep = np.ones(found.chosen.theta.size, dtype=bool)
        keep[where] = False
        if len(structure.effects) == 1:
            fit, noise = found.base, found.base_noise
        else:
            fit = fit_structure(
                found.chosen_simulator, structure.without(effect.name), found.chosen.theta[keep]
            )
            noise = found.chosen_noise
        reduced, sim = figures(found.data, found.data.validation, fit, noise, rng)
        test = compare(
            np.mean(reduced.run.errors**2, axis=1), full, sim.windows, found.data.dt
        )
        out[effect.name] = (test.p_value, 100.0 * (reduced.free_run / after.free_run - 1.0))
    return out


def _dependence(found: Discovery, held_out: Simulator) -> Dependence | None:
    """What the base's residual depends on most, if the held-out data agree that it does."""
    one = strongest(found.base, found.dependence)
    if one is None:
        return None
    test = confirmed(found.base_simulator, held_out, found.base, one.name)
    return one if test.p_value < LEVEL else None


def hold_error(sim: Simulator) -> float:
    """RMS error of holding the mean of the last 20 ms before each window, rad/s."""
    rate, dt = sim.data.rate, sim.data.dt
    back = max(1, round(0.02 / dt))
    last = np.array([np.mean(rate[s - back : s]) for s in sim.windows.starts])
    return float(np.sqrt(np.mean((sim.measured - last[:, None]) ** 2)))
