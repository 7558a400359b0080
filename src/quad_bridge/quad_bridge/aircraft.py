"""One aircraft as the bridge asks it: excitation, gains, what it cannot do.

`Aircraft` is what bridge, relay and services know; the frames that an autopilot wants for it are
its own class's. `Quad` speaks to the firmware of this project, `autopilots/` to PX4 and ArduPilot.
Nothing here sends: each request gives the frame to send.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from enum import Enum
from typing import Any, Protocol

from quad_bridge.gains.protocol import GainEvent, GainProtocol, Keep, Request
from quad_bridge.wire import frames as f
from quad_bridge.wire.axes import flip_body

ACCEPTED = 'accepted'
RESULTS = (ACCEPTED, 'not now', 'denied', 'not supported', 'failed')
STILL = (0.0, 0.0, 0.0)
INJECTIONS = {'attitude': f.Injection.ATTITUDE, 'rate': f.Injection.RATE,
              'control': f.Injection.CONTROL}


def outcome_of(result: int) -> str:
    """A MAV_RESULT in words."""
    return RESULTS[result] if result < len(RESULTS) else f'result {result}'


class Ability(Enum):
    """Abilities that an aircraft may have."""

    EXCITE = 'excitation'
    GAINS = 'gains'
    PULSES = 'test pulses'
    MOTORS = 'motor tests'


class Gains(Protocol):
    """Sets of gains on the aircraft: nothing is active that was not read back. No I/O.

    `poll` says what to send, `take` what came back, `events` what has happened.
    """

    events: list[GainEvent]
    active: Mapping[str, float]
    """Contract names, SI; empty until they are read back."""
    pulses: bool
    """Whether it takes test pulses, which it must then before its gains are changed."""
    cycles_hz: float
    """Cycles per second for the watch where `active` does not say it; 0: it does."""
    keep: Keep
    """Writes to the aircraft's files what must outlive this process."""

    @property
    def names(self) -> Mapping[str, str]:
        """Contract names to those that `write` takes, where these are others."""

    @property
    def aircraft(self) -> str:
        """Name of the aircraft's files; empty while the aircraft is not known."""

    @property
    def reading(self) -> bool:
        """Whether the gains have not been read as a whole yet."""

    @property
    def in_common(self) -> frozenset[str]:
        """Gains that are one for all axes."""

    def recall(self, record: object) -> None:
        """Take what `keep` has written last, once the aircraft's files are open."""

    @property
    def busy(self) -> str:
        """The current activity; empty where a set may be written."""

    def write(self, writes: Mapping[str, float], watch_ms: int) -> None:
        """Begin to write a set on trial, whole or not at all."""

    def confirm(self) -> None:
        """Keep the set on trial."""

    def revert(self, reason: str) -> None:
        """Take back the set that is being written or on trial."""

    def restart(self) -> None:
        """Read everything again."""

    def poll(self, now_s: float) -> Request | None:
        """Say what to send now."""

    def take(self, frame: f.ParamValue | f.GainsState, now_s: float) -> None:
        """Take an answer."""


class Aircraft(ABC):
    """See the module."""

    gains: Gains

    @property
    def at_rest(self) -> bool:
        """Whether excitation and trial have left nothing that the bridge has to put back."""
        return True

    @abstractmethod
    def cannot(self, ability: Ability) -> str:
        """Why it has not this ability; empty where it has."""

    @abstractmethod
    def excite(
        self, value: f.Vector3, injection: f.Injection, valid_ms: int
    ) -> f.Frame | None:
        """Give the frame that adds `value` (FLU, the injection's unit), if one does."""

    @abstractmethod
    def abort(self) -> f.Frame | None:
        """Give the frame that ends an excitation at once, if one does."""

    def segment(self, parameters: Mapping[str, Any] | None) -> None:  # noqa: B027
        """A segment of the schedule begins, as it was announced; None: it has ended."""


class Quad(Aircraft):
    """An aircraft with this project's firmware; of another, what MAVLink's standard gives."""

    gains: GainProtocol

    def __init__(self, standard: Callable[[], str] = lambda: '') -> None:
        """`standard` gives the name of an autopilot that sends standard messages only, or ''."""
        self.gains = GainProtocol()
        self._standard = standard
        self._seq = 0

    def cannot(self, ability: Ability) -> str:
        """Why it has not this ability; empty where it has."""
        name = self._standard()
        if not name:
            return ''
        if ability is Ability.EXCITE:
            return f'{name} has no QUAD_EXCITATION: no excitation of it'
        if ability is Ability.MOTORS:
            return f'{name} has a motor test of its own, in its ground station'
        return f'{name} has no QUAD_GAINS: no gains or pulses for it'

    def excite(self, value: f.Vector3, injection: f.Injection, valid_ms: int) -> f.Frame:
        """Give the frame that adds `value`; the frames are numbered, so an old one is detected."""
        self._seq = (self._seq + 1) % 256
        return f.Excitation(flip_body(value), int(injection), self._seq, valid_ms)

    def abort(self) -> f.Frame:
        """Give the frame that ends an excitation; it clears a refusal too."""
        return self.excite(STILL, f.Injection.NONE, 100)
