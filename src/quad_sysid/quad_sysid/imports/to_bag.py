"""A ForeignLog → a bag of the contract: every stream on the cycles of the rates, then write_bag.

What was logged more slowly than the rates is held (commands, references) or drawn straight
(angles, battery) between its samples, and said; a pause in a stream stays a gap.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from quad_sysid.bags.importer import MIDDLE_COMMAND
from quad_sysid.bags.stamps import Grid, uniform_grid
from quad_sysid.bags.writer import BagOptions, write_bag
from quad_sysid.contract import FloatArray, control_from_motors, motors_from_wrench
from quad_sysid.errors import BadInputError
from quad_sysid.imports.log import ForeignLog, Stream
from quad_sysid.record import GainChange, Record

LONGEST_PAUSE = 3.0
"""Usual intervals of a stream after which its last value counts no more."""
SLOW = 0.5
"""A command logged at less than this share of the rates' rate is told."""
BEYOND_LIMIT = 0.1
"""Share of samples that no X frame's motors can give, up to which they are left out as gaps."""
LEAST_SAMPLES = 100
MOST_DROPPED = 0.03
"""Share of uneven intervals up to which the rates keep their own cycles."""
UNEVEN = 0.3
"""An interval this far from the median, as a share of it, is uneven."""
PARTS = 8
"""Of a coarser cycle, over which the command in force is averaged."""


@dataclass(frozen=True)
class Imported:
    """What became of a log."""

    path: Path
    log: ForeignLog
    record: Record
    """As it was written."""
    warnings: tuple[str, ...]


def import_log(log: ForeignLog, out: Path) -> Imported:
    """Write the bag; raises BadInputError where `out` exists or the log has no steady rate."""
    if out.exists():
        raise BadInputError(str(out), 'exists and is not overwritten',
                            remedy='choose another --out')
    if len(log.rates.time_s) < LEAST_SAMPLES:
        raise BadInputError(log.source, 'has too few samples of the body rates',
                            len(log.rates.time_s), 'log longer')
    cycles = _cycles(log)
    times, dt = cycles.times, cycles.dt
    warnings = [*log.warnings, *cycles.warnings]
    held = _held(log.control, times, dt) if cycles.own else _mean_ahead(log.control, times, dt)
    control, told = _possible(held, log)
    warnings += told
    if log.control.rate_hz < SLOW / dt:
        warnings.append(
            f'the commands were logged at {log.control.rate_hz:.3g} Hz and the rates at '
            f'{1.0 / dt:.4g} Hz; between them the last one is held, so fast motion has the '
            'wrong input: log the commands at the full rate'
        )
    record = Record(
        source=log.source, dt=dt, t0_ns=round(times[0] * 1e9),
        rates=cycles.rates, control=control, wrench=control,
        angles=_drawn(log.angles, times), acceleration=_drawn(log.acceleration, times),
        attitude_setpoint=_maybe_held(log.attitude_setpoint, times, dt),
        rate_setpoint=_maybe_held(log.rate_setpoint, times, dt),
        battery_v=_volts(log.battery, times),
        gains=(GainChange(0.0, log.gains),) if log.gains else (),
    )
    if not np.isfinite(record.rates[:, 0] + record.control[:, 0]).any():
        raise BadInputError(log.source, 'rates and commands were never logged together')
    notes = {'import': f'{Path(log.source).name}, a {log.kind} log: ' + '; '.join(
        f'{m.source} [{m.unit}] as {m.topic}' for m in log.mapped
    )}
    return Imported(
        write_bag(record, out, BagOptions(notes=notes)), log, record, tuple(warnings)
    )


@dataclass(frozen=True)
class _Cycles:
    """The bag's control cycles."""

    times: FloatArray
    """(n,) s."""
    dt: float
    rates: FloatArray
    """(n, 3) rad/s."""
    own: bool
    """Whether the cycles are those of the rates' own samples."""
    warnings: tuple[str, ...]


def _cycles(log: ForeignLog) -> _Cycles:
    """The samples' own cycles or, where the logger dropped many of them, coarser ones.

    On those the rates are drawn straight between their neighbours.
    """
    time_s, values = log.rates.time_s, log.rates.values
    steps = np.diff(time_s)
    uneven = np.abs(steps / np.median(steps) - 1.0) > UNEVEN
    if uneven.mean() <= MOST_DROPPED:
        grid = uniform_grid(np.rint(time_s * 1e9).astype(np.int64), log.source, 'body rates')
        times = np.interp(np.arange(grid.n), grid.cells, grid.stamps * 1e-9)
        return _Cycles(times, grid.dt, _placed(grid, values), own=True, warnings=grid.warnings)
    dt = max(round(float(np.quantile(steps, 1.0 - MOST_DROPPED)), 6), 1e-6)
    times = time_s[0] + dt * np.arange(int((time_s[-1] - time_s[0]) / dt) + 1)
    rates = np.column_stack([np.interp(times, time_s, column) for column in values.T])
    after = np.clip(np.searchsorted(time_s, times), 1, len(time_s) - 1)
    rates[steps[after - 1] > (1.0 + UNEVEN) * dt] = np.nan
    return _Cycles(times, dt, rates, own=False, warnings=(
        (f'the samples of the rates come unevenly (the logger drops some): they are drawn '
         f'straight on a grid of {1.0 / dt:.4g} Hz'),
    ))


