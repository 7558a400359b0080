"""The pipeline: records of one aircraft to one answer per axis.

Calls the packages in the order of the data's line and nothing else; decides which axes are asked.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from numbers import Real
from traceback import extract_tb

import numpy as np
from threadpoolctl import threadpool_limits

from quad_sysid.axes import EVERY
from quad_sysid.beside import side_by_side
from quad_sysid.contract import AXES, FloatArray
from quad_sysid.discover.accept import Unseen, judge
from quad_sysid.discover.constants import AGAIN
from quad_sysid.discover.screen import MIN_MOTORS, candidates, screen
from quad_sysid.discover.search import SearchResult, extended, scored, search, to_convergence
from quad_sysid.effects import EFFECTS
from quad_sysid.errors import NotInformativeError, QuadSysidError, p_in_words
from quad_sysid.estimate.fit import Problem
from quad_sysid.estimate.stored import noise_of
from quad_sysid.explain import explain
from quad_sysid.foresight import drawn_hz
from quad_sysid.model import AxisModel, Designer, GainProposal
from quad_sysid.model.data import AxisData, axis_data
from quad_sysid.model.effect import Effect
from quad_sysid.one_line import one_line
from quad_sysid.own_base import Base, lacking
from quad_sysid.pipeline.answer import AxisAnswer, Findings
from quad_sysid.pipeline.assemble import Support, axis_model, outside_of
from quad_sysid.pipeline.blackbox_part import Fits, about_base, fit_models, io_data
from quad_sysid.pipeline.constants import GUSTY
from quad_sysid.pipeline.held_out import held_out, residuals
from quad_sysid.pipeline.selection import with_blackbox
from quad_sysid.pipeline.step_b import Loop, closed_loop, loop_of
from quad_sysid.pipeline.usable import (
    check_usable,
    cut_off_command,
    refusal,
    together,
    too_few_windows,
)
from quad_sysid.record import IOData, Record
from quad_sysid.units import Units, unit_and_factor


@dataclass(frozen=True)
class AxisFlight:
    """One axis of one or several flights: its data, the loop around it, its references."""

    data: AxisData
    loop: Loop
    gains: Mapping[str, float]
    """Gains and loop constants in force during the first record's training."""
    units: Units | None
    """Units of the arrays that it came from; None: of its axis."""
    drawn_hz: float
    """Sample rate, Hz, of commands that were interpolated in between; 0 if they were not."""
    attitude_reference: FloatArray | None
    """(n,) rad, on the grid of the data; None where a record does not hold it."""
    rate_reference: FloatArray | None
    """(n,) rad/s, alike."""

    @classmethod
    def of(cls, records: Sequence[Record], axis: str) -> AxisFlight:
        """Raises NotInformativeError where the records cannot answer for the axis."""
        data, entry, first = axis_data(records, axis), EVERY[axis], records[0]
        check_usable(data, records)
        # of surge and sway it is the lean, which moves between its samples as the angles do
        commands = slice(1, None) if entry.turns else slice(1)
        drawn = [drawn_hz(record.control[:, commands], record.dt)
                 for record in records if entry.turns or entry.index < 0]
        starts_s = [s.start_s for s in first.segments if s.role == 'train']

        def joined(setpoints: Sequence[FloatArray | None]) -> FloatArray | None:
            columns = [setpoint[:, entry.index] for setpoint in setpoints
                       if setpoint is not None and entry.turns]
            return np.concatenate(columns) if len(columns) == len(setpoints) else None

        return cls(
            data, loop_of(records, axis), dict(first.gains_at(min(starts_s, default=0.0))),
            first.units, max(drawn, default=0.0),
            joined([record.attitude_setpoint for record in records]),
            joined([record.rate_setpoint for record in records]))


Progress = Callable[[str], None]
NOT_SEARCHED = 'effects were not searched for'
DRAWN = (f'{NOT_SEARCHED}, since the commands were interpolated between samples at some '
         '{:.3g} Hz and cannot carry them (log the commands at the full rate)')
NOT_FITTED = 'it cannot be fitted beside the base'
NOT_POSITIVE = (f'{NOT_FITTED}: the training does not bear it with a positive {{}}; leave '
                '`positive` out where a negative one is physical')


