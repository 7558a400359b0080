"""A ForeignLog → a bag of the contract: every stream on the cycles of the rates, then write_bag.

How times become cycles is clock.py's, what the motors do is motor_layout.py's; here both are
asked, and the result is reported.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from quad_sysid.bags.reader import joined
from quad_sysid.bags.stamps import SEVERAL
from quad_sysid.bags.writer import BagOptions, write_bag
from quad_sysid.contract import FloatArray
from quad_sysid.craft import Craft, X
from quad_sysid.errors import BadInputError
from quad_sysid.foresight import drawn_hz
from quad_sysid.imports import clock
from quad_sysid.imports.clock import Cycles, Stream
from quad_sysid.imports.experiments import with_experiments
from quad_sysid.imports.log import FAST_ENOUGH, ForeignLog
from quad_sysid.imports.mixers import Mixer, chosen, mixer_of_patterns
from quad_sysid.imports.plausible import contradicted
from quad_sysid.imports.stretches import airborne, with_stretches
from quad_sysid.imports.stretches import summary as stretches_summary
from quad_sysid.motion import turned
from quad_sysid.motor_layout import (
    Pattern,
    commands_of,
    doubts,
    exchanged,
    opposite,
    patterns_of,
)
from quad_sysid.record import SHORT_GAP_S, GainChange, Record, finite_runs

MIDDLE_COMMAND = 0.5
"""U1 beside the command of a single axis: the middle of the motors' range."""
LOST = 0.005
"""Share of lost samples from which on the logger is blamed."""
LAST_S = 2.0**31 - 1e6
"""ROS' seconds end in 2038; a later date is damage."""
MIN_SAMPLES = 100
"""Least number of samples of a log."""
MEASURED = ('rates', 'angles', 'acceleration', 'velocity', 'position')
"""Streams that do not stand still between samples, as commands and set-points do."""
SLOWEST_HZ = 50.0
"""A slower log of a flight controller shows neither the motors' lag nor the delay."""
DERIVATIVE_HALF_WIDTH_S = 0.01
"""Half the width, s, of the cubic whose slope is the rate of an angle."""


@dataclass(frozen=True)
class Imported:
    """An imported log."""

    path: Path
    log: ForeignLog
    record: Record
    """The record as written."""
    notes: tuple[str, ...]
    """Repairs of times, and findings on motors."""
    warnings: tuple[str, ...]


def import_log(log: ForeignLog, out: Path, grid_hz: float | None = None) -> Imported:
    """Write the bag, on a grid of `grid_hz`, Hz; None: the log's own rate.

    Raises BadInputError where `out` exists or the log holds too little.
    """
    if out.exists():
        raise BadInputError(str(out), 'exists and is not overwritten',
                            remedy='choose another --out')
    read = record_of(log, grid_hz)
    notes = {
        'import': f'{Path(log.source).name}, {log.kind}: ' + '; '.join(
            f'{m.source} [{m.unit}] as {m.topic}' + (f' ({m.how})' if m.how else '')
            for m in log.mapped
        ),
        'import clock': '; '.join(read.notes),
    }
    warnings = (*log.checks, *read.warnings)
    if warnings:
        notes['import check'] = '; '.join(warnings)
    return Imported(write_bag(read.record, out, BagOptions(notes=notes)), log, read.record,
                    tuple(read.notes), warnings)


@dataclass(frozen=True)
class OnGrid:
    """A log on the cycles of its rates, or of its angles without them."""

    record: Record
    grid: Cycles
    notes: list[str]
    """Repairs of times, and findings on motors."""
    warnings: list[str]


def gains_of(
    log: ForeignLog, gains: Mapping[str, float], grid: Cycles
) -> tuple[GainChange, ...]:
    """The gains of a record on these cycles of the log, with what its import added.

    What a change no longer names is switched off, 0: a bag's events add to those before.
    """
    off = dict.fromkeys((name for values in (log.gains, *(c.values for c in log.gain_changes))
                         for name in values), 0.0)
    changes = [GainChange(grid.seconds(change.time_s), {**gains, **off, **change.values})
               for change in log.gain_changes]
    initial = [gains, *(change.values for change in changes if change.time_s <= 0.0)]
    return (*([GainChange(0.0, initial[-1])] if initial[-1] else []),
            *(change for change in changes if change.time_s > 0.0))


def uneven(notes: Sequence[str]) -> list[str]:
    """The first of the notes, about the clock, unless all samples came in time."""
    return [note for note in notes[:1] if ', 0 odd intervals; each sample keeps' not in note]


