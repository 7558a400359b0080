"""Compiled dynamics of the aircraft: one RK4 step of the state under four motor commands.

Equations (1) to (8) of the paper in quaternion form, with the corrections that the paper needs:
lever l sqrt(2)/2, yaw by the rotors' reaction torques, Omega = -w1 + w2 - w3 + w4 positive for
spin vectors that point up (1 and 3 turn clockwise), gyroscopic torque -(J Omega) q about roll and
+(J Omega) p about pitch. Body FLU, world ENU, SI. Constants come as a `Plant`; no sensors here.
Dry friction acts as an impulse after each step (it can hold the axis still, and never reverses
it), so does the ground; everything else goes through RK4.
"""

from __future__ import annotations

import math

import numpy as np

from quad_bridge.si import GRAVITY_M_S2, FloatArray
from quad_bridge.virtual.compiled import kernel
from quad_bridge.virtual.plant import Plant
from quad_bridge.virtual.rotation import (
    body_from_world,
    euler_from_quaternion,
    quaternion_rate,
    world_from_body,
)

RATES, QUAT, ROTORS, MODE, POSITION, VELOCITY = 0, 3, 7, 11, 17, 20
RK_STATES = 23
"""States that RK4 integrates; behind them stand charge drawn (A s), play (3), gust (3), time."""
CHARGE, PLAY, GUST, TIME = 23, 24, 27, 30
STATES = 31


def initial_state(start_charge: float, capacity_as: float, throttle: float) -> FloatArray:
    """State at rest and level, with the rotors at `throttle` (0..1)."""
    state = np.zeros(STATES)
    state[QUAT] = 1.0
    state[ROTORS : ROTORS + 4] = throttle
    state[CHARGE] = (1.0 - start_charge) * capacity_as
    return state


@kernel
def pack_current(state: FloatArray, plant: Plant) -> float:
    """Pack current in A: it follows thrust^1.5 (power)."""
    current = plant.idle_current
    for i in range(4):
        n = max(0.0, float(state[ROTORS + i]))
        current += plant.full_current * n * math.sqrt(n)
    return current


@kernel
def battery_voltage(state: FloatArray, plant: Plant) -> float:
    """Pack voltage in V under the present load, never below 0.

    The open-circuit voltage is linear between points.
    """
    charge = max(0.0, 1.0 - float(state[CHARGE]) / plant.capacity_as)
    points, volts = plant.charge_points, plant.pack_voltage
    i = 1
    while i < len(points) - 1 and charge > points[i]:
        i += 1
    share = (charge - points[i - 1]) / (points[i] - points[i - 1])
    open_circuit = volts[i - 1] + share * (volts[i] - volts[i - 1])
    return max(0.0, open_circuit - plant.resistance * pack_current(state, plant))


@kernel
def motor_thrusts(state: FloatArray, plant: Plant, voltage: float, thrusts: FloatArray) -> None:
    """Write the four thrusts in N."""
    scale = plant.full_thrust
    if plant.sag_exponent != 0.0:
        scale *= (voltage / plant.sag_reference_v) ** plant.sag_exponent
    if plant.ground:
        above = plant.rotor_height + max(0.0, state[POSITION + 2] - plant.ground_m)
        scale /= 1.0 - (0.25 * plant.rotor_radius / above) ** 2
    c = plant.curvature
    for i in range(4):
        n = state[ROTORS + i]
        thrusts[i] = scale * ((1.0 - c) * n + c * n * n)


@kernel
def limited_command(motors: FloatArray, state: FloatArray, plant: Plant, out: FloatArray) -> None:
    """Write what the rotors follow (4,): the commands behind play, dead zone and own limits."""
    u = np.empty(4)
    u[0] = 0.25 * (motors[0] + motors[1] + motors[2] + motors[3])
    u[1] = 0.25 * (motors[0] - motors[1] - motors[2] + motors[3])
    u[2] = 0.25 * (motors[0] + motors[1] - motors[2] - motors[3])
    u[3] = 0.25 * (motors[0] - motors[1] + motors[2] - motors[3])
    for axis in range(3):
        value = u[axis + 1]
        play = plant.play[axis]
        if play > 0.0:
            value = min(max(state[PLAY + axis], value - play), value + play)
        state[PLAY + axis] = value
        dead = plant.dead_zone[axis]
        if dead > 0.0:
            value = max(0.0, value - dead) + min(0.0, value + dead)
        u[axis + 1] = value
    out[0] = u[0] + u[1] + u[2] + u[3]
    out[1] = u[0] - u[1] + u[2] - u[3]
    out[2] = u[0] - u[1] - u[2] + u[3]
    out[3] = u[0] + u[1] - u[2] - u[3]
    for i in range(4):
        out[i] = min(max(out[i], plant.motor_lower), plant.motor_upper)


