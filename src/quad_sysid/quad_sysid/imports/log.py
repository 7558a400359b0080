"""A foreign log behind its reader: streams in SI units and our frames, and what became of what.

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
    """The commands of a log as ForeignLog takes them: one of the two."""

    control: Stream
    motors: Stream
    mixer: Mixer | None


@dataclass(frozen=True)
class Mapped:
    """One line of the table: what a field of the log became."""

    source: str
    unit: str
    """In the log."""
    topic: str
    """Of the contract, with the field."""
    how: str
    """Conversion written out."""
    rate_hz: float = 0.0


@dataclass(frozen=True)
class ForeignLog:
    """What a log holds of the contract. Optional streams are None where it lacks them."""

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
    """What the motors do; None: what the motion shows."""
    armed: Stream | None = None
    """(n, 1) 1 where the motors follow the commands, 0 where they stand; None: they always do."""
    axes: tuple[str, ...] = AXES
    """Those that were measured; the others' columns are 0."""
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
    """As /gains/active has them."""
    mapped: tuple[Mapped, ...] = ()
    missing: tuple[str, ...] = ()
    """What the contract knows and this log lacks, with what cannot be done without it."""
    warnings: tuple[str, ...] = ()
    checks: tuple[str, ...] = ()
    """What is odd about columns, for the report."""
    faster: str = ''
    """What to set in the firmware so that the next flight is logged fast enough."""
    clock: tuple[str, ...] = ()
    """What was done to the times before."""
