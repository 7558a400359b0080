"""What the columns of an unknown table are likely to be, and the command line that imports them.

Names give the role, names and sizes the unit. A guess is printed for the user to check; the import
compares the columns with each other and refuses a wrong one (plausible.py).
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, cast

import numpy as np

from quad_sysid.contract import AXES
from quad_sysid.errors import BadInputError
from quad_sysid.imports.columns import ColumnOptions, read_columns
from quad_sysid.imports.formats import check_single, format_of, read_log
from quad_sysid.imports.likely import likely_units, one_sided
from quad_sysid.imports.log import ForeignLog
from quad_sysid.imports.plausible import time_unit
from quad_sysid.imports.table import Table, open_table
from quad_sysid.imports.to_bag import record_of
from quad_sysid.imports.units import OPTIONS, UNITS, as_typed, bare, flag, header_unit, unit_of
from quad_sysid.report.tables import Table as Text
from quad_sysid.report.tables import wrapped
from quad_sysid.report.words import number

KNOWN_WORDS = (
    'roll', 'pitch', 'yaw', 'phi', 'theta', 'psi', 'heading', 'gyro', 'gyr', 'rate', 'omega',
    'ang', 'angular', 'angle', 'attitude', 'euler', 'vel', 'velocity', 'speed', 'acc', 'accel',
    'acceleration', 'torque', 'tau', 'moment', 'thrust', 'throttle', 'collective', 'control',
    'command', 'cmd', 'output', 'out', 'motor', 'pwm', 'esc', 'servo', 'rotor', 'bat', 'battery',
    'volt', 'voltage', 'time', 'stamp', 'set', 'point', 'setpoint', 'desired', 'des', 'ref',
    'reference', 'target', 'goal', 'sp', 'imu', 'meas', 'measured', 'est', 'actual', 'body',
    'deg', 'rad', 'pose', 'state', 'input', 'pid', 'filt', 'raw', 'gps',
)
"""Words of which names without gaps are made, such as rollrate or cmdpitch."""
_TOKENS = re.compile(r'[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+|[^\W\d_]|[^\w\s]|°')
_MADE_OF = re.compile(f'(?:{"|".join(sorted(KNOWN_WORDS, key=len, reverse=True))})+[xyzpqrs]?')
_PARTS = re.compile(f'{"|".join(sorted(KNOWN_WORDS, key=len, reverse=True))}|[xyzpqrs]$')


@cache
def spaced(name: str) -> str:
    """A name as its words, small and with blanks between them: `gyroRate_x` is `gyro rate x`.

    A word that is not made of known ones stays whole, so that a controller does not roll.
    """
    words: list[str] = []
    for token in _TOKENS.findall(name):
        small = token.lower()
        words += _PARTS.findall(small) if _MADE_OF.fullmatch(small) else [small]
    return ' '.join(words)


def _named(*parts: str) -> re.Pattern[str]:
    """Pattern, for the words of a name, of any of the parts.

    Those of more than three letters may begin or end a word; others are whole words.
    """
    return re.compile('|'.join(
        part if not part.isalpha() else rf'\b{part}|{part}\b' if len(part) > 3 else rf'\b{part}\b'
        for part in parts))


TIME = _named('t', 'time', 'stamp', 'sec', 'secs', 'seconds', 'tick', 'ticks', 'usec', 'micros',
              'millis', 'msec', 'ms', 'us', 'clock', 'epoch')
SETPOINT = _named(r'\bset ?p', 'sp', r'\bdes', 'ref', 'reference', 'target', 'goal', 'cmd',
                  'command', 'commanded', 'wanted')
SETPOINT_SUFFIX = re.compile(r'(?<![A-Za-z])(?:\w*)(?<![A-Z])_d$')
RATE = _named('gyro', 'gyr', 'rate', 'rates', 'omega', r'\bang (ular )?vel', r'\bangular velocity',
              'angvel', r'\bang(ular)? speed', 'p', 'q', 'r', r'\b[gw] ?[xyz]\b',
              r'(rad|deg|°) / s', 'dps', 'pqr', r'\bbody vel')
GYRO = _named('gyro', 'gyr', 'p', 'q', 'r', r'\bg ?[xyz]\b')
ANGLE = _named('roll', 'pitch', 'yaw', 'phi', 'theta', 'psi', 'angle', 'attitude', 'euler')
POSE = _named('pose')
"""Angles of a table that has no others: a rig's pose is one."""
TORQUE = _named('torque', 'tau', 'moment', 'control', 'cmd', 'output', 'u', r'\bu ?[234]\b',
                'input', '%')
