"""A foreign log as read: streams in SI units and our frames, and the table of fields.

A reader (px4.py, ardupilot.py, betaflight.py) opens its file as a Table and says with rows of
Signal what each column is; columns.py has that from the user. to_bag.py puts the result on one
grid. No files.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from quad_sysid.contract import AXES, FloatArray
from quad_sysid.craft import Craft
from quad_sysid.files import escaped
from quad_sysid.imports.clock import Stream
from quad_sysid.imports.mixers import Mixer
from quad_sysid.imports.plausible import FASTEST_M_S, FASTEST_RAD_S
from quad_sysid.record import GainChange

if TYPE_CHECKING:
    from quad_sysid.imports.table import Table

DEGREE, RPM = np.pi / 180.0, np.pi / 30.0
"""One degree in rad, one turn a minute in rad/s."""
TOPICS = {
    'rates': '/imu/data angular_velocity', 'angles': '/imu/data orientation',
    'acceleration': '/imu/data linear_acceleration', 'attitude_setpoint': '/setpoint/attitude',
    'rate_setpoint': '/setpoint/rates', 'battery': '/battery', 'control': '/control/wrench',
    'motors': '/motors/command', 'speeds': '/motors/state', 'velocity': '/odom twist',
    'position': '/odom pose',
    'rates_before': 'quad-sysid look', 'd_term': 'quad-sysid look',
}
"""Topic of each stream of ForeignLog, or who alone reads it."""
CONSEQUENCES = {
    'angles': 'no effects of the angle, no closed loop',
    'attitude_setpoint': 'no indirect approach, no closed loop',
    'rate_setpoint': 'the pictures lack the rate reference',
    'battery': 'no battery sag',
    'velocity': 'no surge and sway; the climb needs it too',
}
"""What cannot be done without a stream."""
NO_GAINS = "the controller's gains: no closed loop, no gain design"
DEMAND_ONLY = 'the input is what the controller demanded: the limits of the motors are not in it'
LARGEST = {
    'rates': (FASTEST_RAD_S, 'no gyro measures such rates'),
    'velocity': (FASTEST_M_S, 'nothing that hovers is so fast'),
    **dict.fromkeys(('control', 'motors'), (10.0, 'no controller commands so much')),
}
"""Of a stream, what only damage exceeds, in its unit, and why."""
FAST_ENOUGH = 0.5
"""Share of the rates' rate at which motors must be logged to be used as the input, and below which
a warning says that commands are slow."""


@dataclass(frozen=True)
class Experiment:
    """One excitation that a firmware injected into one axis."""

    axis: str
    signal: str
    """`chirp`, `square`, …, as in a Segment."""
    injection: str
    """`attitude`, `rate` or `control`."""
    added: Stream
    """(n, 1) rad, rad/s or normalised command, FLU."""
    parameters: Mapping[str, float] = field(default_factory=dict)
    """The signal's own, as the log says."""


@dataclass(frozen=True)
class Mapped:
    """One line of the table: what a field of the log became."""

    source: str
    unit: str
    """Unit in the log."""
    topic: str
    """Topic of the contract, with the field."""
    how: str
    """The conversion in words."""
    rate_hz: float = 0.0


@dataclass(frozen=True)
class ForeignLog:
    """A log's content by the contract; streams that it lacks are None."""

    source: str
    kind: str
    """`a PX4 log`, `a table`, …"""
    rates: Stream | None
    """(n, 3) rad/s, FLU. Its times are the control cycles; without it those of the angles are, and
    the rates are their derivative."""
    control: Stream | None = None
    """(n, 4) U1..U4, normalised, with the contract's signs; None where there are motors."""
    motors: Stream | None = None
    """(n, k) commands 0..1 in the log's own order."""
    crafts: tuple[Craft | Mixer, ...] = ()
    """The craft; several where the log leaves some open, which the motion decides; none: all comes
    from the motion."""
    speeds: Stream | None = None
    """(n, k) measured speeds of the rotors in the order of the motors, rad/s; NaN: not known."""
    loop_s: float | None = None
    """Cycle of the controller that makes the commands, s; None: not known, all are logged."""
    utc_s: float | None = None
    """Time 0 of its clock in UTC, s since 1970; None: not known."""
    armed: Stream | None = None
    """(n, 1) 1 where the motors follow the commands, 0 where they stand; None: always 1."""
    axes: tuple[str, ...] = AXES
    """Measured axes; the columns of the others are 0."""
    angles: Stream | None = None
    """(n, 3) roll, pitch, yaw, rad, FLU in ENU."""
    acceleration: Stream | None = None
    """(n, 3) m/s², FLU."""
    velocity: Stream | None = None
    """(n, 3) m/s over the ground, ENU."""
    position: Stream | None = None
    """(n, 3) m, ENU; its slope is the velocity where that is not logged."""
    attitude_setpoint: Stream | None = None
    """(n, 3) rad."""
    rate_setpoint: Stream | None = None
    """(n, 3) rad/s."""
    battery: Stream | None = None
    """(n, 1) V."""
    rates_before: Stream | None = None
    """(n, 3) rad/s, FLU, before the flight controller's filters."""
    d_term: Stream | None = None
    """(n, k) the D part of the first k axes, normalised command."""
    gains: Mapping[str, float] = field(default_factory=dict)
    """Gains by the names of /gains/active."""
    gain_changes: tuple[GainChange, ...] = ()
    """Gains that changed in flight; times in the log's own, s."""
    experiments: tuple[Experiment, ...] = ()
    mapped: tuple[Mapped, ...] = ()
    missing: tuple[str, ...] = ()
    """Missing streams with the consequences."""
    warnings: tuple[str, ...] = ()
    reversing: Mapping[str, str] = field(default_factory=dict)
    """Axis → the option that turns the sign of its command."""
    checks: tuple[str, ...] = ()
    """Doubts about columns, for the report."""
    faster: str = ''
    """Settings of the firmware with which the next flight is logged fast enough."""
    clock: tuple[str, ...] = ()
    """Repairs so far, and parts that could not be read, in words."""

    def __post_init__(self) -> None:
        """Make the name one that every page and picture can show."""
        object.__setattr__(self, 'source', escaped(self.source))


