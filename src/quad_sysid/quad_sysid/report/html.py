"""report.html and a notebook's cell: their style, and tables and pictures in order of reading."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import PurePath
from typing import Any

from quad_sysid.model import AxisModel, Parameter
from quad_sysid.pipeline.answer import AxisAnswer
from quad_sysid.report import tables, words
from quad_sysid.report.canvas import Picture, embedded, svg
from quad_sysid.report.plots import Gallery, draw, gallery

LIGHT = """--paper:#ffffff;--card:#f6f8fa;--line:#d5dae0;--ink:#1b1f24;
--muted:#5f6b78;--grid:#d5dae0;--blue:#0072b2;--orange:#d55e00;--green:#009e73;--sky:#56b4e9;--pink:#cc79a7;"""
DARK = """--paper:#12161b;--card:#1a2027;--line:#333c46;--ink:#e8ecf0;
--muted:#9aa7b4;--grid:#2b333c;--blue:#56b4e9;--orange:#f08a3c;--green:#2fbf95;--sky:#9bd4f5;--pink:#e0a3c4;"""

SHEET = (
    ':root{color-scheme:light dark;--font:system-ui,-apple-system,"Segoe UI",Roboto,'
    '"DejaVu Sans",sans-serif;' + LIGHT + '}'
    '@media (prefers-color-scheme:dark){:root{' + DARK + '}}'
    """
*{box-sizing:border-box}
body{margin:0 auto;max-width:1120px;padding:16px;background:var(--paper);color:var(--ink);
font:16px/1.5 var(--font)}
h1{font-size:1.5rem;margin:.2em 0}h2{font-size:1.3rem;margin:1.8em 0 .4em;
border-top:1px solid var(--line);padding-top:.8em}h3{font-size:1.08rem;margin:1.4em 0 .4em}
h4{font-size:.95rem;margin:0 0 .3em}p{margin:.4em 0}
a{color:var(--blue)}nav{margin:.6em 0}nav a{margin-right:1em}
.small,figcaption{color:var(--muted);font-size:.85rem}
.answer{background:var(--card);border:1px solid var(--line);border-left:6px solid var(--muted);
border-radius:8px;padding:12px 16px;margin:14px 0}
.answer.found{border-left-color:var(--blue)}.answer.good{border-left-color:var(--green)}
.answer.open{border-left-color:var(--orange)}
.answer h2{border:0;margin:0 0 .3em;padding:0}.axis{display:inline-block;text-transform:capitalize}
.answer h3{font-size:.95rem;margin:.8em 0 0}.answer p{overflow-wrap:anywhere}
.tiles{display:grid;grid-template-columns:repeat(auto-fit,minmax(130px,1fr));gap:8px;margin:10px 0}
.tile{background:var(--paper);border:1px solid var(--line);border-radius:6px;padding:6px 10px}
.tile b{display:block;font-size:1.08rem}.tile span{color:var(--muted);font-size:.8rem}
.figures{columns:2 400px;column-gap:16px;margin-top:.8em}
figure{margin:0 0 16px;break-inside:avoid;padding:10px;
border:1px solid var(--line);border-radius:8px;min-width:0}
figure svg{display:block;width:100%;height:auto}figure svg text{fill:var(--ink)}
.scroll{overflow-x:auto;margin:.6em 0}
table{border-collapse:collapse;font-size:.88rem}
th,td{text-align:left;padding:4px 10px 4px 0;border-bottom:1px solid var(--line);
vertical-align:top}
th{font-weight:600;color:var(--muted);white-space:nowrap}
.n{text-align:right;white-space:nowrap;font-variant-numeric:tabular-nums}
td:first-child{min-width:7em}td.w{min-width:17em}tr.sel td:first-child{font-weight:700}
tr.sel td{background:var(--card)}details{margin:.6em 0}summary{cursor:pointer}
@media (max-width:520px){body{padding:10px}figure{padding:6px}.answer{padding:10px}}
@media print{:root{"""
    + LIGHT
    + """}body{max-width:none;font-size:11pt;padding:0}nav{display:none}
figure,.answer,tr{break-inside:avoid}h2,h3,h4{break-after:avoid}
.figures{columns:2}.scroll{overflow:visible}table{font-size:8.5pt}}
"""
)


