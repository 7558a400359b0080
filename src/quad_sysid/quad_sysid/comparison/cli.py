"""`quad-sysid compare`: arguments and wiring only."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from quad_sysid.arguments import NOT_ANSWERED, Commands, command, quiet_and_json
from quad_sysid.contract import AXES
from quad_sysid.errors import BadInputError
from quad_sysid.progress import progress

if TYPE_CHECKING:
    from quad_sysid.comparison.change import Flight


def add(commands: Commands) -> None:
    """Register the command."""
    parser = command(
        commands, 'compare', _run,
        'Show what changed between flights or aircraft: the difference of every parameter of '
        'base, trim and effects, its error, and the chance that nothing changed.',
        'quad-sysid compare monday/ friday/ --axis roll',
    )
    parser.add_argument('flights', nargs='+', metavar='BAG|MODEL.json',
                        help='the first is what the others are compared with')
    parser.add_argument('--axis', choices=[*AXES, 'all'], default='all', help='default: all')
    parser.add_argument('--no-effects', action='store_true',
                        help='compare base and trim only, which takes less time')
    quiet_and_json(parser, 'one JSON object')


def _run(options: argparse.Namespace) -> int:
    from quad_sysid.comparison.change import changes
    from quad_sysid.comparison.page import lines, tree

    if len(options.flights) < 2:
        raise BadInputError('compare', 'needs two flights or more', len(options.flights),
                            'name what is to be compared with the first')
    axes = AXES if options.axis == 'all' else (options.axis,)
    show = progress(quiet=options.quiet)
    reference, *others = [
        _flight(name, axes, show, effects=not options.no_effects) for name in options.flights
    ]
    show('')
    pairs = [(other, changes(reference, other)) for other in others]
    if options.json:
        print(json.dumps(tree(reference, pairs), indent=1))
    elif not options.quiet:
        print('\n'.join(lines(reference, pairs)))
    if not any(change.p_value is not None for _, found in pairs for change in found):
        print(f'quad-sysid: {reference.source}: nothing can be compared: no parameter has an '
              'error in both flights', file=sys.stderr)
        return NOT_ANSWERED
    return 0


def _flight(
    name: str, axes: tuple[str, ...], show: Callable[[str], None], *, effects: bool
) -> Flight:
    """A stored model as it is; a bag identified, with its trim."""
    from quad_sysid.bags import read_bag, split_segments
    from quad_sysid.comparison.change import Flight, of_model, trims
    from quad_sysid.report.model_file import load_models
    from quad_sysid.result import identify

    if Path(name).suffix == '.json':
        models = load_models(name)
        return Flight(name, {axis: of_model(models[axis]) for axis in axes if axis in models},
                      {axis: 'not in the file' for axis in axes if axis not in models})
    record = split_segments(read_bag(name), axes=axes)
    found = identify(record, axes, effects=None if effects else (),
                     progress=lambda line: show(f'{name}: {line}' if line else ''))
    answers = found.answers
    by_axis = {axis: of_model(answer.model) for axis, answer in answers.items()
               if answer.answered and answer.model}
    told = tuple(by_axis)
    for axis, trim in trims(record).items():
        if axis in axes:
            by_axis.setdefault(axis, {})['trim'] = trim
    return Flight(name, by_axis, {axis: answer.reason for axis, answer in answers.items()
                                  if axis not in told})
