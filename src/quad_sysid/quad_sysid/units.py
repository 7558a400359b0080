"""The units of the arrays that a record was made of: what comes in and goes out in them.

Inside everything is SI and a normalised command. Nothing is read or checked here; arrays.py does.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from quad_sysid.contract import FloatArray

POWERS = {'': 1, '²': 2, '³': 3}
RAD = re.compile(r'(/?)(?:\(rad/s[²]?\)([²³]?)|rad([²³]?)(?=/|$))')
"""A motion in the unit of a parameter: whether it is divided by, and its power."""
LENGTHS = ('m', 'cm', 'mm')
SPOKEN = tuple((re.compile(pattern), word) for pattern, word in (
    (r'(torque|friction) / inertia', 'acceleration'), (r'\brate\b', 'speed'),
    (r'[Aa]ngular acceleration', 'acceleration'),
    (r'\brates\b', 'speeds'), (r'\bangle\b', 'position'), (r'\btorque\b', 'force'),
    (r'\bthe gyro\b', 'the sensor'), (r'\bgyro\b', 'sensor'), (r'\bturns?\b', 'moves'),
))
"""What a rotation's words are of a motion in metres."""
SMALLEST = 6
"""Most decimals of a number that is not written by a power of ten."""
COMMAND = 'unit command'
"""The unit of a command without one of its own."""
FACTOR = 'unit'
"""That of a command of which only the factor to a normalised one was given."""
SHARES = ('1', 'percent', 'pwm16', 'pulse_us')
"""Units that say what full command is."""


@dataclass(frozen=True)
class Units:
    """Names of the units of an experiment's arrays, and what one of each is inside."""

    command: str = COMMAND
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

    def command_in(self, command: FloatArray) -> FloatArray:
        """Normalised commands (n,), in their unit."""
        return (command - self.zero_command) / self.per_command

    def renamed(self, other: Units) -> tuple[float, float] | None:
        """(factor, offset) from a command normalised by these units to one by others.

        None where the two name different things, between which only the user knows the factor.
        """
        if self.command == other.command and self.command != FACTOR:
            factor = other.per_command / self.per_command
            return factor, other.zero_command - factor * self.zero_command
        return (1.0, 0.0) if self._normalises and other._normalises else None

    @property
    def _normalises(self) -> bool:
        """Whether a normalised command is the same share of full command in all such units."""
        return self.command in (*SHARES, FACTOR) or (
            self.command == COMMAND and self.per_command == 1.0)

    def signal_in(self, name: str, value: float) -> float:
        """A value of a signal, by its word, in the unit of its array."""
        offset, factor = {'rate': (0.0, self.per_rate), 'angle': (0.0, self.per_motion),
                          'command': (self.zero_command, self.per_command)}.get(name, (0.0, 1.0))
        return (value - offset) / factor

    def parameter(self, unit: str) -> tuple[str, float]:
        """The unit in which a parameter is shown, and how many of it one of `unit` is."""
        names, factor = list[str](), 1.0
        for i, part in enumerate(unit.split(' per ')):
            way = 1 if i == 0 else -1
            if part == 'rad/s' and i == 0:
                names, factor = [self.rate], 1.0 / self.per_rate
                continue
            factor /= self.per_motion**(way * sum(
                (-1 if over else 1) * POWERS[a or b] for over, a, b in RAD.findall(part)))
            name = part.replace('rad', self.motion)
            for word in (COMMAND, 'normalised command'):
                if part.endswith(word):
                    factor /= self.per_command**way
                    name = name if self.command == COMMAND else name.replace(word, self.command)
            names.append(name)
        return ' per '.join(names), factor


@dataclass(frozen=True)
class Scale:
    """A quantity in a picture: its label, and its values in the unit of the label."""

    label: str
    factor: float = 1.0
    zero: float = 0.0
    """The SI value at which the shown one is 0."""

    def __call__(self, values: FloatArray) -> FloatArray:
        """Values (n,) in SI, as they are shown."""
        return self.factor * (values - self.zero)


def scale(units: Units | None, name: str, unit: str) -> Scale:
    """The scale of a quantity of an axis, whose name and unit are those of a rotation in SI."""
    if unit == COMMAND:
        chosen = units or Units()
        plain = 'norm.' if chosen.per_command == 1.0 else '1'
        command_unit = plain if chosen.command == COMMAND else chosen.command
        return Scale(f'{in_units_of(units, name)}, {command_unit}', 1.0 / chosen.per_command,
                     chosen.zero_command)
    text, factor = unit_and_factor(units, unit)
    return Scale(f'{in_units_of(units, name)}, {text}', factor)


def unit_and_factor(units: Units | None, unit: str) -> tuple[str, float]:
    """The unit in which a number is shown, and how many of it one of `unit` is."""
    return (unit, 1.0) if units is None else units.parameter(unit)


def in_units_of(units: Units | None, text: str) -> str:
    """A text about an axis in the words of its motion."""
    if units is None or units.motion not in LENGTHS:
        return text
    for pattern, word in SPOKEN:
        text = pattern.sub(word, text)
    return text


def with_error(value: float, std: float) -> str:
    """Value and standard error as `458 ± 24`: two digits of the error, and the value to match."""
    digits = 1 - math.floor(math.log10(std)) if 0.0 < std < math.inf else SMALLEST + 1
    if digits > SMALLEST:
        return f'{value:.4g} ± {std:.2g}'
    return ' ± '.join(f'{round(n, digits) + 0.0:.{max(digits, 0)}f}' for n in (value, std))
