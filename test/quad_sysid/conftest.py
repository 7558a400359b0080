"""An axis flown in plain Python, for tests of the analysis: known plant, known noise, by hand.

It shares no line with the analysis: the midpoint rule at 1 kHz instead of exact steps, the
controller and the effects written out where they act.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from quad_sysid.record import GainChange, Record, Segment

DT = 0.004
SUBSTEPS = 4


def no_torque(_rate: float, _angle: float) -> float:
    return 0.0


@dataclass(frozen=True)
class Axis:
    """The true plant; torques in rad/s², `command` maps (u, volts) to what the motors do."""

    gain: float = 450.0
    lag_s: float = 0.042
    delay_cycles: int = 2
    damping: float = 0.4
    bias: float = 0.2
    torque: Callable[[float, float], float] = no_torque
    command: Callable[[float, float], float] = lambda u, _: u
    gyro_noise: float = 0.005
    torque_noise: float = 0.03
    """(rad/s²)/√Hz"""
    volts: tuple[float, float] = (12.4, 12.4)


@dataclass(frozen=True)
class Plan:
    """Segments (role, signal, start, end in s) on a PRBS of `amplitude` rad, from one seed."""

    seconds: float = 54.0
    segments: tuple[tuple[str, str, float, float], ...] = (
        ('idle', 'none', 0.0, 1.0),
        ('train', 'prbs', 1.0, 35.0),
        ('validation', 'prbs', 36.0, 54.0),
    )
    amplitude: float = 0.2


SECOND = Plan(30.0, (('idle', 'none', 0.0, 1.0), ('validation', 'prbs', 1.0, 30.0)))


def fly(axis: Axis, seed: int, plan: Plan | None = None) -> Record:
    """One flight of the axis in an attitude loop; the gyro is unfiltered, its noise white."""
    plan = plan or Plan()
    rng = np.random.default_rng(seed)
    n, h = round(plan.seconds / DT), DT / SUBSTEPS
    # levels that hold for 0.1 s to 0.7 s, three sizes: slow and fast, small and large
    reference = np.zeros(n)
    k = round(1.0 / DT)
    while k < n:
        held = int(rng.integers(25, 175))
        reference[k : k + held] = plan.amplitude * rng.choice([-1.0, -0.4, 0.4, 1.0])
        k += held
    gyro = axis.gyro_noise * rng.standard_normal(n)
    pushes = axis.torque_noise / math.sqrt(h) * rng.standard_normal(n * SUBSTEPS)
    volts = np.linspace(*axis.volts, n)
    rates, angles, commands = np.zeros(n), np.zeros(n), np.zeros(n)
    rate = angle = drive = 0.0
    keep_half, keep = math.exp(-0.5 * h / axis.lag_s), math.exp(-h / axis.lag_s)
    for k in range(n):
        rates[k], angles[k] = rate + gyro[k], angle
        wanted = 3.0 * (reference[k] - angle)
        commands[k] = min(max(0.06 * (wanted - rates[k]), -0.3), 0.3)
        late = max(k - axis.delay_cycles, 0)
        aim = axis.gain * axis.command(float(commands[late]), float(volts[late]))
        for i in range(SUBSTEPS):
            push = axis.bias + pushes[k * SUBSTEPS + i]
            slope = drive + push - axis.damping * rate + axis.torque(rate, angle)
            r, a = rate + 0.5 * h * slope, angle + 0.5 * h * rate
            middle = aim + (drive - aim) * keep_half
            angle += h * r
            rate += h * (middle + push - axis.damping * r + axis.torque(r, a))
            drive = aim + (drive - aim) * keep
    zero = np.zeros(n)
    return Record(
        source=f'flight {seed}', dt=DT, rates=np.stack([rates, zero, zero], axis=1),
        control=np.stack([zero + 0.5, commands, zero, zero], axis=1),
        angles=np.stack([angles, zero, zero], axis=1), battery_v=volts,
        attitude_setpoint=np.stack([reference, zero, zero], axis=1),
        segments=tuple(
            Segment(role, signal, 'roll', 'attitude', a, b) for role, signal, a, b in plan.segments
        ),
        gains=(GainChange(0.0, {'roll.rate.kp': 0.06}),),
    )


@pytest.fixture(scope='session')
def axis_type() -> type[Axis]:
    return Axis


@pytest.fixture(scope='session')
def plan_type() -> type[Plan]:
    return Plan


@pytest.fixture(scope='session')
def flown() -> Callable[..., Record]:
    return fly


@pytest.fixture(scope='session')
def second_plan() -> Plan:
    return SECOND
