"""report.html and a notebook's cell: their style, and tables and pictures in order of reading."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import PurePath
from typing import Any

from quad_sysid.model import AxisModel, Parameter
from quad_sysid.pipeline.answer import AxisAnswer
from quad_sysid.report import sliders, tables, words, zoom
from quad_sysid.report.canvas import embedded, framed
from quad_sysid.report.next_flight import next_flight
from quad_sysid.report.plots import PICTURES, Gallery, draw
from quad_sysid.report.plots_data import zooming
from quad_sysid.report.style import document, script
from quad_sysid.whole import URDF

PREFERRED = ('effect_shape', 'missing_torque', 'free_run', 'signals')
"""Picture of a notebook's cell: the first of these that exists."""
COPY = """<script>document.querySelectorAll('[data-copy]').forEach(b => { b.onclick = () => {
const pre = b.parentElement.querySelector('pre'), done = () => { b.textContent = 'copied'; };
if (navigator.clipboard && window.isSecureContext)
  navigator.clipboard.writeText(pre.textContent).then(done);
else { getSelection().selectAllChildren(pre); document.execCommand('copy'); done(); }
}; });</script>"""
"""What the buttons of `copied` do."""
CELL = """.quad .tiles{display:flex;flex-wrap:wrap;gap:8px}
.quad .tile{border:1px solid #8886;border-radius:6px;padding:4px 10px}
.quad .tile span{display:block;opacity:.75;font-size:.85em}.quad .scroll{overflow-x:auto}
.quad .small{opacity:.75;font-size:.9em}.quad img{max-width:100%}.quad summary{cursor:pointer}"""
"""Style of a notebook's cell: no colours of its own, so that it suits light and dark."""


def page(report: Mapping[str, Any], answers: Mapping[str, AxisAnswer],
         drawn: Mapping[str, Gallery]) -> str:
    """The page as text; `drawn`: the pictures by axis."""
    axes = report['axes']
    bags = ', '.join(PurePath(bag).name or bag for bag in report['bags'])
    parts = [f'<h1>Identification of {escape(bags)}</h1>']
    if len(axes) > 1:
        links = ''.join(
            f'<a href="#{a}"><span class="axis">{escape(a)}</span> in detail</a>' for a in axes
        )
        parts += [tables.overview(report).html(), f'<nav>{links}</nav>']
    parts += [_answer(axis, tree) for axis, tree in axes.items()]
    if report.get('aircraft', {}).get('facts'):
        parts.append(tables.aircraft(report).html())
        if urdf := report['aircraft']['urdf']:
            parts.append(f'<details><summary>URDF of it ({URDF})</summary><pre>'
                         f'{escape(urdf)}</pre></details>')
    parts += [_axis(axis, tree, answers.get(axis), drawn.get(axis, Gallery({})))
              for axis, tree in axes.items()]
    sources = escape(', '.join(report['bags']))
    parts.append(
        '<p class="small">Every parameter was fitted to the training segments alone; the held-out '
        'ones were opened once. Numbers in full: report.json; the model: model.json. '
        f'Source: {sources}</p>'
    )
    return document(f'Identification of {bags}', *parts, script('zoom.js'),
                    script('sliders.js'), COPY, style=zoom.STYLE + sliders.STYLE)


def excerpt(report: Mapping[str, Any], answers: Mapping[str, AxisAnswer], text: str) -> str:
    """A result in a notebook: answer, tables and one picture per axis; `text` folded."""
    parts = [f'<style>{CELL}</style><div class="quad">']
    for axis, tree in report['axes'].items():
        drawn = (draw(answers[axis], name) for name in PREFERRED)
        picture = next((picture for picture in drawn if picture is not None), None)
        parts += [_answer(axis, tree), tables.explanation(tree).html(),
                  tables.effects(tree).html(), tables.parameters(tree).html(),
                  tables.errors(tree).html(), '' if picture is None else embedded(picture, axis)]
    parts.append(f'{_fold("All in words", f"<pre>{escape(text)}</pre>")}</div>')
    return ''.join(parts)


def model_excerpt(model: AxisModel, parameters: Mapping[str, Parameter]) -> str:
    """A model in a notebook: its ladder, and the `parameters` passed."""
    names = tables.added([[effect.name for effect in rung.effects] for rung in model.rungs])
    rungs = [(name, {'explains_pct': rung.explains_pct, 'answer': model.is_rung(rung)})
             for name, rung in zip(names, model.rungs, strict=True)]
    rows = [[name, words.number(p.value, 4), words.number(p.std), p.unit]
            for name, p in parameters.items()]
    table = tables.Table(['parameter', 'value', 'std. error', 'unit'], rows, (1, 2))
    return (f'<style>{CELL}</style><div class="quad"><p>{escape(repr(model).splitlines()[0])}</p>'
            f'{bars(rungs)}{table.html()}</div>')


def _answer(axis: str, tree: Mapping[str, Any]) -> str:
    """The answer, which the page begins with."""
    style, line = words.headline(tree)
    story = ''.join(f'<h3>{escape(question)}</h3><p>{escape(answer)}</p>'
                    for question, answer in words.story(axis, tree))
    return (f'<section class="answer {style}"><h2><span class="axis">{escape(axis)}</span>: '
            f'{escape(line)}</h2>{_ladder(tree)}{_tiles(tree)}{story}</section>')


