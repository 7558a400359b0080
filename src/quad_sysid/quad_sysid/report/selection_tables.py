"""The report's tables of the black-box selection and of the residual tests, as HTML.

Approaches, the paper's Table 2, one model for roll and pitch; from the tree alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import Any

from quad_sysid.report.tables import table
from quad_sysid.report.words import chance, number

Tree = Mapping[str, Any]
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
