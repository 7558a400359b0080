"""report.html: one self-contained page from the report's tree and the answers behind it.

The words come from words.py, the tables from tables.py, the pictures from plots.py; here they are
put in the order of reading. No scripts, no links to other files or hosts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import PurePath
from typing import Any

from quad_sysid.pipeline.answer import AxisAnswer
from quad_sysid.report import selection_tables, tables, words
from quad_sysid.report.canvas import Picture, svg
from quad_sysid.report.plots import Gallery, gallery
from quad_sysid.report.style import SHEET

DATA = ('signals', 'signals_detail', 'spectra', 'coherence')
MODELS = ('residual_test', 'bode')
PREDICTION = ('free_run', 'horizon', 'one_step')
EFFECTS = ('effect_shape', 'left_out', 'rivals')
LEFT = ('correlations', 'residual_spectrum', 'missing_torque')
LOOP = ('closed_loop', 'step', 'margins')


def page(
    report: Mapping[str, Any], answers: Mapping[str, AxisAnswer],
    galleries: Mapping[str, Gallery] | None = None,
) -> str:
    """The page as text; `galleries` by axis where they are drawn already."""
    drawn = galleries if galleries is not None else {a: gallery(one) for a, one in answers.items()}
    axes = report['axes']
    bags = ', '.join(PurePath(bag).name for bag in report['bags'])
    parts = [
        '<!doctype html><html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width,initial-scale=1">',
        f'<title>Identification of {escape(bags)}</title><style>{SHEET}</style></head><body>',
        f'<h1>Identification of {escape(bags)}</h1>',
    ]
    if len(axes) > 1:
        links = ''.join(
            f'<a href="#{a}"><span class="axis">{escape(a)}</span> in detail</a>' for a in axes
        )
        parts += [tables.overview(report), f'<nav>{links}</nav>']
    parts += [_answer(axis, tree) for axis, tree in axes.items()]
    parts += [
        _axis(axis, tree, answers.get(axis), drawn.get(axis, Gallery({})))
        for axis, tree in axes.items()
    ]
    parts.append(_footer(report['bags']))
    return '\n'.join([*parts, '</body></html>\n'])


def _answer(axis: str, tree: Mapping[str, Any]) -> str:
    """What a reader wants first."""
    style, line = words.headline(tree)
    told = ''.join(
        f'<h3>{escape(question)}</h3><p>{escape(answer)}</p>'
        for question, answer in words.story(axis, tree)
    )
    return (
        f'<section class="answer {style}"><h2><span class="axis">{escape(axis)}</span>: '
        f'{escape(line)}</h2>{_tiles(tree)}{told}</section>'
    )


def _tiles(tree: Mapping[str, Any]) -> str:
    error = tree['error']
    if error['before'] is None:
        return ''
    unit = error['unit']
    tiles = [('error of the base', f'{words.number(error["before"])} {unit}')]
    if tree['verdict'] == 'effects_added':
        tiles.append(('error completed', f'{words.number(error["after"])} {unit}'))
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


def _axis(
    axis: str, tree: Mapping[str, Any], answer: AxisAnswer | None, drawn: Gallery
) -> str:
    """All of one axis behind its answer."""
    model = answer.model if answer is not None else None
    active = model.active_gains if model is not None else {}
    shown = drawn.pictures

    def figures(names: Sequence[str]) -> str:
        found = ''.join(_figure(axis, shown[name]) for name in names if name in shown)
        return f'<div class="figures">{found}</div>' if found else ''

    sections = [
        ('Data', _fold('Segments', tables.segments(tree)) + figures(DATA)),
        ('Prediction on held-out data', tables.errors(tree) + tables.horizons(tree)
         + figures(PREDICTION)),
        ('What the base lacks', tables.effects(tree) + tables.parameters(tree)
         + figures(EFFECTS) + _fold('All that was tried', tables.tried(tree))),
        ('What is left', selection_tables.residuals(tree) + figures(LEFT)),
        ('Black-box models', tables.models(tree) + selection_tables.shared(tree)
         + figures(MODELS) + selection_tables.approaches(tree)
         + _fold("Beside the paper's Table 2", selection_tables.table2(tree))),
        ('Advice', _notes([
            *tree.get('advice', []),
            *(f'{c["name"]}: {c["words"]}' for c in tree.get('preparation', [])
              if c['kept'] is False),
        ])),
        ('Loop and gains', tables.gains(tree, axis, active) + figures(LOOP)),
        ('Warnings', _notes([
            *tree.get('warnings', []),
            *(f'picture {name} could not be drawn: {why}' for name, why in drawn.failed),
        ])),
    ]
    body = ''.join(f'<h3>{title}</h3>{content}' for title, content in sections if content)
    rate = f'{tree["sample_rate_hz"]:g} Hz'
    return (f'<section id="{escape(axis)}"><h2><span class="axis">{escape(axis)}</span> in detail '
            f'<span class="small">{rate}</span></h2>{body}</section>')


def _figure(axis: str, picture: Picture) -> str:
    return (
        f'<figure id="{axis}-{picture.name}"><h4>{escape(picture.title)}</h4>'
        f'{svg(picture, axis)}<figcaption>{escape(picture.caption)}</figcaption></figure>'
    )


def _fold(title: str, content: str) -> str:
    return f'<details><summary>{title}</summary>{content}</details>' if content else ''


def _notes(lines: Sequence[str]) -> str:
    items = ''.join(f'<li>{escape(line)}</li>' for line in lines)
    return f'<ul class="small">{items}</ul>' if items else ''


def _footer(bags: Sequence[str]) -> str:
    sources = ', '.join(bags)
    return (f'<p class="small">Fits and choices used the training segments alone; the held-out '
            f'ones were opened once. Numbers in full: report.json; the model: model.json. '
            f'Source: {escape(sources)}</p>')
