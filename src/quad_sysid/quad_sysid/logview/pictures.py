"""The pictures of a look, by matplotlib: steps, spectra, maps over time and throttle, loop."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.logview.measure import DEG, Measured, Part
from quad_sysid.logview.spectrum import LOWEST_PEAK_HZ, ORDERS, THROTTLE, Frames
from quad_sysid.report import canvas
from quad_sysid.report.canvas import Picture

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS = {'all': canvas.INK, 'small': canvas.SKY, 'medium': canvas.BLUE, 'large': canvas.ORANGE}
MOST_PIXELS = 300
"""Columns and rows of a map."""
RANGE_DB = 50.0  # of a map: what is fainter is the gyro's own noise


def pictures(look: Measured) -> tuple[Picture, ...]:
    """All that the log allows, in the order of reading."""
    return tuple(one for make in makers() if (one := make(look)) is not None)


def makers() -> tuple[Callable[[Measured], Picture | None], ...]:
    """The functions that draw a picture each, or return None where the log does not allow it."""
    return (partial(steps, quantity='rate'), partial(steps, quantity='angle'), by_gains, spectra,
            throttle_map, time_map, orders, loop)


def draw(look: Measured, name: str) -> Picture:
    """One picture by its name; raises BadInputError where the log does not allow it."""
    by_name = {picture.name: picture for picture in pictures(look)}
    if name not in by_name:
        raise BadInputError('look', 'has no such picture', name, f'it has {", ".join(by_name)}')
    return by_name[name]


def steps(look: Measured, quantity: str) -> Picture | None:
    """The step response of each axis, by amplitude."""
    axes = {axis: [s for s in on_axis.steps if s.quantity == quantity]
            for axis, on_axis in look.whole.axes.items()}
    axes = {axis: responses for axis, responses in axes.items() if responses}
    if not axes:
        return None
    figure, drawn = canvas.panels(len(axes), height_in=0.7 + 1.6 * len(axes))
    for panel, responses in zip(drawn, axes.values(), strict=True):
        panel.axhline(1.0, color=canvas.MUTED, linewidth=0.8, linestyle=':')
        for s in responses:
            colour = COLOURS[s.amplitude]
            if s.amplitude == 'all':
                panel.fill_between(s.time_s, s.low, s.high, color=canvas.MUTED, alpha=0.25,
                                   linewidth=0)
            panel.plot(s.time_s, s.mean, color=colour, label=s.amplitude,
                       linewidth=1.6 if s.amplitude == 'all' else 1.0)
        panel.set_ylim(min(-0.1, *(float(s.mean.min()) for s in responses)),
                       max(1.5, *(1.05 * float(s.mean.max()) for s in responses)))
    canvas.finish(drawn, 'time after the step, s', *(f'{axis}, 1' for axis in axes))
    return Picture(
        f'step_{quantity}', f'Step response of the {quantity}',
        'Response to a unit step of the set-point, by regularised deconvolution. '
        'Grey: the spread between windows (16 to 84 %). Colours: windows whose largest set-point '
        'is small, medium, large (table).', figure)


def by_gains(look: Measured) -> Picture | None:
    """The rate's step response of each set of gains."""
    axes = [axis for axis in look.whole.axes if any(
        p.axes[axis].rate_step is not None for p in look.parts if axis in p.axes)]
    if not axes:
        return None
    figure, drawn = canvas.panels(len(axes), height_in=0.7 + 1.6 * len(axes))
    for panel, axis in zip(drawn, axes, strict=True):
        panel.axhline(1.0, color=canvas.MUTED, linewidth=0.8, linestyle=':')
        for k, part in enumerate(look.parts):
            step = part.axes[axis].rate_step
            if step is not None:
                panel.plot(step.time_s, step.mean, color=canvas.LINES[k % len(canvas.LINES)],
                           label=f'{part.stretch.start_s:.0f} to {part.stretch.end_s:.0f} s')
    canvas.finish(drawn, 'time after the step, s', *(f'{axis}, 1' for axis in axes))
    return Picture('step_by_gains', 'Step response by set of gains',
                   'One line for each stretch of the flight with its own gains.', figure)