DATA = ('signals', 'coherence')
MODELS = ('bode',)
PREDICTION = ('free_run', 'horizon')
EFFECTS = ('effect_shape', 'left_out', 'rivals')
LEFT = ('correlations', 'residual_spectrum', 'missing_torque')
LOOP = ('closed_loop', 'step', 'margins')
SHOWN = ('effect_shape', 'missing_torque', 'free_run', 'signals')
"""Picture of a notebook's cell: the first of these that exists."""
CELL = """.quad .tiles{display:flex;flex-wrap:wrap;gap:8px}
.quad .tile{border:1px solid #8886;border-radius:6px;padding:4px 10px}
.quad .tile span{display:block;opacity:.75;font-size:.85em}.quad .scroll{overflow-x:auto}
.quad .small{opacity:.75;font-size:.9em}.quad img{max-width:100%}.quad summary{cursor:pointer}"""
"""Style of a notebook's cell: no colours of its own, so that it suits light and dark."""


def page(report: Mapping[str, Any], answers: Mapping[str, AxisAnswer],
         galleries: Mapping[str, Gallery] | None = None) -> str:
    """The page as text; `galleries` by axis where they are drawn already."""
    drawn = galleries if galleries is not None else {a: gallery(one) for a, one in answers.items()}
    axes = report['axes']
    bags = ', '.join(PurePath(bag).name for bag in report['bags'])
    parts = ['<!doctype html><html lang="en"><head><meta charset="utf-8">',
             '<meta name="viewport" content="width=device-width,initial-scale=1">',
             f'<title>Identification of {escape(bags)}</title><style>{SHEET}</style></head><body>',
             f'<h1>Identification of {escape(bags)}</h1>']
    if len(axes) > 1:
        links = ''.join(
            f'<a href="#{a}"><span class="axis">{escape(a)}</span> in detail</a>' for a in axes
        )
        parts += [tables.overview(report).html(), f'<nav>{links}</nav>']
    parts += [_answer(axis, tree) for axis, tree in axes.items()]
    parts += [_axis(axis, tree, answers.get(axis), drawn.get(axis, Gallery({})))
              for axis, tree in axes.items()]
    sources = escape(', '.join(report['bags']))
    parts.append(
        '<p class="small">Every parameter was fitted to the training segments alone; the held-out '
        'ones were opened once. Numbers in full: report.json; the model: model.json. '
        f'Source: {sources}</p>'
    )
    return '\n'.join([*parts, '</body></html>\n'])


def excerpt(report: Mapping[str, Any], answers: Mapping[str, AxisAnswer], text: str) -> str:
    """What a notebook shows of a result: answer, tables and one picture an axis; `text` folded."""
    parts = [f'<style>{CELL}</style><div class="quad">']
    for axis, tree in report['axes'].items():
        drawn = (draw(answers[axis], name) for name in SHOWN)
        picture = next((one for one in drawn if one is not None), None)
        parts += [_answer(axis, tree), tables.explanation(tree).html(),
                  tables.effects(tree).html(), tables.parameters(tree).html(),
                  tables.errors(tree).html(), '' if picture is None else embedded(picture, axis)]
    parts.append(f'{_fold("All in words", f"<pre>{escape(text)}</pre>")}</div>')
    return ''.join(parts)


def model_excerpt(model: AxisModel, parameters: Mapping[str, Parameter]) -> str:
    """What a notebook shows of a model: its ladder, and its parameters as they are handed in."""
    rungs = [(' and '.join(e.name for e in rung.effects),
              {'explains_pct': rung.explains_pct, 'answer': len(rung.effects) ==
               len(model.effects)}) for rung in model.rungs]
    rows = [[name, words.number(p.value, 4), words.number(p.std), p.unit]
            for name, p in parameters.items()]
    table = tables.Table(['parameter', 'value', 'std. error', 'unit'], rows, (1, 2))
    return (f'<style>{CELL}</style><div class="quad"><p>{escape(repr(model).splitlines()[0])}</p>'
            f'{bars(rungs)}{table.html()}</div>')


