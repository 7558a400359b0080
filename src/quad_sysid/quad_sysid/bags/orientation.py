"""Quaternions ↔ roll, pitch, yaw (ZYX, REP-103). Array maths only."""

from __future__ import annotations

import numpy as np

from quad_sysid.contract import FloatArray

UNMEASURED = -1.0
"""First number of a covariance whose quantity is not measured (REP-145)."""
MIN_NORM = 0.5
"""Below it four numbers are zeros or noise, and no quaternion of norm 1."""


def quaternions(angles: FloatArray) -> FloatArray:
    """(n, 4) x y z w from roll, pitch, yaw (n, 3), rad."""
    cr, cp, cy = np.cos(0.5 * angles).T
    sr, sp, sy = np.sin(0.5 * angles).T
    return np.column_stack(
        (sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy,
         cr * cp * cy + sr * sp * sy)
    )


def euler_angles(orientation: FloatArray) -> FloatArray:
    """Roll, pitch, yaw (n, 3), rad, from x y z w and covariance[0] (n, 5).

    NaN where it is not measured: covariance[0] of -1 (REP-145), zeros or NaN. Yaw is unwrapped
    over what is measured.
    """
    quaternion, covariance = orientation[:, :4], orientation[:, 4]
    norm = np.linalg.norm(quaternion, axis=1)
    is_measured = np.isfinite(norm) & (norm > MIN_NORM) & (covariance != UNMEASURED)
    angles = np.full((len(orientation), 3), np.nan)
    angles[is_measured] = euler_from_quaternion(quaternion[is_measured] / norm[is_measured, None])
    angles[is_measured, 2] = np.unwrap(angles[is_measured, 2])
    return angles


def euler_from_quaternion(xyzw: FloatArray) -> FloatArray:
    """Roll, pitch, yaw (n, 3), rad, ZYX, from unit quaternions x y z w (n, 4)."""
    x, y, z, w = xyzw.T
    return np.column_stack([
        np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
        np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0)),
        np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
    ])
