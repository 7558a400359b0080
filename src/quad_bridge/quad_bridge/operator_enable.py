"""The operator's dead-man switch, /operator/enable: alive or not. Pure.

Whoever holds it says `true` at 5 Hz or faster; half a second of silence counts as letting go.
Where somebody has held it once, it is needed from then on: who takes a switch relies on it.
"""

from __future__ import annotations

import math

TIMEOUT_S = 0.5


class OperatorEnable:
    """`required` False: needed only once somebody has held it. Times in s on a steady clock."""

    def __init__(self, *, required: bool) -> None:
        self.required = required
        self._heard_s = -math.inf
        self._on = False

    def take(self, on: bool, now_s: float) -> None:
        """A message has come."""
        self._on, self._heard_s = on, now_s
        self.required = True

    def fault(self, now_s: float) -> str:
        """Why nobody may excite or arm now, empty where somebody may."""
        if not self.required:
            return ''
        if now_s - self._heard_s > TIMEOUT_S:
            return f'/operator/enable is silent: publish true to it every {TIMEOUT_S / 2.5:g} s'
        return '' if self._on else "the operator's enable is off"
