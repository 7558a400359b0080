"""Stamps of frames, and the frames that wait for one: clock, wraps and guards. Pure.

All times are ns of one steady host clock, device times µs. What TIMESYNC asks is the link's.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from quad_bridge.link.autopilot import Inertial
from quad_bridge.link.clock import ClockEstimator, DeviceTime
from quad_bridge.link.guards import PATIENCE_NS, LateGuard, StepGuard
from quad_bridge.wire import frames as f

FUTURE_NS = 100_000_000  # a stamp later than its arrival by more is false
NEAR_US = 60_000_000  # a device time has wrapped at 32 bits only within this of the wrap


class Stamped(NamedTuple):
    """A frame for a topic with its stamp, host time in ns; the node makes ROS time of it."""

    frame: f.Cycle | f.RcChannels | f.Battery | f.SlowSensors | Inertial | f.Outputs
    stamp_ns: int


class Arrived(NamedTuple):
    """A frame as it arrives; cycles and channels are stamped later, or never."""

    frame: f.Cycle | f.CommandAck | f.ParamValue | f.GainsState | f.RcChannels | f.StatusText


class Restarted(NamedTuple):
    """The aircraft has restarted, or is another one."""


Event = Stamped | Arrived | Restarted


class Stamping:
    """Appends what is stamped to `out`, in order; whoever reads that list puts a new one there."""

    def __init__(self, on_restart: Callable[[], None] = lambda: None) -> None:
        """`on_restart` is called where the aircraft restarted and its counter does not tell."""
        self._on_restart = on_restart
        self.out: list[Event] = []
        self.clock, self.device_time = ClockEstimator(), DeviceTime()
        self.guard, self.late = StepGuard(), LateGuard()
        self.held = 0
        """Not published: no clock yet, or a stamp that runs backwards or lies in the future."""
        self.last_ns = 0  # the latest stamp
        self._stamped: f.Cycle | Inertial | None = None  # what has this stamp
        self._waiting: list[Callable[[int], None]] = []
        """Frames that wait until it is known whether the aircraft's clock is still the same."""
        self._arrived_ns = self._waits_since_ns = 0

    def restart(self) -> None:
        """Forget: the aircraft has restarted, or is another one."""
        for part in (self.device_time, self.guard, self.late):
            part.restart()
        self.clock.reset()
        self.held += len(self._waiting)
        self._waiting.clear()
        self._stamped = None

    @property
    def asks(self) -> bool:
        """Whether frames wait for a round trip."""
        return bool(self._waiting)

    def cycle(self, frame: f.Cycle, now_ns: int) -> None:
        """Stamp a cycle that has arrived, or let it wait."""
        device_us = self.device_time.extend(frame.time_us, NEAR_US)
        uneven = self.guard.step(frame.cycle, device_us, now_ns)
        self._timed(frame, 1000 * device_us, now_ns, uneven=uneven)

    def inertial(self, frame: Inertial, now_ns: int) -> None:
        """Stamp what an autopilot sends in place of a cycle; its arrival tells the clock too."""
        device_ns = 1000 * self.device_time.extend(frame.time_us, NEAR_US)
        self.clock.add_arrival(device_ns, now_ns)
        self._timed(frame, device_ns, now_ns, uneven=False)

    def outputs(self, frame: f.Outputs) -> None:
        """Stamp an autopilot's motor pulses, whose time has 32 bits."""
        if self.clock.converged:
            device_ns = 1000 * self.device_time.nearest(frame.time_us)
            self.out.append(Stamped(frame, self.clock.host_ns(device_ns)))

    def other(
        self, frame: f.RcChannels | f.SlowSensors, time_us: int, grain_us: int, now_ns: int
    ) -> None:
        """Stamp a frame whose time has this grain: with its cycle's stamp where it was of one."""
        device_ns = 1000 * self.device_time.peek(time_us, NEAR_US)
        stamp = partial(self._stamp_other, frame, time_us // grain_us, grain_us, device_ns)
        late_ns = self._late_ns(device_ns, now_ns) if self._sure else 0
        if self._waiting and now_ns - self._waits_since_ns > 2 * PATIENCE_NS:
            # cycles would have lost their patience by now: they have stopped, others go on
            if self.late.waiting and self.late.anew:
                self._begin_anew()
            else:
                self.late.believe(late_ns)
                self._release(now_ns)
        if self._waiting or self.late.late(late_ns):
            self._wait(stamp, now_ns)
        else:
            stamp(now_ns)

    def trip(self, sent_ns: int, told_ns: int, now_ns: int) -> None:
        """Take a round trip of TIMESYNC: sent and received by us, told by the aircraft."""
        # who counts µs in 32 bits wraps here too
        whole_us, rest_ns = divmod(told_ns, 1000)
        device_ns = 1000 * self.device_time.peek(whole_us, NEAR_US) + rest_ns
        if self._sure:
            off_ns = (sent_ns + now_ns) // 2 - self.clock.host_ns(device_ns)
            self.late.trip(sent_ns, off_ns, now_ns - sent_ns)
        if self.late.gone:
            self._begin_anew()
            device_ns = told_ns
        accepted = self.clock.add(sent_ns, device_ns, now_ns)
        self.guard.trip(sent_ns, self.clock.off_ns, accepted=accepted)
        if not self.clock.converged:
            self.guard.restart()
        if not (self.guard.waiting or self.late.waiting):
            self._release(now_ns)

    @property
    def _sure(self) -> bool:
        return self.clock.converged and not self.clock.one_way

    def _late_ns(self, device_ns: int, now_ns: int) -> int:
        return now_ns - self.clock.host_ns(device_ns)

    def _timed(
        self, frame: f.Cycle | Inertial, device_ns: int, now_ns: int, *, uneven: bool
    ) -> None:
        unheard_ns, self._arrived_ns = now_ns - self._arrived_ns, now_ns
        stamp = partial(self._stamp_timed, frame, device_ns)
        if self._sure:
            late_ns = self._late_ns(device_ns, now_ns)
            waits = self.late.step(late_ns, now_ns, anew=device_ns < unheard_ns)
            if self.late.gone:
                self._begin_anew()
            elif waits or uneven:
                self._wait(stamp, now_ns)
                return
        self._release(now_ns)
        stamp(now_ns)

    def _wait(self, stamp: Callable[[int], None], now_ns: int) -> None:
        if not self._waiting:
            self._waits_since_ns = now_ns
        self._waiting.append(stamp)

    def _begin_anew(self) -> None:
        """Drop late frames of another clock."""
        restarted = self.late.anew
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
            self.held += 1
            return
        self.last_ns, self._stamped = stamp_ns, frame
        self.out.append(Stamped(frame, stamp_ns))

    def _stamp_other(
        self, frame: f.RcChannels | f.SlowSensors, grains: int, grain_us: int, device_ns: int,
        _now_ns: int,
    ) -> None:  # fmt: skip
        if self.clock.converged:
            last = self._stamped
            same = last is not None and last.time_us // grain_us == grains
            stamp_ns = self.last_ns if same else self.clock.host_ns(device_ns)
            self.out.append(Stamped(frame, stamp_ns))
