"""Parameter events of a bag → segments of the flight and changes of the gains, and back.

No files; a function converts stamps to seconds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from quad_sysid.axes import EVERY
from quad_sysid.bags.cdr import blank, typestore
from quad_sysid.contract import AXES, IDLE, FloatArray
from quad_sysid.record import ROLES, GainChange, Segment

EVENT = 'rcl_interfaces/msg/ParameterEvent'
DESATURATION = 'mixer.desaturation'
DESATURATIONS = ('clip', 'yaw_first', 'none')
"""Its values; the first holds where a bag does not say."""
KINDS: dict[int, tuple[str, type]] = {1: ('bool_value', bool), 2: ('integer_value', int),
                                      3: ('double_value', float), 4: ('string_value', str)}
"""ParameterType to the field that holds the value, and its type; True counts as a bool."""
UNEXCITED_S = 1.0
"""The longest time from the last excitation to an end that was announced."""

Value = float | int | str | bool


@dataclass(frozen=True)
class Event:
    """`changed_parameters` of one message and its stamp in ns."""

    stamp: int
    values: Mapping[str, Value]


def decode_events(messages: Iterable[bytes]) -> tuple[list[Event], int]:
    """Events in the order of their stamps, each once, and the number of unreadable ones."""
    events: list[Event] = []
    unreadable = 0
    for raw in messages:
        try:
            message: Any = typestore().deserialize_cdr(raw, EVENT)
        except Exception:  # noqa: BLE001 - rosbags raises many kinds on spoiled bytes
            unreadable += 1
            continue
        values: dict[str, Value] = {}
        for parameter in message.changed_parameters:
            value = parameter.value
            if value.type in KINDS:
                values[parameter.name] = getattr(value, KINDS[value.type][0])
        event = Event(message.stamp.sec * 10**9 + message.stamp.nanosec, values)
        if event not in events:
            events.append(event)
    return sorted(events, key=lambda e: e.stamp), unreadable


def encode_event(event: Event, node: str) -> bytes:
    """Serialise a ParameterEvent (CDR)."""
    message = blank(EVENT, node=node)
    message.stamp.sec, message.stamp.nanosec = divmod(event.stamp, 10**9)
    message.changed_parameters = [
        blank('rcl_interfaces/msg/Parameter', name=name, value=_value(value))
        for name, value in event.values.items()
    ]
    return bytes(typestore().serialize_cdr(message, EVENT))


def _value(value: Value) -> Any:
    """A ParameterValue of the value's type."""
    kind = next(k for k, own in KINDS.items() if isinstance(value, own[1]))
    return blank('rcl_interfaces/msg/ParameterValue', type=kind,
                 **{KINDS[kind][0]: KINDS[kind][1](value)})


def segments_from(events: Sequence[Event], seconds: Callable[[int], float],
                  end_s: float) -> tuple[tuple[Segment, ...], list[str]]:
    """Segments, each from its event to the next, and warnings; `seconds` converts stamps.

    An event for several axes at once (a flight without an experiment) names them in `axes`.
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
        if role not in ROLES or (role != 'idle' and axis not in EVERY):
            warnings.append(
                f'/excitation/segment: found segment {role!r}, axis {axis!r} at {start:.2f} s; '
                f'counted as idle (roles {", ".join(ROLES)}; axes {", ".join(EVERY)})'
            )
            role = 'idle'
        if stop > start:
            axis = axis if axis in EVERY else AXES[0]
            axes = [a for a in str(values.pop('axes', axis)).split(',') if a in EVERY] or [axis]
            segments += [
                Segment(role, signal, axis, injection, start, stop, values) for axis in axes
            ]
    return tuple(segments), warnings


def as_excited(segments: tuple[Segment, ...], excitation: FloatArray | None,
               dt: float) -> tuple[tuple[Segment, ...], list[str]]:
    """`segments`, each to its last excitation at the latest, and warnings.

    A node that was killed announces no end. `excitation`: (n, w) by cycle, NaN where none was
    applied; a segment without any is left as it is.
    """
    if excitation is None:
        return segments, []
    applied = np.asarray(np.isfinite(excitation).all(axis=1))
    ended, warnings = [], []
    for segment in segments:
        first, behind = (round(at_s / dt) for at_s in (segment.start_s, segment.end_s))
        excited = np.flatnonzero(applied[first:behind])
        end_s = float(first + excited[-1] + 1) * dt if excited.size else segment.end_s
        if segment.role != 'idle' and segment.end_s - end_s > UNEXCITED_S:
            warnings.append(f'/excitation/segment: {segment.role} of {segment.axis} ends at '
                            f'{end_s:.2f} s, with its last excitation')
            ended.append(replace(segment, end_s=end_s))
        else:
            ended.append(segment)
    return tuple(ended), warnings


def desaturation_from(events: Sequence[Event]) -> str:
    """Value of `mixer.desaturation`: the treatment of commands beyond the motors' range."""
    values = [str(event.values[DESATURATION]) for event in events if DESATURATION in event.values]
    return values[-1] if values and values[-1] in DESATURATIONS else DESATURATIONS[0]


def idle_from(events: Sequence[Event]) -> float:
    """The smallest command of a motor in flight, `mixer.idle`; 0 where nothing says so."""
    values = [event.values[IDLE] for event in events if IDLE in event.values]
    return float(values[-1]) if values and isinstance(values[-1], int | float) else 0.0


def gains_from(events: Sequence[Event], seconds: Callable[[int], float]) -> tuple[GainChange, ...]:
    """Acknowledged gains with the time from which they apply."""
    changes = []
    for event in events:
        numbers = {name: float(value)
                   for name, value in event.values.items()
                   if isinstance(value, (int, float)) and not isinstance(value, bool)}
        if numbers:
            changes.append(GainChange(max(0.0, seconds(event.stamp)), numbers))
    return tuple(changes)
