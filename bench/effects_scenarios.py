"""What bench/effects.py flies: scenarios drawn from fixed seeds, and how each is flown.

The draws know strengths, axes, mounts and traps; the analysis gets nothing but the record. How
large a strength makes the error on unseen flights two times the true structure's was measured once
(STRENGTHS); the judge measures the factor of each flight again.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from types import ModuleType

import numpy as np
from effects_undeclared import NEEDS_DRIVE, UNDECLARED, EffectFunction, plain_torque
from virtual_flights import PLAN, record_of, schedule_of

from quad_bridge.virtual.profile import Profile, load_profile
from quad_bridge.virtual.receiver import Event, Receiver
from quad_bridge.virtual.simulation import Flight, fly
from quad_sysid.record import Record

UNSEEN = (('validation', 'prbs', 20.0), ('validation', 'square', 15.0))
AXES = ('roll', 'pitch', 'yaw')
PLACES = tuple((axis, mount) for mount in ('rig', 'hover') for axis in ('roll', 'pitch'))
FACTORS = (1.3, 5.0)
"""Range over which the worth of an effect is drawn, log-uniform."""

Settings = Mapping[str, Mapping[str, object]]


@dataclass(frozen=True)
class Scenario:
    """One flight to be judged. `planted` is what the judge holds the answer against."""

    number: int
    kind: str
    """`named`, `pair`, `nothing` or `undeclared`."""
    planted: tuple[str, ...]
    simulator: str
    """`virtual`: the virtual STM32's physics; `plain`: the tests' own simulator."""
    axis: str
    mount: str
    seed: int
    effects: Settings = field(default_factory=dict)
    wanted_factor: float = 0.0
    module: str = ''
    """Name of an undeclared effect of effects_undeclared.py, of this `size` (rad/s²)."""
    size: float = 0.0
    torque_bandwidth_hz: float = 0.0
    stirred: bool = False
    """The pilot moves sticks and throttle besides the excitation."""
    start_charge: float = 0.95

    def sealed(self) -> dict[str, object]:
        """The scenario as plain values, sealed before the flight and opened by the judge."""
        return asdict(self)


# ------------------------------------------------------------------ strengths of named effects

STRENGTHS: dict[str, tuple[str, str, float, float]] = {
    'coulomb_friction': ('torque_nm', 'acceleration', 0.086, 0.15),
    'quadratic_drag': ('coefficient_nm_s2', 'acceleration', 0.58, 0.96),
    'pendulum_stiffness': ('stiffness_nm_rad', 'acceleration', 0.38, 0.70),
    'cubic_stiffness': ('stiffness_nm_rad3', 'acceleration', 11.0, 29.0),
    'dead_zone': ('half_width', '', 2.5e-4, 3.6e-4),
    'backlash': ('half_width', '', 9.2e-4, 1.1e-3),
    'motor_lag': ('slow_time_constant_s', 'lag', 0.106, 0.106),
    'resonance': ('peak', '', 0.081, 0.139),
    'periodic_disturbance': ('amplitude_nm', 'acceleration', 0.06, 0.098),
    'step_event': ('torque_nm', 'acceleration', 0.146, 0.234),
    'battery_sag': ('exponent', '', 0.37, 1.0),
    'thrust_curve': ('curvature', '', 0.085, 0.085),
    'saturation': ('upper', 'limit', 0.445, 0.445),
    'cross_axis_input': ('fraction', '', 0.116, 0.116),
    'gyroscopic_coupling': ('extra_momentum_nm_s', 'acceleration', 0.6, 0.6),
}
"""Effect: key of its strength, how it scales, and what doubles the error on rig and in hover."""

STIRRED = {'battery_sag', 'thrust_curve', 'cross_axis_input', 'gyroscopic_coupling'}
"""These are only seen where throttle or other axes move."""
ONLY_ON = {'gyroscopic_coupling': 'hover', 'cross_axis_input': 'hover', 'thrust_curve': 'rig'}
"""Other axes move in hover alone; a pilot who holds height does not move the throttle."""


def strength(name: str, axis: str, mount: str, factor: float) -> float:
    """The strength that should make the base's error `factor` times the true structure's."""
    _, scale, rig, hover = STRENGTHS[name]
    two = rig if mount == 'rig' else hover
    share = float(np.sqrt((factor**2 - 1.0) / 3.0))
    if scale == 'lag':
        return 0.045 + (two - 0.045) * share
    if scale == 'limit':
        return two - 0.05 * (share - 1.0)
    inertia = load_profile('plain').airframe.inertia_kg_m2[AXES.index(axis)]
    return two * share * (inertia if scale == 'acceleration' else 1.0)


def settings_of(
    rng: np.random.Generator, name: str, axis: str, mount: str, factor: float
) -> dict[str, object]:
    """The virtual aircraft's switches for one named effect."""
    settings: dict[str, object] = {STRENGTHS[name][0]: strength(name, axis, mount, factor)}
    if name == 'saturation':
        settings['lower'] = 0.02
    if name == 'step_event':
        settings['time_s'] = float(rng.uniform(12.0, 34.0))
    if name == 'resonance':
        settings['frequency_hz'] = float(np.exp(rng.uniform(np.log(2.0), np.log(10.0))))
        settings['damping_ratio'] = float(rng.uniform(0.03, 0.1))
    if name == 'periodic_disturbance':
        settings['frequency_hz'] = float(np.exp(rng.uniform(np.log(0.4), np.log(5.0))))
    if name == 'motor_lag':
        settings['motors'] = (int(rng.integers(1, 5)),)
    if name == 'cross_axis_input':
        settings['from_axis'] = 'pitch' if axis == 'roll' else 'roll'
        settings['to_axis'] = axis
    return settings


