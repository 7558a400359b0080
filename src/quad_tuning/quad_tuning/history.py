"""`quad-tune history`, `rollback` and `send`: an aircraft's gains over time, and the way back.

Reads `<folder>/<aircraft>/gains.jsonl` (quad_bridge's gains/history.py writes it): each set with
its source and outcome. Exit status: 0 done, 2 bad input, 3 refused by the bridge; both with one
line on stderr.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

from quad_sysid.arguments import NOT_ANSWERED, command
from quad_sysid.errors import BadInputError
from quad_sysid.report.tables import Table
from quad_tuning.exports import finite, read_axes, read_gains
from quad_tuning.gain_table import DEFAULT_BOUNDS

SCHEMA = 'quad_tuning/history/1'
SOURCE, SENDER = 'quad-tune rollback', 'quad-tune send'
STORED = 'quad_bridge/gains/1'
FILE = 'gains.jsonl'
GOOD = ('confirmed', 'found')
"""Outcomes of sets to which a rollback may return."""
GROUND = 'not flown'
"""Outcome of a set that was confirmed and has not flown for the watch's time yet."""
OPEN = 'in flight', 'unfinished'
"""Outcomes of sets whose end is not written yet."""


@dataclass(frozen=True)
class GainSet:
    """One set that was active."""

    number: int
    """Number of the set, from 1, in the order of time."""
    time: str
    """ISO 8601, UTC."""
    gains: Mapping[str, float]
    """All gains and loop constants, contract names, SI."""
    source: str = ''
    model: str = ''
    bag: str = ''
    update: str = ''
    """Name of its update; sets of one update are its steps."""
    outcome: str = 'in flight'
    """Outcome: `found` on the STM32, `in flight`, `unfinished` (its end was not recorded),
    `confirmed`, `not flown` (confirmed on the ground), `passed` on the way, `rolled back`, ..."""
    reason: str = ''


def default_folder() -> Path:
    """Folder of the bridge's files: `$ROS_HOME/quad_suite`, or `~/.ros/quad_suite`."""
    ros_home = os.environ.get('ROS_HOME')
    return (Path(ros_home) if ros_home else Path.home() / '.ros') / 'quad_suite'


def history_file(folder: Path, aircraft: str) -> Path:
    """The file of an aircraft; without a name the only one. Raises BadInputError."""
    names = sorted(path.parent.name for path in folder.glob(f'*/{FILE}'))
    if not names:
        raise BadInputError(str(folder), 'holds no history of gains', None,
                            "give the bridge's parameter state_folder as --folder")
    if aircraft and aircraft not in names:
        raise BadInputError('--aircraft', f'must be one of {", ".join(names)}', aircraft)
    if not aircraft and len(names) > 1:
        raise BadInputError(str(folder), 'holds several aircraft', ', '.join(names),
                            'choose one by --aircraft')
    return folder / (aircraft or names[0]) / FILE


def read_history(path: Path) -> list[GainSet]:
    """All sets in order of time, without lines that a crash cut short.

    Raises BadInputError where the file cannot be read or is of another kind.
    """
    try:
        lines = path.read_text(encoding='utf-8', errors='replace').splitlines()
    except OSError as error:
        raise BadInputError(str(path), 'cannot be read', error.strerror) from error
    sets: list[GainSet] = []
    for line in lines:
        entry = _entry(line)
        if entry is None:
            continue
        if entry.get('schema') != STORED:
            raise BadInputError(str(path), f'schema must be {STORED}', entry.get('schema'))
        if entry.get('state') == 'active':
            new = _as_before(_set(entry, len(sets) + 1), sets)
            sets = [*(_left(one, new) for one in sets), new]
        elif entry.get('state') == 'flown':
            sets[-1:] = [_flown(one) for one in sets[-1:]]
        else:
            sets = [_ended(one, entry) for one in sets]
    return _passed(sets)


def changed(one: Mapping[str, float], other: Mapping[str, float]) -> dict[str, float]:
    """The gains of `other` that differ in `one`."""
    return {name: value
            for name, value in other.items()
            if abs(one.get(name, float('inf')) - value) > 1e-6 * max(abs(value), 1e-9)}


