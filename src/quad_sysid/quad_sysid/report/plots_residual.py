"""Pictures of what models leave on the held-out data: one step, correlations, spectrum, torque.

The tests of the black box on its training data stand in plots_models.py.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from quad_sysid.pipeline.answer import AxisAnswer, Residual
from quad_sysid.report.canvas import (
    AFTER,
    BEFORE,
    GREEN,
    INK,
    MUTED,
    OTHER,
    Picture,
    legend,
    panels,
    thinned,
)
from quad_sysid.report.words import equals

SHOWN_S = 2.0
"""Of one-step predictions, so that single cycles can be told apart."""
Z99 = 2.576
NAMES = (('before', 'base', BEFORE, '--'), ('after', 'completed', AFTER, '-'))
OFFSET = 0.3
"""Lags by which the second model's lines stand beside the first's."""


def one_step(answer: AxisAnswer) -> Picture | None:
    """Measured rate against the prediction of one cycle ahead, and its error."""
    found = answer.findings
    if found is None or not found.data.validation:
        return None
    data = found.data
    errors = found.after.innovations
    start, stop = max(
        data.validation, key=lambda s: float(np.nanvar(data.rate[s[0]:s[1]]) * (s[1] - s[0]))
    )
    length = round(SHOWN_S / data.dt)
    if stop - start <= 2 * length or errors.shape != data.rate.shape:
        return None
    pieces = np.arange(start + length, stop - length, length)
    begin = int(max(pieces, key=lambda a: float(np.var(data.rate[a:a + length]))))
    inside = slice(begin, begin + length)
    time_s = np.arange(begin, begin + length) * data.dt
    figure, axes = panels(2, height_in=3.7, ratios=(1.6, 1.0))
    axes[0].plot(time_s, data.rate[inside], color=INK, lw=2.2, alpha=0.35, label='measured')
    axes[0].plot(time_s, (data.rate - errors)[inside], color=AFTER, lw=0.9,
                 label='one step ahead')
    if found.added:
        axes[1].plot(time_s, found.before.innovations[inside], color=BEFORE, lw=0.9,
                     ls='--', label='base')
    axes[1].plot(time_s, errors[inside], color=AFTER, lw=0.9,
                 label='completed' if found.added else 'base')
    bound = Z99 * found.verdict.noise_floor
    axes[1].axhspan(-bound, bound, color=GREEN, alpha=0.14, lw=0, label='99 % of the noise')
    axes[0].set_ylabel('rate, rad/s')
    axes[1].set_ylabel('error, rad/s')
    axes[1].set_xlabel('time, s')
    axes[1].margins(x=0.01)
    for one in axes:
        legend(one)
    return Picture(
        'one_step', 'One step ahead on held-out data',
        'Each cycle is predicted from all that was measured before it. Close to the line is easy '
        'here; the free run is the harder test.', figure,
    )


def _known(answer: AxisAnswer) -> Iterator[tuple[Residual, str, str, str]]:
    """Residuals to draw: of the base, and of the completed model where it is another one."""
    same = answer.findings is None or not answer.findings.added
    for key, name, colour, style in NAMES:
        if key in answer.residuals and not (same and key == 'after'):
            yield answer.residuals[key], name, colour, style


def correlations(answer: AxisAnswer) -> Picture | None:
    """Auto- and cross-correlation of the one-step errors of base and completed model."""
    shown = list(_known(answer))
    found = answer.findings
    if not shown or found is None:
        return None
    dt = found.data.dt
    figure, axes = panels(2, height_in=4.0, share_x=False)
    figure.subplots_adjust(hspace=0.72)
    reach = [0.0, 0.0]
    for number, (residual, name, colour, style) in enumerate(shown):
        test = residual.test
        for panel, lags, values, bound in (
            (0, test.lags[1:], test.autocorrelation[1:], test.autocorrelation_bound),
            (1, test.cross_lags, test.cross_correlation, test.cross_bound),
        ):
            at = (lags + OFFSET * number) * dt
            axes[panel].vlines(at, 0.0, values, color=colour, lw=1.1)
            axes[panel].plot(at, values, 's' if number == 0 else 'o', ms=2.4, color=colour,
                             label=name)
            for sign in (-1.0, 1.0):
                axes[panel].axhline(sign * bound, color=colour, ls=style, lw=0.8)
            reach[panel] = max(reach[panel], 1.2 * float(np.max(np.abs(values))), 1.8 * bound)
    for one, limit, label in zip(
        axes, reach, ('autocorrelation, 1', 'with command, 1'), strict=True
    ):
        one.axhline(0.0, color=MUTED, lw=0.7)
        one.set_ylim(-limit, limit)
        one.set_ylabel(label)
        one.set_xlabel('lag, s')
    legend(axes[0])
    told = '; '.join(
        f'{name}: white {_yes(r.test.residual_white)} (p {equals(r.test.p_white)}), free of past '
        f'commands {_yes(r.test.residual_uncorrelated_with_input)} (p {equals(r.test.p_input)})'
        for r, name, _, _ in shown
    )
    return Picture(
        'correlations', 'What is left, cycle by cycle',
        'One-step errors on held-out data; lines bound 99 % of a single lag. A positive lag is '
        f'the command before the error. {told[:1].upper()}{told[1:]}.', figure,
    )


def spectrum(answer: AxisAnswer) -> Picture | None:
    """Spectrum of the one-step errors of every model, with the peaks that stand out."""
    shown = list(_known(answer))
    if 'blackbox' in answer.residuals:
        shown.append((answer.residuals['blackbox'], 'black box', OTHER, ':'))
    shown = [entry for entry in shown if entry[0].frequency_hz.size > 2]
    if not shown:
        return None
    figure, (one,) = panels(height_in=2.7)
    for residual, name, colour, style in shown:
        one.loglog(residual.frequency_hz[1:], residual.density[1:], color=colour, ls=style,
                   lw=1.2, label=name)
    last = next((r for r, name, _, _ in shown if name == 'completed'), shown[0][0])
    for frequency, _ in last.peaks[:3]:
        one.axvline(frequency, color=MUTED, lw=0.7, ls=':')
        one.text(frequency, one.get_ylim()[0], f' {frequency:.1f} Hz', fontsize=8, va='bottom')
    one.set_xlabel('frequency, Hz')
    one.set_ylabel('error, (rad/s)²/Hz')
    legend(one)
    peaks = ' Dotted: peaks over their surroundings.' if last.peaks else ''
    return Picture(
        'residual_spectrum', 'Spectrum of what is left',
        'One-step errors on held-out data. Flat is noise; a slope or a peak is something that '
        f'the model does not know.{peaks}', figure,
    )


def torque(answer: AxisAnswer) -> Picture | None:
    """The torque that base and completed model seem to lack, over time."""
    shown = [(r.missing, n, c) for r, n, c, _ in _known(answer) if r.missing is not None]
    if not shown:
        return None
    figure, (one,) = panels(height_in=2.7)
    for missing, name, colour in shown:
        time_s, values = np.asarray(missing.time_s), np.asarray(missing.acceleration)
        pieces = np.split(np.arange(time_s.size), np.flatnonzero(np.diff(time_s) > 1.0) + 1)
        for number, at in enumerate(pieces):
            one.plot(*thinned(time_s[at], values[at]), color=colour, lw=0.8,
                     label='' if number else name)
    last = shown[-1][0]
    bound = Z99 * last.expected_rms
    one.axhspan(-bound, bound, color=GREEN, alpha=0.14, lw=0, label='99 % of its noise')
    one.set_xlabel('time, s')
    one.set_ylabel('torque / inertia, rad/s²')
    legend(one)
    return Picture(
        'missing_torque', 'The torque that seems to lack, over time',
        "The torque disturbance that the model's Kalman filter sees on held-out data. The green "
        "band is what the last model's own noise lets one expect.", figure,
    )


def _yes(value: bool) -> str:
    return 'yes' if value else 'no'
