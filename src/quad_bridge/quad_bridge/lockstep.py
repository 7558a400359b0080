"""Simulated time in lockstep: the virtual STM32 owns the clock and waits for the slowest process.

A line is a Unix socket. The virtual STM32 (virtual/line.py) sends the time, each process that
takes part answers with the time up to which it has done everything; simulated time is never more
than `WINDOW_NS` ahead of the slowest. Who publishes a stream says how far, who handles it waits
for that much, so that no message can be late. No ROS here; nodes get timers and stamps by
node_time.py.

Messages are lines of JSON: `{"now": ns, "published": {stream: ns}}` to the processes,
`{"name": ..., "reached": ns, "published": {stream: ns}}` from them.
"""

from __future__ import annotations

import contextlib
import functools
import json
import math
import os
import select
import socket
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path

VARIABLE = 'QUAD_LOCKSTEP'  # the environment variable that names the socket; unset: real time
WINDOW_NS = 20_000_000  # five control cycles: enough for all processes to work at the same time
START_NS = 1_000_000_000_000
"""Simulated time at the STM32's boot: stamps are above 0, and no date is mistaken for today's."""
WIRE = 'wire'  # the stream of the virtual STM32 itself: bytes on the serial line
STREAMS = ('/imu/data', '/rc/in', '/excitation/setpoint')
"""Topics that whoever subscribes is waited for; node_time.py reports them."""
RETRY_S = 0.05  # between attempts to reach a clock that has not begun
AGAIN_S = 0.5  # after which whoever did not run what is due is woken again


class Clock:
    """Real time: the host's steady clock, and nobody to wait for."""

    simulated = False

    def now_ns(self) -> int:
        """The time by which everything in flight is measured, ns."""
        return time.monotonic_ns()

    def now_s(self) -> float:
        """The time in s."""
        return self.now_ns() * 1e-9

    def published(self, stream: str, stamp_ns: int) -> None:
        """Note what was published; it is reported with the next answer."""

    def handled(self, stream: str, stamp_ns: int) -> None:
        """Note what was received and dealt with; from now on the stream is waited for."""

    def forget(self, stream: str) -> None:
        """Wait for the stream no more, until it is handled again."""

    def hold(self) -> None:
        """Let simulated time stand still until `release`."""

    def release(self) -> None:
        """Let it go on."""

    def rest(self, seconds: float) -> None:
        """Wait a little in the thread of timers and subscriptions; time goes on meanwhile."""
        time.sleep(seconds)

    def close(self) -> None:
        """Take part no more."""


def patience(seconds: float) -> float:
    """Longest real time to wait, s; without limit in lockstep, where simulated time waits too."""
    return math.inf if VARIABLE in os.environ else seconds


@functools.cache
def clock() -> Clock:
    """The clock of this process."""
    path = os.environ.get(VARIABLE)
    return Participant(Path(path), Path(sys.argv[0]).name) if path else Clock()


class Timer:
    """A callback every `period_ns` of simulated time, run by `Participant.step`."""

    def __init__(
        self, period_ns: int, callback: Callable[[], None], now_ns: Callable[[], int]
    ) -> None:
        self._period_ns, self.callback, self._now_ns = period_ns, callback, now_ns
        self._due_ns: float = math.inf
        self.reset()

    def cancel(self) -> None:
        """Stop until `reset`."""
        self._due_ns = math.inf

    def reset(self) -> None:
        """Begin anew, one period from now, or from when time begins."""
        now_ns = self._now_ns()
        self._due_ns = now_ns + self._period_ns if now_ns else 0

    def due(self, now_ns: int) -> bool:
        """Whether it is to run at this time."""
        self._due_ns = self._due_ns or now_ns + self._period_ns
        return self._due_ns <= now_ns

    def ran(self, now_ns: int) -> None:
        """Run at this time, and next a period later; missed times are not repeated."""
        self._due_ns += self._period_ns
        if self._due_ns <= now_ns:
            self._due_ns = now_ns + self._period_ns


