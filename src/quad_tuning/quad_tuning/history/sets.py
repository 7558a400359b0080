"""An aircraft's gains over time: each set with its source and outcome, as the bridge stores it.

Reads `<folder>/<aircraft>/gains.jsonl` (quad_bridge's gains/history.py writes it); no printing.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from quad_sysid.errors import BadInputError

SCHEMA = 'quad_bridge/gains/1'
FILE = 'gains.jsonl'
GOOD = ('confirmed', 'found')
"""Outcomes of sets to which a rollback may return."""


@dataclass(frozen=True)
class GainSet:
    """One set that was active."""

    number: int
    """From 1, in the order of time."""
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
    """`found` on the STM32, `in flight`, `confirmed`, `passed` on the way, `rolled back`, ..."""
    reason: str = ''


def default_folder() -> Path:
    """Where the bridge stores it: `$ROS_HOME/quad_suite`, or in `~/.ros`."""
    home = os.environ.get('ROS_HOME')
    return (Path(home) if home else Path.home() / '.ros') / 'quad_suite'


def history_file(folder: Path, aircraft: str) -> Path:
    """The file of an aircraft; without a name the only one. Raises BadInputError."""
    found = sorted(path.parent.name for path in folder.glob(f'*/{FILE}'))
    if not found:
        raise BadInputError(str(folder), 'holds no history of gains', None,
                            "give the bridge's parameter state_folder as --folder")
    if aircraft and aircraft not in found:
        raise BadInputError('--aircraft', f'must be one of {", ".join(found)}', aircraft)
    if not aircraft and len(found) > 1:
        raise BadInputError(str(folder), 'holds several aircraft', ', '.join(found),
                            'choose one by --aircraft')
    return folder / (aircraft or found[0]) / FILE


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
        if entry.get('schema') != SCHEMA:
            raise BadInputError(str(path), f'schema must be {SCHEMA}', entry.get('schema'))
        if entry.get('state') == 'active':
            sets.append(_set(entry, len(sets) + 1))
        else:
            sets = [_ended(one, entry) for one in sets]
    return _passed(sets)


def changed(one: Mapping[str, float], other: Mapping[str, float]) -> dict[str, float]:
    """The gains of `other` that differ in `one`."""
    return {name: value
            for name, value in other.items()
            if abs(one.get(name, float('inf')) - value) > 1e-6 * max(abs(value), 1e-9)}


def way_back(sets: Sequence[GainSet],
             number: int | None = None) -> tuple[GainSet, dict[str, float]]:
    """The set `number`, or the last good set that differs, and the gains that must change.

    Raises BadInputError where there is no such set.
    """
    if not sets:
        raise BadInputError('history', 'holds no set of gains',
                            remedy='the bridge adds the first when the aircraft is connected')
    now = sets[-1].gains
    if number is not None:
        if not 1 <= number <= len(sets):
            raise BadInputError('--to', f'must be 1..{len(sets)}', number, 'see quad-tune history')
        chosen = sets[number - 1]
        return chosen, changed(now, chosen.gains)
    for one in reversed(sets[:-1]):
        difference = changed(now, one.gains)
        if one.outcome in GOOD and difference:
            return one, difference
    raise BadInputError('history', 'holds no earlier good set that differs from the present one')


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
              if isinstance(value, (int, float))}
    keys = ('source', 'model', 'bag', 'update', 'reason')
    texts = {key: str(entry.get(key, '')) for key in keys}
    outcome = 'in flight' if texts['update'] else 'found'
    return GainSet(number, str(entry.get('time', '')), values, outcome=outcome, **texts)


def _ended(one: GainSet, entry: Mapping[str, Any]) -> GainSet:
    if not one.update or one.update != entry.get('update') or one.outcome != 'in flight':
        return one
    outcome, reason = str(entry.get('state', '')), str(entry.get('reason', ''))
    return replace(one, outcome=outcome, reason=reason)


def _passed(sets: Sequence[GainSet]) -> list[GainSet]:
    """`sets` with only the last set of an update confirmed; those before it were passed."""
    last = {one.update: one.number for one in sets}
    return [
        replace(one, outcome='passed')
        if one.outcome == 'confirmed' and last[one.update] != one.number
        else one
        for one in sets
    ]
