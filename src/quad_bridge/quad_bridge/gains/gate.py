"""The checks of /gains/update: types, names, bounds, steps, sources. Pure.

Here a NaN is refused. The bounds are the installation's (YAML, over the table's defaults). Whether
gains are good is the designer's business; whether they turned out well the watch's.
"""

from __future__ import annotations

import json
import math
import reprlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from fnmatch import fnmatchcase

from quad_bridge.errors import BadInputError, RefusedError
from quad_bridge.gains.protocol import float32
from quad_bridge.gains.table import (
    AXES,
    DEFAULT_BOUNDS,
    LARGEST_FACTOR,
    SETTABLE,
    Bound,
    switch_of,
)
from quad_bridge.gains.watch import CLIMB, Predicted
from quad_bridge.wire.frames import Flag

FLOAT32_MAX = 3.4028234663852886e38  # nothing larger goes over the wire, and no bound is
USUAL_HZ = 250.0  # control cycles per second, where the STM32 has not said it
MAX_NAME, MAX_TEXT = 60, 4096  # characters of a name in a message; of a text
SAME = 0.02  # relative difference up to which a gain is the one that a design began from
MAX_STEPS = 16  # more than that in one update counts as a mistake: 2 to the 16 is 65536
_LIMITS = {'rate_rms_ratio': (0.5, 3.0), 'oscillation_ratio': (0.5, 3.0), 'peak': (1.0, 2.5)}
"""Limits of a prediction's effect on the watch's bounds."""
_WHOLE = 'send the whole set that quad-tune design --method lqr gives'
_NEEDS = (
    ('lqr.share', ('lqr.gain', 'lqr.k_angle', 'lqr.k_rate', 'lqr.observer'), (
        f'the state feedback does not work as long as {{0}} is 0; {_WHOLE}'
    )),
    ('sag.exponent', ('sag.reference_v',), (
        '{0} is 0; send it too: the voltage at which commands are not scaled'
    )),
)  # fmt: skip
"""A gain above 0, the others of its axis that must be above 0 then, and why."""


@dataclass(frozen=True)
class GainRequest:
    """One requested update."""

    gains: Mapping[str, float]  # contract names, SI
    source: str = 'unknown source'
    model: str = ''
    bag: str = ''
    aircraft: str = ''  # for which they are; empty: for the connected one
    rollback: bool = False  # take back what is in flight; else `gains` are an update
    predicted: Mapping[str, Predicted] = field(default_factory=dict)  # by axis
    flown: Mapping[str, float] = field(default_factory=dict)  # contract names: designed upon them


def read_request(parameters: Mapping[str, object]) -> GainRequest:
    """The request in a message's parameters. Raises RefusedError for a meaningless one."""
    rest = dict(parameters)
    names = ('source', 'model', 'bag', 'aircraft')
    texts = {n: _text(n, rest.pop(n)) for n in names if n in rest}
    for name, text in texts.items():  # which may stand in a log and in the aircraft's history
        if not text.isprintable():
            words = f'must be printable and one line: found {shorten(text)!r}'
            raise RefusedError(f'{name}: {words}')
    rollback = rest.pop('rollback', False)
    if not isinstance(rollback, bool):
        raise RefusedError(f'rollback: must be true or false: found {reprlib.repr(rollback)}')
    predicted = _predictions(_object('predicted', rest))
    flown = _object('flown', rest)
    return GainRequest(
        gains=numbers(rest), rollback=rollback, predicted=predicted, flown=flown, **texts
    )


def _object(name: str, rest: dict[str, object]) -> dict[str, float]:
    """Remove a parameter that is JSON such as `{"roll.peak": 1.2}`; its numbers, all finite."""
    text = _text(name, rest.pop(name, '{}'))
    try:
        tree = json.loads(text)
        values = numbers(tree) if isinstance(tree, dict) else None
    except (ValueError, RecursionError) as error:
        raise RefusedError(f'{name}: must be a JSON object of numbers: {error}') from error
    if values is None:
        raise RefusedError(f'{name}: must be a JSON object: found {shorten(text)}')
    for key, value in values.items():
        if not math.isfinite(value):
            raise RefusedError(f'{name}: {shorten(key)} must be finite: found {value}')
    return values


