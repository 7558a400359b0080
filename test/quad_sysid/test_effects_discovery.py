"""From a flight to what it lacks: one effect planted, or nothing, and what is said of it.

The virtual STM32's physics faster than time, arrays only. What was planted stands in this file
alone; the analysis gets the record. Shorter than a real flight: 34 s of training.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from quad_bridge.virtual.profile import Profile, load_profile
from quad_bridge.virtual.simulation import Excited, fly
from quad_sysid.contract import control_from_motors
from quad_sysid.effects.discover import Discovery, discover
from quad_sysid.effects.judge import Judgement, judge
from quad_sysid.effects.scan import strongest
from quad_sysid.effects.shapes import SHAPES
from quad_sysid.effects.table import EFFECTS
from quad_sysid.greybox.data import axis_data
from quad_sysid.model import AxisModel, EffectEstimate
from quad_sysid.pipeline.assemble import axis_model
from quad_sysid.pipeline.evaluate import evaluate
from quad_sysid.record import GainChange, Record, Segment
from quad_sysid.signals.prbs import prbs

RATE_HZ = 250
FIRST = (('train', 'prbs', 34.0), ('validation', 'prbs', 11.0), ('validation', 'square', 11.0))
UNSEEN = (('validation', 'prbs', 12.0), ('validation', 'square', 10.0))
INERTIA = 0.0135
"""Of roll in the profile `plain`, kg m²: strengths planted in N m are told in rad/s²."""
WORTH = 1.5
"""A planted effect is clear where the unseen flight's error falls by this factor or more."""

Torque = Callable[..., np.ndarray]


@dataclass(frozen=True)
class Planted:
    """What one aircraft has: effects of the profile, or a torque of its own."""

    effects: Mapping[str, Mapping[str, object]] = field(default_factory=dict)
    mount: str = 'rig'
    also: str = ''
    """A second axis that is excited at the same time."""
    torque: Callable[[], Torque] | None = None
    torque_bandwidth_hz: float = 0.0
    capacity_ah: float = 4.5


def profile_of(planted: Planted) -> Profile:
    profile = load_profile('plain')
    effects = profile.effects
    for name, settings in planted.effects.items():
        old = getattr(effects, name)
        given = {
            key: (value,) * 3 if isinstance(getattr(old, key), tuple) else value
            for key, value in settings.items()
        }
        effects = replace(effects, **{name: replace(old, enabled=True, **given)})
    airframe, wide = profile.airframe, planted.torque_bandwidth_hz
    mounts = replace(
        airframe.mounts,
        rig=replace(airframe.mounts.rig, torque_noise_bandwidth_hz=wide),
        hover=replace(airframe.mounts.hover, torque_noise_bandwidth_hz=wide),
    )
    battery = replace(airframe.battery, capacity_ah=planted.capacity_ah, start_charge=1.0)
    return replace(
        profile, mount=planted.mount, axis='roll', effects=effects,
        airframe=replace(airframe, mounts=mounts, battery=battery),
    )


