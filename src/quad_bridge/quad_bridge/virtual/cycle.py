"""Compiled entry points: whole control cycles, or one in pieces.

A cycle is: read the sensors, let the firmware compute, put the commands into the delay queue, then
run the physics to the next cycle. The firmware is the C of firmware/, called from compiled code
(`run_cycles`, `begin_cycle`) or by whoever asks for the sensors and brings the commands
(`measure_cycle`, `move_cycle`). All ways run the same kernels in the same order.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import types

from quad_bridge.si import FloatArray
from quad_bridge.virtual.compiled import entry, kernel, source_digest
from quad_bridge.virtual.native import library
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
from quad_bridge.virtual.sensors import MAG, PRESSURE, SAMPLES, Chips, sense_cycle, sense_step

ARMED, INJECTION, ADDED = 0, 1, 2
STICK_ROLL, STICK_PITCH, THROTTLE, STICK_YAW, HOLD = 5, 6, 7, 8, 9
INPUTS = 10
"""Columns of what reaches a cycle from outside: armed 0/1, injection 0..4 (none, attitude, rate,
control, thrust), excitation (3), sticks -1..1, throttle 0..1, height mode 0/1."""
MAX_DELAY = 4  # cycles
MAX_HOLD = 0.08  # the most that the pilot adds to the throttle to hold the height, either way
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
    'position_m': slice(37, 40),
    'velocity_m_s': slice(40, 43),
    'height_m': slice(43, 44),
    'climb_m_s': slice(44, 45),
}
"""Columns of a log row, by name."""
WIDTH = 45
OUTPUTS = 25  # numbers that the firmware writes (boards/linux/library.c)
OBSERVED = 12


library()  # its symbols are there for what numba compiles
_number: Any = types.float64
_fly: Any = types.ExternalFunction(
    'quad_library_fly',
    _number(*[types.intp] * 3, _number, _number, *[types.intp] * 2, types.int64, types.intp),
)
"""The firmware's control cycle (boards/linux/library.c); arrays go as their addresses."""


class Machine(NamedTuple):
    """The whole aircraft as the kernels see it: constants and (written in place) states."""

    plant: Plant
    chips: Chips
    delay_cycles: int
    climb_kp: float  # pilot's altitude hold in hover: throttle per m; 0 on the rig
    climb_kd: float
    state: FloatArray
    sensed: FloatArray
    samples: FloatArray  # (n, 6) gyro and accelerometer, chip axes
    queue: FloatArray  # (MAX_DELAY + 1, 4) motor commands on their way
    acting: FloatArray  # (4,) motor commands that act during the present cycle
    firmware: npt.NDArray[np.uint8]  # the C firmware's memory
    gains: npt.NDArray[np.float32]
    """(n,) its parameters where it flies in compiled code, in the order of their index."""


@kernel
def pilot_throttle(machine: Machine, throttle: float) -> float:
    """The pilot's throttle, which adds to a trim what holds the height."""
    state = machine.state
    hold = -machine.climb_kp * state[POSITION + 2] - machine.climb_kd * state[VELOCITY + 2]
    return float(min(1.0, max(0.0, throttle + min(MAX_HOLD, max(-MAX_HOLD, hold)))))


@kernel
def delayed(machine: Machine, cycle: int, commands: FloatArray) -> None:
    """Put this cycle's commands in the queue; those that are due act."""
    rows = MAX_DELAY + 1
    for i in range(4):
        machine.queue[cycle % rows, i] = commands[i]
    for i in range(4):
        machine.acting[i] = machine.queue[(cycle - machine.delay_cycles) % rows, i]