def way_back(sets: Sequence[GainSet], number: int | None = None,
             where: str = 'history') -> tuple[GainSet, dict[str, float]]:
    """The set `number`, or the last good set that differs, and the gains that must change.

    Those are the ones that a bridge lets an update change; a set-up (channels, offsets, limits)
    that was changed since stays. A set that was only confirmed on the ground is none of those.

    Raises BadInputError, naming the file `where`, where there is no such set.
    """
    if not sets:
        raise BadInputError(where, 'holds no set of gains',
                            remedy='the bridge adds the first when the aircraft is connected')
    now = sets[-1].gains
    if number is not None:
        if not 1 <= number <= len(sets):
            raise BadInputError('--to', f'must be 1..{len(sets)}', number, 'see quad-tune history')
        chosen = sets[number - 1]
        return chosen, _of_updates(changed(now, chosen.gains), sets)
    for one in reversed(sets[:-1]):
        difference = _of_updates(changed(now, one.gains), sets)
        if one.outcome in GOOD and difference:
            return one, difference
    raise BadInputError(where, 'holds no earlier good set that differs from the present one',
                        None, 'quad-tune history shows all; --to N takes any of them')


def _of_updates(gains: Mapping[str, float], sets: Sequence[GainSet]) -> dict[str, float]:
    """Those that an update may change, by default or because one has on this aircraft."""
    may = {name for before, one in pairwise(sets) if one.update
           for name in changed(before.gains, one.gains)} | DEFAULT_BOUNDS.keys()
    return {name: value for name, value in gains.items() if name in may}


def _entry(line: str) -> dict[str, Any] | None:
    try:
        entry = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return entry if isinstance(entry, dict) else None


def _set(entry: Mapping[str, Any], number: int) -> GainSet:
    gains = entry.get('gains')
    values = {str(name): float(value)
              for name, value in (gains.items() if isinstance(gains, dict) else ())
              if isinstance(value, (int, float)) and abs(value) <= sys.float_info.max}
    keys = ('source', 'model', 'bag', 'update', 'reason')
    texts = {key: str(entry.get(key, '')) for key in keys}
    outcome = 'in flight' if texts['update'] else 'found'
    return GainSet(number, str(entry.get('time', '')), values, outcome=outcome, **texts)


def _ended(one: GainSet, entry: Mapping[str, Any]) -> GainSet:
    if not one.update or one.update != entry.get('update') or one.outcome not in OPEN:
        return one
    outcome, reason = str(entry.get('state', '')), str(entry.get('reason', ''))
    if outcome == 'confirmed' and entry.get('flown') is False:
        outcome = GROUND
    return replace(one, outcome=outcome, reason=reason)


def _left(one: GainSet, later: GainSet) -> GainSet:
    """A set in flight, once another follows that is not of its update: nobody watched its end."""
    if one.outcome != 'in flight' or one.update == later.update:
        return one
    return replace(one, outcome='unfinished', reason='its end was not recorded')


def _as_before(one: GainSet, sets: Sequence[GainSet]) -> GainSet:
    """A set that was found is not flown where it was confirmed on the ground before."""
    same = [s.outcome for s in sets if not changed(s.gains, one.gains)]
    return replace(one, outcome=GROUND) if not one.update and same[-1:] == [GROUND] else one


def _flown(one: GainSet) -> GainSet:
    """The set in force once the bridge has seen it fly for the watch's time."""
    if one.outcome != GROUND:
        return one
    return replace(one, outcome='confirmed' if one.update else 'found')


def _passed(sets: Sequence[GainSet]) -> list[GainSet]:
    """`sets` with only the last set of an update confirmed; those before it were passed."""
    last = {one.update: one.number for one in sets if one.update}
    return [
        replace(one, outcome='passed')
        if one.outcome in {'confirmed', GROUND} and last.get(one.update, 0) > one.number
        else one
        for one in sets
    ]


def add(commands: Any) -> None:
    """Add them to the subparsers of `quad-tune`."""
    history = command(commands, 'history', show, 'Every set of gains that was ever active, with '
                      'its source, its outcome and what it changed.',
                      'quad-tune history --folder demo_out/aircraft')
    history.add_argument('--json', action='store_true', help='print JSON instead of the table')
    rollback = command(commands, 'rollback', go_back, 'Send the last good set of gains that '
                       'has flown and differs from the present one. Exit status 3: the bridge '
                       'refuses it.',
                       'quad-tune rollback --print')
    rollback.add_argument('--to', type=int, metavar='N', help='this set of the history')
    rollback.add_argument('--print', action='store_true', help='only print what would be sent')
    for parser in (history, rollback):
        parser.add_argument('--folder', type=Path, metavar='DIR',
                            help="the bridge's state_folder; default quad_suite in ROS_HOME")
        parser.add_argument('--aircraft', default='', metavar='NAME',
                            help='its folder there; default the only one')
    sending = command(commands, 'send', send, 'Send designed gains to the bridge. Exit status 3: '
                      'the bridge refuses them, for their values too, or takes them back.',
                      'quad-tune send gains.json')
    sending.add_argument('design', type=Path, metavar='GAINS.json',
                         help='of quad-tune design --out, or a report.json')
    for parser in (rollback, sending):
        parser.add_argument('--namespace', default='', metavar='NS',
                            help="the bridge's, where several aircraft fly")


