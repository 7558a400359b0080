"""Power spectra of a signal: mean, over time, over throttle, in orders of the rotors. Pure.

All are means over one set of frames: Hann windows of FRAME_S, half overlapping, without a gap.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from quad_sysid.contract import FloatArray

FRAME_S = 0.5
"""Length of a frame, s: 2 Hz between lines."""
THROTTLE = np.linspace(0.0, 1.0, 41)
"""Edges of the throttle's classes."""
ORDERS = np.linspace(0.25, 4.25, 161)
"""Edges of the classes of frequency over rotor frequency."""
PEAK, PEAKS = 3.0, 3
"""A peak is this factor above the median around it, in power; so many are stated."""
MIN_WINDOWS = 8
"""Frames from which a peak is stated: the mean of fewer has some by chance."""
AROUND_HZ = 30.0
"""Span whose median is the floor from which a peak stands out."""
LOWEST_PEAK_HZ = 20.0
"""Below this is what the aircraft flies."""


@dataclass(frozen=True)
class Peak:
    """A peak of a spectrum."""

    frequency_hz: float
    rms: float
    """RMS of the lines that stand out of the background, in the signal's unit."""


@dataclass(frozen=True)
class Frames:
    """Spectra of all frames of one signal."""

    frequency_hz: FloatArray
    """(f,)"""
    density: FloatArray
    """(k, f) power, unit²/Hz."""
    time_s: FloatArray
    """(k,) middle of each frame."""
    at: npt.NDArray[np.int64]
    """(k,) first sample of each."""
    size: int
    """Samples in a frame."""

    @cached_property
    def mean(self) -> FloatArray:
        """(f,) unit²/Hz."""
        return np.asarray(self.density.mean(axis=0))

    def rms(self, low_hz: float, high_hz: float = np.inf) -> float:
        """RMS within a band, in the signal's unit."""
        inside = (self.frequency_hz >= low_hz) & (self.frequency_hz < high_hz)
        return float(np.sqrt(self.mean[inside].sum() * self.frequency_hz[1]))

    def over(self, values: FloatArray, edges: FloatArray) -> FloatArray:
        """(c, f) mean density of the frames by the mean of `values` (n,); NaN without any."""
        sums = np.concatenate(([0.0], np.cumsum(np.nan_to_num(values))))
        return self.at_places((sums[self.at + self.size] - sums[self.at]) / self.size, edges)

    def at_places(self, places: FloatArray, edges: FloatArray) -> FloatArray:
        """(c, f) mean density of the frames by where each of them is (k,); NaN without any."""
        group = np.digitize(places, edges) - 1
        out = np.full((len(edges) - 1, len(self.frequency_hz)), np.nan)
        for c in np.unique(group[(group >= 0) & (group < len(out))]):
            out[c] = self.density[group == c].mean(axis=0)
        return out

    def orders(self, rotor_hz: FloatArray) -> FloatArray | None:
        """(ORDERS - 1,) mean density over f / rotor_hz (n,); None where that is unknown."""
        mean = np.array([float(np.mean(rotor_hz[a:a + self.size])) for a in self.at])
        least = 2.0 * self.frequency_hz[1] / np.diff(ORDERS)[0] / 8.0
        is_finite = np.isfinite(mean) & (mean > least)
        if not is_finite.any():
            return None
        centres = 0.5 * (ORDERS[1:] + ORDERS[:-1])
        rows = [np.interp(centres * hz, self.frequency_hz, row, right=np.nan)
                for hz, row in zip(mean[is_finite], self.density[is_finite], strict=True)]
        finite = np.isfinite(rows)
        total = np.where(finite, rows, 0.0).sum(axis=0)
        return np.where(finite.any(axis=0), total / np.maximum(finite.sum(axis=0), 1), np.nan)

    def peaks(self) -> tuple[Peak, ...]:
        """The largest peaks above what surrounds them."""
        if len(self.density) < MIN_WINDOWS:
            return ()
        line = float(self.frequency_hz[1])
        reach = max(3, round(AROUND_HZ / line))
        padded = np.pad(self.mean, reach, mode='reflect') if len(self.mean) > reach else self.mean
        if len(padded) == len(self.mean):
            return ()
        floor = np.median(np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1), axis=1)
        stands = (self.mean > PEAK * floor) & (self.frequency_hz >= LOWEST_PEAK_HZ)
        edges = np.flatnonzero(np.diff(np.concatenate(([False], stands, [False]))))
        out = []
        for a, b in edges.reshape(-1, 2):
            power = float((self.mean[a:b] - floor[a:b]).sum() * line)
            centre = float(self.frequency_hz[a:b] @ self.mean[a:b] / self.mean[a:b].sum())
            out.append(Peak(centre, float(np.sqrt(power))))
        return tuple(sorted(out, key=lambda p: -p.rms)[:PEAKS])


def starts_of(usable: npt.NDArray[np.bool_], size: int) -> npt.NDArray[np.int64]:
    """First samples of windows of this size, half overlapping, in which all is usable."""
    lost_before = np.concatenate(([0], np.cumsum(~usable)))
    starts = np.arange(0, len(usable) - size + 1, max(1, size // 2))
    return np.asarray(starts[lost_before[starts + size] == lost_before[starts]])


def frames(signal: FloatArray, usable: npt.NDArray[np.bool_], dt: float) -> Frames | None:
    """The frames of a signal (n,) within `usable` (n,); None without any."""
    size = round(FRAME_S / dt)
    # a log too slow for 8 samples in a frame has no spectrum
    if size < 8 or not len(starts := starts_of(usable & np.isfinite(signal), size)):
        return None
    window = np.hanning(size + 1)[:size]
    cut = signal[starts[:, None] + np.arange(size)]
    spectra = np.fft.rfft((cut - cut.mean(axis=1, keepdims=True)) * window, axis=1)
    density = np.abs(spectra) ** 2 * (2.0 * dt / (window @ window))
    density[:, 0] *= 0.5
    if size % 2 == 0:
        density[:, -1] *= 0.5
    lines = np.asarray(np.fft.rfftfreq(size, dt), float)
    return Frames(lines, density, np.asarray((starts + 0.5 * size) * dt), starts, size)
