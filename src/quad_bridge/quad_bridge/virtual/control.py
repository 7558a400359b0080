"""Compiled control cycle of the firmware: C1, C2 or state feedback, excitation, mixer with limits.

C1: rate reference = kp (reference - angle), limited. C2: u = kp e + ki int e - kd d(rate)/dt with
the D term on the measured rate behind a first-order filter (backward Euler), integrator clamped,
output limited. Excitation is added to the attitude reference, behind C1's limit to the rate
reference, or behind C2's limit to U2..U4. Gains are SI (contract).

An axis flies `lqr.share` of the state feedback (state_feedback.py) and the rest of the cascade: 0,
the default, is the cascade alone. Only one integral runs, the state feedback's where it has a
share; the other follows.

Where `sag.exponent` is not 0, what C2 or the feedback commands is multiplied by that power of
(reference voltage / voltage), low-passed: a pack that sags does not weaken the loop.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from quad_bridge.virtual.compiled import kernel
from quad_bridge.virtual.gain_columns import (
    ANGLE_KP,
    D_FILTER_HZ,
    INTEGRATOR_LIMIT,
    KD,
    KI,
    KP,
    LQR_GAIN,
    LQR_INTEGRAL,
    LQR_RATE,
    LQR_SHARE,
    OUTPUT_LIMIT,
    RATE_LIMIT,
    SAG_EXPONENT,
    SAG_VOLTS,
)
from quad_bridge.virtual.rotation import wrapped
from quad_bridge.virtual.state_feedback import INTEGRAL as TOTAL
from quad_bridge.virtual.state_feedback import (
    RATE,
    STATES,
    state_feedback,
    state_feedback_moved,
)

FloatArray = npt.NDArray[np.float64]

INTEGRAL, D_STATE, LAST_RATE, YAW_REFERENCE, STARTED, QUEUE = 0, 3, 6, 9, 10, 11
QUEUE_ROWS = 5
FEEDBACK = QUEUE + 4 * QUEUE_ROWS
VOLTS = FEEDBACK + 3 * STATES
CONTROL_STATES = VOLTS + 1
VOLTAGE_LAG_S = 0.5
LARGEST_LIFT = 1.5
"""Of the command, either way, whatever voltage is measured."""

ARMED, INJECTION, ADDED, STICK_ROLL, STICK_PITCH, THROTTLE, STICK_YAW = 0, 1, 2, 5, 6, 7, 8
INPUTS = 9
"""Columns of what reaches a cycle from outside: armed 0/1, injection 0..3 (none, attitude, rate,
control), excitation (3), sticks -1..1, throttle 0..1."""

SATURATED, ANGLE_LIMITED = 1.0, 2.0


class Controller(NamedTuple):
    """What the control cycle knows; `gains` is written in place by parameter writes."""

    gains: FloatArray
    cycle_s: float
    delay_cycles: int
    stick_angle: float
    stick_yaw_rate: float
    angle_limit: float
    climb_kp: float
    """Pilot's altitude hold in hover: throttle per m; 0 on the rig."""
    climb_kd: float


class Output(NamedTuple):
    """Where a cycle writes its results."""

    attitude_reference: FloatArray
    rate_reference: FloatArray
    wrench: FloatArray
    motors: FloatArray


@kernel
def second_loop(
    memory: FloatArray, controller: Controller, axis: int, reference: float, rate: float
) -> float:
    """C2 of one axis: normalised command from the rate's reference and measurement, rad/s."""
    row, dt = controller.gains[axis], controller.cycle_s
    error = reference - rate
    total = memory[INTEGRAL + axis] + row[KI] * error * dt
    memory[INTEGRAL + axis] = min(row[INTEGRATOR_LIMIT], max(-row[INTEGRATOR_LIMIT], total))
    share = dt / (dt + 1.0 / (2.0 * math.pi * row[D_FILTER_HZ]))
    slope = (rate - memory[LAST_RATE + axis]) / dt
    memory[D_STATE + axis] += share * (slope - memory[D_STATE + axis])
    memory[LAST_RATE + axis] = rate
    raw = row[KP] * error + memory[INTEGRAL + axis] - row[KD] * memory[D_STATE + axis]
    return float(min(row[OUTPUT_LIMIT], max(-row[OUTPUT_LIMIT], raw)))


@kernel
def lift(row: FloatArray, volts: float) -> float:
    """What a command is multiplied by at this voltage."""
    if not (row[SAG_EXPONENT] > 0.0 and row[SAG_VOLTS] > 0.0 and volts > 0.0):
        return 1.0
    factor = (row[SAG_VOLTS] / volts) ** row[SAG_EXPONENT]
    return float(min(LARGEST_LIFT, max(1.0 / LARGEST_LIFT, factor)))


@kernel
def _own(memory: FloatArray, axis: int) -> FloatArray:
    """The state feedback's states of an axis, written in place."""
    return memory[FEEDBACK + axis * STATES : FEEDBACK + (axis + 1) * STATES]


