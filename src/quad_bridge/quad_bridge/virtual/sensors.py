"""Compiled sensor models: what the chips report of the true state.

MPU-6050: it samples at 1 kHz, here at every physics step, with noise, bias and quantisation; the
low-pass filters and the attitude estimate are the firmware's. The bias that calibration at rest
could not see drifts on. Chip axes are the body's, FLU.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from quad_bridge.si import GRAVITY_M_S2, FloatArray
from quad_bridge.virtual.airframe import Vector, require
from quad_bridge.virtual.compiled import kernel
from quad_bridge.virtual.effects import Vibration
from quad_bridge.virtual.physics import (
    POSITION,
    QUAT,
    RATES,
    TIME,
    air_force,
    battery_voltage,
    motor_thrusts,
    stands,
)
from quad_bridge.virtual.plant import Plant
from quad_bridge.virtual.rotation import body_from_world

BIAS, MAG, PRESSURE, SAMPLES = 0, 3, 6, 7
"""`SAMPLES`: samples of gyro and accelerometer since the last cycle."""
SENSOR_STATES = 8

GYRO_DEG_S_PER_LSB = 1.0 / 65.5
ACCEL_G_PER_LSB = 1.0 / 4096.0


@dataclass(frozen=True)
class Sensors:
    """Noise, bias and filters of the sensors."""

    gyro_filter_hz: float = 42.0
    accel_filter_hz: float = 42.0
    gyro_noise_rad_s_rthz: float = 6.0e-4  # one-sided, motors running; the bare chip has 0.9e-4
    gyro_calibration_error_rad_s: float = 5.0e-4
    """Standard deviation of the bias that calibration at rest leaves."""
    gyro_drift_rad_s_rts: float = 5.0e-5  # random walk of the bias
    accel_noise_m_s2_rthz: float = 0.02
    accel_bias_m_s2: Vector = (0.02, -0.03, 0.05)
    complementary_time_s: float = 5.0
    mag_field_t: Vector = (0.0, 24.0e-6, -38.0e-6)  # world ENU
    mag_noise_t: float = 3.0e-7
    pressure_pa: float = 101325.0
    pressure_noise_pa: float = 2.0
    battery_divider: float = 11.0  # ratio of the divider in front of the board's pin
    slow_divider: int = 5  # magnetometer and barometer are read every so many cycles
    quantisation: bool = True

    def __post_init__(self) -> None:
        """Check bounds."""
        for name in ('gyro_filter_hz', 'accel_filter_hz'):
            value = getattr(self, name)
            require(1.0 <= value <= 400.0, f'{name} must lie in 1..400, is {value}')
        require(self.slow_divider >= 1, f'slow_divider must be at least 1: {self.slow_divider}')
        require(self.complementary_time_s > 0.1, 'complementary_time_s must be over 0.1')


class Chips(NamedTuple):
    """Constants for the kernels."""

    gyro_sigma: float  # per physics step, rad/s
    accel_sigma: float
    drift_sigma: float  # per cycle, rad/s
    accel_bias: Vector
    mag_field: Vector
    mag_sigma: float
    pressure: float
    pressure_sigma: float
    slow_divider: int
    gyro_lsb: float
    accel_lsb: float
    line_rad_s: FloatArray
    line_size: FloatArray
    line_phase: FloatArray


def build_chips(
    sensors: Sensors, vibration: Vibration, *, step_s: float, cycle_s: float, phases: FloatArray
) -> Chips:
    """The kernels' constants; `phases` (rad) belong to the vibration lines."""
    lines = len(vibration.frequency_hz) if vibration.enabled else 0
    density = math.sqrt(0.5 / step_s)
    lsb = 1.0 if sensors.quantisation else 0.0
    return Chips(
        gyro_sigma=sensors.gyro_noise_rad_s_rthz * density,
        accel_sigma=sensors.accel_noise_m_s2_rthz * density,
        drift_sigma=sensors.gyro_drift_rad_s_rts * math.sqrt(cycle_s),
        accel_bias=sensors.accel_bias_m_s2,
        mag_field=sensors.mag_field_t,
        mag_sigma=sensors.mag_noise_t,
        pressure=sensors.pressure_pa,
        pressure_sigma=sensors.pressure_noise_pa,
        slow_divider=sensors.slow_divider,
        gyro_lsb=lsb * math.radians(GYRO_DEG_S_PER_LSB),
        accel_lsb=lsb * GRAVITY_M_S2 * ACCEL_G_PER_LSB,
        line_rad_s=2.0 * math.pi * np.array(vibration.frequency_hz[:lines], dtype=float),
        line_size=np.array(vibration.amplitude_rad_s[:lines], dtype=float),
        line_phase=np.asarray(phases[:lines], dtype=float),
    )


