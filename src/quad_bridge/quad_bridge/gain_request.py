"""What a message on /gains/update asks for: gains, from whom, and what the design predicts."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields

from quad_bridge.errors import RefusedError
from quad_bridge.gain_gate import numbers, shorten
from quad_bridge.gain_watch import AXES, Predicted

_LIMITS = {'rate_rms_ratio': (0.5, 3.0), 'oscillation_ratio': (0.5, 3.0), 'peak': (1.0, 2.5)}
"""How far a prediction may move the watch's bounds; beyond, the limit counts."""
LONGEST = 4096
"""Characters of a text."""


@dataclass(frozen=True)
class GainRequest:
    """One update as it was asked for."""

    gains: Mapping[str, float]
    """Contract names, SI."""
    source: str = 'unknown source'
    model: str = ''
    bag: str = ''
    rollback: bool = False
    """Take back what is in flight; with nothing in flight `gains` are an update."""
    predicted: Mapping[str, Predicted] = field(default_factory=dict)
    """Axis to what the design says of it."""


def read_request(parameters: Mapping[str, object]) -> GainRequest:
    """The request of a message's parameters. Raises RefusedError where one has no meaning."""
    rest = dict(parameters)
    texts = {n: _text(n, rest.pop(n)) for n in ('source', 'model', 'bag') if n in rest}
    rollback = bool(rest.pop('rollback', False))
    predicted = _predictions(_short('predicted', rest.pop('predicted', '{}')))
    return GainRequest(gains=numbers(rest), rollback=rollback, predicted=predicted, **texts)


def _text(name: str, value: object) -> str:
    """A text that may stand in a log and in the aircraft's history."""
    text = _short(name, value)
    if not text.isprintable():
        raise RefusedError(f'{name}: must be printable and one line: found {shorten(text)!r}')
    return text


def _short(name: str, value: object) -> str:
    text = str(value)
    if len(text) > LONGEST:
        raise RefusedError(f'{name}: must have {LONGEST} characters at most: found {len(text)}')
    return text


def _predictions(text: str) -> dict[str, Predicted]:
    """Of JSON such as `{"roll.peak": 1.2, "roll.rate_rms_ratio": 0.9}`."""
    try:
        said = json.loads(text)
        pairs = numbers(dict(said))
    except (ValueError, TypeError, RecursionError) as error:
        raise RefusedError(f'predicted: must be a JSON object of numbers: {error}') from error
    values: dict[str, dict[str, float]] = {}
    known = {f.name for f in fields(Predicted)}
    for name, value in pairs.items():
        axis, _, figure = name.partition('.')
        if axis not in AXES or figure not in known:
            words = f'{shorten(name)} is not known; known are {", ".join(sorted(known))}'
            raise RefusedError(f'predicted: {words}')
        if not math.isfinite(value):
            raise RefusedError(f'predicted: {name} must be finite: found {value}')
        low, high = _LIMITS[figure]
        values.setdefault(axis, {})[figure] = min(max(value, low), high)
    return {axis: Predicted(**figures) for axis, figures in values.items()}
