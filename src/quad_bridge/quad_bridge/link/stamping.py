"""Stamps of frames, and the frames that wait for one: clock, wraps and guards. Pure.

All times are ns of one steady host clock, device times µs. What TIMESYNC asks is the link's.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple

from quad_bridge.link.autopilot import INERTIAL, Inertial
from quad_bridge.link.clock import SPAN, ClockEstimator, DeviceTime
from quad_bridge.link.guards import TIMEOUT_NS, LateGuard, StepGuard
from quad_bridge.wire import frames as f

FUTURE_NS = 100_000_000  # a stamp later than its arrival by more is false
PAST_US = 2_000_000  # a time so far behind what else the aircraft says is false
NEAR_US = 60_000_000  # a device time has wrapped at 32 bits only within this of the wrap


class Stamped(NamedTuple):
    """A frame for a topic with its stamp, host time in ns; the node makes ROS time of it."""

    frame: f.Frame | Inertial
    stamp_ns: int
    topic: str  # that it is for: a message may feed several


class Arrived(NamedTuple):
    """A frame as it arrives; cycles and channels are stamped later, or never."""

    frame: f.Frame


class Restarted(NamedTuple):
    """The aircraft has restarted, or is another one."""


class Described(NamedTuple):
    """Another autopilot has described its craft by its parameters, as far as it does."""

    peer: f.Heartbeat
    parameters: Mapping[str, float]


Event = Stamped | Arrived | Restarted | Described


class Stamping:
    """Appends what is stamped to `out`, in order; whoever reads that list puts a new one there."""

    def __init__(self, on_restart: Callable[[], None] = lambda: None) -> None:
        """`on_restart` is called where the aircraft restarted and its counter does not show it."""
        self._on_restart = on_restart
        self.out: list[Event] = []
        self.clock, self.device_time = ClockEstimator(), DeviceTime()
        self.guard, self.late = StepGuard(), LateGuard()
        self.withheld = 0
        """Not published: no clock yet, or a stamp that runs backwards or lies in the future."""
        self.false_times = 0
        """Not published, beside cycles: a time that runs backwards or is days off."""
        self.last_ns = 0  # the latest stamp of a cycle
        self._last: dict[str, int] = {}  # the latest stamp of each topic beside
        self._anchor_us = 0  # the latest device time that is known as a whole, 0 before one is
        self._stamped: f.Cycle | Inertial | None = None  # what has this stamp
        self._waiting: list[Callable[[int], None]] = []
        """Frames that wait until it is known whether the aircraft's clock is still the same."""
        self._arrival_ns = self._waits_since_ns = 0

    def restart(self) -> None:
        """Forget: the aircraft has restarted, or is another one."""
        for part in (self.device_time, self.guard, self.late):
            part.restart()
        self.clock.reset()
        self.withheld += len(self._waiting)
        self._waiting.clear()
        self._stamped = None
        self._anchor_us = 0

    @property
    def asks(self) -> bool:
        """Whether frames wait for a round trip."""
        return bool(self._waiting)

    def cycle(self, frame: f.Cycle, now_ns: int) -> None:
        """Stamp a cycle that has arrived, or let it wait."""
        device_us = self._anchor_us = self.device_time.extend(frame.time_us, NEAR_US)
        uneven = self.guard.step(frame.cycle, device_us, now_ns)
        self._timed(frame, 1000 * device_us, now_ns, uneven=uneven)

    def inertial(self, frame: Inertial, now_ns: int) -> None:
        """Stamp an autopilot's message in place of a cycle; its arrival also sets the clock."""
        whole_us = frame.time_us
        if frame.grain_us > 1:
            whole_us = self._nearest(whole_us, SPAN * frame.grain_us)
        device_us = self._anchor_us = self.device_time.extend(whole_us, NEAR_US)
        self.clock.add_arrival(1000 * device_us, now_ns)
        self._timed(frame, 1000 * device_us, now_ns, uneven=False)

    def untimed(
        self, topic: str, frame: f.Battery | f.RotorSpeeds | f.RcChannels
    ) -> None:
        """Stamp a frame without a time of its own: with that of the latest cycle."""
        if self.clock.converged and self.last_ns > self._last.get(topic, 0):
            self._last[topic] = self.last_ns
            self.out.append(Stamped(frame, self.last_ns, topic))

    def other(
        self, topic: str, frame: f.RcChannels | f.SlowSensors | f.Outputs | f.RotorSpeeds,
        time_us: int, grain_us: int, now_ns: int, *, bits: int = 64,
    ) -> None:  # fmt: skip
        """Stamp a frame whose time has this grain: with its cycle's stamp where it was of one.

        A time in ms has 32 bits, one in µs as many as `bits` says.
        """
        device_us = self.device_time.peek(time_us, NEAR_US)
        if grain_us > 1 or bits == 32:
            device_us = self._nearest(device_us, SPAN * grain_us)
        if self._anchor_us and device_us < self._anchor_us - PAST_US:
            self.false_times += 1
            return
        device_ns = 1000 * device_us
        grains = time_us // grain_us
        stamp = partial(self._stamp_other, topic, frame, grains, grain_us, device_ns)
        late_ns = self._late_ns(device_ns, now_ns) if self._sure else 0
        if self._waiting and now_ns - self._waits_since_ns > 2 * TIMEOUT_NS:
            # cycles would have lost their patience by now: they have stopped, others go on
            if self.late.waiting and self.late.fits_restart:
                self._drop_other_clock()
            else:
                self.late.believe(late_ns)
                self._release(now_ns)
        if self._waiting or self.late.late(late_ns):
            self._wait(stamp, now_ns)
        else:
            stamp(now_ns)

    def trip(self, sent_ns: int, aircraft_ns: int, now_ns: int) -> None:
        """Take a round trip of TIMESYNC: when sent, answered by the aircraft, received."""
        # who counts µs in 32 bits wraps here too
        whole_us, rest_ns = divmod(aircraft_ns, 1000)
        device_us = self.device_time.peek(whole_us, NEAR_US)
        near_us = self._nearest(device_us, SPAN)  # Betaflight's TIMESYNC alone has 32 bits
        if abs(near_us - self._anchor_us) < PAST_US:
            device_us = near_us
        device_ns = 1000 * device_us + rest_ns
        if self._sure:
            off_ns = (sent_ns + now_ns) // 2 - self.clock.host_ns(device_ns)
            self.late.trip(sent_ns, off_ns, now_ns - sent_ns)
        if self.late.reset:
            self._drop_other_clock()
            device_ns = aircraft_ns
        self._anchor_us = device_ns // 1000
        accepted = self.clock.add(sent_ns, device_ns, now_ns)
        self.guard.trip(sent_ns, self.clock.off_ns, accepted=accepted)
        if not self.clock.converged:
            self.guard.restart()
        if not (self.guard.waiting or self.late.waiting):
            self._release(now_ns)

    @property
    def _sure(self) -> bool:
        return self.clock.converged and not self.clock.one_way

    def _nearest(self, time_us: int, span_us: int) -> int:
        """The time nearest to the latest known one that equals `time_us` but for its wraps."""
        if not self._anchor_us:
            return time_us
        off_us = (time_us - self._anchor_us + span_us // 2) % span_us - span_us // 2
        return max(self._anchor_us + off_us, 0)

    def _late_ns(self, device_ns: int, now_ns: int) -> int:
        return now_ns - self.clock.host_ns(device_ns)

    def _timed(
        self, frame: f.Cycle | Inertial, device_ns: int, now_ns: int, *, uneven: bool
    ) -> None:
        unheard_ns, self._arrival_ns = now_ns - self._arrival_ns, now_ns
        stamp = partial(self._stamp_timed, frame, device_ns)
        if self._sure:
            late_ns = self._late_ns(device_ns, now_ns)
            waits = self.late.step(late_ns, now_ns, fits_restart=device_ns < unheard_ns)
            if self.late.reset:
                self._drop_other_clock()
            elif waits or uneven:
                self._wait(stamp, now_ns)
                return
        self._release(now_ns)
        stamp(now_ns)

    def _wait(self, stamp: Callable[[int], None], now_ns: int) -> None:
        if not self._waiting:
            self._waits_since_ns = now_ns
        self._waiting.append(stamp)

    def _drop_other_clock(self) -> None:
        """Drop late frames of another clock."""
        restarted = self.late.fits_restart
        self.restart()
        if restarted:
            self._on_restart()

    def _release(self, now_ns: int) -> None:
        """Stamp the waiting frames."""
        waiting, self._waiting = self._waiting, []
        for stamp in waiting:
            stamp(now_ns)

    def _stamp_timed(self, frame: f.Cycle | Inertial, device_ns: int, now_ns: int) -> None:
        """Publish a stamped frame unless its stamp runs backwards or lies in the future."""
        stamp_ns = self.clock.host_ns(device_ns) if self.clock.converged else 0
        if stamp_ns <= self.last_ns or stamp_ns > now_ns + FUTURE_NS:
            self.withheld += 1
            return
        self.last_ns, self._stamped = stamp_ns, frame
        self.out.append(Stamped(frame, stamp_ns, INERTIAL))

    def _stamp_other(
        self, topic: str, frame: f.RcChannels | f.SlowSensors | f.Outputs | f.RotorSpeeds,
        grains: int, grain_us: int, device_ns: int, now_ns: int,
    ) -> None:  # fmt: skip
        if not self.clock.converged:
            return
        last = self._stamped
        same = last is not None and last.time_us // grain_us == grains
        stamp_ns = self.last_ns if same else self.clock.host_ns(device_ns)
        if stamp_ns <= self._last.get(topic, 0) or stamp_ns > now_ns + FUTURE_NS:
            self.false_times += 1
            return
        self._last[topic] = stamp_ns
        self.out.append(Stamped(frame, stamp_ns, topic))