def _placed(grid: Grid, values: FloatArray) -> FloatArray:
    out = np.full((grid.n, values.shape[1]), np.nan)
    out[grid.cells] = values[grid.rows]
    return out


def _mean_ahead(stream: Stream, times: FloatArray, dt: float) -> FloatArray:
    """Mean of what is in force from each time to the next."""
    parts = dt / PARTS
    fine = (times[:, None] + parts * np.arange(PARTS)).ravel()
    held = _held(stream, fine, parts)
    return np.asarray(held.reshape(len(times), PARTS, -1).mean(axis=1), dtype=np.float64)


def _held(stream: Stream, times: FloatArray, dt: float) -> FloatArray:
    """The value in force at each time: the last one up to half a cycle later."""
    usual = 1.0 / stream.rate_hz if stream.rate_hz else np.inf
    at = np.searchsorted(stream.time_s, times + 0.5 * dt, side='right') - 1
    known = at >= 0
    at = np.maximum(at, 0)
    known &= times - stream.time_s[at] <= LONGEST_PAUSE * max(usual, dt)
    out = stream.values[at].copy()
    out[~known] = np.nan
    return np.asarray(out, dtype=np.float64)


def _maybe_held(stream: Stream | None, times: FloatArray, dt: float) -> FloatArray | None:
    return None if stream is None else _held(stream, times, dt)


def _drawn(stream: Stream | None, times: FloatArray) -> FloatArray | None:
    """A straight line between samples; NaN in pauses and beyond the ends."""
    if stream is None or len(stream.time_s) < 2:
        return None
    values = np.column_stack([np.interp(times, stream.time_s, v) for v in stream.values.T])
    after = np.clip(np.searchsorted(stream.time_s, times), 1, len(stream.time_s) - 1)
    wide = np.diff(stream.time_s)[after - 1] > LONGEST_PAUSE / stream.rate_hz
    outside = (times < stream.time_s[0]) | (times > stream.time_s[-1] + 1.0 / stream.rate_hz)
    values[wide | outside] = np.nan
    return values


def _volts(stream: Stream | None, times: FloatArray) -> FloatArray | None:
    if stream is None or not len(stream.time_s):
        return None
    return np.asarray(np.interp(times, stream.time_s, stream.values[:, 0]))


def _possible(control: FloatArray, log: ForeignLog) -> tuple[FloatArray, list[str]]:
    """Keep what the contract's mixer and limits let through, as the bag's reader will ask.

    Motors that turn the other way can give more yaw than the contract's; a controller may ask
    for torque at a throttle that allows none.
    """
    told: list[str] = []
    share = float(np.mean(_beyond(control)))
    if share > BEYOND_LIMIT and log.from_motors:
        control = _with(control, 3, 0.0)
        told.append(
            f'yaw commands are left out: with them {100.0 * share:.0f} % of the samples are '
            "beyond the limits of the contract's mixer"
        )
    elif share > BEYOND_LIMIT:
        control = _with(control, 0, MIDDLE_COMMAND)
        told.append(
            f'U1 stands as {MIDDLE_COMMAND:g}: in {100.0 * share:.0f} % of the samples the '
            'throttle is too low for the torque that was asked for (on the ground, or no '
            'multirotor flight?); what the motors did is not known, a thrust curve cannot be told'
        )
    beyond = _beyond(control)
    if beyond.mean() > BEYOND_LIMIT:
        raise BadInputError(
            log.source, 'commands are beyond what the motors of an X frame can give',
            f'{100.0 * beyond.mean():.0f} % of the samples', 'is it a quadrotor in X?',
        )
    if beyond.any():
        told.append(f'{int(beyond.sum())} samples left out that no motors of an X frame can give')
        control = control.copy()
        control[beyond] = np.nan
    return control, told


def _with(control: FloatArray, column: int, value: float) -> FloatArray:
    """The control with one column at a constant, gaps kept."""
    out: FloatArray = control.copy()
    out[~np.isnan(out[:, column]), column] = value
    return out


def _beyond(control: FloatArray) -> np.ndarray:
    limited = control_from_motors(motors_from_wrench(control))
    with np.errstate(invalid='ignore'):
        return np.asarray((np.abs(limited - control) > 1e-6).any(axis=1))
