"""Compiled entry points: whole control cycles, or one in pieces for an effect written in Python.

A cycle is: read the sensors, compute, put the commands into the delay queue, then run the physics
to the next cycle. Both ways run the same kernels in the same order, so they agree exactly.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from quad_bridge.virtual.compiled import entry, kernel, source_digest
from quad_bridge.virtual.control import THROTTLE, Controller, Output, control_cycle, delayed
from quad_bridge.virtual.physics import (
    POSITION,
    QUAT,
    RATES,
    TIME,
    VELOCITY,
    battery_voltage,
    motor_thrusts,
    physics_step,
)
from quad_bridge.virtual.plant import Plant
from quad_bridge.virtual.rotation import euler_from_quaternion
from quad_bridge.virtual.sensors import (
    ATTITUDE,
    MAG,
    PRESSURE,
    Chips,
    complementary_filter,
    sample,
    sense_step,
)

FloatArray = npt.NDArray[np.float64]

NORMALS_PER_STEP = 9
NORMALS_PER_CYCLE = 7

COLUMNS: dict[str, slice] = {
    'time_s': slice(0, 1),
    'rates': slice(1, 4),
    'acceleration': slice(4, 7),
    'angles': slice(7, 10),
    'attitude_setpoint': slice(10, 13),
    'rate_setpoint': slice(13, 16),
    'wrench': slice(16, 20),
    'motors': slice(20, 24),
    'battery_v': slice(24, 25),
    'mag': slice(25, 28),
    'pressure_pa': slice(28, 29),
    'limits': slice(29, 30),
    'throttle': slice(30, 31),
    'true_rates': slice(31, 34),
    'true_angles': slice(34, 37),
    'altitude_m': slice(37, 38),
}
"""Columns of a log row, by name."""
WIDTH = 38
OBSERVED = 12


class Machine(NamedTuple):
    """The whole aircraft as the kernels see it: constants and (written in place) states."""

    plant: Plant
    chips: Chips
    controller: Controller
    state: FloatArray
    sensed: FloatArray
    memory: FloatArray
    acting: FloatArray
    """(4,) motor commands that act during the present cycle."""


@kernel
def begin(
    machine: Machine, cycle: int, given: FloatArray, normals: FloatArray, log: FloatArray
) -> None:
    """The firmware's part of a cycle; fills the log row and `acting`."""
    plant, chips, controller, state, sensed, memory, acting = machine
    gyro, accel, angles = log[1:4], log[4:7], log[7:10]
    sample(sensed, state, chips, normals, cycle, gyro, accel)
    complementary_filter(sensed, chips, gyro, accel, controller.cycle_s)
    angles[:] = sensed[ATTITUDE : ATTITUDE + 3]
    used = given.copy()
    hold = -controller.climb_kp * state[POSITION + 2] - controller.climb_kd * state[VELOCITY + 2]
    used[THROTTLE] = min(1.0, max(0.0, given[THROTTLE] + min(0.08, max(-0.08, hold))))
    out = Output(log[10:13], log[13:16], log[16:20], log[20:24])
    volts = battery_voltage(state, plant)
    log[29] = control_cycle(memory, controller, used, gyro, angles, volts, out)
    acting[:] = log[20:24]
    delayed(memory, controller, cycle, acting)
    log[0] = state[TIME]
    log[24] = battery_voltage(state, plant)
    log[25:28] = sensed[MAG : MAG + 3]
    log[28] = sensed[PRESSURE]
    log[30] = used[THROTTLE]
    log[31:34] = state[RATES : RATES + 3]
    euler_from_quaternion(state[QUAT : QUAT + 4], log[34:37])
    log[37] = state[POSITION + 2]


@kernel
def advance(machine: Machine, normals: FloatArray, extra: FloatArray) -> None:
    """One physics step and the chips' filters; `normals` (9,), `extra` (3,) N m."""
    physics_step(machine.state, machine.plant, machine.acting, normals[:3], extra)
    sense_step(machine.sensed, machine.state, machine.plant, machine.chips, normals[3:])


@kernel
def look(machine: Machine, seen: FloatArray) -> None:
    """Write (OBSERVED,): time, true rates (3), angles (3), thrusts (4), battery voltage."""
    state, plant = machine.state, machine.plant
    voltage = battery_voltage(state, plant)
    seen[0] = state[TIME]
    seen[1:4] = state[RATES : RATES + 3]
    euler_from_quaternion(state[QUAT : QUAT + 4], seen[4:7])
    motor_thrusts(state, plant, voltage, seen[7:11])
    seen[11] = voltage


def _entries(digest: str) -> tuple[Callable[..., None], ...]:
    """The compiled entry points; `digest` ties their cache to all kernel sources."""

    @entry
    def run_cycles(
        machine: Machine, first: int, given: FloatArray, normals: FloatArray, log: FloatArray
    ) -> None:
        _ = digest
        extra = np.zeros(3)
        steps = (normals.shape[1] - NORMALS_PER_CYCLE) // NORMALS_PER_STEP
        for row in range(given.shape[0]):
            begin(machine, first + row, given[row], normals[row], log[row])
            for step in range(steps):
                start = NORMALS_PER_CYCLE + step * NORMALS_PER_STEP
                advance(machine, normals[row, start : start + NORMALS_PER_STEP], extra)

    @entry
    def begin_cycle(
        machine: Machine, cycle: int, given: FloatArray, normals: FloatArray, log: FloatArray
    ) -> None:
        _ = digest
        begin(machine, cycle, given, normals, log)

    @entry
    def advance_step(machine: Machine, normals: FloatArray, extra: FloatArray) -> None:
        _ = digest
        advance(machine, normals, extra)

    @entry
    def observe(machine: Machine, seen: FloatArray) -> None:
        _ = digest
        look(machine, seen)

    return run_cycles, begin_cycle, advance_step, observe


run_cycles, begin_cycle, advance_step, observe = _entries(source_digest())
