"""By how much the far end's angle leads the integral of its rate: its own way to integrate.

A firmware that adds each new rate times the cycle is half a cycle ahead of the true integral.
"""

from __future__ import annotations

import numpy as np

from quad_sysid.contract import FloatArray

BELIEVED = 0.9
"""Share of the angle's steps, beside those of the last rate, that a lead must explain."""


def angle_lead_s(angle: FloatArray | None, rate: FloatArray, dt: float) -> float:
    """Lead in s, -dt/2..dt/2, of angle (n,) rad over the integral of rate (n,) rad/s.

    Least squares of w in a(k) - a(k-1) = dt (w rate(k) + (1 - w) rate(k-1)); the lead is
    (w - 1/2) dt: 0 for trapezoids, dt/2 for rectangles with the newest rate. 0 where the angle is
    not known or does not come from this rate.
    """
    if angle is None:
        return 0.0
    step = np.diff(angle) - dt * rate[:-1]
    turn = dt * np.diff(rate)
    known = np.isfinite(step) & np.isfinite(turn)
    step, turn = step[known], turn[known]
    power = float(turn @ turn)
    if not power > 0.0:
        return 0.0
    share = float(turn @ step) / power
    left = step - share * turn
    if float(left @ left) > (1.0 - BELIEVED) * float(step @ step):
        return 0.0
    return (min(max(share, 0.0), 1.0) - 0.5) * dt
