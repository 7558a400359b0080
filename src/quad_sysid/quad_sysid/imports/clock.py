"""Times of a recording → one grid of control cycles, and streams on it.

Rates are interpolated smoothly, commands are held, a pause stays a gap; the texts say what was
done. Array maths only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from quad_sysid.bags.stamps import count_cycles, in_whole_us, new_rows, spread
from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.record import finite_runs

BACK = 5.0
"""Usual intervals by which rows may go back in time and are sorted; further back, the clock was
set and another experiment begins."""
EPOCH_S = 1e8
"""Times beyond this count as seconds since 1970; others start at one second."""
JUMP_S, JUMP_INTERVALS = 10.0, 20.0
"""Forward jump (s, and usual intervals) from which another experiment begins."""
MIN_SAMPLES = 20
"""Least rows of a stretch between two jumps; fewer are wrong stamps."""
SPARSEST = 0.01
"""Least share of a grid's cycles that hold a sample; with fewer, times are wrong."""
PAUSE_S, PAUSE_INTERVALS = 2.0, 5.0
"""Pause inserted between two experiments."""
UNEVEN = 0.3
"""An interval this far from the median, as a share of it, is odd."""
MAX_ODD = 0.03
"""Share of odd intervals up to which each sample keeps its own cycle."""
FEW_LOST = 0.9
"""Share of usual intervals among whole multiples of them down to which the grid has all cycles."""
MAX_JITTER = 0.1
"""Largest jitter, cycles (99 % quantile), with which samples are not interpolated."""
BLOCK = 16
"""Number of intervals whose mean gives a rate."""
STEADY = 0.2
"""Spread of these means up to which there is one rate with jitter."""
MAX_RATE_HZ = 20e3
"""Highest sample rate of flight controllers and rigs."""
MAX_DRAWN = 2.5
"""Longest interval, cycles, that is interpolated; a longer one is a gap."""
MAX_PAUSE = 3.0
"""Usual intervals for which a command is held."""
MOST_LOOPS = 1.5
"""Usual interval of a command, in the controller's cycles, from which some are not in the log."""
MOST_LEFT_OUT = 64
"""Cycles for each command in the log beyond which the stated cycle is not believed."""
PARTS = 8
"""Parts of a cycle over which the active command is averaged."""


@dataclass(frozen=True)
class Stream:
    """Samples (n, w) at times (n,) in s since the controller started, in the order of time."""

    time_s: FloatArray
    values: FloatArray

    @property
    def rate_hz(self) -> float:
        """Median rate; 0 with fewer than 2 samples."""
        steps = np.diff(self.time_s)
        usual = float(np.median(steps)) if steps.size else 0.0
        return 1.0 / usual if usual > 0.0 else 0.0


@dataclass(frozen=True)
class Unrolled:
    """Rows of increasing time, restarts and jumps removed."""

    rows: np.ndarray
    """(m,) indices of the original rows, in order of time."""
    time_s: FloatArray
    """(m,) strictly increasing, from one second on if they do not count from 1970."""
    notes: tuple[str, ...]


@dataclass(frozen=True)
class Cycles:
    """The bag's control cycles and the samples of the rates on them."""

    times: FloatArray
    """(n,) s, in the recording's time."""
    dt: float
    values: FloatArray
    """(n, w) NaN in gaps."""
    own: bool
    """Whether the cycles are those of the samples."""
    notes: tuple[str, ...]

    def seconds(self, time_s: float) -> float:
        """A time of the recording in the bag's, which counts `dt` for each cycle from the first.

        Over ten minutes the two may be a tenth of a second apart.
        """
        inside = float(np.clip(time_s, self.times[0], self.times[-1]))
        place = float(np.interp(inside, self.times, np.arange(self.times.size)))
        return self.dt * place + time_s - inside