TURNING = _named('torque', 'tau', 'moment', 'control', 'controller', 'cmd', 'output', 'thrust')
"""Words that no measured angle has in its name."""
FORCE = _named('acc', 'accel', 'acceleration', r'\ba ?[xyz]\b')
NO_FORCE = _named('ang', 'angular', 'gyro', 'bias', 'world', 'ned', 'enu', 'lin', 'linear')
THRUST = _named('thrust', 'throttle', 'collective')
BATTERY = _named('bat', 'vbat', 'battery', 'volt', 'voltage')
MOTOR = re.compile(
    r'^(?P<stem>.*?(?:motor|mot|esc|pwm|rotor|out|(?:^|[^a-z])[mu]|servo)[^0-9]*)'
    r'(?P<number>\d+)(?P<rest>\D*)$', re.IGNORECASE)
AXIS_NAMES = (
    _named('roll', 'rol', 'phi', 'p', r'\b[gwau]? ?x\b', r'\[ 0 \]'),
    _named('pitch', 'pit', 'theta', 'q', r'\b[gwau]? ?y\b', r'\[ 1 \]'),
    _named('yaw', 'psi', 'heading', 'r', r'\b[gwau]? ?z\b', r'\[ 2 \]'),
)
RISING = 0.95
"""Least share of the steps of a time that rise; of one by its name, that do not fall."""
TICKING = 0.5
"""Share of the rows with which a clock has to tick to be likelier than others."""

Triple = tuple[str, str, str]


@dataclass(frozen=True)
class Guess:
    """The options of the import with their columns, and the units that are proposed for them."""

    columns: Mapping[str, tuple[str, ...]]
    """Option → its columns; one per axis in the order of AXES, '' for an axis without."""
    axes: tuple[str, ...]
    """Axes that can be imported together: they have a rate (or an angle) and a command."""
    units: Mapping[str, str]
    timed: bool = True
    """Whether there is a column of time, or the columns have times of their own."""

    def role_of(self, column: str) -> str:
        """The guess for one column, in words."""
        option = next((o for o, names in self.columns.items() if column in names), None)
        if option is None:
            return '-'
        index, word = self.columns[option].index(column), option.replace('_', ' ')
        unit = self.units.get(column) or header_unit(column, OPTIONS[option].role)
        if option == 'motors':
            word = f'motor {index + 1}'
        elif OPTIONS[option].per_axis:
            word += f', {AXES[index]}'
        word += f' [{unit}]' if unit else ''
        return word if column in self._used(self.axes).get(option, ()) else f'{word}, not used'

    def _used(self, axes: Sequence[str]) -> dict[str, tuple[str, ...]]:
        """The columns of each option that an import of these axes takes."""
        used = {
            option: tuple(name for axis, name in zip(AXES, names, strict=True) if axis in axes)
            if OPTIONS[option].per_axis else names
            for option, names in self.columns.items()
        }
        return {option: names for option, names in used.items() if all(names) and names}

    def lacks(self, axes: Sequence[str] = ()) -> tuple[str, ...]:
        """What an import of these axes, or all, needs and no column seems to be."""
        used = self._used(axes or self.axes).keys()
        return (*(() if {'rate', 'angle'} & used else ('rates (--rate or --angle)',)),
                *(() if {'control', 'motors'} & used else ('commands (--control or --motors)',)))

    def command(self, file: Path, axes: Sequence[str] = (), out: Path | None = None) -> str | None:
        """The command line that imports these axes, or all; None without rates or commands."""
        used = self._used(axes or self.axes)
        if self.lacks(axes) or not self.timed:
            return None
        bag = str(out or '_'.join([file.name.partition('.')[0], *axes, 'bag']))
        return shlex.join(['quad-sysid', 'import', str(file), *as_typed(
            axes or self.axes, used, self._units_of(used)), '--out', bag])

    def _units_of(self, used: Mapping[str, Sequence[str]]) -> dict[str, str]:
        """The proposed units of these columns."""
        return {column: unit for column, unit in self.units.items()
                if any(column in names for names in used.values())}

    def options(self, file: Path) -> ColumnOptions | None:
        """Options of the import of all axes; None where no axis can be imported."""
        if self.command(file) is None:
            return None
        used = self._used(self.axes)
        named = {option: names if OPTIONS[option].per_axis or OPTIONS[option].several else names[0]
                 for option, names in used.items()}
        return ColumnOptions(file=file, axes=self.axes, mixer='auto',
                             units=self._units_of(used), **cast('Any', named))

    def partial(self) -> dict[tuple[str, ...], list[str]]:
        """Options that only some of the axes have columns for, by these axes."""
        options: dict[tuple[str, ...], list[str]] = {}
        for option, names in self.columns.items():
            if OPTIONS[option].per_axis and option not in self._used(self.axes):
                axes = tuple(axis for axis in _axes(names) if axis in self.axes)
                options.setdefault(axes, []).append(option)
        options.pop((), None)
        return options


