"""From the steady clock to ROS time, where the system clock may be set while bytes arrive. Pure.

A record with a step in its stamps is spoilt, so in flight the stamps still use the old time; on
the ground they follow a clock that is set forward. A step back would let stamps run backwards: it
waits for the next opening of the port.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

NEVER_NS = -(1 << 62)  # the epoch before the first simulated time: with it no stamp is above 0
SIMULATED_STEP_NS = 100_000_000
"""Simulated time comes in steps; stamps follow it where it differs by more."""
STEP_NS = 5_000_000  # a smaller difference is none: clocks are slewed
CLOSE_NS, TRIES = 50_000, 10
"""Two clocks are read until the readings lie so close together, so many times at the most."""


class Epoch(NamedTuple):
    """ROS time minus the steady clock, and what bounds its error, ns."""

    ns: int
    error_ns: int = 0


def read_epoch(ros_ns: Callable[[], int], steady_ns: Callable[[], int]) -> Epoch:
    """Read both clocks, one between two readings of the other: the closest pair counts.

    Whoever is pre-empted between two readings would take the pause for a step of the clock.
    """
    best: Epoch | None = None
    for _ in range(TRIES):
        before, ros, after = steady_ns(), ros_ns(), steady_ns()
        half = (after - before) // 2
        if best is None or half < best.error_ns:
            best = Epoch(ros - before - half, half)
        if best.error_ns <= CLOSE_NS:
            break
    assert best is not None  # noqa: S101  (TRIES is above 0)
    return best


class HostTime:
    """`epoch_ns` is what to add to the steady clock, ns."""

    def __init__(self, epoch_ns: int, error_ns: int = 0) -> None:
        self.epoch_ns, self._error_ns = epoch_ns, error_ns
        self.behind_ns = 0
        """How much the system clock has been set beyond the stamps; below 0: set back."""

    def opened(self, epoch_ns: int, error_ns: int = 0) -> None:
        """Take the system clock as it is: nothing is being published."""
        self.epoch_ns, self._error_ns, self.behind_ns = epoch_ns, error_ns, 0

    def follow(self, epoch_ns: int) -> None:
        """Simulated time (`use_sim_time`): it may run at another pace, stop or start anew."""
        if abs(epoch_ns - self.epoch_ns) > SIMULATED_STEP_NS:
            self.opened(epoch_ns)

    def measured(self, epoch_ns: int, error_ns: int = 0, *, armed: bool) -> str:
        """Compare with the clocks as they are; a line for the log where they differ, else ''."""
        step = epoch_ns - self.epoch_ns
        if abs(step) <= STEP_NS + error_ns + self._error_ns:
            self.behind_ns = 0
            return ''
        if step > 0 and not armed:
            self.opened(epoch_ns, error_ns)
            return f'the system clock was set: stamps move by {step * 1e-6:.0f} ms'
        is_known = abs(step - self.behind_ns) <= STEP_NS
        self.behind_ns = step
        if is_known:
            return ''
        return (
            f'the system clock was set by {step * 1e-6:.0f} ms: stamps still use the old time'
            f' {"until disarmed" if step > 0 else "until the port is opened again"}'
        )
