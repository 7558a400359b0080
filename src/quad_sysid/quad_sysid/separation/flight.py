"""One simulated flight: an aircraft with a given effect, an excitation, what happens around it.

Free of noise: what is compared is the mean of what real flights would show. The noise enters when
the comparison is weighed (measure.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from quad_sysid.contract import AXES, FloatArray, motors_from_wrench
from quad_sysid.greybox import drive
from quad_sysid.greybox.data import AxisData
from quad_sysid.greybox.structure import Structure, Term
from quad_sysid.loop.cascade import CascadeGains, derivative_weight
from quad_sysid.loop.kernels import Constants
from quad_sysid.separation import kernels
from quad_sysid.separation.aircraft import PAPER, Aircraft
from quad_sysid.separation.stages import stages_of
from quad_sysid.signals.schedule import Part

LEAD_S = 1.0
"""At rest before the excitation."""
THROTTLE_STEP = 0.1
THROTTLE_STEP_S = 4.0
VOLTS_PER_S = 0.003
"""Fall of a 4.5 Ah pack at half throttle."""
VOLTS_PER_THROTTLE = 1.4
"""Drop over the pack's resistance at full throttle."""
PILOT_DEG = 8.0
"""Size of the other axes' motion where the pilot stirs them."""
PILOT_HZ = (0.2, 0.5, 0.9, 1.4)


@dataclass(frozen=True)
class Excitation:
    """A part of a schedule, what is flown before it, and what the pilot does besides."""

    part: Part
    throttle_steps: bool = False
    others_move: bool = False
    before: Part | None = None
    """A plain PRBS where the part alone would not tell the base."""

    @property
    def parts(self) -> tuple[Part, ...]:
        """What trains, in order."""
        return (self.part,) if self.before is None else (self.before, self.part)


@dataclass(frozen=True)
class Flown:
    """A simulated flight; training is all of it behind the lead."""

    data: AxisData
    peak_angle: float
    """rad."""

    @property
    def rate_rms(self) -> float:
        """rad/s."""
        return float(np.sqrt(np.mean(self.data.rate**2)))


def surroundings(aircraft: Aircraft, excitation: Excitation, n: int) -> AxisData:
    """Everything that is known before the flight: throttle, battery, the other axes. No motion."""
    dt = aircraft.dt
    t = np.arange(n) * dt
    throttle = np.full(n, aircraft.throttle)
    if excitation.throttle_steps:
        throttle += np.where(np.floor(t / THROTTLE_STEP_S) % 2 == 0, -1.0, 1.0) * THROTTLE_STEP
    fall = VOLTS_PER_S * np.cumsum(throttle / 0.5) * dt
    control = np.zeros((n, 4))
    control[:, 0] = throttle
    rates = np.zeros((n, 2))
    others = [axis for axis in AXES if axis != aircraft.axis]
    if excitation.others_move:
        for column, axis in enumerate(others):
            rate, command = _stirred(axis, dt, n, AXES.index(axis))
            rates[:, column] = rate
            control[:, AXES.index(axis) + 1] = command
    volts = aircraft.battery_v - (fall - fall[-1] / 2.0)
    return AxisData(
        axis=aircraft.axis, dt=dt, rate=np.zeros(n), angle=np.zeros(n), control=control,
        motors=motors_from_wrench(control), other_rates=rates,
        battery_v=volts - VOLTS_PER_THROTTLE * (throttle - aircraft.throttle),
        gyro_filter_hz=aircraft.gyro_filter_hz, stretches=((0, n),),
        train=((round(LEAD_S / dt), n),), validation=(), realisation=aircraft.realisation,
    )


@lru_cache(maxsize=16)
def _stirred(axis: str, dt: float, n: int, phase: int) -> tuple[FloatArray, FloatArray]:
    """Rate and command (n,) of another axis that the pilot moves."""
    t = np.arange(n) * dt
    reference = sum(
        np.sin(2.0 * np.pi * (1.0 + 0.17 * phase) * f * t + i + phase)
        for i, f in enumerate(PILOT_HZ)
    ) * np.deg2rad(PILOT_DEG) / 2.0
    own = Aircraft(axis, np.array(PAPER[axis]), CascadeGains.default(axis), dt=dt)
    out = _run(own, Structure(), own.theta, _still(own, n), np.stack([reference, 0 * t, 0 * t]))
    return out[1], out[2]


