"""Tells a link that is silent from a node that itself stood still (a busy host, a page fault).

After a standstill a node's timer comes before what waits in its subscriptions: everything looks
old although nothing is. Pure: times in, a verdict out.
"""

from __future__ import annotations

STALL_S = 0.05
"""Between two ticks: more than this and the node stood still."""
LONGEST_S = 1.0
"""A longer standstill is excused by nothing: nobody watched the aircraft."""


class Stall:
    """Watches the times of a node's own ticks."""

    def __init__(self) -> None:
        self._last: float | None = None
        self._excused = False
        self.stood_still_s = 0.0
        """Length of the standstill before the last tick, 0 where there was none."""

    def reset(self) -> None:
        """Forget the last tick: the timer was stopped on purpose."""
        self._last, self._excused, self.stood_still_s = None, False, 0.0

    def tick(self, now_s: float) -> bool:
        """Whether ages are not to be judged in this tick, because its node has just woken.

        Never twice in a row: between two ticks the executor hands over what has arrived.
        """
        gap = 0.0 if self._last is None else now_s - self._last
        self._last = now_s
        self.stood_still_s = gap if gap > STALL_S else 0.0
        self._excused = STALL_S < gap <= LONGEST_S and not self._excused
        return self._excused
