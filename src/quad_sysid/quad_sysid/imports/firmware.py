"""Common parts of PX4 and ArduPilot logs: messages of named fields, a table of streams.

Both have body axes forward-right-down, world axes north-east-down and times in µs. No files.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypedDict, cast

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.imports.log import Mapped, Stream

TOPICS = {
    'rates': '/imu/data angular_velocity', 'angles': '/imu/data orientation',
    'acceleration': '/imu/data linear_acceleration', 'attitude_setpoint': '/setpoint/attitude',
    'rate_setpoint': '/setpoint/rates', 'battery': '/battery',
}
"""Topic of each stream of ForeignLog."""
LACKING = {
    'angles': 'no effects of the angle, no closed loop',
    'attitude_setpoint': 'no indirect approach, no closed loop',
    'rate_setpoint': 'the pictures lack the rate reference',
    'battery': 'no battery sag',
}
"""What cannot be done without a stream."""
NO_GAINS = "the controller's gains: no closed loop, no gain design"
ASKED_FOR = 'the input is what the controller demanded: the limits of the motors are not in it'
FAST_ENOUGH = 0.5
"""Share of the rates' rate at which motors must be logged to be taken as the input."""


class Streams(TypedDict, total=False):
    """Measurements and set-points of a ForeignLog."""

    rates: Stream
    angles: Stream
    acceleration: Stream
    attitude_setpoint: Stream
    rate_setpoint: Stream
    battery: Stream


@dataclass(frozen=True)
class Wanted:
    """A stream of the contract in one message of the log."""

    name: str
    """Field of ForeignLog, a key of TOPICS."""
    message: str
    fields: tuple[str, ...]
    unit: str
    how: str
    """The conversion in words."""
    convert: Callable[[FloatArray], FloatArray] = np.asarray
    """(n, k) fields → values of the ForeignLog."""


@dataclass(frozen=True)
class Content:
    """A log's messages of the first instance, and its parameters."""

    source: str
    messages: Mapping[str, Mapping[str, FloatArray]]
    """Columns (n,) of each message; `timestamp` in µs, or `timestamp_sample` where it is known."""
    parameters: Mapping[str, float]

    def stream(self, message: str, *fields: str) -> Stream | None:
        """Fields (n, w) over the time of the sample; None where one was not logged."""
        data = self.messages.get(message, {})
        if any(name not in data for name in fields):
            return None
        stamps = np.asarray(data.get('timestamp_sample', data['timestamp']), dtype=float)
        if not (stamps > 0).all():
            stamps = np.asarray(data['timestamp'], dtype=float)
        values = np.column_stack([np.asarray(data[name], dtype=float) for name in fields])
        order = np.argsort(stamps, kind='stable')
        order = order[np.concatenate(([True], np.diff(stamps[order]) > 0))]
        if len(order) < 2 or np.isnan(values).all(axis=0).any():
            return None
        return Stream(stamps[order] * 1e-6, values[order])

    def streams(self, wanted: Sequence[Wanted], mapped: list[Mapped]) -> Streams:
        """The first of each name that was logged, converted; told in `mapped`."""
        out: dict[str, Stream] = {}
        for one in wanted:
            found = None if one.name in out else self.stream(one.message, *one.fields)
            if found is not None:
                out[one.name] = Stream(found.time_s, one.convert(found.values))
                fields = ', '.join(dict.fromkeys(name.partition('[')[0] for name in one.fields))
                mapped.append(Mapped(f'{one.message}.{fields}', one.unit, TOPICS[one.name],
                                     one.how, found.rate_hz))
        return cast('Streams', out)


def missing(
    wanted: Sequence[Wanted], found: Streams, gains: Mapping[str, float]
) -> tuple[str, ...]:
    """Streams that were not logged, with the consequences."""
    first = {one.name: one.message for one in reversed(wanted)}
    return (*(f'{first[name]}: {text}' for name, text in LACKING.items() if name not in found),
            *(() if gains else (NO_GAINS,)))


def motors_fast(motors: Stream | None, rates: Stream, asked: Stream | None) -> bool:
    """Whether the motors are the input, not what the controller asked for."""
    return motors is not None and (
        asked is None or motors.rate_hz >= FAST_ENOUGH * rates.rate_hz)


def gains_of(
    known: Mapping[str, float], axes: Mapping[str, tuple[float, Sequence[tuple[str, str, float]]]]
) -> dict[str, float]:
    """The contract's gains from the firmware's parameters.

    By axis: the limit of the controller's output, and rows of the contract's name, the
    parameter's name and a factor. Limits and filters of 0 are none.
    """
    out: dict[str, float] = {}
    for axis, (limit, rows) in axes.items():
        for ours, theirs, factor in rows:
            if theirs in known and (known[theirs] > 0.0 or not ours.endswith(('limit', '_hz'))):
                out[f'{axis}.{ours}'] = float(known[theirs] * factor)
        if f'{axis}.rate.kp' in out:
            out[f'{axis}.rate.output_limit'] = float(limit)
    return out