def guesses(table: Table) -> Iterator[Guess]:
    """Guesses from names and values of all columns, for each column that may be the time."""
    times: Sequence[str | None] = _times(table) or (None,)
    yield from (guess(table, time) for time in times)


def guess(table: Table, time: str | None = None) -> Guess:  # noqa: C901 - option by option
    """Guess from names and values of all columns, with this one as the time."""
    columns: dict[str, tuple[str, ...]] = {}
    free = [n for n in table.columns if np.nanstd(table.columns[n]) > 0.0]

    def take(option: str, names: Sequence[str]) -> None:
        columns[option] = tuple(names)
        for name in filter(None, names):
            free.remove(name)

    if time:
        take('time', [time])
    if motors := _motors(table, free):
        take('motors', motors)
    for option, pattern in (('rate', RATE), ('angle', ANGLE), ('control', TORQUE),
                            ('reference', ANGLE), ('rate_reference', RATE), ('angle', POSE)):
        if option in columns or (option == 'control' and motors):
            continue
        triples = _triples([n for n in free if _fits(option, n)], pattern)
        if best := _widest(triples, _importable(columns)):
            take(option, best)
    for option, pattern in (('thrust', THRUST), ('battery', BATTERY)):
        named = [n for n in free if pattern.search(spaced(n))]
        if named and (option == 'battery' or 'control' in columns):
            take(option, named[:1])
    forces = _triples([n for n in free if not NO_FORCE.search(spaced(n))], FORCE)
    if forces := [triple for triple in forces if all(triple) and _has_weight(table, triple)]:
        take('acceleration', forces[0])
    sorted_columns = {option: columns[option] for option in OPTIONS if option in columns}
    units = {
        name: unit for option, names in sorted_columns.items()
        for name, unit in zip(filter(None, names), likely_units(table, option, names), strict=True)
        if unit and header_unit(name, OPTIONS[option].role) != unit
    }
    return Guess(sorted_columns, _importable(columns), units, bool(time or table.times))


def _has_weight(table: Table, triple: Triple) -> bool:
    """Whether z is most of the time the largest part: what a flying body's accelerometer shows."""
    size = [float(np.nanmedian(np.abs(table.columns[name]))) for name in triple]
    return size[2] > 2.0 * max(size[:2])


