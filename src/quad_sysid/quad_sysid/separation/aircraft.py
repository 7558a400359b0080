"""The aircraft that a separating flight is designed for: an identified model or the paper's.

Values and where they come from; nothing flies here.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.estimate.stored import fitted_of, part_of
from quad_sysid.loop.cascade import CascadeGains
from quad_sysid.model import AxisModel, NoiseEstimate
from quad_sysid.model.effect import Part
from quad_sysid.model.plant import BASE

PAPER = {
    'roll': (434.5, 0.045, 0.008, 0.4, 0.3),
    'pitch': (419.0, 0.045, 0.008, 0.4, -0.2),
    'yaw': (24.6, 0.045, 0.008, 0.3, 0.04),
}
"""gain, lag, delay, damping, bias: the paper's airframe (1.2 kg, 940 g a motor) on its rig."""
PAPER_NOISE = NoiseEstimate(
    {'white': 1.5, 'disturbance': 0.5, 'correlation': 0.3, 'after': 0.1}, scale=0.002,
    degrees=1e4, gyro_rms=0.01, measured_rms=0.0048,
)
"""MPU-6050 behind 42 Hz; a torque noise of 0.015 (rad/s²)/√Hz, hardly any wind."""
PAPER_GYRO_HZ = 42.0
PAPER_DT = 0.004
THROTTLE = 0.35
"""Between rig and hover."""
VOLTS = 12.1
"""3 cells, charged, under load."""


@dataclass(frozen=True)
class Acting:
    """An effect of a certain strength: its physics and its parameters (p,) in their units."""

    part: Part
    p: FloatArray


@dataclass(frozen=True)
class Aircraft:
    """One axis: its model without the rivals, the loop around it and its noise."""

    axis: str
    theta: FloatArray
    """(5,) gain, lag, delay, damping, bias."""
    gains: CascadeGains
    acting: tuple[Acting, ...] = ()
    """The effects that are no rivals."""
    dt: float = PAPER_DT
    """Control cycle, s."""
    gyro_filter_hz: float | None = PAPER_GYRO_HZ
    noise: NoiseEstimate = field(default=PAPER_NOISE)
    battery_v: float = VOLTS
    throttle: float = THROTTLE
    told: str = "the paper's plant"
    """Where the values come from, for the user."""


def paper_aircraft(axis: str) -> Aircraft:
    """The paper's aircraft on its rig."""
    return Aircraft(axis, np.array(PAPER[axis]), CascadeGains.default(axis))


def aircraft_of(model: AxisModel, less: str, told: str) -> Aircraft:
    """An identified model less one effect (`less`; all of it where it has none of the name).

    Raises BadInputError where the model names an effect that this version does not know.
    """
    known = f'{model.axis}.rate.kp' in model.active_gains
    theta = np.array([model.value(spec.name) for spec in BASE])
    if not theta[0] > 0.0:
        raise BadInputError(
            told, f'{model.axis} cannot be flown in a loop, its gain is not positive',
            f'{theta[0]:.4g}', 'check mixer and gyro, identify again',
        )
    return Aircraft(
        axis=model.axis, theta=theta, acting=_acting(model, lambda name: name != less),
        gains=CascadeGains.from_mapping(model.active_gains, model.axis) if known
        else CascadeGains.default(model.axis),
        dt=model.dt, gyro_filter_hz=model.gyro_filter_hz, noise=model.noise or PAPER_NOISE,
        battery_v=model.mean_battery_v or VOLTS, told=told,
    )


def effect_of(model: AxisModel, name: str) -> Acting | None:
    """One effect of a model; None without it."""
    return next(iter(_acting(model, lambda own: own == name)), None)


def _acting(model: AxisModel, wanted) -> tuple[Acting, ...]:  # type: ignore[no-untyped-def]  # noqa: ANN001
    parts = [(part_of(model, e), e) for e in model.effects if wanted(e.name)]
    return tuple(Acting(part, fitted_of(part, e)) for part, e in parts)