@kernel
def drive_torque(thrusts: FloatArray, plant: Plant, time_s: float, drive: FloatArray) -> None:
    """Write the body torque (3,) of the rotors in N m, cross-axis share and event included."""
    torque = np.empty(3)
    for i in range(3):
        total = 0.0
        for j in range(4):
            total += plant.torque_map[i][j] * thrusts[j]
        if time_s >= plant.event_time_s:
            total *= 1.0 + plant.event_gain[i]
        torque[i] = total
    for i in range(3):
        drive[i] = torque[i]
        for j in range(3):
            drive[i] += plant.cross[i][j] * torque[j]


@kernel
def body_torque(state: FloatArray, plant: Plant, time_s: float, torque: FloatArray) -> None:
    """Add to `torque` (3,) what the body's own motion causes: drag, springs, gyroscopic terms."""
    p, q, r = state[RATES], state[RATES + 1], state[RATES + 2]
    angles = np.zeros(3)
    if plant.springs:
        euler_from_quaternion(state[QUAT : QUAT + 4], angles)
    spin = plant.gyro_momentum
    if plant.gyro_scale != 0.0:
        for i in range(4):
            direction = -1.0 if i % 2 == 0 else 1.0
            speed = plant.full_speed * math.sqrt(max(0.0, state[ROTORS + i]))
            spin += plant.gyro_scale * plant.rotor_inertia * direction * speed
    ix, iy, iz = plant.inertia[0], plant.inertia[1], plant.inertia[2]
    torque[0] += -spin * q + plant.euler_term * (iy - iz) * q * r
    torque[1] += spin * p + plant.euler_term * (iz - ix) * p * r
    torque[2] += plant.euler_term * (ix - iy) * p * q
    swing = 0.0
    if plant.periodic:
        swing = math.sin(plant.periodic_rad_s * time_s + plant.periodic_phase)
    for i in range(3):
        rate, angle = state[RATES + i], angles[i]
        torque[i] -= plant.damping[i] * rate + plant.quadratic_drag[i] * rate * abs(rate)
        if plant.springs:
            torque[i] -= plant.pendulum[i] * math.sin(angle) + plant.cubic[i] * angle**3
        torque[i] += plant.bias_torque[i] + plant.periodic_torque[i] * swing
        if time_s >= plant.event_time_s:
            torque[i] += plant.event_torque[i]


@kernel
def air_force(state: FloatArray, plant: Plant, thrusts: FloatArray, out: FloatArray) -> None:
    """Write all but the weight (3,) over the mass, m/s², body axes: thrust and drags."""
    lift, turning, speed = 0.0, 0.0, np.empty(3)
    for i in range(4):
        lift += thrusts[i]
        turning += math.sqrt(max(0.0, float(state[ROTORS + i])))
    body_from_world(state[QUAT : QUAT + 4], state[VELOCITY : VELOCITY + 3], speed)
    for i in range(3):
        blades = plant.rotor_drag * turning if i < 2 else 0.0
        force = blades * speed[i] + plant.air_drag[i] * speed[i] * abs(speed[i])
        out[i] = -plant.linear_drag * speed[i] - force / plant.mass
    out[2] += lift / plant.mass