def _importable(columns: Mapping[str, tuple[str, ...]]) -> tuple[str, ...]:
    """The axes that these columns measure (by a rate, else an angle) and command."""
    measured = columns.get('rate') or columns.get('angle') or AXES
    both = zip(AXES, measured, columns.get('control') or AXES, strict=True)
    return tuple(axis for axis, *pair in both if all(pair))


def _widest(triples: Sequence[Triple], axes: Sequence[str]) -> Triple | None:
    """The triple that has most of these axes, a gyro's before others; None where none has any."""
    shared = {triple: len({*axes} & {*_axes(triple)}) for triple in triples}
    best = max(shared, key=lambda t: (shared[t], all(GYRO.search(spaced(n)) for n in t)),
               default=None)
    return best if best and shared[best] else None


def _fits(option: str, name: str) -> bool:
    """Whether a column of this name may be what the option asks for."""
    words = spaced(name)
    is_setpoint = bool(SETPOINT.search(words) or SETPOINT_SUFFIX.search(name))
    if OPTIONS[option].role == 'angle' and RATE.search(words) and 'angle' not in words:
        return False
    if option in ('rate', 'angle') and TURNING.search(words):
        return False
    unit = header_unit(name)
    if option == 'control':
        return unit not in {*UNITS['rate'], *UNITS['angle']}
    return unit not in UNITS['control'] and is_setpoint == option.endswith('reference')


def _axes(triple: Sequence[str]) -> tuple[str, ...]:
    return tuple(axis for axis, name in zip(AXES, triple, strict=True) if name)


def lines(table: Table, file: Path, out: Path | None = None) -> Iterator[str]:
    """The table of columns, and what to type: a command that was tried before it is printed."""
    guessed, _, reason = _first_accepted(table, file)
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
    for line in table.notes:
        yield from wrapped(line, '  ')
    yield ''
    yield from Text(['column', 'Hz', 'lowest', 'highest', 'guess'], rows, (1, 2, 3)).text()
    command = guessed.command(file, out=out)
    yield ''
    if not guessed.timed:
        yield ('no column of time was recognised: add one, name it with --time, or give the rate '
               'of the rows with --sample-rate')
    elif command is None:
        yield from wrapped(f'{" and ".join(guessed.lacks())} were not recognised, and nothing is '
                           'identified without them: name them, see quad-sysid import --help', '')
    else:
        yield 'check the guesses, then:'
        yield command
        if reason:
            yield from wrapped(f'as it stands the import refuses it: {reason}', '')
        yield from quicker(max((rate for rate in rates if rate), default=0.0))
        for axes, options in guessed.partial().items():
            named = ', '.join(map(flag, options))
            yield ''
            yield from wrapped(
                f'{named}: not used, since no such column was recognised for '
                f'{" and ".join(a for a in guessed.axes if a not in axes)}; to use it, import '
                f'{" and ".join(axes)} alone:', '')
            yield str(guessed.command(file, axes))


def described(table: Table, file: Path) -> dict[str, Any]:
    """The columns with their guesses, and what may be chosen instead, for a page's menus."""
    guessed, _, reason = _first_accepted(table, file)
    roles = {name: f'{option}, {AXES[k]}' if OPTIONS[option].per_axis else
             f'motor {k + 1}' if option == 'motors' else option
             for option, names in guessed.columns.items() if option != 'acceleration'
             for k, name in enumerate(names) if name}
    return {
        'columns': [{'name': name, 'lowest': number(np.nanmin(values), 4),
                     'highest': number(np.nanmax(values), 4), 'role': roles.get(name, ''),
                     'unit': guessed.units.get(name, '')}
                    for name, values in table.columns.items()],
        'units': {option: list(UNITS[entry.role]) for option, entry in OPTIONS.items()},
        'refused': reason,
    }


