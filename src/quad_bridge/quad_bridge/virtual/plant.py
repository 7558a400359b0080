"""Airframe, mount and effects -> the flat tuple of numbers that the compiled physics takes.

An effect that is off becomes the number with which its term vanishes exactly. No dynamics here.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from quad_bridge.craft import X
from quad_bridge.gains.table import AXES
from quad_bridge.si import GRAVITY_M_S2, FloatArray
from quad_bridge.virtual.airframe import Airframe
from quad_bridge.virtual.effects import CrossAxisInput, Effects

Triple = tuple[float, float, float]
Quad = tuple[float, float, float, float]


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
    air_drag: Triple  # along the body's axes, N s²/m²
    rotor_drag: float  # for a rotor at full speed, N s/m
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
    ground: bool
    ground_m: float
    rotor_radius: float
    rotor_height: float


def torque_map(airframe: Airframe) -> FloatArray:
    """(3, 4) body torque per thrust of each motor, m: eq. (7), lever l sqrt(2)/2, yaw reaction."""
    lever = airframe.arm_m * math.sqrt(2.0) / 2.0
    levers = np.array([lever, lever, airframe.motors.torque_per_thrust_m])
    return np.ascontiguousarray(X.mixer.T[1:] * levers[:, None])


def axis_gains(airframe: Airframe) -> FloatArray:
    """(3,) acceleration per unit of U2..U4 of the linear aircraft, rad/s²."""
    torque = np.abs(torque_map(airframe)).sum(axis=1) * airframe.motors.full_thrust_n
    return np.asarray(torque / np.array(airframe.inertia_kg_m2))


STRENGTHS = {
    'quadratic_drag': ('quadratic_drag', 'coefficient_nm_s2'),
    'pendulum': ('pendulum_stiffness', 'stiffness_nm_rad'),
    'cubic': ('cubic_stiffness', 'stiffness_nm_rad3'),
    'dead_zone': ('dead_zone', 'half_width'),
    'play': ('backlash', 'half_width'),
    'mode_peak': ('resonance', 'peak'),
    'periodic_torque': ('periodic_disturbance', 'amplitude_nm'),
    'event_gain': ('step_event', 'gain_change'),
    'event_torque': ('step_event', 'torque_nm'),
    'air_drag': ('air_drag', 'coefficient_n_s2_m2'),
    'rotor_drag': ('rotor_drag', 'coefficient_n_s_m'),
}
"""Constant of the plant to the effect and its field that it is where the effect is on; else 0."""


def build_plant(
    airframe: Airframe, effects: Effects, *, mount: str, axis: str, step_s: float, phase: float
) -> Plant:
    """The constants of one aircraft on one mount; `phase` (rad) of the periodic disturbance."""
    hovers, inertia = mount == 'hover', np.array(airframe.inertia_kg_m2)
    support = airframe.mounts.hover if hovers else airframe.mounts.rig
    motors, battery = airframe.motors, airframe.battery
    lag, limits, gyro = effects.motor_lag, effects.saturation, effects.gyroscopic_coupling
    lags = np.full(4, motors.lag_s)
    if lag.enabled:
        lags[[m - 1 for m in lag.motors]] = lag.slow_time_constant_s
    stribeck, coulomb = effects.stribeck, effects.coulomb_friction
    sliding = stribeck.enabled * np.array(stribeck.coulomb_nm)
    values: dict[str, Any] = {
        'step_s': step_s,
        'free_axes': np.ones(3) if hovers else np.eye(3)[AXES.index(axis)],
        'moves': float(hovers),
        'mass': airframe.mass_kg,
        'inertia': inertia,
        'torque_map': torque_map(airframe),
        'full_thrust': motors.full_thrust_n,
        'lag': lags,
        'linear_drag': airframe.linear_drag_per_s,
        'damping': np.array(support.damping_per_s) * inertia,
        'bias_torque': support.bias_torque_nm,
        'noise': support.torque_noise_nm_rthz,
        'noise_bandwidth_hz': support.torque_noise_bandwidth_hz,
        'charge_points': battery.charge_points,
        'pack_voltage': np.array(battery.cell_voltage_v) * battery.cells,
        'resistance': battery.resistance_ohm,
        'capacity_as': battery.capacity_ah * 3600.0,
        'full_current': motors.full_current_a,
        'idle_current': battery.idle_current_a,
        'full_speed': motors.full_speed_rad_s,
        'rotor_inertia': motors.rotor_inertia_kg_m2,
        'curvature': effects.thrust_curve.enabled * effects.thrust_curve.curvature,
        'sag_exponent': effects.battery_sag.enabled * effects.battery_sag.exponent,
        'sag_reference_v': effects.battery_sag.reference_v,
        'dry_low': sliding + coulomb.enabled * np.array(coulomb.torque_nm),
        'dry_extra': stribeck.enabled * np.array(stribeck.static_nm) - sliding,
        'dry_speed': stribeck.speed_rad_s,
        'springs': effects.pendulum_stiffness.enabled or effects.cubic_stiffness.enabled,
        'motor_lower': limits.lower if limits.enabled else 0.0,
        'motor_upper': limits.upper if limits.enabled else 1.0,
        'gyro_scale': gyro.enabled * gyro.rotor_scale,
        'gyro_momentum': gyro.enabled * gyro.extra_momentum_nm_s,
        'euler_term': float(effects.inertia_coupling.enabled),
        'cross': _cross(airframe, effects.cross_axis_input),
        'mode_rad_s': 2.0 * math.pi * effects.resonance.frequency_hz,
        'mode_damping': effects.resonance.damping_ratio,
        'periodic': effects.periodic_disturbance.enabled,
        'periodic_rad_s': 2.0 * math.pi * effects.periodic_disturbance.frequency_hz,
        'periodic_phase': phase,
        'event_time_s': effects.step_event.time_s,
        'ground': hovers and effects.ground.enabled,
        'ground_m': effects.ground.height_m,
        'rotor_radius': effects.ground.rotor_radius_m,
        'rotor_height': effects.ground.rotor_height_m,
    }
    for name, (effect, strength) in STRENGTHS.items():
        planted = getattr(effects, effect)
        values[name] = planted.enabled * np.array(getattr(planted, strength))
    return Plant(**{name: _frozen(value) for name, value in values.items()})


def _frozen(value: Any) -> Any:
    """Arrays as nested tuples, anything else as it is."""
    if not isinstance(value, np.ndarray | np.generic):
        return value
    if not value.ndim:
        return value.item()
    return tuple(tuple(row) if isinstance(row, list) else row for row in value.tolist())


def _cross(airframe: Airframe, coupling: CrossAxisInput) -> FloatArray:
    """(3, 3) share of the drive of axis j that acts on axis i as well."""
    cross, gain = np.zeros((3, 3)), axis_gains(airframe) * np.array(airframe.inertia_kg_m2)
    to, source = AXES.index(coupling.to_axis), AXES.index(coupling.from_axis)
    cross[to, source] = coupling.enabled * coupling.fraction * gain[to] / gain[source]
    return cross


def hover_throttle(airframe: Airframe, plant: Plant) -> float:
    """The throttle (0..1) whose thrust carries the weight at the battery's first voltage."""
    voltage = float(
        np.interp(airframe.battery.start_charge, plant.charge_points, plant.pack_voltage)
    )
    scale = float((voltage / plant.sag_reference_v) ** plant.sag_exponent)
    hover = airframe.mass_kg * GRAVITY_M_S2 / (4.0 * plant.full_thrust * scale)
    c = plant.curvature
    if abs(c) < 1e-9:
        return min(1.0, hover)
    return min(1.0, (-(1 - c) + math.sqrt((1 - c) ** 2 + 4 * c * hover)) / (2 * c))
