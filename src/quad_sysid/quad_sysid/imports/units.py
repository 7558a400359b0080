"""Units of foreign recordings → those of the contract, by the role of the column.

One table per role; a plain number is a factor, `FACTOR:OFFSET` adds an offset. No files.
"""

from __future__ import annotations

import csv
import io
import math
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.motion import GRAVITY

Role = Literal['time', 'control', 'motor', 'thrust', 'rate', 'angle', 'battery', 'acceleration',
               'speed', 'place']


@dataclass(frozen=True)
class Unit:
    """SI or normalised value = factor * value + offset."""

    name: str
    factor: float
    offset: float = 0.0

    @property
    def reversed(self) -> str:
        """The text of the unit that gives the opposite values."""
        return f'{-self.factor:.6g}' + (f':{-self.offset:.6g}' if self.offset else '')

    def __call__(self, values: FloatArray) -> FloatArray:
        """Convert values of any shape."""
        return self.factor * values + self.offset


@dataclass(frozen=True)
class Option:
    """An option of `quad-sysid import` that names columns of a table."""

    role: Role
    metavar: str = 'COL'
    help: str | None = None
    per_axis: bool = False
    """Whether it has a column for each axis."""
    several: bool = False
    """Whether it has several columns, of the axes or other ones."""
    span: tuple[float, float] | None = None
    """Range of a normalised command."""


OPTIONS = {
    'time': Option('time', help='s unless --unit says'),
    'control': Option('control', 'COLS', 'commands of the axes, -0.5..0.5', per_axis=True,
                      span=(-0.5, 0.5)),
    'thrust': Option('thrust', help='U1 beside --control, 0..1 (default 0.5)', span=(0.0, 1.0)),
    'motors': Option('motor', 'COL,COL,…', 'the motors, all of them, 0..1', several=True,
                     span=(0.0, 1.0)),
    'rate': Option('rate', 'COLS', 'measured rates, rad/s; else from --angle', per_axis=True),
    'angle': Option('angle', 'COLS', 'measured angles or positions, rad', per_axis=True),
    'reference': Option('angle', 'COLS', 'attitude set-points, rad', per_axis=True),
    'rate_reference': Option('rate', 'COLS', 'rate set-points, rad/s', per_axis=True),
    'battery': Option('battery', help='voltage of the pack, V'),
    'acceleration': Option('acceleration', 'X,Y,Z', 'specific force, m/s², of the body: it tells '
                           'whether z points up', several=True),
    'velocity': Option('speed', 'X,Y,Z', 'speed over the ground, m/s, ENU', several=True),
    'position': Option('place', 'X,Y,Z', 'place of the aircraft, m, ENU; without --velocity its '
                       'slope is the speed', several=True),
}
"""By the option's name, the time first."""


def flag(option: str) -> str:
    """An option as it is typed."""
    return f'--{option.replace("_", "-")}'


DEGREE = math.pi / 180.0

UNITS: dict[Role, dict[str, tuple[float, float]]] = {
    'time': {'s': (1.0, 0.0), 'ms': (1e-3, 0.0), 'us': (1e-6, 0.0), 'ns': (1e-9, 0.0)},
    'control': {
        '1': (1.0, 0.0), 'percent': (0.01, 0.0), 'pwm16': (1.0 / 65535.0, 0.0),
        'pulse_us': (1e-3, -1.5), 'V': (1.0 / 20.0, 0.0),  # of an analogue command, -10 V..10 V
    },
    'motor': {
        '1': (1.0, 0.0), 'percent': (0.01, 0.0), 'pwm16': (1.0 / 65535.0, 0.0),
        'pulse_us': (1e-3, -1.0), 'dshot': (1.0 / 1999.0, -48.0 / 1999.0),
    },
    'thrust': {'1': (1.0, 0.0), 'percent': (0.01, 0.0), 'pwm16': (1.0 / 65535.0, 0.0)},
    'rate': {
        'rad/s': (1.0, 0.0), 'deg/s': (DEGREE, 0.0), 'm/s': (1.0, 0.0), 'mm/s': (1e-3, 0.0),
    },
    'angle': {'rad': (1.0, 0.0), 'deg': (DEGREE, 0.0), 'm': (1.0, 0.0), 'mm': (1e-3, 0.0)},
    'battery': {'V': (1.0, 0.0), 'mV': (1e-3, 0.0)},
    'speed': {'m/s': (1.0, 0.0), 'mm/s': (1e-3, 0.0)},
    'place': {'m': (1.0, 0.0), 'mm': (1e-3, 0.0)},
    'acceleration': {'m/s2': (1.0, 0.0), 'g': (GRAVITY, 0.0), 'mg': (1e-3 * GRAVITY, 0.0)},
}
"""(factor, offset). The first unit of each role holds where none is named. `pulse_us` is a servo
pulse of 1000..2000 µs (a control column is centred at 1500), `pwm16` a duty of 0..65535."""


