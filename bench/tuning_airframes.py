"""The airframes that bench/tuning.py tunes: drawn from one seed, flown, and identified.

Each is drawn around the paper's aircraft, flown with the paper's gains, and identified from that
flight alone by the same calls as the identification node's, black-box models left out (no gain
comes from them). What was drawn is known to the judge (`truth`) and not to the analysis.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from threadpoolctl import threadpool_limits
from virtual_flights import AMPLITUDE, PLAN, RATE_HZ, START_S, record_of, schedule_of

from quad_bridge.virtual.plant import axis_gains
from quad_bridge.virtual.profile import FirmwareSettings, Profile, load_profile
from quad_bridge.virtual.receiver import Event, Receiver
from quad_bridge.virtual.simulation import Excited, Flight, fly
from quad_sysid.contract import AXES
from quad_sysid.errors import NotInformativeError
from quad_sysid.estimate.stored import estimate_of
from quad_sysid.model import AxisModel, EffectEstimate, Parameter
from quad_sysid.model.data import axis_data
from quad_sysid.pipeline.assemble import Support, axis_model
from quad_sysid.pipeline.blackbox_part import io_data
from quad_sysid.pipeline.identify import Options, findings_of
from quad_sysid.record import Record

HALF_PERIOD_S = 2.0
PERIODS = 5
PLACES = tuple((axis, mount) for axis in ('roll', 'pitch') for mount in ('rig', 'hover'))
Settings = Mapping[str, object]


def longest_delay() -> int:
    """Four cycles, or what the virtual firmware's queue holds."""
    try:
        FirmwareSettings(delay_cycles=4)
    except ValueError:
        return 3
    return 4


@dataclass(frozen=True)
class Airframe:
    """One drawn aircraft, the axis that is tuned, and its one effect (or none)."""

    number: int
    seed: int
    axis: str
    mount: str
    inertia: float
    """Share of the paper's aircraft's."""
    thrust: float
    lag_s: float
    delay_cycles: int
    effect: str = ''
    settings: Settings = field(default_factory=dict)

    @property
    def stirred(self) -> bool:
        """Whether the pilot moves the throttle, without which some effects do not show."""
        return self.effect in ('battery_sag', 'thrust_curve')


SIZES: dict[str, tuple[str, float, float]] = {
    'coulomb_friction': ('torque_nm', 0.12, 0.8),
    'quadratic_drag': ('coefficient_nm_s2', 0.3, 2.0),
    'pendulum_stiffness': ('stiffness_nm_rad', 0.5, 8.0),
    'cubic_stiffness': ('stiffness_nm_rad3', 15.0, 150.0),
    'dead_zone': ('half_width', 3e-4, 3e-3),
    'backlash': ('half_width', 5e-4, 2e-3),
    'motor_lag': ('slow_time_constant_s', 1.3, 2.2),
    'resonance': ('peak', 0.08, 0.5),
    'periodic_disturbance': ('amplitude_nm', 0.1, 0.8),
    'step_event': ('gain_change', 0.08, 0.25),
    'battery_sag': ('exponent', 0.5, 1.5),
    'thrust_curve': ('curvature', 0.1, 0.5),
}
"""Effect: the key of its strength and the range it is drawn from, log-uniform; torques per inertia
(rad/s² and so on), the slow motor's lag as a multiple of the others'."""
TORQUES = ('coulomb_friction', 'quadratic_drag', 'pendulum_stiffness', 'cubic_stiffness',
           'periodic_disturbance')  # fmt: skip