def record_of(
    log: ForeignLog, grid_hz: float | None = None, dt: float | None = None
) -> OnGrid:
    """A log on the cycles of its rates, or of its angles without them.

    `grid_hz` and `dt` as in clock.cycles. Raises BadInputError where the log holds too little.
    """
    log, held = _once(log)
    base = log.rates or log.angles
    if base is None or len(base.time_s) < MIN_SAMPLES:
        raise BadInputError(log.source, 'has too few samples of the body rates',
                            0 if base is None else len(base.time_s),
                            f'at least {MIN_SAMPLES} are needed; log longer')
    grid = clock.cycles(base, log.source, grid_hz, dt)
    faster = f' ({log.faster})' if log.faster else ''
    notes, warnings = [*log.clock, *grid.notes], [*held, *log.warnings]
    gains = dict(log.gains)
    rates, angles = _motion(log, grid, gains, notes, warnings)
    control, motors, craft = _commands(log, grid, rates, angles, notes, warnings)
    control, motors = _armed(log, grid, control, motors, warnings)
    if not np.isfinite(rates[:, 0] + control[:, 0]).any():
        raise BadInputError(log.source, 'rates and commands were never logged together',
                            remedy='log both during the same flight')
    if not any(np.unique(column[np.isfinite(column)]).size > 1 for column in control.T):
        raise BadInputError(log.source, 'holds commands that never change',
                            remedy='; '.join([*log.clock, 'import a log of a flight']))
    if grid.dt > 1.0 / SLOWEST_HZ and log.faster:
        warnings.append(f'{1.0 / grid.dt:.3g} Hz is too slow to show lag and delay: '
                        f'{log.faster}')
    commands = log.control or log.motors
    drawn = drawn_hz(control[:, 1:], grid.dt)
    if drawn:
        warnings.append(
            f'the commands are straight lines between samples at some {drawn:.3g} Hz: they were '
            'interpolated and not logged at this rate, so no effect can be claimed from them: log '
            f'the commands at the full rate{faster}')
    drawn = drawn_hz(rates, grid.dt)
    if drawn and log.rates is not None:
        warnings.append(f'the rates are straight lines between samples at some {drawn:.3g} Hz, '
                        'which a fit takes for motion: give each sample once')
    if commands is not None and commands.rate_hz < FAST_ENOUGH / grid.dt:
        warnings.append(
            f'the commands were logged at {commands.rate_hz:.3g} Hz and the rates at '
            f'{1.0 / grid.dt:.4g} Hz; between them the last one is held, so fast motion has the '
            f'wrong input: log the commands at the full rate{faster}')
    if log.kind == 'a table':  # a row is whole or a gap
        is_lost = np.asarray(np.isnan(control).any(axis=1))
        rates = np.where(is_lost[:, None], np.nan, rates)
    utc_s = grid.times[0] + (log.utc_s or 0.0)
    start = utc_s if clock.EPOCH_S < utc_s < LAST_S else 1.0
    record = Record(source=log.source, dt=grid.dt, t0_ns=round(start * 1e9),
                    rates=rates, control=control, wrench=None if motors is not None else control,
                    motors=motors, craft=craft, speeds=_speeds(log, grid, motors),
                    desaturation='clip' if motors is not None else 'none', angles=angles,
                    acceleration=clock.drawn_on(log.acceleration, grid.times),
                    attitude_setpoint=clock.hold_if_any(log.attitude_setpoint, grid.times,
                                                        grid.dt),
                    rate_setpoint=clock.hold_if_any(log.rate_setpoint, grid.times, grid.dt),
                    battery_v=volts_on(log.battery, grid.times),
                    **_translation(log, grid, angles, warnings),
                    gains=gains_of(log, gains, grid))
    record, experiment = with_experiments(record, log.experiments, grid)
    if not experiment:
        record = with_stretches(record, log.axes)
        experiment = stretches_summary(record)
    notes += [experiment] if experiment else []
    return OnGrid(record, grid, notes, [*warnings, *([] if held else _gaps(record, log))])


def _once(log: ForeignLog) -> tuple[ForeignLog, list[str]]:
    """The log, of a table with each measured value once; a line that says so."""
    new: dict[str, Any] = {}
    rows = []
    for role in MEASURED if log.kind == 'a table' else ():
        stream = getattr(log, role)
        if stream is not None and (once := clock.fresh(stream)) is not stream:
            new[role] = once
            rows.append(f'{role} {len(stream.time_s) / len(once.time_s):.3g}')
    text = ('measured values were repeated until the next one came (rows for each: '
            f'{", ".join(rows)}): each is taken once')
    return replace(log, **new), [text] * bool(new)


