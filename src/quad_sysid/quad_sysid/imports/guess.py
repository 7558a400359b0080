"""What the columns of an unknown table are likely to be, and the command line that imports them.

Names give the role, names and sizes the unit. A guess is printed for the user to check; the import
compares the columns with each other and refuses a wrong one (plausible.py).
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from quad_sysid.contract import AXES
from quad_sysid.imports.plausible import time_unit
from quad_sysid.imports.table import Table
from quad_sysid.imports.units import OPTIONS, UNITS, Role, bare, flag, header_unit, unit_of
from quad_sysid.report.tables import Table as Text
from quad_sysid.report.tables import wrapped
from quad_sysid.report.words import number


def _named(*parts: str) -> re.Pattern[str]:
    """Pattern for any of the parts; those of up to two letters only as whole words."""
    return re.compile('|'.join(
        part if len(part) > 2 else f'(?<![a-z]){part}(?![a-z])' for part in parts
    ), re.IGNORECASE)


TIME = _named('t', r'time', 'stamp', r'(?<![a-z])secs?(?![a-z])', 'ticks?')
WANTED = _named('set.?p', 'sp', r'(?<![a-z])des', 'ref', 'target', 'goal', 'cmd', '(?<![A-Z])_d$')
RATE = _named('gyro', 'rate', 'omega', 'ang(ular)?.?vel', 'p', 'q', 'r', '(?<![a-z])[gw][xyz]',
              '(rad|deg|°)/s', 'dps')
GYRO = _named('gyro', 'p', 'q', 'r', '(?<![a-z])g[xyz]')
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
SMOOTH_TURN = 20.0
"""99 % quantile of a rate, rad/s, above which it is taken for deg/s."""
RISING = 0.95
"""Least share of the steps of a time that rise; of one by its name, that do not fall."""
FAST_HZ, GRID_HZ = 500.0, 250.0
"""Sample rate from which a fit takes minutes, and a grid that suffices for most aircraft."""
LARGEST_V = 1000.0
"""A larger battery voltage is taken for mV."""

Triple = tuple[str, str, str]


@dataclass(frozen=True)
class Guess:
    """The options of the import with their columns, and the units that are proposed for them."""

    columns: Mapping[str, tuple[str, ...]]
    """By option; of one with a column for each axis those of AXES, '' where an axis has none."""
    axes: tuple[str, ...]
    """Those that can be imported together: with a rate (or else an angle) and a command."""
    units: Mapping[str, str]
    timed: bool = True
    """Whether a column of time was found, or the columns have times of their own."""

    def role_of(self, column: str) -> str:
        """The guess for one column, in words."""
        option = next((o for o, names in self.columns.items() if column in names), None)
        if option is None:
            return '-'
        at, word = self.columns[option].index(column), option.replace('_', ' ')
        unit = self.units.get(column) or header_unit(column, OPTIONS[option].role)
        if option == 'motors':
            word = f'motor {at + 1}'
        elif OPTIONS[option].per_axis:
            word += f', {AXES[at]}'
        word += f' [{unit}]' if unit else ''
        return word if column in self._taken(self.axes).get(option, ()) else f'{word}, not used'

    def _taken(self, axes: Sequence[str]) -> dict[str, tuple[str, ...]]:
        """The columns of each option that an import of these axes takes."""
        taken = {
            option: tuple(name for axis, name in zip(AXES, names, strict=True) if axis in axes)
            if OPTIONS[option].per_axis else names
            for option, names in self.columns.items()
        }
        return {option: names for option, names in taken.items() if all(names) and names}

    def command(self, file: Path, axes: Sequence[str] = ()) -> str | None:
        """The command line that imports these axes, or all; None without rates or commands."""
        taken = self._taken(axes or self.axes)
        if not ({'rate', 'angle'} & taken.keys() and {'control', 'motors'} & taken.keys()
                and self.timed):
            return None
        words = ['quad-sysid', 'import', str(file), '--axis', ','.join(axes or self.axes)]
        for option, names in taken.items():
            words += [flag(option), ','.join(names)]
        words += ['--mixer', 'auto'] if 'motors' in taken else []
        for column, unit in self.units.items():
            if any(column in names for names in taken.values()):
                words += ['--unit', f'{column}={unit}']
        out = '_'.join([file.name.partition('.')[0], *axes, 'bag'])
        return shlex.join([*words, '--out', out])

    def partial(self) -> dict[tuple[str, ...], list[str]]:
        """Options that only some of the axes have columns for, by these axes."""
        found: dict[tuple[str, ...], list[str]] = {}
        for option, names in self.columns.items():
            if OPTIONS[option].per_axis and option not in self._taken(self.axes):
                own = tuple(axis for axis in _axes(names) if axis in self.axes)
                found.setdefault(own, []).append(option)
        found.pop((), None)
        return found


def guess(table: Table) -> Guess:
    """Guess from names and values of all columns."""
    found: dict[str, tuple[str, ...]] = {}
    free = [n for n in table.columns if np.nanstd(table.columns[n]) > 0.0]

    def take(option: str, names: Sequence[str]) -> None:
        found[option] = tuple(names)
        for name in filter(None, names):
            free.remove(name)

    if time := _time(table):
        take('time', [time])
    if motors := _motors(table, free):
        take('motors', motors)
    for option, pattern in (('rate', RATE), ('angle', ANGLE), ('control', TORQUE),
                            ('reference', ANGLE), ('rate_reference', RATE)):
        if option == 'control' and motors:
            continue
        triples = _triples([n for n in free if _fits(option, n)], pattern)
        if best := _widest(triples, _importable(found)):
            take(option, best)
    for option, pattern in (('thrust', THRUST), ('battery', BATTERY)):
        named = [n for n in free if pattern.search(n)]
        if named and (option == 'battery' or 'control' in found):
            take(option, named[:1])
    ordered = {option: found[option] for option in OPTIONS if option in found}
    units = {
        name: unit for option, names in ordered.items()
        for name, unit in zip(filter(None, names), likely_units(table, option, names), strict=True)
        if unit and header_unit(name, OPTIONS[option].role) != unit
    }
    return Guess(ordered, _importable(found), units, bool(time or table.times))


def _importable(found: Mapping[str, tuple[str, ...]]) -> tuple[str, ...]:
    """The axes that what was found so far measures (by a rate, else an angle) and commands."""
    measured = found.get('rate') or found.get('angle') or AXES
    both = zip(AXES, measured, found.get('control') or AXES, strict=True)
    return tuple(axis for axis, *columns in both if all(columns))


def _widest(triples: Sequence[Triple], axes: Sequence[str]) -> Triple | None:
    """The triple that has most of these axes, a gyro's before others; None where none has any."""
    shared = {triple: len({*axes} & {*_axes(triple)}) for triple in triples}
    best = max(shared, key=lambda t: (shared[t], all(GYRO.search(n) for n in t)), default=None)
    return best if best and shared[best] else None