@kernel
def begin(
    machine: Machine, cycle: int, inputs: FloatArray, normals: FloatArray, log: FloatArray
) -> None:
    """The firmware's part of a cycle; fills the log row and `acting`."""
    state, sensed = machine.state, machine.sensed
    sense_cycle(sensed, state, machine.chips, normals, cycle)
    used, outputs = np.empty(INPUTS), np.empty(OUTPUTS)
    for i in range(INPUTS):
        used[i] = inputs[i]
    if inputs[HOLD] < 0.5:
        used[THROTTLE] = pilot_throttle(machine, inputs[THROTTLE])
    volts = battery_voltage(state, machine.plant)
    log[29] = _fly(
        machine.firmware.ctypes.data, machine.gains.ctypes.data, used.ctypes.data, volts,
        sensed[PRESSURE], sensed[MAG : MAG + 3].ctypes.data, machine.samples.ctypes.data,
        int(sensed[SAMPLES]), outputs.ctypes.data,
    )  # fmt: skip
    for i in range(23):
        log[1 + i] = outputs[i]
    log[43] = outputs[23]
    log[44] = outputs[24]
    sensed[SAMPLES] = 0.0
    delayed(machine, cycle, log[20:24])
    log[0] = state[TIME]
    log[24] = volts
    for i in range(3):  # one by one: whole slices take numba seconds to compile
        log[25 + i] = sensed[MAG + i]
        log[31 + i] = state[RATES + i]
    log[28] = sensed[PRESSURE]
    log[30] = used[THROTTLE]
    euler_from_quaternion(state[QUAT : QUAT + 4], log[34:37])
    for i in range(3):
        log[37 + i] = state[POSITION + i]
        log[40 + i] = state[VELOCITY + i]


@kernel
def advance(machine: Machine, normals: FloatArray, extra: FloatArray) -> None:
    """One physics step and the chips' filters; `normals` (9,), `extra` (3,) N m."""
    physics_step(machine.state, machine.plant, machine.acting, normals[:3], extra)
    sense_step(
        machine.sensed, machine.samples, machine.state, machine.plant, machine.chips, normals[3:]
    )


@kernel
def look(machine: Machine, out: FloatArray) -> None:
    """Write (OBSERVED,): time, true rates (3), angles (3), thrusts (4), battery voltage."""
    state, plant = machine.state, machine.plant
    voltage = battery_voltage(state, plant)
    out[0] = state[TIME]
    for i in range(3):
        out[1 + i] = state[RATES + i]
    euler_from_quaternion(state[QUAT : QUAT + 4], out[4:7])
    motor_thrusts(state, plant, voltage, out[7:11])
    out[11] = voltage


def _entries(digest: str) -> tuple[Callable[..., None], ...]:
    """The compiled entry points; `digest` ties their cache to all kernel sources."""

    @entry
    def run_cycles(
        machine: Machine, first: int, inputs: FloatArray, normals: FloatArray, log: FloatArray
    ) -> None:
        _ = digest
        extra = np.zeros(3)
        steps = (normals.shape[1] - NORMALS_PER_CYCLE) // NORMALS_PER_STEP
        for row in range(inputs.shape[0]):
            begin(machine, first + row, inputs[row], normals[row], log[row])
            for step in range(steps):
                start = NORMALS_PER_CYCLE + step * NORMALS_PER_STEP
                advance(machine, normals[row, start : start + NORMALS_PER_STEP], extra)

    @entry
    def begin_cycle(
        machine: Machine, cycle: int, inputs: FloatArray, normals: FloatArray, log: FloatArray
    ) -> None:
        _ = digest
        begin(machine, cycle, inputs, normals, log)

    @entry
    def measure_cycle(
        machine: Machine, cycle: int, throttle: float, normals: FloatArray, out: FloatArray
    ) -> None:
        """Write (2,) the throttle that the pilot gives, the battery's voltage."""
        _ = digest
        sense_cycle(machine.sensed, machine.state, machine.chips, normals, cycle)
        out[0] = pilot_throttle(machine, throttle)
        out[1] = battery_voltage(machine.state, machine.plant)

    @entry
    def move_cycle(
        machine: Machine, cycle: int, commands: FloatArray, normals: FloatArray
    ) -> None:
        """Put the commands under way and run the physics as far as `normals` go."""
        _ = digest
        extra = np.zeros(3)
        machine.sensed[SAMPLES] = 0.0
        delayed(machine, cycle, commands)
        for start in range(0, normals.size, NORMALS_PER_STEP):
            advance(machine, normals[start : start + NORMALS_PER_STEP], extra)

    @entry
    def advance_step(machine: Machine, normals: FloatArray, extra: FloatArray) -> None:
        _ = digest
        advance(machine, normals, extra)

    @entry
    def observe(machine: Machine, out: FloatArray) -> None:
        _ = digest
        look(machine, out)

    return run_cycles, begin_cycle, measure_cycle, move_cycle, advance_step, observe


(run_cycles, begin_cycle, measure_cycle, move_cycle, advance_step, observe) = _entries(
    source_digest()
)
