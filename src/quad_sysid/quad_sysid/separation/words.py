"""A separation as text: the table, the reason for the first flight, and its schedule."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator, Mapping

from quad_sysid.separation.design import CERTAIN, Row, Separation
from quad_sysid.separation.flight import THROTTLE_STEP, THROTTLE_STEP_S, Excitation
from quad_sysid.signals.design import mount_line
from quad_sysid.signals.schedule import AMPLITUDES, Part

MOST_ROWS = 8
NOTICED = 0.01
"""Shares that differ by less are the same to a reader."""
WIDTH = 80
ROW = '{:>2} {:<39}{:>6}{:>9}{:>8}{:>8}{:>7}'
IDLE = '{segment: idle, duration_s: 3.0}'


def text(result: Separation) -> str:
    """The flight to fly, with the reason, and the table, in lines of 80 columns."""
    return '\n'.join(_lines(result))


def _lines(result: Separation) -> Iterator[str]:
    a = result.aircraft
    yield f'{result.first.name} or {result.second.name} on {a.axis}: which flight separates them'
    yield from textwrap.wrap(why(result), WIDTH)
    yield ''
    yield from textwrap.wrap(
        f'plant: {a.source}, gain {a.theta[0]:.3g} rad/s² per unit, '
        f'lag {1e3 * a.theta[1]:.0f} ms, delay {1e3 * a.theta[2]:.0f} ms; '
        f'assumed: {result.first.words()}; {result.second.words()}', WIDTH,
    )
    yield ''
    yield ROW.format('', '', 'angle', 'apart', 'apart', 'right', '95 %')
    yield ROW.format('', f'flight of {result.seconds:g} s', '°', 'first', 'second', 'one', 'after')
    for number, row in enumerate(result.rows[:MOST_ROWS], 1):
        yield _row(str(number), row, result.seconds)
    if result.plain not in result.rows[:MOST_ROWS]:
        yield _row('', result.plain, result.seconds)
    yield ''
    yield from textwrap.wrap(
        'apart: log evidence, in nats, of this effect over the other in a flight in which it is '
        'the true one. right one: probability that the true one has the larger evidence. '
        '95 % after: seconds until that probability is 95 %.', WIDTH,
    )
    excitations = [row.excitation for row in result.rows[:MOST_ROWS]]
    if any(e.before is not None for e in excitations):
        yield '+P: after a plain PRBS for a third of the time, which identifies the base.'
    if any(e.throttle_steps for e in excitations):
        yield '+T: the pilot steps the throttle.'
    if any(e.others_move for e in excitations):
        yield '+A: the pilot moves the other two axes.'
    if result.refused:
        yield from textwrap.wrap(
            f'Of {result.tried} candidates {result.refused} would go near the angle at which the '
            'excitation node ends a flight, or move too little to identify the base; the best of '
            'the others are shown.', WIDTH,
        )


def why(result: Separation) -> str:
    """Why the first flight is the one to fly."""
    best, plain = result.best, result.plain
    gain = best.worst.nats / plain.worst.nats if plain.worst.nats > 0.0 else math.inf
    harder = result.first if best.worst is best.first else result.second
    other = result.second if best.worst is best.first else result.first
    matched = plain.first if best.worst is best.first else plain.second
    sentence = f'Fly {name_of(best.excitation)}: '
    if best is plain:
        return sentence + 'no candidate separates them better than the plain PRBS.'
    if other.acting is None:
        sentence += f'the evidence for {harder.name} is '
    else:
        share = best.worst.mimicked
        sentence += (f'in this flight {other.name} cannot imitate {harder.name}'
                     if share < 0.005 else  # it would print as 0 %
                     f'{other.name} explains {share:.0%} of the evidence for {harder.name}')
        if matched is not None and matched.mimicked > share + NOTICED:
            sentence += f', with the plain PRBS it explains {matched.mimicked:.0%}'
        sentence += '; the evidence between them is '
    more = f'{gain:.1f} times that' if gain < 1e3 else 'far more than that'
    sentence += (f'{more} of the plain PRBS (rate {best.rate_rms:.2f} rad/s RMS, angle up to '
                 f'{math.degrees(best.peak_angle):.0f}°; PRBS {plain.rate_rms:.2f} rad/s and '
                 f'{math.degrees(plain.peak_angle):.0f}°).')
    if best.worst.over(result.seconds).probability < CERTAIN:
        sentence += (
            f' {result.seconds:g} s are not enough for {100 * CERTAIN:.0f} %: '
            f'fly {_seconds(best.worst.seconds_for(CERTAIN))}, in several flights if need be.'
        )
    return sentence + pilot_of(best.excitation)


def pilot_of(excitation: Excitation) -> str:
    """Words for the pilot's part in the training, which no schedule contains."""
    sentence = ''
    if excitation.throttle_steps:
        sentence += (
            f' Meanwhile the pilot steps the throttle by {2 * THROTTLE_STEP:g} up and down every '
            f'{THROTTLE_STEP_S:g} s.'
        )
    if excitation.others_move:
        sentence += ' Meanwhile the pilot moves the other two axes, by some 8° each.'
    return sentence


