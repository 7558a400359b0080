"""The axes that can be identified, a row of each: what drives it, its units, its experiment.

Roll, pitch and yaw turn; surge, sway and climb move, and their numbers stand where those of a
rotation do, metres for radians. Nothing is read or fitted here.
"""

from __future__ import annotations

from dataclasses import dataclass

from quad_sysid.craft import AXES
from quad_sysid.errors import BadInputError
from quad_sysid.units import Units

LEAN = Units(command='rad of lean', rate='m/s', motion='m')
THRUST = Units(rate='m/s', motion='m')


@dataclass(frozen=True)
class Axis:
    """One axis: its input is column `index` + 1 of AxisData.control."""

    name: str
    index: int
    """0 roll or surge, 1 pitch or sway, 2 yaw; -1 climb, whose input is U1."""
    others: tuple[str, str]
    """The two axes whose signals an effect may need."""
    units: Units | None = None
    """Of what moves; None: of a rotation, rad/s per normalised command."""
    excited_as: str = ''
    """The axis whose excitation also excites this one."""

    @property
    def turns(self) -> bool:
        """Whether it is a rotation."""
        return self.units is None


EVERY: dict[str, Axis] = {axis.name: axis for axis in (
    Axis('roll', 0, ('pitch', 'yaw')),
    Axis('pitch', 1, ('roll', 'yaw')),
    Axis('yaw', 2, ('roll', 'pitch')),
    Axis('surge', 0, ('sway', 'climb'), LEAN, 'pitch'),
    Axis('sway', 1, ('surge', 'climb'), LEAN, 'roll'),
    Axis('climb', -1, ('roll', 'pitch'), THRUST),
)}
ALL_WORDS = {'all': AXES, 'every': tuple(EVERY)}
"""What stands for several axes in a command."""


def axis_of(where: str, name: str) -> Axis:
    """The axis of this name; else BadInputError, naming `where`."""
    if name not in EVERY:
        raise BadInputError(where, f'axis must be one of {", ".join(EVERY)}', repr(name))
    return EVERY[name]


def units_of(name: str) -> Units | None:
    """The units of an axis that moves; None of one that turns, or has a name of its own."""
    return EVERY[name].units if name in EVERY else None
