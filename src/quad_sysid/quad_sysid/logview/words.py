"""A look as text of 80 columns that begins with the answer, and as the tree of `--json`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import is_dataclass
from pathlib import PurePath
from typing import Any

import numpy as np

from quad_sysid.contract import AXES
from quad_sysid.logview.measure import DEG, NOISE_HZ, AxisLook, Measured, Part, noise_rms
from quad_sysid.logview.response import LoopResponse
from quad_sysid.logview.spectrum import Peak
from quad_sysid.logview.step import Response
from quad_sysid.report.tables import Table, wrapped
from quad_sysid.report.words import number

SCHEMA = 'quad_sysid/look/1'
UNEVEN_PCT = 5.0
"""A motor's command this far from the mean of all is said in words."""
LIMITED_PCT = 0.5
"""Share of the time at a limit from which it is said."""
MISSED_PCT = 5.0
"""Distance of a step's end from the step from which it is said."""
ORIGIN = ('import:', 'import clock:')
"""How the notes of an import begin that say where a bag comes from, and warn of nothing."""


def lines(look: Measured) -> list[str]:
    """One page for a terminal."""
    out = [line for text in sentences(look) for line in wrapped(text, '  ', '')]
    out += ['', *wrapped(header(look), '  ', '')]
    for table in (*tables(look), *(one for part in look.parts for one in part_tables(part))):
        if table.rows:
            out += ['', *table.text()]
    if look.flown.lacks:
        out += ['', *wrapped('not in the log: ' + '; '.join(look.flown.lacks), '  ', '')]
    for text in look.flown.warnings:
        kind = '' if text.startswith(ORIGIN) else 'warning: '
        out += wrapped(f'{kind}{text}', '  ', '')
    return out


def sentences(look: Measured) -> list[str]:
    """The measurements that a reader looks for first, one sentence each."""
    out = [_axis_sentence(look, axis) for axis in look.whole.axes.values()]
    out += filter(None, (_motor_sentence(look),))
    if look.parts:
        out.append(f'The gains changed in flight: {len(look.parts)} stretches, each measured by '
                   'itself below.')
    return out


def header(look: Measured) -> str:
    """A line on the log: source, length, rate, gaps, time in the air."""
    flight = look.flown
    count = len(flight.gaps)
    gaps = f', {count} gap{"s" * (count > 1)}' if count else ''
    name, rate = PurePath(flight.source).name or flight.source, 1.0 / flight.dt
    return (f'{name}: {flight.kind}, {flight.length_s:.1f} s at {rate:.5g} Hz{gaps}, '
            f'{look.whole.flown_s:.1f} s of it in the air{_experiments(look)}')


def _experiments(look: Measured) -> str:
    """The time with something injected, where set-point and rate are not compared."""
    injected = look.flown.injected
    if injected is None:
        return ''
    seconds = np.isfinite(injected).sum(axis=0) * look.flown.dt
    named = [f'{axis} {s:.0f} s' for axis, s in zip(AXES, seconds, strict=True) if s > 0.0]
    return (f'; experiments of {", ".join(named)}: there the axis is not compared with its '
            'set-point') if named else ''


