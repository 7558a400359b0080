"""Changes as text for 80 columns, and as a tree for JSON. Strings only."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import Any

from quad_sysid.comparison.change import LEVEL, Change, Flight

SCHEMA = 'quad_sysid/comparison/1'
Pair = tuple[Flight, tuple[Change, ...]]


def tree(reference: Flight, pairs: Sequence[Pair]) -> dict[str, Any]:
    """What `--json` prints."""
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
