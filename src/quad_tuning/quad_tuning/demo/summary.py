"""The demo's last words: how both flights followed the square wave, as figures, picture and lines.

Numbers and bags come in, nothing is computed but figures of the square wave and ratios.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from quad_sysid.bags import read_bag
from quad_sysid.contract import AXES, FloatArray
from quad_sysid.errors import NotInformativeError, QuadSysidError
from quad_sysid.loop.figures import EDGE_SHARE, SquareFigures, square_figures
from quad_sysid.record import Record
from quad_sysid.report.canvas import AFTER, BEFORE
from quad_tuning.bounds import ROWS
from quad_tuning.demo.processes import StageFailedError


@dataclass(frozen=True)
class FlownSquare:
    """The square wave of one flight: reference and angle (n,), rad, and the figures."""

    reference: FloatArray
    angle: FloatArray
    dt: float
    figures: SquareFigures


def flown_square(bag: Path, axis: str) -> FlownSquare:
    """The square wave on `axis` in a bag; raises StageFailedError where none is."""
    try:
        record = read_bag(bag)
        reference, angle = square_of(record, axis)
        figures = replace(square_figures(reference, angle, record.dt),
                          rms_error_rad=tracking_error(reference, angle))
    except QuadSysidError as error:
        raise StageFailedError('compare', str(error)) from error
    return FlownSquare(reference, angle, record.dt, figures)


def square_of(record: Record, axis: str) -> tuple[FloatArray, FloatArray]:
    """Reference and angle (n,) in rad over the square segments of `axis`, joined by a NaN.

    Raises StageFailedError where the record lacks the segment, the reference or the angle.
    """
    spans = [record.span(s) for s in record.segments if s.signal == 'square' and s.axis == axis]
    if not spans or record.attitude_setpoint is None or record.angles is None:
        raise StageFailedError(
            'compare', f'{record.source} holds no square wave on {axis} with setpoint and angle'
        )
    column = AXES.index(axis)
    reference, angle = record.attitude_setpoint[:, column], record.angles[:, column]
    return _joined(reference, spans), _joined(angle, spans)


def tracking_error(reference: FloatArray, angle: FloatArray) -> float:
    """RMS of reference - angle (n,), rad, from each square wave's first edge to its last.

    What lies outside, the ramps in and out, is no square wave. Pieces are parted by NaN.
    """
    inside: list[FloatArray] = []
    for piece in np.split(np.arange(reference.size), np.flatnonzero(np.isnan(reference))):
        jump = np.abs(np.diff(reference[piece]))
        edges = np.flatnonzero(jump > EDGE_SHARE * np.ptp(np.nan_to_num(reference[piece])))
        if edges.size > 1:
            inside.append((reference - angle)[piece][edges[0] + 1 : edges[-1] + 1])
    if not inside:
        raise NotInformativeError('square wave: fewer than two edges')
    return float(np.sqrt(np.nanmean(np.concatenate(inside) ** 2)))


def _joined(values: FloatArray, spans: list[tuple[int, int]]) -> FloatArray:
    return np.concatenate([np.append(values[start:stop], np.nan) for start, stop in spans])


def draw_square(path: Path, flights: Mapping[str, FlownSquare]) -> None:
    """Write the angle over the reference of each flight, by its name, as PNG."""
    with mpl.rc_context({'font.size': 10}):
        figure = Figure(figsize=(9.0, 2.8 * len(flights)), layout='constrained')
        FigureCanvasAgg(figure)
        axes = np.atleast_1d(figure.subplots(len(flights), 1, sharex=True, sharey=True))
        colours = (BEFORE, AFTER)
        for ax, (name, one), colour in zip(axes, flights.items(), colours, strict=False):
            time_s = np.arange(one.angle.size) * one.dt
            ax.plot(time_s, np.degrees(one.reference), color='0.5', lw=1.0, label='reference')
            ax.plot(time_s, np.degrees(one.angle), color=colour, lw=1.5, label='measured')
            ax.set_title(name, loc='left')
            ax.set_ylabel('roll angle, deg')
            ax.legend(loc='lower right', bbox_to_anchor=(1.0, 1.0), ncols=2, frameon=False)
            ax.grid(alpha=0.3)
        axes[-1].set_xlabel('time, s')
        figure.savefig(path, dpi=120)


WIDTH = 12


@dataclass(frozen=True)
class FlightSummary:
    """One recorded flight: its length in s, gains in force, its figures."""

    seconds: float
    gains: Mapping[str, float]
    square: SquareFigures


@dataclass(frozen=True)
class Outcome:
    """The content of the summary."""

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
    """Duration of the whole demo."""


def lines(outcome: Outcome) -> list[str]:
    """The summary, one string per line of at most 80 columns (paths may be longer)."""
    old, new = outcome.first.square, outcome.second.square
    return [
        '',
        f'The loop, closed once on the {outcome.axis} axis in {outcome.seconds:.0f} s',
        row('flown', f'{outcome.first.seconds:.0f} s with the old gains, '
            f'{outcome.second.seconds:.0f} s with the new ones'),
        row('undeclared', 'a bearing that sticks and slips (friction_bearing.py)'),
        *_answer_rows(outcome),
        *_gains(outcome),
        row('square wave', f'{"":24s}{"before":>10s}{"after":>10s}'),
        row('', f'{"rise time, s":24s}{old.rise_time_s:10.3f}{new.rise_time_s:10.3f}'),
        row('', f'{"overshoot, %":24s}{old.overshoot_pct:10.1f}{new.overshoot_pct:10.1f}'),
        row('', f'{"RMS tracking error, deg":24s}'
            f'{math.degrees(old.rms_error_rad):10.2f}{math.degrees(new.rms_error_rad):10.2f}'),
        row('results in', f'{outcome.folder}/'),
        *(row('', f'{path.relative_to(outcome.folder)!s:32s} {what}')
          for what, path in outcome.files),
    ]


def _answer_rows(outcome: Outcome) -> list[str]:
    report = outcome.report
    lines = [row('verdict', report['verdict'])]
    for effect in report['effects']:
        lines.append(row('effect', f'{effect["name"]} (probability {effect["probability"]:.2f})'))
        lines += [row('', f'{p["name"]} {p["value"]:.4g} {p["unit"]}')
                  for p in effect['parameters'][:3]]
    error = report['error']
    lines.append(row('error', f'{error["metric"]}, {error["unit"]}'))
    lines.append(row('', before_after('held-out', error)))
    lines.append(row('', before_after('second flight, never seen', outcome.unseen)))
    return lines


def _gains(outcome: Outcome) -> list[str]:
    names = [name
             for name in outcome.second.gains
             if name.startswith(f'{outcome.axis}.') and name.split('.')[-1] in {'kp', 'ki', 'kd'}]
    table = [row('gains', f'{"":16s}{"before":>10s}{"after":>10s}')]
    for name in sorted(names):
        old = outcome.first.gains.get(name, math.nan)
        unit = ROWS[name].unit
        table.append(row('', f'{name:16s}{old:10.4g}{outcome.second.gains[name]:10.4g}  {unit}'))
    table.append(row('', f'in force {outcome.acknowledged_after_s:.1f} s after sending '
                         '(steps, with 3 s of watch between)'))
    return table


def row(label: str, text: str) -> str:
    """One line: a label in its column and the text."""
    return f'{label:{WIDTH}s} {text}'.rstrip()


def before_after(label: str, error: Mapping[str, Any]) -> str:
    """Error before and after with its ratio."""
    before, after = error['before'], error['after']
    ratio = after / before if before else math.nan
    return f'{label}: {before:.4f} before, {after:.4f} after ({ratio:.2f})'
