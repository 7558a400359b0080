"""The aircraft that a separating flight is designed for: an identified model or the paper's.

Values and where they come from; nothing flies here.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.greybox.structure import Structure
from quad_sysid.loop.cascade import CascadeGains
from quad_sysid.model import AxisModel
from quad_sysid.pipeline.evaluate import structure_of

PAPER = {
    'roll': (434.5, 0.045, 0.008, 0.4, 0.3),
    'pitch': (419.0, 0.045, 0.008, 0.4, -0.2),
    'yaw': (24.6, 0.045, 0.008, 0.3, 0.04),
}
"""gain, lag, delay, damping, bias: the paper's airframe (1.2 kg, 940 g a motor) on its rig."""
PAPER_NOISE_RMS = 0.0048
"""rad/s, MPU-6050 at 42 Hz."""
PAPER_TORQUE_NOISE = 0.015
"""(rad/s²)/√Hz."""
PAPER_GYRO_HZ = 42.0
PAPER_DT = 0.004
THROTTLE = 0.35
"""Between rig and hover."""
VOLTS = 12.1
"""3 cells, charged, under load."""


@dataclass(frozen=True)
class Aircraft:
    """One axis: its model without the rivals, the loop around it and its noise."""

    axis: str
    theta: FloatArray
    """(p,) parameters of `structure`: base, then the effects that are no rivals."""
    gains: CascadeGains
    structure: Structure = field(default_factory=Structure)
    dt: float = PAPER_DT
    """Control cycle, s."""
    gyro_filter_hz: float | None = PAPER_GYRO_HZ
    realisation: str = 'continuous'
    noise_rms: float = PAPER_NOISE_RMS
    torque_noise: float = PAPER_TORQUE_NOISE
    battery_v: float = VOLTS
    throttle: float = THROTTLE
    told: str = "the paper's plant"
    """Where the values come from, for the user."""


def paper_aircraft(axis: str) -> Aircraft:
    """The paper's aircraft on its rig."""
    return Aircraft(axis, np.array(PAPER[axis]), CascadeGains.default(axis))


def aircraft_of(model: AxisModel, less: str, told: str) -> Aircraft:
    """An identified model less one effect (`less`; the whole base where it has none of the name).

    Raises BadInputError where the model names an effect that this version does not know.
    """
    structure, theta = structure_of(model)
    keep = np.ones(theta.size, dtype=bool)
    for effect, where in zip(structure.effects, structure.slices(), strict=True):
        if effect.name == less:
            keep[where] = False
    known = f'{model.axis}.rate.kp' in model.active_gains
    gains = (
        CascadeGains.from_mapping(model.active_gains, model.axis) if known
        else CascadeGains.default(model.axis)
    )
    if not theta[0] > 0.0:
        raise BadInputError(
            told, f'{model.axis} cannot be flown in a loop, its gain is not positive',
            f'{theta[0]:.4g}', 'check mixer and gyro, identify again',
        )
    return Aircraft(
        axis=model.axis, theta=theta[keep], gains=gains, structure=structure.without(less),
        dt=model.dt, gyro_filter_hz=model.gyro_filter_hz, realisation=model.realisation,
        noise_rms=model.noise_rms or PAPER_NOISE_RMS,
        torque_noise=PAPER_TORQUE_NOISE if model.torque_noise is None else model.torque_noise,
        battery_v=model.mean_battery_v or VOLTS, told=told,
    )


def effect_of(model: AxisModel, name: str) -> tuple[Structure, FloatArray] | None:
    """One effect of a model alone: structure of it and its parameters (q,); None without it."""
    structure, theta = structure_of(model)
    for effect, settings, where in zip(
        structure.effects, structure.settings, structure.slices(), strict=True
    ):
        if effect.name == name:
            return Structure((effect,), (settings,)), theta[where]
    return None
