"""What is said in a log once and not every time: repeats and bursts are left out. Pure."""

from __future__ import annotations

from collections import deque


class Sparing:
    """`allow` says whether a line may be logged now; times in s on a steady clock."""

    def __init__(self, *, repeat_s: float = 30.0, burst: int = 20, per_s: float = 60.0) -> None:
        """The same line once in `repeat_s`; `burst` lines in `per_s` at most."""
        self._repeat_s, self._per_s = repeat_s, per_s
        self._said: dict[str, float] = {}
        self._times: deque[float] = deque(maxlen=burst)
        self.left_out = 0

    def allow(self, text: str, now_s: float) -> bool:
        """Whether to log `text`; counts it where not."""
        full = len(self._times) == self._times.maxlen and now_s - self._times[0] < self._per_s
        if full or now_s - self._said.get(text, -self._repeat_s) < self._repeat_s:
            self.left_out += 1
            return False
        self._said = {t: s for t, s in self._said.items() if now_s - s < self._repeat_s}
        self._said[text] = now_s
        self._times.append(now_s)
        return True
