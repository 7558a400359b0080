"""Simulated flights in closed loop: an aircraft with given effects, several excitations at once.

The aircraft is an identified model or the paper's, flown by the package loop.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from scipy.signal import lfilter

from quad_sysid.contract import AXES, FloatArray
from quad_sysid.craft import Craft, X
from quad_sysid.errors import BadInputError
from quad_sysid.loop.cascade import CascadeGains
from quad_sysid.loop.from_model import acting_effect
from quad_sysid.loop.plant import plant_like
from quad_sysid.loop.simulation import simulate_cascade
from quad_sysid.model import AxisModel, NoiseEstimate
from quad_sysid.model.data import SETTLE_S, AxisData
from quad_sysid.model.effect import ActingEffect, Signals, required
from quad_sysid.model.noise import sensor_of
from quad_sysid.model.structure import BASE, Structure
from quad_sysid.signals import schedule

PAPER = {'roll': (434.5, 0.045, 0.008, 0.4, 0.3), 'pitch': (419.0, 0.045, 0.008, 0.4, -0.2),
         'yaw': (24.6, 0.045, 0.008, 0.3, 0.04)}
"""gain, lag, delay, damping, bias: the paper's airframe (1.2 kg, 940 g per motor) on its rig."""
PAPER_NOISE = NoiseEstimate({'white': 1.5, 'disturbance': 0.5, 'correlation': 0.3, 'after': 0.1},
                            scale=0.002, degrees=1e4, gyro_rms=0.01, measured_rms=0.0048)
"""MPU-6050 with its 42 Hz filter; torque noise of 0.015 (rad/s²)/√Hz, hardly any wind."""
VOLTS = 12.1
"""3 cells, charged, under load."""
THROTTLE = 0.35
"""Of hover, where no flight says it."""


@dataclass(frozen=True)
class Aircraft:
    """One axis: its model without the rivals, the loop around it and its noise."""

    axis: str
    theta: FloatArray
    """(5,) gain, lag, delay, damping, bias."""
    gains: CascadeGains
    acting: tuple[ActingEffect, ...] = ()
    """The effects that are no rivals."""
    dt: float = 0.004
    """Control cycle, s."""
    gyro_filter_hz: float | None = 42.0
    noise: NoiseEstimate = field(default=PAPER_NOISE)
    battery_v: float = VOLTS
    throttle: float = THROTTLE
    craft: Craft = X
    source: str = "the paper's plant"
    """Origin of the values, in words for the user."""


def paper_aircraft(axis: str) -> Aircraft:
    """The paper's aircraft on its rig."""
    return Aircraft(axis, np.array(PAPER[axis]), CascadeGains.default(axis))


def aircraft_of(model: AxisModel, less: str, source: str) -> Aircraft:
    """The aircraft of an identified model, without the effect `less` if it has it.

    Raises BadInputError for an unknown effect or a gain that is not positive.
    """
    if model.law is not None:
        raise BadInputError('separate', 'flies the built-in base only', model.law.name,
                            'design_experiment takes a base of your own')
    has_gains = f'{model.axis}.rate.kp' in model.active_gains
    theta = np.array([model.value(spec.name) for spec in BASE])
    if not theta[0] > 0.0:
        raise BadInputError(source,
                            f'{model.axis} cannot be flown in a loop, its gain is not positive',
                            f'{theta[0]:.4g}', 'check mixer and gyro, identify again')
    return Aircraft(
        axis=model.axis, theta=theta,
        acting=tuple(acting_effect(model, e) for e in model.effects if e.name != less),
        gains=CascadeGains.from_mapping(model.active_gains, model.axis) if has_gains
        else CascadeGains.default(model.axis),
        dt=model.dt, gyro_filter_hz=model.gyro_filter_hz, noise=model.noise or PAPER_NOISE,
        battery_v=model.mean_battery_v or VOLTS, throttle=model.mean_throttle or THROTTLE,
        craft=model.craft, source=source,
    )


