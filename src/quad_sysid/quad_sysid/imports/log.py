"""A foreign log behind its reader: streams in SI units and our frames, and what became of what.

Readers (px4.py, ardupilot.py, betaflight.py) make it, to_bag.py lays it on one grid. No files.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from quad_sysid.contract import FloatArray


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
    """`PX4`, `ArduPilot`, `Betaflight`."""
    rates: Stream
    """(n, 3) rad/s, FLU. Its times are the control cycles."""
    control: Stream
    """(n, 4) U1..U4, normalised, with the contract's signs."""
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
    from_motors: bool = True
    """Whether `control` was rebuilt from motor commands; else it is the controller's output."""
    mapped: tuple[Mapped, ...] = ()
    missing: tuple[str, ...] = ()
    """What the contract knows and this log lacks, with what cannot be done without it."""
    warnings: tuple[str, ...] = ()
