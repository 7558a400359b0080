"""The report's tables, from its tree alone, for the page and for a terminal."""

from __future__ import annotations

import re
import textwrap
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from itertools import zip_longest
from typing import Any

from quad_sysid.axes import units_of
from quad_sysid.record import UNNAMED
from quad_sysid.report.words import (
    FIGURES,
    chance,
    estimate,
    figure,
    listed_gains,
    named,
    number,
    target,
    values,
    yes,
)
from quad_sysid.units import unit_and_factor

Tree = Mapping[str, Any]
WIDTH = 78
COLUMNS = 80
"""Most of a table's line."""
WORD = 16
"""A longer word, such as a path, may be broken."""
MODELS = (('before', 'base'), ('after', 'completed'), ('blackbox', 'black box'))
GAIN_UNITS = {'angle_kp': '1/s', 'rate_kp': 's/rad', 'rate_ki': '1/rad', 'rate_kd': 's²/rad',
              'd_filter_hz': 'Hz'}
WIDE = ('outcome', 'because', 'parameters')
"""Columns with sentences."""
UNDETERMINED = '± one standard error, – where the data determine none; <: upper bound at 95 %'
RUNAWAY = 1e3
"""rad/s or m/s: no gyro measures such an error, and no aircraft is as fast."""


@dataclass(frozen=True)
class Table:
    """A table of text; without rows it shows nothing."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    numeric: Collection[int] = ()
    """Columns aligned to the right."""
    marked: int | None = None
    """The highlighted row."""
    caption: str = ''

    def html(self) -> str:
        """The table as HTML, which scrolls by itself on a narrow screen."""
        if not self.rows:
            return ''
        classes = ['n' if i in self.numeric else 'w' if h in WIDE else ''
                   for i, h in enumerate(self.head)]
        top = ''.join(_cell('th', c, h) for c, h in zip(classes, self.head, strict=True))
        body = ''.join(
            f'<tr{" class=sel" if i == self.marked else ""}>'
            + ''.join(_cell('td', c, v) for c, v in zip(classes, row, strict=True)) + '</tr>'
            for i, row in enumerate(self.rows)
        )
        caption = f'<p class="small">{escape(self.caption)}</p>' if self.caption else ''
        return (f'<div class="scroll"><table><thead><tr>{top}</tr></thead>'
                f'<tbody>{body}</tbody></table></div>{caption}')

    def text(self, columns: Sequence[int] | None = None, below: int | None = None, *,
             caption: bool = True) -> list[str]:
        """Lines for a terminal: some columns side by side, another one's sentences below."""
        if not self.rows:
            return []
        columns = [c for c in (columns or range(len(self.head))) if c != below]
        cells = [[line[c] for c in columns] for line in (self.head, *self.rows)]
        widths = _widths(cells, [i for i, c in enumerate(columns) if c not in self.numeric])
        out = []
        for row, line in enumerate(cells, -1):
            wrapped_cells = (textwrap.wrap(cell, width) if len(cell) > width else [cell]
                             for cell, width in zip(line, widths, strict=True))
            for k, parts in enumerate(zip_longest(*wrapped_cells, fillvalue='')):
                padded = (part.rjust(width) if c in self.numeric else part.ljust(width)
                          for part, width, c in zip(parts, widths, columns, strict=True))
                mark = '*' if row == self.marked and not k else ' '
                out.append(mark + '  '.join(padded).rstrip())
            if row >= 0 and below is not None:
                out += wrapped(self.rows[row][below], '    ')
        return out + wrapped(self.caption if caption else '', ' ')


def _widths(cells: Sequence[Sequence[str]], words: Collection[int]) -> list[int]:
    """Widths of the columns: where a line is long heads are broken, then one column of `words`.

    That is the widest of those that can be broken between words; no word of usual length is
    broken, even if the line is longer then.
    """
    columns = [*zip(*cells, strict=True)]
    widths = [max(map(len, column)) for column in columns]
    free = COLUMNS - 1 - 2 * (len(widths) - 1)
    for between in ('(?<=,) ', ' '):  # before a unit, else anywhere
        if sum(widths) > free:
            widths = [max(map(len, (*re.split(between, head), *body))) for head, *body in columns]
    over = sum(widths) - free
    if over > 0 and words:
        longest = [max((len(word) for cell in column for word in cell.split()), default=0)
                   for column in columns]
        widest = max(words, key=lambda i: (longest[i] <= widths[i] - over, widths[i]))
        widths[widest] = max(min(longest[widest], WORD), widths[widest] - over)
    return widths


