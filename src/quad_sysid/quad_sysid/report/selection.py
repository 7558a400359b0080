"""The black-box selection in report.json and on the terminal. No arithmetic."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

from quad_sysid.blackbox import Table2Entry
from quad_sysid.pipeline.answer import LoopRun, ModelRow, Selection, SharedModel

TABLE2_ROW = '{:<17}{:>7}{:>7}  {:>7}{:>7}  {:>7}{:>7}  {}'
POLYNOMIALS = 'ABCDF'


def row_tree(row: ModelRow) -> dict[str, Any]:
    """The entry of `models`: both steps, and why it was eliminated."""
    tree: dict[str, Any] = {
        **row.step_a.as_report(),
        'closed_loop_fit_pct': _number(row.closed_loop_fit_pct),
        'passed_second_step': row.passed_second_step,
        'closed_loop': [_run(run) for run in row.loop_runs],
    }
    because = [tree.pop('eliminated_because'), row.second_step_because]
    if any(because):
        tree['eliminated_because'] = '; '.join(line for line in because if line)
    return tree


def _run(run: LoopRun) -> dict[str, Any]:
    return {
        'bag': run.bag, 'gains_changed': run.gains_changed, 'signals': list(run.signals),
        'fit_pct': _number(run.fit_pct), 'rmse': _number(run.rmse), 'mae': _number(run.mae),
        **({'because': run.because} if run.because else {}),
    }


def selection_tree(selection: Selection) -> dict[str, Any]:
    """What an axis' tree says of how its black-box models were found and chosen."""
    tree: dict[str, Any] = {
        'approaches': [
            {'name': a.name, 'possible': a.possible, 'because': a.because}
            for a in selection.approaches
        ],
        'feedback': selection.feedback,
        'preparation': [
            {'name': c.name, 'kept': c.kept, 'words': c.words} for c in selection.checks
        ],
        'advice': list(selection.advice),
    }
    if selection.table2:
        tree['table2'] = [_entry(entry) for entry in selection.table2]
    if selection.shared is not None:
        tree['roll_and_pitch'] = _shared(selection.shared)
    return tree


def _entry(entry: Table2Entry) -> dict[str, Any]:
    paper = entry.paper
    return {
        'name': paper.name,
        'paper': {'prbs': paper.prbs_pct, 'square': paper.square_pct, 'train': paper.train_pct,
                  'kept': paper.kept},
        'fit_train_pct': entry.row and _number(entry.row.fit_train_pct),
        'fit_validation_pct': {
            name: _number(fit) for name, fit in entry.row.fit_validation_pct.items()
        } if entry.row else {},
        'passed_first_step': bool(entry.row and entry.row.passed_first_step),
        'because': entry.row.eliminated_because if entry.row else entry.refused_because,
    }


def _shared(shared: SharedModel) -> dict[str, Any]:
    model = shared.model
    return {
        'agree': shared.agree,
        'because': shared.because,
        'model': None if model is None else {
            'structure': model.structure, 'orders': dict(model.orders),
            **{name: getattr(model, name).tolist() for name in POLYNOMIALS},
        },
        'fit_validation_pct': {
            axis: _number(fit) for axis, fit in shared.fit_validation_pct.items()
        },
    }


def lines(tree: Mapping[str, Any]) -> list[str]:
    """What the terminal says of an axis' selection below its table of models."""
    out: list[str] = []
    broken = [c for c in tree.get('preparation', []) if c['kept'] is False]
    for title, items in (
        ('data preparation', [f'{c["name"]}: {c["words"]}' for c in broken]),
        ('advice', tree.get('advice', [])),
    ):
        if items:
            out += [title, *(part for item in items for part in _item(item))]
    shared = tree.get('roll_and_pitch')
    if shared:
        text = 'one model for roll and pitch' if shared['agree'] else 'roll and pitch: two models'
        out += _item(f'{text}; {shared["because"]}')
    out += table2_lines(tree.get('table2', []))
    return [*out, ''] if out else []


def table2_lines(entries: list[Mapping[str, Any]]) -> list[str]:
    """Our fits beside the paper's, per cent."""
    if not entries:
        return []
    out = [
        '', 'Table 2: fit in % here and, behind each, in the paper;',
        'train is the one-step fit, the others are free runs',
        TABLE2_ROW.format('model', 'train', '', 'prbs', '', 'square', '', 'first step'),
    ]
    for entry in entries:
        fits, paper = entry['fit_validation_pct'], entry['paper']
        name = entry['name'] + (' *' if paper['kept'] else '')
        out.append(
            TABLE2_ROW.format(
                name, _pct(entry['fit_train_pct']), _pct(paper['train']),
                _pct(fits.get('prbs')), _pct(paper['prbs']),
                _pct(fits.get('square')), _pct(paper['square']),
                'pass' if entry['passed_first_step'] else 'out',
            ).rstrip()
        )
        others = {n: v for n, v in fits.items() if n not in ('prbs', 'square')}
        if others:
            out += _item(', '.join(f'{n} {_pct(v)}' for n, v in others.items()))
        if entry['because']:
            out += _item(entry['because'])
    return [*out, '* kept in the paper']


def _item(text: str, width: int = 76) -> Iterator[str]:
    """Lines of a list's item, its first word behind a dash."""
    line, lead = '', '  - '
    for word in text.split():
        if line and len(line) + len(word) + 1 > width - len(lead):
            yield lead + line
            line, lead = word, '    '
        else:
            line = f'{line} {word}'.strip()
    if line:
        yield lead + line


def _pct(value: float | None) -> str:
    return '-' if value is None else f'{max(value, -999.0):.2f}'


def _number(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)
