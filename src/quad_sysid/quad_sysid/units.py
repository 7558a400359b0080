"""The units of the arrays that a record was made of: what comes in and goes out in them.

Inside everything is SI and a normalised command. Nothing is read or checked here; arrays.py does.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from quad_sysid.contract import FloatArray

POWERS = {'': 1, '²': 2, '³': 3}
RAD = re.compile(r'\(rad/s[²]?\)([²³]?)|rad([²³]?)(?=/|$)')
"""A motion in the unit of a parameter, and its power."""


@dataclass(frozen=True)
class Units:
    """Names of the units of an experiment's arrays, and what one of each is inside."""

    command: str = 'unit command'
    per_command: float = 1.0
    """Normalised command."""
    zero_command: float = 0.0
    """Normalised command where the array is 0."""
    rate: str = 'rad/s'
    per_rate: float = 1.0
    """rad/s (m/s of what slides)."""
    motion: str = 'rad'
    per_motion: float = 1.0
    """rad (m)."""

    def command_of(self, u: FloatArray) -> FloatArray:
        """Commands (n,) in their unit, normalised."""
        return self.per_command * u + self.zero_command

    def rate_of(self, y: FloatArray) -> FloatArray:
        """Rates (n,) in their unit, rad/s."""
        return self.per_rate * y

    def rate_in(self, rate: FloatArray) -> FloatArray:
        """Rates (n,), rad/s, in their unit."""
        return rate / self.per_rate

    def parameter(self, unit: str) -> tuple[str, float]:
        """The unit in which a parameter is shown, and how many of it one of `unit` is."""
        factor, powers = 1.0, 0
        for i, part in enumerate(unit.split(' per ')):
            way = 1 if i == 0 else -1
            powers += way * sum(POWERS[a or b] for a, b in RAD.findall(part))
            if part.endswith(('unit command', 'normalised command')):
                factor /= self.per_command**way
        name = unit.replace('rad', self.motion)
        for word in ('unit command', 'normalised command'):
            if self.command != Units.command:
                name = name.replace(word, self.command)
        return name, factor / self.per_motion**powers
