"""Pictures of the models' predictions, and of their errors on the held-out data.

Free run, error over the horizon, one step ahead, residual tests, spectrum, torque, Bode.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from quad_sysid.blackbox import ResidualTest, frequency_response, spa
from quad_sysid.contract import FloatArray
from quad_sysid.errors import QuadSysidError, p_in_words
from quad_sysid.loop.from_model import response_of
from quad_sysid.loop.linear import WIDE, ComplexArray
from quad_sysid.model.data import Windows
from quad_sysid.pipeline.answer import AxisAnswer, Findings, HeldOut, Residual
from quad_sysid.pipeline.constants import Z99
from quad_sysid.report import canvas
from quad_sysid.report.canvas import Picture
from quad_sysid.report.plots_data import trusted, trusted_words
from quad_sysid.report.words import yes
from quad_sysid.units import COMMAND, scale

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_WINDOWS = 10
LEAST_COHERENCE = 0.2
"""Below it a point of the empirical response is mostly noise, and is not drawn."""


def runs(findings: Findings) -> list[tuple[HeldOut, str, str, str]]:
    """The base and, where effects were added, the completed model."""
    models = [(findings.before, canvas.BEFORE, '--', 'base'),
              (findings.after, canvas.AFTER, '-', 'completed')]
    return models if findings.added else models[:1]


def free_run(answer: AxisAnswer) -> Picture | None:
    """Measured rate against free runs of base and completed model over held-out windows."""
    findings = answer.findings
    if findings is None:
        return None
    data = findings.data
    windows = data.windows(data.validation)
    errors = findings.before.errors
    if not windows.count or errors.shape != (windows.count, windows.length):
        return None
    first, last = _lively(windows, data.rate)
    a, b = int(windows.starts[first]), int(windows.starts[last]) + windows.length
    time_s, of = np.arange(a, b) * data.dt, scale(answer.units, 'rate', 'rad/s')
    figure, axes = canvas.panels(2, height_in=3.9, ratios=(2.0, 1.0))
    axes[0].plot(time_s, of(data.rate[a:b]), color=canvas.INK, lw=1.0, label='measured')
    for held_out, colour, style, name in runs(findings):
        for w in range(first, last + 1):
            index = np.arange(windows.starts[w], windows.starts[w] + windows.length)
            wrong = held_out.errors[w]
            label = name if w == first else None
            axes[0].plot(index * data.dt, of(data.rate[index] + wrong), color=colour, label=label,
                         lw=1.3, ls=style)
            axes[1].plot(index * data.dt, of(wrong), color=colour, lw=1.0)
    for w in range(first, last + 1):
        for panel in axes:
            panel.axvline(windows.starts[w] * data.dt, color=canvas.MUTED, lw=0.5, ls=':')
    axes[1].margins(x=0.01)
    canvas.finish(axes, 'time, s', of.label, scale(answer.units, 'error', 'rad/s').label)
    return Picture(
        'free_run', 'Free run on held-out data',
        'In each window of 0.5 s (dotted) the model starts from what was measured before it and '
        'then runs on the commands alone. The liveliest stretch of the held-out segments.', figure,
    )


def _lively(windows: Windows, rate: FloatArray) -> tuple[int, int]:
    """First and last of up to MOST_WINDOWS windows in a row with the largest motion."""
    power = np.array([np.var(rate[s : s + windows.length]) for s in windows.starts])
    breaks = np.flatnonzero(np.diff(windows.starts) != windows.length) + 1
    rows = [(a, min(a + MOST_WINDOWS, int(piece[-1]) + 1) - 1)
            for piece in np.split(np.arange(windows.count), breaks) for a in piece.tolist()]
    return max(rows, key=lambda row: float(np.sum(power[row[0] : row[1] + 1])))


def horizon(answer: AxisAnswer) -> Picture | None:
    """RMS of the free-run error over the time since the window's start."""
    findings = answer.findings
    if findings is None or not findings.before.errors.size:
        return None
    figure, (panel,) = canvas.panels(height_in=2.6)
    of = scale(answer.units, 'RMS error', 'rad/s')
    horizon_s = np.arange(findings.before.errors.shape[1]) * findings.data.dt
    for held_out, colour, style, name in runs(findings):
        growth = of(np.sqrt(np.mean(held_out.errors**2, axis=0)))
        panel.plot(horizon_s, growth, color=colour, ls=style, lw=1.6, label=name)
    panel.axhline(of.factor * findings.verdict.noise_floor, color=canvas.GREEN, lw=1, ls=':',
                  label='measurement noise')
    panel.set_ylim(bottom=0.0)
    canvas.finish([panel], 'time since the start of the window, s', of.label)
    return Picture(
        'horizon', 'Error over the horizon',
        'How the prediction becomes worse: RMS over all held-out windows. Its mean square '
        'over the window is the error of the table.', figure,
    )


