"""`quad-tune history`, `rollback` and `send`: wiring only.

Exit status: 0 done, 2 bad input, 3 refused by the bridge; both with one line on stderr.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from quad_sysid.arguments import NOT_ANSWERED
from quad_sysid.errors import BadInputError
from quad_sysid.report.tables import Table
from quad_sysid.result import PROMISES
from quad_tuning.exports.cli import read_gains
from quad_tuning.history.sets import (
    GainSet,
    changed,
    default_folder,
    history_file,
    read_history,
    way_back,
)

SCHEMA = 'quad_tuning/history/1'
SOURCE, SENDER = 'quad-tune rollback', 'quad-tune send'


def add(commands: Any) -> None:
    """Add them to the subparsers of `quad-tune`."""
    history = commands.add_parser('history', help='every set of gains that was ever active')
    history.add_argument('--json', action='store_true', help='print JSON instead of the table')
    rollback = commands.add_parser('rollback', help='back to the last good set of gains')
    rollback.add_argument('--to', type=int, metavar='N', help='this set of the history')
    rollback.add_argument('--print', action='store_true', help='only print what would be sent')
    for parser, run in ((history, show), (rollback, go_back)):
        parser.set_defaults(run=run)
        parser.add_argument('--folder', type=Path, metavar='DIR',
                            help="the bridge's state_folder; default quad_suite in ROS_HOME")
        parser.add_argument('--aircraft', default='', metavar='NAME')
    sending = commands.add_parser('send', help='designed gains to the bridge, through its gate')
    sending.add_argument('design', type=Path, metavar='GAINS.json',
                         help='of quad-tune design --out')
    sending.set_defaults(run=send)
    for parser in (rollback, sending):
        parser.add_argument('--namespace', default='', metavar='NS',
                            help="the bridge's, where several aircraft fly")


def show(arguments: argparse.Namespace) -> int:
    """`quad-tune history`. Raises QuadSysidError for bad input."""
    sets = _sets(arguments)
    tree = {'schema': SCHEMA, 'sets': [asdict(one) for one in sets]}
    print(json.dumps(tree, indent=1) if arguments.json else table(sets))
    return 0


def go_back(arguments: argparse.Namespace) -> int:
    """`quad-tune rollback`. Raises QuadSysidError for bad input."""
    chosen, gains = way_back(_sets(arguments), arguments.to)
    told = f'set {chosen.number} of {chosen.time}: {_words(gains) or "nothing differs"}'
    if arguments.print or not gains:
        print(told)
        return 0
    refusal = _publish('rollback')(gains, SOURCE, rollback=True, namespace=arguments.namespace)
    return _told(refusal, f'back to {told}')


def send(arguments: argparse.Namespace) -> int:
    """`quad-tune send`. Raises QuadSysidError for bad input."""
    gains, predicted = read_design(arguments.design)
    refusal = _publish('send')(gains, SENDER, predicted=json.dumps(predicted),
                               namespace=arguments.namespace)
    return _told(refusal, f'active, and watched by the bridge: {_words(gains)}')


def _publish(command: str) -> Callable[..., str]:
    """What sends gains to the bridge; raises BadInputError without ROS."""
    try:
        from quad_tuning.history.update_node import publish
    except ImportError as missing:
        raise BadInputError(f'quad-tune {command}', 'needs ROS 2', missing.name,
                            'run it where the bridge runs') from missing
    return publish


def _told(refusal: str, success: str) -> int:
    """Say how the bridge answered; the exit status."""
    if refusal:
        print(f'quad-tune: {refusal}', file=sys.stderr)
        return NOT_ANSWERED
    print(success)
    return 0


def read_design(path: Path) -> tuple[dict[str, float], dict[str, float]]:
    """Gains and predictions of all axes in a design's file. Raises BadInputError."""
    gains = read_gains(path)
    axes = json.loads(path.read_text(encoding='utf-8'))['axes']
    figures = {axis: one.get('figures') or {} for axis, one in axes.items() if one.get('gains')}
    predicted = {f'{axis}.{name}': float(said[name])
                 for axis, said in figures.items()
                 for name in PROMISES
                 if name in said}
    return gains, predicted


def _sets(arguments: argparse.Namespace) -> list[GainSet]:
    return read_history(history_file(arguments.folder or default_folder(), arguments.aircraft))


def table(sets: Sequence[GainSet]) -> str:
    """One line per set with time, source and outcome, and below it its changes and the reason."""
    rows = []
    before: Mapping[str, float] = {}
    for one in sets:
        words = _words(changed(before, one.gains)) if before else f'{len(one.gains)} values'
        why = one.reason if one.outcome not in {'found', 'confirmed', 'passed'} else ''
        origin = ' and '.join(filter(None, (one.bag, one.model)))
        below = '; '.join(filter(None, (words, why, origin and f'of {origin}')))
        rows.append([str(one.number), one.time[:19], one.outcome,
                     one.source or 'read from the STM32', below])
        before = one.gains
    head = ['', 'time (UTC)', 'outcome', 'source', 'changed']
    return '\n'.join(Table(head, rows, (0,)).text(below=4))


def _words(gains: Mapping[str, float]) -> str:
    return ', '.join(f'{name} {value:.4g}' for name, value in gains.items())
