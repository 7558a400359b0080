"""Compiled attitude maths: unit quaternion (w, x, y, z) body (FLU) to world (ENU), Euler angles.

Angles are roll, pitch, yaw about x, y, z in the order z-y-x (REP-103).
"""

from __future__ import annotations

import math

from quad_bridge.si import FloatArray
from quad_bridge.virtual.compiled import kernel


@kernel
def euler_from_quaternion(quat: FloatArray, angles: FloatArray) -> None:
    """Write roll, pitch, yaw (3,) in rad of the quaternion (4,)."""
    w, x, y, z = quat[0], quat[1], quat[2], quat[3]
    angles[0] = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    angles[1] = math.asin(min(1.0, max(-1.0, 2.0 * (w * y - z * x))))
    angles[2] = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


@kernel
def quaternion_rate(quat: FloatArray, rates: FloatArray, out: FloatArray) -> None:
    """Write the derivative (4,) of the quaternion under body rates (3,) in rad/s."""
    w, x, y, z = quat[0], quat[1], quat[2], quat[3]
    p, q, r = rates[0], rates[1], rates[2]
    out[0] = -0.5 * (x * p + y * q + z * r)
    out[1] = 0.5 * (w * p + y * r - z * q)
    out[2] = 0.5 * (w * q + z * p - x * r)
    out[3] = 0.5 * (w * r + x * q - y * p)


@kernel
def body_from_world(quat: FloatArray, vector: FloatArray, out: FloatArray) -> None:
    """Write the world vector (3,) in body axes."""
    w, x, y, z = quat[0], quat[1], quat[2], quat[3]
    a, b, c = vector[0], vector[1], vector[2]
    out[0] = (1 - 2 * (y * y + z * z)) * a + 2 * (x * y + w * z) * b + 2 * (x * z - w * y) * c
    out[1] = 2 * (x * y - w * z) * a + (1 - 2 * (x * x + z * z)) * b + 2 * (y * z + w * x) * c
    out[2] = 2 * (x * z + w * y) * a + 2 * (y * z - w * x) * b + (1 - 2 * (x * x + y * y)) * c


@kernel
def world_from_body(quat: FloatArray, vector: FloatArray, out: FloatArray) -> None:
    """Write the body vector (3,) in world axes; of body z, the thrust of eqs. (1) to (3)."""
    w, x, y, z = quat[0], quat[1], quat[2], quat[3]
    a, b, c = vector[0], vector[1], vector[2]
    out[0] = (1 - 2 * (y * y + z * z)) * a + 2 * (x * y - w * z) * b + 2 * (x * z + w * y) * c
    out[1] = 2 * (x * y + w * z) * a + (1 - 2 * (x * x + z * z)) * b + 2 * (y * z - w * x) * c
    out[2] = 2 * (x * z - w * y) * a + 2 * (y * z + w * x) * b + (1 - 2 * (x * x + y * y)) * c
