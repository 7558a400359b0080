"""The angle of an axis, from its measurement and the gyro."""

from __future__ import annotations

import math

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.model import recursion
from quad_sysid.model.data import AxisData
from quad_sysid.model.effect import required

LONG_S = 1.0
"""Time over which the drift between angle and gyro is measured, and no longer one is trusted."""


def led_by_gyro(data: AxisData, rate: FloatArray) -> FloatArray:
    """(n,) the measured angle, rad, with little of the noise that is white in it.

    A Kalman filter of one state, the angle, which the measured `rate` (n,), without gaps, carries
    on. Both variances come from the differences between the two: over one cycle and two, to which
    white noise adds the same, and over LONG_S, to which drift adds. An angle without white noise,
    such as a flight controller's estimate or one that was delayed, is taken as it is.
    """
    measured = required(data.angle)
    increments = np.append(0.5 * data.dt * (rate[1:] + rate[:-1]), 0.0)
    difference = measured - np.append(0.0, np.cumsum(increments[:-1]))

    def variance(cycles: int) -> float:
        steps = [difference[a:b][cycles:] - difference[a:b][:-cycles]
                 for a, b in data.stretches]
        return float(np.nanmean(np.concatenate([np.zeros(1), *steps]) ** 2))

    long = max(3, round(LONG_S / data.dt))
    of_one_cycle = variance(1)
    white = of_one_cycle - 0.5 * variance(2)
    gain = 1.0
    if white > 0.0:
        drift = max((variance(long) - of_one_cycle) / (long - 1), white / long**2)
        predicted = 0.5 * (drift + math.sqrt(drift**2 + 4.0 * drift * white))
        gain = predicted / (predicted + white)
    out = np.zeros(rate.size)
    for start, stop in data.stretches:
        recursion.led(measured, increments, gain, start, stop, out)
    return out