def bode(answer: AxisAnswer) -> Picture | None:
    """Response from command to measured rate: grey box and black box with bands, and the data."""
    model, train = answer.model, answer.train
    if model is None or train is None:
        return None
    w = np.geomspace(0.3, 0.9 * np.pi / model.dt, 160)
    of = scale(answer.units, 'gain', f'rad/s per {COMMAND}')
    figure, axes = canvas.panels(2, height_in=4.3, ratios=(1.25, 1.0))
    try:
        data = spa(train)
        coherent = data.coherence > LEAST_COHERENCE
        axes[0].loglog(data.w[coherent], of(np.abs(data.response[coherent])), '.', ms=3.5,
                       color=canvas.INK, label='data')
        axes[1].semilogx(data.w[coherent], degrees(data.response[coherent]), '.', ms=3.5,
                         color=canvas.INK)
        w = w[w > 0.7 * data.w[0]]
    except QuadSysidError:
        axes[0].set_yscale('log')
    if answer.selected is not None:
        chosen = answer.rows[answer.selected].step_a.model
        estimate = frequency_response(chosen, w)
        _curve(axes, w, of.factor * estimate.response, Z99 * of(estimate.magnitude_std),
               Z99 * estimate.phase_std, canvas.OTHER, '--', chosen.name)
    base = response_of(replace(model, effects=(), active_gains={}), w, WIDE)
    response = of.factor * base.response
    _curve(axes, w, response, Z99 * of(base.magnitude_std), Z99 * base.phase_std, canvas.AFTER,
           '-', 'grey box')
    for panel in axes:
        trusted(panel, answer)
        panel.set_xscale('log')
    magnitude = np.abs(response)
    axes[0].set_ylim(max(float(magnitude.min()), 1e-4 * float(magnitude.max())) * 0.3,
                     float(magnitude.max()) * 4.0)
    axes[1].set_ylim(-720.0, 60.0)
    axes[1].set_yticks(range(-720, 61, 180))
    canvas.finish(axes, 'frequency, rad/s', of.label, 'phase, deg')
    note = ' Effects that are not linear are left out.' if model.effects else ''
    return Picture(
        'bode', 'Frequency response', 'From command to measured rate, bands of 99 %. Points: '
        'spectral analysis without a model, where coherence exceeds 0.2.' + note
        + trusted_words(answer), figure,
    )


def _curve(axes: list[Axes], w: FloatArray, response: ComplexArray, magnitude: FloatArray,
           phase: FloatArray, colour: str, style: str, name: str) -> None:
    """One response with its band; `magnitude` and `phase` (rad) are half widths, NaN for none."""
    size, angle = np.abs(response), degrees(response)
    axes[0].loglog(w, size, color=colour, ls=style, lw=1.4, label=name)
    axes[1].semilogx(w, angle, color=colour, ls=style, lw=1.4)
    if np.isfinite(magnitude).all():
        axes[0].fill_between(w, np.maximum(size - magnitude, 1e-3 * size), size + magnitude,
                             color=colour, alpha=0.22, lw=0)
        width = np.minimum(np.degrees(phase), 360.0)
        axes[1].fill_between(w, angle - width, angle + width, color=colour, alpha=0.22, lw=0)


def degrees(response: ComplexArray) -> FloatArray:
    """Unwrapped phase, moved by whole turns so that it starts within -270 to 90 degrees."""
    phase = np.degrees(np.unwrap(np.angle(response)))
    if phase.size:
        phase = phase - 360.0 * np.ceil((phase[0] - 90.0) / 360.0)
    return np.asarray(phase)


NAMES = (('before', 'base', canvas.BEFORE, '--'), ('after', 'completed', canvas.AFTER, '-'),
         ('blackbox', 'black box', canvas.OTHER, ':'))


def _known(answer: AxisAnswer) -> Iterator[tuple[Residual, str, str, str]]:
    """Residuals to draw: of the completed model only where it is another one than the base."""
    same = answer.findings is None or not answer.findings.added
    for key, name, colour, style in NAMES:
        if key in answer.residuals and not (same and key == 'after'):
            yield answer.residuals[key], name, colour, style