def _ladder(tree: Mapping[str, Any]) -> str:
    """The causes in a sentence, and a bar for each rung of the explanation."""
    sentence, rungs = words.causes(tree), tree.get('explanation', ())
    if not sentence:
        return ''
    named = zip(tables.explanation(tree).rows, rungs, strict=True)
    return f'<p><b>{escape(sentence)}</b></p>{bars([(row[1], rung) for row, rung in named])}'


def bars(rungs: Sequence[tuple[str, Mapping[str, Any]]]) -> str:
    """A bar for each rung of a ladder, with its name."""
    drawn, total = [], 0.0
    for name, rung in rungs:
        share = max(0.0, min(100.0, rung['explains_pct']))
        style = 'opacity:1' if not total or rung.get('answer') else 'opacity:.45'
        drawn.append(
            f'<div class="small">{escape(name)}: {share:.0f} %</div>'
            f'<div style="height:.6em;border:1px solid #8886;margin:.1em 0 .5em">'
            f'<div style="height:100%;width:{share:.1f}%;background:currentColor;{style}"></div>'
            '</div>'
        )
        total = share
    return ''.join(drawn)


def _tiles(tree: Mapping[str, Any]) -> str:
    error = tree['error']
    if error['before'] is None:
        return ''
    unit = error['unit']
    tiles = [('error of the base', f'{words.number(error["before"])} {unit}')]
    if tree['verdict'] == 'effects_added':
        tiles.append(('error completed', f'{words.number(error["after"])} {unit}'))
    if tree['verdict'] != 'cannot_tell':
        reach_s = words.reach(error)
        tiles.append(('halves the error up to',
                      'nowhere' if reach_s is None else f'{reach_s:g} s'))
    tiles.append(('measurement noise', f'{words.number(error["noise_floor"])} {unit}'))
    figures = tree.get('gain_figures') or {}
    old, new = figures.get('rise_time_s_before'), figures.get('rise_time_s')
    if old is not None and new is not None:
        tiles.append(('rise time', f'{words.number(old)} → {words.number(new)} s'))
    return '<div class="tiles">' + ''.join(
        f'<div class="tile"><span>{escape(name)}</span><b>{escape(value)}</b></div>'
        for name, value in tiles
    ) + '</div>'


def _axis(axis: str, tree: Mapping[str, Any], answer: AxisAnswer | None, drawn: Gallery) -> str:
    """All details of one axis."""
    model = answer.model if answer is not None else None
    active = model.active_gains if model is not None else {}
    pictures = drawn.pictures

    def figures(section: str, *but: str) -> str:
        names = [picture.name for picture in PICTURES
                 if picture.section == section and picture.name not in but]
        parts = ''.join(framed(pictures[name], f'{axis}-{name}')
                        for name in names if name in pictures)
        return f'<div class="figures">{parts}</div>' if parts else ''

    traces = ''
    if answer is not None and 'signals' in pictures and (zooms := zooming(answer)):
        traces = framed(pictures['signals'], f'{axis}-signals', zooms)
    sections = [
        ('Data', traces + _fold('Segments', tables.segments(tree).html()) + figures(
            'Data', *(['signals'] if traces else []))),
        ('Prediction on held-out data', tables.errors(tree).html() + tables.horizons(tree).html()
         + figures('Prediction on held-out data')),
        ('What the base lacks', tables.explanation(tree).html() + tables.effects(tree).html()
         + tables.own(tree).html() + tables.parameters(tree).html()
         + figures('What the base lacks')
         + _fold('Everything that was tried',
                 tables.tried(tree).html() + tables.untested(tree).html())),
        ('What is left', tables.residuals(tree).html() + figures('What is left')),
        ('Black-box models', tables.models(tree).html() + figures('Black-box models')
         + tables.approaches(tree).html()),
        ('Next flight', _next(axis, tree)),
        ('Advice', _notes(tree.get('advice', ()))),
        ('Loop and gains', tables.gains(tree, axis, active).html()
         + copied(gain_lines(tree.get('gains') or active)) + figures('Loop and gains')),
        ('Gains to try', '' if model is None else sliders.sliders(model, tree.get('gains') or {})),
        ('Warnings', _notes([
            *tree.get('warnings', []),
            *(f'picture {name} could not be drawn: {why}' for name, why in drawn.failed),
        ])),
    ]
    body = ''.join(f'<h3>{title}</h3>{content}' for title, content in sections if content)
    rate = f'{tree["sample_rate_hz"]:g} Hz'
    return (f'<section id="{escape(axis)}"><h2><span class="axis">{escape(axis)}</span> in detail '
            f'<span class="small">{rate}</span></h2>{body}</section>')


def gain_lines(gains: Mapping[str, float]) -> str:
    """Gains as lines of YAML, to copy into a parameter file."""
    return '\n'.join(f'{name}: {value:.6g}' for name, value in sorted(gains.items()))


def copied(text: str) -> str:
    """A block of text with a button that copies it; nothing for an empty one."""
    if not text:
        return ''
    return ('<div class="copy"><button type="button" data-copy>copy</button>'
            f'<pre tabindex="0">{escape(text)}</pre></div>')


def _next(axis: str, tree: Mapping[str, Any]) -> str:
    """What to fly next, and why."""
    rows = next_flight(axis, tree)
    items = ''.join(f'<li>{escape(row.why)}' + copied(row.command) + '</li>' for row in rows)
    return f'<ul>{items}</ul>' if items else ''


def _fold(title: str, content: str) -> str:
    return f'<details><summary>{title}</summary>{content}</details>' if content else ''


def _notes(lines: Sequence[str]) -> str:
    items = ''.join(f'<li>{escape(line)}</li>' for line in lines)
    return f'<ul class="small">{items}</ul>' if items else ''
