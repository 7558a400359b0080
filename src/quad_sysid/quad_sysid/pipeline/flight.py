"""What the records of an aircraft say of one axis, read once: nothing later opens a record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from quad_sysid.axes import EVERY
from quad_sysid.contract import FloatArray
from quad_sysid.foresight import drawn_hz
from quad_sysid.model.data import AxisData, axis_data
from quad_sysid.pipeline.step_b import Loop, loop_of
from quad_sysid.pipeline.usable import check_usable
from quad_sysid.record import Record
from quad_sysid.units import Units


@dataclass(frozen=True)
class AxisFlight:
    """One axis of one or several flights: its data, the loop around it, its references."""

    data: AxisData
    loop: Loop
    gains: Mapping[str, float]
    """Gains and loop constants in force during the first record's training."""
    units: Units | None
    """Units of the arrays that it came from; None: of its axis."""
    drawn_hz: float
    """Sample rate, Hz, of commands that were interpolated in between; 0 if they were not."""
    attitude_reference: FloatArray | None
    """(n,) rad, on the grid of the data; None where a record does not hold it."""
    rate_reference: FloatArray | None
    """(n,) rad/s, alike."""

    @classmethod
    def of(cls, records: Sequence[Record], axis: str) -> AxisFlight:
        """Raises NotInformativeError where the records cannot answer for the axis."""
        data, entry, first = axis_data(records, axis), EVERY[axis], records[0]
        check_usable(data, records)
        # of surge and sway it is the lean, which moves between its samples as the angles do
        commands = slice(1, None) if entry.turns else slice(1)
        drawn = [drawn_hz(record.control[:, commands], record.dt)
                 for record in records if entry.turns or entry.index < 0]
        trained = [s.start_s for s in first.segments if s.role == 'train']

        def joined(setpoints: Sequence[FloatArray | None]) -> FloatArray | None:
            columns = [setpoint[:, entry.index] for setpoint in setpoints
                       if setpoint is not None and entry.turns]
            return np.concatenate(columns) if len(columns) == len(setpoints) else None

        return cls(
            data, loop_of(records, axis), dict(first.gains_at(min(trained, default=0.0))),
            first.units, max(drawn, default=0.0),
            joined([record.attitude_setpoint for record in records]),
            joined([record.rate_setpoint for record in records]))