def correlations(answer: AxisAnswer) -> Picture | None:
    """Auto- and cross-correlation of the one-step errors of every model, with their bounds."""
    entries, findings = list(_known(answer)), answer.findings
    if not entries or findings is None:
        return None
    figure, axes = canvas.panels(2, height_in=4.0, share_x=False, spacing=0.72)
    reach = [0.0, 0.0]
    for number, (residual, name, colour, style) in enumerate(entries):
        test = residual.test
        for panel, lags, values, bound in (
            (0, test.lags[1:], test.autocorrelation[1:], test.autocorrelation_bound),
            (1, test.cross_lags, test.cross_correlation, test.cross_bound),
        ):
            lag_s = (lags + 0.3 * number) * findings.data.dt
            axes[panel].vlines(lag_s, 0.0, values, color=colour, lw=1.1)
            axes[panel].plot(lag_s, values, 's' if number == 0 else 'o', ms=2.4, color=colour,
                             label=name)
            for sign in (-1.0, 1.0):
                axes[panel].axhline(sign * bound, color=colour, ls=style, lw=0.8)
            reach[panel] = max(reach[panel], 1.2 * float(np.max(np.abs(values))), 1.8 * bound)
    for row, limit, label in zip(axes, reach, ('autocorrelation, 1', 'with command, 1'),
                                 strict=True):
        row.axhline(0.0, color=canvas.MUTED, lw=0.7)
        row.set_ylim(-limit, limit)
        row.set_ylabel(label)
        row.set_xlabel('lag, s')
    canvas.legend(axes[0])
    texts = '; '.join(f'{name}: {_words(r.test)}' for r, name, _, _ in entries)
    return Picture(
        'correlations', 'What is left, cycle by cycle',
        'One-step errors on held-out data; lines bound 99 % of a single lag. A positive lag is '
        'the command before the error; at negative lags a closed loop alone gives correlation. '
        f'{texts[:1].upper()}{texts[1:]}.', figure,
    )


def _words(test: ResidualTest) -> str:
    """What the tests say, in words."""
    white, free = test.residual_white, test.residual_uncorrelated_with_input
    return (f'white {yes(white)} (p {p_in_words(test.p_white)}), free of past commands '
            f'{yes(free)} (p {p_in_words(test.p_input)})')


def spectrum(answer: AxisAnswer) -> Picture | None:
    """Spectrum of the one-step errors of every model, with the peaks that stand out."""
    entries = [entry for entry in _known(answer) if entry[0].frequency_hz.size > 2]
    if not entries:
        return None
    of = scale(answer.units, 'error', '(rad/s)²/Hz')
    figure, (panel,) = canvas.panels(height_in=2.7)
    for residual, name, colour, style in entries:
        panel.loglog(residual.frequency_hz[1:], of(residual.density[1:]), color=colour, ls=style,
                     lw=1.2, label=name)
    last = next((r for r, name, _, _ in entries if name == 'completed'), entries[0][0])
    for frequency, _ in last.peaks[:3]:
        panel.axvline(frequency, color=canvas.MUTED, lw=0.7, ls=':')
        panel.text(frequency, panel.get_ylim()[0], f' {frequency:.1f} Hz', fontsize=8, va='bottom')
    canvas.finish([panel], 'frequency, Hz', of.label)
    peaks = ' Dotted: peaks over their surroundings.' if last.peaks else ''
    return Picture(
        'residual_spectrum', 'Spectrum of what is left',
        'One-step errors on held-out data. Flat is noise; a slope or a peak is something that '
        f'the model does not know.{peaks}', figure,
    )


def torque(answer: AxisAnswer) -> Picture | None:
    """The torque that base and completed model seem to lack, over time."""
    entries = [(r.missing, n, c) for r, n, c, _ in _known(answer) if r.missing is not None]
    if not entries:
        return None
    of = scale(answer.units, 'torque / inertia', 'rad/s²')
    figure, (panel,) = canvas.panels(height_in=2.7)
    for missing, name, colour in entries:
        time_s, values = np.asarray(missing.time_s), of(np.asarray(missing.acceleration))
        pieces = np.split(np.arange(time_s.size), np.flatnonzero(np.diff(time_s) > 1.0) + 1)
        for number, index in enumerate(pieces):
            panel.plot(time_s[index], values[index], color=colour, lw=0.8,
                       label='' if number else name)
    last = entries[-1][0]
    bound = Z99 * of.factor * last.expected_rms
    panel.axhspan(-bound, bound, color=canvas.GREEN, alpha=0.14, lw=0, label='99 % of its noise')
    canvas.finish([panel], 'time, s', of.label)
    return Picture(
        'missing_torque', 'The torque that seems to be missing, over time',
        "The torque disturbance that the model's Kalman filter sees on held-out data. The green "
        "band is what the last model's own noise predicts.", figure,
    )


DRAWINGS = (
    canvas.Drawing('free_run', 'Prediction on held-out data', free_run),
    canvas.Drawing('horizon', 'Prediction on held-out data', horizon),
    canvas.Drawing('bode', 'Black-box models', bode),
    canvas.Drawing('correlations', 'What is left', correlations),
    canvas.Drawing('residual_spectrum', 'What is left', spectrum),
    canvas.Drawing('missing_torque', 'What is left', torque),
)
