"""The autopilot's own log, fetched over the line after landing. Pure; whoever has files writes.

LOG_REQUEST_LIST, then LOG_REQUEST_DATA in windows; what is lost of a window is asked for again,
and what an earlier line brought is not: `there` says how many bytes there are. They come out in
order.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from enum import Enum

from quad_bridge.wire import frames as f

CHUNK = 90  # bytes of a LOG_DATA
WINDOW = 600 * CHUNK
LIST_S, DATA_S = 1.0, 0.5  # of silence, after which it is asked again
TRIES = 40
"""Of the same question without any answer, before it is given up."""


class Phase(Enum):
    """State of the fetch."""

    IDLE = 'none asked for'
    WAITING = 'waiting until the log is closed'
    LISTING = 'asking for the list'
    FETCHING = 'fetching'
    DONE = 'complete'
    FAILED = 'failed'


class LogFetch:
    """One log at a time. Times in s on a steady clock."""

    def __init__(self) -> None:
        self.phase = Phase.IDLE
        self.entry: f.LogEntry | None = None
        self.reason = ''
        self.got = 0  # bytes that are there in order
        self.parts: list[f.LogData] = []
        """What has come, in order, for the file; whoever writes it puts a new list there."""
        self.there: Callable[[f.LogEntry], int] = lambda _: 0
        """How many bytes of this log an earlier fetch has written."""
        self._listed_so_far: dict[int, f.LogEntry] = {}
        self._by_time = False
        self._waiting: dict[int, bytes] = {}  # offset to bytes beyond a hole
        self._from = self._until = 0  # what was asked for
        self._due_s, self._tries = -math.inf, 0
        self._ends = False  # whether to say that no more is wanted

    @property
    def busy(self) -> bool:
        """Whether it goes on."""
        return self.phase in {Phase.WAITING, Phase.LISTING, Phase.FETCHING}

    @property
    def size(self) -> int:
        """Size of the log, bytes; 0 before the autopilot has stated it."""
        return self.entry.size if self.entry is not None else 0

    def begin(self, now_s: float, wait_s: float, *, by_time: bool = False) -> None:
        """Fetch the newest log, which is closed `wait_s` from now.

        `by_time`: the list is in no order, so the newest is the one with the latest time.
        """
        self._forget()
        self._by_time = by_time
        self.phase, self._due_s = Phase.WAITING, now_s + wait_s

    def stop(self, reason: str) -> None:
        """Give it up; what is there stays for the next fetch.

        The autopilot is told: ArduPilot does not arm before it has sent what was asked for, and
        sends nothing where no heartbeat comes.
        """
        if self.busy:
            self._ends = self.phase is Phase.FETCHING
            self.phase, self.reason = Phase.FAILED, reason

    def take(self, frame: f.LogEntry | f.LogData, now_s: float) -> None:
        """Take an answer."""
        if isinstance(frame, f.LogEntry):
            self._listed(frame, now_s)
        elif self.phase is Phase.FETCHING and self.entry is not None and (
            frame.number == self.entry.number
        ):
            self._data(frame, now_s)

    def poll(self, now_s: float) -> list[f.Frame]:
        """Say what to send now."""
        if self._ends:
            self._ends = False
            return [f.LogRequestEnd()]
        if not self.busy or now_s < self._due_s:
            return []
        if self.phase is Phase.WAITING:
            self.phase = Phase.LISTING
        if self._tries >= TRIES:
            self.stop(f'no answer to {TRIES} requests')
            return []
        self._tries += 1
        if self.phase is Phase.LISTING:
            self._due_s = now_s + LIST_S
            return [f.LogRequestList()]
        self._due_s = now_s + DATA_S
        return [self._request()]

    def _listed(self, entry: f.LogEntry, now_s: float) -> None:
        if self.phase is not Phase.LISTING:
            return
        if not self._by_time:
            if entry.number < entry.last:
                return
        elif entry.count:  # PX4's `last` is none of its numbers, which begin at 0
            entries = [*self._listed_so_far.values(), entry]
            self._listed_so_far = {log.number: log for log in entries if log.count == entry.count}
            self._tries, self._due_s = 0, now_s + LIST_S
            if len(self._listed_so_far) < entry.count:
                return
            entry = max(self._listed_so_far.values(), key=lambda log: (log.time_utc_s, log.number))
        if entry.count == 0 or entry.size == 0:
            self.phase, self.reason = Phase.FAILED, 'the autopilot has no log'
            return
        self.entry, self._tries = entry, 0
        self.got = self._from = self._until = min(self.there(entry), entry.size)
        self.phase, self._due_s = Phase.FETCHING, now_s
        self._finish()

    def _request(self) -> f.LogRequestData:
        self._from = self.got
        beyond = min(self._waiting, default=self.size)  # the hole, or the rest
        end = min(self.got + WINDOW, self.size, beyond if beyond > self.got else self.size)
        self._until = max(end, self._from)
        number = self.entry.number if self.entry is not None else 0
        return f.LogRequestData(number, self._from, self._until - self._from)

    def _data(self, frame: f.LogData, now_s: float) -> None:
        self._tries, self._due_s = 0, now_s + DATA_S
        if frame.offset > self.got:
            if len(self._waiting) < WINDOW // CHUNK:
                self._waiting[frame.offset] = frame.data
        elif frame.offset == self.got and frame.data:
            self._add(frame.data)
            while self.got in self._waiting:
                self._add(self._waiting.pop(self.got))
        # ArduPilot says the same where its card has not been read for once: asked again, it has
        if not frame.data and frame.offset == self._from == self.got and self.entry is not None:
            self.entry = replace(self.entry, size=self.got)  # the list had said about how many
        if self.got >= self._until or frame.offset + len(frame.data) >= self._until:
            self._due_s = now_s  # the window has passed: the next, or the hole
        self._finish()

    def _add(self, data: bytes) -> None:
        number = self.entry.number if self.entry is not None else 0
        self.parts.append(f.LogData(number, self.got, data))
        self.got += len(data)

    def _finish(self) -> None:
        if self.got >= self.size:
            self.phase = Phase.DONE

    def _forget(self) -> None:
        there = self.there
        self.__init__()  # type: ignore[misc]
        self.there = there
