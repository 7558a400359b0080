"""Compiled sensor models: what the chips report of the true state, and the attitude estimate.

MPU-6050: noise and bias enter before the 2nd-order Butterworth low-pass, which runs at the physics
step (the chip samples at 1 kHz); quantisation comes after it, at the sampling instant. The bias
that calibration at rest could not see drifts on. Complementary filter as in the paper.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from quad_bridge.virtual.airframe import GRAVITY_M_S2, Vector, require
from quad_bridge.virtual.compiled import kernel
from quad_bridge.virtual.effects import Vibration
from quad_bridge.virtual.physics import (
    POSITION,
    QUAT,
    RATES,
    TIME,
    VELOCITY,
    battery_voltage,
    motor_thrusts,
)
from quad_bridge.virtual.plant import Plant
from quad_bridge.virtual.rotation import body_from_world, wrapped

FloatArray = npt.NDArray[np.float64]

GYRO_LP, ACCEL_LP, BIAS, ATTITUDE = 0, 6, 12, 15
MAG, PRESSURE, ACCEL_NOW, GYRO_NOW = 18, 21, 22, 25
SENSOR_STATES = 28

GYRO_DEG_S_PER_LSB = 1.0 / 65.5
ACCEL_G_PER_LSB = 1.0 / 4096.0


@dataclass(frozen=True)
class Sensors:
    """Noise, bias and filters of the sensors."""

    gyro_filter_hz: float = 42.0
    accel_filter_hz: float = 42.0
    gyro_noise_rad_s_rthz: float = 6.0e-4
    """One-sided, motors running; the bare chip has 0.9e-4."""
    gyro_calibration_error_rad_s: float = 5.0e-4
    """Standard deviation of the bias that calibration at rest leaves."""
    gyro_drift_rad_s_rts: float = 5.0e-5
    """Random walk of the bias."""
    accel_noise_m_s2_rthz: float = 0.02
    accel_bias_m_s2: Vector = (0.02, -0.03, 0.05)
    complementary_time_s: float = 5.0
    mag_field_t: Vector = (0.0, 24.0e-6, -38.0e-6)
    """World ENU."""
    mag_noise_t: float = 3.0e-7
    pressure_pa: float = 101325.0
    pressure_noise_pa: float = 2.0
    slow_divider: int = 5
    """Magnetometer and barometer are read every so many cycles."""
    quantisation: bool = True

    def __post_init__(self) -> None:
        """Check bounds."""
        for name in ('gyro_filter_hz', 'accel_filter_hz'):
            value = getattr(self, name)
            require(1.0 <= value <= 400.0, f'{name} must lie in 1..400, is {value}')
        require(self.slow_divider >= 1, f'slow_divider must be at least 1: {self.slow_divider}')
        require(self.complementary_time_s > 0.1, 'complementary_time_s must be over 0.1')


class Chips(NamedTuple):
    """Constants for the kernels; low-pass rows are b0 b1 b2 a1 a2 at the physics step."""

    gyro_lp: FloatArray
    accel_lp: FloatArray
    gyro_sigma: float
    """Per physics step, rad/s."""
    accel_sigma: float
    drift_sigma: float
    """Per cycle, rad/s."""
    accel_bias: Vector
    blend: float
    """Share of the accelerometer's (compass') angle per cycle."""
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


def butterworth(cutoff_hz: float, step_s: float) -> FloatArray:
    """(5,) b0 b1 b2 a1 a2 of the 2nd-order Butterworth low-pass, bilinear.

    Not prewarped: its delay at low frequency is then exactly the continuous filter's.
    """
    k = math.pi * cutoff_hz * step_s
    norm = 1.0 / (1.0 + math.sqrt(2.0) * k + k * k)
    b0 = k * k * norm
    return np.array(
        [b0, 2 * b0, b0, 2 * (k * k - 1) * norm, (1 - math.sqrt(2.0) * k + k * k) * norm]
    )


def build_chips(
    sensors: Sensors, vibration: Vibration, *, step_s: float, cycle_s: float, phases: FloatArray
) -> Chips:
    """The kernels' constants; `phases` (rad) belong to the vibration lines."""
    lines = len(vibration.frequency_hz) if vibration.enabled else 0
    density = math.sqrt(0.5 / step_s)
    lsb = 1.0 if sensors.quantisation else 0.0
    return Chips(
        gyro_lp=butterworth(sensors.gyro_filter_hz, step_s),
        accel_lp=butterworth(sensors.accel_filter_hz, step_s),
        gyro_sigma=sensors.gyro_noise_rad_s_rthz * density,
        accel_sigma=sensors.accel_noise_m_s2_rthz * density,
        drift_sigma=sensors.gyro_drift_rad_s_rts * math.sqrt(cycle_s),
        accel_bias=sensors.accel_bias_m_s2,
        blend=cycle_s / sensors.complementary_time_s,
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


def initial_sensors(chips: Chips, bias: FloatArray) -> FloatArray:
    """Filters settled at rest and level, north at yaw 0; `bias` (3,) rad/s of the gyro."""
    state = np.zeros(SENSOR_STATES)
    resting = np.array([0.0, 0.0, GRAVITY_M_S2]) + np.array(chips.accel_bias)
    for base, row, value in ((GYRO_LP, chips.gyro_lp, bias), (ACCEL_LP, chips.accel_lp, resting)):
        state[base : base + 3] = value * (1.0 - row[0])
        state[base + 3 : base + 6] = value * (row[2] - row[4])
    state[BIAS : BIAS + 3] = bias
    state[GYRO_NOW : GYRO_NOW + 3] = bias
    state[ACCEL_NOW : ACCEL_NOW + 3] = resting
    state[MAG : MAG + 3] = chips.mag_field
    state[PRESSURE] = chips.pressure
    return state


@kernel
def low_pass(state: FloatArray, base: int, i: int, row: FloatArray, value: float) -> float:
    """One step of channel `i` of the filter at `base` (transposed direct form II)."""
    out = float(row[0] * value + state[base + i])
    state[base + i] = row[1] * value - row[3] * out + state[base + 3 + i]
    state[base + 3 + i] = row[2] * value - row[4] * out
    return out


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
    for i in range(3):
        drag[i] = -plant.linear_drag * state[VELOCITY + i]
    body_from_world(state[QUAT : QUAT + 4], drag, out)
    motor_thrusts(state, plant, battery_voltage(state, plant), thrusts)
    out[2] += (thrusts[0] + thrusts[1] + thrusts[2] + thrusts[3]) / plant.mass


@kernel
def sense_step(
    sensed: FloatArray, state: FloatArray, plant: Plant, chips: Chips, normals: FloatArray
) -> None:
    """The chip's own 1 kHz: filter rates and acceleration behind noise; `normals` (6,)."""
    force = np.empty(3)
    specific_force(state, plant, force)
    shake = 0.0
    for line in range(chips.line_rad_s.size):
        turn = chips.line_rad_s[line] * state[TIME] + chips.line_phase[line]
        shake += chips.line_size[line] * math.sin(turn)
    for i in range(3):
        rate = state[RATES + i] + sensed[BIAS + i] + chips.gyro_sigma * normals[i] + shake
        sensed[GYRO_NOW + i] = low_pass(sensed, GYRO_LP, i, chips.gyro_lp, rate)
        accel = force[i] + chips.accel_bias[i] + chips.accel_sigma * normals[3 + i]
        sensed[ACCEL_NOW + i] = low_pass(sensed, ACCEL_LP, i, chips.accel_lp, accel)


@kernel
def quantised(value: float, lsb: float) -> float:
    """`value` on the grid of a signed 16-bit reading with that step, clipped at its range."""
    if lsb == 0.0:
        return value
    return lsb * min(32767.0, max(-32768.0, math.floor(value / lsb + 0.5)))


@kernel
def sample(
    sensed: FloatArray,
    state: FloatArray,
    chips: Chips,
    normals: FloatArray,
    cycle: int,
    gyro: FloatArray,
    accel: FloatArray,
) -> None:
    """Read the chips at the start of a cycle; `normals` (7,): drift 3, compass 3, pressure."""
    for i in range(3):
        sensed[BIAS + i] += chips.drift_sigma * normals[i]
        gyro[i] = quantised(sensed[GYRO_NOW + i], chips.gyro_lsb)
        accel[i] = quantised(sensed[ACCEL_NOW + i], chips.accel_lsb)
    if cycle % chips.slow_divider == 0:
        north, field = np.empty(3), np.empty(3)
        for i in range(3):
            north[i] = chips.mag_field[i]
        body_from_world(state[QUAT : QUAT + 4], north, field)
        for i in range(3):
            sensed[MAG + i] = field[i] + chips.mag_sigma * normals[3 + i]
        above = chips.pressure * (1.0 - 2.25577e-5 * state[POSITION + 2]) ** 5.25588
        sensed[PRESSURE] = above + chips.pressure_sigma * normals[6]


@kernel
def complementary_filter(
    sensed: FloatArray, chips: Chips, gyro: FloatArray, accel: FloatArray, cycle_s: float
) -> None:
    """Advance the attitude estimate: gyro integrated, held by gravity and north."""
    roll, pitch, yaw = sensed[ATTITUDE], sensed[ATTITUDE + 1], sensed[ATTITUDE + 2]
    sr, cr, cp = math.sin(roll), math.cos(roll), max(0.1, math.cos(pitch))
    turn = (gyro[1] * sr + gyro[2] * cr) / cp
    roll += cycle_s * (gyro[0] + math.sin(pitch) * turn)
    pitch += cycle_s * (gyro[1] * cr - gyro[2] * sr)
    yaw += cycle_s * turn
    seen_roll = math.atan2(accel[1], accel[2])
    seen_pitch = math.atan2(-accel[0], math.sqrt(accel[1] ** 2 + accel[2] ** 2))
    roll += chips.blend * wrapped(seen_roll - roll)
    pitch += chips.blend * (seen_pitch - pitch)
    sr, cr, sp, cp = math.sin(roll), math.cos(roll), math.sin(pitch), math.cos(pitch)
    level_x = sensed[MAG] * cp + (sensed[MAG + 1] * sr + sensed[MAG + 2] * cr) * sp
    level_y = sensed[MAG + 1] * cr - sensed[MAG + 2] * sr
    seen_yaw = math.atan2(chips.mag_field[1], chips.mag_field[0]) - math.atan2(level_y, level_x)
    yaw += chips.blend * wrapped(seen_yaw - yaw)
    sensed[ATTITUDE] = roll
    sensed[ATTITUDE + 1] = pitch
    sensed[ATTITUDE + 2] = wrapped(yaw)
