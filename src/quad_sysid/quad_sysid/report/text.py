"""The answer as plain text for a terminal of 80 columns: the report's tables, and sentences.

Of each axis first the answer (verdict, what was missing, error before and after), the black-box
models last; then the aircraft as a whole, and what several axes warn of.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from quad_sysid.model.identified import Outside
from quad_sysid.report import tables, words
from quad_sysid.report.tables import wrapped


def lines(report: Mapping[str, Any]) -> list[str]:
    """The text that `quad-sysid identify` prints of a report's tree."""
    out: list[str] = []
    count = Counter(warning for tree in report['axes'].values() for warning in tree['warnings'])
    for axis, tree in report['axes'].items():
        parts = [_verdict(tree), tables.errors(tree).text((0, 1, 2)), growth(tree),
                 _details(tree), _gains(axis, tree)]
        parts.append(_list('advice', tree.get('advice', ())))
        parts.append(_list('warnings', [w for w in tree['warnings'] if count[w] == 1]))
        models = tables.models(tree)
        loop, outcome = (models.head.index(name) for name in ('loop, %', 'outcome'))
        columns = [0, 1, *range(2, min(loop, 6)), loop]
        parts.append(models.text(columns, outcome, caption=False))
        out += ['', f'{axis} at {tree["sample_rate_hz"]:g} Hz']
        out += spaced(parts)
    parts = [tables.aircraft(report).text((0, 1, 2)),
             _list('warnings for several axes', [w for w in count if count[w] > 1])]
    return out + spaced(parts)


def spaced(parts: Sequence[Sequence[str]]) -> list[str]:
    """The lines of the parts that are not empty, a blank one before each."""
    return [line for part in parts if part for line in ('', *part)]


def _list(head: str, sentences: Sequence[str]) -> list[str]:
    lines = [line for text in sentences for line in wrapped(text, '    ', '  - ')]
    return [head, *lines] if lines else []


def _verdict(tree: Mapping[str, Any]) -> list[str]:
    out = [f'verdict  {tree["verdict"]}', *wrapped(words.causes(tree))]
    out += wrapped(tree.get('reason', ''))
    out += tables.explanation(tree).text()
    out += tables.effects(tree).text((0, 3, 4, 5))
    for effect in tree['effects']:
        near = ', '.join(f'{r["name"]} {r["probability"]:.2f}' for r in effect['rivals'][:3])
        out += wrapped(f'rivals of {effect["name"]}: {near}') if near else []
    return out


def _details(tree: Mapping[str, Any]) -> list[str]:
    """The model's numbers, and what else became of what was asked."""
    out = tables.parameters(tree).text()
    noise = (f'{p["name"].replace("_", " ")} {p["value"]:.3g} {p["unit"]}'
             for p in tree['base']['noise'])
    out += wrapped(', '.join(noise))
    for name, outcome in tables.own(tree).rows:
        out += wrapped(f'your effect {name}: {outcome}')
    for names, because in tables.untested(tree).rows:
        out += wrapped(f'not tested: {names}: {because}')
    for excess in tree.get('outside', ()):
        out += wrapped(f'held out: {Outside(**excess)}')
    band = tree.get('trusted_band_rad_s')
    return [*out, f'  trusted from {band[0]:.2g} to {band[1]:.3g} rad/s'] if band else out


def growth(tree: Mapping[str, Any]) -> list[str]:
    """Growth of the error, and the horizon up to which the model is useful."""
    text = '' if tree.get('verdict') == 'cannot_tell' else words.horizon_words(tree['error'])
    return [*tables.horizons(tree).text(), *wrapped(text.strip())]


def _gains(axis: str, tree: Mapping[str, Any]) -> list[str]:
    if tree.get('gains'):
        left_out = words.left_out(tree.get('gain_left_out', {}))
        return tables.gains(tree, axis, {}).text() + wrapped(left_out)
    because = tree.get('gains_refused_because')
    return wrapped(f'no gains: {because}', first='') if because else []
