"""Two other ways to gains, from the same flight and the same model, for bench/tuning.py's table.

`px4_like`: the structure that PX4's autotune identifies (two poles, three zeros, recursive least
squares) and its rule, a PID from generalised minimum variance control (Yamamoto, Fujii, Kaneda
1998). `ziegler_nichols`: the ultimate-gain rules on the identified model, inner loop then outer.
Neither knows of margins over an ensemble. Written from the published equations.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.signal import butter, sosfilt

from quad_sysid.contract import AXES, FloatArray
from quad_sysid.loop.cascade import CascadeGains, frequency_grid, open_loop
from quad_sysid.loop.from_model import loop_plant
from quad_sysid.loop.linear import WIDE, ComplexArray, loops_of
from quad_sysid.model import AxisModel
from quad_sysid.record import Record

MODEL_CYCLES = 2
"""Half the gyro filter's period, in whole control cycles, as PX4 chooses its model's step."""
MEMORY_S = 60.0
HIGH_PASS_HZ = 0.5
RISE_TIME_S = 0.14
DETUNING = 0.7
LARGEST = {'angle_kp': 20.0, 'rate_kp': 1.0, 'rate_ki': 1.0, 'rate_kd': 0.05}
"""What the firmware accepts."""


def px4_like(record: Record, axis: str, active: CascadeGains) -> CascadeGains | None:
    """Gains by PX4's structure and rule; None where they come out negative (its own check)."""
    index = AXES.index(axis)
    high = butter(1, HIGH_PASS_HZ, 'highpass', fs=1.0 / record.dt, output='sos')
    segment = next(s for s in record.segments if s.role == 'train')
    start, stop = record.span(segment)
    u = sosfilt(high, record.control[start:stop, index + 1])[::MODEL_CYCLES]
    y = sosfilt(high, record.rates[start:stop, index])[::MODEL_CYCLES]
    dt = MODEL_CYCLES * record.dt
    a1, a2, b0, b1, b2 = _recursive_least_squares(u, y, 1.0 - dt / MEMORY_S)
    kc, ki, kd = _gmvc(a1, a2, b0 + b1 + b2, dt)
    if not (np.isfinite([kc, ki, kd]).all() and kc > 0.0 and ki > 0.0 and kd > -0.001):
        return None
    angle = float(np.clip(1.0 / (np.radians(60.0) * kc), 2.0, 6.5))
    return _limited(active, angle, kc, kc * ki, kc * max(kd, 0.0))


def _recursive_least_squares(u: FloatArray, y: FloatArray, forgetting: float) -> FloatArray:
    """(5,) a1, a2, b0, b1, b2 of y[k] = -a1 y[k-1] - a2 y[k-2] + b0 u[k-1] + ... + b2 u[k-3]."""
    theta, spread = np.zeros(5), 1e4 * np.eye(5)
    for k in range(3, y.size):
        row = np.array([-y[k - 1], -y[k - 2], u[k - 1], u[k - 2], u[k - 3]])
        gain = spread @ row / (forgetting + row @ spread @ row)
        theta = theta + gain * (y[k] - row @ theta)
        spread = (spread - np.outer(gain, row @ spread)) / forgetting
    return theta


def _gmvc(a1: float, a2: float, b: float, dt: float) -> tuple[float, float, float]:
    """(kc, 1/Ti, Td) of u = kc (1 + 1/(Ti s) + Td s) e; critically damped reference model.

    P = Delta A E + q^-2 F with E = 1 + e1 q^-1, F = f0 + f1 q^-1 + f2 q^-2; the PID in its
    velocity form takes F's coefficients.
    """
    # the model's two poles at exp(-2 dt / rise time)
    pole = np.exp(-2.0 * dt / RISE_TIME_S)
    p1, p2 = -2.0 * pole, pole**2
    e1 = p1 - a1 + 1.0
    f0 = p2 - (a2 - a1) - (a1 - 1.0) * e1
    f1 = a2 - (a2 - a1) * e1
    f2 = a2 * e1
    nu = DETUNING + (1.0 + e1) * b
    kc = -(f1 + 2.0 * f2) / nu
    return kc, (f0 + f1 + f2) / nu / dt / kc, f2 / nu * dt / kc


def ziegler_nichols(model: AxisModel, active: CascadeGains) -> CascadeGains | None:
    """0.6 Ku, Tu/2, Tu/8 on the rate loop, then 0.5 Ku of the angle loop around it."""
    plant = loop_plant(model)
    omega = frequency_grid(model.dt, points=2000, lowest_rad_s=0.5)
    response = loops_of([(plant, WIDE)]).response(omega)
    ultimate = _ultimate(response[0, 0], omega)
    if ultimate is None:
        return None
    ku, wu = ultimate
    tu = 2.0 * np.pi / wu
    inner = replace(
        active, angle_kp=0.0, rate_kp=0.6 * ku, rate_ki=1.2 * ku / tu, rate_kd=0.075 * ku * tu
    )
    loop = open_loop(inner, response, omega, model.dt)
    forward = open_loop(replace(inner, angle_kp=1.0), response, omega, model.dt) - loop
    outer = _ultimate((forward / (1.0 + loop))[0], omega)
    if outer is None:
        return None
    return _limited(active, 0.5 * outer[0], inner.rate_kp, inner.rate_ki, inner.rate_kd)


def _ultimate(response: ComplexArray, omega: FloatArray) -> tuple[float, float] | None:
    """Gain and frequency at which the loop just oscillates: the first crossing of -180 degrees."""
    phase = np.unwrap(np.angle(response))
    below = np.flatnonzero((phase[:-1] > -np.pi) & (phase[1:] <= -np.pi))
    if not below.size:
        return None
    k = int(below[0])
    return 1.0 / float(np.abs(response[k])), float(omega[k])


def _limited(
    active: CascadeGains, angle: float, kp: float, ki: float, kd: float
) -> CascadeGains:
    values = {'angle_kp': angle, 'rate_kp': kp, 'rate_ki': ki, 'rate_kd': kd}
    return replace(active, **{k: float(min(v, LARGEST[k])) for k, v in values.items()})
