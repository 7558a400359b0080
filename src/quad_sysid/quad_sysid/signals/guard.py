"""When an excitation must end: limits of angle, link, battery and sticks.

Pure: readings in, a reason out; player.py acts on it. Below is a clock that leaves out the times
in which the node itself did not run.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain

from quad_sysid.contract import AXES

Vector = tuple[float, float, float]
CAUSES = {'rc_kill': "the pilot's kill switch is on", 'rc_failsafe': 'its receiver is in failsafe',
          'angle_limit': 'it is beyond its angle', 'motor_test': 'its motors are being tested'}
"""Flag of the STM32 → why it refuses, the first one that applies."""


@dataclass(frozen=True)
class Limits:
    """Limits that end an excitation. Angles in rad, times in s, sticks and switches in -1..1."""

    mount: str = 'rig'
    """`rig`: any stick but the throttle ends it; `hover`: only a deflection beyond
    `hover_deflection`."""
    angle_rad: float = math.radians(25.0)
    imu_stale_s: float = 0.2
    rc_stale_s: float = 1.0
    """Applies once a receiver has been heard."""
    battery_min_v: float = 0.0
    """0: not checked. Above it, a voltage must be heard too."""
    battery_stale_s: float = 2.0
    """Age of the last voltage; /battery comes ten times a second."""
    stick_dead_band: float = 0.1
    hover_deflection: float = 0.6
    abort_switch: bool = False
    """The pilot has an abort switch, which must be heard."""

    @property
    def largest_stick(self) -> float:
        """Deflection beyond which a stick of roll, pitch or yaw ends it."""
        return self.stick_dead_band if self.mount == 'rig' else self.hover_deflection
    abort_threshold: float = 0.5
    """The pilot's abort switch counts as thrown above this."""


@dataclass(frozen=True)
class Readings:
    """The guard's inputs at one moment; None where nothing was received."""

    imu_age_s: float | None = None
    angles: Vector | None = None
    """Roll, pitch, yaw, rad; NaN where not measured."""
    rc_age_s: float | None = None
    sticks: Vector | None = None
    """Roll, pitch, yaw, -1..1."""
    abort_switch: float | None = None
    """Position of the switch, -1..1; None or NaN where /rc/in has no such channel."""
    failsafe: bool = False
    battery_v: float | None = None
    battery_age_s: float | None = None
    """Age of the last voltage that was measured."""
    refused: str = ''
    """Flags of the STM32 as it refused the excitation, with spaces between; empty: it did not."""


@dataclass(frozen=True)
class Abort:
    """Why an excitation ends; `immediate`: without a ramp."""

    reason: str
    immediate: bool = False


def check(limits: Limits, readings: Readings, axis: str, yaw_start: float = 0.0) -> Abort | None:
    """The gravest reason to end the excitation of `axis`; None: continue.

    Yaw counts against `yaw_start` (rad) and only while it is the excited axis.
    """
    return next(chain(_lines(limits, readings), _attitude(limits, readings, axis, yaw_start),
                      _sticks_and_battery(limits, readings)), None)


def _lines(limits: Limits, r: Readings) -> Iterator[Abort]:
    """Reasons of the receiver, then of the link."""
    if r.failsafe:
        yield Abort('the receiver is in failsafe', immediate=True)
    if r.rc_age_s is not None and r.rc_age_s > limits.rc_stale_s:
        yield Abort(f'/rc/in is {r.rc_age_s:.2f} s old', immediate=True)
    if r.refused:
        yield Abort(f'the STM32 refuses the excitation: {_cause(r)}', immediate=True)
    if limits.abort_switch:
        yield from _switch(limits, r)
    if r.imu_age_s is None:
        yield Abort('no /imu/data yet')
    elif r.imu_age_s > limits.imu_stale_s:
        yield Abort(f'/imu/data is {r.imu_age_s:.2f} s old')


