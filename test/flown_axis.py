"""An axis flown in plain Python, for tests of the analysis: known plant, known noise, by hand.

It shares no line with the analysis: the midpoint rule at 1 kHz instead of exact steps, the
controller and the effects written out where they act. `model_of` is what an identification says.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from quad_sysid.model import AxisModel, EffectEstimate, Parameter
from quad_sysid.record import GainChange, Record, Segment

DT = 0.004
SUBSTEPS = 4
GAINS = {'roll.angle.kp': 3.0, 'roll.rate.kp': 0.06, 'roll.rate.ki': 0.0, 'roll.rate.kd': 0.0}


@dataclass(frozen=True)
class Axis:
    """The true plant of roll; what else moves is known over time.

    torque(t, rate, angle) in rad/s²; command(t, u, volts) is what the motors make of u, where t
    is the time at which u was sent. Both may keep a state: they are asked in the order of time,
    the torque twice in each substep of 1 ms.
    """

    gain: float = 450.0
    lag_s: float = 0.042
    delay_ms: int = 8
    damping: float = 0.4
    bias: float = 0.2
    gyro_filter_hz: float | None = None
    """Cut-off of a 2nd-order Butterworth filter between rate and measurement."""
    torque: Callable[[float, float, float], float] = lambda _t, _rate, _angle: 0.0
    command: Callable[[float, float, float], float] = lambda _t, u, _volts: u
    gyro_noise: float = 0.005
    torque_noise: float = 0.03
    """(rad/s²)/√Hz"""
    volts: tuple[float, float] = (12.4, 12.4)
    throttle: Callable[[np.ndarray], np.ndarray] = lambda t: 0.5 + 0.0 * t
    other_commands: Callable[[np.ndarray], tuple] = lambda t: (0.0 * t, 0.0 * t)
    """Of pitch and yaw."""
    other_rates: Callable[[np.ndarray], tuple] = lambda t: (0.0 * t, 0.0 * t)
    """Of pitch and yaw, rad/s."""


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
    reference: np.ndarray | None = None
    """(n,) rad, instead of that PRBS."""


UNSEEN = Plan(30.0, (('idle', 'none', 0.0, 1.0), ('validation', 'prbs', 1.0, 30.0)))
SHORT = Plan(21.0, (('train', 'prbs', 1.0, 13.0), ('validation', 'prbs', 13.5, 21.0)))
LONGER = Plan(30.0, (('train', 'prbs', 1.0, 18.0), ('validation', 'prbs', 19.0, 30.0)))


def fly(axis: Axis, seed: int, plan: Plan | None = None) -> Record:
    """One flight of the axis in an attitude loop; the noise of the gyro is white."""
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
    if plan.reference is not None:
        reference[:] = plan.reference[:n]
    gyro = axis.gyro_noise * rng.standard_normal(n)
    pushes = (axis.torque_noise / math.sqrt(h) * rng.standard_normal(n * SUBSTEPS)).tolist()
    times, volts = np.arange(n) * DT, np.linspace(*axis.volts, n)
    wishes, shakes, clock, supply = (x.tolist() for x in (reference, gyro, times, volts))
    rates, angles, commands = [], [], []
    torque, damping, bias, gain = axis.torque, axis.damping, axis.bias, axis.gain
    rate = angle = drive = given = seen = seen_slope = 0.0
    taken, w = -1, 2.0 * math.pi * (axis.gyro_filter_hz or 0.0)
    keep_half, keep = math.exp(-0.5 * h / axis.lag_s), math.exp(-h / axis.lag_s)
    for k in range(n):
        rates.append((seen if w else rate) + shakes[k])
        angles.append(angle)
        wanted = 3.0 * (wishes[k] - angle)
        commands.append(min(max(0.06 * (wanted - rates[k]), -0.3), 0.3))
        for i in range(SUBSTEPS):
            sent = (k * SUBSTEPS + i - axis.delay_ms) // SUBSTEPS
            if sent > taken:
                taken = sent
                given = axis.command(clock[sent], commands[sent], supply[sent])
            aim, t = gain * given, k * DT + i * h
            push = bias + pushes[k * SUBSTEPS + i]
            slope = drive + push - damping * rate + torque(t, rate, angle)
            r, a = rate + 0.5 * h * slope, angle + 0.5 * h * rate
            middle = aim + (drive - aim) * keep_half
            angle += h * r
            rate += h * (middle + push - damping * r + torque(t + 0.5 * h, r, a))
            drive = aim + (drive - aim) * keep
            if w:
                for _ in range(4):
                    seen_slope += 0.25 * h * w * (w * (rate - seen) - math.sqrt(2.0) * seen_slope)
                    seen += 0.25 * h * seen_slope
    angles, zero, others = np.array(angles), np.zeros(n), axis.other_rates(times)
    leans = [np.cumsum(rate) * DT for rate in others]
    return Record(
        source=f'flight {seed}', dt=DT, t0_ns=10**18,
        rates=np.stack([rates, *others], axis=1),
        control=np.stack([axis.throttle(times), commands, *axis.other_commands(times)], axis=1),
        angles=np.stack([angles, *leans], axis=1), battery_v=volts,
        attitude_setpoint=np.stack([reference, zero, zero], axis=1),
        segments=tuple(
            Segment(role, signal, 'roll', 'attitude', a, b) for role, signal, a, b in plan.segments
        ),
        rate_setpoint=np.stack([3.0 * (reference - angles), zero, zero], axis=1),
        gains=(GainChange(0.0, GAINS),),
    )


def model_of(
    *effects: EffectEstimate, gyro_filter_hz: float | None = 42.0, **base: float
) -> AxisModel:
    """A model as if it had been identified: the paper's roll axis, but for these numbers."""
    values = {'gain': 450.0, 'lag': 0.043, 'delay': 0.008, 'damping': 0.4, 'bias': 0.0} | base
    return AxisModel('roll', DT, gyro_filter_hz, tuple(
        Parameter(name, value, 0.01, '') for name, value in values.items()), effects,
        mean_battery_v=11.0)
