"""What a message on /gains/update asks for: gains, from whom, and what the design predicts."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields

from quad_bridge.errors import RefusedError
from quad_bridge.gain_gate import numbers
from quad_bridge.gain_watch import AXES, Predicted

PREDICTED = 'predicted.'
_LIMITS = {'rate_rms_ratio': (0.5, 3.0), 'oscillation_ratio': (0.5, 3.0), 'peak': (1.0, 2.5)}
"""How far a prediction may move the watch's bounds; beyond, the limit counts."""


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
    texts = {name: str(rest.pop(name)) for name in ('source', 'model', 'bag') if name in rest}
    rollback = bool(rest.pop('rollback', False))
    said = {n: rest.pop(n) for n in list(rest) if n.startswith(PREDICTED)}
    return GainRequest(
        gains=numbers(rest), rollback=rollback, predicted=_predictions(numbers(said)), **texts
    )


def _predictions(said: Mapping[str, float]) -> dict[str, Predicted]:
    values: dict[str, dict[str, float]] = {}
    known = {f.name for f in fields(Predicted)}
    for name, value in said.items():
        axis, _, figure = name.removeprefix(PREDICTED).partition('.')
        if axis not in AXES or figure not in known:
            raise RefusedError(f'{name}: no such prediction; known are {", ".join(sorted(known))}')
        if not math.isfinite(value):
            raise RefusedError(f'{name}: must be finite: found {value}')
        low, high = _LIMITS[figure]
        values.setdefault(axis, {})[figure] = min(max(value, low), high)
    return {axis: Predicted(**figures) for axis, figures in values.items()}
