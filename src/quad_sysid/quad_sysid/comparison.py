"""`quad-sysid compare`: what changed between flights or models, parameter by parameter.

Base, trim and effects of every axis, the first flight against each other one: difference, error
and p-value. Two-sided tests, held to one level together (Holm 1979). Fits are pipeline's.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from quad_sysid.arguments import (
    NOT_ANSWERED,
    Commands,
    candidates,
    command,
    effects_option,
    progress,
    quiet_and_json,
)
from quad_sysid.axes import EVERY, axes_in
from quad_sysid.errors import BadInputError
from quad_sysid.report.tables import Table, wrapped
from quad_sysid.report.words import by_reason, number
from quad_sysid.units import Units

if TYPE_CHECKING:
    from quad_sysid.model import AxisModel
    from quad_sysid.model.effect import Effect
    from quad_sysid.record import Record

SCHEMA = 'quad_sysid/comparison/1'
LEVEL = 0.01
"""Probability of any false change among all comparisons."""
QUARTERS = 4
"""Parts of a flight whose trims give the trim's scatter between equal flights."""
COMMAND = 'normalised command'
MIN_IN_PART = 50
"""Samples of a quarter that has a mean."""
ROUNDING = 1e-9
"""Normalised command; what scatters less was not flown."""


@dataclass(frozen=True)
class Estimate:
    """One parameter of one flight."""

    value: float
    std: float | None
    """Standard error; None where there is no ordinary one."""
    unit: str
    degrees: float = np.inf
    """Degrees of freedom of `std`."""


@dataclass(frozen=True)
class Flight:
    """Parameters of one flight or model by axis and name."""

    source: str
    parameters: Mapping[str, Mapping[str, Estimate]]
    """`gain`, `lag`, …, `trim`, and `<effect>.<parameter>`; of answered axes."""
    reasons: Mapping[str, str]
    """Axis → why it has no model."""


@dataclass(frozen=True)
class Change:
    """One parameter in two flights."""

    axis: str
    name: str
    unit: str
    reference: float | None
    """Value in the first flight; None where it has no such effect."""
    value: float | None
    difference: float | None = None
    std: float | None = None
    """Standard error of the difference."""
    p_value: float | None = None
    """Probability of a difference as large without a change; None without an error."""
    changed: bool = False
    """Whether it is significant among all comparisons."""


class Comparison(tuple[tuple[Flight, tuple[Change, ...]], ...]):  # noqa: SLOT001 - it has a reference
    """Each other flight with its changes; in print the tables of the command."""

    reference: Flight
    """What the others are compared with."""

    def __repr__(self) -> str:
        return '\n'.join(lines(self))


def of_model(model: AxisModel, *, alone: bool = False) -> dict[str, Estimate]:
    """The base beside its effects, then these; `alone` the base that takes up what they do."""
    base = model.plain if alone and model.plain else model.base
    named = {p.name: p for p in base if model.shows(p)}
    for effect in () if alone else model.effects:
        named |= {f'{effect.name}.{p.name}': p for p in effect.parameters}
    converted = {name: model.in_units(p) for name, p in named.items()}
    return {name: Estimate(p.value, p.std, p.unit) for name, p in converted.items()}


def trims(record: Record) -> dict[str, Estimate]:
    """Mean command of each axis over training and validation, normalised; of arrays in their unit.

    Axes of which arrays hold signals beside theirs are normalised. The error is the scatter
    between the flight's quarters, not that of their mean: a trim drifts with wind and battery,
    between flights as within one.
    """
    used = np.zeros(record.n, dtype=bool)
    for segment in record.segments:
        if segment.role != 'idle':
            used[slice(*record.span(segment))] = True
    used &= np.isfinite(record.control).all(axis=1)
    rows = np.flatnonzero(used if record.segments else np.isfinite(record.control[:, 0]))
    if len(rows) < QUARTERS * MIN_IN_PART:
        return {}
    means = np.array([record.control[part].mean(axis=0)
                      for part in np.array_split(rows, QUARTERS)])
    std = means.std(axis=0, ddof=1)
    own, other = record.units or Units(), Units()
    out = {}
    for axis, row in EVERY.items():
        if not row.outer and std[i := row.index + 1] > ROUNDING:
            units = own if axis == record.axis_of_units else other
            unit = COMMAND if units.command == Units.command else units.command
            out[axis] = Estimate(float(units.command_in(means[:, i]).mean()),
                                 float(std[i]) / abs(units.per_command), unit, QUARTERS - 1.0)
    return out


