"""Pictures of what was measured: signals and segments, coherence. No model."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from quad_sysid.blackbox import coherence
from quad_sysid.contract import FloatArray
from quad_sysid.model.data import AxisData, bridged
from quad_sysid.pipeline.answer import AxisAnswer
from quad_sysid.pipeline.constants import COHERENT
from quad_sysid.report import canvas, zoom
from quad_sysid.report.canvas import Picture
from quad_sysid.units import COMMAND, scale

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TRACES = 350_000
"""Characters that the samples of one axis may take in a page of three."""


def signals(answer: AxisAnswer) -> Picture | None:
    """The whole record with its segments shaded."""
    findings = answer.findings
    if findings is None:
        return None
    data = findings.data
    return Picture(
        'signals', 'Signals and segments',
        'The whole record. Blue stretches train the model, orange ones are held out and were '
        'opened once, at the end; what lies in grey was left out.',
        _traces(answer, data),
    )


def zooming(answer: AxisAnswer) -> str:
    """HTML of the whole record, which zooms, with its segments shaded; '' without data."""
    findings = answer.findings
    if findings is None:
        return ''
    data = findings.data
    rows = []
    for label, measured, reference in _rows(answer, data):
        name = 'command' if label.startswith('command') else 'measured'
        lines = [zoom.Line(name, measured, '--ink')] if measured is not None else []
        lines += [zoom.Line('reference', reference, '--green')] if reference is not None else []
        rows.append(zoom.Row(label, lines))
    marks = [zoom.Mark(start_s, end_s, f'--{canvas.THEMED[colour]}')
             for start_s, end_s, colour, _ in _stretches(answer, data)]
    return zoom.group(rows, data.dt, marks, TRACES)


def _stretches(answer: AxisAnswer, data: AxisData) -> Iterator[tuple[float, float, str, str]]:
    """Begin and end, s, colour and name of what trains, is held out and was left out."""
    for spans, colour, name in ((data.train, canvas.BLUE, 'training'),
                                (data.validation, canvas.ORANGE, 'held out')):
        for a, b in bridged(sorted(spans), data.dt):
            yield a * data.dt, b * data.dt, colour, name
    for segment in answer.segments:
        if segment.axis == answer.axis and segment.parameters.get('because'):
            yield (segment.start_s, segment.end_s, canvas.MUTED,
                   f'left out: {segment.parameters["because"]}')


def _rows(answer: AxisAnswer, data: AxisData,
          ) -> list[tuple[str, FloatArray | None, FloatArray | None]]:
    """Label, signal and reference of what was measured, in the units of the arrays."""
    rows = []
    for name, unit, *signals in (('rate', 'rad/s', data.rate, answer.rate_reference),
                                 ('angle', 'rad', data.angle, answer.attitude_reference),
                                 ('command', COMMAND, data.command, None)):
        of = scale(answer.units, name, unit)
        measured, reference = (None if signal is None else of(signal) for signal in signals)
        if measured is not None or reference is not None:
            rows.append((of.label, measured, reference))
    return rows


def _traces(answer: AxisAnswer, data: AxisData) -> Figure:
    """Stacked panels of rate, angle (where measured) and command with the segments shaded."""
    time_s = np.asarray(np.arange(data.rate.size) * data.dt, dtype=np.float64)
    rows = _rows(answer, data)
    figure, axes = canvas.panels(len(rows), height_in=1.2 + 1.15 * len(rows))
    for number, (panel, (label, measured, reference)) in enumerate(zip(axes, rows, strict=True)):
        labelled: set[str] = set()
        for start_s, end_s, colour, name in _stretches(answer, data):
            canvas.shade(panel, start_s, end_s, colour, '' if name in labelled else name)
            labelled.add(name)
        if reference is not None:
            panel.plot(time_s, reference, color=canvas.GREEN, lw=0.9, label='reference')
        if measured is not None:
            panel.plot(time_s, measured, color=canvas.INK, lw=0.7,
                       label='measured' if number < len(rows) - 1 else 'command')
        panel.set_ylabel(label)
        panel.margins(x=0.0)
    canvas.legend(axes[0])
    axes[-1].set_xlabel('time, s')
    return figure


def coherences(answer: AxisAnswer) -> Picture | None:
    """Squared coherence of the command, and where known the reference, with the rate."""
    train = answer.train
    if train is None:
        return None
    figure, (panel,) = canvas.panels(height_in=2.6)
    w, values = coherence(train)
    panel.semilogx(w, values, color=canvas.AFTER, label='command to rate')
    reference = answer.rate_reference
    if reference is not None and all(
            np.isfinite(reference[a:b]).all() for a, b in train.segments):
        with_reference = replace(train, r=reference)
        w, values = coherence(with_reference, joint=True)
        panel.semilogx(w, values, color=canvas.PINK, ls='--', label='reference to rate')
    panel.axhline(COHERENT, color=canvas.MUTED, lw=0.8, ls=':')
    trusted(panel, answer)
    panel.set_ylim(0.0, 1.02)
    canvas.finish([panel], 'frequency, rad/s', 'squared coherence, 1')
    return Picture(
        'coherence', 'Coherence',
        f'A model can be trusted above {COHERENT:g} (dotted) only; noise, wind and what is not '
        'linear pull the coherence down. Feedback alone makes that of command and rate high: '
        'where the reference is known, its line counts.'
        + trusted_words(answer),
        figure,
    )


def trusted(axes: Axes, answer: AxisAnswer) -> None:
    """Shade the trusted range on an axis of frequencies."""
    band = answer.model.trusted_band_rad_s if answer.model else None
    if band is not None:
        canvas.shade(axes, band[0], band[1], canvas.GREEN)


def trusted_words(answer: AxisAnswer) -> str:
    """A sentence on the meaning of the shading, whose limits the answer states; '' without it."""
    band = answer.model.trusted_band_rad_s if answer.model else None
    return '' if band is None else ' Green: the trusted range.'


DRAWINGS = (
    canvas.Drawing('signals', 'Data', signals),
    canvas.Drawing('coherence', 'Data', coherences),
)
