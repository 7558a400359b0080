"""The report's tables as HTML: models, parameters, errors, effects, gains. From the tree alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from quad_sysid.report.words import FIGURES, bound, chance, named, number, parameter

Tree = Mapping[str, Any]


def table(
    head: Sequence[str], rows: Sequence[Sequence[str]], numeric: Sequence[int] = (),
    marked: int | None = None, caption: str = '',
) -> str:
    """A table that scrolls by itself where the screen is narrow; `marked` row stands out."""
    if not rows:
        return ''
    wide = ('outcome', 'because', 'parameters')
    classes = ['n' if i in numeric else 'w' if h in wide else '' for i, h in enumerate(head)]
    top = ''.join(_cell('th', c, h) for c, h in zip(classes, head, strict=True))
    body = ''.join(
        f'<tr{" class=sel" if i == marked else ""}>'
        + ''.join(_cell('td', c, v) for c, v in zip(classes, row, strict=True)) + '</tr>'
        for i, row in enumerate(rows)
    )
    words = f'<p class="small">{escape(caption)}</p>' if caption else ''
    return (f'<div class="scroll"><table><thead><tr>{top}</tr></thead>'
            f'<tbody>{body}</tbody></table></div>{words}')


def _cell(tag: str, name: str, text: str) -> str:
    return f'<{tag}{f" class={name}" if name else ""}>{escape(text)}</{tag}>'


def overview(report: Tree) -> str:
    """One row per axis."""
    rows = []
    for axis, tree in report['axes'].items():
        error = tree['error']
        names = ', '.join(e['name'] for e in tree['effects']) or '–'
        gains = 'proposed' if tree.get('gains') else 'none'
        rows.append([axis, tree['verdict'], names, number(error['before']),
                     number(error['after']) if tree['effects'] else '–', gains])
    return table(['axis', 'verdict', 'effects', 'before, rad/s', 'after, rad/s', 'gains'], rows,
                 (3, 4))


def errors(tree: Tree) -> str:
    """The held-out error of everything that predicts."""
    error = tree['error']
    if error['before'] is None:
        return ''
    rows = [
        ['hold the last value', number(error.get('hold_last_value')), '', ''],
        ['base (before)', number(error['before']), _span(error.get('before_interval_95')),
         number(error.get('one_step_before'))],
        ['completed (after)', number(error['after']), _span(error.get('after_interval_95')),
         number(error.get('one_step_after'))],
        ['black box', number(error.get('blackbox')), '', ''],
        ['measurement noise', number(error.get('noise_floor')), '', ''],
        ['in the loop, base', number(error.get('closed_loop_before')), '', ''],
        ['in the loop, completed', number(error.get('closed_loop_after')), '', ''],
    ]
    if not tree['effects']:
        rows = [row for row in rows if 'completed' not in row[0]]
    rows = [row for row in rows if row[1] != '–']
    windows = f', {error["windows"]} windows' if error.get('windows') else ''
    caption = f'{error["metric"]}, {error["unit"]}, {error["data"]} data{windows}'
    return table(['model', 'free run', '95 % interval', 'one step'], rows, (1, 2, 3),
                 caption=caption)


def horizons(tree: Tree) -> str:
    """How the error grows with the time since the start of a free run."""
    listed = tree['error'].get('horizons') or []
    columns = ['hold', 'before', *(['after'] if tree['effects'] else []), 'blackbox']
    names = {'hold': 'hold the last value', 'before': 'base', 'after': 'completed',
             'blackbox': 'black box'}
    rows = [[f'{h["horizon_s"]:g}', *(number(h[c]) for c in columns)] for h in listed]
    return table(['after, s', *(names[c] for c in columns)], rows, range(len(columns) + 1),
                 caption='RMS error so long after the start of a free run, rad/s')


def models(tree: Tree) -> str:
    """Black-box models with both steps of the selection and why one is out."""
    listed = tree['models']
    if not listed:
        return ''
    signals = list(dict.fromkeys(s for m in listed for s in m['fit_validation_pct']))
    head = ['model', 'approach', 'train, %', *(f'{s}, %' for s in signals), 'loop, %', 'AIC',
            'BIC', 'white', 'free of input', 'causal', 'outcome']
    rows = [
        [
            ' '.join([m['structure'], *(str(v) for v in m['orders'].values())]), m['approach'],
            _fit(m['fit_train_pct']), *(_fit(m['fit_validation_pct'].get(s)) for s in signals),
            _fit(m.get('closed_loop_fit_pct')), _whole(m.get('aic')), _whole(m.get('bic')),
            _yes(m['residual_white']), _yes(m['residual_uncorrelated_with_input']),
            _yes(m['causal']), _outcome(m, chosen=i == tree['selected']),
        ]
        for i, m in enumerate(listed)
    ]
    n = len(signals)
    return table(
        head, rows, tuple(range(2, 6 + n)), tree['selected'],
        'Train: one-step fit; signals: free-run fit on held-out segments; loop: simulated closed '
        'loop. Orders as in report.json.',
    )


def _outcome(model: Tree, *, chosen: bool) -> str:
    start = 'selected. ' if chosen else ''
    because = model.get('eliminated_because')
    if because:
        return f'{start}Out at the first step: {because}'
    if model.get('passed_second_step'):
        return f'{start}Passed both steps'
    if model.get('closed_loop_fit_pct') is None:
        return f'{start}Passed the first step; no loop to fly it in'
    return f'{start}Out at the second step: loop fit too low'


def parameters(tree: Tree) -> str:
    """Base alone and, where effects were added, completed, side by side."""
    if not tree['effects']:
        alone = [[p['name'], _value(p), p['unit']] for p in tree['base']['parameters']]
        return table(['parameter', 'base', 'unit'], alone, (1,), caption='± one standard error')
    after = {p['name']: p for p in tree.get('completed', {}).get('parameters', [])}
    rows = [
        [p['name'], _value(p), _value(after.get(p['name'])), p['unit']]
        for p in tree['base']['parameters']
    ]
    rows += [
        [f'{e["name"]}: {p["name"]}', '', _value(p), p['unit']]
        for e in tree['effects'] for p in e['parameters']
    ]
    return table(['parameter', 'base alone', 'completed', 'unit'], rows, (1, 2),
                 caption='± one standard error')


def effects(tree: Tree) -> str:
    """What was added."""
    rows = [
        [e['name'], named(e['name']),
         'a curve, drawn below' if e['kind'] == 'shape'
         else '; '.join(parameter(p) for p in e['parameters']),
         chance(e['p_value']), f'{e["probability"]:.2f}', f'{e["error_reduction_pct"]:.0f} %']
        for e in tree['effects']
    ]
    return table(['effect', 'in words', 'parameters', 'p', 'probability', 'lowers the error by'],
                 rows, (3, 4, 5))


def tried(tree: Tree) -> str:
    """Every structure that was fitted, and what could not be tested."""
    fitted = [
        [' + '.join(t['effects']) or 'the base alone', number(t['log_evidence_over_base'], 4),
         chance(t['probability']), '' if t['converged'] else 'did not converge']
        for t in tree.get('tried', [])
    ]
    untested = [[t['name'], t['because']] for t in tree.get('not_tested', [])]
    head = ['structure', 'log evidence over the base', 'probability', '']
    return (table(head, fitted, (1, 2), caption='Of the training segments alone, prior included.')
            + table(['not tested', 'because'], untested))


def gains(tree: Tree, axis: str, active: Mapping[str, float]) -> str:
    """Gains before and after, then the designer's figures before and after."""
    figures = tree.get('gain_figures') or {}
    new = tree.get('gains') or {}
    names = [f'{axis}.{n}' for n in ('angle.kp', 'rate.kp', 'rate.ki', 'rate.kd')]
    units = ('1/s', 'norm. per rad/s', 'norm. per rad', 'norm. per rad/s²')
    rows = [
        [name, number(figures.get(f'{name}_before', active.get(name)), 4),
         number(new.get(name), 4), unit]
        for name, unit in zip(names, units, strict=True)
        if name in new or name in active
    ]
    for key, (label, unit, factor) in FIGURES.items():
        old, value = figures.get(f'{key}_before'), figures.get(key)
        if old is not None or value is not None:
            rows.append([label, *(number(None if v is None else v * factor)
                                  for v in (old, value)), unit])
    return table(['', 'before', 'after', 'unit'], rows, (1, 2))


