"""Time stamps → the uniform grid of the control cycle: which sample belongs to which cell.

Pure array maths on nanoseconds. Repairs are reported as warnings; no rate is invented.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError

IntArray = npt.NDArray[np.int64]
TOPIC = '/imu/data'
"""Whose stamps are the grid."""

MIN_SAMPLES = 3
"""Least number of messages of a recording."""
LEAK = 0.02
"""Share of the remaining phase by which the grid follows the stamps, per sample."""
JUMP_NS = 1_000_000_000
"""A step beyond it, either way, may be a clock that was set."""
MAX_GAP_S = 600.0
"""Longest gap, s, within a recording; between longer ones the longest stretch is kept."""
RATE_TOLERANCE = 0.15
"""Relative difference above which a block has another rate."""
ONE_CYCLE = 0.5
"""A step that is off by less, as a share, is one cycle and neither none nor two."""
SEVERAL = 1.5
"""Commands in a cycle of the rates from which their mean counts, and cycles for each command from
which it is held."""
CRYSTAL = 2e-4
"""Two clocks differ by less than this share, so an interval that is so near whole µs is meant."""
BLOCK = 32
"""Differences per block in which the rate is checked."""
TOGETHER, TICKS = 0.2, 0.05
"""Part of the usual interval within which samples come together, and the share of them from which
their times are those of a slow clock or of bursts; fewer are duplicates."""
STEADY_PACE = 0.5
"""Part by which the pace of BLOCK samples may differ where they come at a steady one in bursts."""
TWICE = 0.5
"""How much larger the share of equal samples is among those of one stamp than among the others
where each was written twice."""
REPEATED = 1.1
"""Samples for each value from which a logger may have repeated what it had."""
CHANGES, PACE, STEADY = 32, 0.02, 0.8
"""Changes over which their pace is measured, five times at least; the part by which it may differ,
besides one sample; and how often it must not."""
JITTER_WARNING = 0.25
"""Jitter of the stamps, cycles (99th percentile), above which a warning says so."""


@dataclass(frozen=True)
class Grid:
    """The cells of one stream of stamps."""

    dt: float
    """Length of a cell, s."""
    t0_ns: int
    n: int
    """Number of cells."""
    rows: IntArray
    """(m,) indices of the samples that are kept, in order of time."""
    cells: IntArray
    """(m,) their cells, strictly increasing from 0."""
    stamps: IntArray
    """(m,) their stamps, ns."""
    warnings: tuple[str, ...]

    def position(self, stamps: IntArray) -> FloatArray:
        """Position of other stamps in cells, extrapolated beyond the ends."""
        since = (stamps - self.t0_ns).astype(float)
        mine = (self.stamps - self.t0_ns).astype(float)
        place = np.interp(since, mine, self.cells.astype(float))
        step = self.dt * 1e9
        place = np.where(since < 0.0, since / step, place)
        beyond = since - mine[-1]
        return np.where(beyond > 0.0, self.cells[-1] + beyond / step, place)

    def place(self, stamps: IntArray, values: FloatArray) -> FloatArray:
        """(n, w) values on the grid, of each cell the nearest within half a cycle; else NaN."""
        out = np.full((self.n, values.shape[1]), np.nan)
        if len(stamps) == 0:
            return out
        rows = _in_order(stamps, np.arange(len(stamps)), [])
        place = self.position(stamps[rows])
        cells = np.rint(place).astype(np.int64)
        order = np.argsort(np.abs(place - cells), kind='stable')[::-1]  # the nearest comes last
        order = order[(cells[order] >= 0) & (cells[order] < self.n)]
        out[cells[order]] = values[rows[order]]
        return out

    def commanded(self, stamps: IntArray, values: FloatArray) -> FloatArray:
        """(n, w) commands on the grid, each of which holds until the next one.

        Of several in a cycle the mean counts, one for several cycles is held; NaN where the next
        one is late by half the usual interval.
        """
        is_finite = np.isfinite(values).all(axis=1)
        rows = _in_order(stamps, np.flatnonzero(is_finite), [])
        place = self.position(stamps[rows])
        steps = np.diff(place)
        usual = float(np.median(steps)) if steps.size else 1.0
        if 1.0 / SEVERAL < usual < SEVERAL:
            return self.place(stamps, values)
        held = values[rows]
        sums = np.concatenate([np.zeros((1, held.shape[1])),
                               np.cumsum(held[:-1] * steps[:, None], axis=0)])
        edges = np.arange(self.n + 1.0)
        last = np.clip(np.searchsorted(place, edges + 1e-6, side='right') - 1, 0, None)
        out = np.diff(sums[last] + held[last] * (edges - place[last])[:, None], axis=0)
        oldest = max(1.0, SEVERAL * usual)
        begins, ends = np.append(0.0, place + oldest) + 1e-6, np.append(place, self.n) - 1e-6
        for i in np.flatnonzero(begins < ends):  # in between none is known
            out[max(math.floor(begins[i]), 0) : max(math.ceil(ends[i]), 0)] = np.nan
        return np.asarray(out)


def uniform_grid(stamps: IntArray, source: str) -> Grid:
    """Grid of `stamps` (ns, in order of arrival), with warnings of what was repaired.

    Raises BadInputError where there is no single sample rate.
    """
    warnings: list[str] = []
    rows = np.flatnonzero(stamps > 0)
    if len(rows) < len(stamps):
        warnings.append(f'{TOPIC}: {len(stamps) - len(rows)} messages without a stamp left out')
    rows = _in_order(stamps, rows, warnings)
    rows = _longest_stretch(stamps, rows, warnings)
    if len(rows) < MIN_SAMPLES:
        raise BadInputError(source, f'{TOPIC} has too few stamped messages', len(rows),
                            f'at least {MIN_SAMPLES} are needed; record longer')
    nominal = float(np.median(np.diff(stamps[rows])))
    rows = _one_rate(stamps, rows, nominal, source, warnings)
    times = stamps[rows]
    steps = np.diff(times)
    near = np.abs(steps / nominal - 1.0) < ONE_CYCLE
    if near.mean() > 0.5:  # the median of steps that jitter is a per cent off, their mean is not
        nominal = float(steps[near].mean())
    cells, phase = count_cycles(steps / nominal)
    first = np.concatenate(([True], np.diff(cells) > 0))
    if not first.all():
        warnings.append(f'{TOPIC}: {np.count_nonzero(~first)} stamps fall into an occupied cycle; '
                        'kept the first')
    rows, times, cells = rows[first], times[first], cells[first]
    dt = _interval(times, cells)
    _tell_gaps(cells, dt, warnings)
    jitter = float(np.quantile(np.abs(phase), 0.99))
    if jitter > JITTER_WARNING:
        warnings.append(f'{TOPIC}: stamps jitter by {100 * jitter:.0f} % of a cycle (p99)')
    return Grid(dt=dt, t0_ns=int(times[0]), n=int(cells[-1]) + 1, rows=rows, cells=cells,
                stamps=times, warnings=tuple(warnings))


def spread(times: FloatArray, values: FloatArray | None = None) -> tuple[FloatArray, str]:
    """Times (n,) of samples (n, k) that came at one pace, in the order of arrival; what was done.

    Those of one tick of a slow clock lie between it and the next; those that arrived together were
    measured after what arrived before. values: where samples may have been written twice.
    """
    steps = np.diff(times)
    blocks = times[BLOCK:] - times[:-BLOCK]
    pace = float(np.median(blocks)) / BLOCK if blocks.size else 0.0
    together = (steps >= 0.0) & (steps <= TOGETHER * pace)
    if not TICKS * steps.size < np.count_nonzero(together) < steps.size:
        return times, ''
    is_late = bool(np.mean(steps[together] > 0.0) > 0.5)
    low, high = np.quantile(blocks, (0.05, 0.95)) if is_late else (0.0, 0.0)
    is_twice = False
    if values is not None:
        equal = np.isclose(values[1:], values[:-1], 0.0, 0.0, equal_nan=True)
        same = np.asarray(equal.all(axis=1))
        is_twice = same[together].mean() - same[~together].mean() > TWICE
    if is_twice or high - low > STEADY_PACE * high:
        return times, ''
    clock = -times[::-1] if is_late else times
    first = np.append(True, ~(together[::-1] if is_late else together))
    ticks = np.flatnonzero(first)
    k = min(BLOCK, ticks.size - 1)
    pace = float(np.median((clock[ticks[k:]] - clock[ticks[:-k]]) / (ticks[k:] - ticks[:-k])))
    following = np.append(clock[ticks[1:]], np.inf)[np.cumsum(first) - 1]
    out, at = np.empty_like(clock), clock[0] - pace
    for i, (tick, after) in enumerate(zip(clock.tolist(), following.tolist(), strict=True)):
        out[i] = at = max(tick, min(at + pace, after))
    share = f'{100 * together.mean():.0f} %'
    if is_late:
        return -out[::-1], f'{share} of the rows come right behind another: spread, as in bursts'
    return out, (f'the clock ticks more slowly than the rows come ({share} repeat a time): rows '
                 'are spread between the ticks')


def _in_order(stamps: IntArray, rows: IntArray, warnings: list[str]) -> IntArray:
    """Rows sorted by stamp without duplicates; after a jump of the clock, what follows in time."""
    steps = np.diff(stamps[rows])
    if (steps > 0).all():
        return rows
    back = int(np.count_nonzero(steps < -JUMP_NS))
    if back:
        chain = _longest_chain(np.split(rows, np.flatnonzero(np.abs(steps) > JUMP_NS) + 1), stamps)
        warnings.append(
            f'{TOPIC}: the clock was set back {back} times: {len(rows) - len(chain)} of '
            f'{len(rows)} messages, whose stamps fit to no others, are left out'
        )
        rows = chain
    times = stamps[rows]
    backward = int(np.count_nonzero(np.diff(times) < 0))
    if backward:
        warnings.append(f'{TOPIC}: {backward} stamps run backward; sorted by stamp')
        rows = rows[np.argsort(times, kind='stable')]
        times = stamps[rows]
    later = np.concatenate(([True], np.diff(times) > 0))
    if not later.all():
        warnings.append(
            f'{TOPIC}: {np.count_nonzero(~later)} messages repeat a stamp; kept the first of each'
        )
    return rows[later]


def _longest_chain(parts: list[IntArray], stamps: IntArray) -> IntArray:
    """Rows of the parts that follow each other in time, with the most messages.

    A stretch of wrong stamps falls out alone; of a clock that stays set back one side is left.
    """
    first = np.array([stamps[part].min() for part in parts])
    last = np.array([stamps[part].max() for part in parts])
    total = np.array([len(part) for part in parts])
    previous = np.full(len(parts), -1)
    for i in range(1, len(parts)):
        behind = np.where(last[:i] < first[i], total[:i], 0)
        if behind.any():
            previous[i] = int(np.argmax(behind))
            total[i] += behind[previous[i]]
    chain, index = [], int(np.argmax(total))
    while index >= 0:
        chain.append(parts[index])
        index = previous[index]
    return np.concatenate(chain[::-1])


def _longest_stretch(stamps: IntArray, rows: IntArray, warnings: list[str]) -> IntArray:
    """Keep the stretch with most samples between gaps of more than MAX_GAP_S."""
    breaks = np.flatnonzero(np.diff(stamps[rows]) > MAX_GAP_S * 1e9)
    if len(breaks) == 0:
        return rows
    longest = max(np.split(rows, breaks + 1), key=len)
    warnings.append(f'{TOPIC}: gaps of more than {MAX_GAP_S:g} s; kept the longest stretch, '
                    f'{len(longest)} of {len(rows)} messages')
    return longest


def _one_rate(stamps: IntArray, rows: IntArray, nominal: float, source: str,
              warnings: list[str]) -> IntArray:
    """Rows without stretches of another sample rate, whose time becomes a gap."""
    steps = np.diff(stamps[rows]) / nominal
    blocks = len(steps) // BLOCK
    if blocks == 0:
        return rows
    medians = np.median(steps[: blocks * BLOCK].reshape(blocks, BLOCK), axis=1)
    other = np.abs(medians - 1.0) > RATE_TOLERANCE
    if not other.any():
        return rows
    share = float(other.mean())
    if share > 0.5:
        raise BadInputError(
            source, f'{TOPIC} has no steady rate',
            f'{100 * share:.0f} % of the time more than {100 * RATE_TOLERANCE:.0f} % off '
            f'{1e9 / nominal:.4g} Hz',
            'record at one fixed rate, or check which program fills header.stamp',
        )
    first = int(np.flatnonzero(other)[0]) * BLOCK
    rate = 1e9 / (nominal * float(np.median(medians[other])))
    warnings.append(
        f'{TOPIC}: the rate changes from {1e9 / nominal:.4g} Hz to about {rate:.4g} Hz at '
        f'{(stamps[rows[first]] - stamps[rows[0]]) * 1e-9:.2f} s; '
        f'the {100 * share:.0f} % at another rate are left out as a gap'
    )
    drop = np.zeros(len(rows), dtype=bool)
    drop[: blocks * BLOCK] = np.repeat(other, BLOCK)
    drop[blocks * BLOCK :] = other[-1]
    return rows[~drop]


def count_cycles(steps: FloatArray) -> tuple[IntArray, FloatArray]:
    """Cell (n,) and phase (n,), in cycles, of every sample; the phase follows slow drift.

    `steps` (n - 1,) are the times between samples in cycles. A gap of more than two cycles resets
    the phase; cells repeat where two samples lie within half a cycle.
    """
    cells = np.zeros(len(steps) + 1, dtype=np.int64)
    phases = np.zeros(len(steps) + 1)
    cell, phase = 0, 0.0
    for i, step in enumerate(steps.tolist()):
        place = phase + step
        count = round(place)
        phase = 0.0 if count > 2 else (place - count) * (1.0 - LEAK)
        cell += count
        cells[i + 1] = cell
        phases[i + 1] = phase
    return cells, phases


def new_rows(values: FloatArray) -> npt.NDArray[np.bool_]:
    """(n,) where measured values (n, k) are new, if a logger repeated each until the next came.

    Such values change at a steady pace; those that stay the same by their resolution do not, and
    all of them count.
    """
    new = np.concatenate(([True], (values[1:] != values[:-1]).any(axis=1)))
    spans = np.diff(np.flatnonzero(new)[::CHANGES])
    usual = float(np.median(spans)) if spans.size >= 5 else 0.0
    steady = np.abs(spans - usual) <= 1.0 + PACE * usual
    is_repeated = usual >= REPEATED * CHANGES and steady.mean() >= STEADY
    return new if is_repeated else np.ones_like(new)


def _interval(times: IntArray, cells: IntArray) -> float:
    """Sample interval, s: the mean outside gaps, in whole µs if that fits."""
    counts = np.diff(cells)
    near = counts <= 2
    mean_ns = float(np.diff(times)[near].sum() / counts[near].sum())
    return in_whole_us(mean_ns * 1e-9)


def in_whole_us(dt: float) -> float:
    """A mean interval, s, in whole µs where that is what was meant."""
    rounded = round(dt * 1e6) / 1e6
    return rounded if rounded and abs(rounded / dt - 1.0) < CRYSTAL else dt


def _tell_gaps(cells: IntArray, dt: float, warnings: list[str]) -> None:
    missing = np.diff(cells) - 1
    if missing.any():
        worst = int(np.argmax(missing))
        warnings.append(
            f'{TOPIC}: {int(missing.sum())} of {int(cells[-1]) + 1} cycles lost, the longest gap '
            f'{missing[worst] * dt:.3f} s at {cells[worst] * dt:.2f} s'
        )