def _cell(tag: str, name: str, text: str) -> str:
    return f'<{tag}{f" class={name}" if name else ""}>{escape(text)}</{tag}>'


def wrapped(text: str, indent: str = '  ', first: str | None = None) -> list[str]:
    """A sentence in lines for a terminal."""
    return textwrap.wrap(text, WIDTH, initial_indent=indent if first is None else first,
                         subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)


def overview(report: Tree) -> Table:
    """One row per axis."""
    rows = [
        [axis, tree['verdict'], ', '.join(e['name'] for e in tree['effects']) or '–',
         number(tree['error']['before']),
         number(tree['error']['after']) if tree['effects'] else '–',
         'proposed' if tree.get('gains') else 'none']
        for axis, tree in report['axes'].items()
    ]
    units = dict.fromkeys(tree['error']['unit'] for tree in report['axes'].values())
    unit = ' or '.join(units) or 'rad/s'
    return Table(['axis', 'verdict', 'effects', f'before, {unit}', f'after, {unit}', 'gains'],
                 rows, (3, 4))


def aircraft(report: Tree) -> Table:
    """The aircraft as a whole."""
    rows = [[fact['name'].replace('_', ' '), _value(fact) if fact['std'] is not None
             else number(fact['value'], 4), '' if fact['unit'] == '1' else fact['unit'],
             fact['how']] for fact in report.get('aircraft', {}).get('facts', ())]
    return Table(['aircraft', 'value', 'unit', 'how'], rows, (1,))


def errors(tree: Tree) -> Table:
    """The held-out error of everything that predicts."""
    error = tree['error']
    same = error.get('reference') == error.get('after')
    figures = {**error, 'reference': None} if same else error
    rows = [
        [name, number(error.get(key), 4), _span(error.get(f'{key}_interval_95')),
         number(error.get(f'one_step_{key}'), 4) if f'one_step_{key}' in error else '']
        for name, key in (('hold the last value', 'hold_last_value'), ('base (before)', 'before'),
                          ('completed (after)', 'after'),
                          ('best predictor of the training', 'reference'),
                          ('black box', 'blackbox'),
                          ('measurement noise', 'noise_floor'),
                          ('in the loop, base', 'closed_loop_before'),
                          ('in the loop, completed', 'closed_loop_after'))
        if figures.get(key) is not None and (tree['effects'] or 'completed' not in name)
    ]
    windows = f', {error["windows"]} windows' if error.get('windows') else ''
    return Table(['model', 'free run', '95 % interval', 'one step'],
                 rows if error['before'] is not None else [], (1, 2, 3),
                 caption=f'{error["metric"]}, {error["unit"]}, {error["data"]} data{windows}')


def horizons(tree: Tree) -> Table:
    """Errors over the time since the start of a free run."""
    listed = tree['error'].get('horizons') or []
    names = {'hold': 'hold', 'before': 'base', 'after': 'completed', 'blackbox': 'black box'}
    if not tree['effects']:
        names.pop('after')
    rows = [[f'{h["horizon_s"]:g}', *(number(h[c], 4) for c in names)] for h in listed]
    return Table(['after, s', *names.values()], rows, range(len(names) + 1),
                 caption='RMS error so long after the start of a free run, '
                 f'{tree["error"]["unit"]}')


def models(tree: Tree) -> Table:
    """Black-box models with both steps of the selection and why one is out."""
    listed = tree['models']
    signals = list(dict.fromkeys(s for m in listed for s in m['fit_validation_pct']))
    named = ('held-out' if s in UNNAMED else s for s in signals)
    head = ['model', 'approach', 'train, %', *(f'{s}, %' for s in named), 'loop, %', 'AIC',
            'BIC', 'white', 'free of input', 'causal', 'outcome']
    rows = [
        [' '.join([m['structure'], *(str(v) for v in m['orders'].values())]), m['approach'],
         _fit(m['fit_train_pct']), *(_fit(m['fit_validation_pct'].get(s)) for s in signals),
         _fit(m.get('closed_loop_fit_pct')), _whole(m.get('aic')), _whole(m.get('bic')),
         yes(m['residual_white']), yes(m['residual_uncorrelated_with_input']), yes(m['causal']),
         _outcome(m)]
        for m in listed
    ]
    return Table(
        head, rows, range(2, 6 + len(signals)), tree['selected'],
        'Train: one-step fit; signals: free-run fit on held-out segments; loop: simulated closed '
        'loop. Orders as in report.json.',
    )


