"""Whether what arrives long after its stamp was late on the way, or comes from a clock begun anew.

A host that stood still, or a line that held bytes back, delivers a burst: it catches up within
milliseconds. A far end that restarted while nobody heard it, with a cycle counter that happens to
be higher than before, stays behind for ever. So what is late waits until it has caught up, or a
round trip has told. No timers, no I/O.
"""

from __future__ import annotations

PAST_NS = 100_000_000
"""Lateness that is taken as it is: a busy host."""
PATIENCE_NS = 300_000_000
"""Without a word from TIMESYNC for so long nothing waits."""


class LateGuard:
    """`step` for every cycle, `trip` for every round trip; `waiting` tells to hold cycles back."""

    def __init__(self) -> None:
        self.gone = False
        """The clock of before is no more."""
        self.anew = False
        """Device time fits a start since the last cycle that had been heard before."""
        self._since_ns: int | None = None
        self._allowed_ns = PAST_NS
        self._late_ns = 0

    @property
    def waiting(self) -> bool:
        """Whether cycles are to be held back until it is known."""
        return self._since_ns is not None

    def restart(self) -> None:
        """Begin anew: stamps are by another clock now."""
        self.gone, self._since_ns, self._allowed_ns = False, None, PAST_NS

    def late(self, late_ns: int) -> bool:
        """Whether so much between stamp and arrival needs an explanation."""
        return late_ns > self._allowed_ns

    def step(self, late_ns: int, now_ns: int, *, anew: bool) -> bool:
        """Take a cycle's lateness as it arrives; whether it has to wait."""
        self._late_ns = late_ns
        if late_ns <= PAST_NS:
            self.restart()
        elif self._since_ns is None:
            if self.late(late_ns):
                self._since_ns, self.anew = now_ns, anew
        elif now_ns - self._since_ns > PATIENCE_NS:
            self.gone = self.anew
            self._believe()
        return self.waiting

    def trip(self, sent_ns: int, off_ns: float, round_trip_ns: int) -> None:
        """Take a round trip, however long, that is `off_ns` away from the estimate.

        Half of what it took bounds its own error.
        """
        if self._since_ns is None or sent_ns < self._since_ns:
            return
        if abs(off_ns) > (round_trip_ns + PAST_NS) / 2:
            self.gone = True
        else:
            self._believe()

    def believe(self, late_ns: int) -> None:
        """Take so much lateness as it is from now on: nobody tells."""
        self._late_ns = late_ns
        self._believe()

    def _believe(self) -> None:
        self._since_ns, self._allowed_ns = None, self._late_ns + PAST_NS