PAIRS = (
    ('coulomb_friction', 'pendulum_stiffness'), ('coulomb_friction', 'quadratic_drag'),
    ('coulomb_friction', 'resonance'), ('coulomb_friction', 'battery_sag'),
    ('quadratic_drag', 'pendulum_stiffness'), ('quadratic_drag', 'periodic_disturbance'),
    ('pendulum_stiffness', 'periodic_disturbance'), ('pendulum_stiffness', 'backlash'),
    ('cubic_stiffness', 'coulomb_friction'), ('step_event', 'coulomb_friction'),
    ('motor_lag', 'pendulum_stiffness'), ('resonance', 'quadratic_drag'),
)


def factor_of(rng: np.random.Generator) -> float:
    """A log-uniform factor on an effect's strength."""
    return float(np.exp(rng.uniform(*np.log(FACTORS))))


def draw(
    first_seed: int, *, seeds: int, pairs: int, nothing: int, undeclared: int
) -> list[Scenario]:
    """All scenarios of a run; `seeds` flights per named effect, `pairs` per pair and so on."""
    rng = np.random.default_rng(first_seed)
    parts = (
        _named(rng, seeds), _pairs(rng, pairs), _nothing(rng, nothing), _invented(rng, undeclared)
    )
    values = [one for part in parts for one in part]
    return [Scenario(number=i, seed=first_seed + i, **v) for i, v in enumerate(values)]


Drawn = Iterator[dict[str, object]]


