"""When an excitation must end: limits of angle, link, battery, and the pilot's will.

Pure: readings in, a reason out. What happens then is player.py's business. Below stands a clock
that leaves out when the node itself stood still.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from quad_sysid.contract import AXES

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Limits:
    """What ends an excitation. Angles in rad, times in s, sticks and switches in -1..1."""

    mount: str = 'rig'
    """`rig`: any stick ends it (the throttle not); `hover`: the sticks are the pilot's to use, and
    only a deflection beyond `hover_deflection` ends it."""
    angle_rad: float = math.radians(25.0)
    imu_stale_s: float = 0.2
    rc_stale_s: float = 1.0
    """Counts once a receiver has been heard."""
    battery_min_v: float = 0.0
    """0: not checked."""
    stick_dead_band: float = 0.1
    hover_deflection: float = 0.6
    abort_threshold: float = 0.5
    """The pilot's abort switch counts as thrown above this."""


@dataclass(frozen=True)
class Readings:
    """What the guard sees at one moment; None where nothing has been received."""

    imu_age_s: float | None = None
    angles: Vector | None = None
    """Roll, pitch, yaw, rad; NaN where not measured."""
    rc_age_s: float | None = None
    sticks: Vector | None = None
    """Roll, pitch, yaw."""
    abort_switch: float | None = None
    failsafe: bool = False
    battery_v: float | None = None
    """None or NaN where not measured."""


@dataclass(frozen=True)
class Abort:
    """Why an excitation ends, and whether without a ramp."""

    reason: str
    immediate: bool = False


def check(limits: Limits, readings: Readings, axis: str, yaw_start: float = 0.0) -> Abort | None:
    """The first reason to end the excitation of `axis`, the gravest first; None: go on.

    Yaw counts against `yaw_start` (rad) and only while it is the excited axis.
    """
    return (
        _receiver(limits, readings)
        or _link(limits, readings)
        or _attitude(limits, readings, axis, yaw_start)
        or _sticks(limits, readings)
        or _battery(limits, readings)
    )


def _receiver(limits: Limits, readings: Readings) -> Abort | None:
    if readings.failsafe:
        return Abort('the receiver is in failsafe', immediate=True)
    if readings.rc_age_s is not None and readings.rc_age_s > limits.rc_stale_s:
        return Abort(f'/rc/in is {readings.rc_age_s:.2f} s old', immediate=True)
    switch = readings.abort_switch
    if switch is not None and switch > limits.abort_threshold:
        return Abort("the pilot's abort switch is thrown")
    return None


def _link(limits: Limits, readings: Readings) -> Abort | None:
    if readings.imu_age_s is None:
        return Abort('no /imu/data yet')
    if readings.imu_age_s > limits.imu_stale_s:
        return Abort(f'/imu/data is {readings.imu_age_s:.2f} s old')
    return None


def _attitude(limits: Limits, readings: Readings, axis: str, yaw_start: float) -> Abort | None:
    if readings.angles is None or not all(map(math.isfinite, readings.angles)):
        return Abort('/imu/data has no orientation: the angle cannot be watched')
    roll, pitch, yaw = readings.angles
    turned = math.remainder(yaw - yaw_start, 2.0 * math.pi) if axis == 'yaw' else 0.0
    for name, angle in zip(AXES, (roll, pitch, turned), strict=True):
        if abs(angle) > limits.angle_rad:
            return Abort(
                f'{name} of {math.degrees(angle):.1f}° is beyond '
                f'{math.degrees(limits.angle_rad):.0f}°'
            )
    return None


def _sticks(limits: Limits, readings: Readings) -> Abort | None:
    if readings.sticks is None:
        return None
    allowed = limits.stick_dead_band if limits.mount == 'rig' else limits.hover_deflection
    for name, stick in zip(AXES, readings.sticks, strict=True):
        if not abs(stick) <= allowed:
            return Abort(f'the {name} stick is at {100 * stick:.0f} %')
    return None


def _battery(limits: Limits, readings: Readings) -> Abort | None:
    volts = readings.battery_v
    if volts is None or not math.isfinite(volts) or limits.battery_min_v <= 0.0:
        return None
    if volts < limits.battery_min_v:
        return Abort(f'battery at {volts:.2f} V, below {limits.battery_min_v:.2f} V')
    return None


STALL_S = 0.05
"""Between two ticks: more than this and the node stood still."""
LONGEST_S = 1.0
"""So much standstill is left out, in one piece or several; what is awake earns it back, second by
second. A longer one is left out by nothing: nobody watched the aircraft."""


class Stall:
    """Watches the times of a node's own ticks; a clock that leaves its standstills out."""

    def __init__(self) -> None:
        self._last: float | None = None
        self._left_out_s = 0.0
        self._allowed_s = LONGEST_S
        self.stood_still_s = 0.0
        """Length of the standstill before the last tick, 0 where there was none."""

    def begin(self, now_s: float) -> None:
        """Watch from `now_s` on, which is before the first tick; forget the ticks so far."""
        self._last, self.stood_still_s, self._allowed_s = now_s, 0.0, LONGEST_S

    def tick(self, now_s: float) -> None:
        """Take note of a tick, before ages are judged in it."""
        gap = 0.0 if self._last is None else now_s - self._last
        self._last = now_s
        self.stood_still_s = gap if gap > STALL_S else 0.0
        if not self.stood_still_s:
            self._allowed_s = min(self._allowed_s + gap, LONGEST_S)
        elif gap <= self._allowed_s:
            self._allowed_s -= gap
            self._left_out_s += gap

    def awake_s(self, now_s: float) -> float:
        """`now_s` (s) without the standstills so far: stamp by it what arrives, age it by it."""
        return now_s - self._left_out_s