def spectra(look: Measured) -> Picture | None:
    """Amplitude spectra of gyro, before and after, D part and motors."""
    axes = {axis: on_axis for axis, on_axis in look.whole.axes.items() if on_axis.gyro is not None}
    if not axes:
        return None
    motors = look.motor_frames
    figure, drawn = canvas.panels(len(axes) + (motors is not None),
                           height_in=0.7 + 1.5 * (len(axes) + (motors is not None)))
    for panel, signals in zip(drawn, axes.values(), strict=False):
        for name, frames, colour in (('gyro before filters', signals.gyro_before, canvas.SKY),
                                     ('gyro', signals.gyro, canvas.INK)):
            if frames is not None:
                _line(panel, frames, DEG, colour, name)
        if signals.d_term is not None:
            _line(panel, signals.d_term, 1e3, canvas.ORANGE, 'D part, ‰ of command')
    if motors is not None:
        _line(drawn[-1], motors, 1e3, canvas.GREEN, 'motor commands, ‰')
        canvas.legend(drawn[-1])
    canvas.plain_logarithms(drawn)
    canvas.finish(drawn, 'frequency, Hz', *(f'{axis}, deg/s/√Hz' for axis in axes),
           *['motors, ‰/√Hz'] * (motors is not None))
    return Picture('spectra', 'Spectra of gyro, D part and motors',
                   'Amplitude density in the air: mean power of Hann windows of 0.5 s.', figure)


def _line(axes: Axes, frames: Frames, scale: float, colour: str, label: str) -> None:
    axes.loglog(frames.frequency_hz[1:], scale * np.sqrt(np.maximum(frames.mean[1:], 1e-30)),
                color=colour, label=label)


def throttle_map(look: Measured) -> Picture | None:
    """Gyro noise over throttle, each axis."""
    throttle = look.flown.throttle
    if throttle is None:
        return None
    maps = {axis: (f, f.over(throttle, THROTTLE)) for axis, f in _noisiest(look)}
    maps = {axis: (f, m) for axis, (f, m) in maps.items()
            if np.isfinite(m).any(axis=1).sum() > 1}
    if not maps:
        return None
    figure, drawn = canvas.panels(len(maps), height_in=0.7 + 1.6 * len(maps))
    for panel, (frames, values) in zip(drawn, maps.values(), strict=True):
        finite = np.flatnonzero(np.isfinite(values).any(axis=1))
        used = values[finite[0]:finite[-1] + 1]
        _map(panel, used.T, (float(THROTTLE[finite[0]]), float(THROTTLE[finite[-1] + 1])), frames)
    canvas.finish(drawn, 'throttle (mean motor command)', *(f'{axis}, Hz' for axis in maps))
    return Picture('throttle', 'Gyro spectrum over throttle', _map_words(look), figure)


def time_map(look: Measured) -> Picture | None:
    """The spectrogram of each axis."""
    maps = dict(_noisiest(look))
    if not maps:
        return None
    figure, drawn = canvas.panels(len(maps), height_in=0.7 + 1.6 * len(maps))
    for panel, frames in zip(drawn, maps.values(), strict=True):
        edges = np.linspace(0.0, look.flown.length_s, min(
            MOST_PIXELS, max(2, math.ceil(look.flown.length_s / 0.25))) + 1)
        _map(panel, frames.at_places(frames.time_s, edges).T, (0.0, look.flown.length_s), frames)
    canvas.finish(drawn, 'time, s', *(f'{axis}, Hz' for axis in maps))
    return Picture('spectrogram', 'Spectrogram of the gyro', _map_words(look), figure)


def _map_words(look: Measured) -> str:
    raw = any(on_axis.gyro_before is not None for on_axis in look.whole.axes.values())
    whose = 'before its filters' if raw else 'as the controller sees it'
    return (f'Bright is loud, {RANGE_DB:.0f} dB from the loudest above {LOWEST_PEAK_HZ:g} Hz to '
            f'black; the gyro {whose}. White: not flown there.')