def _fits(option: str, name: str) -> bool:
    """Whether a column of this name may be what the option asks for."""
    wanted = bool(WANTED.search(name))
    if OPTIONS[option].role == 'angle' and RATE.search(name) and 'angle' not in name.lower():
        return False
    return option == 'control' or wanted == option.endswith('reference')


def _axes(triple: Sequence[str]) -> tuple[str, ...]:
    return tuple(axis for axis, name in zip(AXES, triple, strict=True) if name)


def lines(guessed: Guess, table: Table, file: Path) -> Iterator[str]:
    """The table of columns, and what to type."""
    (time,) = guessed.columns.get('time', (None,))
    factor = unit_of('time', guessed.units.get(str(time)), str(time)).factor
    rows, rates = [], []
    for name, values in table.columns.items():
        own = table.times.get(name)
        times = factor * table.columns[time] if own is None and time else own
        steps = np.zeros(0) if times is None else np.diff(times[np.isfinite(values)])
        steps = steps[steps > 0.0]
        rates.append(1.0 / float(np.median(steps)) if len(steps) else None)
        rows.append([name, number(rates[-1], 4),
                     number(np.nanmin(values), 4), number(np.nanmax(values), 4),
                     guessed.role_of(name)])
    yield f'{file}: {len(rows)} columns with numbers'
    yield ''
    yield from Text(['column', 'Hz', 'lowest', 'highest', 'guess'], rows, (1, 2, 3)).text()
    command = guessed.command(file)
    yield ''
    if not guessed.timed:
        yield 'no column of time was recognised: add one, or name it with --time'
    elif command is None:
        yield 'rates and commands were not recognised: name them, see quad-sysid import --help'
    else:
        yield 'check the guesses, then:'
        yield command
        yield from quicker(max((rate for rate in rates if rate), default=0.0))
        for axes, options in guessed.partial().items():
            named = ', '.join(map(flag, options))
            yield ''
            yield from wrapped(
                f'{named}: not used, since only {" and ".join(axes)} of '
                f'{", ".join(guessed.axes)} has such a column; to use it, import '
                f'{" and ".join(axes)} alone:', '')
            yield str(guessed.command(file, axes))


