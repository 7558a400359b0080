"""Body FRD / earth NED (wire) to body FLU / earth ENU (ROS) and back: the one place for signs.

Both maps are their own inverse, so the same function serves both directions (REP-103).
"""

from __future__ import annotations

import math

from quad_bridge.wire.frames import Vector3, Vector4


def flip_body(v: Vector3) -> Vector3:
    """A body vector (rates, acceleration, torque, differences of angles): y and z turned."""
    return v[0], -v[1], -v[2]


def flip_attitude(rpy: Vector3) -> Vector3:
    """Roll, pitch, yaw (Z-Y-X, rad) of FRD in NED to those of FLU in ENU, or back.

    Yaw counts from east anticlockwise in ENU, from north clockwise in NED: yaw' = pi/2 - yaw,
    wrapped to [-pi, pi).
    """
    yaw = math.remainder(0.5 * math.pi - rpy[2], 2.0 * math.pi)
    return rpy[0], -rpy[1], yaw


def upwards(accel: Vector3, rpy: Vector3) -> float:
    """Specific force along the vertical, up, of that in FRD at this attitude against NED."""
    roll, pitch, _ = rpy
    side = math.sin(roll) * accel[1] + math.cos(roll) * accel[2]
    return math.sin(pitch) * accel[0] - math.cos(pitch) * side


def flip_control(u: Vector4) -> Vector4:
    """U1..U4: the collective stays, the torques about y and z are turned."""
    return u[0], u[1], -u[2], -u[3]


def quaternion(rpy: Vector3) -> Vector4:
    """Unit quaternion (x, y, z, w) of roll, pitch, yaw (Z-Y-X, rad)."""
    cr, sr = math.cos(0.5 * rpy[0]), math.sin(0.5 * rpy[0])
    cp, sp = math.cos(0.5 * rpy[1]), math.sin(0.5 * rpy[1])
    cy, sy = math.cos(0.5 * rpy[2]), math.sin(0.5 * rpy[2])
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )


def angles_of(q: Vector4) -> Vector3:
    """Roll, pitch, yaw (Z-Y-X, rad) of a quaternion w x y z."""
    w, x, y, z = q
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = math.asin(min(max(2.0 * (w * y - z * x), -1.0), 1.0))
    return roll, pitch, math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
