"""The square wave is cut out of the right segment and axis of a record."""

from __future__ import annotations

import math

import numpy as np
import pytest

from quad_sysid.loop.figures import square_figures, square_wave
from quad_sysid.record import Record, Segment
from quad_tuning.demo.comparison import square_of, tracking_error
from quad_tuning.demo.errors import StageFailedError

DT = 0.004


def flown(axis: str) -> Record:
    """A record whose pitch follows a square of 0.2 rad by a first-order lag of 0.1 s, from 3 s."""
    wave = square_wave(0.2, 1.5, 3, DT)
    n0 = round(3.0 / DT)
    reference = np.concatenate([np.full(n0, 5.0), wave])
    angle = np.zeros_like(reference)
    for k in range(n0, len(reference)):
        angle[k] = angle[k - 1] + (reference[k - 1] - angle[k - 1]) * DT / 0.1
    zeros = np.zeros((len(reference), 3))
    setpoint, angles = zeros.copy(), zeros.copy()
    setpoint[:, 1], angles[:, 1] = reference, angle
    square = Segment('validation', 'square', axis, 'attitude', 3.0, len(reference) * DT)
    return Record(
        'flight', DT, zeros, np.zeros((len(reference), 4)), angles=angles,
        attitude_setpoint=setpoint, segments=(square,),
    )  # fmt: skip


def test_the_figures_are_those_of_the_segment() -> None:
    reference, angle = square_of(flown('pitch'), 'pitch')
    figures = square_figures(reference, angle, DT)
    assert figures.rise_time_s == pytest.approx(0.1 * math.log(9), abs=2 * DT)
    assert figures.overshoot_pct < 0.1
    assert figures.step_rad == pytest.approx(0.4, rel=0.01)


def test_ramps_in_and_out_count_for_nothing() -> None:
    wave = square_wave(0.2, 1.5, 3, DT)
    edge = round(1.5 / DT)
    angle = wave - 0.05
    angle[:edge] = angle[-edge:] = 7.0
    assert tracking_error(wave, angle) == pytest.approx(0.05)
    twice = np.concatenate([wave, [np.nan], wave, [np.nan]])
    both = np.concatenate([angle, [np.nan], angle + 0.1, [np.nan]])
    both[-edge - 1 :] = both[wave.size + 1 : wave.size + 1 + edge] = -3.0
    assert tracking_error(twice, both) == pytest.approx(0.05)


def test_a_flight_without_a_square_on_the_axis_is_named() -> None:
    with pytest.raises(StageFailedError, match='flight holds no square wave on roll'):
        square_of(flown('pitch'), 'roll')
