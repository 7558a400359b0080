"""What must stay as it was while an autopilot is excited: sticks, place, height, lean, line. Pure.

Neither PX4's OFFBOARD nor ArduPilot's SYSTEM ID watches the pilot's sticks by default. Nor does
either look at who has set the mode that a command replaces: `ModeSwitch` does.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from quad_bridge.autopilots.flight import BATTERY_S, HEIGHT_S, FlightState
from quad_bridge.wire import frames as f
from quad_bridge.wire.frames import Vector3

MOST_TILT_RAD = math.radians(35.0)  # at hover thrust a fifth of the lift is lost there
MOST_HEIGHT_M, MOST_PLACE_M = 2.0, 5.0  # from where the segment began: room to recover in
MOST_SAG = 0.08  # share of the voltage at the beginning by which the battery may sink
REQUEST_MESSAGE, HEARTBEAT = 512, 0
AGAIN_S = 0.5  # between two questions for the mode


@dataclass(frozen=True)
class Guard:
    """State of the flight at the start of a segment; `fault` gives the reason to end it."""

    mode: int
    sticks: tuple[float, ...]
    yaw: float
    height_m: float | None
    height_source: str
    place: Vector3 | None
    volts: float

    @classmethod
    def of(cls, flight: FlightState) -> Guard:
        """The flight as it is now."""
        yaw = 0.0 if flight.angles is None else flight.angles[2]
        return cls(flight.mode or 0, flight.sticks, yaw, flight.height_m, flight.height_source,
                   flight.place, flight.volts)

    def has_height(self, flight: FlightState, now_s: float) -> bool:
        """Whether the height comes, and from the source that it came from at the start."""
        return (flight.height_source == self.height_source
                and now_s - flight.height_s < HEIGHT_S)

    def mode_fault(self, flight: FlightState, own: int) -> str:
        """Why its mode ends it, where that is neither the one of before nor `own`."""
        return '' if flight.mode in {self.mode, own} else 'the pilot has chosen another mode'

    def fault(self, flight: FlightState, now_s: float) -> str:  # noqa: C901, PLR0911
        """Why what began so must end now; empty where it may go on."""
        fault = flight.line_fault(now_s) or flight.sticks_fault(now_s)
        if fault:
            return fault
        if not flight.armed:
            return 'it was disarmed'
        if flight.moved(self.sticks):
            return "the pilot's sticks were moved"
        if flight.angles is not None and max(map(abs, flight.angles[:2])) > MOST_TILT_RAD:
            return f'beyond {math.degrees(MOST_TILT_RAD):.0f} deg of roll or pitch'
        if self.height_source and not self.has_height(flight, now_s):
            return f'its height by {self.height_source} is not known any more'
        if self.height_m is not None and flight.height_m is not None:
            off_m = flight.height_m - self.height_m
            if abs(off_m) > MOST_HEIGHT_M:
                return f'{off_m:+.1f} m of height from where it began'
        if self.place is not None and flight.place is not None:
            distance_m = math.dist(flight.place[:2], self.place[:2])
            if distance_m > MOST_PLACE_M:
                return f'{distance_m:.1f} m from where it began'
        if math.isfinite(self.volts) and now_s - flight.volts_s > BATTERY_S:
            return 'the battery is not reported any more'
        if flight.volts < (1.0 - MOST_SAG) * self.volts:
            return f'the battery has sunk to {flight.volts:.1f} V'
        return ''


class ModeSwitch:
    """Changes the mode, unless the pilot has chosen another since the last heartbeat.

    A heartbeat tells the mode, but comes once a second only; one that is asked for comes within a
    round trip (where such requests are not known, the next one by itself), and allows one command.
    """

    def __init__(self, flight: FlightState, set_mode: Callable[[int], f.Command]) -> None:
        self._flight, self._set_mode = flight, set_mode
        self.restart()

    def restart(self) -> None:
        """Ask at once: it is another change."""
        self._asked_s, self._is_open = -math.inf, False

    def poll(self, previous: int, wanted: int, now_s: float) -> list[f.Frame]:
        """Say what to send now so that the mode becomes `wanted`, where it is `previous`."""
        if self._is_open and self._flight.beat_s > self._asked_s:
            self._is_open = False
            return [self._set_mode(wanted)] if self._flight.mode == previous else []
        if now_s - self._asked_s <= AGAIN_S:
            return []
        self._asked_s, self._is_open = now_s, True
        return [f.Command(REQUEST_MESSAGE, (float(HEARTBEAT),))]