def name_of(excitation: Excitation) -> str:
    """Signal, its times, its size, and what the pilot adds."""
    part = excitation.part
    p = part.parameters
    shape = {
        'prbs': lambda: f'prbs, clock {p["clock_s"]:g} s',
        'square': lambda: f'square, period {p["period_s"]:g} s',
        'multisine': lambda: (
            f'slow sine, {p["period_s"]:g} s' if p['f0_hz'] == p['f1_hz']
            else f'multisine, {p["f0_hz"]:g} to {p["f1_hz"]:g} Hz'
        ),
        'chirp': lambda: f'chirp, {p["f0_hz"]:g} to {p["f1_hz"]:g} Hz',
        '3211': lambda: f'3-2-1-1, unit {p["unit_s"]:g} s',
    }[part.signal]()
    size = part.amplitude / AMPLITUDES[part.injection][1]
    unit = '°' if part.injection == 'attitude' else ' control'
    extra = ''.join(
        word for word, on in ((' +P', excitation.before is not None),
                              (' +T', excitation.throttle_steps),
                              (' +A', excitation.others_move)) if on
    )
    return f'{shape}, {size:g}{unit}{extra}'


def _row(number: str, row: Row, seconds: float) -> str:
    worst = row.worst.over(seconds)
    nats = ('-' if power is None else f'{power.over(seconds).nats:.1f}'
            for power in (row.first, row.second))
    return ROW.format(number, name_of(row.excitation), f'{math.degrees(row.peak_angle):.0f}',
                      *nats, f'{worst.probability:.2f}', _seconds(worst.seconds_for(CERTAIN)))


def _seconds(value: float) -> str:
    return f'{math.ceil(value)} s' if value < 6000.0 else 'never'  # a hundred minutes


def schedule(result: Separation) -> str:
    """YAML of the excitation node: trains with the best flight, validates on its like."""
    best = result.best.excitation
    part = best.part
    scale = result.seconds / sum(p.duration_s for p in best.parts)
    trains = [_entry('train', p, p.parameters, scale * p.duration_s) for p in best.parts]
    # two fifths of the training, and at least the 28 windows of 15 s
    checks = [_entry('validation', part, _like(part), max(15.0, 0.4 * result.seconds))]
    if best.before is not None:
        checks.insert(0, _entry('validation', best.before, _like(best.before), 15.0))
    rows = [*(row for entry in (*trains, *checks) for row in (IDLE, entry)), IDLE]
    head = [f'Tells {result.first.name} and {result.second.name} on {part.axis} apart:',
            *textwrap.wrap(why(result), WIDTH - 2)]
    mount = 'hover' if best.others_move else 'rig'  # where the pilot's sticks may move
    lines = [*(f'# {line}' for line in head), 'schedule:', mount_line(mount), '  segments:']
    return '\n'.join([*lines, *(f'    - {row}' for row in rows)]) + '\n'


def _like(part: Part) -> dict[str, float | int]:
    """The same kind of signal, but not the same again."""
    p = part.parameters
    if part.signal == 'prbs':
        return {**p, 'seed': p['seed'] + 1, 'register_bits': p['register_bits'] - 1}
    return {name: value * (0.8 if name.endswith('_s') else 1.25) for name, value in p.items()}


def _entry(role: str, part: Part, parameters: Mapping[str, float | int], seconds: float) -> str:
    key, unit, _, _ = AMPLITUDES[part.injection]
    fields = {'segment': role, 'signal': part.signal, 'axis': part.axis,
              'injection': part.injection, key: f'{part.amplitude / unit:g}',
              'duration_s': f'{seconds:.1f}',
              **{name: f'{value:g}' for name, value in parameters.items()}}
    return '{' + ', '.join(f'{name}: {value}' for name, value in fields.items()) + '}'