def draw(count: int, first_seed: int) -> list[Airframe]:
    """`count` airframes; every second has an effect."""
    rng = np.random.default_rng(first_seed)
    out = []
    names = sorted(SIZES)
    for number in range(count):
        axis, mount = PLACES[(number // 2) % len(PLACES)]
        inertia, thrust = float(rng.uniform(0.6, 1.4)), float(rng.uniform(0.8, 1.2))
        lag = float(rng.uniform(0.02, 0.09))
        delay = int(rng.integers(1, longest_delay() + 1))
        effect = names[(number // 2) % len(names)] if number % 2 else ''
        if effect == 'thrust_curve':
            mount = 'rig'  # a pilot who holds height does not move the throttle
        settings: dict[str, object] = {}
        if effect:
            settings = _settings(rng, effect, axis, inertia, lag)
        out.append(
            Airframe(number, first_seed + number, axis, mount, inertia, thrust, lag, delay,
                     effect, settings)
        )  # fmt: skip
    return out


def _settings(
    rng: np.random.Generator, effect: str, axis: str, inertia: float, lag: float
) -> dict[str, object]:
    key, low, high = SIZES[effect]
    size = float(np.exp(rng.uniform(np.log(low), np.log(high))))
    if effect in TORQUES:
        size *= inertia * load_profile('plain').airframe.inertia_kg_m2[AXES.index(axis)]
    settings: dict[str, object] = {key: size}
    if effect == 'motor_lag':
        settings = {key: size * lag, 'motors': (int(rng.integers(1, 5)),)}
    if effect == 'resonance':
        settings['frequency_hz'] = float(np.exp(rng.uniform(np.log(3.0), np.log(10.0))))
        settings['damping_ratio'] = float(rng.uniform(0.03, 0.1))
    if effect == 'periodic_disturbance':
        settings['frequency_hz'] = float(np.exp(rng.uniform(np.log(0.4), np.log(5.0))))
    if effect == 'step_event':
        settings = {
            key: size * float(rng.choice([-1.0, 1.0])), 'time_s': float(rng.uniform(12.0, 34.0)),
            'torque_nm': 0.0,
        }  # fmt: skip
    if effect == 'pendulum_stiffness' and rng.random() < 0.25:
        settings[key] = -0.25 * size
    return settings


# ------------------------------------------------------------------------------- flying them


def profile_of(airframe: Airframe, *, later: bool) -> Profile:
    """The virtual aircraft; `later`: the flight after the identification's."""
    profile = load_profile('plain')
    body = profile.airframe
    motors = replace(
        body.motors, lag_s=airframe.lag_s,
        full_thrust_n=body.motors.full_thrust_n * airframe.thrust,
    )  # fmt: skip
    a, b, c = (airframe.inertia * value for value in body.inertia_kg_m2)
    battery = replace(body.battery, start_charge=0.8 if later else 0.95)
    effects = profile.effects
    if airframe.effect:
        entry = replace(getattr(effects, airframe.effect), enabled=True)
        for key, value in airframe.settings.items():
            spread = isinstance(getattr(entry, key), tuple) and not isinstance(value, tuple)
            entry = replace(entry, **{key: (value,) * 3 if spread else value})
        if airframe.effect == 'step_event' and later:
            entry = replace(entry, time_s=0.0)  # what happened has happened
        effects = replace(effects, **{airframe.effect: entry})
    return replace(
        profile, mount=airframe.mount, axis=airframe.axis, effects=effects,
        firmware=replace(profile.firmware, delay_cycles=airframe.delay_cycles),
        airframe=replace(body, motors=motors, inertia_kg_m2=(a, b, c), battery=battery),
    )


def first_flight(airframe: Airframe) -> Record:
    """The flight that is identified, with the paper's gains."""
    schedule, time = schedule_of(airframe.axis, PLAN, airframe.seed)
    profile = profile_of(airframe, later=False)
    if airframe.stirred and airframe.mount == 'rig':
        rng = np.random.default_rng([airframe.seed, 7])
        events, at = [], 2.0
        while at < time:
            events.append(Event(at, 'throttle', float(rng.uniform(0.28, 0.6))))
            at += float(rng.uniform(0.3, 4.0))
        profile = replace(profile, receiver=Receiver(tuple(events)))
    return record_of(fly(profile, schedule, time, airframe.seed))


def second_flight(airframe: Airframe, gains: Mapping[str, float], number: int = 0) -> Flight:
    """A square wave with these gains (contract's names) in the full nonlinear simulation."""
    half = round(HALF_PERIOD_S * RATE_HZ)
    samples = AMPLITUDE * np.where((np.arange(2 * PERIODS * half) // half) % 2 == 0, 1.0, -1.0)
    part = Excited(START_S, samples, airframe.axis, 'attitude', 'validation', 'square')
    end = START_S + samples.size / RATE_HZ
    seed = airframe.seed + 700_000 + number
    return fly(profile_of(airframe, later=True), [part], end, seed, gains=gains)


# ------------------------------------------------------------------------- identifying them


def identified(record: Record, axis: str) -> AxisModel | str:
    """The completed model as the identification hands it to a designer, or why there is none."""
    with threadpool_limits(limits=1):
        try:
            told = findings_of(axis_data([record], axis), Options())
        except NotInformativeError as error:
            return str(error)
        if told.verdict.verdict == 'cannot_tell':
            return told.verdict.reason
        band = Support.of(io_data(told.data, told.data.train), axis).band
        return axis_model(told, dict(record.gains[0].values), band)


# -------------------------------------------------------------------------------- the truth


def truth(airframe: Airframe, model: AxisModel) -> AxisModel:
    """The model as it would be with the drawn parameters instead of estimated ones.

    Effects that have no place in one axis' loop are left out, as the design would leave them.
    """
    index = AXES.index(airframe.axis)
    profile = profile_of(airframe, later=True)
    body = profile.airframe
    around = body.mounts.rig if airframe.mount == 'rig' else body.mounts.hover
    inertia = body.inertia_kg_m2[index]
    gain = float(axis_gains(body)[index])
    if airframe.effect == 'step_event':
        gain *= 1.0 + float(airframe.settings['gain_change'])
    if airframe.effect == 'thrust_curve':
        curvature = float(airframe.settings['curvature'])
        hover = body.mass_kg * 9.80665 / (4.0 * body.motors.full_thrust_n)
        gain *= 1.0 - curvature + 2.0 * curvature * _throttle(curvature, hover)
    if airframe.effect == 'battery_sag':
        gain *= (11.6 / 11.1) ** float(airframe.settings['exponent'])
    base = (
        Parameter('gain', gain, 0.0, 'rad/s²'),
        Parameter('lag', airframe.lag_s, 0.0, 's'),
        Parameter('delay', airframe.delay_cycles / RATE_HZ, 0.0, 's'),
        Parameter('damping', around.damping_per_s[index], 0.0, '1/s'),
        Parameter('bias', around.bias_torque_nm[index] / inertia, 0.0, 'rad/s²'),
    )
    names = tuple(p.name for p in base)
    return replace(
        model, base=base, effects=_true_effects(airframe, inertia), parameter_names=names,
        covariance=np.zeros((5, 5)), trusted_band_rad_s=None,
        active_gains=model.active_gains,
    )


def _throttle(curvature: float, thrust: float) -> float:
    """Command whose thrust, as a share of the full one, is `thrust`."""
    root = np.sqrt((1.0 - curvature) ** 2 + 4.0 * curvature * thrust)
    return float((root - (1.0 - curvature)) / (2.0 * curvature))


def _true_effects(airframe: Airframe, inertia: float) -> tuple[EffectEstimate, ...]:
    name, values = airframe.effect, airframe.settings
    if name in TORQUES[:-1]:  # a periodic torque has no place in the loop
        fitted = [float(values[SIZES[name][0]]) / inertia]
    elif name in ('dead_zone', 'backlash'):
        fitted = [float(values['half_width'])]
    elif name == 'motor_lag':
        fitted = [float(values['slow_time_constant_s']), 0.25]
    elif name == 'resonance':
        damping, peak = float(values['damping_ratio']), float(values['peak'])
        fitted = [float(values['frequency_hz']), damping, 0.0, 2.0 * damping * peak]
    else:
        return ()
    return (estimate_of(name, fitted, std=0.0),)
