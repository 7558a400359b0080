"""A node's own standstill is left out of the age of what it heard, a silent link never."""

from __future__ import annotations

import pytest

from quad_sysid.signals.guard import LONGEST_S, STALL_S, Stall

DT = 0.004
STALE_S = 0.2


def ages(times: list[float], stall: Stall | None = None) -> list[float]:
    """At each tick the age of what was heard at the first, nothing since."""
    stall = stall or Stall()
    heard = stall.awake_s(times[0])
    found = []
    for time in times:
        stall.tick(time)
        found.append(stall.awake_s(time) - heard)
    return found


def after(*gaps: float) -> list[float]:
    times = [0.0]
    for gap in gaps:
        times.append(times[-1] + gap)
    return times


EVEN = [k * DT for k in range(1000)]


@pytest.mark.parametrize(('times', 'expected'), [
    (EVEN, EVEN),
    # left out until what waited has had time to come
    (after(DT, 0.34, DT, DT), [0.0, DT, DT, 2 * DT, 3 * DT]),
    # a second standstill at once is left out too, but no more than a second of both
    (after(0.5, DT, 0.4, DT, 0.3), [0.0, 0.0, DT, DT, 2 * DT, 0.3 + 2 * DT]),
    # a long one by nothing
    (after(1.01 * LONGEST_S), [0.0, 1.01 * LONGEST_S]),
])
def test_a_silent_link_grows_old_by_the_clock_but_for_standstills(times, expected) -> None:
    assert ages(times) == pytest.approx(expected)


def test_a_node_that_only_crawls_still_sees_the_link_die() -> None:
    times = after(*[2 * STALL_S] * 20)
    late = [t for t, age in zip(times, ages(times), strict=True) if age > STALE_S]
    assert late[0] <= LONGEST_S + STALE_S + 2 * STALL_S + 1e-9


@pytest.mark.parametrize(('awake', 'left_out'), [(50, False), (250, True)])
def test_only_time_awake_earns_the_next_standstill(awake: int, left_out: bool) -> None:
    stall = Stall()
    beat = after(0.9, *[DT] * awake)
    ages(beat, stall)
    age = ages([beat[-1], beat[-1] + 0.9], stall)[-1]
    assert age == pytest.approx(0.0 if left_out else 0.9, abs=1e-9)


def test_a_pause_on_purpose_is_no_standstill_and_one_before_the_first_tick_is() -> None:
    paused, late = Stall(), Stall()
    paused.tick(0.0)
    paused.begin(0.5)
    paused.tick(0.5 + DT)
    assert (paused.stood_still_s, paused.awake_s(0.5)) == (0.0, 0.5)
    late.begin(10.0)
    late.tick(10.6)
    assert late.stood_still_s == pytest.approx(0.6)
    assert late.awake_s(10.6) - 9.99 == pytest.approx(0.01)