def _axis_sentence(look: Measured, on_axis: AxisLook) -> str:
    step, loop = on_axis.rate_step, on_axis.loop
    name = on_axis.axis.capitalize()
    error = next((track for track in on_axis.tracking if track.quantity == 'rate'), None)
    if step is not None:
        text = f'{name} follows a step of its rate set-point {_figures(step)}'
    elif error is not None:
        text = (f'{name} deviates from its rate set-point by {DEG * error.error_rms:.3g} deg/s '
                f'RMS (the set-point: {DEG * error.setpoint_rms:.3g} deg/s RMS); ' + (
                    'gaps come too often' if on_axis.broken else
                    'the set-point moves too little, or the rate follows it too loosely,')
                + ' for a step response')
    elif look.flown.rate_setpoint is None:
        text = f'{name} has no rate set-point in the log, hence no step response'
    else:
        text = f'The rate set-point of {on_axis.axis} does not move, hence no step response'
    angle = next((s for s in on_axis.steps if s.quantity == 'angle'), None)
    if angle is not None:
        text += f'; the angle {_figures(angle)}'
    if loop is not None and np.isfinite(loop.phase_margin_deg):
        text += (f'. Its loop crosses over at {loop.crossover_hz:.3g} Hz with '
                 f'{loop.phase_margin_deg:.0f}° of phase margin')
        if np.isfinite(loop.gain_margin_db):
            text += f' and {loop.gain_margin_db:.1f} dB of gain margin'
    noise = on_axis.noise_rms
    if noise is not None and on_axis.gyro is not None:
        text += f'. Gyro noise above {NOISE_HZ:g} Hz: {DEG * noise:.2g} deg/s RMS'
        peaks = [p for p in on_axis.gyro.peaks() if p.frequency_hz >= NOISE_HZ]
        if peaks:
            text += f', of which {DEG * peaks[0].rms:.2g} at {peaks[0].frequency_hz:.0f} Hz'
    return f'{text}.'


def _figures(step: Response) -> str:
    f = step.figures
    if not np.isfinite(f.overshoot_pct):
        return (f'slowly: it still rises after {step.time_s[-1]:.2g} s, at '
                f'{100.0 * step.mean[-1]:.0f} % of it')
    parts = [f'in {_ms(f.rise_time_s)} (10 to 90 %)' if np.isfinite(f.rise_time_s) else
             'without reaching it']
    parts += [f'{f.overshoot_pct:.0f} % overshoot']
    parts += [f'settled after {_ms(f.settling_time_s)}' if np.isfinite(f.settling_time_s)
              else f'not settled within {step.time_s[-1]:.2g} s']
    if abs(f.final_error_pct) >= MISSED_PCT:
        parts.append(f'ending at {100.0 - f.final_error_pct:.0f} % of it')
    return ', '.join(parts)


def _motor_sentence(look: Measured) -> str:
    if not look.motors:
        return ''
    differing = [f'{m.name} {m.apart_pct:+.0f} %' for m in look.motors
                 if abs(m.apart_pct) >= UNEVEN_PCT]
    limit = [f'{m.name} {m.at_one_pct + m.at_zero_pct:.1f} %' for m in look.motors
             if m.at_one_pct + m.at_zero_pct >= LIMITED_PCT]
    text = 'Motors: ' + (f'mean commands apart from the others: {", ".join(differing)}'
                         if differing else
                         f'mean commands within {UNEVEN_PCT:g} % of each other')
    return text + (f'; at a limit for {", ".join(limit)} of the time.' if limit else
                   '; never at their limits.' if not any(
                       m.at_one_pct + m.at_zero_pct for m in look.motors) else
                   f'; at their limits for less than {LIMITED_PCT:g} % of the time.')


def tables(look: Measured) -> tuple[Table, ...]:
    """The tables of the whole flight."""
    return (*part_tables(look.whole), motors(look))


def part_tables(part: Part) -> tuple[Table, ...]:
    """Steps, loop, delays, noise and tracking of one stretch."""
    return (steps(part), loops(part), delays(part), noise(part), tracking(part))


def _title(part: Part) -> str:
    s = part.stretch
    if not s.changed:
        return '' if not s.start_s else f'{s.start_s:.1f} to {s.end_s:.1f} s: '
    changed = ', '.join(f'{n} {s.gains[n]:.4g}' for n in s.changed[:6])
    return f'{s.start_s:.1f} to {s.end_s:.1f} s, from here on {changed}: '