def _cause(r: Readings) -> str:
    flags = r.refused.split()
    for flag, words in CAUSES.items():
        if flag in flags:
            return words
    if 'armed' not in flags:
        return 'it is disarmed'
    volts = '' if r.battery_v is None else f' ({r.battery_v:.2f} V)'
    return f'low battery{volts}, the throttle is down, or beyond its limits'


def _switch(limits: Limits, r: Readings) -> Iterator[Abort]:
    if r.rc_age_s is None:
        yield Abort("no /rc/in yet: the pilot's abort switch (abort_aux) cannot be watched")
    elif r.abort_switch is None or not math.isfinite(r.abort_switch):
        yield Abort("/rc/in has no channel of the pilot's abort switch (abort_aux)")
    elif r.abort_switch > limits.abort_threshold:
        yield Abort("the pilot's abort switch is thrown")


def _attitude(limits: Limits, r: Readings, axis: str, yaw_start: float) -> Iterator[Abort]:
    if r.angles is None or not all(map(math.isfinite, r.angles)):
        yield Abort('/imu/data has no orientation: the angle cannot be watched')
        return
    roll, pitch, yaw = r.angles
    yaw_change = math.remainder(yaw - yaw_start, 2.0 * math.pi) if axis == 'yaw' else 0.0
    for name, angle in zip(AXES, (roll, pitch, yaw_change), strict=True):
        if abs(angle) > limits.angle_rad:
            yield Abort(f'{name} of {math.degrees(angle):.1f}° is beyond '
                        f'{math.degrees(limits.angle_rad):.0f}°')


def _sticks_and_battery(limits: Limits, r: Readings) -> Iterator[Abort]:
    allowed = limits.largest_stick
    for name, stick in zip(AXES, r.sticks or (), strict=False):
        if not abs(stick) <= allowed:
            yield Abort(f'the {name} stick is at {100 * stick:.0f} %')
    if limits.battery_min_v > 0.0:
        yield from _battery(limits, r)


def _battery(limits: Limits, r: Readings) -> Iterator[Abort]:
    if r.battery_v is None or r.battery_age_s is None:
        yield Abort('no voltage on /battery yet: battery_min_v cannot be watched')
    elif not r.battery_age_s <= limits.battery_stale_s:
        yield Abort(f'the last voltage on /battery is {r.battery_age_s:.1f} s old')
    elif not r.battery_v >= limits.battery_min_v:
        yield Abort(f'battery at {r.battery_v:.2f} V, below {limits.battery_min_v:.2f} V')


STALL_S = 0.05
"""Time between two ticks above which the node counts as stalled."""
MOST_STALLED_S = 1.0
"""Most stalled time that is left out, in one piece or several; running time restores it second by
second. A longer stall counts as age, because nothing watched the aircraft."""


class Stall:
    """A clock that leaves out the stalls of the node, seen from the times of its ticks."""

    def __init__(self, period_s: float = 0.0) -> None:
        """`period_s` between two ticks that are in time."""
        self._longest_s = max(STALL_S, 2.5 * period_s)
        self._last: float | None = None
        self._stalled_s = 0.0
        self._allowed_s = MOST_STALLED_S
        self.stood_still_s = 0.0
        """Length of the stall before the last tick, s; 0: none."""

    def begin(self, now_s: float) -> None:
        """Start at `now_s`, before the first tick, and forget earlier ticks."""
        self._last, self.stood_still_s, self._allowed_s = now_s, 0.0, MOST_STALLED_S

    def tick(self, now_s: float) -> None:
        """Register a tick, before ages are judged in it."""
        gap = 0.0 if self._last is None else now_s - self._last
        self._last = now_s
        self.stood_still_s = gap if gap > self._longest_s else 0.0
        if not self.stood_still_s:
            self._allowed_s = min(self._allowed_s + gap, MOST_STALLED_S)
        elif gap <= self._allowed_s:
            self._allowed_s -= gap
            self._stalled_s += gap

    def awake_s(self, now_s: float) -> float:
        """`now_s` (s) less the stalls so far; use it for arrival times and for ages."""
        return now_s - self._stalled_s