def flight_of(flight: Any, axes: tuple[str, ...] = (), effects: Sequence[Effect] | None = None,
              show: Callable[[str], None] = lambda _: None) -> Flight:
    """The parameters of a model or a result, or of a flight, which is identified for them.

    `flight` may be the path of a model.json or a bag. Without `axes` all that it has; `effects`
    and `show` as in `identify`; without any effects the bases alone are compared.
    """
    from quad_sysid.bags import read_bag, split_segments
    from quad_sysid.model import AxisModel, GainProposal
    from quad_sysid.record import Record
    from quad_sysid.report.model_file import load_models, names_model
    from quad_sysid.result import Result, identify

    alone = effects is not None and not effects
    if isinstance(flight, AxisModel):
        return Flight('model', {flight.axis: of_model(flight, alone=alone)}, {})
    if isinstance(flight, str | Path) and names_model(flight):
        models = load_models(flight, effects or ())
        return Flight(str(flight), {axis: of_model(models[axis], alone=alone)
                                    for axis in axes or models if axis in models},
                      {axis: 'not in the file' for axis in axes if axis not in models})
    trim: dict[str, Estimate] = {}
    if not isinstance(flight, Result):
        record = split_segments(flight if isinstance(flight, Record) else read_bag(flight),
                                axes=axes or None)
        flight = identify(record, axes, effects=effects, designer=lambda _: GainProposal(None),
                          progress=lambda line: show(f'{record.source}: {line}' if line else ''))
        trim = {axis: mean for axis, mean in trims(record).items() if axis in flight}
    of_axes = {axis: of_model(answer.model, alone=alone)
               for axis, answer in flight.answers.items()
               if answer.answered and answer.model is not None}
    reasons = {axis: answer.reason for axis, answer in flight.answers.items()
               if axis not in of_axes}
    for axis, mean in trim.items():
        of_axes.setdefault(axis, {})['trim'] = mean
    return Flight(', '.join(flight.flights), of_axes, reasons)


def compare(reference: Flight, others: Sequence[Flight]) -> Comparison:
    """All parameters of each flight and the first, in the order of axes and names.

    The changes are those at LEVEL for all comparisons of all flights together. Raises
    BadInputError where the flights are arrays of unlike units.
    """
    changes = [_changes(reference, other) for other in others]
    marked = iter(_marked([*chain(*changes)]))
    out = Comparison((other, tuple(islice(marked, len(own))))
                     for other, own in zip(others, changes, strict=True))
    out.reference = reference
    return out


def _changes(reference: Flight, other: Flight) -> list[Change]:
    return [
        _change(axis, name, reference.parameters.get(axis, {}).get(name),
                other.parameters.get(axis, {}).get(name))
        for axis in EVERY
        for name in dict.fromkeys([*reference.parameters.get(axis, {}),
                                   *other.parameters.get(axis, {})])
    ]


def _change(axis: str, name: str, a: Estimate | None, b: Estimate | None) -> Change:
    from scipy.stats import t  # slow to import

    unit = next(one.unit for one in (a, b) if one)
    change = Change(axis, name, unit, a.value if a else None, b.value if b else None)
    if a is None or b is None:
        return change
    if a.unit != b.unit and '.' not in name:
        raise BadInputError('compare', f'needs flights of the same units, but {axis} {name} is in '
                            f'{a.unit} and in {b.unit}', remedy='name one unit for both')
    if a.unit != b.unit:  # an effect in two forms
        return replace(change, unit=f'{a.unit}, then {b.unit}')
    change = replace(change, difference=b.value - a.value)
    if a.std is None or b.std is None or not a.std + b.std > 0.0:
        return change
    variances = np.array([a.std**2, b.std**2])
    std = float(np.sqrt(variances.sum()))
    # Welch 1947
    variance_share = float(np.sum(variances**2 / np.array([a.degrees, b.degrees])))
    degrees = float(variances.sum()) ** 2 / variance_share if variance_share > 0.0 else np.inf
    p = float(2.0 * t.sf(abs(b.value - a.value) / std, degrees))
    return replace(change, std=std, p_value=p)


def _marked(changes: Sequence[Change]) -> tuple[Change, ...]:
    """Mark the changes at LEVEL for all of them together."""
    from quad_sysid.fleets.drift import holm  # slow to import

    marks = iter(holm([c.p_value for c in changes if c.p_value is not None], LEVEL))
    return tuple(c if c.p_value is None else replace(c, changed=next(marks))
                 for c in changes)


def add(commands: Commands) -> None:
    """Register the command."""
    parser = command(
        commands, 'compare', _run,
        'Show what changed between flights or aircraft: the difference of every parameter of '
        'base, trim and effects, its standard error, and the probability of so large a '
        'difference if nothing had changed.',
        'quad-sysid compare monday/ friday/ --axis roll', reads='flights',
    )
    parser.add_argument('flights', nargs='+', metavar='BAG|MODEL.json',
                        help='the first is what the others are compared with')
    parser.add_argument('--axis', metavar='AXES', default='all',
                        help='roll, pitch, yaw, surge, sway or climb, several with commas '
                        'between; all: roll, pitch and yaw (default); every: all six')
    parser.add_argument('--no-effects', action='store_true',
                        help='compare base and trim only, which takes less time')
    effects_option(parser)
    quiet_and_json(parser, 'one JSON object')