def _noisiest(look: Measured) -> Iterator[tuple[str, Frames]]:
    """Of each axis the gyro before its filters on the log's grid, or else behind them."""
    for axis, on_axis in look.whole.axes.items():
        raw = on_axis.gyro_before if look.flown.before_dt == look.flown.dt else None
        gyro = raw if raw is not None else on_axis.gyro
        if gyro is not None:
            yield axis, gyro


def _map(axes: Axes, density: FloatArray, span: tuple[float, float], frames: Frames) -> None:
    """A map of decibels, the rows thinned to what can be seen."""
    every = max(1, math.ceil(len(density) / MOST_PIXELS))
    length = len(density) // every * every
    thin = density[:length].reshape(-1, every, density.shape[1]).mean(axis=1)
    level = 10.0 * np.log10(np.maximum(thin, 1e-30))
    shaking = frames.frequency_hz[:length:every] >= LOWEST_PEAK_HZ
    top = float(np.nanpercentile(level[shaking[:len(level)]], 99.8))
    axes.imshow(level, origin='lower', aspect='auto', interpolation='nearest', cmap='magma',
                vmin=top - RANGE_DB, vmax=top,
                extent=(*span, 0.0, float(frames.frequency_hz[length - 1])))
    axes.grid(visible=False)


def orders(look: Measured) -> Picture | None:
    """Gyro noise over multiples of the rotors' mean frequency."""
    if look.rotor_hz is None:
        return None
    maps = {axis: f.orders(look.rotor_hz) for axis, f in _noisiest(look)}
    maps = {axis: m for axis, m in maps.items() if m is not None}
    if not maps:
        return None
    figure, (panel,) = canvas.panels(height_in=2.6)
    centres = 0.5 * (ORDERS[1:] + ORDERS[:-1])
    for (axis, m), colour in zip(maps.items(), canvas.LINES, strict=False):
        if m is not None:
            panel.semilogy(centres, DEG * np.sqrt(m), color=colour, label=axis)
    canvas.plain_logarithms([panel])
    canvas.finish([panel], "frequency over the rotors' mean frequency", 'deg/s/√Hz')
    return Picture('orders', 'Gyro spectrum in orders of the rotors',
                   'Whole orders are imbalance and blades; what stands between them is not driven '
                   'by the rotors.', figure)


def loop(look: Measured) -> Picture | None:
    """Tracking over frequency, coherence, and loop gain where the gains are known."""
    part: Part = look.parts[-1] if look.parts else look.whole
    loops = {axis: on_axis.loop for axis, on_axis in part.axes.items() if on_axis.loop is not None}
    if not loops:
        return None
    has_loop = any(measured.loop is not None for measured in loops.values())
    figure, drawn = canvas.panels(4 if has_loop else 3, height_in=5.6 if has_loop else 4.4)
    for (axis, measured), colour in zip(loops.items(), canvas.LINES, strict=False):
        f = measured.frequency_hz
        drawn[0].loglog(f, np.abs(measured.tracking), color=colour, label=axis)
        drawn[1].semilogx(f, np.degrees(np.unwrap(np.angle(measured.tracking))), color=colour)
        drawn[2].semilogx(f, measured.coherence, color=colour)
        if has_loop and measured.loop is not None:
            finite = np.isfinite(measured.loop)
            drawn[3].loglog(f[finite], np.abs(1.0 / (1.0 + measured.loop[finite])), color=colour)
    drawn[2].set_ylim(0.0, 1.05)
    canvas.plain_logarithms(drawn)
    canvas.finish(drawn, 'frequency, Hz', 'tracking, 1', 'phase, °', 'coherence²',
           *['sensitivity, 1'] * has_loop)
    return Picture('loop', 'Rate loop over frequency',
                   'Rate over set-point where both are coherent' + (
                       '; the sensitivity 1 / (1 + L) by the measured plant and the known gains.'
                       if has_loop else '.'), figure)
