"""Gaps in the numbers that publishers give their messages: what was lost before it arrived. Pure.

A middleware with a bounded history overwrites what a late reader has not fetched, and reports only
a small part of that as lost; the numbers tell all of it.
"""

from __future__ import annotations

from collections.abc import Callable


class Gaps:
    """Messages lost of one topic; several publishers may number theirs independently."""

    def __init__(self) -> None:
        self._last: list[int] = []
        """Last number of each publisher, the most recently heard one at the end."""

    def lost_before(self, number: int, publishers: Callable[[], int]) -> int:
        """How many messages are missing between this one and the one before it.

        Whose message it is does not come with it: it continues the publisher whose turn it is.
        `publishers` says how many there are; it is asked only where no turn fits.
        """
        if number - 1 in self._last:
            self._last.remove(number - 1)
            self._last.append(number)
            return 0
        known = max(publishers(), 1)
        below = [last for last in self._last if last < number]
        if number == 1 or len(self._last) < known or not below:  # a new publisher, or a restart
            self._last = [*self._last, number][-known:]
            return 0
        before = max(below)
        self._last.remove(before)
        self._last.append(number)
        return number - before - 1
