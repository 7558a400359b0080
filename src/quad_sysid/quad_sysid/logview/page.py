"""A look as one page: the answer, time series that zoom, pictures, tables. Nothing is loaded."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from functools import partial
from html import escape
from pathlib import PurePath

from quad_sysid.beside import side_by_side
from quad_sysid.contract import AXES
from quad_sysid.logview.measure import DEG, Measured
from quad_sysid.logview.pictures import makers
from quad_sysid.logview.words import header, part_tables, sentences, tables
from quad_sysid.report import zoom
from quad_sysid.report.canvas import Picture, framed
from quad_sysid.report.style import document, script

MARK = '<meta name="generator" content="quad-sysid look">'
"""By which a page of this command is recognised, and may be replaced."""
MOTORS = ('--blue', '--orange', '--green', '--pink', '--sky', '--ink', '--muted', '--grid')
ROLES = {'train': '--blue', 'validation': '--orange'}
PROPOSED = ('<p class="small">Shaded blue: to train, orange: held out, as an identification would '
            'split it.</p>')


def page(look: Measured) -> str:
    """The page as text, at most 2 MB."""
    name = PurePath(look.flown.source).name or look.flown.source
    answer = ''.join(f'<p>{escape(text)}</p>' for text in sentences(look))
    importlib.import_module('matplotlib.backends.backend_svg')  # once, before processes divide
    figures = ''.join(side_by_side([partial(_figure, make, look) for make in makers()]))
    stretches = ''.join(
        f'<h3>{part.stretch.start_s:.1f} to {part.stretch.end_s:.1f} s</h3>'
        + ''.join(table.html() for table in part_tables(part)) for part in look.parts)
    notes = [f'Not in the log: {text}' for text in look.flown.lacks] + list(look.flown.warnings)
    gains = ''.join(f'{escape(n)} {v:.6g}\n' for n, v in sorted(look.whole.stretch.gains.items()))
    return document(
        f'Look at {name}',
        f'<h1>Look at {escape(name)}</h1><p class="small">{escape(header(look))}</p>',
        f'<section class="answer">{answer}</section>',
        f'<h2>Traces</h2>{traces(look)}',
        f'<h2>Pictures</h2><div class="figures">{figures}</div>',
        f'<h2>Figures</h2>{"".join(table.html() for table in tables(look))}',
        f'<h2>By set of gains</h2>{stretches}' if stretches else '',
        f'<h2>Gains in the log</h2><pre>{gains}</pre>' if gains else '',
        '<h2>Notes</h2><ul class="small">' + ''.join(f'<li>{escape(n)}</li>' for n in notes)
        + '</ul>' if notes else '',
        script('zoom.js'), mark=MARK, style=zoom.STYLE)


def _figure(make: Callable[[Measured], Picture | None], look: Measured) -> str:
    figure = make(look)
    return '' if figure is None else framed(figure, figure.name)


def traces(look: Measured) -> str:
    """The time series: each axis with its set-point, motors, rotor speeds, battery."""
    flight = look.flown
    rows = []
    for axis in flight.axes:
        i = AXES.index(axis)
        lines = [zoom.Line('rate', DEG * flight.rates[:, i], '--blue')]
        if flight.rate_setpoint is not None:
            lines.append(zoom.Line('set-point', DEG * flight.rate_setpoint[:, i], '--orange'))
        rows.append(zoom.Row(f'{axis}, deg/s', lines))
    if flight.angles is not None:
        rows.append(zoom.Row('attitude, deg', [
            zoom.Line(axis, DEG * flight.angles[:, AXES.index(axis)], colour)
            for axis, colour in zip(('roll', 'pitch'), ('--blue', '--orange'), strict=True)]))
    for label, values, scale in (('motor commands', flight.motors, 1.0),
                                 ('rotor speeds, 1000 rpm', flight.speeds,
                                  30.0 / math.pi / 1000.0)):
        if values is not None:
            rows.append(zoom.Row(label, [
                zoom.Line(f'{k + 1}', scale * values[:, k], MOTORS[k % len(MOTORS)])
                for k in range(values.shape[1])]))
    if flight.motors is None and flight.control is not None:
        rows.append(zoom.Row('command', [
            zoom.Line(axis, flight.control[:, AXES.index(axis) + 1], colour)
            for axis, colour in zip(AXES, MOTORS, strict=False)]))
    if flight.battery_v is not None:
        rows.append(zoom.Row('battery, V', [zoom.Line('V', flight.battery_v, '--green')]))
    marks = [zoom.Mark(a, b, '--muted') for a, b in flight.gaps]
    marks += [zoom.Mark(p.stretch.start_s, p.stretch.end_s, '--pink') for p in look.parts[1::2]]
    marks += [zoom.Mark(a, b, ROLES[role]) for role, a, b in flight.proposed]
    note = PROPOSED if flight.proposed else ''
    return zoom.group(rows, flight.dt, marks) + note
