"""A record → what it holds, per axis and as a whole: excitation, coherence, limits, battery.

Nothing is fitted: this is what can be said at once. Words for a reader stand in page.py, what the
data suffice for in uses.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from quad_sysid.bags import read_bag, split_segments
from quad_sysid.blackbox import excitation_order
from quad_sysid.contract import MIXER, MIXER_INVERSE
from quad_sysid.errors import BadInputError, NotInformativeError, QuadSysidError
from quad_sysid.inspection.topics import Topics, topics
from quad_sysid.inspection.uses import MOVES, Use, uses_of_axis, uses_of_flight
from quad_sysid.model.data import AxisData, axis_data
from quad_sysid.motor_layout import Pattern, doubts, patterns_of
from quad_sysid.pipeline.assemble import band_of
from quad_sysid.pipeline.blackbox_part import io_data
from quad_sysid.pipeline.identify import asked_axes
from quad_sysid.pipeline.motor_order import refusal
from quad_sysid.pipeline.usable import AT_LIMIT
from quad_sysid.record import Record, Segment

RICHEST = 50
"""Order up to which excitation is counted; the paper's PRBS is of this order or more."""


@dataclass(frozen=True)
class AxisContent:
    """One axis over its training segments; figures are None where it has none."""

    axis: str
    train_s: float
    validation_s: float
    windows: int
    """Free-run windows of 0.5 s in the validation segments."""
    rate_rms: float | None
    """rad/s about the mean."""
    command_rms: float | None
    """Normalised, about the mean."""
    reference_rms: float | None
    """rad, rad/s or normalised, as the excitation is injected; None where the bag lacks it."""
    excitation_order: int | None
    """Order to which the command is persistently exciting, at most RICHEST; 0: it stands still."""
    coherent_band_rad_s: tuple[float, float] | None
    """Widest unbroken band of squared coherence above 0.6."""
    uses: tuple[Use, ...]

    @property
    def identifiable(self) -> bool:
        """Whether a model can be fitted at all."""
        return self.uses[0].possible


@dataclass(frozen=True)
class Battery:
    """Pack voltage over the flight, V."""

    first: float
    last: float
    lowest: float


@dataclass(frozen=True)
class Content:
    """What a bag holds."""

    source: str
    topics: Topics
    sample_rate_hz: float | None = None
    length_s: float = 0.0
    lost_pct: float = 0.0
    """Of the control cycles, no /imu/data."""
    longest_gap_s: float = 0.0
    split: bool = False
    """Whether the bag names no segments and was cut in time."""
    segments: tuple[Segment, ...] = ()
    gains: tuple[str, ...] = ()
    """Names in /gains/active, in the order of the alphabet."""
    motors_at_limit_pct: tuple[float, ...] = ()
    """Per motor, share of the time at 0 or 1; empty where /motors/command is missing."""
    battery: Battery | None = None
    layout: tuple[Pattern, ...] = ()
    """What the motors do to each axis that moves, by the motion; in the order of the contract."""
    axes: tuple[AxisContent, ...] = ()
    uses: tuple[Use, ...] = ()
    """Of the flight as a whole."""
    unusable: str = ''
    """Why it is no record at all; then only the topics are told."""
    warnings: tuple[str, ...] = ()


def content(path: str | Path) -> Content:
    """Look at a bag; raises BadInputError where there is none to be read."""
    source = str(path)
    held = topics(Path(path))
    try:
        record = read_bag(path)
    except BadInputError as error:
        return Content(source, held, unusable=str(error), warnings=held.warnings)
    named = any(s.role in ('train', 'validation') for s in record.segments)
    with threadpool_limits(limits=1):
        return of_record(split_segments(record), held, split=not named)


def of_record(record: Record, held: Topics, *, split: bool) -> Content:
    """Look at a record that has its segments."""
    lost = np.asarray(np.isnan(record.rates).any(axis=1))
    warning = refusal(record)
    axes = tuple(_axis(record, axis) for axis in asked_axes([record]))
    motors = record.control @ MIXER.T if record.motors is None else record.motors
    layout = patterns_of(record.rates, motors, record.dt, record.angles)
    odd = doubts("the contract's mixer", MIXER_INVERSE, layout, record.rates, motors, record.dt,
                 record.angles)
    return Content(
        record.source, held,
        sample_rate_hz=1.0 / record.dt,
        length_s=record.n * record.dt,
        lost_pct=100.0 * float(np.mean(lost)),
        longest_gap_s=_longest(lost) * record.dt,
        split=split,
        segments=record.segments,
        gains=tuple(sorted(record.gains_at(np.inf))),
        motors_at_limit_pct=_at_limit(record),
        battery=_battery(record),
        layout=layout,
        axes=axes,
        uses=uses_of_flight(
            tuple(one.axis for one in axes if one.identifiable),
            moving=any(one.windows and one.rate_rms and one.command_rms for one in axes),
        ),
        warnings=(*record.warnings, *((warning,) if warning else ()), *odd),
    )


def _axis(record: Record, axis: str) -> AxisContent:
    lengths = {
        role: sum(s.end_s - s.start_s for s in record.segments
                  if s.role == role and s.axis == axis)
        for role in ('train', 'validation')
    }
    try:
        data = axis_data([record], axis)
    except NotInformativeError as error:
        return AxisContent(
            axis, lengths['train'], lengths['validation'], 0, None, None, None, None, None,
            (Use(f'identify {axis}', possible=False,
                 because=str(error).removeprefix(f'{axis}: ')),),
        )
    windows = data.windows(data.validation).count
    uses = uses_of_axis(record, data)
    if not data.train:
        return AxisContent(
            axis, lengths['train'], lengths['validation'], windows, None, None, None, None, None,
            uses,
        )
    reference = None if data.reference is None else _rms(data, data.reference)
    command = _rms(data, data.command)
    return AxisContent(
        axis, lengths['train'], lengths['validation'], windows, _rms(data, data.rate),
        command, reference, _order(data, command),
        band_of(data) if command and command > MOVES else None, uses,
    )


def _order(data: AxisData, command_rms: float | None) -> int | None:
    if command_rms is not None and command_rms <= MOVES:
        return 0  # else rounding of the mixer would count as excitation
    try:
        return excitation_order(io_data(data, data.train), RICHEST)
    except QuadSysidError:
        return None


def _rms(data: AxisData, signal: np.ndarray) -> float | None:
    """Standard deviation over the training segments; None where it is not known there."""
    used = np.concatenate([signal[a:b] for a, b in data.train])
    return float(np.std(used)) if np.isfinite(used).all() else None


def _longest(lost: np.ndarray) -> int:
    edges = np.flatnonzero(np.diff(np.concatenate(([False], lost, [False]))))
    return int(np.max(edges[1::2] - edges[::2], initial=0))


def _at_limit(record: Record) -> tuple[float, ...]:
    if record.motors is None:
        return ()
    known = record.motors[np.isfinite(record.motors).all(axis=1)]
    stuck = (known <= AT_LIMIT) | (known >= 1.0 - AT_LIMIT)
    return tuple(float(100.0 * share) for share in stuck.mean(axis=0))


def _battery(record: Record) -> Battery | None:
    if record.battery_v is None:
        return None
    volts = record.battery_v[np.isfinite(record.battery_v)]
    if not volts.size:
        return None
    return Battery(float(volts[0]), float(volts[-1]), float(volts.min()))


