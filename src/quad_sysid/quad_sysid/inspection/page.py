"""An inspection as one page: the motors drawn in their places, then the text."""

from __future__ import annotations

import math
from html import escape
from pathlib import PurePath

from quad_sysid.contract import AXES
from quad_sysid.inspection.content import Content, MotorPlace
from quad_sysid.inspection.text import lines
from quad_sysid.report.style import document
from quad_sysid.report.tables import Table

MARK = '<meta name="generator" content="quad-sysid inspect">'
"""By which a page of this command is recognised, and may be replaced."""
MIDDLE, REACH, DISC = 170.0, 112.0, 40.0
"""Of the drawing: its centre, the longest arm, the largest propeller."""
SIGNS = {1: '+', -1: '−', 0: '0', None: '?'}


def page(held: Content) -> str:
    """The page as text."""
    title = f'What {PurePath(held.source).name} holds'
    body = f'<pre class="scroll">{escape(chr(10).join(lines(held)))}</pre>'
    return document(title, f'<h1>{escape(title)}</h1>', _motors(held.motors),
                    f'<h2>In words</h2>{body}', mark=MARK)


def _motors(motors: tuple[MotorPlace, ...]) -> str:
    if not motors:
        return '<p>The motors are not recorded, so they are not drawn.</p>'
    rows = [[motor.name, motor.place, 'counter-clockwise' if motor.spin > 0 else 'clockwise',
             *(_shown(motor, i) for i in range(len(AXES)))] for motor in motors]
    table = Table(['motor', 'is drawn at the', 'turns', *AXES], rows).html()
    return ('<h2>Motors</h2><div class="figures"><figure>' + _drawing(motors) + '<figcaption>Seen '
            'from above, the nose up; the arrow is the sense of the propeller. Below the number: '
            'the sign with which more of the motor turns roll, pitch, yaw by the motion of this '
            'flight; ? where it does not show. Orange: it contradicts the place or the sense, so '
            f'the order or the direction is wrong.</figcaption></figure></div>{table}')


def _shown(place: MotorPlace, axis: int) -> str:
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
