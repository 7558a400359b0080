"""How a recorded flight followed the square wave: the bag's segment cut out, figures taken."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from quad_sysid.bags import read_bag
from quad_sysid.contract import AXES, FloatArray
from quad_sysid.errors import NotInformativeError, QuadSysidError
from quad_sysid.loop.figures import EDGE_SHARE, SquareFigures, square_figures
from quad_sysid.record import Record
from quad_tuning.demo.errors import StageFailedError


@dataclass(frozen=True)
class FlownSquare:
    """The square wave of one flight: reference and angle (n,), rad, and the figures."""

    reference: FloatArray
    angle: FloatArray
    dt: float
    figures: SquareFigures


def flown_square(bag: Path, axis: str) -> FlownSquare:
    """The square wave on `axis` in a bag; raises StageFailedError where none is."""
    try:
        record = read_bag(bag)
        reference, angle = square_of(record, axis)
        figures = replace(
            square_figures(reference, angle, record.dt),
            rms_error_rad=tracking_error(reference, angle),
        )
    except QuadSysidError as error:
        raise StageFailedError('compare', str(error)) from error
    return FlownSquare(reference, angle, record.dt, figures)


def square_of(record: Record, axis: str) -> tuple[FloatArray, FloatArray]:
    """Reference and angle (n,) in rad over the square segments of `axis`, joined by a NaN.

    Raises StageFailedError where the record lacks the segment, the reference or the angle.
    """
    spans = [record.span(s) for s in record.segments if s.signal == 'square' and s.axis == axis]
    if not spans or record.attitude_setpoint is None or record.angles is None:
        raise StageFailedError(
            'compare', f'{record.source} holds no square wave on {axis} with setpoint and angle'
        )
    column = AXES.index(axis)
    reference, angle = record.attitude_setpoint[:, column], record.angles[:, column]
    return _joined(reference, spans), _joined(angle, spans)


def tracking_error(reference: FloatArray, angle: FloatArray) -> float:
    """RMS of reference - angle (n,), rad, from each square wave's first edge to its last.

    What lies outside, the ramps in and out, is no square wave. Pieces are parted by NaN.
    """
    inside: list[FloatArray] = []
    for piece in np.split(np.arange(reference.size), np.flatnonzero(np.isnan(reference))):
        jump = np.abs(np.diff(reference[piece]))
        edges = np.flatnonzero(jump > EDGE_SHARE * np.ptp(np.nan_to_num(reference[piece])))
        if edges.size > 1:
            inside.append((reference - angle)[piece][edges[0] + 1 : edges[-1] + 1])
    if not inside:
        raise NotInformativeError('square wave: fewer than two edges')
    return float(np.sqrt(np.nanmean(np.concatenate(inside) ** 2)))


def _joined(values: FloatArray, spans: list[tuple[int, int]]) -> FloatArray:
    return np.concatenate([np.append(values[start:stop], np.nan) for start, stop in spans])
