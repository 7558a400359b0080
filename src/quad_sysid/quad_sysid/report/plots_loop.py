"""Pictures of the loop: simulated against recorded, a step and margins with old and new gains."""

from __future__ import annotations

import numpy as np

from quad_sysid.axes import EVERY
from quad_sysid.errors import QuadSysidError
from quad_sysid.logview.step import ANGLE, Response, responses
from quad_sysid.loop.cascade import CascadeGains, frequency_grid, margins, open_loop
from quad_sysid.loop.from_model import in_flight, loop_plant
from quad_sysid.loop.linear import loops_of
from quad_sysid.loop.simulation import simulate_cascade
from quad_sysid.pipeline.answer import AxisAnswer
from quad_sysid.report import canvas
from quad_sysid.report.canvas import Picture
from quad_sysid.report.plots_models import degrees
from quad_sysid.units import COMMAND, scale


def overlay(answer: AxisAnswer) -> Picture | None:
    """The simulated cascade on the recorded reference against the recorded rate."""
    loop = answer.closed_loop
    if loop is None or loop.time_s.size < 2:
        return None
    step = float(np.median(np.diff(loop.time_s)))
    time_s = np.asarray(loop.time_s, dtype=float)
    breaks = np.flatnonzero(np.diff(time_s) > 1.5 * step) + 1
    pieces = np.split(np.arange(time_s.size), breaks)
    long = [p for p in pieces if p.size > 1.0 / step] or pieces
    piece = max(long, key=lambda p: float(np.var(loop.measured[p])))
    piece = piece[: round(10.0 / step)]
    figure, axes = canvas.panels(2, height_in=3.9, ratios=(2.0, 1.0))
    of = scale(answer.units, 'rate', 'rad/s')
    measured = of(loop.measured[piece])
    axes[0].plot(time_s[piece], measured, color=canvas.INK, lw=1.0, label='measured')
    added = answer.model is not None and bool(answer.model.effects)
    runs = [(loop.after, canvas.AFTER, '-', 'completed' if added else 'base')]
    if added:
        runs.insert(0, (loop.before, canvas.BEFORE, '--', 'base'))
    for simulated, colour, style, name in runs:
        simulated_run = of(simulated[piece])
        axes[0].plot(time_s[piece], simulated_run, color=colour, ls=style, label=name)
        axes[1].plot(time_s[piece], simulated_run - measured, color=colour, lw=0.8)
    axes[1].margins(x=0.01)
    error = scale(answer.units, 'error', 'rad/s')
    unit = error.label.removeprefix('error, ')
    canvas.finish(axes, 'time, s', of.label, error.label)
    return Picture(
        'closed_loop', 'Simulated flight against the recorded one',
        'The controller and the model flown on the recorded reference and excitation, from the '
        'start of the record. RMS over the held-out segments: '
        f'base {of.factor * loop.rms_before:.3g}'
        + (f', completed {of.factor * loop.rms_after:.3g}' if added else '') + f' {unit}.', figure,
    )


def _sets(answer: AxisAnswer) -> list[tuple[str, CascadeGains, str, str]]:
    """Flown and new gains, with colour and style; none where unknown."""
    model, proposal = answer.model, answer.proposal
    if model is None or f'{model.axis}.rate.kp' not in model.active_gains:
        return []
    new = proposal.gains if proposal is not None else None
    return [
        (name, CascadeGains.from_mapping({**model.active_gains, **gains}, model.axis), *look)
        for name, gains, look in (('flown gains', {}, (canvas.BEFORE, '--')),
                                  ('proposed gains', new, (canvas.AFTER, '-')))
        if gains is not None
    ]


