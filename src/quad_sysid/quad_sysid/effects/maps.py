"""Maps of the command before the motors: without memory, with kept values, with linear states.

The rows that use them are in actuators.py.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.effects.hidden import Linked
from quad_sysid.effects.loads import along
from quad_sysid.effects.torques import Row
from quad_sysid.model.data import Span
from quad_sysid.model.effect import Left, Settings, Signals, required

SLOPING = 0.05
"""Share of a step over which one level gives way to the next."""


class Map(Row):
    """A map of the command; of every motor's command where it depends on the motors.

    Its law takes the signals, the commands (1, …) or those of the motors (k, …), and the
    parameters.
    """

    term = 'command'

    def commands(self, s: Signals) -> FloatArray:
        """What it maps: (1, …) the axis' command, or (k, …) those of the motors."""
        return np.stack(required(s.motors) if 'motors' in self.signals else [required(s.sent)])

    def command(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        given = self.commands(s)
        mapped: FloatArray = self.law(s, given, p)
        if 'motors' not in self.signals:
            return mapped[0]
        return required(s.sent) + np.tensordot(required(s.share), mapped - given, 1)


class Kept(Map):
    """A map that keeps what it gave in the last cycle, by a compiled loop along a flight."""

    states = 1
    loop: Callable[..., None]
    """The law along a flight, into what is kept at the start of each cycle."""
    numbers: Callable[[Signals, FloatArray], tuple[float, ...]]
    """Of the loop."""

    def mapped(self, s: Signals, p: FloatArray) -> FloatArray:
        """The commands (k, …) as the loop takes them."""
        return self.commands(s)

    def begin(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        return self.mapped(s, p)

    def advance(
        self, x: FloatArray, s: Signals, p: FloatArray, settings: Settings
    ) -> FloatArray:
        return self.law(s.but(hidden=x), self.mapped(s, p), p)

    def trace(
        self, s: Signals, p: FloatArray, settings: Settings, stretches: Sequence[Span],
        begun: FloatArray | None = None,
    ) -> FloatArray:
        numbers = self.numbers(s, p)
        return np.stack([along(stretches, u, self.loop, *numbers) for u in self.mapped(s, p)])


class Steps(Kept):
    """Motors that take whole steps; one level lies p[1] steps of p[0] above half of the range.

    A level is kept until the command is p[2] steps further away from it than half of one. Around
    that point two steps share the cycle over a short slope, for a smooth likelihood.
    """

    def mapped(self, s: Signals, p: FloatArray) -> FloatArray:
        return (self.commands(s) - 0.5) / p[0] - p[1]

    def begin(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        return np.floor(self.mapped(s, p) + 0.5)

    def sought(self, left: Left, settings: Settings) -> Sequence[FloatArray]:
        starts = self.starts(left.data, settings)
        return [np.r_[step, start[2:]] for step in left.steps() for start in starts]

    def command(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        x, kept = self.mapped(s, p), required(s.hidden)
        away = x - kept
        over = np.abs(away) - 0.5 - p[2]
        new = np.where(over > 0.0, np.floor(x + 0.5),
                       kept + np.where(over > -0.5 * SLOPING, np.sign(away), 0.0))
        taken = new + np.maximum(0.5 - over / SLOPING, 0.0) * (kept - new)
        mapped = 0.5 + p[0] * (p[1] + taken) - self.commands(s)
        return required(s.sent) + np.tensordot(required(s.share), mapped, 1)


class Following(Linked, Map):
    """A map with linear states that the command drives."""

    def inputs(self, s: Signals, settings: Settings) -> Sequence[FloatArray]:
        return (required(s.sent),)

    def begin(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        sent = required(s.sent)
        return np.stack([sent, *[np.zeros_like(sent)] * (self.states - 1)])