def _answer(axis: str, tree: Mapping[str, Any]) -> str:
    """The answer, which the page begins with."""
    style, line = words.headline(tree)
    told = ''.join(f'<h3>{escape(question)}</h3><p>{escape(answer)}</p>'
                   for question, answer in words.story(axis, tree))
    return (f'<section class="answer {style}"><h2><span class="axis">{escape(axis)}</span>: '
            f'{escape(line)}</h2>{_ladder(tree)}{_tiles(tree)}{told}</section>')


def _ladder(tree: Mapping[str, Any]) -> str:
    """The causes in a sentence, and a bar for each rung of the explanation."""
    sentence, rungs = words.causes(tree), tree.get('explanation', ())
    if not sentence:
        return ''
    named = zip(tables.explanation(tree).rows, rungs, strict=True)
    return f'<p><b>{escape(sentence)}</b></p>{bars([(row[1], rung) for row, rung in named])}'


def bars(rungs: Sequence[tuple[str, Mapping[str, Any]]]) -> str:
    """A bar for each rung of a ladder, with its name."""
    drawn, shown = [], 0.0
    for name, rung in rungs:
        share = max(0.0, min(100.0, rung['explains_pct']))
        style = 'opacity:1' if not shown or rung.get('answer') else 'opacity:.45'
        drawn.append(
            f'<div class="small">{escape(name)}: {share:.0f} %</div>'
            f'<div style="height:.6em;border:1px solid #8886;margin:.1em 0 .5em">'
            f'<div style="height:100%;width:{share:.1f}%;background:currentColor;{style}"></div>'
            '</div>'
        )
        shown = share
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
        far = words.reach(error)
        tiles.append(('halves the error up to', 'nowhere' if far is None else f'{far:g} s'))
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
    shown = drawn.pictures

    def figures(names: Sequence[str]) -> str:
        found = ''.join(figure(axis, shown[name]) for name in names if name in shown)
        return f'<div class="figures">{found}</div>' if found else ''

    sections = [
        ('Data', _fold('Segments', tables.segments(tree).html()) + figures(DATA)),
        ('Prediction on held-out data', tables.errors(tree).html() + tables.horizons(tree).html()
         + figures(PREDICTION)),
        ('What the base lacks', tables.explanation(tree).html() + tables.effects(tree).html()
         + tables.own(tree).html()
         + tables.parameters(tree).html()
         + figures(EFFECTS) + _fold('Everything that was tried',
                              tables.tried(tree).html() + tables.untested(tree).html())),
        ('What is left', tables.residuals(tree).html() + figures(LEFT)),
        ('Black-box models', tables.models(tree).html() + figures(MODELS)
         + tables.approaches(tree).html()),
        ('Advice', _notes(tree.get('advice', ()))),
        ('Loop and gains', tables.gains(tree, axis, active).html() + figures(LOOP)),
        ('Warnings', _notes([
            *tree.get('warnings', []),
            *(f'picture {name} could not be drawn: {why}' for name, why in drawn.failed),
        ])),
    ]
    body = ''.join(f'<h3>{title}</h3>{content}' for title, content in sections if content)
    rate = f'{tree["sample_rate_hz"]:g} Hz'
    return (f'<section id="{escape(axis)}"><h2><span class="axis">{escape(axis)}</span> in detail '
            f'<span class="small">{rate}</span></h2>{body}</section>')


def figure(axis: str, picture: Picture) -> str:
    """A picture with its title and its caption."""
    return (f'<figure id="{axis}-{picture.name}"><h4>{escape(picture.title)}</h4>'
            f'{svg(picture, axis)}<figcaption>{escape(picture.caption)}</figcaption></figure>')


def _fold(title: str, content: str) -> str:
    return f'<details><summary>{title}</summary>{content}</details>' if content else ''


def _notes(lines: Sequence[str]) -> str:
    items = ''.join(f'<li>{escape(line)}</li>' for line in lines)
    return f'<ul class="small">{items}</ul>' if items else ''
