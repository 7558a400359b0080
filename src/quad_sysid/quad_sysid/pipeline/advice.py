"""Advice to the user where data or models are doubtful."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.signal.windows import tukey

from quad_sysid.axes import EVERY
from quad_sysid.blackbox import excitation_order
from quad_sysid.model import AxisModel
from quad_sysid.model.data import high
from quad_sysid.model.effect import required
from quad_sysid.pipeline.answer import AxisAnswer, ModelRow
from quad_sysid.pipeline.assemble import ENDS, Support
from quad_sysid.pipeline.blackbox_part import Fits
from quad_sysid.pipeline.constants import RIVAL
from quad_sysid.record import IOData

PAPERS_BAND = (0.1, 20.0)
"""Band of the paper's PRBS, rad/s; advice names the part of it that a model does not cover."""
FURTHER = 1.5
"""Factor of the held-out rates over the training's above which extrapolation is named."""
QUICKER = 2.0
"""Factor of the held-out rates' frequencies over the training's above which that is named."""
RICHEST = 50
"""Order up to which the paper's PRBS is persistently exciting."""


def advice(answer: AxisAnswer, fits: Fits, support: Support, no_step_b: str) -> tuple[str, ...]:
    """One line each, the most important first; empty without doubts. no_step_b: why, if so."""
    train, held_out = required(answer.train), required(answer.validation)
    return (*_between_flights(answer), *rivalry(answer.model),
            *_excitation(train, answer.rows), *_beyond(train, held_out),
            *_delay(answer, fits.delay), *_band(answer, support.lowest),
            *_edge(fits.search.at_edge), *_unstable(answer.rows), *_selection(answer, no_step_b))


def _between_flights(answer: AxisAnswer) -> Iterator[str]:
    """A line where what changes over time may be what the flights differ in."""
    findings = required(answer.findings)
    chosen, flights = findings.verdict.chosen, findings.problem.data.whole[0].flights
    p = chosen.structure.natural(chosen.theta)
    changes = [part.effect.name for part, where in chosen.structure.effects
               if 'time' in part.effect.signals and not part.effect.repeats_hz(p[where])]
    if len(flights) > 1 and changes:
        yield (f'{" and ".join(changes)} over {len(flights)} flights may be what they differ in, '
               'such as another aircraft, battery or propeller: identify each by itself, and '
               'quad-sysid compare them')


def rivalry(model: AxisModel | None) -> Iterator[str]:
    """The command that designs the flight against an effect's nearest rival, if it is near."""
    for effect in () if model is None else model.effects:
        name, near = max(effect.listed_rivals, key=lambda pair: pair[1], default=('', 0.0))
        if near > RIVAL and model is not None:
            advice = ('; design one that does: quad-sysid design-excitation --separate '
                      f'{effect.name} {name} --axis {model.axis} --model model.json '
                      '--out schedule.yaml') if EVERY[model.axis].turns else ''
            yield (f'{effect.name} (probability {effect.probability:.2g}) or {name} ({near:.2g}): '
                   f'this flight hardly separates them{advice}')


def _excitation(train: IOData, rows: Sequence[ModelRow]) -> Iterator[str]:
    order = excitation_order(train, RICHEST)
    required = max((_inputs(row) for row in rows), default=0)
    if order < required:
        yield (
            f'the command is persistently exciting of order {order} only, the largest model needs '
            f'{required}: the data do not determine all its coefficients; fly a PRBS of more bits '
            'or fit lower orders'
        )


def _beyond(train: IOData, held_out: IOData) -> Iterator[str]:
    low, reach = (high(z.inside(z.y)) for z in (train, held_out))
    if reach > FURTHER * low:
        yield (
            f'the held-out rates reach {reach:.2g} rad/s, those of the training {low:.2g}: '
            'there every effect is extrapolated; train on motion as large as the model has to '
            'predict'
        )
    slow, quick = (_quickest(z) for z in (train, held_out))
    if quick > QUICKER * slow:
        yield (
            f'the held-out rates move at up to {quick:.2g} rad/s, those of the training at '
            f'{slow:.2g} (95 % of their power): the model is judged where it was not trained; '
            'choose --train and --validate so that both hold every frequency'
        )


