"""Another autopilot's outputs as the motors of a craft: which output drives which motor. Pure.

By its parameters, as far as they are known, and by the description that the user gave. Where
nothing says where they are, its outputs are assumed to be the X frame of PX4 and ArduPilot and
put into the order of the contract's; the senses of rotation are then not known to be true.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from quad_bridge.craft import (
    RANGE_US,
    Craft,
    ardupilot_channels,
    ardupilot_range_us,
    of_ardupilot,
    of_px4,
)
from quad_bridge.link.parameters import ARDUPILOT, PX4, PX4_FIRST_MOTOR

X_ORDER = (1, 3, 0, 2)
"""Outputs of the X frame (front right, rear left, front left, rear right) that are the contract's
motors 1 to 4."""
REMEDY = "set robot_description to a URDF or a layout's name"


@dataclass(frozen=True)
class MotorOutputs:
    """The outputs that are motors."""

    craft: Craft | None = None
    """The airframe; None where unknown, and the contract's X frame is assumed."""
    channels: tuple[int, ...] = X_ORDER
    """Output (from 0) of each motor."""
    range_us: tuple[float, float] = RANGE_US
    """Pulses of the commands 0 and 1."""
    words: str = ''
    """The source of this assignment, for the log."""

    def efforts(self, pulses: tuple[int, ...]) -> list[float]:
        """Normalised command of each motor, 0..1, of all outputs' pulses, µs."""
        low, high = self.range_us
        row = [pulses[k] if k < len(pulses) else 0 for k in self.channels]
        return [min(max((pulse - low) / (high - low), 0.0), 1.0) for pulse in row]

    def ordered(self, values: tuple[float, ...]) -> list[float]:
        """Values per output, such as speeds, in the order of the motors; NaN where missing."""
        return [values[k] if k < len(values) else float('nan') for k in self.channels]


def motor_outputs(
    autopilot: int, name: str, parameters: Mapping[str, float], own: Craft | None = None
) -> MotorOutputs:
    """The motors by the autopilot's parameters; their places are those of `own`, if any.

    `autopilot` is its MAV_AUTOPILOT, `name` what messages call it.
    """
    craft: Craft | str = f'{name} does not say where its motors are'
    if own is not None:
        craft = own
    elif autopilot == PX4:
        craft = of_px4(parameters)
    elif autopilot == ARDUPILOT and 'FRAME_CLASS' in parameters:
        craft = of_ardupilot(parameters)
    if isinstance(craft, str):
        words = f"{craft}: its motors are taken for an X frame in this project's order; {REMEDY}"
        return MotorOutputs(words=words)
    channels, range_us = tuple(range(craft.count)), RANGE_US
    if autopilot == PX4:
        channels = px4_channels(parameters, craft.count)
    elif autopilot == ARDUPILOT:
        channels = tuple(k - 1 for k in ardupilot_channels(parameters, craft.count))
        range_us = ardupilot_range_us(parameters)
    words = f'the craft is {craft.name}, {craft.count} motors in their true places'
    return MotorOutputs(craft, channels, range_us, words)


def px4_channels(parameters: Mapping[str, float], count: int) -> tuple[int, ...]:
    """Output (from 0) of each motor by PWM_MAIN_FUNCn; in order where these do not name all."""
    named = {
        round(value) - PX4_FIRST_MOTOR: int(name.removeprefix('PWM_MAIN_FUNC')) - 1
        for name, value in parameters.items()
        if name.startswith('PWM_MAIN_FUNC')
    }
    is_complete = all(k in named for k in range(count))
    return tuple(named[k] if is_complete else k for k in range(count))
