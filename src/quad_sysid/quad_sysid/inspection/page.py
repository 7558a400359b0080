"""An inspection as text for 80 columns, and as a page that draws the motors above the text."""

from __future__ import annotations

import math
from collections.abc import Iterator
from html import escape
from pathlib import PurePath

from quad_sysid.axes import EVERY
from quad_sysid.contract import AXES
from quad_sysid.inspection.content import AxisContent, Content, MotorPlace
from quad_sysid.pipeline.answer import Use
from quad_sysid.report.style import document
from quad_sysid.report.tables import Table, wrapped

MAX_SEGMENTS = 12  # a screen; --json has all


def lines(content: Content) -> list[str]:
    """The text, a screen, which begins with the answer."""
    able = ', '.join(axis.axis for axis in content.axes if axis.uses[0].possible) or 'no axis'
    out = [*wrapped(f'not usable: {content.unusable}' if content.unusable else
                    f'{content.source}: {able} can be identified', '  ', ''),
           '', *_topics(content)]
    if content.unusable:
        return out
    out += ['', *_flight(content), '', *_segments(content), '']
    for axis in content.axes:
        out += [*_axis(axis), '']
    out += ['usable for', *(line for use in content.uses for line in _use(use))]
    if content.warnings:
        first = content.warnings[:8]
        more = len(content.warnings) - len(first)
        out += ['', 'warnings', *(line for text in first for line in wrapped(text, '  '))]
        out += [f'  and {more} more (--json)'] if more else []
    return out


def _topics(content: Content) -> Iterator[str]:
    rows = [
        [topic.name, str(topic.messages), '-' if topic.rate_hz is None else f'{topic.rate_hz:.4g}',
         f'{topic.span_s:.1f}', str(topic.gaps),
         f'{topic.longest_lost_s:.3f}' if topic.gaps else '-']
        for topic in content.topics.present
    ]
    if not rows:  # a log, not a bag
        return
    yield from Table(['topic', 'messages', 'rate, Hz', 'seconds', 'gaps', 'longest, s'], rows,
                     range(1, 6)).text()
    if content.topics.absent:
        yield from wrapped(f'missing: {", ".join(content.topics.absent)}', '')


def _flight(content: Content) -> Iterator[str]:
    rate = content.sample_rate_hz or 0.0
    lost = f'{content.lost_pct:.2g} % of the cycles lost'
    if content.longest_gap_s:
        lost += f', the longest gap {content.longest_gap_s:.3f} s'
    yield f'flight    {content.length_s:.1f} s at {rate:.4g} Hz, {lost}'
    if content.motors_at_limit_pct:
        shares = ', '.join(f'{share:.2g}' for share in content.motors_at_limit_pct)
        used = ' outside idle segments' if any(s.role == 'idle' for s in content.segments) else ''
        yield f'motors    at a limit for {shares} % of the time{used}'
    else:
        yield 'motors    not recorded'  # a warning says what is known of mixer and limits
    if content.craft:
        yield from wrapped(content.craft, '          ', first='craft     ')
    for line in content.rotors:
        yield from wrapped(line, '          ', first='rotors    ')
    for pattern in content.layout:
        yield from wrapped(pattern.sentence, '          ')
    if content.battery:
        b = content.battery
        yield f'battery   {b.first:.2f} V to {b.last:.2f} V, lowest {b.lowest:.2f} V'
    else:
        yield 'battery   not measured'
    axes = ', '.join(axis for axis in EVERY if any(
        name.startswith(f'{axis}.') for name in content.gains))
    if 'sensor.gyro_filter_hz' in content.gains:
        axes += ' and the gyro filter'
    yield f'gains     {"of " + axes if axes else "unknown (/gains/active is missing)"}'


def _segments(content: Content) -> Iterator[str]:
    note = ' (the bag names none: split in time)' if content.split else ''
    yield f'segments{note}'
    axes: dict[tuple[str, str, str, float, float, str], list[str]] = {}
    for s in content.segments:  # those of several axes at a time in one line
        ended = str(s.parameters.get('reason', ''))  # why the excitation before it did
        axes.setdefault((s.role, s.signal, s.injection, s.start_s, s.end_s, ended),
                        []).append(s.axis)
    for (role, signal, injection, start_s, end_s, ended), of in [*axes.items()][:MAX_SEGMENTS]:
        every = 'all' if len(of) > 1 and sorted(of) == sorted(AXES) else ', '.join(of)
        yield (f'  {role:<11} {signal:<10} {every:<6} {injection:<9} '
               f'{start_s:8.2f} to {end_s:8.2f} s')
        if ended:
            yield from wrapped(f'the excitation ended: {ended}', '              ')
    if len(axes) > MAX_SEGMENTS:
        yield f'  and {len(axes) - MAX_SEGMENTS} more (--json)'


def _axis(axis: AxisContent) -> Iterator[str]:
    yield (f'{axis.axis}: {axis.train_s:.1f} s to train, {axis.validation_s:.1f} s to validate, '
           f'{axis.windows} windows of 0.5 s')
    if axis.rate_rms is not None and axis.command_rms is not None:
        reference = '' if axis.reference_rms is None else f', reference {axis.reference_rms:.3g}'
        yield f'  RMS: rate {axis.rate_rms:.3g} rad/s, command {axis.command_rms:.3g}{reference}'
    if axis.excitation_order == 0:
        yield '  not excited: the command stands still'
    elif axis.excitation_order is not None:
        band = axis.coherent_band_rad_s
        span = f'{band[0]:.2g} to {band[1]:.3g} rad/s' if band else 'in no band'
        yield (f'  persistently exciting of order {axis.excitation_order}; '
               f'coherent {span}')
    for use in axis.uses:
        yield from _use(use)