def _quickest(z: IOData) -> float:
    """Frequency, rad/s, below which 95 % of the rate's power lies."""
    mean = float(z.inside(z.y).mean())  # one for all: that of a short part is slow motion itself
    parts = [tukey(b - a, ENDS) * (z.y[a:b] - mean) for a, b in z.segments]
    lines = np.concatenate([2.0 * np.pi * np.fft.rfftfreq(part.size, z.dt) for part in parts])
    power = np.concatenate([np.abs(np.fft.rfft(part)) ** 2 / part.size for part in parts])
    order = np.argsort(lines)
    below = np.cumsum(power[order])
    return float(lines[order][np.searchsorted(below, 0.95 * below[-1])])


def _inputs(row: ModelRow) -> int:
    """Order of excitation that a model needs: the number of its plant's coefficients."""
    model = row.step_a.model
    return int(model.B.size - model.nk + model.denominator.size - 1)


def _delay(answer: AxisAnswer, samples: int) -> Iterator[str]:
    model = required(answer.model)
    if samples == 0 and model.value('delay') < 0.5 * model.dt:
        yield (
            'the estimated delay is 0 samples: in the cascade a command cannot act on the rate of '
            'its own cycle; the stamps of command and rate seem to be one cycle apart, or the log '
            'keeps only some cycles of a faster controller'
        )
    lag = model.value('delay') + model.value('lag')
    # three cycles of slack for an estimate in whole cycles; the fits go no further than 8
    if samples > max(int(np.ceil(lag / model.dt)) + 3, 8):
        yield (
            f'the delay of {samples} samples ({1e3 * samples * model.dt:.0f} ms) is not '
            f'that of the grey box (delay and lag {1e3 * lag:.0f} ms): check the stamps'
        )
    unstable = [row for row in answer.rows if any(r.diverged for r in row.loop_runs)
                and row.step_a.passed_first_step]
    if unstable:
        names = ', '.join(row.step_a.model.name for row in unstable)
        yield (f'with the recorded gains the simulated cascade diverges for {names}, while the '
               'aircraft flew: gain or delay of the model is not consistent with the cascade')


def _band(answer: AxisAnswer, lowest: float) -> Iterator[str]:
    band = required(answer.model).trusted_band_rad_s
    if band is None:
        yield ('at no frequency are command and rate coherent enough to trust a model: '
               'excite with more amplitude')
        return
    low, high = band
    if PAPERS_BAND[0] < low <= 1.05 * lowest:  # trusted from the lowest frequency on
        yield (f'below {low:.2g} rad/s nothing can be said: the longest unbroken training stretch '
               'is too short for it')
    elif low > 2.0 * PAPERS_BAND[0]:
        joint = any(a.name == 'joint' and a.possible for a in answer.selection.approaches)
        why = (
            'there the feedback leaves little motion, and the direct approach sees noise through '
            f'the controller; {"compare with the joint approach, or " if joint else ""}excite '
            'more slowly'
            if answer.selection.feedback
            else 'the excitation holds too little of it; fly longer or slower'
        )
        yield f'below {low:.2g} rad/s the models cannot be trusted: {why}'
    if high < PAPERS_BAND[1]:
        yield (
            f'above {high:.3g} rad/s the models cannot be trusted; a faster excitation or more '
            'amplitude would reach further'
        )


def _edge(edge: Sequence[str]) -> Iterator[str]:
    if edge:
        yield (
            f'the best ARX order by AIC lies at the edge of the search in {", ".join(edge)}: '
            'coloured noise asks for more lags than the plant has; a structure with a noise model '
            'of its own (ARMAX, BJ) needs fewer'
        )


def _unstable(rows: Sequence[ModelRow]) -> Iterator[str]:
    for row in rows:
        model = row.step_a.model
        if model.structure in ('IV4', 'CLRIV') and (not model.stable or model.warnings):
            yield (
                f'{model.name}: the instrumental variable estimate is unstable or did not settle; '
                'its instruments are too weak, do not use it'
            )
        elif model.warnings:
            yield f'{model.name}: {"; ".join(model.warnings)}'


def _selection(answer: AxisAnswer, no_step_b: str) -> Iterator[str]:
    if no_step_b:
        yield f'no second step in the simulated closed loop: {no_step_b}'
    row = None if answer.selected is None else answer.rows[answer.selected]
    if row is None:
        yield 'every black-box model is unstable; none was selected'
    elif not row.step_a.holds:
        yield (
            'no black-box model with a white residual passed the first step; the selected one has '
            'the least error over windows of the training data'
        )
    elif not row.passed_second_step and not no_step_b:
        yield 'no black-box model passed the second step; the selected one passed the first'