def unroll(time_s: FloatArray, values: Sequence[FloatArray], where: str) -> Unrolled:
    """Rows (n,) in an order of increasing time; experiments after a jump follow each other.

    `values`, columns (n,) each, distinguish duplicate rows from rows within one tick of the clock.
    Raises BadInputError, naming `where`, where the time never advances.
    """
    rows = np.flatnonzero(np.isfinite(time_s))
    notes = _omitted(len(time_s) - len(rows), 'rows without a time')
    if len(rows) < 2:
        raise BadInputError(where, 'holds no times', remedy='name another column as the time')
    repeated = np.concatenate(([False], _repeated(time_s, values, rows)))
    notes += _omitted(int(repeated.sum()), 'rows written twice')
    rows = rows[~repeated]
    steps = np.diff(time_s[rows])
    if not (steps > 0.0).any():
        raise BadInputError(where, 'does not increase', remedy='name another column as the time')
    interval = float(np.median(steps[steps > 0.0]))
    jump = _jump(interval)
    long = [rows[part] for part in _stretches(time_s[rows], interval)]
    notes += _omitted(len(rows) - sum(map(len, long)), 'rows with a time far off')
    if not long:
        raise BadInputError(where, 'jumps from row to row', f'{len(rows)} rows',
                            'name another column as the time')
    back = sum(int(np.count_nonzero(np.diff(time_s[part]) < 0.0)) for part in long)
    if back:
        notes.append(f'{back} rows ran back in time and were sorted')
    long = [part[np.argsort(time_s[part], kind='stable')] for part in long]
    pause = max(PAUSE_S, PAUSE_INTERVALS * interval)
    moments = [time_s[long[0]]]
    for part in long[1:]:
        step = time_s[part[0]] - moments[-1][-1]
        moments.append(time_s[part] + (0.0 if 0.0 < step <= jump else pause - step))
    jumps = sum(float(m[0]) != float(time_s[p[0]]) for m, p in zip(moments, long, strict=True))
    if jumps:
        notes.append(f'{jumps} jumps of the clock: {jumps + 1} experiments, placed {pause:.3g} s '
                     'apart')
    chosen = np.concatenate(long)
    moment, note = spread(np.concatenate(moments))
    first = np.concatenate(([True], np.diff(moment) > 0.0))
    notes += [note] * bool(note) + _omitted(int((~first).sum()), 'rows that repeat a time')
    chosen, moment = chosen[first], moment[first]
    moment = moment if moment[0] > EPOCH_S else moment - moment[0] + 1.0
    return Unrolled(chosen, moment, tuple(notes))


def _jump(interval: float) -> float:
    """Step, s, beyond which another experiment begins."""
    return max(JUMP_S, JUMP_INTERVALS * interval)


def _stretches(time_s: FloatArray, interval: float) -> list[np.ndarray]:
    """Indices of the rows between jumps of the clock, without those of wrong stamps."""
    steps = np.diff(time_s)
    jumps = (steps < -BACK * interval) | (steps > _jump(interval))
    parts = np.split(np.arange(len(time_s)), np.flatnonzero(jumps) + 1)
    return [part for part in parts if len(part) >= min(MIN_SAMPLES, len(time_s))]


def _omitted(count: int, what: str) -> list[str]:
    return [f'{count} {what} left out'] if count else []


def _repeated(time_s: FloatArray, values: Sequence[FloatArray], rows: np.ndarray) -> np.ndarray:
    """(m - 1,) whether one of m rows repeats the time and values of the one before."""
    out = np.asarray(np.diff(time_s[rows]) == 0.0)
    index = np.flatnonzero(out)
    for column in values:
        a, b = column[rows[index + 1]], column[rows[index]]
        out[index] &= (a == b) | (np.isnan(a) & np.isnan(b))
    return out


def fresh(stream: Stream) -> Stream:
    """Each measured value once, where a logger repeated it until the next one came; else all."""
    new = new_rows(stream.values)
    return stream if new.all() else Stream(stream.time_s[new], stream.values[new])


