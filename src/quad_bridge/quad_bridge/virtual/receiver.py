"""The pilot's receiver: nine channels that follow a script of timed events. No I/O.

Sticks are -1..1 in body FLU terms (positive roll: right side down, positive pitch: nose down,
positive yaw: to the left), the throttle 0..1; channel 5 (aux 1) is the kill switch, channel 8
(aux 4) that of the height mode.
"""

from __future__ import annotations

from dataclasses import dataclass

from quad_bridge.virtual.airframe import require

NAMES = ('roll', 'pitch', 'throttle', 'yaw', 'aux1', 'aux2', 'aux3', 'aux4', 'aux5')


@dataclass(frozen=True)
class Event:
    """A change of `channel` to `value` at `time_s` (device time); `failsafe` takes 0 or 1."""

    time_s: float
    channel: str
    value: float | None = None  # None on the throttle: back to the trim

    def __post_init__(self) -> None:
        """Check names and ranges."""
        names = (*NAMES, 'failsafe')
        require(self.channel in names, f'channel must be one of {names}, is {self.channel!r}')
        require(self.value is not None or self.channel == 'throttle', 'value is missing')
        require(self.value is None or abs(self.value) <= 1.0, f'value beyond +-1: {self.value}')


@dataclass(frozen=True)
class Receiver:
    """The script: events in any order; before the first, sticks are centred, switches off."""

    events: tuple[Event, ...] = ()


@dataclass(frozen=True)
class Channels:
    """The receiver's channels at one time."""

    roll: float = 0.0
    pitch: float = 0.0
    throttle: float | None = None  # None: the trim that carries the weight
    yaw: float = 0.0
    aux: tuple[float, float, float, float, float] = (-1.0, -1.0, -1.0, -1.0, -1.0)
    failsafe: bool = False

    @property
    def kill(self) -> bool:
        """Kill switch (aux 1) thrown."""
        return self.aux[0] > 0.5

    @property
    def hold(self) -> bool:
        """Switch of the height mode (aux 4) thrown."""
        return self.aux[3] > 0.5

    def axes(self, trim: float) -> tuple[float, ...]:
        """The nine values in the contract's order, throttle 0..1."""
        throttle = trim if self.throttle is None else self.throttle
        return (self.roll, self.pitch, throttle, self.yaw, *self.aux)


def channels_at(script: Receiver, time_s: float) -> Channels:
    """The channels in force at a device time in s."""
    values: dict[str, float | None] = {}
    for event in sorted(script.events, key=lambda e: e.time_s):
        if event.time_s <= time_s:
            values[event.channel] = event.value
    aux = tuple(_number(values.get(f'aux{i}'), -1.0) for i in range(1, 6))
    return Channels(
        roll=_number(values.get('roll'), 0.0),
        pitch=_number(values.get('pitch'), 0.0),
        throttle=values.get('throttle'),
        yaw=_number(values.get('yaw'), 0.0),
        aux=(aux[0], aux[1], aux[2], aux[3], aux[4]),
        failsafe=_number(values.get('failsafe'), 0.0) > 0.5,
    )


def _number(value: float | None, default: float) -> float:
    return default if value is None else value
