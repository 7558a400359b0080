"""The watch over a training segment: when it may end, over which band, with which margin."""

from __future__ import annotations

import numpy as np
import pytest

from quad_bridge.monitor.coverage import needed_s
from quad_sysid.excitation_settings import MARGIN, CoverageWatch, Wanted
from quad_sysid.signals.schedule import parse_schedule

DT = 0.004
def train(axis: str, seconds: float) -> dict:
    return {'segment': 'train', 'signal': 'prbs', 'axis': axis, 'duration_s': seconds,
            'clock_s': 0.1, 'register_bits': 9}


SCHEDULE = {'schedule': {'segments': [
    train('roll', 40.0), {'segment': 'validation', 'signal': 'square', 'axis': 'roll',
                          'duration_s': 8.0, 'period_s': 4.0},
    train('pitch', 30.0), train('pitch', 60.0),
]}}


@pytest.fixture
def told():
    """The watch of the roll segment, and what it says after each second of a loop that follows."""
    watch = CoverageWatch(Wanted((0.1, 20.0), 5.0))
    watch.begin(parse_schedule(SCHEDULE, 'here').parts[0])
    rng = np.random.default_rng(1)
    pairs = watch._pairs
    said, rate, angle = [], 0.0, 0.0
    levels = np.repeat(rng.choice([-0.2, 0.2], 400), 25)
    for k, level in enumerate(levels.tolist()):
        rate += 0.08 * (3.0 * (level - angle) - rate)
        angle += DT * rate
        pairs.rate(k * 4_000_000, rate + 0.005 * rng.standard_normal())
        pairs.excitation(k * 4_000_000, level)
        if k % 250 == 249:
            said.append(watch.look())
    return watch, said


def test_a_segment_too_short_for_the_low_end_ends_at_its_own_lowest_frequency(told):
    """40 s cannot tell 0.1 rad/s; their lowest is 2 pi / 25.2 s, watched with its margin.

    Nothing is said outside training.
    """
    watch, said = told
    first = next(k for k, text in enumerate(said, 1) if text)
    lowest_s = 0.63 * 40.0
    assert MARGIN * lowest_s <= first < 40.0
    assert said[first - 1].startswith('0.25 to 20 rad/s covered after ')
    assert watch.found.wanted == pytest.approx((2.0 * np.pi / lowest_s / MARGIN, 20.0))
    for part in (parse_schedule(SCHEDULE, 'here').parts[1], None):
        watch.begin(part)
        assert watch.look() == ''


def test_a_schedule_tells_how_long_it_trains():
    schedule = parse_schedule(SCHEDULE, 'here')
    assert schedule.training_s == 40.0  # pitch has 60 s in one piece
    assert needed_s(0.1) > schedule.training_s
    idle = parse_schedule({'schedule': {'segments': [
        {'segment': 'idle', 'duration_s': 3.0}]}}, 'here')
    assert idle.training_s == 0.0
