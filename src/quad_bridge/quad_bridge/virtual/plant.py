"""Airframe, mount and effects -> the flat tuple of numbers that the compiled physics takes.

An effect that is off becomes the number with which its term vanishes exactly. No dynamics here.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from quad_bridge.virtual.airframe import GRAVITY_M_S2, Airframe, Surroundings
from quad_bridge.virtual.effects import Effects

FloatArray = npt.NDArray[np.float64]
Triple = tuple[float, float, float]
Quad = tuple[float, float, float, float]

AXES = ('roll', 'pitch', 'yaw')

MIXER: FloatArray = np.array(
    [[1.0, 1, 1, 1], [1.0, -1, 1, -1], [1.0, -1, -1, 1], [1.0, 1, -1, -1]]
)
"""(4, 4) m1..m4 from U1..U4 (contract, eq. (7) transposed)."""
MIXER.setflags(write=False)


class Plant(NamedTuple):
    """Constants of the dynamics; threes are per axis, fours per motor. SI.

    Tuples and not arrays: kernels hand them on without counting references.
    """

    step_s: float
    free_axes: Triple
    moves: float  # 1 in hover, 0 on the rig (no translation)
    mass: float
    inertia: Triple
    torque_map: tuple[Quad, Quad, Quad]  # (3, 4) torque per thrust of each motor, m
    full_thrust: float
    lag: Quad
    linear_drag: float
    damping: Triple  # n m s/rad
    bias_torque: Triple
    noise: Triple  # n m/sqrt(Hz), one-sided
    noise_bandwidth_hz: float
    charge_points: tuple[float, ...]
    pack_voltage: tuple[float, ...]
    resistance: float
    capacity_as: float
    full_current: float
    idle_current: float
    full_speed: float
    rotor_inertia: float
    curvature: float
    sag_exponent: float
    sag_reference_v: float
    dry_low: Triple  # friction at speed, N m
    dry_extra: Triple  # what static friction adds to it, N m
    dry_speed: float
    quadratic_drag: Triple
    pendulum: Triple
    cubic: Triple
    springs: bool  # whether a torque depends on the angle
    dead_zone: Triple
    play: Triple
    motor_lower: float
    motor_upper: float
    gyro_scale: float
    gyro_momentum: float
    euler_term: float
    cross: tuple[Triple, Triple, Triple]
    """(3, 3) share of the drive of axis j that acts on axis i as well, N m per N m."""
    mode_peak: Triple
    mode_rad_s: float
    mode_damping: float
    periodic_torque: Triple
    periodic: bool
    periodic_rad_s: float
    periodic_phase: float
    event_time_s: float
    event_gain: Triple
    event_torque: Triple


def torque_map(airframe: Airframe) -> FloatArray:
    """(3, 4) body torque per thrust of each motor, m: eq. (7), lever l sqrt(2)/2, yaw reaction."""
    lever = airframe.arm_m * math.sqrt(2.0) / 2.0
    levers = np.array([lever, lever, airframe.motors.torque_per_thrust_m])
    return np.ascontiguousarray(MIXER.T[1:] * levers[:, None])


def axis_gains(airframe: Airframe) -> FloatArray:
    """(3,) acceleration per unit of U2..U4 of the linear aircraft, rad/s²."""
    torque = np.abs(torque_map(airframe)).sum(axis=1) * airframe.motors.full_thrust_n
    return np.asarray(torque / np.array(airframe.inertia_kg_m2))


def build_plant(
    airframe: Airframe, effects: Effects, *, mount: str, axis: str, step_s: float, phase: float
) -> Plant:
    """The constants of one aircraft on one mount; `phase` (rad) of the periodic disturbance."""
    around = airframe.mounts.rig if mount == 'rig' else airframe.mounts.hover
    free = np.ones(3) if mount == 'hover' else np.eye(3)[AXES.index(axis)]
    inertia = np.array(airframe.inertia_kg_m2)
    values: dict[str, object] = {
        'step_s': step_s,
        'free_axes': free,
        'moves': 1.0 if mount == 'hover' else 0.0,
        'mass': airframe.mass_kg,
        'inertia': inertia,
        'torque_map': torque_map(airframe),
        'linear_drag': airframe.linear_drag_per_s,
        **_around(around, inertia),
        **_motors_and_battery(airframe, effects),
        **_resistances(effects),
        **_couplings(airframe, effects),
        **_time_dependent(effects, phase),
    }
    fields: dict[str, Any] = {name: _frozen(value) for name, value in values.items()}
    return Plant(**fields)


def _frozen(value: object) -> object:
    """Arrays as nested tuples, anything else as it is."""
    if not isinstance(value, np.ndarray):
        return value
    rows = value.tolist()
    return tuple(tuple(row) if isinstance(row, list) else row for row in rows)


def _strength(on: bool, values: tuple[float, float, float]) -> FloatArray:
    """The values of an effect that is on, zeros where it is off."""
    return np.array(values) if on else np.zeros(3)


def _around(around: Surroundings, inertia: FloatArray) -> dict[str, object]:
    return {
        'damping': np.array(around.damping_per_s) * inertia,
        'bias_torque': np.array(around.bias_torque_nm),
        'noise': np.array(around.torque_noise_nm_rthz),
        'noise_bandwidth_hz': around.torque_noise_bandwidth_hz,
    }


def _motors_and_battery(airframe: Airframe, effects: Effects) -> dict[str, object]:
    motors, battery = airframe.motors, airframe.battery
    lag = np.full(4, motors.lag_s)
    if effects.motor_lag.enabled:
        lag[[m - 1 for m in effects.motor_lag.motors]] = effects.motor_lag.slow_time_constant_s
    limited = effects.saturation.enabled
    return {
        'full_thrust': motors.full_thrust_n,
        'lag': lag,
        'full_speed': motors.full_speed_rad_s,
        'rotor_inertia': motors.rotor_inertia_kg_m2,
        'full_current': motors.full_current_a,
        'motor_lower': effects.saturation.lower if limited else 0.0,
        'motor_upper': effects.saturation.upper if limited else 1.0,
        'charge_points': np.array(battery.charge_points),
        'pack_voltage': np.array(battery.cell_voltage_v) * battery.cells,
        'resistance': battery.resistance_ohm,
        'capacity_as': battery.capacity_ah * 3600.0,
        'idle_current': battery.idle_current_a,
        'curvature': effects.thrust_curve.curvature if effects.thrust_curve.enabled else 0.0,
        'sag_exponent': effects.battery_sag.exponent if effects.battery_sag.enabled else 0.0,
        'sag_reference_v': effects.battery_sag.reference_v,
    }


def _resistances(effects: Effects) -> dict[str, object]:
    stribeck = effects.stribeck
    low = _strength(stribeck.enabled, stribeck.coulomb_nm)
    return {
        'dry_low': low
        + _strength(effects.coulomb_friction.enabled, effects.coulomb_friction.torque_nm),
        'dry_extra': _strength(stribeck.enabled, stribeck.static_nm) - low,
        'dry_speed': stribeck.speed_rad_s,
        'quadratic_drag': _strength(
            effects.quadratic_drag.enabled, effects.quadratic_drag.coefficient_nm_s2
        ),
        'springs': effects.pendulum_stiffness.enabled or effects.cubic_stiffness.enabled,
        'pendulum': _strength(
            effects.pendulum_stiffness.enabled, effects.pendulum_stiffness.stiffness_nm_rad
        ),
        'cubic': _strength(
            effects.cubic_stiffness.enabled, effects.cubic_stiffness.stiffness_nm_rad3
        ),
    }


def _couplings(airframe: Airframe, effects: Effects) -> dict[str, object]:
    cross = np.zeros((3, 3))
    if effects.cross_axis_input.enabled:
        gain = axis_gains(airframe) * np.array(airframe.inertia_kg_m2)
        to, source = (
            AXES.index(effects.cross_axis_input.to_axis),
            AXES.index(effects.cross_axis_input.from_axis),
        )
        cross[to, source] = effects.cross_axis_input.fraction * gain[to] / gain[source]
    gyro = effects.gyroscopic_coupling
    return {
        'gyro_scale': gyro.rotor_scale if gyro.enabled else 0.0,
        'gyro_momentum': gyro.extra_momentum_nm_s if gyro.enabled else 0.0,
        'euler_term': 1.0 if effects.inertia_coupling.enabled else 0.0,
        'cross': cross,
        'dead_zone': _strength(effects.dead_zone.enabled, effects.dead_zone.half_width),
        'play': _strength(effects.backlash.enabled, effects.backlash.half_width),
        'mode_peak': _strength(effects.resonance.enabled, effects.resonance.peak),
        'mode_rad_s': 2.0 * math.pi * effects.resonance.frequency_hz,
        'mode_damping': effects.resonance.damping_ratio,
    }


def _time_dependent(effects: Effects, phase: float) -> dict[str, object]:
    periodic, event = effects.periodic_disturbance, effects.step_event
    return {
        'periodic_torque': _strength(periodic.enabled, periodic.amplitude_nm),
        'periodic': periodic.enabled,
        'periodic_rad_s': 2.0 * math.pi * periodic.frequency_hz,
        'periodic_phase': phase,
        'event_time_s': event.time_s,
        'event_gain': _strength(event.enabled, event.gain_change),
        'event_torque': _strength(event.enabled, event.torque_nm),
    }


def hover_throttle(airframe: Airframe, plant: Plant) -> float:
    """The throttle (0..1) whose thrust carries the weight at the battery's first voltage."""
    voltage = float(
        np.interp(airframe.battery.start_charge, plant.charge_points, plant.pack_voltage)
    )
    scale = float((voltage / plant.sag_reference_v) ** plant.sag_exponent)
    wanted = airframe.mass_kg * GRAVITY_M_S2 / (4.0 * plant.full_thrust * scale)
    c = plant.curvature
    if abs(c) < 1e-9:
        return min(1.0, wanted)
    return min(1.0, (-(1 - c) + math.sqrt((1 - c) ** 2 + 4 * c * wanted)) / (2 * c))
