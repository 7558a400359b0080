"""Whether a frame can be what was sent: one damaged frame in 65,536 has a good checksum after all.

The bounds are far outside of what a quadrotor does; what is merely unlikely passes. Of an
autopilot's sensors a vector that cannot be is dropped alone: one autopilot sends a compass in
another unit for all of a flight, beside a good gyro.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from quad_bridge.wire import frames as f

LARGEST = 1000.0  # no value of a cycle is larger, in rad, rad/s, m/s² or normalised command
MAX_ANGLE = 6.3  # rad: one turn
MAX_FLAGS = 0x0FFF  # no flag has a higher bit
_ABOVE_ONE = 1.001  # a full motor command, rounded


def plausible(frame: f.Frame) -> f.Frame | None:
    """The frame without vectors that cannot be; None where nothing of it can be used.

    What cannot be are values that are no numbers, out of all bounds, or of no known meaning.
    """
    check = _CHECKS.get(type(frame))
    if check is not None:
        return frame if check(frame) else None
    if isinstance(frame, f.Attitude):
        return _attitude(frame)
    return _sensors(frame) if isinstance(frame, f.SlowSensors) else frame


MAX_INJECTION = int(max(f.Injection))


def _cycle(frame: f.Cycle) -> bool:
    angles = frame.attitude + frame.attitude_setpoint
    return (
        _bounded(frame.gyro + frame.accel + frame.rate_setpoint + frame.control
                 + frame.excitation + angles + frame.motors)
        and max(angles) < MAX_ANGLE
        and min(angles) > -MAX_ANGLE
        and min(frame.motors) >= 0.0
        and max(frame.motors) < _ABOVE_ONE
        and frame.flags <= MAX_FLAGS
        and frame.injection <= MAX_INJECTION
    )


def _bounded(values: tuple[float, ...]) -> bool:
    # the sum finds NaN, which the comparisons would let pass
    return math.isfinite(sum(values)) and max(values) < LARGEST and min(values) > -LARGEST


def _attitude(frame: f.Attitude) -> f.Attitude | None:
    if not _bounded(frame.angles):
        return None
    return frame if _whole(frame.rates) else replace(frame, rates=None)


def _sensors(frame: f.SlowSensors) -> f.SlowSensors:
    valid = [_whole(v) for v in (frame.gyro, frame.accel, frame.mag_gauss)]
    pressure = frame.pressure_hpa
    valid.append(pressure is None or math.isfinite(pressure))
    if all(valid):
        return frame
    gyro, accel, mag, air = valid
    return replace(
        frame, gyro=frame.gyro if gyro else None, accel=frame.accel if accel else None,
        mag_gauss=frame.mag_gauss if mag else None, pressure_hpa=pressure if air else None,
    )  # fmt: skip


def _whole(vector: f.Vector3 | None) -> bool:
    return vector is None or _bounded(vector)


_CHECKS: dict[type, Callable[[Any], bool]] = {
    f.Cycle: _cycle,
    f.GainsState: lambda x: (
        x.action <= max(f.GainsAction)
        and x.result <= max(f.GainsResult)
        and x.phase <= max(f.GainsPhase)
    ),
    f.GainsCommand: lambda x: x.action <= max(f.GainsAction),
    f.ParamValue: lambda x: math.isfinite(x.value) or x.kind != f.REAL32,
    f.AttitudeTarget: lambda x: _bounded((*x.q, *x.rates, x.thrust)),
    f.LocalPosition: lambda x: math.isfinite(sum(x.place + x.speed)),
    f.Excitation: lambda x: _bounded(x.value) and x.injection <= max(f.Injection),
}
