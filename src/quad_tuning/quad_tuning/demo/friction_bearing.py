"""The demo's undeclared effect: a rig bearing that holds fast, then slides more easily.

An effect module of the virtual STM32 (`--effect-module`); it imports nothing of the project, and
no module of the analysis knows this equation.
"""

from __future__ import annotations

import math

import numpy as np

STATIC_NM = 0.010
"""Friction near standstill, N m."""
SLIDING_NM = 0.006
"""Friction at speed, N m."""
DROP_SPEED_RAD_S = 0.25
"""Speed over which it drops from the one to the other."""
STICK_SPEED_RAD_S = 0.02
"""Below it the bearing creeps instead of sticking, so that the torque is smooth in the rate."""


def effect(t_s: float, rates: np.ndarray, angles: np.ndarray, thrusts: np.ndarray,
           battery_v: float) -> np.ndarray:
    """Body torque (3,) in N m of the roll bearing; rates (3,) in rad/s, the rest is not used."""
    del t_s, angles, thrusts, battery_v
    rate = float(rates[0])
    level = SLIDING_NM + (STATIC_NM - SLIDING_NM) / (1.0 + (rate / DROP_SPEED_RAD_S) ** 2)
    return np.array([-level * math.tanh(rate / STICK_SPEED_RAD_S), 0.0, 0.0])