def effect_of(model: AxisModel, name: str) -> ActingEffect | None:
    """One effect of a model; None without it."""
    return next((acting_effect(model, e) for e in model.effects if e.name == name), None)


THROTTLE_STEP, THROTTLE_STEP_S = 0.1, 4.0
"""Size and time of the pilot's steps of the throttle, up and down."""
VOLTS_PER_S = 0.003
"""Discharge of a 4.5 Ah battery at half throttle."""
VOLTS_PER_THROTTLE = 1.4
"""Voltage drop over the battery's resistance at full throttle."""
PILOT_DEG = 8.0
"""Size of the other axes' motion where the pilot moves them."""
PILOT_HZ = (0.2, 0.5, 0.9, 1.4)
"""Its frequencies: what a pilot's hands do."""


@dataclass(frozen=True)
class Excitation:
    """A part of a schedule, what precedes it, and what the pilot does meanwhile."""

    part: schedule.Part
    throttle_steps: bool = False
    others_move: bool = False
    before: schedule.Part | None = None
    """A plain PRBS, where the part alone does not identify the base."""

    @property
    def parts(self) -> tuple[schedule.Part, ...]:
        """The training parts, in order."""
        return (self.part,) if self.before is None else (self.before, self.part)

    def added(self, dt: float) -> FloatArray:
        """(3, n) excitation of attitude (rad), rate (rad/s) and control, after a lead at rest."""
        pieces = [np.zeros((3, round(SETTLE_S / dt)))]
        for part in self.parts:
            piece = np.zeros((3, round(part.duration_s / dt)))
            row = ('attitude', 'rate', 'control').index(part.injection)
            piece[row] = [part.at(k * dt) for k in range(piece.shape[1])]
            pieces.append(piece)
        return np.concatenate(pieces, axis=1)


@dataclass(frozen=True)
class Flown:
    """A simulated flight; everything after the lead is training."""

    data: AxisData
    peak_angle: float
    """rad; infinite where the loop diverges."""

    @property
    def rate_rms(self) -> float:
        """rad/s."""
        return float(np.sqrt(np.mean(self.data.rate**2)))


def fly(aircraft: Aircraft, acting: Sequence[ActingEffect],
        excitations: Sequence[Excitation]) -> list[Flown]:
    """Each excitation simulated from rest with the effects `acting` and the aircraft's noise."""
    added = [e.added(aircraft.dt) for e in excitations]
    n = min(a.shape[1] for a in added)
    around = [_surroundings(aircraft, e, n) for e in excitations]
    return _flown(aircraft, acting, around, [a[:, :n] for a in added])


def _flown(aircraft: Aircraft, acting: Sequence[ActingEffect], around: Sequence[AxisData],
           added: Sequence[FloatArray]) -> list[Flown]:
    """Flights with what goes on around them, and the excitation (3, n) of each."""
    plant = plant_like(
        aircraft.axis, np.concatenate([aircraft.theta, *(e.p for e in acting)]), aircraft.dt,
        aircraft.gyro_filter_hz, craft=aircraft.craft,
        structure=Structure(tuple(effect.part for effect in acting)),
    )
    torque, gyro = _noise(aircraft, added[0].shape[1])
    reference, at_rate, at_control = np.stack(added, axis=1)
    run = simulate_cascade(
        [replace(plant, around=_known(data), steady=False) for data in around], aircraft.gains,
        reference, aircraft.dt, gyro, torque, rate_excitation=at_rate,
        control_excitation=at_control)
    flights = []
    for i, data in enumerate(around):
        control = data.control.copy()
        control[:, data.index + 1] = run.control[i]
        flights.append(Flown(
            replace(data, rate=run.rate[i], angle=run.angle[i], control=control,
                    motors=data.craft.commands(control)),
            float(np.nan_to_num(np.max(np.abs(run.angle[i])), nan=np.inf))))
    return flights


