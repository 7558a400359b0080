"""Several logs over one another: what was measured of each, as one table and one page."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from html import escape
from pathlib import PurePath
from typing import TYPE_CHECKING

import numpy as np

from quad_sysid.contract import AXES, FloatArray
from quad_sysid.logview.measure import DEG, AxisLook, Measured
from quad_sysid.logview.page import MARK
from quad_sysid.report import canvas, zoom
from quad_sysid.report.canvas import Picture
from quad_sysid.report.style import document, script
from quad_sysid.report.tables import Table
from quad_sysid.report.words import number

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST = len(canvas.LINES)


def names(looks: Sequence[Measured]) -> list[str]:
    """A short name for each log, with a number where two have the same."""
    short = [PurePath(look.flown.source).name or look.flown.source for look in looks]
    return [f'{name} ({k + 1})' if short.count(name) > 1 else name for k, name in enumerate(short)]


def figures(looks: Sequence[Measured]) -> Table:
    """A row for each axis and log."""
    rows = []
    for axis in _axes(looks):
        for name, look in zip(names(looks), looks, strict=True):
            on_axis = look.whole.axes.get(axis)
            if on_axis is not None:
                rows.append([axis, name, *_row(on_axis)])
    return Table(['axis', 'flight', 'rise, ms', 'overshoot, %', 'settling, ms', 'crossover, Hz',
                  'phase margin, °', 'noise, deg/s'], rows, range(2, 8))


def _row(on_axis: AxisLook) -> list[str]:
    step, loop = on_axis.rate_step, on_axis.loop
    values = [math.nan] * 5
    if step is not None:
        f = step.figures
        values[:3] = [1e3 * f.rise_time_s, f.overshoot_pct, 1e3 * f.settling_time_s]
    if loop is not None:
        values[3:] = [loop.crossover_hz, loop.phase_margin_deg]
    noise = on_axis.noise_rms
    values.append(math.nan if noise is None else DEG * noise)
    return [number(value if math.isfinite(value) else None) for value in values]


def page(looks: Sequence[Measured]) -> str:
    """The page as text: the table, traces from the take-off on, pictures."""
    title = ', '.join(names(looks))
    drawn = ''.join(canvas.framed(look, look.name) for look in pictures(looks))
    return document(
        f'Look at {title}',
        f'<h1>Look at {len(looks)} flights</h1><p class="small">{escape(title)}</p>',
        figures(looks).html(), f'<h2>Traces</h2>{_traces(looks)}',
        f'<h2>Pictures</h2><div class="figures">{drawn}</div>', script('zoom.js'),
        mark=MARK, style=zoom.STYLE)


def pictures(looks: Sequence[Measured]) -> list[Picture]:
    """Step responses, gyro spectra and tracking, a line for each log."""
    def step(axes: Axes, on_axis: AxisLook, colour: str, name: str) -> None:
        if on_axis.rate_step is not None:
            axes.plot(on_axis.rate_step.time_s, on_axis.rate_step.mean, color=colour, label=name)

    def spectrum(axes: Axes, on_axis: AxisLook, colour: str, name: str) -> None:
        if on_axis.gyro is not None:
            axes.loglog(on_axis.gyro.frequency_hz[1:], DEG * np.sqrt(np.maximum(
                on_axis.gyro.mean[1:], 1e-30)), color=colour, label=name)

    def tracking(axes: Axes, on_axis: AxisLook, colour: str, name: str) -> None:
        if on_axis.loop is not None and np.isfinite(on_axis.loop.tracking).any():
            axes.loglog(on_axis.loop.frequency_hz, np.abs(on_axis.loop.tracking), color=colour,
                        label=name)

    return [
        _picture(looks, 'step_rate', 'Step response of the rate', 'time after the step, s', '1',
                 step),
        _picture(looks, 'spectra', 'Gyro spectra', 'frequency, Hz', 'deg/s/√Hz', spectrum),
        _picture(looks, 'tracking', 'Rate over set-point', 'frequency, Hz', '1', tracking),
    ]


def _picture(looks: Sequence[Measured], name: str, title: str, x: str, unit: str,
             draw: Callable[[Axes, AxisLook, str, str], None]) -> Picture:
    axes = _axes(looks)
    figure, drawn = canvas.panels(len(axes), height_in=0.7 + 1.6 * len(axes))
    for panel, axis in zip(drawn, axes, strict=True):
        for look, colour, label in zip(looks, canvas.LINES, names(looks), strict=False):
            if axis in look.whole.axes:
                # no formula between dollars, nor a label with _ before it, which is not shown
                draw(panel, look.whole.axes[axis], colour, f' {label}'.replace('$', r'\$'))
    canvas.finish(drawn, x, *(f'{axis}, {unit}' for axis in axes))
    canvas.plain_logarithms(drawn)
    return Picture(name, title, 'One line for each flight.', figure)


def _axes(looks: Sequence[Measured]) -> list[str]:
    return [axis for axis in AXES if any(axis in look.whole.axes for look in looks)]


def _traces(looks: Sequence[Measured]) -> str:
    """The rates of each axis from the take-off on, on the slowest grid."""
    dt = max(look.flown.dt for look in looks)
    takeoffs = [int(np.argmax(look.flown.flying)) for look in looks]
    length = max((look.flown.n - a) * look.flown.dt
                 for look, a in zip(looks, takeoffs, strict=True))
    times = np.arange(math.ceil(length / dt)) * dt

    def drawn(look: Measured, first: int, i: int) -> FloatArray:
        rates = look.flown.rates[first:, i]
        index = np.rint(times / look.flown.dt).astype(np.int64)
        inside = index < len(rates)
        return np.where(inside, DEG * rates[np.where(inside, index, 0)], np.nan)

    rows = [zoom.Row(f'{axis}, deg/s', [
        zoom.Line(name, drawn(look, first, AXES.index(axis)), f'--{canvas.THEMED[colour]}')
        for look, first, colour, name in zip(looks, takeoffs, canvas.LINES, names(looks),
                                             strict=False)])
        for axis in _axes(looks)]
    return zoom.group(rows, dt)