@dataclass(frozen=True)
class Options:
    """Options of an identification."""

    axes: tuple[str, ...] = ()
    """Empty: those that the segments excite, or all."""
    designer: Designer | None = None
    no_designer_because: str = 'no designer is installed (quad_tuning offers one)'
    effects: tuple[Effect, ...] = EFFECTS
    """The candidates for what is missing."""
    base: Base | None = None
    """The user's own; None: gain, lag, delay, damping and bias."""
    halt: Callable[[], str] = lambda: ''
    """Why the search may add nothing more; '' as long as it may."""


def identify(records: Sequence[Record], options: Options,
             progress: Progress = lambda _: None) -> dict[str, AxisAnswer]:
    """One answer for every axis asked for; records share one aircraft and one sample rate.

    Raises BadInputError where the records do not fit together (pipeline.together).
    """
    records = together(records)
    axes = options.axes or excited_axes(records)
    with threadpool_limits(limits=1):  # the matrices are narrow: threads only wait for another
        answers = side_by_side([partial(identify_axis, records, axis, options, progress)
                                for axis in axes])
    return dict(zip(axes, answers, strict=True))


def excited_axes(records: Sequence[Record]) -> tuple[str, ...]:
    """The axes that any segment trains; where no segment says, all."""
    named = {s.axis for r in records for s in r.segments if s.role == 'train'}
    return tuple(axis for axis in EVERY if axis in named) or AXES


def identify_axis(records: Sequence[Record], axis: str, options: Options,
                  progress: Progress) -> AxisAnswer:
    """Fit, find what is missing, judge, design: one axis."""
    segments = tuple(
        s for r in records for s in r.segments
        if s.excites(axis) or (s.role == 'idle' and 'because' not in s.parameters)
    )
    records = [record.for_axis(axis) for record in records]
    refusals = tuple(filter(None, map(refusal, records)))
    answer = AxisAnswer(
        axis, 1.0 / records[0].dt, segments, 'cannot_tell', '',
        warnings=(*(line for record in records for line in record.warnings), *refusals))
    try:
        flight = AxisFlight.of(records, axis)
        if flight.drawn_hz:
            options = replace(options, effects=())
        problem = None if options.base is None else \
            options.base.problem(flight.data, flight.units)
        findings = findings_of(flight.data, options, progress, problem)
    except NotInformativeError as error:
        reason = '; '.join([str(error), *(w for w in answer.warnings if 'cut off' in w)])
        return replace(answer, reason=reason, proposal=GainProposal(None, reason))
    data, search_result = findings.data, findings.search
    count = max(findings.problem.data.motors.shape[1], MIN_MOTORS)
    is_searched = any(effect.label not in search_result.reasons
                      and max(effect.motors, default=0) < count
                      and (not effect.axes or axis in effect.axes) for effect in options.effects)
    verdict, why_not = findings.verdict.verdict, ''
    if not is_searched:
        verdict = verdict if verdict == 'cannot_tell' else 'not_searched'
        why_not = DRAWN.format(flight.drawn_hz) if flight.drawn_hz else NOT_SEARCHED
    train = io_data(data, data.train)
    progress(f'{axis}: black-box models')
    fits = _black_boxes(train)
    support = Support.of(train, axis, None if isinstance(fits, str) else fits.surest)
    units = flight.units or EVERY[axis].units
    reason = _reason(findings, why_not, units)
    no_gains = *refusals, reason if verdict == 'cannot_tell' else ''
    model = axis_model(findings, flight.gains, support.band, options.effects, units, no_gains[0])
    undetermined = () if options.base is None else \
        lacking(options.base, findings.problem, search_result.base)
    cut_short = search_result.cut_short and (
        f'{axis}: {search_result.cut_short} and ended early: what it names may stand for an '
        'effect that was not tried')
    answer = replace(
        answer, verdict=verdict, reason=reason, findings=findings, model=model,
        train=train, validation=io_data(data, data.validation, external=False),
        outside=outside_of(model, data, data.validation),
        warnings=(*answer.warnings, *undetermined, *filter(None, [cut_short])),
        attitude_reference=flight.attitude_reference, rate_reference=flight.rate_reference)
    known: AxisAnswer
    proposal, known = side_by_side([  # the longer one first: it begins calls of its own
        partial(_proposal, answer, model, options, progress),
        partial(_compared, answer, findings, flight.loop, fits, support),
    ])
    return replace(known, proposal=proposal)


def _black_boxes(train: IOData) -> Fits | str:
    """The black-box models, or why there are none."""
    try:
        return fit_models(train)
    except QuadSysidError as error:
        return str(error)