def _run(options: argparse.Namespace) -> int:
    from quad_sysid.bags import read_bag
    from quad_sysid.report.model_file import names_model

    if len(options.flights) < 2:
        raise BadInputError('compare', 'needs two flights or more', len(options.flights),
                            'name what is to be compared with the first')
    axes = axes_in(options.axis)
    show, effects = progress(quiet=options.quiet), candidates(options)
    # what cannot be read is refused before any flight is identified
    given = [flight_of(name, axes, effects) if names_model(name) else read_bag(name)
             for name in options.flights]
    reference, *others = [one if isinstance(one, Flight) else flight_of(one, axes, effects, show)
                          for one in given]
    show('')
    comparison = compare(reference, others)
    if options.json:
        print(json.dumps(tree(comparison), indent=1))
    elif not options.quiet:
        print(comparison)
    if not any(change.p_value is not None for _, changes in comparison for change in changes):
        why = next(chain(*(_unknown(one) for one in (reference, *others))),
                   'no parameter has an error in both flights')
        print(f'quad-sysid: nothing can be compared: {why}', file=sys.stderr)
        return NOT_ANSWERED
    return 0


def tree(comparison: Comparison) -> dict[str, Any]:
    """The comparison as plain values, for `--json`."""
    reference = comparison.reference
    return {
        'schema': SCHEMA, 'reference': reference.source, 'level': LEVEL,
        'flights': [
            {'source': flight.source, 'not_answered': dict(flight.reasons),
             'parameters': [asdict(change) for change in changes]}
            for flight, changes in comparison
        ],
        'not_answered': dict(reference.reasons),
    }


def lines(comparison: Comparison) -> Iterator[str]:
    """What changed in each flight, and its table."""
    reference = comparison.reference
    for flight, changes in comparison:
        yield f'{reference.source} -> {flight.source}'
        changed = [f'{c.axis} {c.name}' for c in changes if c.changed]
        one_sided = [c for c in changes if (c.reference is None) != (c.value is None)]
        alone = [f'{c.axis} {c.name}' for c in one_sided if '.' in c.name]
        compared = {c.name for c in changes if c.p_value is not None}
        if changed:
            yield f'  changed: {", ".join(changed)}'
        elif compared:
            yield (f'  nothing {"that both have " if one_sided else ""}changed, at a level of '
                   f'{100.0 * LEVEL:g} % for all comparisons together')
        if compared == {'trim'}:
            yield '  only the trim could be compared'
        head = ['', 'axis', '', 'before', 'after', 'change', 'error', 'chance', 'unit']
        yield from Table(head, [*_rows(changes)], range(3, 8)).text()
        either = {*reference.parameters, *flight.parameters}
        for line in chain(*(_unknown(one, either) for one in (reference, flight))):
            yield from wrapped(line, '    ', '  ')
        if alone:
            yield f'  in one of the two only, not compared: {", ".join(alone)}'
            doubtful = [c.name for c in changes if c.changed and '.' not in c.name
                        and c.name != 'trim' and any(a.startswith(f'{c.axis} ') for a in alone)]
            if doubtful:
                yield from wrapped(
                    f'{", ".join(dict.fromkeys(doubtful))} may have changed only because that '
                    'effect is in one model alone: compare with --no-effects as well', '  ')
        yield ''
    yield from wrapped('error: standard error of the change; chance: probability of so large a '
                       'change if nothing had changed', '')


def _unknown(flight: Flight, axes: Collection[str] = tuple(EVERY)) -> list[str]:
    """Which of these axes have no model, and why, in one line; none where all have one."""
    reasons = {axis: reason for axis, reason in flight.reasons.items() if axis in axes}
    return [f'{flight.source}: no model of {by_reason(reasons)}'] if reasons else []


def _rows(changes: Sequence[Change]) -> Iterator[list[str]]:
    """A row for each parameter; those of an effect below its name."""
    above = ''
    for c in changes:
        effect, _, name = c.name.rpartition('.')
        if effect and f'{c.axis} {effect}' != above:
            yield ['', c.axis, effect, *[''] * 6]
        above = f'{c.axis} {effect}'
        yield ['*' if c.changed else '', c.axis, f'  {name}' if effect else name,
               *map(number, (c.reference, c.value, c.difference, c.std, c.p_value)),
               c.unit if c.unit != '1' else '']
