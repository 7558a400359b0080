"""The aircraft's clock against the host's, from TIMESYNC round trips. No timers, no I/O.

Model: host = device + offset + drift (device - now). Weighted least squares over the last round
trips; a trip weighs by how much longer than the shortest it took (half of the excess bounds its
error), the drift has a prior of 100 ppm, a crystal's. A constant asymmetry of the two directions
cannot be seen; half the shortest round trip bounds it.

A trip's error is at most half of what it took beyond the shortest one, and the changes of the
asymmetry: what disagrees by more is a jump of one of the clocks, not noise.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

DRIFT_PRIOR = 1e-4
MAX_ROUND_TRIP_NS = 10_000_000
"""Longer round trips are dropped (`too_long_s` says so): they may have waited anywhere."""
WINDOW, MIN_SAMPLES = 150, 8
"""Round trips that count, and how many make it converged."""
JUMP_NS = 1_000_000
"""Beyond a trip's own error this is a jump; five times as much while the first find the drift."""
SPAN = 1 << 32
"""Of the counter that may lie behind a device's time."""
BLOCK_NS = 250_000_000
MAX_IN_BLOCK = 5000
"""Arrivals in a block: more than that come only where the device's time stands still."""
FLOOR_S = 20e-6  # standard deviation of the best round trip's offset, s


class _Trip(NamedTuple):
    device_ns: int
    offset_ns: int  # mid of the trip on the host's clock minus device time
    round_trip_ns: int


