"""Keeps a node alive when a callback fails, and its log from being flooded. No ROS here."""

from __future__ import annotations

import contextlib
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

from quad_bridge.status import OK, WARN, Status

MAX_IN_A_ROW = 1000  # failures without anything that works between them: ROS itself fails
MIN_REPORT_S = 0.5  # least time between two reports; an earlier one repeats the last figures
LONGEST = 500  # characters of a fault that are logged
REPEAT_S = 30.0  # the same line of the log once in this time
BURST, PER_S = 20, 60.0  # so many lines of the log in this time


class LogLimiter:
    """A rate limiter for the log: the same line once in REPEAT_S, at most BURST in PER_S."""

    def __init__(self) -> None:
        self._logged: dict[str, float] = {}
        self._times: deque[float] = deque(maxlen=BURST)

    def allow(self, text: str, now_s: float) -> bool:
        """Whether to log `text` now, s on a steady clock."""
        full = len(self._times) == self._times.maxlen and now_s - self._times[0] < PER_S
        if full or now_s - self._logged.get(text, -REPEAT_S) < REPEAT_S:
            return False
        self._logged = {t: s for t, s in self._logged.items() if now_s - s < REPEAT_S}
        self._logged[text] = now_s
        self._times.append(now_s)
        return True


class Fence:
    """Keeps a node alive when one of its callbacks fails: logs the fault and counts it.

    `log` takes one line; `then` gets the fault each time. What fails without end is raised again.
    """

    def __init__(
        self, log: Callable[[str], None], then: Callable[[str], None] = lambda _fault: None
    ) -> None:
        self.failed = 0  # callbacks that have raised
        self._log, self._then = log, then
        self._reported_s = -MIN_REPORT_S
        self._reported = self._before = 0  # failures at the last report and at the one before
        self._in_a_row: dict[int, int] = {}  # by thread: the port goes on while ROS fails
        self._limiter = LogLimiter()

    def take(self, error: Exception) -> None:
        """Note what a callback has raised."""
        self.failed += 1
        thread = threading.get_ident()
        self._in_a_row[thread] = self._in_a_row.get(thread, 0) + 1
        if self._in_a_row[thread] > MAX_IN_A_ROW:
            raise error
        frame = traceback.extract_tb(error.__traceback__)[-1]
        words = f'{type(error).__name__}: {" ".join(str(error).split())[:LONGEST]}'
        where = f'{Path(frame.filename).name}:{frame.lineno}'
        if self._limiter.allow(where + words, time.monotonic()):
            self._log(f'a callback failed and was left out: {words} ({where})')
        with contextlib.suppress(Exception):  # it may fail with what failed
            self._then(f'a callback failed: {words}')

    def passed(self) -> None:
        """Note that a callback has succeeded."""
        self._in_a_row[threading.get_ident()] = 0

    def entries(self) -> list[Status]:
        """The failures for /diagnostics, all and since the last report; empty without any."""
        now_s = time.monotonic()
        if now_s - self._reported_s > MIN_REPORT_S:
            self._reported_s, self._before, self._reported = now_s, self._reported, self.failed
        if not self.failed:
            return []
        new = self.failed - self._before
        text = f'{new} callbacks failed since the last report: see the log'
        if not new:
            text = 'no callback has failed since the last report'
        values = {'failed callbacks': self.failed}
        return [Status('callbacks', WARN if new else OK, text, values)]

    def around(self, callback: Callable[..., None]) -> Callable[..., None]:
        """`callback`, for a thread of its own, that never raises."""

        def fenced(*args: Any) -> None:
            try:
                callback(*args)
            except Exception as error:  # noqa: BLE001  (whatever it is, the thread goes on)
                with contextlib.suppress(Exception):
                    self.take(error)
            else:
                self.passed()

        return fenced