def cycles(samples: Stream, where: str, grid_hz: float | None = None,
           dt: float | None = None) -> Cycles:
    """The grid of the rates' samples: their own cycles where they are even, else interpolated.

    `grid_hz` overrides the rate of the grid; `dt`, s, is the cycle of samples that all lie on
    multiples of it, however many of them are missing. Raises BadInputError where `grid_hz` is far
    above the samples', or, naming `where`, where their times leave almost all of the grid empty.
    """
    if dt is not None:
        cells = np.rint((samples.time_s - samples.time_s[0]) / dt).astype(np.int64)
        return _own(samples.time_s, samples.values, dt, cells, f'{len(cells)} samples')
    interval = float(np.median(np.diff(samples.time_s)))
    near_others = _stretches(samples.time_s, interval)
    rows = np.concatenate(near_others) if near_others else np.arange(len(samples.time_s))
    wrong = _omitted(len(samples.time_s) - len(rows), 'samples with a time far off')
    samples = Stream(samples.time_s[rows], samples.values[rows])
    time_s, values = samples.time_s, samples.values
    span = time_s[-1] - time_s[0]
    if SPARSEST * span > interval * len(time_s):
        raise BadInputError(where, 'has times that are damaged, or pauses almost throughout',
                            f'{len(time_s)} samples of {interval:.3g} s within {span:.3g} s',
                            'copy it again, or import a part of it')
    steps = np.diff(time_s)
    near = np.abs(steps / interval - 1.0) <= UNEVEN
    odd = int(np.count_nonzero(~near))
    head = f'{len(time_s)} samples, a median of {1.0 / interval:.4g} Hz, {odd} odd intervals'
    head = '; '.join([*wrong, head])
    highest = min(MAX_RATE_HZ, 4.0 / interval)  # four cycles per sample at most
    if grid_hz is not None and grid_hz > highest:
        raise BadInputError('--grid', f'must be at most {highest:.4g} Hz', f'{grid_hz:g} Hz',
                            f'the log has {1.0 / interval:.4g} Hz; leave --grid out')
    even = near.mean() >= 1.0 - MAX_ODD
    if grid_hz is not None:
        dt, why = 1.0 / grid_hz, 'as --grid says'
    elif even:
        dt = in_whole_us(float(steps[near].mean()))
        cells, phase = count_cycles(steps / dt)
        jitter = float(np.quantile(np.abs(phase), 0.99))
        if jitter <= MAX_JITTER:
            return _own(time_s, values, dt, cells, head)
        why = f'jitter of {100.0 * jitter:.0f} % of a cycle'
    else:
        dt, why = _uneven(steps, interval), 'the rate is uneven'
    times = time_s[0] + dt * np.arange(int((time_s[-1] - time_s[0]) / dt + 1e-6) + 1)
    drawn = draw(samples, times, MAX_DRAWN * max(dt, interval))
    return Cycles(times, dt, drawn, own=False, notes=(
        f'{head}; rates interpolated on a grid of {1.0 / dt:.4g} Hz ({why}){_gaps(drawn, dt)}',
    ))


def _own(
    time_s: FloatArray, values: FloatArray, dt: float, cells: np.ndarray, head: str
) -> Cycles:
    first = np.concatenate(([True], np.diff(cells) > 0))
    crowded = int(np.count_nonzero(~first))
    cells, time_s = cells[first], time_s[first]
    out = np.full((int(cells[-1]) + 1, values.shape[1]), np.nan)
    out[cells] = values[first]
    more = f', {crowded} in an occupied cycle left out' if crowded else ''
    times = np.interp(np.arange(len(out)), cells, time_s)
    return Cycles(times, dt, out, own=True, notes=(
        f'{head}; each kept in its own cycle of {1.0 / dt:.4g} Hz{more}{_gaps(out, dt)}',
    ))


def _gaps(values: FloatArray, dt: float) -> str:
    is_lost = np.asarray(np.isnan(values).all(axis=1))
    gaps = finite_runs(is_lost, (0, len(is_lost)))
    if not gaps:
        return ''
    if len(gaps) == 1:
        return f'; a gap of {is_lost.sum() * dt:.3g} s stays'
    return (f'; {len(gaps)} gaps of {is_lost.sum() * dt:.3g} s in all stay, the longest '
            f'{max(b - a for a, b in gaps) * dt:.3g} s')


def _uneven(steps: FloatArray, interval: float) -> float:
    """Interval of the grid for uneven times.

    The mean where the means of 16 intervals agree (jitter), or the usual one where all are
    multiples of it, so that only rows are missing here and there. Otherwise many were dropped or
    the rate changes, and the longest intervals that are not gaps count.
    """
    blocks = len(steps) // BLOCK
    if blocks:
        means = steps[: blocks * BLOCK].reshape(blocks, BLOCK).mean(axis=1)
        low, high = np.quantile(means, (0.05, 0.95))
        if high - low < STEADY * high:
            share = steps / interval
            near = np.abs(share - 1.0) <= UNEVEN
            distance = np.abs(share - np.round(share))
            if near.mean() >= FEW_LOST and np.quantile(distance, 0.99) <= MAX_JITTER:
                return in_whole_us(float(steps[near].mean()))
            usual = (means >= low) & (means <= high)
            return in_whole_us(float(means[usual].mean()))
    return in_whole_us(float(np.quantile(steps, 1.0 - MAX_ODD)))