def show(arguments: argparse.Namespace) -> int:
    """`quad-tune history`. Raises QuadSysidError for bad input."""
    path = _file(arguments)
    sets = read_history(path)
    tree = {'schema': SCHEMA, 'sets': [asdict(one) for one in sets]}
    print(json.dumps(tree, indent=1) if arguments.json else f'{path}\n{table(sets)}')
    return 0


def go_back(arguments: argparse.Namespace) -> int:
    """`quad-tune rollback`. Raises QuadSysidError for bad input."""
    path = _file(arguments)
    sets = read_history(path)
    chosen, gains = way_back(sets, arguments.to, str(path))
    stays = sorted(changed(sets[-1].gains, chosen.gains).keys() - gains.keys())
    text = f'set {chosen.number} of {chosen.time}: {words(gains) or "nothing differs"}' + (
        f'; no update changes {", ".join(stays)}, which stay as they are' if stays else '')
    if arguments.print or not gains:
        print(text)
        return 0
    answer = _publish('rollback')(gains, SOURCE, rollback=True, namespace=arguments.namespace,
                                  aircraft=path.parent.name)
    return _report(*answer, f'back to {text}')


def send(arguments: argparse.Namespace) -> int:
    """`quad-tune send`. Raises QuadSysidError for bad input."""
    gains, beside = read_design(arguments.design)
    try:
        answer = _publish('send')(gains, SENDER, beside=beside, namespace=arguments.namespace)
    except KeyboardInterrupt as interrupt:
        for line in interrupt.args:
            print(f'quad-tune: {line}', file=sys.stderr)
        raise
    return _report(*answer, f'active: {words(gains)}; the bridge watches them for 10 s of '
                   'flight and takes them back if they fly badly: see quad-tune history')


def _publish(command: str) -> Callable[..., tuple[bool, str]]:
    """What sends gains to the bridge; raises BadInputError without ROS."""
    try:
        from quad_tuning.update_node import publish
    except ImportError as missing:
        raise BadInputError(f'quad-tune {command}', f'needs ROS 2 ({missing.name} is missing)',
                            remedy='run it where the bridge runs') from missing
    return publish


def _report(done: bool, words: str, success: str) -> int:
    """Say how the bridge answered, by its `words` if it has any; the exit status."""
    if not done:
        print(f'quad-tune: {words}', file=sys.stderr)
        return NOT_ANSWERED
    print(words or success)
    return 0


def read_design(path: Path) -> tuple[dict[str, float], dict[str, str]]:
    """Gains of all axes in a design's file, and what is sent with them. Raises BadInputError."""
    from quad_sysid.result import sent_with  # slow to import

    gains = read_gains(path, bounded=False)
    sent = {name.partition('.')[0] for name in gains}
    figures = {axis: {name: finite(value, f'{path}: axes.{axis}.figures.{name}')
                      for name, value in figures_of.items()}
               for axis, one in read_axes(path).items() if axis in sent
               for figures_of in [one.get('figures', one.get('gain_figures'))]
               if isinstance(figures_of, Mapping)}
    return gains, sent_with(figures)


def _file(arguments: argparse.Namespace) -> Path:
    return history_file(arguments.folder or default_folder(), arguments.aircraft)


def table(sets: Sequence[GainSet]) -> str:
    """One line per set with time, source and outcome, and below it its changes and the reason."""
    rows = []
    before: Mapping[str, float] = {}
    for one in sets:
        new = words(changed(before, one.gains)) if before else f'{len(one.gains)} values'
        why = one.reason if one.outcome not in {'found', 'confirmed', 'passed'} else ''
        origin = ' and '.join(filter(None, (one.bag, one.model)))
        below = '; '.join(filter(None, (new, why, origin and f'of {origin}')))
        rows.append([str(one.number), one.time[:19], one.outcome,
                     one.source or 'read from the aircraft', below])
        before = one.gains
    head = ['', 'time (UTC)', 'outcome', 'source', 'changed']
    return '\n'.join(Table(head, rows, (0,)).text(below=4))


def words(gains: Mapping[str, float]) -> str:
    """Gains in a sentence."""
    return ', '.join(f'{name} {value:.4g}' for name, value in gains.items())
