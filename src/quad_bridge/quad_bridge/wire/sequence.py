"""Watches the 32-bit cycle counter: what is missing, and whether the far end has restarted."""

from __future__ import annotations

_WRAP = 1 << 32
_LARGEST_GAP = 1_000_000
"""Cycles (over an hour at 250 Hz): a larger step is a restart, not a loss."""


class CycleWatch:
    """Counts lost cycles; `step` takes each counter value as it arrives."""

    def __init__(self) -> None:
        self.lost = 0
        self.restarts = 0
        self._last: int | None = None

    def step(self, cycle: int) -> int:
        """Cycles lost just before this one; 0 after a restart, which is counted apart."""
        last, self._last = self._last, cycle
        if last is None:
            return 0
        gap = (cycle - last) % _WRAP - 1
        if gap > _LARGEST_GAP:
            self.restarts += 1
            return 0
        missing = max(gap, 0)
        self.lost += missing
        return missing