def draw(stream: Stream, times: FloatArray, longest: float) -> FloatArray:
    """Samples interpolated smoothly without overshoot (PCHIP).

    NaN where samples are more than `longest` s apart, and beyond the ends.
    """
    from scipy.interpolate import pchip_interpolate  # slow to import

    time_s = stream.time_s
    if len(time_s) < 2:
        return np.full((len(times), stream.values.shape[1]), np.nan)
    values = np.asarray(pchip_interpolate(time_s, stream.values, times), dtype=np.float64)
    after = np.clip(np.searchsorted(time_s, times), 1, len(time_s) - 1)
    wide = np.diff(time_s)[after - 1] > longest
    at_sample = np.minimum(np.abs(times - time_s[after]), np.abs(times - time_s[after - 1]))
    outside = (times < time_s[0]) | (times > time_s[-1] + longest / MAX_DRAWN)
    values[(wide & (at_sample > 1e-9)) | outside] = np.nan
    return values


def hold(stream: Stream, times: FloatArray, dt: float, interval: float | None = None
         ) -> FloatArray:
    """The active value at each time: the last one, at most half a cycle later.

    interval: the usual one of the stream, s, if not that of its own times.
    """
    interval = interval or (1.0 / stream.rate_hz if stream.rate_hz else np.inf)
    index = np.searchsorted(stream.time_s, times + 0.5 * dt, side='right') - 1
    is_recent = index >= 0
    index = np.maximum(index, 0)
    is_recent &= times - stream.time_s[index] <= MAX_PAUSE * max(interval, dt)
    out = stream.values[index].copy()
    out[~is_recent] = np.nan
    return np.asarray(out, dtype=np.float64)


def every_cycle(stream: Stream, loop_s: float | None) -> Stream:
    """A command of each of the controller's cycles: straight lines between those that are logged.

    A held one would be late by half of what the log leaves out.
    """
    steps = np.diff(stream.time_s)
    usual = float(np.median(steps)) if steps.size else 0.0
    if loop_s is None or not MOST_LOOPS * loop_s <= usual <= MOST_LEFT_OUT * loop_s:
        return stream
    is_known = np.asarray(np.isfinite(stream.values).all(axis=1))
    drawn = (steps <= MAX_DRAWN * usual) & is_known[1:] & is_known[:-1]
    parts = np.where(drawn, np.rint(steps / loop_s), 1.0)
    parts = np.append(np.maximum(parts, 1.0).astype(int), 1)
    first = np.repeat(np.arange(parts.size), parts)
    share = (np.arange(first.size) - (np.cumsum(parts) - parts)[first]) / parts[first]
    later = np.minimum(first + 1, parts.size - 1)
    place = first + share
    values = stream.values[first].copy()
    on_line = np.asarray(share > 0.0)
    values[on_line] += (share[:, None] * (stream.values[later] - stream.values[first]))[on_line]
    return Stream(np.interp(place, np.arange(parts.size), stream.time_s), values)


def drawn_on(stream: Stream | None, times: FloatArray) -> FloatArray | None:
    """A smooth curve between samples; NaN in pauses and beyond the ends, None without two."""
    if stream is None or len(stream.time_s) < 2:
        return None
    return draw(stream, times, MAX_PAUSE / stream.rate_hz)


def hold_if_any(stream: Stream | None, times: FloatArray, dt: float) -> FloatArray | None:
    """`hold` for a stream that may be absent; None without one."""
    return None if stream is None else hold(stream, times, dt)


def mean_of_next_cycle(stream: Stream, times: FloatArray, dt: float,
                       interval: float | None = None) -> FloatArray:
    """Mean of the active value from each time to the next; interval: as in `hold`."""
    parts = dt / PARTS
    sub_times = (times[:, None] + parts * np.arange(PARTS)).ravel()
    resampled = hold(stream, sub_times, parts, interval)
    return np.asarray(resampled.reshape(len(times), PARTS, -1).mean(axis=1), dtype=np.float64)