def steps(part: Part) -> Table:
    """Step responses by class."""
    rows = []
    for axis, on_axis in part.axes.items():
        for s in on_axis.steps:
            f = s.figures
            largest = f'{DEG * s.largest:.0f}' + (' deg/s' if s.quantity == 'rate' else ' deg')
            rows.append([axis, s.quantity, s.amplitude, largest, _three(1e3 * f.rise_time_s),
                         _or(f.overshoot_pct, '.1f'), _three(1e3 * f.settling_time_s),
                         _three(1e3 * s.latency_s),
                         f'{100.0 - f.final_error_pct:.0f}', f'{100.0 * s.fit:.0f}',
                         str(s.windows)])
    return Table(['axis', 'of', 'set-points', 'up to', 'rise, ms', 'over, %', 'settled, ms',
                  'half, ms', 'end, %', 'fit, %', 'n'], rows, range(3, 11), caption=(
                      f'{_title(part)}Step response by regularised deconvolution of set-point and '
                      'measurement; rise 10 to 90 %, settled within 5 %, half: time to half the '
                      'step; end: level reached; fit: share of the output that it explains; n '
                      'windows.'))


def loops(part: Part) -> Table:
    """Closed loop and margins."""
    rows = []
    for axis, on_axis in part.axes.items():
        loop = on_axis.loop
        if loop is not None:
            rows.append([
                axis, f'{loop.frequency_hz[0]:.2g} to {loop.frequency_hz[-1]:.3g}',
                _three(loop.bandwidth_hz), '–' if not np.isfinite(loop.peak) else
                f'{loop.peak:.2f} at {loop.peak_hz:.3g}',
                _three(loop.crossover_hz), _or(loop.phase_margin_deg, '.0f'),
                _or(loop.gain_margin_db, '.1f'),
                '–' if not np.isfinite(loop.sensitivity) else
                f'{loop.sensitivity:.2f} at {loop.sensitivity_hz:.3g}'])
    return Table(['axis', 'coherent, Hz', '-3 dB, Hz', 'peak, Hz', 'crossover, Hz', 'phase, °',
                  'gain, dB', 'sensitivity, Hz'], rows, range(1, 8), caption=(
                      f'{_title(part)}Frequency response of the rate loop, measured with the '
                      'set-point or the injected signal as instrument. -3 dB and peak are those '
                      'of the tracking; crossover, margins and peak sensitivity follow from the '
                      "measured plant and the log's gains. A dash: gains or coherence are missing."
                  ))


def delays(part: Part) -> Table:
    """Table of the delays in the loop."""
    rows = [[axis, d.part, f'{d.milliseconds:.2f}', f'{d.degrees:.1f}',
             f'{on_axis.loop.delay_hz:.3g}', d.how]
            for axis, on_axis in part.axes.items() if on_axis.loop is not None
            for d in on_axis.loop.delays]
    return Table(['axis', 'part', 'ms', 'phase, °', 'at, Hz', 'by'], rows, (2, 3, 4), caption=(
        f'{_title(part)}What delays the loop, at its crossover where that is known. The rest is '
        'the delay from command to angular acceleration (negative: a lead) less the parts above '
        "it; it is left out where the damping's phase lead is larger."))


def noise(part: Part) -> Table:
    """RMS of gyro and D part, and their largest peaks."""
    rows = []
    for axis, on_axis in part.axes.items():
        for name, frames, scale, unit in (
                ('gyro before filters', on_axis.gyro_before, DEG, 'deg/s'),
                ('gyro', on_axis.gyro, DEG, 'deg/s'),
                ('D part', on_axis.d_term, 100.0, '% command')):
            if frames is None:
                continue
            high = noise_rms(frames)
            rows.append([axis, name, f'{scale * frames.rms(1.0):.3g}',
                         '–' if high is None else f'{scale * high:.3g}', unit,
                         _peaks(frames.peaks(), scale)])
    return Table(['axis', 'signal', 'RMS', f'above {NOISE_HZ:g} Hz', 'unit', 'peaks'], rows,
                 (2, 3), caption=f'{_title(part)}RMS of what is faster than 1 Hz, of that above '
                 f'{NOISE_HZ:g} Hz, and of peaks; a dash where the log is too slow.')