def quicker(rate_hz: float) -> list[str]:
    """A line on the grid that saves time, for samples that come fast."""
    told = (f'at {rate_hz:.4g} Hz a fit takes minutes for each axis: --grid {GRID_HZ:g} makes a '
            'bag that is fitted sooner')
    return [told] if rate_hz > FAST_HZ else []


def _time(table: Table) -> str | None:
    """The column that increases with the rows, if they have no times of their own."""
    if table.times:
        return None
    ahead = {}
    for name, values in table.columns.items():
        steps = np.diff(values[np.isfinite(values)])
        named = bool(TIME.search(name))  # a slow clock repeats its ticks
        rising = float(np.mean(steps >= 0.0 if named else steps > 0.0)) if steps.any() else 0.0
        if rising >= RISING:
            ahead[name] = rising + named
    return max(ahead, key=ahead.__getitem__, default=None)


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


def _triples(names: Sequence[str], pattern: re.Pattern[str]) -> list[Triple]:
    """Columns of the three axes that differ in the axis' name only; '' where one is missing.

    One may have its unit in brackets where another has none.
    """
    groups: dict[str, list[str]] = {}
    for name in names:
        if not pattern.search(name):
            continue
        whole = bare(name)
        last = whole.rpartition('.')[2]
        part = last if any(p.search(last) for p in (pattern, *AXIS_NAMES)) else whole
        for i, axis in enumerate(AXIS_NAMES):
            found = list(axis.finditer(part))
            if found:
                start, stop = (len(whole) - len(part) + at for at in found[-1].span())
                stem = f'{whole[:start]}*{whole[stop:]}'
                if groups.get(stem, ['', '', ''])[i]:  # the same once more in another unit
                    stem += name[len(whole):]
                groups.setdefault(stem, ['', '', ''])[i] = name
                break
    return [(a, b, c) for a, b, c in groups.values()]


def likely_units(table: Table, option: str, names: Sequence[str]) -> list[str]:
    """The units of an option's columns, where name or size tells one that is not SI; else ''.

    Columns of one sensor share what is known of any of them. SI is named where the name's own unit
    is unknown. An empty name is no column.
    """
    role, names = OPTIONS[option].role, [name for name in names if name]
    known = {None, *UNITS[role]}
    return [unit or ('' if header_unit(name, role) in known else next(iter(UNITS[role])))
            for name, unit in zip(names, _by_size(table, option, names), strict=True)]


def _by_size(table: Table, option: str, names: Sequence[str]) -> list[str]:
    columns = [table.columns[name] for name in names]
    if option == 'time':
        known = header_unit(names[0])
        unit = known if known in UNITS['time'] else time_unit(columns[0])
        return ['' if unit == 's' else unit or '']
    if OPTIONS[option].role in ('rate', 'angle'):
        return _turn_units(names, columns, OPTIONS[option].role)
    high = max(float(np.nanmax(np.abs(values))) for values in columns)
    if option == 'battery':
        return ['mV' if float(np.nanmedian(columns[0])) > LARGEST_V else '']
    if option == 'motors' and 1.0 < high <= 2200.0:
        flying = np.median([np.nanmedian(values) for values in columns])
        unit = 'percent' if high <= 100.0 else 'pulse_us' if flying >= 900.0 else 'dshot'
    elif option == 'control' and high <= 2200.0 and min(map(np.nanmin, columns)) >= 900.0:
        unit = 'pulse_us'
    elif high > 2000.0:
        unit = 'pwm16'
    elif option == 'control' and not 0.02 < high <= 0.5:
        unit = f'{10.0 ** np.floor(np.log10(0.5 / high)):g}'
    else:
        unit = f'{0.5 / high:.3g}' if option == 'thrust' and high > 1.0 else ''
    return [unit] * len(names)


def _turn_units(names: Sequence[str], columns: Sequence[np.ndarray], role: Role) -> list[str]:
    """The unit of a sensor's columns where a name or the size of any says so; '' for SI."""
    rate = role == 'rate'
    si, degrees = ('rad/s', 'deg/s') if rate else ('rad', 'deg')

    def named(name: str) -> str | None:
        if header_unit(name, role) in UNITS[role]:
            return header_unit(name, role)
        found = re.search(r'_(rad|deg|dps)(s|ps)?([^a-z]|$)', name.lower())
        return found and (si if found[1] == 'rad' else degrees)

    own = [named(name) for name in names]
    told = {unit for unit in own if unit}
    largest = max(float(np.nanquantile(np.abs(values), 0.99)) for values in columns)
    large = largest > (SMOOTH_TURN if rate else 2.0 * np.pi)
    common = told.pop() if len(told) == 1 else degrees if large and not told else ''
    units = [unit or common for unit in own]
    return ['' if unit == si else unit for unit in units]
