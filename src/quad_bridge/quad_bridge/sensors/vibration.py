"""Vibration of the sensors: the strongest line, and whether the filter suppresses it. Pure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quad_bridge.sensors.rest import MOST_READING, FloatArray

LOWEST_HZ = 12.0  # below it the aircraft flies; above it shakes
COVERED = 0.25  # a filter covers what it lowers to this share


@dataclass(frozen=True)
class Vibration:
    """The strongest line of a spectrum above LOWEST_HZ."""

    frequency_hz: float
    amplitude: float
    """Amplitude of a sinusoid of the same power, in the signal's unit."""
    share: float  # of the power above LOWEST_HZ that lies in this line; small for mere noise
    axis: str
    filter_gain: float  # what the filter leaves at this frequency

    @property
    def covered(self) -> bool:
        """True where the filter lowers the peak to a quarter or less."""
        return self.filter_gain <= COVERED


def butterworth_gain(frequency_hz: float, cutoff_hz: float) -> float:
    """Gain of a low-pass Butterworth filter of order 2."""
    return float(1.0 / np.sqrt(1.0 + (frequency_hz / cutoff_hz) ** 4))


def strongest(
    signal: FloatArray, rate_hz: float, cutoff_hz: float = 42.0, window: int = 256
) -> Vibration | None:
    """Find the peak in (n, 3) samples by averaged Hann periodograms; None where n < window."""
    if len(signal) < window or not (np.abs(signal) < MOST_READING).all():
        return None
    taper = np.hanning(window)
    starts = range(0, len(signal) - window + 1, window // 2)
    power = np.zeros((window // 2 + 1, signal.shape[1]))
    for start in starts:
        part = signal[start : start + window]
        spectrum = np.fft.rfft((part - part.mean(axis=0)) * taper[:, None], axis=0)
        power += 2.0 * np.abs(spectrum) ** 2 / (taper**2).sum() / window
    power /= len(starts)
    frequencies = np.fft.rfftfreq(window, 1.0 / rate_hz)
    power[frequencies < LOWEST_HZ] = 0.0
    peak, axis = np.unravel_index(int(np.argmax(power)), power.shape)
    line = slice(max(int(peak) - 2, 0), int(peak) + 3)
    inside = power[line, axis]
    total = float(power[:, axis].sum())
    if total <= 0.0:
        return None
    frequency = float((inside * frequencies[line]).sum() / inside.sum())
    return Vibration(
        frequency, float(np.sqrt(2.0 * inside.sum())), float(inside.sum()) / total,
        'xyz'[int(axis)], butterworth_gain(frequency, cutoff_hz),
    )  # fmt: skip
