"""Parameter events of a bag → segments of the flight and changes of the gains, and back.

No files, no grid beyond a function that turns a stamp into seconds.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from quad_sysid.bags.cdr import typestore
from quad_sysid.contract import AXES
from quad_sysid.record import GainChange, Segment

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

EVENT = 'rcl_interfaces/msg/ParameterEvent'
ROLES = ('train', 'validation', 'idle')
SECOND = 1_000_000_000

Value = float | int | str | bool


@dataclass(frozen=True)
class Event:
    """`changed_parameters` of one message and its stamp in ns."""

    stamp: int
    values: Mapping[str, Value]


def decode_events(messages: Iterable[bytes]) -> tuple[list[Event], int]:
    """Events in the order of their stamps, each once, and how many could not be read."""
    events: list[Event] = []
    spoiled = 0
    for raw in messages:
        try:
            message: Any = typestore().deserialize_cdr(raw, EVENT)
        except Exception:  # noqa: BLE001 - rosbags raises many kinds on spoiled bytes
            spoiled += 1
            continue
        values: dict[str, Value] = {}
        for parameter in message.changed_parameters:
            value = parameter.value
            fields = {
                1: value.bool_value, 2: value.integer_value, 3: value.double_value,
                4: value.string_value,
            }
            if value.type in fields:
                values[parameter.name] = fields[value.type]
        event = Event(message.stamp.sec * SECOND + message.stamp.nanosec, values)
        if event not in events:
            events.append(event)
    return sorted(events, key=lambda e: e.stamp), spoiled


def encode_event(event: Event, node: str) -> bytes:
    """Serialise a ParameterEvent (CDR)."""
    store = typestore()
    types = store.types
    empty: dict[str, Any] = {
        'byte_array_value': np.array([], dtype=np.int8),
        'bool_array_value': np.array([], dtype=np.bool_),
        'integer_array_value': np.array([], dtype=np.int64),
        'double_array_value': np.array([], dtype=np.float64),
        'string_array_value': [],
    }
    changed = []
    for name, value in event.values.items():
        kind = _kind(value)
        changed.append(
            types['rcl_interfaces/msg/Parameter'](
                name=name,
                value=types['rcl_interfaces/msg/ParameterValue'](
                    type=kind,
                    bool_value=bool(value) if kind == 1 else False,
                    integer_value=int(value) if kind == 2 else 0,
                    double_value=float(value) if kind == 3 else 0.0,
                    string_value=str(value) if kind == 4 else '',
                    **empty,
                ),
            )
        )
    seconds, rest = divmod(event.stamp, SECOND)
    message = types[EVENT](
        stamp=types['builtin_interfaces/msg/Time'](sec=seconds, nanosec=rest),
        node=node, new_parameters=[], changed_parameters=changed, deleted_parameters=[],
    )
    return bytes(store.serialize_cdr(message, EVENT))


def _kind(value: Value) -> int:
    """ParameterType of a value."""
    if isinstance(value, bool):
        return 1
    if isinstance(value, int):
        return 2
    return 3 if isinstance(value, float) else 4


def segments_from(
    events: Sequence[Event], seconds: Callable[[int], float], end_s: float
) -> tuple[tuple[Segment, ...], list[str]]:
    """Each segment from its event to the next one; `seconds` turns a stamp into record time.

    A segment of several axes at once (a flight without an experiment) names them in `axes`.
    """
    segments: list[Segment] = []
    warnings: list[str] = []
    starts = [min(max(seconds(event.stamp), 0.0), end_s) for event in events]
    stops = [*starts[1:], end_s][: len(starts)]
    for event, start, stop in zip(events, starts, stops, strict=True):
        values = dict(event.values)
        role = str(values.pop('segment', ''))
        axis = str(values.pop('axis', ''))
        signal = str(values.pop('signal', 'unknown'))
        injection = str(values.pop('injection', 'unknown'))
        if role not in ROLES or (role != 'idle' and axis not in AXES):
            warnings.append(
                f'/excitation/segment: found segment {role!r}, axis {axis!r} at {start:.2f} s; '
                f'counted as idle (roles {", ".join(ROLES)}; axes {", ".join(AXES)})'
            )
            role = 'idle'
        if stop > start:
            axis = axis if axis in AXES else AXES[0]
            axes = [a for a in str(values.pop('axes', axis)).split(',') if a in AXES] or [axis]
            segments += [
                Segment(role, signal, one, injection, start, stop, values) for one in axes
            ]
    return tuple(segments), warnings


def gains_from(
    events: Sequence[Event], seconds: Callable[[int], float]
) -> tuple[GainChange, ...]:
    """Acknowledged gains with the time from which they hold."""
    changes = []
    for event in events:
        numbers = {
            name: float(value)
            for name, value in event.values.items()
            if isinstance(value, (int, float)) and not isinstance(value, bool)
        }
        if numbers:
            changes.append(GainChange(max(0.0, seconds(event.stamp)), numbers))
    return tuple(changes)
