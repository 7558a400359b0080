"""Plays a schedule under the guard: states, ramps, announcements, progress.

Pure: times and readings in, set-points and announcements out; the node publishes them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

from quad_sysid.signals.guard import Limits, Readings, Vector, check
from quad_sysid.signals.schedule import Schedule

ZERO: Vector = (0.0, 0.0, 0.0)
Announcement = Mapping[str, float | int | str]


class State(Enum):
    """State of the player."""

    READY = 'ready'
    RUNNING = 'running'
    ENDING = 'ending'
    """Ramping out after an abort."""
    DONE = 'done'
    ABORTED = 'aborted'


@dataclass(frozen=True)
class Tick:
    """Messages to publish now; None: nothing."""

    setpoint: Vector | None = None
    announcement: Announcement | None = None


class Player:
    """Plays one schedule from `start` to its end or abort, any number of times."""

    def __init__(self, schedule: Schedule, limits: Limits, ramp_out_s: float = 0.5) -> None:
        self.schedule = schedule
        self.limits = limits
        self.state = State.READY
        self.reason = ''
        self._ramp_out_s = ramp_out_s
        self._began = self._ended = 0.0
        self._now = 0.0
        self._index: int | None = None
        self._last: Vector = ZERO
        self._yaw_start = 0.0

    @property
    def active(self) -> bool:
        """Whether it needs further ticks."""
        return self.state in (State.RUNNING, State.ENDING)

    @property
    def elapsed_s(self) -> float:
        """Time into the schedule at the last tick."""
        return min(max(self._now - self._began, 0.0), self.schedule.duration_s)

    @property
    def part(self) -> int | None:
        """Index of the running part."""
        return self._index if self.active else None

    def start(self, now_s: float, readings: Readings) -> str:
        """Begin at `now_s`; returns the reason of a refusal, or an empty text."""
        if self.active:
            return 'the schedule is already running'
        yaw = readings.angles[2] if readings.angles is not None else 0.0
        abort = check(self.limits, readings, self.schedule.parts[0].axis, yaw)
        if abort is not None:
            return abort.reason
        self.state, self.reason = State.RUNNING, ''
        self._began = self._now = now_s
        self._index, self._last, self._yaw_start = None, ZERO, yaw
        return ''

    def stop(self, now_s: float, reason: str) -> None:
        """Ramp out from `now_s`."""
        if self.state is State.RUNNING:
            self.state, self.reason, self._ended = State.ENDING, reason, now_s

    def cut(self, reason: str) -> Tick:
        """End at once, without a ramp."""
        return self._finish(State.ABORTED, reason) if self.active else Tick()

    def tick(self, now_s: float, readings: Readings) -> Tick:
        """Advance to `now_s`; call at the control rate while `active`."""
        if not self.active:
            return Tick()
        self._now = now_s
        axis = self.schedule.parts[self._index or 0].axis
        abort = check(self.limits, readings, axis, self._yaw_start)
        if abort is not None and abort.immediate:
            return self._finish(State.ABORTED, abort.reason)
        if abort is not None:
            self.stop(now_s, abort.reason)
        if self.state is State.ENDING:
            return self._ramp_out(now_s)
        into_s = now_s - self._began
        if into_s < 0.0:
            return self._finish(State.ABORTED, 'the clock was set back before its start')
        index = self.schedule.index(into_s)
        if index is None:
            return self._finish(State.DONE, 'the schedule is complete')
        part = self.schedule.parts[index]
        announcement = None
        if index != self._index:
            self._index = index
            announcement = part.announcement()
            if part.axis == 'yaw' and readings.angles is not None:
                self._yaw_start = readings.angles[2]
        idle = part.role == 'idle'
        self._last = ZERO if idle else self.schedule.sample(into_s)
        return Tick(None if idle else self._last, announcement)

    def _ramp_out(self, now_s: float) -> Tick:
        share = 1.0 - (now_s - self._ended) / self._ramp_out_s if self._ramp_out_s > 0.0 else 0.0
        if not 0.0 < share <= 1.0 or self._last == ZERO:
            return self._finish(State.ABORTED, self.reason)
        roll, pitch, yaw = self._last
        return Tick((share * roll, share * pitch, share * yaw))

    def _finish(self, state: State, reason: str) -> Tick:
        """Set-point zero, and the announcement that the excitation has ended."""
        part = self.schedule.parts[self._index or 0]
        self.state, self.reason = state, reason
        running = self._last != ZERO
        self._index, self._last = None, ZERO
        announcement = {'segment': 'idle', 'signal': 'none', 'axis': part.axis,
                        'injection': part.injection, 'reason': reason}
        return Tick(ZERO if running else None, announcement)
