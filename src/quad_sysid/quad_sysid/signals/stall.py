"""Tells a link that is silent from a node that itself stood still (a busy host, a page fault).

After a standstill a node's timer comes before what waits in its subscriptions, and what waits in
the middleware comes later still: everything looks old although nothing is. So ages are taken by
the time that the node was awake. Pure: times in, times out.
"""

from __future__ import annotations

STALL_S = 0.05
"""Between two ticks: more than this and the node stood still."""
LONGEST_S = 1.0
"""So much standstill is left out, in one piece or several; what is awake earns it back, second by
second. A longer one is left out by nothing: nobody watched the aircraft."""


class Stall:
    """Watches the times of a node's own ticks; a clock that leaves its standstills out."""

    def __init__(self) -> None:
        self._last: float | None = None
        self._left_out_s = 0.0
        self._allowed_s = LONGEST_S
        self.stood_still_s = 0.0
        """Length of the standstill before the last tick, 0 where there was none."""

    def begin(self, now_s: float) -> None:
        """Watch from `now_s` on, which is before the first tick; forget the ticks so far."""
        self._last, self.stood_still_s, self._allowed_s = now_s, 0.0, LONGEST_S

    def tick(self, now_s: float) -> None:
        """Take note of a tick, before ages are judged in it."""
        gap = 0.0 if self._last is None else now_s - self._last
        self._last = now_s
        self.stood_still_s = gap if gap > STALL_S else 0.0
        if not self.stood_still_s:
            self._allowed_s = min(self._allowed_s + gap, LONGEST_S)
        elif gap <= self._allowed_s:
            self._allowed_s -= gap
            self._left_out_s += gap

    def awake_s(self, now_s: float) -> float:
        """`now_s` (s) without the standstills so far: stamp by it what arrives, age it by it."""
        return now_s - self._left_out_s
