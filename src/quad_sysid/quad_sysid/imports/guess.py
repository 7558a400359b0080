"""What the columns of an unknown table are likely to be, and the command line that imports them.

Names give the role, names and sizes the unit. A guess is printed for the user to check; the import
compares the columns with each other and refuses a wrong one (plausible.py).
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from quad_sysid.contract import AXES, FloatArray
from quad_sysid.imports.plausible import HIGHEST_RATE_HZ, LOWEST_RATE_HZ, USUAL_RATE_HZ
from quad_sysid.imports.table import Table
from quad_sysid.imports.units import UNITS, header_unit


def _named(*parts: str) -> re.Pattern[str]:
    """Pattern for any of the parts; those of up to two letters only as whole words."""
    return re.compile('|'.join(
        part if len(part) > 2 else f'(?<![a-z]){part}(?![a-z])' for part in parts
    ), re.IGNORECASE)


TIME = _named('t', r'time', 'stamp', r'(?<![a-z])secs?(?![a-z])', 'ticks?')
WANTED = _named('set.?p', 'sp', r'(?<![a-z])des', 'ref', 'target', 'goal', 'cmd', '(?<![A-Z])_d$')
RATE = _named('gyro', 'rate', 'omega', 'ang(ular)?.?vel', 'p', 'q', 'r', '(?<![a-z])[gw][xyz]')
ANGLE = _named('roll', 'pitch', 'yaw', 'phi', 'theta', 'psi', 'angle', 'attitude', 'euler')
TORQUE = _named('torque', 'tau', 'moment', 'control', 'cmd', 'output', 'u', r'(?<![a-z])u[234]')
THRUST = _named('thrust', 'throttle', 'collective')
BATTERY = _named('v?bat', 'volt')
MOTOR = re.compile(
    r'^(?P<stem>.*?(?:motor|mot|esc|pwm|rotor|out|(?:^|[^a-z])m|servo)[^0-9]*)'
    r'(?P<number>\d+)(?P<rest>\D*)$', re.IGNORECASE)
AXIS_NAMES = (
    _named('roll', 'phi', 'p', '(?<![a-z])[gw]?x(?![a-z])', r'\[0\]'),
    _named('pitch', 'theta', 'q', '(?<![a-z])[gw]?y(?![a-z])', r'\[1\]'),
    _named('yaw', 'psi', 'heading', 'r', '(?<![a-z])[gw]?z(?![a-z])', r'\[2\]'),
)
GYRO = _named('gyro', 'p', 'q', 'r', '(?<![a-z])g[xyz]')
SMOOTH_TURN = 20.0
"""99 % quantile of a rate, rad/s, above which it is taken for deg/s."""


@dataclass(frozen=True)
class Guess:
    """Columns by role, and the units that are proposed for them."""

    table: Table
    time: str | None
    seconds: Mapping[str, FloatArray]
    """Times of each column, s."""
    axes: tuple[str, ...] = ()
    roles: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """`rate`, `angle`, `reference`, `control`, `motors`, `thrust`, `battery`."""
    reference_is: str = 'angle'
    units: Mapping[str, str] = field(default_factory=dict)

    def role_of(self, column: str) -> str:
        """The guess for one column, in words."""
        if column == self.time:
            return 'time'
        for role, names in self.roles.items():
            if column in names:
                axis = names.index(column)
                if role == 'motors':
                    return f'motor {axis + 1}'
                return role if role in ('thrust', 'battery') else f'{role}, {self.axes[axis]}'
        return '-'

    def command(self, file: Path) -> str | None:
        """The command line that imports the table; None without rates or commands."""
        roles = self.roles
        if not (roles.get('rate') or roles.get('angle')) or \
                not (roles.get('control') or roles.get('motors')):
            return None
        words = ['quad-sysid', 'import', str(file), '--axis', ','.join(self.axes)]
        if self.time is not None:
            words += ['--time', self.time]
        for role in ('motors', 'control', 'thrust', 'rate', 'angle', 'reference', 'battery'):
            if roles.get(role):
                words += [f'--{role}', ','.join(roles[role])]
                words += ['--mixer', 'auto'] if role == 'motors' else []
        if roles.get('reference') and self.reference_is == 'rate':
            words += ['--reference-is', 'rate']
        for column, unit in self.units.items():
            words += ['--unit', f'{column}={unit}']
        return shlex.join([*words, '--out', f'{file.name.partition(".")[0]}_bag'])


def guess(table: Table) -> Guess:
    """Guess from names and values of all columns."""
    time, unit = (None, '') if table.times else _time(table)
    units = {} if time is None or unit in ('', 's') else {time: unit}
    factor = UNITS['time'][unit or 's'][0]
    seconds: dict[str, FloatArray] = dict(table.times) or {
        name: factor * (table.columns[time] if time else np.arange(float(len(values))))
        for name, values in table.columns.items()
    }
    names = [n for n in table.columns if n != time and np.nanstd(table.columns[n]) > 0.0]
    roles: dict[str, tuple[str, ...]] = {}
    if motors := _motors(table, names):
        roles['motors'] = motors
        units |= {name: u for name in motors if (u := _motor_unit(table, motors)) != '1'}
    rest = [n for n in names if n not in motors]
    measured = [n for n in rest if not WANTED.search(n)]
    rates = _triples(measured, RATE)
    rates.sort(key=lambda t: not all(GYRO.search(n) for n in t))
    rate = rates[0] if rates else ()
    angles = _triples([n for n in measured if not RATE.search(n) or 'angle' in n.lower()], ANGLE)
    angle = next((t for t in angles if not rate or _same_axes(t, rate)), ())
    axes = tuple(a for a, name in zip(AXES, rate or angle, strict=True) if name) \
        if rate or angle else ()
    for role, triple in (('rate', rate), ('angle', angle)):
        if triple:
            roles[role] = tuple(n for n in triple if n)
            units |= {n: u for n in roles[role] if (u := _size_unit(table, n, role))}
    if not motors:
        _add_commands(table, rest, rate or angle, roles, units)
    reference_is = _add_references(table, rest, rate or angle, roles, units)
    taken = {n for group in roles.values() for n in group}
    if battery := [n for n in rest if BATTERY.search(n) and n not in taken]:
        roles['battery'] = (battery[0],)
        if np.nanmedian(table.columns[battery[0]]) > 1000.0:
            units[battery[0]] = 'mV'
    used = {n for group in roles.values() for n in group} | {time}
    return Guess(table, time, seconds, axes, roles, reference_is, {
        n: u for n, u in units.items() if n in used and header_unit(n) != u
    })


def _add_commands(
    table: Table, names: Sequence[str], measured: Sequence[str],
    roles: dict[str, tuple[str, ...]], units: dict[str, str],
) -> None:
    """Commands of the measured axes, and the thrust."""
    taken = {n for group in roles.values() for n in group}
    commands = [t for t in _triples([n for n in names if n not in taken], TORQUE)
                if _same_axes(t, measured)]
    if not commands:
        return
    roles['control'] = tuple(n for n in commands[0] if n)
    scale = _scale(table, commands[0])
    units |= dict.fromkeys(roles['control'], scale) if scale != '1' else {}
    thrust = next((n for n in names if THRUST.search(n) and n not in commands[0]), None)
    if thrust is not None and (high := float(np.nanmax(np.abs(table.columns[thrust])))) > 0.0:
        roles['thrust'] = (thrust,)
        if high > 1.0:
            units[thrust] = 'pwm16' if high > 2000.0 else f'{0.5 / high:.3g}'


def _add_references(
    table: Table, names: Sequence[str], measured: Sequence[str],
    roles: dict[str, tuple[str, ...]], units: dict[str, str],
) -> str:
    """References of the axes, and whether they are angles or rates."""
    taken = {n for group in roles.values() for n in group}
    wanted = [n for n in names if WANTED.search(n) and n not in taken]
    for kind, pattern in (('angle', ANGLE), ('rate', RATE)):
        for triple in _triples(wanted, pattern):
            if _same_axes(triple, measured):
                roles['reference'] = tuple(n for n in triple if n)
                units |= {n: u for n in roles['reference'] if (u := _size_unit(table, n, kind))}
                return kind
    return 'angle'


def lines(guessed: Guess, file: Path) -> Iterator[str]:
    """The table of columns, and what to type."""
    table = guessed.table
    width = min(34, max(len(n) for n in table.columns))
    yield f'{file}: {len(table.columns)} columns with numbers'
    yield ''
    yield f'{"column":<{width}} {"Hz":>7} {"lowest":>10} {"highest":>10}  guess'
    for name, values in table.columns.items():
        known = np.isfinite(values)
        steps = np.diff(np.asarray(guessed.seconds[name])[known])
        steps = steps[steps > 0.0]
        rate = f'{1.0 / np.median(steps):.4g}' if len(steps) else '-'
        unit = guessed.units.get(name) or header_unit(name)
        role = guessed.role_of(name) + (f' [{unit}]' if unit and guessed.role_of(name) != '-'
                                        else '')
        yield (f'{name:<{width}} {rate:>7} {np.nanmin(values):>10.4g} '
               f'{np.nanmax(values):>10.4g}  {role}')
    command = guessed.command(file)
    yield ''
    if command is None:
        yield 'rates and commands were not recognised: name them, see quad-sysid import --help'
    else:
        yield 'check the guesses, then:'
        yield command


def _time(table: Table) -> tuple[str | None, str]:
    """The column that increases with the rows, and its unit."""
    best: tuple[float, str] | None = None
    for name, values in table.columns.items():
        steps = np.diff(values[np.isfinite(values)])
        ahead = float(np.mean(steps > 0.0)) if len(steps) else 0.0
        worth = ahead + (1.0 if TIME.search(name) else 0.0)
        if ahead > 0.5 and (best is None or worth > best[0]):
            best = worth, name
    if best is None:
        return None, ''
    name = best[1]
    steps = np.diff(table.columns[name])
    step = float(np.median(steps[steps > 0.0]))
    written = header_unit(name)
    if written in UNITS['time']:
        return name, str(written)
    near = {
        unit: abs(np.log(1.0 / (factor * step) / USUAL_RATE_HZ))
        for unit, (factor, _) in UNITS['time'].items()
        if LOWEST_RATE_HZ <= 1.0 / (factor * step) <= HIGHEST_RATE_HZ
    }
    return name, min(near, key=near.__getitem__) if near else 's'


def _motors(table: Table, names: Sequence[str]) -> tuple[str, ...]:
    """The largest family of numbered columns that never go below zero."""
    families: dict[tuple[str, str], list[tuple[int, str]]] = {}
    for name in names:
        found = MOTOR.match(name)
        if found and np.nanmin(table.columns[name]) >= 0.0:
            families.setdefault((found['stem'], found['rest']), []).append(
                (int(found['number']), name))
    whole = [sorted(f) for f in families.values() if len(f) in (4, 6, 8)]
    return tuple(name for _, name in max(whole, key=len)) if whole else ()


def _motor_unit(table: Table, motors: Sequence[str]) -> str:
    high = max(float(np.nanmax(table.columns[n])) for n in motors)
    flying = np.median([np.nanmedian(table.columns[n]) for n in motors])
    if high <= 1.0:
        return '1'
    if high <= 100.0:
        return 'percent'
    if high <= 2200.0:
        return 'pulse_us' if flying >= 900.0 else 'dshot'
    return 'pwm16'


def _triples(names: Sequence[str], pattern: re.Pattern[str]) -> list[tuple[str, str, str]]:
    """Columns of the three axes that differ in the axis' name only; '' where one is missing."""
    groups: dict[str, list[str]] = {}
    for name in names:
        if not pattern.search(name):
            continue
        bare = name.rpartition('.')[2] if pattern.search(name.rpartition('.')[2]) or \
            any(a.search(name.rpartition('.')[2]) for a in AXIS_NAMES) else name
        for i, axis in enumerate(AXIS_NAMES):
            found = list(axis.finditer(bare))
            if found:
                last = found[-1]
                at = len(name) - len(bare)
                stem = name[:at] + bare[:last.start()] + '*' + bare[last.end():]
                groups.setdefault(stem, ['', '', ''])[i] = name
                break
    whole = [(a, b, c) for a, b, c in groups.values()]
    return sorted(whole, key=lambda g: -sum(map(bool, g)))


def _same_axes(triple: Sequence[str], other: Sequence[str]) -> bool:
    return [bool(n) for n in triple] == [bool(n) for n in other]


def _size_unit(table: Table, name: str, kind: str) -> str:
    """`deg` or `deg/s` where the name or the size says so; else nothing."""
    unit = 'deg' if kind == 'angle' else 'deg/s'
    if header_unit(name) is not None:
        return ''
    lower = name.lower()
    if re.search(r'_(deg|dps|degs)([^a-z]|$)', lower):
        return unit
    if re.search(r'_rad(s|ps)?([^a-z]|$)', lower):
        return ''
    size = float(np.nanquantile(np.abs(table.columns[name]), 0.99))
    return unit if size > (2.0 * np.pi if kind == 'angle' else SMOOTH_TURN) else ''


def _scale(table: Table, names: Sequence[str]) -> str:
    """Unit of commands that brings them within half of the whole range, a power of ten if any."""
    high = max(float(np.nanmax(np.abs(table.columns[n]))) for n in names if n)
    if high > 2000.0:
        return 'pwm16'
    return f'{10.0 ** np.floor(np.log10(0.5 / high)):g}' if not 0.02 < high <= 0.5 else '1'