def segments(tree: Tree) -> str:
    """When what was flown, and for what it was used."""
    rows = [
        [f'left out: {s["because"]}' if 'because' in s else s['role'], s['signal'],
         f'{s["start_s"]:.2f}', f'{s["end_s"]:.2f}']
        for s in tree['segments']
    ]
    return table(['role', 'signal', 'start, s', 'end, s'], rows, (2, 3))


def _value(p: Tree | None) -> str:
    if p is None:
        return '–'
    return f'{p["value"]:.4g}' + (f' ± {p["std"]:.2g}' if p.get('std') is not None else bound(p))


def _span(interval: Sequence[float] | None) -> str:
    return f'{number(interval[0])} to {number(interval[1])}' if interval else ''


def _fit(value: float | None) -> str:
    return '–' if value is None else f'{max(value, -999.0):.1f}'


def _whole(value: float | None) -> str:
    return '–' if value is None else f'{value:.0f}'


def _yes(value: bool) -> str:
    return 'yes' if value else 'no'


MODELS = (('before', 'base'), ('after', 'completed'), ('blackbox', 'black box'))


def approaches(tree: Tree) -> str:
    """The paper's Table 1 on this record: which approach the signals allow."""
    rows = [
        [a['name'], 'yes' if a['possible'] else 'no', a['because']]
        for a in tree.get('approaches', [])
    ]
    feedback = tree.get('feedback')
    told = {True: 'The data show feedback from the rate to the command.',
            False: 'The data exclude feedback.',
            None: 'The data neither show nor exclude feedback.'}[feedback]
    return table(['approach', 'possible', 'because'], rows, caption=told)


