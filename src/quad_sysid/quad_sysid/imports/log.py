"""A foreign log as read: streams in SI units and our frames, and the table of fields.

Readers (px4.py, ardupilot.py, betaflight.py, columns.py) make it, to_bag.py lays it on one grid.
No files.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TypedDict

import numpy as np

from quad_sysid.contract import AXES, FloatArray
from quad_sysid.imports.mixers import Mixer


@dataclass(frozen=True)
class Stream:
    """Samples (n, w) at times (n,) in s since the controller started, in the order of time."""

    time_s: FloatArray
    values: FloatArray

    @property
    def rate_hz(self) -> float:
        """Median rate; 0 with fewer than 2 samples."""
        steps = np.diff(self.time_s)
        usual = float(np.median(steps)) if steps.size else 0.0
        return 1.0 / usual if usual > 0.0 else 0.0


class Given(TypedDict, total=False):
    """The commands of a log: `control`, or `motors` with their mixer."""

    control: Stream
    motors: Stream
    mixer: Mixer | None


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
    mixer: Mixer | None = None
    """Mixer of the motors; None: from the motion."""
    armed: Stream | None = None
    """(n, 1) 1 where the motors follow the commands, 0 where they stand; None: always 1."""
    axes: tuple[str, ...] = AXES
    """Measured axes; the columns of the others are 0."""
    angles: Stream | None = None
    """(n, 3) roll, pitch, yaw, rad, FLU in ENU."""
    acceleration: Stream | None = None
    """(n, 3) m/s², FLU."""
    attitude_setpoint: Stream | None = None
    """(n, 3) rad."""
    rate_setpoint: Stream | None = None
    """(n, 3) rad/s."""
    battery: Stream | None = None
    """(n, 1) V."""
    gains: Mapping[str, float] = field(default_factory=dict)
    """Gains by the names of /gains/active."""
    mapped: tuple[Mapped, ...] = ()
    missing: tuple[str, ...] = ()
    """Missing streams with the consequences."""
    warnings: tuple[str, ...] = ()
    checks: tuple[str, ...] = ()
    """Doubts about columns, for the report."""
    faster: str = ''
    """Settings of the firmware with which the next flight is logged fast enough."""
    clock: tuple[str, ...] = ()
    """Repairs of the times so far."""
