"""`quad-sysid compare`: the command, and changes as text for 80 columns or as JSON."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from quad_sysid.arguments import (
    NOT_ANSWERED,
    Commands,
    candidates,
    command,
    effects_option,
    progress,
    quiet_and_json,
)
from quad_sysid.contract import AXES
from quad_sysid.errors import BadInputError

if TYPE_CHECKING:
    from quad_sysid.comparison.change import Change, Flight
    from quad_sysid.model.effect import Effect

    Pair = tuple[Flight, tuple[Change, ...]]

SCHEMA = 'quad_sysid/comparison/1'


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
    effects_option(parser)
    quiet_and_json(parser, 'one JSON object')


def _run(options: argparse.Namespace) -> int:
    from quad_sysid.comparison.change import changes

    if len(options.flights) < 2:
        raise BadInputError('compare', 'needs two flights or more', len(options.flights),
                            'name what is to be compared with the first')
    axes = AXES if options.axis == 'all' else (options.axis,)
    show, effects = progress(quiet=options.quiet), candidates(options)
    reference, *others = [_flight(name, axes, effects, show) for name in options.flights]
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


def _flight(name: str, axes: tuple[str, ...], effects: tuple[Effect, ...] | None,
            show: Callable[[str], None]) -> Flight:
    """A stored model as it is; a bag identified, with its trim."""
    from quad_sysid.bags import read_bag, split_segments
    from quad_sysid.comparison.change import Flight, of_model, trims
    from quad_sysid.report.model_file import load_models
    from quad_sysid.result import identify

    if Path(name).suffix == '.json':
        models = load_models(name, effects or ())
        return Flight(name, {axis: of_model(models[axis]) for axis in axes if axis in models},
                      {axis: 'not in the file' for axis in axes if axis not in models})
    record = split_segments(read_bag(name), axes=axes)
    found = identify(record, axes, effects=effects,
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


def tree(reference: Flight, pairs: Sequence[Pair]) -> dict[str, Any]:
    """What `--json` prints."""
    from quad_sysid.comparison.change import LEVEL

    return {
        'schema': SCHEMA, 'reference': reference.source, 'level': LEVEL,
        'flights': [
            {'source': flight.source, 'not_answered': dict(flight.reasons),
             'parameters': [asdict(change) for change in found]}
            for flight, found in pairs
        ],
        'not_answered': dict(reference.reasons),
    }


def lines(reference: Flight, pairs: Sequence[Pair]) -> Iterator[str]:
    """A table for each flight, then what changed."""
    for flight, found in pairs:
        yield f'{reference.source} -> {flight.source}'
        yield (f'  {"":<26} {"before":>9} {"after":>9} {"difference":>11} {"error":>8} '
               f'{"chance":>8}')
        for axis in dict.fromkeys(change.axis for change in found):
            yield f'  {axis}'
            for c in found:
                if c.axis == axis:
                    yield (f'  {"* " if c.changed else "  "}{_name(c):<24} '
                           f'{_number(c.reference):>9} {_number(c.value):>9} '
                           f'{_number(c.difference):>11} {_number(c.std):>8} '
                           f'{_number(c.p_value):>8}')
        for known in (reference, flight):
            for axis, reason in known.reasons.items():
                yield f'  {known.source}, {axis}: no model ({reason})'
        yield from _verdict(found)
        yield ''
    yield 'chance: probability of a difference as large if nothing had changed'


def _verdict(found: Sequence[Change]) -> Iterator[str]:
    from quad_sysid.comparison.change import LEVEL

    told = [f'{c.axis} {c.name}' for c in found if c.changed]
    alone = [f'{c.axis} {c.name}' for c in found
             if (c.reference is None) != (c.value is None) and '.' in c.name]
    yield (f'  changed: {", ".join(told)}' if told else
           f'  nothing changed, at a level of {LEVEL:.0%} for all comparisons together')
    if alone:
        yield f'  in one of the two only, not compared: {", ".join(alone)}'


def _name(change: Change) -> str:
    unit = '' if change.unit in ('', '1') else f', {change.unit}'
    name = f'{change.name}{unit}'
    return name if len(name) <= 24 else f'{name[:23]}…'


def _number(value: float | None) -> str:
    return '-' if value is None else f'{value:.3g}'