class ClockEstimator:
    """Feed it round trips with `add`; ask it for host times with `host_ns`."""

    def __init__(self) -> None:
        self._trips: deque[_Trip] = deque(maxlen=WINDOW)
        self._outliers = 0
        self.offset_ns = 0.0  # host minus device at the latest trip
        self.drift = 0.0  # s per s
        self.accepted = self.rejected = self.restarts = 0
        self.one_way = False
        """Whether times come from arrivals, without TIMESYNC, and are late by the transport."""
        self.off_ns = 0.0  # by how much the last trip was off what was estimated before it
        self.too_long_s = math.nan  # the last round trip, where it was dropped as too long
        self._block: list[tuple[int, int]] = []
        self._early: list[_Trip] = []  # too few as yet to take the place of arrivals

    @property
    def converged(self) -> bool:
        """True once stamps may be published."""
        return len(self._trips) >= MIN_SAMPLES

    @property
    def doubtful(self) -> bool:
        """True where the last round trip disagreed: ask again at once."""
        return self._outliers > 0

    @property
    def round_trip_s(self) -> float:
        """Shortest round trip in the window, s; NaN without any.

        Half of it bounds the error of a constant asymmetry.
        """
        return 1e-9 * min((t.round_trip_ns for t in self._trips), default=math.nan)

    def reset(self) -> None:
        """Forget the past: one of the clocks has jumped."""
        self.restarts += bool(self._trips)
        self._trips.clear()
        self._outliers, self.drift = 0, 0.0
        self.one_way = False
        self._block.clear()
        self._early = []

    def add_arrival(self, device_ns: int, arrival_ns: int) -> None:
        """Take a message's device time and arrival, from an aircraft that answers no TIMESYNC.

        Of each block the one that took least counts, until there are enough round trips.
        """
        if self.converged and not self.one_way:
            return
        if len(self._block) >= MAX_IN_BLOCK:
            self._block.clear()  # its time stands still
        self._block.append((device_ns, arrival_ns))
        since_ns = device_ns - self._block[0][0]
        if since_ns < BLOCK_NS:
            if since_ns < -BLOCK_NS:  # what lies less behind was overtaken on a network
                self.reset()
            return
        device, arrival = min(self._block, key=lambda trip: trip[1] - trip[0])
        self._block.clear()
        if not self.one_way:
            self._early = [*self._trips]
            self._trips.clear()
            self.one_way = True
        self._take(_Trip(device, arrival - device, 0))

    def add(self, sent_ns: int, device_ns: int, received_ns: int) -> bool:
        """Take one round trip (host ns, device ns, host ns); False where it was dropped.

        Two trips in a row that disagree with all before them restart the estimate.
        """
        trip = _Trip(device_ns, (sent_ns + received_ns) // 2 - device_ns, received_ns - sent_ns)
        if trip.round_trip_ns > MAX_ROUND_TRIP_NS:
            self.rejected += 1
            self.too_long_s = 1e-9 * trip.round_trip_ns
            return False
        trips = [trip]
        if self.one_way:
            self._early.append(trip)
            if len(self._early) < MIN_SAMPLES:
                return True
            trips = self._early
            self._trips.clear()  # no clock has jumped
            self.reset()
        self.too_long_s = math.nan
        return [self._take(each) for each in trips][-1]

    def _take(self, trip: _Trip) -> bool:
        if self._trips and self._jumped(trip):
            self._outliers += 1
            self.rejected += 1
            if self._outliers < 2:
                return False
            one_way = self.one_way
            self.reset()
            self.one_way = one_way
        self._outliers = 0
        self._trips.append(trip)
        self.accepted += 1
        self._fit()
        return True

    def host_ns(self, device_ns: int) -> int:
        """Host time of a device time, ns, by the present estimate."""
        base = self._trips[-1].device_ns if self._trips else device_ns
        return device_ns + round(self.offset_ns + self.drift * (device_ns - base))

    def _jumped(self, trip: _Trip) -> bool:
        since = trip.device_ns - self._trips[-1].device_ns
        self.off_ns = trip.offset_ns - self.offset_ns - self.drift * since
        shortest = min(t.round_trip_ns for t in self._trips)
        uncertainty = abs(trip.round_trip_ns - shortest) / 2
        jump = JUMP_NS * (20 if self.one_way else 1 if self.converged else 5)
        allowed = jump + uncertainty + 2.0 * DRIFT_PRIOR * abs(since)
        return since < 0 or abs(self.off_ns) > allowed

    def _fit(self) -> None:
        """Weighted least squares of offset (at the latest trip) and drift."""
        last = self._trips[-1]
        shortest = min(t.round_trip_ns for t in self._trips)
        s0 = sx = sxx = sy = sxy = 0.0
        for trip in self._trips:
            w = (FLOOR_S + 0.5e-9 * (trip.round_trip_ns - shortest)) ** -2
            x = 1e-9 * (trip.device_ns - last.device_ns)
            y = 1e-9 * (trip.offset_ns - last.offset_ns)
            s0 += w
            sx += w * x
            sxx += w * x * x
            sy += w * y
            sxy += w * x * y
        sxx += 1.0 / (DRIFT_PRIOR * DRIFT_PRIOR)
        self.drift = (s0 * sxy - sx * sy) / (s0 * sxx - sx * sx)
        self.offset_ns = last.offset_ns + 1e9 * (sy - self.drift * sx) / s0


class DeviceTime:
    """Device times that may wrap at 32 bits, as one that does not. µs, or any unit.

    Only what `extend` is given moves it: a false time of something else must not.
    """

    def __init__(self) -> None:
        self._base = 0
        self._last = 0
        self.wraps = 0

    def restart(self) -> None:
        """Forget: the device has restarted."""
        self._base = self._last = 0

    def extend(self, time: int, near: int) -> int:
        """`time` with its wraps; a wrap is believed within `near` of the counter's end."""
        extended = self.peek(time, near)
        wrapped = extended > time + self._base
        self._base += SPAN if wrapped else 0
        self.wraps += wrapped
        if extended >= time + self._base:
            self._last = extended
        return extended

    def peek(self, time: int, near: int) -> int:
        """The result of `extend`, without changing the state."""
        extended = time + self._base
        if SPAN - near < self._last - extended <= SPAN and time < near:
            return extended + SPAN
        if self._base and extended - self._last > SPAN - near:
            return extended - SPAN  # sent before the wrap, arrived behind it
        return extended

