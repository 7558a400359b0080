"""What stands between /gains/update and the aircraft: names, finite, bounds, steps. Pure.

The bounds are the installation's (YAML); whether gains are good is the designer's business.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from quad_bridge.errors import BadInputError, RefusedError
from quad_bridge.wire.gain_names import READ_ONLY, WIRE_NAMES


@dataclass(frozen=True)
class Bound:
    """Hard limits of one gain in its SI unit, and the largest factor it may change by at once."""

    lower: float
    upper: float
    max_factor: float = math.inf
    """Largest ratio of new to active value and of active to new; from or to 0 it does not hold."""


def check(
    wanted: Mapping[str, float],
    active: Mapping[str, float],
    bounds: Mapping[str, Bound],
    *,
    excitation_running: bool = False,
) -> dict[str, float]:
    """The writes that `wanted` (contract names, SI) amounts to, as wire name to value.

    Raises RefusedError with the first fault; nothing is let through in part.
    """
    if excitation_running:
        raise RefusedError('gains refused while the excitation runs: send them when it is idle')
    if not wanted:
        raise RefusedError('gains refused: no gain in changed_parameters')
    writes = {}
    for name, value in wanted.items():
        if name not in WIRE_NAMES or name in READ_ONLY:
            raise RefusedError(f'{name}: no gain of this name can be set')
        _check_one(name, value, active, bounds)
        writes[WIRE_NAMES[name]] = value
    return writes


def _check_one(
    name: str, value: float, active: Mapping[str, float], bounds: Mapping[str, Bound]
) -> None:
    if not math.isfinite(value):
        raise RefusedError(f'{name}: must be finite: found {value}')
    bound = bounds.get(name)
    if bound is None:
        raise RefusedError(
            f'{name}: the configuration allows no change of it: found {value:g}; '
            'list it under bounds as in config/serial_bridge.yaml'
        )
    if not bound.lower <= value <= bound.upper:
        raise RefusedError(
            f'{name}: must lie in {bound.lower:g} .. {bound.upper:g}: found {value:g}'
        )
    now = active.get(name)
    if now is None:
        raise RefusedError(f'{name}: the STM32 has not reported it yet')
    if now > 0.0 and value > 0.0 and max(value / now, now / value) > bound.max_factor:
        raise RefusedError(
            f'{name}: may change by a factor of at most {bound.max_factor:g}: '
            f'found {now:g} to {value:g}; go there in steps'
        )


def numbers(wanted: Mapping[str, object]) -> dict[str, float]:
    """The values as floats. Raises RefusedError where one is a string or a bool."""
    for name, value in wanted.items():
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise RefusedError(f'{name}: must be a number: found {value!r}')
    return {name: float(value) for name, value in wanted.items()}  # type: ignore[arg-type]


def bound_from(name: str, values: Sequence[float]) -> Bound:
    """The bound that the YAML's list `[lower, upper]` or `[lower, upper, max_factor]` means.

    Raises BadInputError naming the parameter.
    """
    where = f'parameter bounds.{name}'
    if len(values) not in {2, 3}:
        raise BadInputError(
            where, 'must be [lower, upper] or [lower, upper, max_factor]', list(values)
        )
    bound = Bound(*values)
    if not (math.isfinite(bound.lower) and math.isfinite(bound.upper)):
        raise BadInputError(where, 'limits must be finite', list(values))
    if bound.lower > bound.upper or bound.max_factor < 1.0 or math.isnan(bound.max_factor):
        raise BadInputError(where, 'needs lower <= upper and max_factor >= 1', list(values))
    return bound