class Participant(Clock):
    """Simulated time as one process sees it, which is as far as it has come itself."""

    simulated = True

    def __init__(self, path: Path, name: str) -> None:
        """Connect in a thread of its own, as soon as the virtual STM32 listens at `path`."""
        self.on_due: Callable[[], None] = self.step
        """Has `step` called where the timers are to run; called in the line's thread."""
        self._path, self._name = str(path), name
        self._lock = threading.Lock()
        self._line: socket.socket | None = None
        self._now_ns = self._reached_ns = 0
        self._coming: deque[int] = deque()
        self._timers: list[Timer] = []
        self._sent: Mapping[str, int] = {}
        self._handled: dict[str, int] = {}
        self._published: dict[str, int] = {}
        self._on_hold = self._closed = self._stepping = False
        self._answered = ''
        threading.Thread(target=self._run, name='lockstep', daemon=True).start()

    def now_ns(self) -> int:
        """Simulated time, ns; 0 before the line is there."""
        return self._now_ns

    def timer(self, period_s: float, callback: Callable[[], None]) -> Timer:
        """Run `callback` every `period_s` of simulated time."""
        timer = Timer(round(period_s * 1e9), callback, self.now_ns)
        with self._lock:
            self._timers.append(timer)
        return timer

    def remove(self, timer: Timer) -> None:
        """Run it no more."""
        timer.cancel()
        with self._lock, contextlib.suppress(ValueError):
            self._timers.remove(timer)

    def step(self) -> None:
        """Go through the times that were received, run what is due at each, answer."""
        try:
            while self._next():
                for timer in self._due():
                    timer.callback()
        finally:
            with self._lock:
                self._stepping = False
                rest = bool(self._coming)
                self._answer()
            if rest:  # a callback failed
                self.on_due()

    def published(self, stream: str, stamp_ns: int) -> None:
        """See Clock."""
        self._published[stream] = stamp_ns

    def handled(self, stream: str, stamp_ns: int) -> None:
        """See Clock."""
        with self._lock:
            self._handled[stream] = stamp_ns
            self._answer()

    def forget(self, stream: str) -> None:
        """See Clock."""
        with self._lock:
            if self._handled.pop(stream, None) is not None:
                self._answer()

    def hold(self) -> None:
        """See Clock."""
        self._on_hold = True

    def release(self) -> None:
        """See Clock."""
        with self._lock:
            self._on_hold = False
            self._answer()

    def rest(self, seconds: float) -> None:
        """See Clock."""
        super().rest(seconds)
        for stream in STREAMS:  # nobody hears them now
            self.forget(stream)
        self.step()

    def close(self) -> None:
        """See Clock."""
        self._closed = True
        with self._lock, contextlib.suppress(OSError):
            if self._line is not None:
                self._line.shutdown(socket.SHUT_RDWR)

    def _run(self) -> None:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as line:
            while not self._closed:
                try:
                    line.connect(self._path)
                    break
                except OSError:  # not there yet
                    time.sleep(RETRY_S)
            with self._lock:
                self._line = line
                self._answer()
            rest = b''
            while not self._closed:
                if not select.select([line], [], [], AGAIN_S)[0]:
                    if self._coming:  # rmw_fastrtps can lose a trigger (its pull request 895)
                        self.on_due()
                    continue
                try:
                    data = line.recv(65536)
                except OSError:
                    data = b''
                if not data:
                    return
                *whole, rest = (rest + data).split(b'\n')
                for message in map(json.loads, whole):
                    self._take(message['now'], message['published'])

    def _take(self, now_ns: int, published: Mapping[str, int]) -> None:
        with self._lock:
            self._sent = published
            for stream in self._handled.keys() - published.keys():  # its publisher has gone
                del self._handled[stream]
            busy = self._stepping or bool(self._coming)
            wake = busy or any(timer.due(now_ns) for timer in self._timers)
            if wake:
                self._coming.append(now_ns)
            else:
                self._now_ns = now_ns
            self._answer()
        if wake:
            self.on_due()

    def _next(self) -> bool:
        with self._lock:
            self._stepping = bool(self._coming)
            if not self._coming:
                return False
            self._now_ns = self._coming.popleft()
            return True

    def _due(self) -> list[Timer]:
        now_ns = self._now_ns
        with self._lock:
            due = [timer for timer in self._timers if timer.due(now_ns)]
            for timer in due:
                timer.ran(now_ns)
        return due

    def _answer(self) -> None:
        """Say how far this process has come; the lock is held."""
        behind = [ns for stream, ns in self._handled.items() if ns < self._sent.get(stream, 0)]
        reached = min([self._now_ns, *behind])
        if not self._on_hold:
            self._reached_ns = max(self._reached_ns, reached)
        answer = {
            'name': self._name, 'reached': self._reached_ns, 'published': self._published,
        }  # fmt: skip
        text = json.dumps(answer) + '\n'
        if self._line is not None and text != self._answered:
            self._answered = text
            with contextlib.suppress(OSError):
                self._line.sendall(text.encode())