def table2(tree: Tree) -> str:
    """Our fits beside the paper's; empty where they were not asked for."""
    rows = []
    for entry in tree.get('table2', []):
        paper, fits = entry['paper'], entry['fit_validation_pct']
        name = entry['name'] + (' *' if paper['kept'] else '')
        rows.append([
            name, _pct(entry['fit_train_pct']), _pct(paper['train']), _pct(fits.get('prbs')),
            _pct(paper['prbs']), _pct(fits.get('square')), _pct(paper['square']),
            entry['because'] or 'passed the first step',
        ])
    return table(
        ['model', 'train, %', 'paper', 'prbs, %', 'paper', 'square, %', 'paper', 'outcome'],
        rows, (1, 2, 3, 4, 5, 6), None,
        'Train: one-step fit; prbs and square: free run on held-out segments. * kept in the '
        'paper.',
    )


def shared(tree: Tree) -> str:
    """Whether roll and pitch share one model."""
    found = tree.get('roll_and_pitch')
    if not found:
        return ''
    told = (
        'One model serves roll and pitch' if found['agree'] else 'Roll and pitch need two models'
    )
    fits = ', '.join(
        f'{axis} {_pct(fit)} %' for axis, fit in found['fit_validation_pct'].items()
        if fit is not None
    )
    more = f' Its free-run fit: {fits}.' if fits else ''
    return f'<p>{escape(told)}: {escape(found["because"])}.{escape(more)}</p>'


def residuals(tree: Tree) -> str:
    """The tests of each model's one-step errors on the held-out data."""
    rows = []
    for key, name in MODELS:
        found = (tree.get('residual') or {}).get(key)
        if not found or (key == 'after' and not tree['effects']):
            continue
        peaks = ', '.join(f'{p["frequency_hz"]:.1f} Hz' for p in found['peaks'][:3])
        torque = found.get('missing_torque')
        rows.append([
            name, number(found['rms']), _test(found['white'], found['p_white']),
            _test(found['uncorrelated_with_input'], found['p_input']), peaks or 'none',
            '' if torque is None else number(torque['rms']),
            '' if torque is None else number(torque['expected_rms']),
        ])
    return table(
        ['model', 'RMS, rad/s', 'white', 'free of past commands', 'peaks',
         'torque, rad/s²', 'expected'], rows, (1, 5, 6),
        caption='One-step errors on held-out data, tests at 99 %. Torque: RMS of the disturbance '
        "that the model's filter sees; expected: what its own noise model says.",
    )


def _test(passed: bool, p: float | None) -> str:
    return f'{"yes" if passed else "no"} (p {chance(p)})'


def _pct(value: float | None) -> str:
    return '–' if value is None else f'{max(value, -999.0):.1f}'
