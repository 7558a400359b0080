"""The demo's last words: some 25 lines from the report and the figures of both flights.

Text only: numbers come in, nothing is computed but ratios, nothing is read or printed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from quad_sysid.loop.figures import SquareFigures
from quad_tuning.bounds import BOUNDS

WIDTH = 12


@dataclass(frozen=True)
class FlightSummary:
    """One recorded flight: its bag, its length in s, gains in force, its figures."""

    bag: Path
    seconds: float
    gains: Mapping[str, float]
    square: SquareFigures


@dataclass(frozen=True)
class Outcome:
    """All that the summary tells."""

    axis: str
    first: FlightSummary
    second: FlightSummary
    report: Mapping[str, Any]
    """The axis' part of report.json."""
    unseen: Mapping[str, Any]
    """Error figures of the stored model on the second flight (`quad-sysid evaluate`)."""
    acknowledged_after_s: float
    folder: Path
    files: Sequence[tuple[str, Path]]
    seconds: float
    """Of the whole demo."""


def lines(outcome: Outcome) -> list[str]:
    """The summary, one string per line of at most 80 columns (paths may be longer)."""
    return [
        *_flown(outcome),
        *_found(outcome),
        *_gains(outcome),
        *_worth(outcome),
        *_where(outcome),
    ]


def _flown(outcome: Outcome) -> list[str]:
    return [
        '',
        f'The loop, closed once on the {outcome.axis} axis in {outcome.seconds:.0f} s',
        row('flown', f'{outcome.first.seconds:.0f} s with the old gains, '
                     f'{outcome.second.seconds:.0f} s with the new ones'),
        row('undeclared', 'a bearing that sticks and slips (friction_bearing.py)'),
    ]  # fmt: skip


def _found(outcome: Outcome) -> list[str]:
    report = outcome.report
    base = [number(p) for p in report['base']['parameters']]
    found = [row('base model', ', '.join(base[:2]))]
    found += [row('', ', '.join(base[k : k + 2])) for k in range(2, len(base), 2)]
    found.append(row('verdict', report['verdict']))
    for effect in report['effects']:
        found.append(row('effect', f'{effect["name"]} (probability {effect["probability"]:.2f})'))
        found += [row('', number(p)) for p in effect['parameters'][:3]]
    error = report['error']
    found.append(row('error', f'{error["metric"]}, {error["unit"]}'))
    found.append(row('', before_after('held-out', error)))
    found.append(row('', before_after('second flight, never seen', outcome.unseen)))
    return found


def _gains(outcome: Outcome) -> list[str]:
    shown = [
        name
        for name in outcome.second.gains
        if name.startswith(f'{outcome.axis}.') and name.split('.')[-1] in {'kp', 'ki', 'kd'}
    ]
    table = [row('gains', f'{"":16s}{"before":>10s}{"after":>10s}')]
    for name in sorted(shown):
        old = outcome.first.gains.get(name, math.nan)
        unit = BOUNDS[name.partition('.')[2]].unit
        table.append(row('', f'{name:16s}{old:10.4g}{outcome.second.gains[name]:10.4g}  {unit}'))
    table.append(
        row('', f'acknowledged {1000 * outcome.acknowledged_after_s:.0f} ms after sending')
    )
    return table


def _worth(outcome: Outcome) -> list[str]:
    old, new = outcome.first.square, outcome.second.square
    return [
        row('square wave', f'{"":24s}{"before":>10s}{"after":>10s}'),
        row('', f'{"rise time, s":24s}{old.rise_time_s:10.3f}{new.rise_time_s:10.3f}'),
        row('', f'{"overshoot, %":24s}{old.overshoot_pct:10.1f}{new.overshoot_pct:10.1f}'),
        row('', f'{"RMS tracking error, deg":24s}'
                f'{math.degrees(old.rms_error_rad):10.2f}{math.degrees(new.rms_error_rad):10.2f}'),
    ]  # fmt: skip


def _where(outcome: Outcome) -> list[str]:
    return [row('results in', f'{outcome.folder}/')] + [
        row('', f'{path.relative_to(outcome.folder)!s:32s} {what}') for what, path in outcome.files
    ]


def row(label: str, text: str) -> str:
    """One line: a label in its column and the text."""
    return f'{label:{WIDTH}s} {text}'.rstrip()


def number(parameter: Mapping[str, Any]) -> str:
    """`gain 12.3 ± 0.4 rad/s²`; without a standard error where there is none."""
    std = parameter.get('std')
    spread = f' ± {std:.1g}' if isinstance(std, float | int) and math.isfinite(std) else ''
    unit = '' if parameter.get('unit') in {None, '', '1'} else f' {parameter["unit"]}'
    return f'{parameter["name"]} {parameter["value"]:.4g}{spread}{unit}'


def before_after(label: str, error: Mapping[str, Any]) -> str:
    """Error before and after with its ratio."""
    before, after = error['before'], error['after']
    ratio = after / before if before else math.nan
    return f'{label}: {before:.4f} before, {after:.4f} after ({ratio:.2f})'