def _text(name: str, text: object) -> str:
    if not isinstance(text, str):
        raise RefusedError(f'{name}: must be a text: found {reprlib.repr(text)}')
    if len(text) > MAX_TEXT:
        words = f'must have {MAX_TEXT} characters at most: found {len(text)}'
        raise RefusedError(f'{name}: {words}')
    return text


def _predictions(pairs: Mapping[str, float]) -> dict[str, Predicted]:
    """What `{"roll.peak": 1.2, "roll.rate_rms_ratio": 0.9}` says of each axis."""
    values: dict[str, dict[str, float]] = {}
    field_names = {f.name for f in fields(Predicted)}
    for name, value in pairs.items():
        axis, _, figure = name.partition('.')
        if axis not in {*AXES, CLIMB} or figure not in field_names:
            words = f'{shorten(name)} is not known; known are {", ".join(sorted(field_names))}'
            raise RefusedError(f'predicted: {words}')
        low, high = _LIMITS[figure]
        values.setdefault(axis, {})[figure] = min(max(value, low), high)
    return {axis: Predicted(**figures) for axis, figures in values.items()}


def numbers(target: Mapping[str, object]) -> dict[str, float]:
    """The values as floats. Raises RefusedError where one is a string, a bool or too large."""
    values: dict[str, float] = {}
    for name, value in target.items():
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise RefusedError(f'{shorten(name)}: must be a number: found {reprlib.repr(value)}')
        try:
            values[name] = float(value)
        except OverflowError as error:
            raise RefusedError(f'{shorten(name)}: is too large a number') from error
    return values


def shorten(text: str) -> str:
    """A received name, shortened for one line of a log."""
    printable = ''.join(c if c.isprintable() else '?' for c in text[: MAX_NAME + 1])
    return printable if len(text) <= MAX_NAME else f'{printable[:MAX_NAME]}…'


def check_source(source: str, allowed: Sequence[str]) -> None:
    """Raise RefusedError unless `source` fits one of the patterns (`*`, `identification*`)."""
    if not any(fnmatchcase(source, pattern) for pattern in allowed):
        names = ', '.join(allowed) or 'none'
        raise RefusedError(f'the source is not allowed; parameter sources has {names}')


def check_flown(request: GainRequest, active: Mapping[str, float]) -> None:
    """Raise RefusedError where the aircraft flies other gains than the design began from.

    Then the design is of another aircraft, in another unit of the commands, or it is old. On the
    way from those gains to the new ones is where an update that was reverted has left it.
    """
    for name, value in request.flown.items():
        now = active.get(name)
        low, high = sorted((value, request.gains.get(name, value)))
        slack = SAME * max(abs(low), abs(high))
        if now is not None and not low - slack <= now <= high + slack:
            raise RefusedError(
                f'{name}: the design began from {value:.4g}, and the aircraft has {now:.4g}: it '
                'is of another aircraft or of older gains; fly, identify and design again'
            )


def refuse_climb(target: Mapping[str, float], flags: int, *, flying: bool) -> None:
    """Raise RefusedError for gains of the height mode while the pilot has the throttle."""
    climbs = any(name.startswith(f'{CLIMB}.') for name in target)
    if climbs and flying and not flags & Flag.HOLD:
        raise RefusedError('climb gains are tried in the height mode: switch it on first')


def steps(
    target: Mapping[str, float], active: Mapping[str, float], bounds: Mapping[str, Bound],
    *, at_once: bool = False,
) -> list[dict[str, float]]:  # fmt: skip
    """The sets (contract names, SI) that lead from `active` to `target`, one after the other.

    In each step each gain goes as far as it may, `at_once` the whole way; the last one is
    `target`. What has no effect as yet (a state feedback without a share) is set whole. Raises
    RefusedError with the first fault; nothing is let through in part.
    """
    if not target:
        raise RefusedError('no gain in changed_parameters; send one such as roll.rate.kp')
    for name, value in target.items():
        _check_one(name, value, active, bounds)
    for axis in AXES:
        _check_needs(axis, target, {**active, **target})
    path = [dict(target)] if at_once else _path(target, active, bounds)
    for step in path:
        for axis in {name.partition('.')[0] for name in target if '.lqr.' in name}:
            _check_observer(axis, {**active, **step})
    return path


