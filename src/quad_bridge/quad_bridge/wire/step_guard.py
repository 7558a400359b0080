"""Whether a cycle's device time follows from the one before: a clock that was set shows here.

TIMESYNC sees a jump of a running STM32's clock only at its next round trips; cycles stamped until
then would be wrong. Cycle counter and device time step together, so a step that does not fit holds
cycles back until a round trip asked for after it has told. No timers, no I/O.
"""

from __future__ import annotations

_WRAP = 1 << 32
_LONGEST = 1_000_000
"""Cycles: a larger step of the counter is a restart."""
LEAST_US, MOST_US = 1_000, 20_000
"""What a step may be off. Doubled by each false alarm: there are far ends with uneven cycles."""
AGREES_NS = 1_000_000
"""A round trip this close to the estimate tells that the clock has not jumped."""
PATIENCE_NS = 300_000_000
"""Without a word from TIMESYNC for so long nothing is held back."""
LEARN = 1.0 / 64.0
DRIFT = 1e-3
"""Share of a gap by which the period that was learned may be off."""


class StepGuard:
    """`step` for every cycle, `trip` for every round trip; `waiting` tells to hold cycles back."""

    def __init__(self) -> None:
        self.alarms = 0
        """Steps that did not fit."""
        self._tolerance_us = float(LEAST_US)
        self._period_us = 0.0
        self._last: tuple[int, int] | None = None
        self._since_ns: int | None = None

    @property
    def waiting(self) -> bool:
        """Whether cycles are to be held back until TIMESYNC has told."""
        return self._since_ns is not None

    def restart(self) -> None:
        """Begin anew: the device has restarted, or its jump is known."""
        self._period_us, self._last, self._since_ns = 0.0, None, None

    def step(self, cycle: int, device_us: int, now_ns: int) -> bool:
        """Take a cycle's counter and device time, as it arrives; whether it has to wait."""
        last, self._last = self._last, (cycle, device_us)
        count = (cycle - last[0]) % _WRAP if last is not None else 0
        if last is not None and 0 < count < _LONGEST:
            passed = device_us - last[1]
            if self._fits(passed, count):
                period = self._period_us or passed / count
                self._period_us = period + LEARN * (passed / count - period)
            elif self._since_ns is None:
                self._since_ns = now_ns
                self.alarms += 1
        if self._since_ns is not None and now_ns - self._since_ns > PATIENCE_NS:
            self._false_alarm()
        return self.waiting

    def trip(self, sent_ns: int, off_ns: float, *, accepted: bool) -> None:
        """Take a round trip that was sent at `sent_ns`, `off_ns` away from the estimate."""
        if self._since_ns is None or sent_ns < self._since_ns:
            return
        if accepted and abs(off_ns) < AGREES_NS:
            self._false_alarm()

    def _fits(self, passed_us: int, count: int) -> bool:
        if not self._period_us:
            return passed_us > 0
        expected = count * self._period_us
        return abs(passed_us - expected) <= self._tolerance_us + DRIFT * expected

    def _false_alarm(self) -> None:
        self._tolerance_us = min(2.0 * self._tolerance_us, MOST_US)
        self._period_us, self._since_ns = 0.0, None
