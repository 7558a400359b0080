"""Effects that are linear, in the place of others that move most like them (loop/linear.py).

They are fitted to a law, not to a flight, and stand in no list.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.model.effect import Drive, Effect, Settings, Signals, required


class Linearised(Effect):
    """x' = a x + b inputs, and c x + d inputs is what it gives."""

    name = 'linear'

    def __init__(self, states: int, rows: FloatArray, steady: FloatArray) -> None:
        """`rows` (states + outputs, states + inputs); rest (states,)."""
        self.states, self.rows, self.rest = states, rows, steady

    def inputs(self, s: Signals) -> FloatArray:
        """(inputs, …) what moves it."""
        raise NotImplementedError

    def _all(self, s: Signals, x: FloatArray | None) -> FloatArray:
        inputs = self.inputs(s)
        from_rest = [] if x is None else [x - self.rest.reshape(-1, *[1] * (x.ndim - 1))]
        return np.tensordot(self.rows, np.concatenate([*from_rest, inputs]), 1)

    def begin(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        return np.repeat(self.rest[:, None], s.time.size, axis=1)

    def advance(self, x: FloatArray, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        return self._all(s, x)[: self.states] + self.rest[:, None]

    def outputs(self, s: Signals) -> FloatArray:
        """(outputs, …) what it gives."""
        return self._all(s, s.hidden if self.states else None)[self.states :]


class LinearTorque(Linearised):
    """A torque of rate, angle, drive and the drive's change."""

    signals = ('rate',)

    def inputs(self, s: Signals) -> FloatArray:
        return np.stack([s.rate, required(s.angle), s.drive, s.change])

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        return self.outputs(s)[0]


class LinearMap(Linearised):
    """The linear likeness of an effect that maps the command."""

    def inputs(self, s: Signals) -> FloatArray:
        return required(s.sent)[None]

    def command(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        return self.outputs(s)[0]


class Trim(Effect):
    """The command about which a loop works, added to what is sent; it stands first."""

    name = 'trim'

    def __init__(self, trim: float) -> None:
        """`trim`: the command, normalised, or a lean in rad."""
        self.trim = trim

    def command(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        return required(s.sent) + self.trim


class LinearChannels(Effect):
    """The linear likeness of the effects between command and motors: channels with a lag each.

    It stands first and sees the command as it was sent.
    """

    name = 'linear'

    def __init__(self, slopes: FloatArray, drive: Drive) -> None:
        """`slopes` (c, 2) of each channel over the mapped command and over that of the motors."""
        self.slopes, self.drive = slopes, drive

    def actuate(self, drive: Drive, s: Signals, p: FloatArray, settings: Settings) -> Drive:
        commands = self.slopes @ np.stack([drive.commands[0], required(s.sent)])
        lag = np.repeat(self.drive.lag, commands.shape[1], axis=1)
        return replace(drive, commands=commands, row=self.drive.row, lag=lag,
                       factors=np.zeros((1, 2, 6)))