def _compared(answer: AxisAnswer, findings: Findings, loop: Loop, fits: Fits | str,
              support: Support) -> AxisAnswer:
    """The answer with the black-box models, what all models leave, and the loop around them."""
    answer = with_blackbox(answer, fits, findings.data, loop, support)
    return replace(answer, residuals=residuals(answer, findings),
                   closed_loop=closed_loop(answer.model, loop, findings.data))


def findings_of(data: AxisData, options: Options, progress: Progress = lambda _: None,
                problem: Problem | None = None) -> Findings:
    """Search on the training segments, then the held-out ones. Raises NotInformativeError.

    problem: the training with a base of one's own.
    """
    progress(f'{data.axis}: what is missing')
    try:
        problem = problem or Problem(data, data.train)
        result = search(problem, options.effects, options.halt,
                        lambda line: progress(f'{data.axis}: {line}'))
        if not options.halt():
            result = with_own(problem, result, options.effects)
        if not options.effects:
            result.reasons.update((effect.label, NOT_SEARCHED) for effect in EFFECTS)
        progress(f'{data.axis}: the explanation')
        parts = [part for part in candidates(problem, options.effects)[0]
                 if part.effect.label not in result.reasons]
        ladder = explain(problem, result, parts)
        progress(f'{data.axis}: held-out segments')
        if options.base is None:
            data = about_base(data, result.base.value('gain'), result.base.value('bias'))
        unseen = Unseen(data, data.validation)
        verdict = judge(unseen, problem, result, ladder)
        base_error = held_out(unseen, verdict.base)
        after = base_error if verdict.chosen is verdict.base else held_out(unseen, verdict.chosen)
        return Findings(data, problem, result, ladder, verdict, base_error, after)
    except (FloatingPointError, np.linalg.LinAlgError) as error:
        spreads = [float(np.nanstd(data.training(x))) for x in (data.command, data.rate)]
        raise NotInformativeError(
            f'{data.axis}: no model of this axis can be fitted to the training, in which its '
            f'command moves by {spreads[0]:.2g} and its rate by {spreads[1]:.2g} rad/s (RMS); '
            'excite it, and look at its command and rate'
        ) from error


def with_own(problem: Problem, result: SearchResult, effects: Sequence[Effect]) -> SearchResult:
    """The search's result, with fits beside the base of the user's effects that it skipped.

    A search fits only promising effects; the report states for every effect of the user's what it
    explains.
    """
    fitted = {label for entry in result.all for label in entry.fit.structure.labels}
    passed_over = [effect for effect in effects if effect not in EFFECTS
                   and effect.label not in fitted | result.reasons.keys()]
    if not passed_over:
        return result
    fits = {score.part.effect.label: extended(problem, result.base, score)
            for score in screen(problem, result.base, candidates(problem, passed_over)[0])}
    more = [scored(fit, result.prices) for fit in fits.values() if fit is not None]
    positive = {effect.label: ' or '.join(spec.name for spec in effect.parameters if spec.positive)
                for effect in passed_over if effect.label not in fits}
    failed = {effect.label: NOT_POSITIVE.format(positive[effect.label])
              if positive.get(effect.label) else NOT_FITTED
              for effect in passed_over if fits.get(effect.label) is None}
    return to_convergence(problem, replace(result, all=(*result.all, *more),
                                           reasons=result.reasons | failed))


def _would_help(findings: Findings, not_searched: str) -> str:
    """What would help where the commands predict nothing."""
    if not_searched:
        return (f'; {not_searched}: either the axis is hardly excited (quad-sysid inspect says '
                'so), or the base alone lacks what it needs, such as how its motors respond, '
                'and it is to be identified with effects')
    return ('; a model that sees only past rates predicts as well as one that also sees the '
            'commands, so the data do not show what the commands do; fly a PRBS on '
            f'{findings.data.axis} (quad-sysid design-excitation), with more amplitude where one '
            'was flown')


