"""Gaps in publishers' numbers are counted, new and restarted publishers are no gaps."""

import pytest

from quad_bridge.sequence import Gaps


@pytest.mark.parametrize(
    ('numbers', 'publishers', 'lost'),
    [
        ([1, 2, 3], 1, 0),
        ([40, 41, 45, 46, 50], 1, 6),
        ([40, 41, 1, 2, 3], 1, 0),  # restarted
        ([40, 41, 2, 3, 5], 1, 1),  # restarted, its first message lost unseen
        ([40, 7, 41, 8, 42, 9], 2, 0),  # two of them
        ([40, 7, 43, 8, 44, 10], 2, 3),
        ([5, 1, 6, 2, 7], 2, 0),
        ([5, 6, 8, 9, 9], 2, 2),  # the second 9 ends the gap after 6
    ],
)
def test_gaps_are_counted(numbers, publishers, lost):
    gaps = Gaps()
    assert sum(gaps.lost_before(n, lambda: publishers) for n in numbers) == lost


def test_publishers_are_asked_for_only_where_no_turn_fits():
    gaps, asked = Gaps(), []
    for n in (7, 8, 9, 12, 13):
        gaps.lost_before(n, lambda: asked.append(1) or 1)
    assert len(asked) == 2