def initial_sensors(
    chips: Chips, bias: FloatArray, samples_per_cycle: int
) -> tuple[FloatArray, FloatArray]:
    """State and samples (n, 6) of sensors at rest and level, with one sample.

    `bias` (3,) rad/s of the gyro.
    """
    state, samples = np.zeros(SENSOR_STATES), np.zeros((samples_per_cycle, 6))
    state[BIAS : BIAS + 3] = bias
    state[MAG : MAG + 3] = chips.mag_field
    state[PRESSURE] = chips.pressure
    state[SAMPLES] = 1.0
    samples[0, :3] = bias
    samples[0, 3:] = np.array([0.0, 0.0, GRAVITY_M_S2]) + np.array(chips.accel_bias)
    return state, samples


@kernel
def specific_force(state: FloatArray, plant: Plant, out: FloatArray) -> None:
    """Write what an ideal accelerometer at the centre of mass feels (3,), m/s², body axes."""
    thrusts, drag = np.empty(4), np.empty(3)
    if plant.moves == 0.0:
        drag[0] = 0.0
        drag[1] = 0.0
        drag[2] = GRAVITY_M_S2
        body_from_world(state[QUAT : QUAT + 4], drag, out)
        return
    motor_thrusts(state, plant, battery_voltage(state, plant), thrusts)
    air_force(state, plant, thrusts, out)
    if stands(state, plant):
        out[2] = max(out[2], GRAVITY_M_S2)


@kernel
def quantised(value: float, lsb: float) -> float:
    """`value` on the grid of a signed 16-bit reading with that step, clipped at its range."""
    if lsb == 0.0:
        return value
    return lsb * min(32767.0, max(-32768.0, math.floor(value / lsb + 0.5)))


@kernel
def sense_step(
    sensed: FloatArray, samples: FloatArray, state: FloatArray, plant: Plant, chips: Chips,
    normals: FloatArray,
) -> None:  # fmt: skip
    """The chip's own 1 kHz: one more sample of rates and specific force; `normals` (6,)."""
    force = np.empty(3)
    specific_force(state, plant, force)
    shake = 0.0
    for line in range(chips.line_rad_s.size):
        turn = chips.line_rad_s[line] * state[TIME] + chips.line_phase[line]
        shake += chips.line_size[line] * math.sin(turn)
    row = int(sensed[SAMPLES])
    for i in range(3):
        rate = state[RATES + i] + sensed[BIAS + i] + chips.gyro_sigma * normals[i] + shake
        samples[row, i] = quantised(rate, chips.gyro_lsb)
        accel = force[i] + chips.accel_bias[i] + chips.accel_sigma * normals[3 + i]
        samples[row, 3 + i] = quantised(accel, chips.accel_lsb)
    sensed[SAMPLES] = row + 1.0


@kernel
def sense_cycle(
    sensed: FloatArray, state: FloatArray, chips: Chips, normals: FloatArray, cycle: int
) -> None:
    """Update the readings that change once a cycle; `normals` (7,): drift 3, compass 3, pressure.

    The first readings of all are those of a calibration at rest, without noise.
    """
    for i in range(3):
        sensed[BIAS + i] += chips.drift_sigma * normals[i]
    if cycle > 0 and cycle % chips.slow_divider == 0:
        north, field = np.empty(3), np.empty(3)
        for i in range(3):
            north[i] = chips.mag_field[i]
        body_from_world(state[QUAT : QUAT + 4], north, field)
        for i in range(3):
            sensed[MAG + i] = field[i] + chips.mag_sigma * normals[3 + i]
        above = chips.pressure * (1.0 - 2.25577e-5 * state[POSITION + 2]) ** 5.25588
        sensed[PRESSURE] = above + chips.pressure_sigma * normals[6]
