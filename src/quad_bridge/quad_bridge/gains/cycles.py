"""What the aircraft's cycles and the pilot's stick say of an update of the gains. Pure.

Whether the link is fast enough, whether the aircraft flies and is excited, and the pilot's
gesture. What follows from it is update.py's; how well it flies is watch.py's. Times are s on a
steady clock.
"""

from __future__ import annotations

import math
from collections import deque

from quad_bridge.errors import RefusedError
from quad_bridge.wire import frames as f

QUIET_S = 0.5
"""Time without excitation before gains may change, and without a cycle before a check ends."""
LOW_THROTTLE = 0.05  # below which the STM32 commands no torque (QUAD_LOW_THROTTLE)
LINK_S = 1.0  # time without a control cycle after which gains on trial are reverted
RATE_SHARE = 0.01
"""Weight of the last cycle in the average period of arrival."""
MIN_HZ, MAX_HZ = 50.0, 1000.0
"""Control cycles per second with which watch and pulses work."""
GESTURE_END, GESTURE_ENDS, GESTURE_S = 0.8, 3, 2.0
"""Time for the pilot's gesture: the yaw stick at one end, the other and the first again."""
ARMED, EXCITATION = int(f.Flag.ARMED), int(f.Flag.EXCITATION)  # an enum's take a microsecond


class Cycles:
    """The cycles so far; `take` each one."""

    def __init__(self) -> None:
        self.flags = 0
        self.arrived_s = self.excited_s = -math.inf
        """When the last cycle arrived, and the last one with an excitation."""
        self.flying = False  # armed with the throttle up
        self._period_s = 0.0  # average time between the cycles that arrive
        self._time_us = 0  # device time of the last cycle

    def take(self, frame: f.Cycle, now_s: float, *, pulses: bool = False) -> float:
        """Take a cycle; the time since the one before. `pulses`: the excitation is a check's."""
        since_s, self.arrived_s, self.flags = now_s - self.arrived_s, now_s, frame.flags
        passed_s = min(max(1e-6 * (frame.time_us - self._time_us), 0.0), LINK_S)
        self._time_us = frame.time_us
        self._period_s += RATE_SHARE * (passed_s - self._period_s)
        self.flying = bool(frame.flags & ARMED) and frame.control[0] >= LOW_THROTTLE
        if frame.flags & EXCITATION and not pulses:
            self.excited_s = now_s
        return since_s

    @property
    def slow(self) -> str:
        """Why the link brings fewer cycles than the watch needs; empty where some may be lost."""
        if self._period_s <= 1.2 / MIN_HZ:
            return ''
        return f'the link brings {1.0 / self._period_s:.0f} cycles/s: the watch needs {MIN_HZ:g}'

    def refuse_slow(self, rate_hz: float) -> None:
        """Raise RefusedError where the watch cannot work on this link or at this `rate_hz`."""
        if self.slow:
            raise RefusedError(self.slow)
        if not MIN_HZ / 1.2 <= rate_hz <= MAX_HZ:  # as where it counts as slow
            words = f'the watch works at {MIN_HZ:g} to {MAX_HZ:g} Hz: found {rate_hz:g}'
            raise RefusedError(f'loop.rate_hz: {words}')


class Gesture:
    """The pilot's gesture that takes gains back."""

    def __init__(self) -> None:
        self.ends: deque[tuple[float, int]] = deque(maxlen=GESTURE_ENDS)

    def take(self, yaw: float, now_s: float) -> bool:
        """Take the yaw stick's position, -1..1; whether it completes the gesture."""
        end = int(yaw > GESTURE_END) - int(yaw < -GESTURE_END)
        if not end:
            return False
        if self.ends and self.ends[-1][1] == end:
            self.ends.pop()  # the last moment there counts
        self.ends.append((now_s, end))
        if len(self.ends) < GESTURE_ENDS or now_s - self.ends[0][0] > GESTURE_S:
            return False
        self.ends.clear()
        return True