def _reason(findings: Findings, not_searched: str, units: Units | None = None) -> str:
    """The verdict's reason in words, with what would help; why no effects were sought, if so."""
    verdict, ladder = findings.verdict, findings.ladder
    reason = verdict.reason
    if verdict.verdict == 'cannot_tell':
        reason = too_few_windows(findings.data) or reason + _would_help(findings, not_searched)
    elif verdict.verdict == 'effects_added':
        effects = (part.effect for part in verdict.chosen.structure.parts)
        names = ' and '.join(
            effect.name for effect in sorted(effects, key=lambda e: ladder.rank(e.label)))
        reason = (
            f'with {names} the model predicts the held-out segments better than the base alone '
            f'(by chance alone: p {p_in_words(max(claim.p_value for claim in verdict.claims))})'
        ) + (verdict.reason and f'; yet that is not all: {verdict.reason}')
    elif not_searched:
        reason = f'{not_searched}: this is the base alone' + (reason and f'; {reason}')
    else:
        reason = reason or ('no effect is confirmed by the held-out segments' if ladder.answer
                            else 'no effect alone explains the training better than the base')
    labels = verdict.chosen.structure.labels
    claimed = ladder.rungs[ladder.answer].model.structure.parts
    withdrawn = [part.effect.name for part in claimed if part.effect.label not in labels]
    if withdrawn and verdict.verdict != 'cannot_tell':
        again = min(ladder.reproducible.get(name, 1.0) for name in withdrawn)
        reason += (
            f'; the training {"also " if labels else ""}suggests {" and ".join(withdrawn)}, which '
        ) + ('the held-out segments do not confirm' if again >= AGAIN else
             f'comes again in {again:.0%} of resampled flights only')
    follows = not verdict.after > GUSTY * verdict.noise_floor
    cut_off = '' if follows else cut_off_command(findings.data, units)
    if cut_off and verdict.verdict != 'cannot_tell':
        reason += f'{"; " if reason else ""}{cut_off}'
    elif verdict.verdict == 'no_missing_effect' and (
            verdict.before > GUSTY * verdict.noise_floor):
        noise = noise_of(verdict.base)
        unit, factor = unit_and_factor(units, 'rad/s²')
        reason += (
            f"; the base's error is {verdict.before / verdict.noise_floor:.0f} times the noise of "
            f'the rate and is taken for gusts, {factor * noise.disturbance_rms:.2g} {unit} that '
            f'last some {noise.correlation_s:.2g} s: if the air was still, something slow is '
            'missing'
        )
    if not verdict.chosen.converged:
        reason += f'{"; " if reason else ""}its fit did not converge: its figures are rough'
    other = findings.search.other
    if other is not None and verdict.verdict != 'cannot_tell':
        first, second = (', '.join(f'{name} {reading.value(name):.3g}{unit}' for name, unit in (
            ('gain', ''), ('lag', ' s'), ('damping', ' 1/s')))
            for reading in (findings.search.best, other))
        reason += (f'{"; " if reason else ""}the data do not tell lag and damping apart: {first}, '
                   f'or about as well {second}; measured rotor speeds would decide')
    gain = verdict.chosen.value('gain')
    if verdict.verdict != 'cannot_tell' and gain < 0.0 and not (
            cut_off or findings.problem.zero_terms):
        reason += (
            '; a positive command lowers the rate: check the order of the motors, the mixer and '
            'the sign of the gyro before anything else'
        )
    return reason


def _proposal(answer: AxisAnswer, model: AxisModel, options: Options,
              progress: Progress) -> GainProposal:
    progress(f'{answer.axis}: gains')
    if model.no_gains_because:
        return GainProposal(None, model.no_gains_because)
    if EVERY[answer.axis].outer:
        return GainProposal(None, 'no firmware has its loop; quad-tune design MODEL.json --axis '
                            f'{answer.axis} gives gains for one of your own')
    if options.designer is None or options.base is not None:
        return GainProposal(None, options.no_designer_because if options.base is None
                            else 'gains are designed for the built-in base only')
    try:
        proposal = options.designer(model.predicting)
    except Exception as error:  # noqa: BLE001 - the search, which took minutes, stands
        code = extract_tb(error.__traceback__)[-1]
        return GainProposal(None, str(error) if isinstance(error, QuadSysidError) else one_line(
            f'the designer {getattr(options.designer, "__qualname__", repr(options.designer))}',
            f'failed in {code.filename}:{code.lineno}', f'{type(error).__name__}: {error}'))
    if not isinstance(proposal, GainProposal):
        return GainProposal(None, f'the designer gave {proposal!r} instead of a GainProposal')
    wrong = [f'{name} = {value}' for name, value in (proposal.gains or {}).items() if not (
        name.startswith(f'{answer.axis}.') and isinstance(value, Real) and math.isfinite(value))]
    return proposal if not wrong else GainProposal(
        None, f'the designer gave what is no gain of {answer.axis}: {", ".join(wrong)}')