def step_response(answer: AxisAnswer) -> Picture | None:
    """A step of the attitude reference with flown and new gains."""
    sets = _sets(answer)
    if answer.model is None or not sets:
        return None
    model = in_flight(answer.model)
    plant = loop_plant(model)
    size, units = plant.trial.step, answer.units
    turns = units is None or units.motion == 'rad'
    factor, unit = (np.degrees(1.0), 'deg') if units is None or turns else (
        1.0 / units.per_motion, units.motion)
    command = scale(units, 'command', COMMAND)
    n = round(plant.trial.half_period_s / model.dt)
    lead = n // 10
    reference = np.where(np.arange(n + lead) < lead, 0.0, size)
    time_s = np.asarray((np.arange(n + lead) - lead) * model.dt, dtype=np.float64)
    figure, axes = canvas.panels(2, height_in=3.7, ratios=(1.7, 1.0))
    axes[0].plot(time_s, factor * reference, color=canvas.GREEN, lw=1.0, label='reference')
    for name, gains, colour, style in sets:
        try:
            response = simulate_cascade(plant, gains, reference, model.dt)
        except QuadSysidError:
            return None
        if not np.isfinite(response.angle).all():
            return None
        axes[0].plot(time_s, factor * response.angle, color=colour, ls=style, lw=1.6,
                     label=name)
        axes[1].plot(time_s, command(response.control), color=colour, ls=style, lw=1.2)
    measured = _measured(answer)
    if measured is not None:
        axes[0].plot(measured.time_s, factor * size * measured.mean, color=canvas.MEASURED,
                     lw=1.2, label='measured')
        axes[0].fill_between(measured.time_s, factor * size * measured.low,
                             factor * size * measured.high, color=canvas.MUTED, alpha=0.25,
                             linewidth=0)
        axes[0].set_xlim(time_s[0], time_s[-1])
    place = EVERY[model.axis].place
    canvas.finish(axes, 'time since the step, s', f'{place}, {unit}', command.label)
    why = '' if len(sets) == 2 else ' No new gains are proposed; the words above say why.'
    what = f'{factor * size:.0f} degrees in the attitude reference' if turns else \
        f'{factor * size:.2g} {unit} in the reference of the {place}'
    return Picture('step', 'Step before and after',
                   f'A step of {what}, simulated with the identified model.'
                   + (' Measured: the response of this flight with the flown gains, by '
                      'deconvolution, with its spread between windows.' if measured else '')
                   + why, figure)


def _measured(answer: AxisAnswer) -> Response | None:
    """The step response of the angle in flight; None where it cannot be measured."""
    findings, reference = answer.findings, answer.attitude_reference
    if findings is None or reference is None or (angle := findings.data.angle) is None:
        return None
    is_finite = np.isfinite(findings.data.rate)
    return next(iter(responses(reference, angle, is_finite, findings.data.dt, ANGLE)), None)


def open_loop_margins(answer: AxisAnswer) -> Picture | None:
    """Loop gain and phase, broken at the command, before and after, with their margins."""
    sets = _sets(answer)
    if answer.model is None or not sets:
        return None
    model = in_flight(answer.model)
    plant = loop_plant(model)
    loops = loops_of([(plant, plant.trial.wide)])
    omega = frequency_grid(model.dt, 400, 0.3, loops)
    response = loops.response(omega)
    figure, axes = canvas.panels(2, height_in=4.1)
    lines = []
    for name, gains, colour, style in sets:
        loop = open_loop(gains, response, omega, model.dt)
        values = margins(loop, omega)
        phase = degrees(loop[0])
        axes[0].loglog(omega, np.abs(loop[0]), color=colour, ls=style, lw=1.4, label=name)
        axes[1].semilogx(omega, phase, color=colour, ls=style, lw=1.4)
        crossover = float(values.crossover_rad_s[0])
        if np.isfinite(crossover):
            crossover_phase = float(np.interp(np.log(crossover), np.log(omega), phase))
            axes[0].plot([crossover], [1.0], 'o', ms=4, color=colour)
            axes[1].plot([crossover], [crossover_phase], 'o', ms=4, color=colour)
        lines.append(f'{name}: phase margin {values.phase_margin_deg[0]:.0f} deg, gain margin '
                     f'{values.gain_margin_db[0]:.1f} dB, crossover {crossover:.3g} rad/s, peak '
                     f'sensitivity {values.peak_sensitivity[0]:.2f}')
    axes[0].axhline(1.0, color=canvas.MUTED, lw=0.8, ls=':')
    axes[1].axhline(-180.0, color=canvas.MUTED, lw=0.8, ls=':')
    axes[1].set_ylim(-540.0, 0.0)
    axes[1].set_yticks(range(-540, 1, 180))
    canvas.finish(axes, 'frequency, rad/s', 'loop gain, 1', 'phase, deg')
    caption = '; '.join(lines)
    return Picture(
        'margins', 'The open loop and its margins',
        f'Broken at the command; dots mark the crossover. {caption[:1].upper()}{caption[1:]}. '
        'For the model itself, in wide motion; the table has the worst of all draws too.', figure,
    )


DRAWINGS = (
    canvas.Drawing('closed_loop', 'Loop and gains', overlay),
    canvas.Drawing('step', 'Loop and gains', step_response),
    canvas.Drawing('margins', 'Loop and gains', open_loop_margins),
)