def _named(rng: np.random.Generator, seeds: int) -> Drawn:
    for name in STRENGTHS:
        for k in range(seeds):
            axis, mount = PLACES[k % 4]
            mount = ONLY_ON.get(name, mount)
            factor = factor_of(rng)
            yield {
                'kind': 'named', 'planted': (name,), 'simulator': 'virtual', 'axis': axis,
                'mount': mount, 'wanted_factor': factor, 'stirred': name in STIRRED,
                'effects': {name: settings_of(rng, name, axis, mount, factor)},
            }
        for _ in range(max(1, seeds // 4) if name in PLAIN and seeds else 0):
            factor = factor_of(rng)
            yield {
                'kind': 'named', 'planted': (name,), 'simulator': 'plain', 'axis': 'roll',
                'mount': 'rig', 'wanted_factor': factor,
                'effects': {name: {'strength': PLAIN[name] * np.sqrt((factor**2 - 1) / 3)}},
            }


def _pairs(rng: np.random.Generator, pairs: int) -> Drawn:
    for both in PAIRS:
        for k in range(pairs):
            axis, mount = PLACES[k % 4]
            yield {
                'kind': 'pair', 'planted': both, 'simulator': 'virtual', 'axis': axis,
                'mount': mount, 'stirred': 'battery_sag' in both,
                'effects': {
                    name: settings_of(rng, name, axis, mount, float(rng.uniform(1.8, 4.0)))
                    for name in both
                },
            }


def _nothing(rng: np.random.Generator, count: int) -> Drawn:
    places = (*PLACES, ('yaw', 'rig'), ('yaw', 'hover'))
    for k in range(count):
        plain = k % 10 == 9
        axis, mount = ('roll', 'rig') if plain else places[k % 6]
        yield {
            'kind': 'nothing', 'planted': (), 'simulator': 'plain' if plain else 'virtual',
            'axis': axis, 'mount': mount,
            'effects': {'vibration': {}} if rng.random() < 0.3 else {},
            'torque_bandwidth_hz': float(rng.choice([0.0, 0.0, 2.0, 5.0])),
            'stirred': bool(rng.random() < 0.4),
            'start_charge': float(rng.choice([0.95, 0.4, 0.15])),
        }


def _invented(rng: np.random.Generator, count: int) -> Drawn:
    for name in UNDECLARED:
        for k in range(count):
            plain = k % 4 == 3 and name not in NEEDS_DRIVE
            axis, mount = ('roll', 'rig') if plain else PLACES[k % 4]
            yield {
                'kind': 'undeclared', 'planted': (name,), 'axis': axis, 'mount': mount,
                'simulator': 'plain' if plain else 'virtual', 'module': name,
                'size': float(np.exp(rng.uniform(np.log(0.15), np.log(0.6)))),
            }


# ------------------------------------------------------------------------------- flying them


def flown(scenario: Scenario, *, unseen: bool) -> Record:
    """The record of the scenario's flight, or of the one that is kept for the judge."""
    seed = scenario.seed + (500_000 if unseen else 0)
    if scenario.simulator == 'plain':
        return _plain(scenario, seed, unseen=unseen)
    return record_of(flight_of(scenario, seed, unseen=unseen))


def without(scenario: Scenario) -> Scenario:
    """The scenario without its effects (traps stay)."""
    traps = {k: v for k, v in scenario.effects.items() if k == 'vibration'}
    return replace(scenario, effects=traps, module='')


def flight_of(
    scenario: Scenario, seed: int, *, unseen: bool, effect: EffectFunction | None = None
) -> Flight:
    """The flight on the virtual STM32's physics; `effect` as in effects_undeclared."""
    profile = _profile(scenario, unseen=unseen)
    plan = UNSEEN if unseen else PLAN
    schedule, end = schedule_of(scenario.axis, plan, seed)
    if scenario.stirred:
        profile = replace(profile, receiver=_sticks(scenario, seed, end))
    if scenario.module:
        index = AXES.index(scenario.axis)
        size = scenario.size * profile.airframe.inertia_kg_m2[index]
        effect = UNDECLARED[scenario.module].torque(index, size)
    return fly(profile, schedule, end, seed, effect=effect)


def _profile(scenario: Scenario, *, unseen: bool) -> Profile:
    profile = load_profile('plain')
    effects = profile.effects
    for name, settings in scenario.effects.items():
        entry = replace(getattr(effects, name), enabled=True)
        for key, value in settings.items():
            old = getattr(entry, key)
            spread = isinstance(old, tuple) and not isinstance(value, (tuple, list))
            given = tuple(value) if isinstance(value, list) else value
            entry = replace(entry, **{key: (value,) * 3 if spread else given})
        if name == 'step_event' and unseen:
            entry = replace(entry, time_s=0.0)  # what happened before has happened
        effects = replace(effects, **{name: entry})
    mounts, bandwidth = profile.airframe.mounts, scenario.torque_bandwidth_hz
    mounts = replace(
        mounts,
        rig=replace(mounts.rig, torque_noise_bandwidth_hz=bandwidth),
        hover=replace(mounts.hover, torque_noise_bandwidth_hz=bandwidth),
    )
    charge = scenario.start_charge - (0.25 if unseen and scenario.start_charge > 0.5 else 0.0)
    battery = replace(profile.airframe.battery, start_charge=charge)
    return replace(
        profile, mount=scenario.mount, axis=scenario.axis, effects=effects,
        airframe=replace(profile.airframe, mounts=mounts, battery=battery),
    )


def _sticks(scenario: Scenario, seed: int, end: float) -> Receiver:
    """A busy pilot: the other axes in hover, the throttle on the rig."""
    rng = np.random.default_rng([seed, 7])
    events: list[Event] = []
    time = 2.0
    others = [name for name in ('roll', 'pitch') if name != scenario.axis]
    while time < end:
        if scenario.mount == 'hover':
            channel = str(rng.choice([*others, 'yaw']))
            events.append(Event(time, channel, float(rng.uniform(-0.35, 0.35))))
        else:
            events.append(Event(time, 'throttle', float(rng.uniform(0.28, 0.6))))
        time += float(rng.uniform(0.2, 1.5 if scenario.mount == 'hover' else 5.0))
    return Receiver(tuple(events))


# ----------------------------------------------------------------- the second simulator

PLAIN = {'coulomb_friction': 0.2, 'quadratic_drag': 2.1, 'pendulum_stiffness': 0.9,
         'cubic_stiffness': 30.0, 'dead_zone': 6.0e-4}
"""What doubles the error there (rad/s² and so on)."""


def _simulator() -> ModuleType:
    """The simulator of the tests: plain Python, no line shared with the virtual STM32."""
    folder = str(Path(__file__).parents[1] / 'test')
    if folder not in sys.path:
        sys.path.append(folder)
    return importlib.import_module('flown_axis')


def _plain(scenario: Scenario, seed: int, *, unseen: bool) -> Record:
    plain = _simulator()
    axis = plain.Axis()
    for name, settings in scenario.effects.items():
        if name in PLAIN:
            axis = replace(axis, **_plain_effect(name, float(settings['strength'])))
    if scenario.module:
        axis = replace(axis, torque=plain_torque(scenario.module, scenario.size))
    plan = plain.Plan(
        seconds=72.0,
        segments=(('idle', 'none', 0.0, 1.0), ('train', 'prbs', 1.0, 41.0),
                  ('validation', 'prbs', 42.0, 72.0)),
    )
    if unseen:
        plan = plain.Plan(36.0, (('idle', 'none', 0.0, 1.0), ('validation', 'prbs', 1.0, 36.0)))
    return plain.fly(axis, seed, plan)


def _plain_effect(name: str, size: float) -> dict[str, Callable[[float, float, float], float]]:
    if name == 'dead_zone':
        return {'command': lambda _, u, __: np.sign(u) * max(abs(u) - size, 0.0)}
    torques: dict[str, Callable[[float, float, float], float]] = {
        'coulomb_friction': lambda _, w, __: -size * np.tanh(w / 1e-3),
        'quadratic_drag': lambda _, w, __: -size * w * abs(w),
        'pendulum_stiffness': lambda _, __, a: -size * np.sin(a),
        'cubic_stiffness': lambda _, __, a: -size * a**3,
    }
    return {'torque': torques[name]}
