"""The axes that can be identified, a row of each: what drives it, its units, its experiment.

Roll, pitch and yaw turn; surge, sway and climb move, and their numbers stand where those of a
rotation do, metres for radians. Nothing is read or fitted here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from quad_sysid.craft import AXES
from quad_sysid.errors import BadInputError
from quad_sysid.units import Units

LEAN = Units(command='rad of lean', rate='m/s', motion='m')
THRUST = Units(rate='m/s', motion='m')


Level = tuple[float, float, float]
"""Amplitudes of rate, position and command of a motion."""


@dataclass(frozen=True)
class Trial:
    """The motion by which the loop of an axis is judged, rad and rad/s, or m and m/s."""

    step: float = math.radians(12.0)
    """Amplitude of the square wave of the reference."""
    half_period_s: float = 2.0
    push: float = 2.0
    """Size of the step of the acceleration that disturbs it."""
    push_s: float = 3.0
    gust_rad_s: float = 3.0
    """Corner frequency of what gusts do to it."""
    bands_rad_s: tuple[float, ...] = (4.0, 8.0, 16.0, 32.0, 64.0)
    """Centres of the octaves that are compared before and after."""
    wide: Level = (4.0, 0.35, 0.3)
    near_rest: Level = (0.3, 0.05, 0.03)
    crossover_rad_s: float = math.inf
    """Highest that a design may have, whatever the model says."""
    throttle: tuple[float, float] | None = None
    """Least and largest throttle of the loop, where its command is one."""


TURNING = Trial()
CLIMBING = Trial(0.4, 4.0, 1.0, 6.0, 1.0, (0.5, 1.0, 2.0, 4.0, 8.0), (0.8, 0.5, 0.1),
                 (0.1, 0.05, 0.02), crossover_rad_s=6.0, throttle=(0.1, 0.9))
"""Faster than 6 rad/s no autopilot closes this loop: the wash of the rotors on the barometer and
the shaking of the frame are in no model."""

SLIDING = Trial(1.0, 6.0, 0.5, 20.0, 0.5, (0.25, 0.5, 1.0, 2.0, 4.0), (1.0, 1.0, 0.15),
                (0.1, 0.1, 0.02))
"""Steps of a metre every 6 s, as an autopilot holds a position."""


@dataclass(frozen=True)
class Axis:
    """One axis: its input is column `index` + 1 of AxisData.control."""

    name: str
    index: int
    """0 roll or surge, 1 pitch or sway, 2 yaw; -1 climb, whose input is U1."""
    others: tuple[str, str]
    """The two axes whose signals an effect may need."""
    units: Units | None = None
    """Units of speed and command; None for a rotation: rad/s, normalised command."""
    excited_as: str = ''
    """The axis whose excitation also excites this one."""
    place: str = 'angle'
    """The quantity that its outer loop holds, by which the contract names its gains."""
    trial: Trial = TURNING
    outer: bool = False
    """Whether its loop is the user's own, around that of the lean: the firmware has none."""

    @property
    def turns(self) -> bool:
        """Whether it is a rotation."""
        return self.units is None


EVERY: dict[str, Axis] = {axis.name: axis for axis in (
    Axis('roll', 0, ('pitch', 'yaw')),
    Axis('pitch', 1, ('roll', 'yaw')),
    Axis('yaw', 2, ('roll', 'pitch')),
    Axis('surge', 0, ('sway', 'climb'), LEAN, 'pitch', 'position', SLIDING, outer=True),
    Axis('sway', 1, ('surge', 'climb'), LEAN, 'roll', 'position', SLIDING, outer=True),
    Axis('climb', -1, ('roll', 'pitch'), THRUST, place='height', trial=CLIMBING),
)}
ALL_WORDS = {'all': AXES, 'every': tuple(EVERY)}
"""Words of a command that stand for several axes."""
NAMES = (*EVERY, *ALL_WORDS)
"""Values of an option that names axes."""


def axes_in(words: str | Sequence[str]) -> tuple[str, ...]:
    """The axes that `roll,pitch` or `all`, or a list, names, each once; raises BadInputError."""
    names = words.split(',') if isinstance(words, str) else words
    for name in names:
        if name not in NAMES:
            raise BadInputError('--axis', f'must be one of {", ".join(NAMES)}', repr(name),
                                'several stand with commas between, as in roll,pitch')
    return tuple(dict.fromkeys(axis for name in names for axis in ALL_WORDS.get(name, (name,))))


def axis_of(where: str, name: str) -> Axis:
    """The axis of this name; else BadInputError, naming `where`."""
    if name not in EVERY:
        raise BadInputError(where, f'axis must be one of {", ".join(EVERY)}', repr(name))
    return EVERY[name]


def units_of(name: str) -> Units | None:
    """The units of an axis that moves; None of one that turns, or has a name of its own."""
    return EVERY[name].units if name in EVERY else None