def _outcome(model: Tree) -> str:
    if model.get('eliminated_because'):
        return f'Rejected at the first step: {model["eliminated_because"]}'
    if model.get('closed_loop_fit_pct') is None:
        return 'Passed the first step; no second step'
    if model.get('passed_second_step'):
        return 'Passed both steps'
    return 'Rejected at the second step: loop fit too low'


def parameters(tree: Tree) -> Table:
    """Base alone and, where effects were added, completed, side by side."""
    base = tree['base']['parameters']
    if not tree['effects']:
        return Table(['parameter', 'base', 'unit'],
                     [[p['name'], _value(p), p['unit']] for p in base], (1,),
                     caption=UNDETERMINED)
    after = {p['name']: p for p in tree.get('completed', {}).get('parameters', [])}
    rows = [[p['name'], _value(p), _value(after.get(p['name'])), p['unit']] for p in base]
    rows += [[f'{e["name"].replace("_", " ")}: {p["name"].replace("_", " ")}', '', _value(p),
              p['unit']] for e in tree['effects'] for p in e['parameters']]
    return Table(['parameter', 'base alone', 'completed', 'unit'], rows, (1, 2),
                 caption=UNDETERMINED)


def effects(tree: Tree) -> Table:
    """The added effects."""
    rows = [
        [e['name'], named(e), values(e), chance(e['p_value']), f'{e["probability"]:.2f}',
         f'{-e["error_reduction_pct"]:+.0f} %']
        for e in tree['effects']
    ]
    return Table(['effect', 'in words', 'parameters', 'p', 'probability', 'change of the error'],
                 rows, (3, 4, 5))


def explanation(tree: Tree) -> Table:
    """The ladder: what each rung adds, and how much of the base's miss it explains."""
    rows, answer, rungs = [], None, tree.get('explanation', ())
    names = added([rung['effects'] for rung in rungs])
    for i, (rung, adds) in enumerate(zip(rungs, names, strict=True)):
        stays = rung['error'] is not None and rung['error'] < RUNAWAY
        rows.append([str(i + 1), adds, f'{rung["explains_pct"]:.0f} %',
                     number(rung['error'], 4) if stays else 'runs away'])
        answer = i if rung.get('answer') and tree['effects'] else answer
    unit = tree['error']['unit']
    claimed = 'No rung is confirmed, and none is claimed as a cause.' if answer is None else (
        'The rungs after the marked one are finer details and not claimed as causes.')
    return Table(['rung', 'adds', 'explains', f'error, {unit}'], rows, (0, 2, 3), answer,
                 'Explains: how much of the difference between the base and the best predictor '
                 'the rung removes in the training; the least of slow, medium and fast motion. '
                 f'The error is of {tree["error"]["data"]} data, where the base alone '
                 f'has {number(tree["error"]["before"], 4)}. {claimed}')


def added(rungs: Sequence[Sequence[str]]) -> list[str]:
    """What each rung of a ladder adds to the one below, by the names of their effects."""
    return [' and '.join(Counter(names) - Counter(below))
            or f'{" and ".join(names)} in another form'
            for below, names in zip([(), *rungs], rungs, strict=False)]


def tried(tree: Tree) -> Table:
    """Every structure that was fitted."""
    rows = [
        [' + '.join(t['effects']) or 'the base alone', number(t['log_evidence_over_base'], 4),
         chance(t['probability']), '' if t['converged'] else 'did not converge']
        for t in tree.get('tried', [])
    ]
    return Table(['structure', 'log evidence over the base', 'probability', ''], rows, (1, 2),
                 caption='Evidence in the training segments alone, prior included.')


def own(tree: Tree) -> Table:
    """Table of the user's own effects: accepted, rejected or not tried."""
    rows = [[item['name'], _became(item)] for item in tree.get('own_effects', [])]
    return Table(['your effect', 'outcome'], rows)


def _became(item: Tree) -> str:
    if item['outcome'] == 'not_tested':
        return f'not tested: {item["because"]}'
    if item['outcome'] == 'added':
        return 'tried and added'
    partners, best = ' + '.join(item['with']), item['best']
    return (
        f'tried and not added: log evidence over the base {number(item["log_evidence_over_base"])}'
        f'{f" (with {partners})" if partners else ""}, where '
        f'{" + ".join(best["effects"]) or "the base alone"} has '
        f'{number(best["log_evidence_over_base"])}'
    )


def untested(tree: Tree) -> Table:
    """Effects that could not be tested, grouped by reason."""
    reasons: dict[str, list[str]] = {}
    for item in tree.get('not_tested', []):
        if not tree.get('reason', '').startswith(item['because']):  # else the verdict says it
            reasons.setdefault(item['because'], []).append(item['name'])
    return Table(['not tested', 'because'], [[_counted(n), why] for why, n in reasons.items()])


