"""The band in which the rate of an axis follows its excitation so far.

Squared coherence of the excitation as applied with the measured rate, by sine tapers (Riedel and
Sidorenko 1995) over each unbroken part: a frequency counts once a whole period of it lies in a
part. Feedback alone gives no coherence, because the excitation comes from outside the loop.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from quad_bridge.si import FloatArray

BAND = 0.1, 20.0  # rad/s, the default of the wanted band: its lowest period lasts 63 s
SPARED = 0.63
"""Share of a training segment in which the lowest period must fit."""
TAPERS = 5
POINTS = 30  # frequencies of the wanted band
MIN_PERIODS = 1.0  # a part counts for a frequency if it has so many periods of it
SMOOTHING = 0.15  # half the width over which a frequency is averaged, as a share of it
FINENESS = 8.0
"""Samples per period of the highest wanted frequency that are kept; more would only cost time."""
COHERENT = 0.6  # squared coherence from which the pair is trusted, as in the analysis
BRIDGED_S = 0.1
"""A shorter gap of lost cycles does not end a part: both signals are interpolated over it."""
CHANCE = 0.01  # a coherence that noise alone would reach with this probability does not count


@dataclass(frozen=True)
class Coverage:
    """Which frequencies of the wanted band, rad/s, are covered."""

    target: tuple[float, float]
    w: FloatArray  # (m,) frequencies inside the wanted band, log-spaced
    coherent: npt.NDArray[np.bool_]  # (m,)

    @property
    def share(self) -> float:
        """The covered share of the wanted band on a logarithmic scale, 0..1."""
        return float(np.mean(self.coherent)) if self.coherent.size else 0.0

    @property
    def band(self) -> tuple[float, float] | None:
        """The widest covered band without a gap, rad/s; None where nothing is covered."""
        edges = np.flatnonzero(np.diff(np.concatenate(([False], self.coherent, [False]))))
        if not edges.size:
            return None
        a, b = max(edges.reshape(-1, 2), key=lambda e: int(e[1] - e[0]))
        return float(self.w[a]), float(self.w[b - 1])

    @property
    def enough(self) -> bool:
        """Whether the whole wanted band is covered."""
        return bool(self.coherent.size) and bool(self.coherent.all())


def reachable(target: tuple[float, float], segment_s: float) -> tuple[float, float]:
    """The part of a band, rad/s, that a segment of this length can cover; all if it is unknown.

    Its low end rises to the frequency of which a period fits into SPARED of the segment.
    """
    low, high = target
    if not segment_s > 0.0:
        return target
    return min(max(low, 2.0 * np.pi * MIN_PERIODS / (SPARED * segment_s)), high), high


def needed_s(low: float) -> float:
    """Length in s of a training segment that can cover `low`, rad/s."""
    return 2.0 * np.pi * MIN_PERIODS / (SPARED * low)


def coverage(
    parts: Sequence[tuple[FloatArray, FloatArray]], dt: float, target: tuple[float, float],
) -> Coverage:
    """Coverage by unbroken parts of (excitation (n,), rate (n,)), dt in s, `target` in rad/s."""
    w = np.geomspace(*target, POINTS)
    xx, yy, windows = np.zeros(POINTS), np.zeros(POINTS), np.zeros(POINTS)
    xy = np.zeros(POINTS, dtype=complex)
    step = max(1, int(2.0 * np.pi / (FINENESS * target[1] * dt)))
    for x, y in parts:
        seconds = x.size * dt
        covered = w * seconds >= 2.0 * np.pi * MIN_PERIODS
        if covered.any() and x.size > 4 * step:
            sums = _spectra(_thinned(x, step), _thinned(y, step), step * dt, w[covered])
            xx[covered] += sums[0]
            yy[covered] += sums[1]
            xy[covered] += sums[2]
            windows[covered] += _windows(w[covered], seconds)
    squared = np.abs(xy) ** 2 / np.maximum(xx * yy, np.finfo(float).tiny)
    chance = 1.0 - CHANCE ** (1.0 / np.maximum(windows - 1.0, 1.0))
    return Coverage(target, w, (windows > 0.0) & (squared > np.maximum(COHERENT, chance)))


def _thinned(x: FloatArray, every: int) -> FloatArray:
    """Means over `every` samples each."""
    rows: FloatArray = x[:x.size // every * every].reshape(-1, every).mean(axis=1)
    return rows


def _spectra(
    x: FloatArray, y: FloatArray, dt: float, w: FloatArray
) -> tuple[FloatArray, FloatArray, npt.NDArray[np.complex128]]:
    """Sums over tapers and the neighbours of each w, of the excitation's change and the rate.

    Its change, because the loop holds the angle: the rate's answer to the excitation itself goes
    through zero at rest, and a window across it would see both signs.
    """
    a, b = np.diff(x), y[1:] - y[1:].mean()
    n = a.size
    k = np.arange(1, TAPERS + 1)[:, None]
    tapers = np.sqrt(2.0 / (n + 1)) * np.sin(np.pi * k * np.arange(1, n + 1) / (n + 1))
    fa, fb = np.fft.rfft(tapers * a), np.fft.rfft(tapers * b)
    xx, yy = (np.abs(fa) ** 2).sum(axis=0), (np.abs(fb) ** 2).sum(axis=0)
    xy = (np.conj(fa) * fb).sum(axis=0)
    bins = 2.0 * np.pi / (n * dt)
    low = np.clip(np.floor((1.0 - SMOOTHING) * w / bins + 0.5).astype(int), 0, xx.size - 1)
    high = np.clip(np.floor((1.0 + SMOOTHING) * w / bins + 0.5).astype(int), 0, xx.size - 1)
    total = [np.concatenate(([0.0], np.cumsum(sums))) for sums in (xx, yy, xy)]
    xx, yy, xy = (sums[high + 1] - sums[low] for sums in total)
    return xx.real, yy.real, xy


def _windows(w: FloatArray, seconds: float) -> FloatArray:
    """The number of independent windows that the sums at w amount to."""
    half = np.pi * (TAPERS + 1) / seconds  # half a taper's width, rad/s
    return TAPERS * np.maximum(1.0, SMOOTHING * w / half)


def _even(
    time_s: FloatArray, x: FloatArray, y: FloatArray, dt: float
) -> tuple[FloatArray, FloatArray]:
    """Both signals, interpolated on an even grid."""
    grid = np.arange(time_s[0], time_s[-1] + 0.5 * dt, dt)
    return np.interp(grid, time_s, x), np.interp(grid, time_s, y)


class Pairs:
    """Excitation and rate of one axis, matched by the stamps of their control cycles."""

    def __init__(self) -> None:
        self._rates: dict[int, float] = {}
        self._inputs: dict[int, float] = {}

    def rate(self, stamp_ns: int, value: float) -> None:
        """The measured rate of a cycle, rad/s."""
        self._rates[stamp_ns] = value

    def excitation(self, stamp_ns: int, value: float) -> None:
        """The excitation that the STM32 says it added in a cycle."""
        self._inputs[stamp_ns] = value

    def clear(self) -> None:
        """Forget all: another axis begins."""
        self.__init__()  # type: ignore[misc]

    def parts(self) -> tuple[list[tuple[FloatArray, FloatArray]], float]:
        """Unbroken parts (excitation, rate) and the cycle in s (0 where too little is known)."""
        stamps = np.array(sorted(self._rates.keys() & self._inputs.keys()), dtype=np.int64)
        steps = np.diff(stamps)
        dt = float(np.median(steps)) * 1e-9 if steps.size > 1 else 0.0
        if dt <= 0.0:
            return [], 0.0
        x, y = (np.array([values[s] for s in stamps.tolist()])
                for values in (self._inputs, self._rates))
        time_s = 1e-9 * (stamps - stamps[0])
        cuts = np.flatnonzero(steps > 1e9 * max(BRIDGED_S, 1.5 * dt)) + 1
        return [_even(*part, dt) for part in zip(
            np.split(time_s, cuts), np.split(x, cuts), np.split(y, cuts), strict=True
        )], dt
