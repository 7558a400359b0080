"""The watch over a training segment: when it may end, over which band, with which margin."""

from __future__ import annotations

import numpy as np
import pytest

from quad_sysid.excitation_settings import MARGIN, CoverageWatch, Wanted
from quad_sysid.signals.schedule import parse_schedule

DT = 0.004
SCHEDULE = {'schedule': {'segments': [
    {'segment': 'train', 'signal': 'prbs', 'duration_s': 40.0, 'clock_s': 0.1, 'register_bits': 9},
    {'segment': 'validation', 'signal': 'square', 'duration_s': 8.0, 'period_s': 4.0},
]}}


def test_a_segment_too_short_for_the_low_end_ends_at_its_own_lowest_frequency():
    """40 s cannot tell 0.1 rad/s; their lowest is 2 pi / 25.2 s, watched with its margin.

    Asked once a second of a loop that follows; nothing is said outside training.
    """
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
    first = next(k for k, text in enumerate(said, 1) if text)
    lowest_s = 0.63 * 40.0
    assert MARGIN * lowest_s <= first < 40.0
    assert said[first - 1].startswith('0.25 to 20 rad/s covered after ')
    assert watch.found.wanted == pytest.approx((2.0 * np.pi / lowest_s / MARGIN, 20.0))
    for part in (parse_schedule(SCHEDULE, 'here').parts[1], None):
        watch.begin(part)
        assert watch.look() == ''