@dataclass(frozen=True)
class Signal:
    """A stream of the contract, as columns of a log."""

    role: str
    """Field of ForeignLog, a key of TOPICS."""
    columns: tuple[str, ...]
    unit: str
    how: str
    """The conversion in words."""
    convert: Callable[[FloatArray], FloatArray] = np.asarray
    """(n, k) columns → values of the ForeignLog."""


def per_torque(units: Sequence[float]) -> str:
    """What `quad-tune export` asks for, from our command per unit of their torque, by axis."""
    text = ', '.join(f'{axis}={unit:.4g}' for axis, unit in zip(AXES, units, strict=True))
    return f'--scale of quad-tune export, our command per unit of their torque: {text}'


def changes_of(
    table: Table, names: Collection[str],
    gains: Callable[[Mapping[str, Any]], Mapping[str, float]],
) -> tuple[GainChange, ...]:
    """The gains after each change of one of these parameters, by `gains` of all parameters."""
    known, out = dict(table.header), dict[float, GainChange]()
    for change in table.changed:
        if change.name in names and np.isfinite(change.value) \
                and known.get(change.name) != change.value:
            known[change.name] = change.value
            out[change.time_s] = GainChange(change.time_s, gains(known))
    return tuple(out.values())


def within(message: str, *fields: str) -> tuple[str, ...]:
    """The columns of these fields of a message."""
    return tuple(f'{message}.{field}' for field in fields)


@dataclass
class Reading:
    """A table that is turned into a ForeignLog, with the streams read so far."""

    table: Table
    streams: dict[str, Stream] = field(default_factory=dict)
    mapped: list[Mapped] = field(default_factory=list)

    def take(self, *signals: Signal) -> None:
        """Take the first of each role whose columns were logged."""
        for signal in signals:
            stream = None if signal.role in self.streams else self.table.stream(*signal.columns)
            if stream is not None:
                self.put(signal, Stream(stream.time_s, signal.convert(stream.values)))

    def put(self, signal: Signal, stream: Stream) -> None:
        """Take a stream that was made of the columns of `one`, but for damaged samples."""
        message = signal.columns[0].rpartition('.')[0]
        fields = dict.fromkeys(name.removeprefix(f'{message}.').partition('[')[0]
                               for name in signal.columns)
        source = '.'.join(filter(None, (message, ', '.join(fields))))
        largest, why = LARGEST.get(signal.role, (np.inf, ''))
        wrong = (np.abs(stream.values) > largest).any(axis=1)
        if wrong.any():
            note = f'{wrong.sum()} of {wrong.size} {source} left out: {why}'
            self.table = replace(self.table, notes=(*self.table.notes, note))
            stream = Stream(stream.time_s[~wrong], stream.values[~wrong])
        self.streams[signal.role] = stream
        self.mapped.append(
            Mapped(source, signal.unit, TOPICS[signal.role], signal.how, stream.rate_hz))

    def log(self, kind: str, signals: Sequence[Signal], **more: Any) -> ForeignLog:
        """The log, with what it lacks of these channels; `more` are its other fields."""
        first = {signal.role: signal.columns[0].rpartition('.')[0] or signal.columns[0]
                 for signal in reversed(signals)}
        consequences = [f'{first[role]}: {text}' for role, text in CONSEQUENCES.items()
                        if role in first and role not in self.streams]
        no_gains = more.pop('no_gains', NO_GAINS)
        consequences += [] if more.get('gains') else [no_gains]
        return ForeignLog(self.table.source, kind, clock=self.table.notes,
                          **{'rates': None, **self.streams, **more},
                          mapped=tuple(self.mapped), missing=tuple(consequences))

    def motors_fast(self, motors: Stream | None, command: Stream | None) -> bool:
        """Whether the motors, instead of the controller's demand, are the input."""
        return motors is not None and (
            command is None or motors.rate_hz >= FAST_ENOUGH * self.streams['rates'].rate_hz)
