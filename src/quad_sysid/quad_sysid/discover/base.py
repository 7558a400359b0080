"""The base alone: its start values, and the noise of the flight."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from quad_sysid.beside import side_by_side
from quad_sysid.contract import FloatArray
from quad_sysid.discover.constants import BEAM, BRIEF, EXPECTED, LEVEL
from quad_sysid.discover.screen import vibration_line
from quad_sysid.estimate.fit import Fit, Problem, fit, start_of
from quad_sysid.model.data import other_axis
from quad_sysid.model.flight import Flight
from quad_sysid.model.structure import Structure

FIRST_STEPS = 6
"""Steps of each fit before the best ones go on."""
FAR_BEHIND = 30.0
"""Nats by which a fit that was begun may lag behind and still be brought to convergence."""
UNDECIDED = math.log(1.0 / LEVEL)
"""Nats within which the data do not decide between two readings."""
ROUGH_NATS = 0.3
"""A step that gains less ends the fits of a contest; what is chosen goes on from there."""
STARTS = ((1, 0.04, 0.01), (1, 0.005, 0.03), (1, 0.15, 0.005), (1, 0.002, 0.002), (-1, 0.04, 0.01))
"""Sign of the gain, lag and delay (s) that a base starts from: usual motors, a late log, slow
motors, a drive that answers at once, and a drive that is wired the wrong way."""
SLOW_HZ, SLOW_WIDTH_HZ = 1.0, 5.0
"""Where the fit of slow gyro noise starts: a line near 0 Hz, wider than its frequency."""
VIBRATION_WIDTH_HZ = 0.1
"""Where that of a vibration starts, at its own frequency."""
MOST_LINES = 3
"""Most lines of vibration in the noise."""


def best_base(problem: Problem) -> Fit:
    """The base from several starts, since its likelihood may have several maxima in closed loop.

    A few steps from each start; then the best are fitted to convergence.
    """
    starts: list[FloatArray] = []
    for sign, lag, delay in STARTS:
        start = start_of(problem)
        start[0] *= sign
        start[1], start[2] = math.log(lag), math.log(delay)
        start[problem.zero_terms] = problem.centres(problem.plain)[problem.zero_terms]
        if not any(np.array_equal(start, other) for other in starts):
            starts.append(start)
    base = most_probable(compared_fits(problem, [
        Candidate(problem.plain, (start,), problem.flight.rate) for start in starts
    ]))
    if base is None:
        raise FloatingPointError('no start of the base holds')
    ended = fitted_from(problem, base.structure, base.theta, rate=base.rate)
    base = _neighbouring_delays(problem, most_probable((base, ended)) or base)
    if problem.flight.sensor.noisy:
        averaged = replace(base.structure, averaged=True)
        base = _likelier(base, fitted_from(problem, averaged, base.theta, rate=base.rate))
    while base.structure.lines < MOST_LINES and (hz := vibration_line(problem, base)) is not None:
        shaken = _likelier(base, _with_line(problem, base, hz, VIBRATION_WIDTH_HZ))
        if shaken is base:
            break
        base = shaken
    return both_orders(problem, base)


def with_slow_noise(problem: Problem, base: Fit) -> Fit | None:
    """The base with slow noise of the gyro, as of a drift; None where that fit diverges.

    Without such noise lag and damping may have changed places.
    """
    slow = _with_line(problem, base, SLOW_HZ, SLOW_WIDTH_HZ)
    return slow and both_orders(problem, slow)


def both_orders(problem: Problem, fitted: Fit) -> Fit:
    """A fit, or the one in which lag and damping have changed places where it is likelier."""
    return most_probable((fitted, _other_order(problem, fitted))) or fitted


def second_reading(problem: Problem, fitted: Fit) -> Fit | None:
    """A fit in which lag and damping have changed places that the data hardly tell from this one.

    It is another maximum, and no point of the same one: further away than this one reaches.
    """
    other = _other_order(problem, fitted)
    if other is None or other.evidence < fitted.evidence - UNDECIDED:
        return None
    away = other.theta - fitted.theta
    return other if 0.5 * float(away @ fitted.hessian @ away) > UNDECIDED else None


def _other_order(problem: Problem, fitted: Fit) -> Fit | None:
    """A fit from where lag and damping have changed places; None where it falls far behind.

    Gain, lag and damping that follow as gain / (lag damping), 1 / damping and 1 / lag answer to
    the command alike; only where the disturbance enters and the priors tell them apart.
    """
    gain, lag, _, damping = fitted.values[:4]
    if not damping > 0.0 or problem.zero_terms:
        return None
    start = fitted.theta.copy()
    start[0], start[1], start[3] = gain / (lag * damping), -math.log(damping), 1.0 / lag
    other = fitted_from(problem, fitted.structure, start, rate=fitted.rate,
                        max_steps=FIRST_STEPS)
    if other is None or other.log_posterior < fitted.log_posterior - FAR_BEHIND:
        return None
    return fitted_from(problem, fitted.structure, other.theta, rate=fitted.rate)


@dataclass(frozen=True, eq=False)
class Candidate:
    """A structure to be fitted from the best of some starts, along a trajectory of the rate."""

    structure: Structure
    starts: Sequence[FloatArray]
    rate: FloatArray


def compared_fits(
    problem: Problem, tries: Sequence[Candidate], least: float = -math.inf
) -> list[Fit]:
    """Fits of structures; only those that do not fall behind are brought near convergence.

    After a few steps of each, what has an evidence FAR_BEHIND the best one, or below `least`, is
    dropped; the BEAM best ones stay. Many are first compared in this way on a short part.
    """
    if problem.short_problem is not None and len(tries) > BEAM:
        tries = _leading_on(problem.short_problem, tries)
    first = first_fits(problem, tries)
    ahead = [fit for fit in _leading(first) if fit.evidence >= least]
    fits = side_by_side([
        partial(fitted_from, problem, fit.structure, fit.theta, rate=fit.rate,
                tolerance_nats=ROUGH_NATS)
        for fit in ahead if not fit.converged
    ])
    return [*(fit for fit in ahead if fit.converged), *(fit for fit in fits if fit is not None)]


def first_fits(problem: Problem, tries: Sequence[Candidate]) -> list[Fit]:
    """A few steps of each; best first."""
    fits = side_by_side([
        partial(fitted_from, problem, candidate.structure, *candidate.starts,
                max_steps=FIRST_STEPS, rate=candidate.rate) for candidate in tries
    ])
    return sorted((fit for fit in fits if fit is not None), key=lambda fit: -fit.evidence)


def _leading(fits: Sequence[Fit], behind: float = FAR_BEHIND) -> list[Fit]:
    """The fits that are at most so many nats behind the first, and BEAM at least."""
    return [fit for i, fit in enumerate(fits)
            if i < BEAM or fit.evidence >= fits[0].evidence - behind]


def _leading_on(short_problem: Problem, tries: Sequence[Candidate]) -> list[Candidate]:
    """Tries that do not fall behind on a part of the rows, each from where it got to there.

    It would miss what happens at a time, which stays as it is.
    """
    local = [candidate for candidate in tries
             if any(part.effect.happens for part in candidate.structure.parts)]
    others = [candidate for candidate in tries if candidate not in local]
    by_labels = {candidate.structure.labels: candidate for candidate in others[::-1]}
    best: dict[frozenset[str], Fit] = {}
    shortened = [replace(candidate, rate=candidate.rate[short_problem.index])
                 for candidate in others]
    for begin in first_fits(short_problem, shortened):
        best.setdefault(frozenset(begin.structure.labels), begin)
    ahead = _leading([*best.values()], FAR_BEHIND / BRIEF)
    full_tries = (by_labels[fit.structure.labels] for fit in ahead)
    return [*local, *(replace(first, starts=(fit.theta, *first.starts))
                      for fit, first in zip(ahead, full_tries, strict=True))]


def _neighbouring_delays(problem: Problem, base: Fit) -> Fit:
    """The base, or a better one whose delay is a cycle shorter or longer.

    Commands are held over a cycle, so that there may be a maximum near each whole one.
    """
    fits: list[Fit | None] = [base]
    for delay in (base.value('delay') - problem.data.dt, base.value('delay') + problem.data.dt):
        if delay > 0.0 and 2 not in problem.zero_terms:
            start = base.theta.copy()
            start[2] = math.log(delay)
            fits.append(fitted_from(problem, base.structure, start, rate=base.rate))
    return most_probable(fits) or base


def most_probable(fits: Iterable[Fit | None]) -> Fit | None:
    """That with the largest posterior density of those of one structure that did not diverge."""
    return max((f for f in fits if f is not None), key=lambda f: f.log_posterior, default=None)


def _with_line(problem: Problem, base: Fit, hz: float, width_hz: float) -> Fit | None:
    """The base with one more line in its noise, begun at this frequency and width."""
    structure = replace(base.structure, lines=base.structure.lines + 1)
    start = np.r_[base.theta, 0.0, math.log(hz), math.log(width_hz)]
    return fitted_from(problem, structure, start, rate=base.rate)


def _likelier(base: Fit, other: Fit | None) -> Fit:
    """The base, or the one with more in its noise if the evidence is for that."""
    if other is not None and other.evidence + math.log(EXPECTED) > base.evidence:
        return other
    return base


def fitted_from(
    problem: Problem, structure: Structure, *starts: FloatArray, **options: Any
) -> Fit | None:
    """A fit from the best of `starts`, as `estimate.fit.fit`; None where it diverges."""
    try:
        return fit(problem, structure, *starts, **options)
    except (FloatingPointError, np.linalg.LinAlgError):
        return None


def fit_without(problem: Problem, fitted: Fit, *indices: int, silent: bool = False,
                **options: Any) -> Fit | None:
    """A fit without some of its effects, the rest refitted; None where that diverges.

    silent: the gain starts at zero, and a law of the user's sees no command.
    """
    slices = fitted.structure.slices
    gone = [j for i in indices for j in range(slices[i].start, slices[i].stop)]
    structure, theta = fitted.structure.minus(*indices), np.delete(fitted.theta, gone)
    if silent:
        theta[0], law = 0.0, structure.law
        structure = replace(structure, law=law and replace(law, settings={'silent': True}))
    return fitted_from(problem, structure, theta, rate=fitted.rate, **options)


def shares(problem: Problem, fitted: Fit, base: Fit, index: int) -> bool:
    """Whether another axis' disturbance acts on this one too, by the evidence beside a fit.

    The other axis' disturbance is the acceleration that its own base does not explain. Its fit
    starts from this axis' `base`, since motors and gyro are the same.
    """
    if not problem.data.measures(index):
        return False
    data = other_axis(problem.data, index)
    built_in, other_problem = replace(base.structure, law=None), Problem(data, data.train)
    start = base.theta if base.structure.law is None else np.r_[
        start_of(other_problem)[: len(built_in.base)], base.theta[-len(built_in.noise) :]]
    other = fitted_from(other_problem, built_in, start)
    if other is None:
        return False
    flight = problem.flight
    flight.disturbances[:, index] = Flight(data, data.stretches).unexplained(other.values)
    structure = replace(fitted.structure, shared=(index,))
    theta = np.insert(fitted.theta, -structure.filtered, 0.0)
    fit = fitted_from(problem, structure, theta, rate=fitted.rate)
    return _likelier(fitted, fit) is fit