def _first_accepted(table: Table, file: Path) -> tuple[Guess, ForeignLog | None, str]:
    """The first guess that the import accepts, with its log; else the likeliest, and why not."""
    first, reason = None, ''
    for guessed in guesses(table):
        first = first or guessed
        options = guessed.options(file)
        if options is None:
            continue
        try:
            log = read_columns(options, table)
            record_of(log)
        except BadInputError as error:
            reason = reason or str(error)
        else:
            return guessed, log, ''
    return first or guess(table), None, reason


def quicker(rate_hz: float) -> list[str]:
    """A line on the grid that saves time, for samples that come fast."""
    advice = (f'at {rate_hz:.4g} Hz a fit takes minutes for each axis: --grid 250 makes a '
              'bag that is fitted sooner')
    return [advice] if rate_hz > 500.0 else []


def _times(table: Table) -> list[str]:
    """The columns that may be the time, the likeliest first; none where columns have their own.

    The values increase with the rows. A clock that ticks with every row is likelier than a slow
    one, such as that of a satellite receiver, and one that gives a usual rate than another.
    """
    if table.times:
        return []
    ranks = {}
    for name, values in table.columns.items():
        finite = values[np.isfinite(values)]
        steps = np.diff(finite)
        named = bool(TIME.search(spaced(name)))  # a slow clock repeats its ticks
        rising = float(np.mean(steps >= 0.0 if named else steps > 0.0)) if steps.any() else 0.0
        if rising >= RISING:
            ticks = float(np.mean(steps > 0.0))
            ranks[name] = (named, ticks >= TICKING and finite.size >= TICKING * values.size,
                           time_unit(values) is not None, rising)
    return sorted(ranks, key=ranks.__getitem__, reverse=True)


def _motors(table: Table, names: Sequence[str]) -> tuple[str, ...]:
    """The largest family of numbered columns that never cross zero."""
    families: dict[tuple[str, str], list[tuple[int, str]]] = {}
    for name in names:
        match = MOTOR.match(name)
        if match and one_sided(table.columns[name]):
            families.setdefault((match['stem'], match['rest']), []).append(
                (int(match['number']), name))
    complete = [sorted(f) for f in families.values() if len(f) in (4, 6, 8)]
    return tuple(name for _, name in max(complete, key=len)) if complete else ()


def _triples(names: Sequence[str], pattern: re.Pattern[str]) -> list[Triple]:
    """Columns of the three axes that differ in the axis' name only; '' where one is missing.

    One may have its unit in brackets where another has none.
    """
    groups: dict[str, list[str]] = {}
    for name in names:
        if not pattern.search(spaced(name)):
            continue
        text = spaced(bare(name))
        last = text.rpartition('. ')[2]
        part = last if any(p.search(last) for p in (pattern, *AXIS_NAMES)) else text
        for i, axis in enumerate(AXIS_NAMES):
            match = list(axis.finditer(part))
            if match:
                start, stop = (len(text) - len(part) + edge for edge in match[-1].span())
                stem = f'{text[:start]}*{text[stop:]}'
                if groups.get(stem, ['', '', ''])[i]:  # the same once more in another unit
                    stem += name[len(bare(name)):]
                groups.setdefault(stem, ['', '', ''])[i] = name
                break
    return [(a, b, c) for a, b, c in groups.values()]


def read_any(path: Path, log: int = 1, messages: Path | None = None) -> ForeignLog:
    """A log of a known format, or else a table by the guess of its columns that gives a record.

    Raises BadInputError where it is neither.
    """
    log_format = format_of(path)
    if log_format is not None:
        return read_log(path, log_format, log, messages)
    check_single(path, 'a table', log)
    _, read, reason = _first_accepted(open_table(path, messages=messages), path)
    if read is None:
        raise BadInputError(
            str(path), 'is a table whose columns cannot be guessed', reason or None,
            'quad-sysid import FILE lists them; import it with the right ones, then give the bag')
    doubt = f'the columns were guessed: check them with quad-sysid import {path}'
    return replace(read, checks=(*read.checks, doubt))