@kernel
def derivative(
    state: FloatArray,
    plant: Plant,
    command: FloatArray,
    outside: FloatArray,
    voltage: float,
    time_s: float,
    out: FloatArray,
) -> None:
    """Write d(state)/dt of the RK4 states; `outside` (3,) N m is held over the step."""
    thrusts, drive, torque = np.empty(4), np.empty(3), np.empty(3)
    force, total = np.empty(3), np.empty(3)
    motor_thrusts(state, plant, voltage, thrusts)
    drive_torque(thrusts, plant, time_s, drive)
    w = plant.mode_rad_s
    for i in range(3):
        position, speed = state[MODE + i], state[MODE + 3 + i]
        wide = 2.0 * plant.mode_damping * w
        out[MODE + i] = speed
        out[MODE + 3 + i] = drive[i] - wide * speed - w * w * position
        torque[i] = drive[i] + plant.mode_peak[i] * wide * speed + outside[i]
    body_torque(state, plant, time_s, torque)
    for i in range(3):
        out[RATES + i] = plant.free_axes[i] * torque[i] / plant.inertia[i]
    quaternion_rate(state[QUAT : QUAT + 4], state[RATES : RATES + 3], out[QUAT : QUAT + 4])
    for i in range(4):
        out[ROTORS + i] = (command[i] - state[ROTORS + i]) / plant.lag[i]
    air_force(state, plant, thrusts, force)
    world_from_body(state[QUAT : QUAT + 4], force, total)
    for i in range(3):
        weight = GRAVITY_M_S2 if i == 2 else 0.0
        out[POSITION + i] = plant.moves * state[VELOCITY + i]
        out[VELOCITY + i] = plant.moves * (total[i] - weight)


@kernel
def dry_friction(state: FloatArray, plant: Plant) -> None:
    """Take the friction's impulse of one step from the rates, at most what stops them."""
    for i in range(3):
        low, extra = plant.dry_low[i], plant.dry_extra[i]
        if low == 0.0 and extra == 0.0:
            continue
        rate = state[RATES + i]
        torque = low + extra * math.exp(-((rate / plant.dry_speed) ** 2))
        loss = torque / plant.inertia[i] * plant.step_s
        state[RATES + i] = max(0.0, rate - loss) + min(0.0, rate + loss)


@kernel
def stands(state: FloatArray, plant: Plant) -> bool:
    """Whether the ground carries it."""
    return plant.ground and state[POSITION + 2] <= plant.ground_m


@kernel
def touch_ground(state: FloatArray, plant: Plant) -> None:
    """Keep the aircraft above the ground; on it, it is level and neither slides nor turns."""
    if not stands(state, plant) or state[VELOCITY + 2] > 0.0:
        return
    state[POSITION + 2] = plant.ground_m
    heading = math.hypot(state[QUAT], state[QUAT + 3])
    for i in range(3):
        state[VELOCITY + i] = 0.0
        state[RATES + i] = 0.0
    if heading > 0.0:
        state[QUAT] /= heading
        state[QUAT + 1] = 0.0
        state[QUAT + 2] = 0.0
        state[QUAT + 3] /= heading


@kernel
def physics_step(
    state: FloatArray, plant: Plant, motors: FloatArray, normals: FloatArray, extra: FloatArray
) -> None:
    """Advance `state` by one step; `normals` (3,) drive the torque noise, `extra` is N m."""
    h = plant.step_s
    command, outside = np.empty(4), np.empty(3)
    stages, trial = np.empty((4, RK_STATES)), np.empty(RK_STATES)
    limited_command(motors, state, plant, command)
    memory = math.exp(-2.0 * math.pi * plant.noise_bandwidth_hz * h)
    if plant.noise_bandwidth_hz <= 0.0:
        memory = 0.0
    # the colouring filter has unit gain at zero frequency
    width = (1.0 - memory) * math.sqrt(0.5 / h)
    for i in range(3):
        state[GUST + i] = memory * state[GUST + i] + width * plant.noise[i] * normals[i]
        outside[i] = extra[i] + state[GUST + i]
    voltage = battery_voltage(state, plant)
    time_s = state[TIME]
    for stage in range(4):
        reach = 0.0 if stage == 0 else (h if stage == 3 else 0.5 * h)
        for i in range(RK_STATES):
            trial[i] = state[i] + (reach * stages[stage - 1, i] if stage > 0 else 0.0)
        derivative(trial, plant, command, outside, voltage, time_s + reach, stages[stage])
    for i in range(RK_STATES):
        state[i] += (
            h / 6.0 * (stages[0, i] + 2.0 * stages[1, i] + 2.0 * stages[2, i] + stages[3, i])
        )
    dry_friction(state, plant)
    touch_ground(state, plant)
    norm = 0.0
    for i in range(4):
        norm += state[QUAT + i] ** 2
    for i in range(4):
        state[QUAT + i] /= math.sqrt(norm)
    state[CHARGE] += h * pack_current(state, plant)
    state[TIME] = time_s + h