@kernel
def blended(
    memory: FloatArray, controller: Controller, axis: int, u: float, error: float, rate: float,
    added: float,
) -> float:  # fmt: skip
    """`u` of the cascade with the axis' share of state feedback in it; `added` rad/s wanted."""
    row, own = controller.gains[axis], _own(memory, axis)
    share, limit = row[LQR_SHARE], row[OUTPUT_LIMIT]
    if share <= 0.0 and row[LQR_INTEGRAL] > 0.0:
        own[TOTAL] = memory[INTEGRAL + axis] / row[LQR_INTEGRAL]
    raw = state_feedback(own, row, controller.cycle_s, error, rate) + row[LQR_RATE] * added
    if share <= 0.0:
        return u
    # two integrals of the same error would drift apart
    total = row[LQR_INTEGRAL] * own[TOTAL]
    memory[INTEGRAL + axis] = min(row[INTEGRATOR_LIMIT], max(-row[INTEGRATOR_LIMIT], total))
    mixed = share * raw + (1.0 - share) * u
    return float(min(limit, max(-limit, mixed)))


@kernel
def mix(wrench: FloatArray, armed: bool, motors: FloatArray) -> bool:
    """Write the motor commands (4,) of U1..U4 (4,), 0..1; True where one was cut."""
    motors[0] = wrench[0] + wrench[1] + wrench[2] + wrench[3]
    motors[1] = wrench[0] - wrench[1] + wrench[2] - wrench[3]
    motors[2] = wrench[0] - wrench[1] - wrench[2] + wrench[3]
    motors[3] = wrench[0] + wrench[1] - wrench[2] - wrench[3]
    cut = False
    for i in range(4):
        if not armed:
            motors[i] = 0.0
        elif motors[i] < 0.0 or motors[i] > 1.0:
            motors[i] = min(1.0, max(0.0, motors[i]))
            cut = True
    return cut


@kernel
def control_cycle(
    memory: FloatArray,
    controller: Controller,
    given: FloatArray,
    gyro: FloatArray,
    attitude: FloatArray,
    volts: float,
    out: Output,
) -> float:
    """One cycle; writes `out`, returns the sum of SATURATED and ANGLE_LIMITED that apply."""
    armed = given[ARMED] > 0.5
    share = controller.cycle_s / VOLTAGE_LAG_S if memory[VOLTS] > 0.0 else 1.0
    memory[VOLTS] += share * (volts - memory[VOLTS])
    if memory[STARTED] == 0.0 or not armed:
        memory[STARTED] = 1.0
        memory[YAW_REFERENCE] = attitude[2]
        for i in range(3):
            memory[INTEGRAL + i] = 0.0
            memory[LAST_RATE + i] = gyro[i]
            own = _own(memory, i)
            own[:] = 0.0
            own[RATE] = gyro[i]
    memory[YAW_REFERENCE] = wrapped(
        memory[YAW_REFERENCE] + given[STICK_YAW] * controller.stick_yaw_rate * controller.cycle_s
    )
    out.attitude_reference[0] = given[STICK_ROLL] * controller.stick_angle
    out.attitude_reference[1] = given[STICK_PITCH] * controller.stick_angle
    out.attitude_reference[2] = memory[YAW_REFERENCE]
    out.wrench[0] = given[THROTTLE] if armed else 0.0
    for i in range(3):
        if given[INJECTION] == 1.0:
            out.attitude_reference[i] += given[ADDED + i]
        row = controller.gains[i]
        error = wrapped(out.attitude_reference[i] - attitude[i])
        wanted = row[ANGLE_KP] * error
        wanted = min(row[RATE_LIMIT], max(-row[RATE_LIMIT], wanted))
        added = given[ADDED + i] if given[INJECTION] == 2.0 else 0.0
        if given[INJECTION] == 2.0:
            wanted += added
        out.rate_reference[i] = wanted
        u = second_loop(memory, controller, i, wanted, gyro[i])
        followed = row[LQR_GAIN] > 0.0
        if followed:
            u = blended(memory, controller, i, u, error, gyro[i], added)
        held = abs(u) >= row[OUTPUT_LIMIT]
        added = given[ADDED + i] if given[INJECTION] == 3.0 else 0.0
        if followed:
            state_feedback_moved(_own(memory, i), row, controller.cycle_s, error, u + added, held)
        out.wrench[1 + i] = u * lift(row, memory[VOLTS]) + added if armed else 0.0
    cut = mix(out.wrench, armed, out.motors)
    limited = max(abs(attitude[0]), abs(attitude[1])) > controller.angle_limit
    return (SATURATED if cut else 0.0) + (ANGLE_LIMITED if limited else 0.0)


@kernel
def delayed(memory: FloatArray, controller: Controller, cycle: int, motors: FloatArray) -> None:
    """Put this cycle's commands in the queue; `motors` becomes those that act now."""
    now = QUEUE + 4 * (cycle % QUEUE_ROWS)
    then = QUEUE + 4 * ((cycle - controller.delay_cycles) % QUEUE_ROWS)
    for i in range(4):
        memory[now + i] = motors[i]
    for i in range(4):
        motors[i] = memory[then + i]


def initial_memory(throttle: float) -> FloatArray:
    """State of the controller at boot: the motors already run at `throttle` (0 if disarmed)."""
    memory = np.zeros(CONTROL_STATES)
    memory[QUEUE:FEEDBACK] = throttle
    return memory