def _gaps(record: Record, log: ForeignLog) -> list[str]:
    """A warning on a log that loses many samples, which is the logger's fault."""
    is_lost = np.asarray(np.isnan(record.rates).all(axis=1))
    gaps = [b - a for a, b in finite_runs(is_lost, (0, record.n))]
    short = [n for n in gaps if n * record.dt <= SHORT_GAP_S]
    if not short or sum(short) < LOST * record.n:
        return []
    share = 100.0 * sum(short) / record.n
    return [f'the logger lost {share:.2g} % of the samples in {len(short)} short gaps of '
            f'up to {1e3 * max(short) * record.dt:.0f} ms; the fit predicts through '
            'them, but log fewer columns, or to a faster medium' + (
                f' ({log.faster})' if log.faster else '')]


def _motion(
    log: ForeignLog, grid: Cycles, gains: dict[str, float], notes: list[str], warnings: list[str]
) -> tuple[FloatArray, FloatArray | None]:
    """Rates (n, 3) and angles (n, 3); those that contradict the rates are left out."""
    angles = clock.drawn_on(log.angles, grid.times)
    if log.rates is None:
        rates, how = _derivative(grid.values, grid.dt)
        gains['sensor.rate_from_angle_s'] = DERIVATIVE_HALF_WIDTH_S
        notes.append(f'rates by {how}')
        return rates, angles
    if angles is not None and log.kind != 'a table':  # there they are refused
        contradictions = contradicted(grid.values, angles, grid.dt)
        moves = log.velocity is not None or log.position is not None
        left_out = ', and speed and position with them' if moves else ''
        warnings += [f'{line}: the angles are left out{left_out}' for line in contradictions]
        angles = None if contradictions else angles
    return grid.values, angles


def _commands(
    log: ForeignLog, grid: Cycles, rates: FloatArray, angles: FloatArray | None,
    notes: list[str], warnings: list[str],
) -> tuple[FloatArray, FloatArray | None, Craft]:
    """U1..U4 (n, 4), and the motors (n, k) with their craft, where one is known."""
    if log.motors is None:
        if log.control is None:
            raise BadInputError(log.source, 'holds no commands',
                                remedy='log the motors or the output of the controller')
        control = _on_grid(log, log.control, grid, notes)
        patterns = commands_of(rates, control[:, 1:], grid.dt, angles)
        notes += [pattern.sentence for pattern in patterns]
        warnings += [*opposite(patterns, log.reversing),
                     *exchanged(patterns, rates, control[:, 1:], grid.dt)]
        return control, None, X
    motors = _on_grid(log, log.motors, grid, notes)
    rates = np.where(airborne(motors.mean(axis=1), grid.dt)[:, None], rates, np.nan)
    patterns = patterns_of(rates, motors, grid.dt, angles)
    notes += [pattern.sentence for pattern in patterns]
    craft = chosen(log.crafts, patterns, rates, motors, grid.dt)
    if craft is None:
        craft = _by_motion(log, patterns, motors.shape[1], warnings)
    else:
        warnings += doubts(craft.name, craft.inverse, patterns, rates, motors, grid.dt, angles)
    if isinstance(craft, Mixer):
        warnings.append(f'{craft.name} is no place and spin of each motor, so the bag holds what '
                        'the motors do together, not each of them')
        return motors @ craft.inverse.T, None, X
    notes.append(f'{craft.name}: ' + ', '.join(
        f'motor_{k} {place}' for k, place in enumerate(craft.places, 1)))
    return craft.control(motors), motors, craft


def _armed(log: ForeignLog, grid: Cycles, control: FloatArray, motors: FloatArray | None,
           warnings: list[str]) -> tuple[FloatArray, FloatArray | None]:
    """Commands as they reach the motors: none while disarmed, whatever was demanded."""
    if log.armed is None:
        return control, motors
    index = np.searchsorted(log.armed.time_s, grid.times, side='right') - 1
    off = log.armed.values[np.maximum(index, 0), 0] == 0.0
    if off.any():
        warnings.append(f'disarmed for {off.sum() * grid.dt:.3g} s of {off.size * grid.dt:.3g} s: '
                        'the motors stood still then, and the commands count as 0')
    stands = off[:, None]
    return np.where(stands, 0.0, control), None if motors is None else np.where(
        stands, 0.0, motors)


def _by_motion(
    log: ForeignLog, patterns: tuple[Pattern, ...], motors: int, warnings: list[str]
) -> Craft | Mixer:
    certain = [p for p in patterns if p.certain and p.axis in log.axes]
    if not certain:
        best = '; '.join(pattern.sentence for pattern in patterns) or 'nothing moves'
        raise BadInputError(log.source, 'does not show what the motors do', best,
                            'name the mixer, or fly an excitation')
    lost_axes = [axis for axis in log.axes if axis not in {p.axis for p in certain}]
    if lost_axes:
        names = ', '.join(lost_axes)
        warnings.append(f'what the motors do to {names} is not certain: its command '
                        'is set to 0')
    return mixer_of_patterns(certain, motors)


