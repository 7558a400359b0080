"""What the page may start: each kind of request becomes a command line, after all is checked."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from quad_sysid.app.folder import RefusedError, inside, is_bag
from quad_sysid.app.jobs import OWN
from quad_sysid.axes import NAMES
from quad_sysid.contract import AXES
from quad_sysid.errors import BadInputError
from quad_sysid.motor_layout import MAX_MOTORS

SYSID = 'quad-sysid'
FIRMWARES = ('px4', 'ardupilot', 'betaflight', 'inav')
UNIT = re.compile(r'[A-Za-z0-9/_.:+-]{0,24}')
SCALE = re.compile(r'[0-9]*\.?[0-9]+')

Command = tuple[str, str, list[str]]
"""Title, program, arguments."""
Free = Callable[..., str]
"""A path in the folder, by its stem and ending, that nothing has yet."""


def commands(folder: Path, request: Mapping[str, Any],
             promised: Collection[str] = ()) -> list[Command]:
    """Title, program and arguments of what the page asks for, one after the other.

    Only what stands here can be started; OWN is the job's own folder. A log that is to be
    identified is made a bag first. promised: paths that other jobs will write. Raises
    RefusedError.
    """
    kind, names = request.get('kind'), request.get('files')
    if not isinstance(names, list) or not names or not all(isinstance(n, str) for n in names):
        raise RefusedError('choose a file first')
    if not isinstance(kind, str) or kind not in KINDS:
        raise RefusedError('no such command')
    paths = [inside(folder, name) for name in names]
    if kind not in OF_SEVERAL and len(paths) > 1:
        raise RefusedError('choose a single file: this works on one at a time')
    free = partial(_free, folder.resolve(), set(promised))
    before: dict[Path, Command] = {}
    if kind == 'identify':
        for log in (path for path in paths if not is_bag(path)):
            _check_log(log)
            before[log] = _to_bag(free, log)
    paths = [Path(before[path][-1][-1]) if path in before else path for path in paths]
    return [*before.values(), KINDS[kind](free, paths, request)]


def _check_log(path: Path) -> None:
    """Raise RefusedError for a table: nobody knows what its columns are."""
    from quad_sysid.imports.formats import format_of  # slow to import

    try:
        known = format_of(path)
    except BadInputError as error:
        raise RefusedError(str(error)) from error
    if known is None:
        raise RefusedError(f'{path.name} is a table: press Columns, correct what each is, and '
                           'make the bag there')


def _look(_: Free, paths: Sequence[Path], __: Mapping[str, Any]) -> Command:
    title = paths[0].name if len(paths) == 1 else f'{len(paths)} flights'
    return f'look at {title}', SYSID, ['look', *map(str, paths), '--out', f'{OWN}look.html']


def _import(free: Free, paths: Sequence[Path], request: Mapping[str, Any]) -> Command:
    columns = named_columns(request.get('columns'))
    if not columns and not is_bag(paths[0]):
        _check_log(paths[0])
    return _to_bag(free, paths[0], columns)


def _to_bag(free: Free, log: Path, columns: Sequence[str] = ()) -> Command:
    stem = log.name.partition('.')[0] or 'log'
    bag = free(f"{stem.encode(errors='replace').decode()}_bag")  # a bag's name must be UTF-8
    return f'import {log.name}', SYSID, ['import', str(log), *columns, '--out', bag]


def _compare(_: Free, paths: Sequence[Path], __: Mapping[str, Any]) -> Command:
    if len(paths) < 2:
        raise RefusedError('choose two or more bags or models to compare')
    return f'compare {len(paths)} flights', SYSID, ['compare', *map(str, paths)]


def _export(_: Free, paths: Sequence[Path], request: Mapping[str, Any]) -> Command:
    model, to, axes = paths[0], request.get('to'), _answers(paths[0])
    if to not in FIRMWARES:
        raise RefusedError('choose a firmware')
    with_gains = [axis for axis in AXES if axes.get(axis, {}).get('gains')]
    if not with_gains:
        raise RefusedError('this result has no gains: its report says why')
    more, scale = [], str(request.get('scale', ''))
    if to in FIRMWARES[:2]:
        numbers = [number.strip() for number in scale.split(',')]
        if len(numbers) != len(with_gains) or not all(map(SCALE.fullmatch, numbers)):
            raise RefusedError(f'scale: a number is missing for {", ".join(with_gains)}: our '
                               'command per unit of their torque, 1 for a model of their torque '
                               'set-points (the import says so), else the factor of their mixer')
        more = [option for axis, number in zip(with_gains, numbers, strict=True)
                for option in ('--scale', f'{axis}={number}')]
    return f'gains for {to}', 'quad-tune', [
        'export', str(model.with_name('report.json')), '--to', str(to), *more]


def _answers(model: Path) -> dict[str, Any]:
    """What the report beside a result's model says of each axis."""
    try:
        tree = json.loads(model.with_name('report.json').read_text(encoding='utf-8'))
        return dict(tree['axes'])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RefusedError('choose a model that has its report.json beside it') from error


