"""Which cycles must wait for a round trip of TIMESYNC before they are stamped. No timers, no I/O.

Both guards take every cycle (`step`) and every round trip (`trip`), and say by `waiting` whether
cycles are to be held back.

StepGuard: TIMESYNC sees a jump of a running STM32's clock only at its next round trips; cycles
stamped until then would be wrong. Cycle counter and device time step together, so a step that does
not fit holds cycles back until a later round trip has shown it.

LateGuard: a host that stood still, or a line that held bytes back, delivers a burst, which catches
up within milliseconds. An aircraft that restarted while nobody heard it, with a cycle counter that
happens to be higher than before, stays behind for ever. So what is late waits until it has caught
up, or a round trip has shown it.
"""

from __future__ import annotations

_WRAP = 1 << 32
_LONGEST = 1_000_000  # cycles: a larger step of the counter is a restart
MIN_US, MAX_US = 1_000, 20_000
"""Allowed deviation of a step, doubled by each false alarm: some aircraft have uneven cycles."""
AGREES_NS = 1_000_000  # a round trip this close to the estimate: the clock has not jumped
TIMEOUT_NS = 300_000_000  # without an answer to TIMESYNC for so long nothing is held back
LEARN = 1.0 / 64.0  # share of each new period in the mean, of which one cycle says little
DRIFT = 1e-3  # share of a gap by which the period that was learned may be off
PAST_NS = 100_000_000  # a smaller delay needs no explanation: a busy host


class StepGuard:
    """Compares steps of device time with steps of the cycle counter."""

    def __init__(self) -> None:
        self.alarms = 0  # steps that did not fit
        self._tolerance_us = float(MIN_US)
        self.restart()

    @property
    def waiting(self) -> bool:
        """Whether cycles are held back until a TIMESYNC round trip."""
        return self._since_ns is not None

    def restart(self) -> None:
        """Reset, after a restart of the device or a known jump."""
        self._period_us = 0.0
        self._last: tuple[int, int] | None = None
        self._since_ns: int | None = None

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
        if self._since_ns is not None and now_ns - self._since_ns > TIMEOUT_NS:
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
        self._tolerance_us = min(2.0 * self._tolerance_us, MAX_US)
        self._period_us, self._since_ns = 0.0, None


class LateGuard:
    """Compares a cycle's arrival with the time that its stamp would have."""

    def __init__(self) -> None:
        self.fits_restart = False  # device time fits a start since the last cycle before
        self._late_ns = 0
        self.restart()

    @property
    def waiting(self) -> bool:
        """Whether cycles are held back until the reason is known."""
        return self._since_ns is not None

    def restart(self) -> None:
        """Reset, since stamps are by another clock now."""
        self.reset = False  # whether the clock of before is no more
        self._since_ns: int | None = None
        self._allowed_ns = PAST_NS

    def late(self, late_ns: int) -> bool:
        """Whether so much between stamp and arrival needs an explanation."""
        return late_ns > self._allowed_ns

    def step(self, late_ns: int, now_ns: int, *, fits_restart: bool) -> bool:
        """Take a cycle's lateness as it arrives; whether it has to wait."""
        self._late_ns = late_ns
        if late_ns <= PAST_NS:
            self.restart()
        elif self._since_ns is None:
            if self.late(late_ns):
                self._since_ns, self.fits_restart = now_ns, fits_restart
        elif now_ns - self._since_ns > TIMEOUT_NS:
            self.reset = self.fits_restart
            self.believe(late_ns)
        return self.waiting

    def trip(self, sent_ns: int, off_ns: float, round_trip_ns: int) -> None:
        """Take a round trip, however long, that is `off_ns` away from the estimate.

        Half of what it took bounds its own error.
        """
        if self._since_ns is None or sent_ns < self._since_ns:
            return
        if abs(off_ns) > (round_trip_ns + PAST_NS) / 2:
            self.reset = True
        else:
            self.believe(self._late_ns)

    def believe(self, late_ns: int) -> None:
        """Accept this lateness from now on."""
        self._since_ns, self._allowed_ns = None, late_ns + PAST_NS