def _known(data: AxisData) -> Signals:
    """What is known of a flight before it is flown."""
    other_axes = [i + 1 for i in range(3) if i != data.index]
    return Signals.at_rest(
        data.clock + 0.5 * data.dt, data.control[:, 0], battery_v=data.battery_v,
        other_commands=tuple(data.control[:, other_axes].T), other_rates=tuple(data.other_rates.T),
        other_angles=tuple(required(data.other_angles).T),
    )


def _noise(aircraft: Aircraft, n: int) -> tuple[FloatArray, FloatArray]:
    """(n,) disturbing torque, rad/s², and (n,) noise of the measured rate, rad/s."""
    dt, noise, rng = aircraft.dt, aircraft.noise, np.random.default_rng(1)
    torque = noise.ratios['white'] * noise.gyro_rms / np.sqrt(dt) * rng.standard_normal(n)
    fade = np.exp(-dt / noise.correlation_s)
    gust = noise.disturbance_rms * np.sqrt(1.0 - fade**2) * rng.standard_normal(n)
    gyro = noise.gyro_rms * rng.standard_normal(n)
    after = noise.ratios['after'] * noise.gyro_rms * rng.standard_normal(n)
    step = sensor_of(aircraft.gyro_filter_hz, None, dt).step
    move, take = step[:, :2], step[:, 2:].sum(axis=1)
    state = np.zeros(2)
    for k in range(0 if aircraft.gyro_filter_hz is None else n):
        state = move @ state + take * gyro[k]
        gyro[k] = state[0] + after[k]
    return torque + lfilter([1.0], [1.0, -fade], gust), gyro


def _surroundings(aircraft: Aircraft, excitation: Excitation, n: int) -> AxisData:
    """The signals known before the flight: throttle, battery, other axes; no motion."""
    dt = aircraft.dt
    t = np.arange(n) * dt
    throttle = np.full(n, aircraft.throttle)
    if excitation.throttle_steps:
        throttle += np.where(np.floor(t / THROTTLE_STEP_S) % 2 == 0, -1.0, 1.0) * THROTTLE_STEP
    fall = VOLTS_PER_S * np.cumsum(throttle / 0.5) * dt
    control, rates = np.zeros((n, 4)), np.zeros((n, 2))
    control[:, 0] = throttle
    if excitation.others_move:
        for column, axis in enumerate(name for name in AXES if name != aircraft.axis):
            rates[:, column], control[:, AXES.index(axis) + 1] = _stirred(axis, dt, n)
    volts = aircraft.battery_v - (fall - fall[-1] / 2.0)
    return AxisData(axis=aircraft.axis, dt=dt, rate=np.zeros(n), angle=np.zeros(n),
                    control=control, motors=aircraft.craft.commands(control),
                    craft=aircraft.craft, other_rates=rates,
                    other_angles=np.cumsum(rates, axis=0) * dt,
                    battery_v=volts - VOLTS_PER_THROTTLE * (throttle - aircraft.throttle),
                    gyro_filter_hz=aircraft.gyro_filter_hz, stretches=((0, n),),
                    train=((round(SETTLE_S / dt), n),), validation=())


@lru_cache(maxsize=16)
def _stirred(axis: str, dt: float, n: int) -> tuple[FloatArray, FloatArray]:
    """Rate (rad/s) and command (n,) of another axis that the pilot moves."""
    t, phase = np.arange(n) * dt, AXES.index(axis)
    added = np.zeros((3, n))
    for i, f in enumerate(PILOT_HZ):
        added[0] += 0.5 * np.deg2rad(PILOT_DEG) * np.sin(
            2.0 * np.pi * (1.0 + 0.17 * phase) * f * t + i + phase
        )
    aircraft = Aircraft(axis, np.array(PAPER[axis]), CascadeGains.default(axis), dt=dt)
    still = _surroundings(aircraft, Excitation(schedule.Part('train', n * dt)), n)
    (flight,) = _flown(aircraft, (), [still], [added])
    return flight.data.rate, flight.data.command