def _use(use: Use) -> Iterator[str]:
    mark = 'yes' if use.possible else 'no '
    because = f': {use.because}' if use.because else ''
    yield from wrapped(f'{use.name}{because}', '      ', first=f'  {mark} ')


MARK = '<meta name="generator" content="quad-sysid inspect">'
"""By which a page of this command is recognised, and may be replaced."""
MIDDLE, REACH, DISC = 170.0, 112.0, 40.0
"""Of the drawing: its centre, the longest arm, the largest propeller."""
SIGNS = {1: '+', -1: '−', 0: '0', None: '?'}


def page(content: Content) -> str:
    """The page as text."""
    title = f'What {PurePath(content.source).name} holds'
    body = f'<pre class="scroll">{escape(chr(10).join(lines(content)))}</pre>'
    return document(title, f'<h1>{escape(title)}</h1>', _motors(content.motors),
                    f'<h2>In words</h2>{body}', mark=MARK)


def _motors(motors: tuple[MotorPlace, ...]) -> str:
    if not motors:
        return '<p>The motors are not recorded, so they are not drawn.</p>'
    rows = [[motor.name, motor.place, 'counter-clockwise' if motor.spin > 0 else 'clockwise',
             *(_sign_words(motor, i) for i in range(len(AXES)))] for motor in motors]
    table = Table(['motor', 'is drawn at the', 'turns', *AXES], rows).html()
    return ('<h2>Motors</h2><div class="figures"><figure>' + _drawing(motors) + '<figcaption>Seen '
            'from above, the nose up; the arrow is the sense of the propeller. Below the number: '
            'the sign with which more of the motor turns roll, pitch, yaw by the motion of this '
            'flight; ? where it does not show. Orange: it contradicts the place or the sense, so '
            f'the order or the direction is wrong.</figcaption></figure></div>{table}')


def _sign_words(place: MotorPlace, axis: int) -> str:
    """The sign that the motion shows, and the one that the place asks for where that differs."""
    sign = SIGNS[place.shown[axis]]
    return f'{sign}, should be {SIGNS[place.expected[axis]]}' if _wrong(place, axis) else sign


def _wrong(place: MotorPlace, axis: int) -> bool:
    return place.shown[axis] not in (None, place.expected[axis])


def _drawing(motors: tuple[MotorPlace, ...]) -> str:
    unit = REACH / max(1e-9, *(math.hypot(m.x, m.y) for m in motors))
    centres = [(MIDDLE - unit * m.y, MIDDLE - unit * m.x) for m in motors]
    spacing = min((math.dist(a, b) for i, a in enumerate(centres) for b in centres[:i]),
                  default=2 * DISC)
    disc = min(DISC, max(0.46 * spacing, 0.4 * DISC))
    arms = ''.join(f'<path d="M{MIDDLE} {MIDDLE}L{x:.1f} {y:.1f}" stroke="var(--grid)" '
                   'stroke-width="6"/>' for x, y in centres)
    nose = (f'<path d="M{MIDDLE - 9} {MIDDLE + 8}L{MIDDLE} {MIDDLE - 16}L{MIDDLE + 9} '
            f'{MIDDLE + 8}Z" fill="var(--muted)"/>')
    places = '; '.join(f'{m.name} {m.place}' for m in motors)
    return (f'<svg viewBox="0 0 {2 * MIDDLE:g} {2 * MIDDLE:g}" role="img" '
            f'style="max-width:420px" aria-label="{escape(places)}">{arms}{nose}'
            + ''.join(_motor(m, x, y, disc) for m, (x, y) in zip(motors, centres, strict=True))
            + '</svg>')


def _motor(place: MotorPlace, x: float, y: float, disc: float) -> str:
    wrong = any(_wrong(place, i) for i in range(len(AXES)))
    colour = 'orange' if wrong else 'muted' if None in place.shown else 'green'
    # the arrow's end lies a little before the disc's top, on the side that it comes from
    tip, back = (x - place.spin * 0.5 * disc, y - 0.866 * disc), place.spin * 7.0
    head = (f'M{tip[0] + back:.1f} {tip[1] - 9:.1f}L{tip[0]:.1f} {tip[1]:.1f}'
            f'L{tip[0] + back:.1f} {tip[1] + 5:.1f}')
    signs = ' '.join(SIGNS[sign] for sign in place.shown)
    return (f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{disc:.1f}" fill="var(--card)" '
            f'stroke="var(--{colour})" stroke-width="2.5"/>'
            f'<path d="{head}" fill="none" stroke="var(--{colour})" stroke-width="2.5"/>'
            f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="middle" font-size="17" '
            f'font-weight="600">{escape(place.name.rpartition("_")[2])}</text>'
            f'<text x="{x:.1f}" y="{y + 17:.1f}" text-anchor="middle" font-size="13">{signs}'
            '</text>')