def _identify(_: Free, paths: Sequence[Path], request: Mapping[str, Any]) -> Command:
    from quad_sysid.bags import parse_span  # slow to import

    axis = request.get('axis', 'all')
    if axis not in NAMES:
        raise RefusedError(f'axis must be one of {", ".join(NAMES)}')
    arguments = ['identify', *map(str, paths), '--axis', str(axis), '--out', f'{OWN}result']
    for option in ('train', 'validate'):
        span = request.get(option)
        if span:
            try:
                a, b = parse_span(str(span), f'--{option}')
            except BadInputError as error:
                raise RefusedError(str(error)) from error
            arguments += [f'--{option}', f'{a:.4f}:{b:.4f}']
    return f'identify {axis} of {paths[0].name}', SYSID, arguments


def _schedule(free: Free, paths: Sequence[Path], request: Mapping[str, Any]) -> Command:
    """The next flight that the report of a result proposes, as a schedule in the folder."""
    from quad_sysid.report.next_flight import next_flight

    model, axis = paths[0], request.get('axis')
    axes = _answers(model)
    axis = axis if axis in axes else next(iter(axes))
    planned = [advice.command for advice in next_flight(str(axis), axes[axis])
               if advice.command.startswith(SYSID)]
    if not planned:
        raise RefusedError(f'no schedule follows from the report of {axis}: read what it says')
    places = {'model.json': str(model), 'next.yaml': free(f'next_flight_{axis}', '.yaml')}
    return f'next flight of {axis}', SYSID, [
        places.get(word, word) for word in shlex.split(planned[0])[1:]]


KINDS: dict[str, Callable[[Free, Sequence[Path], Mapping[str, Any]], Command]] = {
    'look': _look, 'import': _import, 'identify': _identify, 'compare': _compare,
    'export': _export, 'schedule': _schedule,
    'inspect': lambda _, paths, __: (f'inspect {paths[0].name}', SYSID, [
        'inspect', str(paths[0]), '--out', f'{OWN}inspect.html']),
    'columns': lambda _, paths, __: (f'columns of {paths[0].name}', SYSID, [
        'import', str(paths[0]), '--json']),
}
OF_SEVERAL = ('look', 'identify', 'compare')
"""Those that take several files at once."""


def _free(root: Path, promised: set[str], stem: str, ending: str = '') -> str:
    numbers = ('', *(f'_{k}' for k in range(2, 1000)))
    paths = (root / f'{stem}{k}{ending}' for k in numbers)
    found = str(next(path for path in paths if not path.exists() and str(path) not in promised))
    promised.add(found)
    return found


def named_columns(columns: object) -> list[str]:
    """Options of the import for columns, each [name, role, unit]. Raises RefusedError.

    Roles are those of imports/guess.py: `time`, `rate, roll`, `motor 2`; '' for none.
    """
    from quad_sysid.imports.units import OPTIONS, as_typed

    if columns is None:
        return []
    by_option: dict[str, dict[int, str]] = {}
    units: dict[str, str] = {}
    for name, role, unit in _checked(columns):
        option, place = _place(role)
        if option and place in by_option.setdefault(option, {}):
            raise RefusedError(f'{role}: two columns have this role')
        if option:
            by_option[option][place] = name
            units |= {name: unit} if unit else {}
    measured = by_option.get('rate') or by_option.get('angle') or {}
    commanded = range(len(AXES)) if 'motors' in by_option else by_option.get('control', {})
    axes = [i for i in range(len(AXES)) if i in measured and i in commanded]
    if not axes:
        raise RefusedError('choose a rate (or angle) and a command, or the motors, of an axis')
    places = {option: axes if OPTIONS[option].per_axis else sorted(own)
              for option, own in by_option.items()}
    return as_typed([AXES[i] for i in axes], {
        option: [own[place] for place in places[option]] for option, own in by_option.items()
        if all(place in own for place in places[option])}, units)


def _checked(columns: object) -> list[list[str]]:
    rows: list[Any] = columns if isinstance(columns, list) else [None]
    for row in rows:
        if not (isinstance(row, list) and len(row) == 3
                and all(isinstance(part, str) and OWN not in part for part in row)
                and UNIT.fullmatch(row[2])):
            raise RefusedError('a column needs its name, a role of the menu and a unit')
    return rows


def _place(role: str) -> tuple[str, int]:
    """The option and the place in it of a role; ('', 0) for none. Raises RefusedError."""
    from quad_sysid.imports.units import OPTIONS

    option, _, axis = role.partition(', ')
    number = role.removeprefix('motor ')
    if not role:
        return '', 0
    if role.startswith('motor ') and number.isdecimal() and 1 <= int(number) <= MAX_MOTORS:
        return 'motors', int(number) - 1
    entry = OPTIONS.get(option)
    if entry is not None and entry.per_axis and axis in AXES:
        return option, AXES.index(axis)
    if entry is not None and not (entry.per_axis or entry.several or axis):
        return option, 0
    raise RefusedError(f'{role}: is no role of the menu')