def _counted(names: Sequence[str]) -> str:
    """The names, each once; the number of curves where there are many."""
    shapes = {name for name in names if name.startswith('shape:')}
    if len(shapes) < 3:
        return ', '.join(dict.fromkeys(names))
    named = dict.fromkeys(name for name in names if name not in shapes)
    return ', '.join([*named, f'{len(shapes)} curves (shape:…)'])


def gains(tree: Tree, axis: str, active: Mapping[str, float]) -> Table:
    """Gains before and after, then the designer's figures before and after."""
    from quad_sysid.loop.cascade import contract_names  # seconds, which other tables need not

    figures, new, first = tree.get('gain_figures') or {}, target(tree), tree.get('gains') or {}
    units = {name: unit_and_factor(units_of(axis), GAIN_UNITS[field])[0]
             for field, name in contract_names(axis).items() if field in GAIN_UNITS}
    rows = [
        [name, number(figures.get(f'{name}_before', active.get(name)), 4),
         number(new.get(name), 4), unit]
        for name, unit in units.items() if name in new or name in active
    ]
    return Table(['', 'before', 'after', 'unit'], [*rows, *figure_rows(figures, axis)], (1, 2),
                 caption='' if new == first else 'All at once is not safe: send '
                 f'{listed_gains(first)} first, fly, and identify again.')


def figure_rows(figures: Mapping[str, float], axis: str) -> list[list[str]]:
    """A designer's figures of an axis before and after, in the order of reading."""
    rows = []
    for key in FIGURES:
        label, unit, factor = figure(key, axis)
        pair = [figures.get(f'{key}_before'), figures.get(key)]
        if pair != [None, None]:
            rows.append([label, *(number(None if v is None else v * factor) for v in pair), unit])
    return rows


def segments(tree: Tree) -> Table:
    """The segments: when they were flown and how they were used."""
    rows = [
        [f'left out: {s["because"]}' if 'because' in s else s['role'], s['signal'],
         f'{s["start_s"]:.2f}', f'{s["end_s"]:.2f}']
        for s in tree['segments']
    ]
    return Table(['role', 'signal', 'start, s', 'end, s'], rows, (2, 3))


def approaches(tree: Tree) -> Table:
    """The paper's Table 1 on this record: which approach the signals allow."""
    rows = [[a['name'], yes(a['possible']), a['because']] for a in tree.get('approaches', [])]
    feedback = {True: 'The data show feedback from the rate to the command.',
                False: 'The data exclude feedback.',
                None: 'The data neither show nor exclude feedback.'}[tree.get('feedback')]
    return Table(['approach', 'possible', 'because'], rows, caption=feedback)


def residuals(tree: Tree) -> Table:
    """The tests of each model's one-step errors on the held-out data."""
    rows, unit, acceleration = [], tree['error']['unit'], 'rad/s²'
    for key, name in MODELS:
        tests = (tree.get('residual') or {}).get(key)
        if not tests or (key == 'after' and not tree['effects']):
            continue
        torque = tests.get('missing_torque') or {}
        acceleration = torque.get('unit', acceleration)
        rows.append([
            name, number(tests['rms']), f'{yes(tests["white"])} (p {chance(tests["p_white"])})',
            f'{yes(tests["uncorrelated_with_input"])} (p {chance(tests["p_input"])})',
            ', '.join(f'{p["frequency_hz"]:.1f} Hz' for p in tests['peaks'][:3]) or 'none',
            *(number(torque[part]) if torque else '' for part in ('rms', 'expected_rms')),
        ])
    return Table(
        ['model', f'RMS, {unit}', 'white', 'free of past commands', 'peaks',
         f'{"torque" if acceleration[0] in "rd" else "force"}, {acceleration}', 'expected'],
        rows, (1, 5, 6),
        caption='One-step errors on held-out data, tests at 99 %. Torque: RMS of the disturbance '
        "that the model's filter sees; expected: what its own noise model says.",
    )


def _value(p: Tree | None) -> str:
    return '–' if p is None else estimate(p, brief=True)


def _span(interval: Sequence[float] | None) -> str:
    return f'{number(interval[0])} to {number(interval[1])}' if interval else ''


def _fit(value: float | None) -> str:
    return '–' if value is None else '< -99' if value < -99.0 else f'{value:.1f}'


def _whole(value: float | None) -> str:
    return '–' if value is None else f'{value:.0f}'