def wave(signal: str, n: int, seed: int) -> np.ndarray:
    """+-12 degrees: a square wave of 3 s, or a PRBS whose shortest level holds 92 ms."""
    amplitude = math.radians(12.0)
    if signal == 'square':
        return amplitude * np.where((np.arange(n) // 375) % 2 == 0, 1.0, -1.0)
    return np.resize(prbs(9, 23, amplitude, 1 + seed), n)


def flown(planted: Planted, plan: tuple[tuple[str, str, float], ...], seed: int) -> Record:
    """The flight as the analysis gets it from a bag."""
    schedule: list[Excited] = []
    segments: list[Segment] = []
    time, idle = 3.0, 0.0
    for number, (role, signal, seconds) in enumerate(plan):
        n = round(seconds * RATE_HZ)
        for axis, kind, shift in (('roll', signal, 0), (planted.also, 'prbs', 57)):
            if axis:
                samples = wave(kind, n, 13 * seed + 101 * number + shift)
                schedule.append(Excited(time, samples, axis, 'attitude', role, kind))
        segments.append(Segment('idle', 'none', 'roll', 'attitude', idle, time))
        idle = time + seconds
        segments.append(Segment(role, signal, 'roll', 'attitude', time, idle))
        time = idle + 1.0
    torque = planted.torque() if planted.torque else None
    flight = fly(profile_of(planted), schedule, time, seed, effect=torque)
    return Record(
        source=f'virtual flight {seed}', dt=flight.dt, rates=flight.rates,
        control=control_from_motors(flight.motors), angles=flight.angles, motors=flight.motors,
        wrench=flight.wrench, attitude_setpoint=flight.attitude_setpoint,
        rate_setpoint=flight.rate_setpoint, battery_v=flight.battery_v,
        segments=tuple(segments), gains=(GainChange(0.0, dict(flight.gains)),),
    )


def answered(planted: Planted, seed: int = 1) -> tuple[Discovery, Judgement, AxisModel]:
    """Discovery on the training segments, judged on the validation ones."""
    with threadpool_limits(limits=1):
        data = axis_data([flown(planted, FIRST, seed)], 'roll')
        rng = np.random.default_rng(0)
        found = discover(data, EFFECTS + SHAPES, rng)
        answer = judge(found, rng)
        return found, answer, axis_model(found, answer, {}, None)


def only(model: AxisModel) -> EffectEstimate:
    assert len(model.effects) == 1, [e.name for e in model.effects]
    return model.effects[0]


def value(effect: EffectEstimate, name: str) -> float:
    return next(p.value for p in effect.parameters if p.name == name)


def factor(model: AxisModel, planted: Planted, seed: int = 501) -> float:
    """By how much the completed model lowers the error on a flight that nothing has seen."""
    error = evaluate(model, flown(planted, UNSEEN, seed))
    return error.before / error.after


# what stands in the table

KNOWN: dict[str, tuple[Planted, dict[str, tuple[float, float]]]] = {
    'quadratic_drag': (
        Planted({'quadratic_drag': {'coefficient_nm_s2': 0.02}}),
        {'coefficient': (0.02 / INERTIA, 0.10)},
    ),
    'cubic_stiffness': (
        Planted({'cubic_stiffness': {'stiffness_nm_rad3': 1.0}}),
        {'stiffness': (1.0 / INERTIA, 0.10)},
    ),
    'backlash': (
        Planted({'backlash': {'half_width': 0.002}}), {'half_width': (0.002, 0.10)},
    ),
    'saturation': (
        Planted({'saturation': {'lower': 0.02, 'upper': 0.42}}), {'upper': (0.42, 0.01)},
    ),
    'motor_lag': (
        Planted({'motor_lag': {'slow_time_constant_s': 0.2}}),
        {'slow_time_constant': (0.2, 0.20), 'share': (0.25, 0.15)},
    ),
    'resonance': (
        Planted({'resonance': {'frequency_hz': 6.0, 'peak': 0.4}}),
        {'frequency': (6.0, 0.01), 'damping_ratio': (0.05, 0.10)},
    ),
    'periodic_disturbance': (
        Planted({'periodic_disturbance': {'frequency_hz': 2.3, 'amplitude_nm': 0.01}}),
        {'frequency': (2.3, 0.005), 'amplitude': (0.01 / INERTIA, 0.10)},
    ),
    'step_event': (
        Planted({'step_event': {'torque_nm': 0.005, 'time_s': 20.0}}),
        {'time': (20.0, 0.01), 'torque': (0.005 / INERTIA, 0.10)},
    ),
    'cross_axis_input': (
        Planted({'cross_axis_input': {'fraction': 0.15}}, mount='hover', also='pitch'),
        {'fraction': (0.15, 0.05)},
    ),
    'battery_sag': (
        Planted({'battery_sag': {'exponent': 3.0}}, capacity_ah=0.25), {'exponent': (3.0, 0.10)},
    ),
}  # fmt: skip
"""Planted, and its parameters in the contract's units with the relative tolerance of each."""


@pytest.mark.parametrize('name', KNOWN)
def test_one_planted_effect_is_named_measured_and_pays(name):
    """The name alone, parameters in tolerance, and an unseen flight's error 1.5 times lower."""
    planted, parameters = KNOWN[name]
    _, answer, model = answered(planted)
    assert answer.verdict == 'effects_added'
    effect = only(model)
    assert effect.name == name
    for key, (true, tolerance) in parameters.items():
        assert value(effect, key) == pytest.approx(true, rel=tolerance), key
    assert effect.p_value < 0.05
    assert effect.error_reduction_pct > 100.0 * (WORTH - 1.0)
    assert effect.probability + sum(p for _, p in effect.rivals) == pytest.approx(1.0)
    assert effect.probability > 0.5
    if name == 'step_event':  # a later flight begins after the event
        planted = Planted({'step_event': {'torque_nm': 0.005, 'time_s': 0.0}})
    assert factor(model, planted) > WORTH


# what stands in no table


def relaxing_strap() -> Torque:
    """A load on a viscous strap, 3.6 rad/s² per rad: a state that follows the angle with 0.8 s."""
    state = [0.0, 0.0]

    def torque(t, rates, angles, thrusts, battery_v):  # noqa: ARG001
        passed, state[1] = max(0.0, float(t) - state[1]), float(t)
        state[0] += (float(angles[0]) - state[0]) * (1.0 - math.exp(-passed / 0.8))
        return np.array([-0.048 * (float(angles[0]) - state[0]), 0.0, 0.0])

    return torque


def one_sided_spring() -> Torque:
    """A cable that pulls beyond 4 degrees to one side only."""

    def torque(t, rates, angles, thrusts, battery_v):  # noqa: ARG001
        return np.array([-0.06 * max(0.0, float(angles[0]) - 0.07), 0.0, 0.0])

    return torque


def test_a_hidden_state_comes_out_as_a_mode_with_its_time_constant():
    planted = Planted(torque=relaxing_strap)
    found, answer, model = answered(planted)
    assert answer.verdict == 'effects_added'
    effect = only(model)
    assert (effect.name, effect.kind) == ('mode', 'mode')
    assert value(effect, 'time_constant') == pytest.approx(0.8, rel=0.25)
    assert value(effect, 'stiffness') == pytest.approx(0.048 / INERTIA, rel=0.10)
    assert factor(model, planted) > WORTH
    assert found.dependence[0].name == 'memory'


def test_a_one_sided_spring_comes_out_as_a_curve_of_the_angle():
    """Not silent and under no wrong name; the curve is the spring's but for a constant.

    Slopes in rad/s² per rad: within 0.5 of 0 on the slack side, within 25 % of 4.4 on the other
    (the knots lie 4 degrees apart, and the kink between two).
    """
    planted = Planted(torque=one_sided_spring)
    found, answer, model = answered(planted)
    assert answer.verdict == 'effects_added'
    effect = only(model)
    assert (effect.name, effect.kind) == ('shape:angle', 'shape')
    x, y = np.array(effect.settings['knots']), np.array(effect.settings['values'])
    slack, taut = np.interp([[-0.12, 0.0], [0.11, 0.18]], x, y)
    assert (slack[1] - slack[0]) / 0.12 == pytest.approx(0.0, abs=0.5)
    assert (taut[1] - taut[0]) / 0.07 == pytest.approx(-0.06 / INERTIA, rel=0.25)
    assert factor(model, planted) > WORTH
    assert strongest(found.base, found.dependence) is not None
    assert found.dependence[0].name == 'angle'


# nothing

NOTHING = {
    'rig': Planted(),
    'hover': Planted(mount='hover'),
    'coloured torque noise on the rig': Planted(torque_bandwidth_hz=2.0),
    'coloured torque noise in hover': Planted(mount='hover', torque_bandwidth_hz=5.0),
    'vibration of the gyro': Planted({'vibration': {}}),
}


@pytest.mark.parametrize('case', NOTHING)
def test_where_nothing_is_planted_nothing_is_found(case):
    """No name, no curve, no dependence; and the model is the base to the last bit."""
    found, answer, model = answered(NOTHING[case], seed=2)
    assert answer.verdict == 'no_missing_effect', answer.reason
    assert model.effects == ()
    assert strongest(found.base, found.dependence) is None
    assert factor(model, NOTHING[case]) == 1.0