def _on_grid(log: ForeignLog, logged: Stream, grid: Cycles, notes: list[str]) -> FloatArray:
    """(n, k) what the commands are in each cycle of the grid."""
    # slower ones are held, and the report says so
    is_fast = logged.rate_hz >= FAST_ENOUGH / grid.dt
    stream = clock.every_cycle(logged, log.loop_s if is_fast else None)
    if stream is not logged:
        notes.append(f'commands on straight lines between the logged ones, one for each '
                     f'{1e3 * (log.loop_s or 0.0):.3g} ms of the controller')
        return clock.mean_of_next_cycle(stream, grid.times, grid.dt, 1.0 / logged.rate_hz)
    if grid.own and logged.rate_hz * grid.dt < SEVERAL:
        return clock.hold(stream, grid.times, grid.dt)
    return clock.mean_of_next_cycle(stream, grid.times, grid.dt, grid.dt if grid.own else None)


def _speeds(log: ForeignLog, grid: Cycles, motors: FloatArray | None) -> FloatArray | None:
    """Rotor speeds (n, k) beside the motors that they belong to."""
    if log.speeds is None or motors is None or log.speeds.values.shape[1] != motors.shape[1]:
        return None
    return joined(log.speeds.time_s, log.speeds.values, grid.times)


def _translation(log: ForeignLog, grid: Cycles, angles: FloatArray | None,
                 warnings: list[str]) -> dict[str, Any]:
    """Speed along the heading and altitude, in the cycles in which they were logged."""
    velocity, position = log.velocity, log.position
    if velocity is None and position is not None and len(position.time_s) > 2:
        slope = np.gradient(position.values, position.time_s, axis=0)
        velocity = Stream(position.time_s, np.asarray(slope))
    if velocity is None or len(velocity.time_s) < 2:
        return {}
    if angles is None:
        if log.angles is None:
            warnings.append('speed and position are left out, since the bag holds them by the '
                            'attitude: log the angles of roll, pitch and yaw')
        return {}
    if 'yaw' not in log.axes:
        warnings.append('the heading is not known and counts as 0: surge and sway are right only '
                        'where the aircraft pointed along x; add the angle of yaw')
    out = {'velocity': turned(_in_cells(velocity, grid), -angles[:, 2])}
    if position is not None:
        out['altitude'] = _in_cells(position, grid)[:, 2]
    return out


def _in_cells(stream: Stream, grid: Cycles) -> FloatArray:
    """(n, k) each sample in the cycle that is nearest; NaN in the others."""
    out = np.full((grid.times.size, stream.values.shape[1]), np.nan)
    cells = np.rint(np.interp(stream.time_s, grid.times, np.arange(grid.times.size))).astype(int)
    inside = (stream.time_s >= grid.times[0] - grid.dt) & (
        stream.time_s <= grid.times[-1] + grid.dt)
    out[cells[inside]] = stream.values[inside]
    return out


def volts_on(stream: Stream | None, times: FloatArray) -> FloatArray | None:
    """(n,) V, as straight lines; None where it was not logged."""
    if stream is None or not len(stream.time_s):
        return None
    return np.asarray(np.interp(times, stream.time_s, stream.values[:, 0]))


def _derivative(angles: FloatArray, dt: float) -> tuple[FloatArray, str]:
    """Rates (n, 3) of angles (n, 3) without phase shift, and what they were made by.

    Savitzky-Golay (Anal. Chem. 36, 1964): slope of a cubic fitted over 10 ms to either side, at
    least 2 samples; its -3 dB frequency is some (order + 1) / (3.2 m - 4.6) of half the sample
    rate for m samples to either side. Runs too short for it stay NaN.
    """
    from scipy.signal import savgol_filter  # slow to import, and only an angle alone needs it

    half = max(2, round(DERIVATIVE_HALF_WIDTH_S / dt))
    width = 2 * half + 1
    out = np.full(angles.shape, np.nan)
    is_finite = np.asarray(np.isfinite(angles).all(axis=1))
    for start, stop in finite_runs(is_finite, (0, len(angles))):
        if stop - start >= width:
            out[start:stop] = savgol_filter(
                angles[start:stop], width, 3, deriv=1, delta=dt, mode='interp',
                axis=0,
            )
    return out, f'a zero-phase Savitzky-Golay derivative (cubic over {width} samples)'
