"""The answer as plain text for a terminal of 80 columns. Strings only."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from quad_sysid.report import document, words

ROW = '{:<22} {:>7} {:>9} {:>9} {:>7}  {}'


def lines(report: Mapping[str, Any]) -> list[str]:
    """What `quad-sysid identify` prints of a report's tree."""
    out: list[str] = []
    for axis, tree in report['axes'].items():
        out += ['', f'{axis} at {tree["sample_rate_hz"]:g} Hz', '']
        out += _models(tree)
        out += document.lines(tree)
        out += _verdict(tree)
        out += _errors(tree)
        out += _gains(tree)
    return out


def brief(report: Mapping[str, Any]) -> list[str]:
    """Two lines per axis, for several flights one below the other."""
    out = []
    for axis, tree in report['axes'].items():
        error = tree['error']
        effects = ', '.join(e['name'] for e in tree['effects'])
        out.append(f'  {axis}: {tree["verdict"]}{": " + effects if effects else ""}')
        if error['before'] is not None:
            after = f' -> {error["after"]:.4g}' if tree['effects'] else ''
            out.append(f'    error {error["before"]:.4g}{after} {error["unit"]}')
        else:
            out += ['  ' + line for line in _wrapped(tree.get('reason', ''), 74)]
    return out


def _models(tree: Mapping[str, Any]) -> list[str]:
    if not tree['models']:
        return []
    signals = list(dict.fromkeys(s for m in tree['models'] for s in m['fit_validation_pct']))
    out = [ROW.format('model', 'train', *(_clip(s) for s in [*signals, '', ''][:2]), 'loop',
                      'first step')]
    for index, model in enumerate(tree['models']):
        name = f'{model["structure"]} ' + ' '.join(str(v) for v in model['orders'].values())
        if model['approach'] != 'direct':
            name += f' {model["approach"]}'
        mark = '*' if index == tree['selected'] else ' '
        fits = [_pct(model['fit_validation_pct'].get(s)) for s in signals]
        out.append(
            ROW.format(
                mark + name, _pct(model['fit_train_pct']), *[*fits, '', ''][:2],
                _pct(model.get('closed_loop_fit_pct')),
                'pass' if model['passed_first_step'] else 'out',
            )
        )
        because = model.get('eliminated_because')
        if because:
            out += [f'  {line}' for part in because.split('; ') for line in _wrapped(part, 74)]
    return [*out, '']


def _verdict(tree: Mapping[str, Any]) -> list[str]:
    out = [f'verdict  {tree["verdict"]}', *_wrapped(tree.get('reason', ''))]
    out += ['  base   ' + _number(parameter) for parameter in tree['base']['parameters']]
    out += [
        f'  noise  {p["name"].replace("_", " ")} {p["value"]:.3g} {p["unit"]}'
        for p in tree['base']['noise']
    ]
    for effect in tree['effects']:
        variant = f' ({effect["variant"]})' if 'variant' in effect else ''
        out += [
            f'  effect {effect["name"]}{variant}',
            (f'         p = {effect["p_value"]:.2g}, probability {effect["probability"]:.2f}, '
             f'it lowers the error by {effect["error_reduction_pct"]:.0f} %'),
        ]
        out += ['         ' + _number(p) for p in effect['parameters']]
        for rival in effect['rivals'][:3]:
            out.append(f'         rival {rival["name"]} {rival["probability"]:.2f}')
    untested = tree.get('not_tested', [])
    reasons: dict[str, list[str]] = {}
    for item in untested:
        reasons.setdefault(item['because'], []).append(item['name'])
    for because, names in reasons.items():
        out += _wrapped(f'not tested: {", ".join(dict.fromkeys(names))}: {because}')
    band = tree.get('trusted_band_rad_s')
    if band:
        out.append(f'  trusted from {band[0]:.2g} to {band[1]:.3g} rad/s')
    return out


def _errors(tree: Mapping[str, Any]) -> list[str]:
    error = tree['error']
    if error['before'] is None:
        return []
    out = ['', f'error on {error["data"]} data, {error["unit"]},', f'{error["metric"]}']
    pairs = [
        ('base (before)', error['before'], error.get('before_interval_95')),
        ('completed (after)', error['after'] if tree['effects'] else None,
         error.get('after_interval_95')),
        ('black box', error.get('blackbox'), None),
        ('measurement noise', error['noise_floor'], None),
        ('hold the last value', error.get('hold_last_value'), None),
    ]
    for name, value, interval in pairs:
        if value is not None:
            span = f'  [{interval[0]:.4g}, {interval[1]:.4g}]' if interval else ''
            out.append(f'  {name:<20} {value:.4g}{span}')
    return [*out, *horizons(error, completed=bool(tree['effects']))]


def horizons(error: Mapping[str, Any], *, completed: bool) -> list[str]:
    """How the error grows, and up to where the model is worth something."""
    listed = error.get('horizons', [])
    if not listed:
        return []
    columns = ['hold', 'before', *(['after'] if completed else []), 'blackbox']
    columns = [c for c in columns if any(h[c] is not None for h in listed)]
    out = ['', f'error so long after the start, {error["unit"]}',
           '  ' + ''.join(f'{c:>10}' for c in ['s', *columns])]
    for h in listed:
        cells = ['–' if h[c] is None else f'{h[c]:.4g}' for c in columns]
        out.append('  ' + ''.join(f'{c:>10}' for c in [f'{h["horizon_s"]:g}', *cells]))
    return [*out, *_wrapped(words.horizon_words(error))]


def _gains(tree: Mapping[str, Any]) -> list[str]:
    if tree.get('gains'):
        return ['', 'gains', *(f'  {k:<16} {v:.6g}' for k, v in tree['gains'].items())]
    because = tree.get('gains_refused_because')
    return ['', *_wrapped(f'no gains: {because}')] if because else []


def _number(parameter: Mapping[str, Any]) -> str:
    std = parameter['std']
    error = f'± {std:.2g}' if std is not None else words.bound(parameter).strip()
    return f'{parameter["name"]} {parameter["value"]:.4g} {error} {parameter["unit"]}'


def _pct(value: float | None) -> str:
    return '-' if value is None else f'{max(value, -999.0):.2f}'


def _clip(text: str) -> str:
    return text[:9]


def _wrapped(text: str, width: int = 76) -> list[str]:
    out, line = [], ''
    for word in text.split():
        if line and len(line) + len(word) + 1 > width:
            out.append('  ' + line)
            line = word
        else:
            line = f'{line} {word}'.strip()
    return [*out, '  ' + line] if line else out
