"""Flights with something planted in them, or nothing: what the judge of bench/effects.py draws.

The virtual STM32's physics, faster than time. Strengths are log-uniform; a scenario counts where
the true structure is worth the factor it was drawn for, which the judge measures by a fit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from quad_bridge.virtual.profile import load_profile
from quad_bridge.virtual.simulation import Excited, Flight, fly
from quad_sysid.contract import control_from_motors
from quad_sysid.record import GainChange, Record, Segment
from quad_sysid.signals.prbs import prbs

RATE_HZ = 250.0
AMPLITUDE = np.deg2rad(12.0)
PLAN = (('train', 'prbs', 40.0), ('validation', 'prbs', 18.0), ('validation', 'square', 16.0))
UNSEEN = (('validation', 'prbs', 20.0), ('validation', 'square', 15.0))

EffectFunction = Callable[..., np.ndarray]


@dataclass(frozen=True)
class Scenario:
    """One flight to be judged: what is planted, where, with which seed."""

    name: str
    """Of the planted effect; `nothing`; or of an effect that stands in no list."""
    axis: str
    mount: str
    seed: int
    effects: Mapping[str, Mapping[str, object]]
    module: EffectFunction | None = None
    torque_bandwidth_hz: float = 0.0


STRENGTHS: dict[str, tuple[str, float, float]] = {
    'coulomb_friction': ('torque_nm', 0.0005, 0.006),
    'quadratic_drag': ('coefficient_nm_s2', 0.004, 0.04),
    'pendulum_stiffness': ('stiffness_nm_rad', 0.004, 0.05),
    'cubic_stiffness': ('stiffness_nm_rad3', 0.1, 2.0),
    'dead_zone': ('half_width', 0.0001, 0.001),
    'backlash': ('half_width', 0.0003, 0.003),
    'saturation': ('upper', 0.50, 0.60),
    'motor_lag': ('slow_time_constant_s', 0.09, 0.3),
    'resonance': ('peak', 0.05, 0.6),
    'periodic_disturbance': ('amplitude_nm', 0.0015, 0.015),
    'step_event': ('torque_nm', 0.0005, 0.006),
    'battery_sag': ('exponent', 1.0, 3.0),
}
"""Effect to the key of its strength and the range it is drawn from."""


def named(rng: np.random.Generator, name: str, seed: int, axis: str, mount: str) -> Scenario:
    """A scenario with one named effect of drawn strength."""
    key, low, high = STRENGTHS[name]
    value = float(np.exp(rng.uniform(np.log(low), np.log(high))))
    settings: dict[str, object] = {key: value}
    if name == 'saturation':
        settings['lower'] = 0.02
    return Scenario(name, axis, mount, seed, {name: settings})


def nothing(rng: np.random.Generator, seed: int, axis: str, mount: str) -> Scenario:
    """A flight with nothing missing, often with coloured torque noise or vibration as a trap."""
    effects: dict[str, dict[str, object]] = {}
    if rng.random() < 0.3:
        effects['vibration'] = {}
    bandwidth = float(rng.choice([0.0, 0.0, 2.0, 5.0]))
    return Scenario('nothing', axis, mount, seed, effects, torque_bandwidth_hz=bandwidth)


def flown(scenario: Scenario, plan: tuple[tuple[str, str, float], ...], seed: int) -> Record:
    """Fly a scenario over a plan of segments."""
    profile = load_profile('plain')
    effects = profile.effects
    for name, settings in scenario.effects.items():
        entry = replace(getattr(effects, name), enabled=True)
        for key, value in settings.items():
            old = getattr(entry, key)
            entry = replace(entry, **{key: (value,) * 3 if isinstance(old, tuple) else value})
        effects = replace(effects, **{name: entry})
    mounts = profile.airframe.mounts
    mounts = replace(
        mounts,
        rig=replace(mounts.rig, torque_noise_bandwidth_hz=scenario.torque_bandwidth_hz),
        hover=replace(mounts.hover, torque_noise_bandwidth_hz=scenario.torque_bandwidth_hz),
    )
    profile = replace(
        profile, mount=scenario.mount, axis=scenario.axis, effects=effects,
        airframe=replace(profile.airframe, mounts=mounts),
    )
    schedule, end = _schedule(scenario.axis, plan, seed)
    return record_of(fly(profile, schedule, end, seed, effect=scenario.module))


def _schedule(
    axis: str, plan: tuple[tuple[str, str, float], ...], seed: int
) -> tuple[list[Excited], float]:
    out: list[Excited] = []
    time = 3.0
    for number, (role, signal, seconds) in enumerate(plan):
        n = round(seconds * RATE_HZ)
        if signal == 'square':
            samples = AMPLITUDE * np.where((np.arange(n) // 375) % 2 == 0, 1.0, -1.0)
        else:
            wave = prbs(9, 23, float(AMPLITUDE), 1 + 13 * seed + 101 * number)
            samples = np.resize(wave, n)
        out.append(Excited(time, samples, axis, 'attitude', role, signal))
        time += seconds + 2.0
    return out, time


def record_of(flight: Flight) -> Record:
    """The flight as the analysis gets it from a bag."""
    segments: list[Segment] = []
    time = 0.0
    for part in flight.schedule:
        segments.append(Segment('idle', 'none', part.axis, part.injection, time, part.start_s))
        time = part.start_s + part.samples.size * flight.dt
        segments.append(
            Segment(part.role, part.signal, part.axis, part.injection, part.start_s, time)
        )
    return Record(
        source='simulated', dt=flight.dt, rates=flight.rates,
        control=control_from_motors(flight.motors), angles=flight.angles, motors=flight.motors,
        wrench=flight.wrench, attitude_setpoint=flight.attitude_setpoint,
        rate_setpoint=flight.rate_setpoint, battery_v=flight.battery_v,
        segments=tuple(segments), gains=(GainChange(0.0, dict(flight.gains)),),
    )