def _peaks(peaks: Sequence[Peak], scale: float) -> str:
    return ', '.join(f'{scale * p.rms:.2g} at {p.frequency_hz:.0f} Hz' for p in peaks) or '–'


def tracking(part: Part) -> Table:
    """Tracking error by axis."""
    rows = [[axis, t.quantity, f'{DEG * t.setpoint_rms:.3g}', f'{DEG * t.error_rms:.3g}',
             f'{DEG * t.error_rms_delayed:.3g}', _ms(t.latency_s)]
            for axis, on_axis in part.axes.items() for t in on_axis.tracking]
    return Table(['axis', 'of', 'set-point RMS', 'error RMS', 'left if delayed', 'by'], rows,
                 range(2, 6), caption=f'{_title(part)}deg/s and deg. Left: the error against the '
                 'set-point delayed so that it is least; a dash where no delay lowers it.')


def motors(look: Measured) -> Table:
    """Balance and limits."""
    rows = [[m.name, f'{m.mean:.3f}', f'{m.apart_pct:+.1f}', f'{m.at_zero_pct:.2g}',
             f'{m.at_one_pct:.2g}', '–' if m.speed_rad_s is None else
             f'{m.speed_rad_s * 30.0 / math.pi:.0f}'] for m in look.motors]
    return Table(['motor', 'mean command', 'from the mean, %', 'at lowest, %', 'at 1, %', 'rpm'],
                 rows, range(1, 6))


def _ms(seconds: float) -> str:
    return f'{number(1e3 * seconds)} ms' if np.isfinite(seconds) else '–'


def _three(value: float) -> str:
    return number(value) if np.isfinite(value) else '–'


def _or(value: float, form: str) -> str:
    return f'{value:{form}}' if np.isfinite(value) else '–'


def tree(look: Measured) -> dict[str, Any]:
    """The measurements for `--json`: SI units, null where something was not measured."""
    flight = look.flown
    return dict(_plain({
        'schema': SCHEMA, 'source': flight.source, 'kind': flight.kind,
        'sample_rate_hz': 1.0 / flight.dt, 'length_s': flight.length_s,
        'flown_s': look.whole.flown_s, 'gaps': flight.gaps, 'answer': sentences(look),
        'axes': _axes(look.whole),
        'stretches': [{**vars(p.stretch), 'axes': _axes(p)} for p in look.parts],
        'motors': look.motors, 'lacks': flight.lacks, 'warnings': flight.warnings,
        'gains': look.whole.stretch.gains,
    }))


def _axes(part: Part) -> dict[str, Any]:
    return {axis: {
        'steps': [{**{name: value for name, value in vars(step).items() if name != 'figures'},
                   **vars(step.figures)} for step in on_axis.steps],
        'loop': _loop(on_axis.loop), 'tracking': on_axis.tracking,
        'noise': {name: {'rms': frames.rms(1.0), f'rms_above_{NOISE_HZ:g}_hz':
                         noise_rms(frames), 'peaks': frames.peaks()}
                  for name, frames in (('gyro_before', on_axis.gyro_before),
                                       ('gyro', on_axis.gyro), ('d_term', on_axis.d_term))
                  if frames is not None},
    } for axis, on_axis in part.axes.items()}


def _loop(loop: LoopResponse | None) -> dict[str, Any] | None:
    return None if loop is None else {
        **{name: value for name, value in vars(loop).items()
           if name not in ('plant', 'loop', 'tracking')},
        'tracking_abs': np.abs(loop.tracking), 'tracking_deg': np.degrees(np.angle(loop.tracking))}


def _plain(value: Any) -> Any:
    """The value for JSON: null where it is not finite; arrays to five digits."""
    if is_dataclass(value):
        value = vars(value)
    if isinstance(value, Mapping):
        return {name: _plain(item) for name, item in value.items()}
    if isinstance(value, np.ndarray):
        return [_plain(float(f'{number:.5g}')) for number in value]
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
