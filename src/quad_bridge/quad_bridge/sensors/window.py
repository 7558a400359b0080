"""The last seconds of gyro and accelerometer, what estimates are made from. Pure.

Standing (disarmed) and flying samples are kept apart: a bias is estimated from the first only.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from quad_bridge.sensors.rest import LEAST_S, FloatArray, RestEstimate, estimate_at_rest

STANDING_S = LEAST_S + 1.0
SHAKING = 1024
"""Samples whose spectrum is looked at: four seconds at 250 Hz."""

Sample = tuple[float, float, float, float, float, float, float]
"""Device time in s, rates in rad/s, accelerations in m/s², FLU."""


class SensorWindow:
    """Feed it every cycle; ask it for an estimate or for the samples of a spectrum."""

    def __init__(self) -> None:
        self._standing: deque[Sample] = deque()
        self._latest: deque[Sample] = deque(maxlen=SHAKING)

    def clear(self) -> None:
        """Forget: the device has restarted."""
        self._standing.clear()
        self._latest.clear()

    def add(self, sample: Sample, *, standing: bool) -> None:
        """Take one cycle; the first that does not stand empties what stood."""
        if self._latest and sample[0] < self._latest[-1][0]:
            self.clear()  # its clock has wrapped or jumped
        self._latest.append(sample)
        if not standing:
            self._standing.clear()
            return
        self._standing.append(sample)
        while sample[0] - self._standing[0][0] > STANDING_S:
            self._standing.popleft()

    def standing(self) -> tuple[Sample, ...]:
        """A copy of what stood last."""
        return tuple(self._standing)

    def spectrum(self) -> tuple[float, FloatArray]:
        """Sample rate in Hz, 0 where unknown, and rates and accelerations (n, 6)."""
        samples = np.array(self._latest, dtype=float).reshape(-1, 7)
        step = float(np.median(np.diff(samples[:, 0]))) if len(samples) > 1 else 0.0
        return (1.0 / step if step > 0.0 else 0.0), samples[:, 1:]


def at_rest(samples: tuple[Sample, ...]) -> RestEstimate:
    """Estimate from what stood. Raises RefusedError, in one line."""
    rows = np.array(samples, dtype=float).reshape(-1, 7)
    return estimate_at_rest(rows[:, 0], rows[:, 1:4], rows[:, 4:])