def _still(aircraft: Aircraft, n: int) -> AxisData:
    """Surroundings in which nothing happens."""
    zero = np.zeros(n)
    return AxisData(
        axis=aircraft.axis, dt=aircraft.dt, rate=zero, angle=zero, control=np.zeros((n, 4)),
        motors=np.zeros((n, 4)), other_rates=np.zeros((n, 2)), battery_v=None,
        gyro_filter_hz=aircraft.gyro_filter_hz, stretches=((0, n),), train=((0, n),),
        validation=(), realisation=aircraft.realisation,
    )


def fly(
    aircraft: Aircraft, structure: Structure, theta: FloatArray, excitation: Excitation
) -> Flown:
    """The aircraft with `structure` and its parameters (p,) in its loop, from rest."""
    dt = aircraft.dt
    lead = round(LEAD_S / dt)
    pieces = [np.zeros((3, lead))]
    for part in excitation.parts:
        piece = np.zeros((3, round(part.duration_s / dt)))
        row = ('attitude', 'rate', 'control').index(part.injection)
        piece[row] = [part.at(k * dt) for k in range(piece.shape[1])]
        pieces.append(piece)
    added = np.concatenate(pieces, axis=1)
    n = added.shape[1]
    around = surroundings(aircraft, excitation, n)
    angle, rate, command, _ = _run(aircraft, structure, theta, around, added)
    control = around.control.copy()
    control[:, around.index + 1] = command
    data = AxisData(
        axis=aircraft.axis, dt=dt, rate=rate, angle=angle, control=control,
        motors=motors_from_wrench(control), other_rates=around.other_rates,
        battery_v=around.battery_v, gyro_filter_hz=around.gyro_filter_hz,
        stretches=around.stretches, train=around.train, validation=(),
        realisation=aircraft.realisation, reference=added[0],
    )
    return Flown(data, float(np.max(np.abs(angle))))


def _run(
    aircraft: Aircraft, structure: Structure, theta: FloatArray, around: AxisData,
    added: FloatArray,
) -> FloatArray:
    """(4, n) angle, rate, control, rate reference."""
    g, dt = aircraft.gains, aircraft.dt
    delay = float(theta[2])
    if aircraft.realisation == 'stepped':
        delay = max(0.0, delay - 0.5 * drive.SUBSTEP_S)
    exact = drive.steps(float(theta[1]), delay, dt)
    filtered = aircraft.gyro_filter_hz is not None
    out = np.zeros((4, added.shape[1]))
    kernels.fly(
        Constants(
            angle_kp=g.angle_kp, rate_kp=g.rate_kp, rate_ki=g.rate_ki, rate_kd=g.rate_kd,
            d_weight=float(derivative_weight(g.d_filter_hz, dt)), output_limit=g.output_limit,
            rate_limit=g.rate_limit, integrator_limit=g.integrator_limit, dt=dt,
        ),
        added, exact.whole, exact.matrices, exact.inputs, exact.pattern,
        drive.gyro_step(aircraft.gyro_filter_hz, dt, aircraft.realisation), filtered,
        (float(theta[0]), float(theta[3]), float(theta[4])),
        torques_of(structure, theta, around), stages_of(structure, theta, around), out,
    )
    return out


def torques_of(
    structure: Structure, theta: FloatArray, data: AxisData
) -> tuple[np.ndarray, FloatArray, FloatArray]:
    """Codes (m,), values (m, q) and signals (m, n) of the effects' torques."""
    terms: list[Term] = [
        effect.torque(data, theta[where], settings)
        for effect, settings, where in zip(
            structure.effects, structure.settings, structure.slices(), strict=True
        )
        if effect.torque is not None
    ]
    values = np.zeros((len(terms), max((len(t.values) for t in terms), default=1)))
    signals = np.zeros((len(terms), data.rate.size))
    for i, term in enumerate(terms):
        values[i, : len(term.values)] = term.values
        if term.signal is not None:
            signals[i] = term.signal
    return np.array([t.code for t in terms], dtype=np.int64), values, signals


__all__ = ['LEAD_S', 'Excitation', 'Flown', 'fly', 'surroundings', 'torques_of']
