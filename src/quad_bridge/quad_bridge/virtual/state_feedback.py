"""Compiled second control mode: the angle by state feedback, with observer, delay and integral.

    drive' = (gain u(t - delay) - drive) / lag,  rate' = drive - damping rate,  angle' = rate
    u = k_angle e - k_rate rate - k_drive drive + k_integral xi,  e = reference - angle, xi' = e

An observer corrects the model's rate by the measured one; from there the states are predicted over
the delay (whole cycles) with the commands that are under way, so the feedback acts on the states
in which its command will arrive. One step: drive exact for a held command, rate and angle by the
trapezoid. Source: Franklin, Powell, Workman, Digital Control of Dynamic Systems, 3rd ed., 8.2 and
8.6. Off (gain 0) it leaves no trace. Limits, mixing with the cascade and excitation: control.py.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from quad_bridge.virtual.compiled import kernel
from quad_bridge.virtual.gain_columns import (
    INTEGRATOR_LIMIT,
    LQR_ANGLE,
    LQR_DAMPING,
    LQR_DELAY_S,
    LQR_DRIVE,
    LQR_GAIN,
    LQR_INTEGRAL,
    LQR_LAG_S,
    LQR_OBSERVER,
    LQR_RATE,
    RATE_LIMIT,
)

FloatArray = npt.NDArray[np.float64]

DRIVE, RATE, INTEGRAL, COMMANDS = range(4)
"""An axis' states: rad/s², rad/s, rad s, and the last commands, newest first."""
LONGEST_DELAY = 15
"""Cycles."""
STATES = COMMANDS + LONGEST_DELAY + 1


@kernel
def cycles_late(row: FloatArray, dt: float) -> int:
    """The delay in whole control cycles."""
    return int(min(LONGEST_DELAY, max(0.0, math.floor(row[LQR_DELAY_S] / dt + 0.5))))


@kernel
def state_feedback(
    own: FloatArray, row: FloatArray, dt: float, error: float, rate: float
) -> float:
    """Command of this cycle, unlimited, from the angle's error (rad) and the measured rate."""
    own[RATE] += row[LQR_OBSERVER] * (rate - own[RATE])
    drive, speed, total = own[DRIVE], own[RATE], own[INTEGRAL]
    late = cycles_late(row, dt)
    share = 1.0 - math.exp(-dt / max(row[LQR_LAG_S], 1e-5))
    for j in range(late):
        command = own[COMMANDS + late - 1 - j]
        following = drive + share * (row[LQR_GAIN] * command - drive)
        after = speed + dt * (0.5 * (drive + following) - row[LQR_DAMPING] * speed)
        total += dt * error
        error -= 0.5 * dt * (speed + after)
        drive, speed = following, after
    # the same limit of the rate that is asked for as the cascade's
    reach = row[RATE_LIMIT] * row[LQR_RATE]
    pull = min(reach, max(-reach, row[LQR_ANGLE] * error))
    return float(
        pull - row[LQR_RATE] * speed - row[LQR_DRIVE] * drive + row[LQR_INTEGRAL] * total
    )


@kernel
def state_feedback_moved(
    own: FloatArray, row: FloatArray, dt: float, error: float, command: float, held: bool
) -> None:
    """Take over what was commanded; `held`: the integral stays, the output was at its limit."""
    if not held and row[LQR_INTEGRAL] > 0.0:
        reach = row[INTEGRATOR_LIMIT] / row[LQR_INTEGRAL]
        own[INTEGRAL] = min(reach, max(-reach, own[INTEGRAL] + dt * error))
    for j in range(LONGEST_DELAY, 0, -1):
        own[COMMANDS + j] = own[COMMANDS + j - 1]
    own[COMMANDS] = command
    acting = own[COMMANDS + cycles_late(row, dt)]
    share = 1.0 - math.exp(-dt / max(row[LQR_LAG_S], 1e-5))
    drive = own[DRIVE] + share * (row[LQR_GAIN] * acting - own[DRIVE])
    own[RATE] += dt * (0.5 * (own[DRIVE] + drive) - row[LQR_DAMPING] * own[RATE])
    own[DRIVE] = drive