def _path(
    target: Mapping[str, float], active: Mapping[str, float], bounds: Mapping[str, Bound]
) -> list[dict[str, float]]:
    path, now = list[dict[str, float]](), {name: active[name] for name in target}
    now.update({name: value for name, value in target.items() if _idle(name, active)})
    while any(float32(now[name]) != float32(value) for name, value in target.items()):
        if len(path) == MAX_STEPS:
            raise RefusedError(f'more than {MAX_STEPS} steps; send intermediate values first')
        now = {name: _towards(now[name], value, bounds[name]) for name, value in target.items()}
        path.append(now)
    return path or [dict(target)]


def _check_needs(axis: str, target: Mapping[str, float], gains: Mapping[str, float]) -> None:
    for name, requirement, words in _NEEDS:
        if target.get(f'{axis}.{name}', 0.0) > 0.0:
            for other in requirement:
                if not gains.get(f'{axis}.{other}', 0.0) > 0.0:
                    raise RefusedError(f'{axis}.{name}: {words.format(f"{axis}.{other}")}')


def _check_observer(axis: str, gains: Mapping[str, float]) -> None:
    """Refuse an observer whose error grows, at share 0 too: a share may follow."""
    gain, damping, observer = (
        gains.get(f'{axis}.lqr.{name}', 0.0) for name in ('gain', 'damping', 'observer')
    )
    pole = (1.0 - observer) * (1.0 - damping / gains.get('loop.rate_hz', USUAL_HZ))
    if gain > 0.0 and pole >= 1.0:
        raise RefusedError(
            f'{axis}.lqr.observer: the observer diverges: {observer:g} a cycle is too little for '
            f'a damping of {damping:g} 1/s; {_WHOLE}'
        )


def _idle(name: str, active: Mapping[str, float]) -> bool:
    """Whether a gain belongs to a part that is off: state feedback, schedule on the voltage."""
    switch = switch_of(name)
    return bool(switch) and active.get(switch, 1.0) == 0.0


def _towards(now: float, target: float, bound: Bound) -> float:
    low, high = bound.one_step(now)
    return min(max(target, low, bound.lower), high, bound.upper)


def _check_one(
    name: str, value: float, active: Mapping[str, float], bounds: Mapping[str, Bound]
) -> None:
    if name not in SETTABLE:
        listing = 'docs/reference/gains.md lists them'
        raise RefusedError(f'{shorten(name)}: no gain of this name can be set; {listing}')
    if not math.isfinite(value):
        raise RefusedError(f'{name}: must be finite: found {value}')
    bound = bounds.get(name)
    if bound is None:
        remedy = 'list it under bounds as in config/serial_bridge.yaml'
        raise RefusedError(
            f'{name}: the configuration allows no change of it: found {value:g}; {remedy}'
        )
    span = f'{bound.lower:g} .. {bound.upper:g}'
    if not bound.lower <= value <= bound.upper:
        raise RefusedError(f'{name}: must lie in {span}: found {value:g}')
    now = active.get(name)
    if now is None:
        raise RefusedError(f'{name}: the aircraft has not reported it yet; wait for /gains/active')
    slack = 1e-6 * max(abs(bound.lower), abs(bound.upper))
    if not _idle(name, active) and not bound.lower - slack <= now <= bound.upper + slack:
        words = f'its active value {now:g} lies outside {span}; bring it there by hand'
        raise RefusedError(f'{name}: {words}')


def bound_from(name: str, values: Sequence[float]) -> Bound:
    """The bound that the YAML's `[lower, upper(, max_factor(, small_step))]` means.

    Raises BadInputError naming the parameter.
    """
    standard, what = DEFAULT_BOUNDS.get(name, Bound(0.0, 0.0)), ''
    if len(values) not in {2, 3, 4}:
        what = 'must be [lower, upper] or [lower, upper, max_factor, small_step]'
    elif not all(abs(v) <= FLOAT32_MAX for v in (*values[:2], *values[3:])):  # nor is NaN
        what = 'limits must be finite, and fit a float32'
    else:
        rest = (LARGEST_FACTOR, standard.small_step)[len(values) - 2 :]
        lower, upper, factor, small = (*values, *rest)
        if lower <= upper and factor > 1.0 and small >= 0.0:
            return Bound(lower, upper, min(factor, LARGEST_FACTOR), small)
        what = 'needs lower <= upper, max_factor > 1 and small_step >= 0'
    raise BadInputError(f'parameter bounds.{name}', what, list(values))
