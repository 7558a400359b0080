"""The pilot's way to say no: the yaw stick to one end, the other and back, within two seconds."""

from __future__ import annotations

from collections import deque

END = 0.8
"""Of the stick's way, -1..1."""
TURNS, WITHIN_S = 3, 2.0


class StickGesture:
    """Counts the ends that the stick reached, alternately."""

    def __init__(self) -> None:
        self._ends: deque[tuple[float, int]] = deque(maxlen=TURNS)

    def step(self, yaw: float, now_s: float) -> bool:
        """Take the stick's place, -1..1; True once when the gesture is complete."""
        end = 1 if yaw > END else -1 if yaw < -END else 0
        if end and (not self._ends or self._ends[-1][1] != end):
            self._ends.append((now_s, end))
            if len(self._ends) == TURNS and now_s - self._ends[0][0] <= WITHIN_S:
                self._ends.clear()
                return True
        return False