ALIASES = {
    'sec': 's', 'seconds': 's', 'msec': 'ms', 'µs': 'us', 'usec': 'us', 'μs': 'us',
    '°/s': 'deg/s', 'dps': 'deg/s', 'deg/sec': 'deg/s', 'degree/s': 'deg/s', 'rad/sec': 'rad/s',
    '°': 'deg', 'degree': 'deg', 'degrees': 'deg', 'radians': 'rad', '%': 'percent', 'v': 'V',
    'volt': 'V', 'volts': 'V', '-': '1', 'm/s²': 'm/s2', 'm/s^2': 'm/s2', 'm/s/s': 'm/s2',
    'm s-2': 'm/s2', 'gs': 'g', 'rads': 'rad', 'rad/second': 'rad/s', 'degs': 'deg',
    'microseconds': 'us', 'milliseconds': 'ms', 'nanoseconds': 'ns', 'nsec': 'ns', 'second': 's',
}
"""How headers write the units above, in small letters."""
BEYOND: Mapping[str, float] = {'pulse_us': 0.2, 'dshot': 0.03}
"""By the unit of a command: how far beyond the range, normalised, it is limited to it. Motors get
pulses of 900 µs while disarmed, and transmitters give some beyond 1000 to 2000."""
OF_PULSES: Mapping[str, str] = {'us': 'pulse_us'}
OF_ROLE: dict[Role, Mapping[str, str]] = {'motor': OF_PULSES, 'control': OF_PULSES}
"""Units that mean another one in columns of a role: a motor's microseconds are its pulse's."""
WRITTEN = {name.lower(): name for known in UNITS.values() for name in known} | ALIASES
IN_HEADER = re.compile(r'\s*[\[(]\s*([^\[\]()]*?)\s*[\])]\s*$')
"""`[deg/s]` or `(ms)` at the end of a column's name; an index such as `[0]` is not a unit."""

IN_NAME = re.compile(r'_(rad|deg|dps)(s|ps)?([^a-z]|$)')


def header_unit(column: str, role: Role | None = None) -> str | None:
    """The unit in brackets at the end of a column's name; None where there is none."""
    match = IN_HEADER.search(column)
    if match is None or not match[1] or match[1].isdigit():
        return None
    return written(match[1], role)


def unit_in_name(column: str, role: Role) -> str | None:
    """The unit of an angle or a rate in a name such as `gyro_x_dps`; None where there is none."""
    match = IN_NAME.search(column.lower()) if role in ('rate', 'angle') else None
    if match is None:
        return None
    angle = 'rad' if match[1] == 'rad' else 'deg'
    return f'{angle}/s' if role == 'rate' else angle


def written(text: str, role: Role | None = None) -> str:
    """The name of a unit that may be written otherwise; an unknown one as it stands."""
    name = WRITTEN.get(text.lower(), text)
    return OF_ROLE[role].get(name, name) if role in OF_ROLE else name


def bare(column: str) -> str:
    """A column's name without a known unit in brackets."""
    return IN_HEADER.sub('', column) if header_unit(column) in WRITTEN.values() else column


def columns_of(text: str) -> tuple[str, ...]:
    """The columns of an option, separated by commas; one with a comma stands in double quotes."""
    return tuple(next(csv.reader([text], skipinitialspace=True), []))


def as_typed(axes: Sequence[str], columns: Mapping[str, Sequence[str]],
             units: Mapping[str, str]) -> list[str]:
    """The words of a command line that import these columns, by option, with their units."""
    values = [('--axis', ','.join(axes))]
    for option, names in columns.items():
        text = names[0]
        if OPTIONS[option].per_axis or OPTIONS[option].several:
            out = io.StringIO()
            csv.writer(out, lineterminator='').writerow(names)
            text = out.getvalue()
        values.append((flag(option), text))
    values += [('--mixer', 'auto')] * ('motors' in columns)
    values += [('--unit', f'{column}={unit}') for column, unit in units.items()]
    return [word for name, text in values
            for word in ([f'{name}={text}'] if text.startswith('-') else [name, text])]


def unit_of(role: Role, text: str | None, column: str, likely: str = '') -> Unit:
    """Look up the unit of a column: `text`, else the unit of its header or name, else SI.

    Raises BadInputError naming what the role allows, and `likely` as an example.
    """
    units = UNITS[role]
    name = written(text, role) if text else (
        header_unit(column, role) or unit_in_name(column, role) or next(iter(units)))
    if name in units:
        return Unit(name, *units[name])
    allowed = f'use {", ".join(units)}, a factor or FACTOR:OFFSET'
    if not text:
        example = shlex.quote(f'{column}={likely or next(iter(units))}')
        raise BadInputError(f'column {column}', 'has no known unit in its brackets', repr(name),
                            f'{allowed}, such as --unit {example}')
    factor, colon, offset = name.partition(':')
    try:
        unit = Unit(name, float(factor), float(offset) if colon else 0.0)
    except ValueError:
        unit = Unit(name, math.nan)
    if not (math.isfinite(unit.factor) and math.isfinite(unit.offset) and unit.factor):
        raise BadInputError(f'--unit {column}', f'is not a unit of a {role}', repr(name), allowed)
    return unit
