"""A node's own standstill is left out of the age of what it heard, a silent link never."""

from __future__ import annotations

import pytest

from quad_sysid.signals.stall import LONGEST_S, STALL_S, Stall

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


def test_on_an_even_beat_a_silent_link_grows_old_by_the_clock() -> None:
    times = [k * DT for k in range(1000)]
    assert ages(times) == times


def test_a_standstill_is_left_out_until_what_waited_has_had_time_to_come() -> None:
    assert ages(after(DT, 0.34, DT, DT)) == pytest.approx([0.0, DT, DT, 2 * DT, 3 * DT])


def test_a_second_standstill_at_once_is_left_out_too_but_no_more_than_a_second() -> None:
    found = ages(after(0.5, DT, 0.4, DT, 0.3))
    assert found == pytest.approx([0.0, 0.0, DT, DT, 2 * DT, 0.3 + 2 * DT])


def test_a_node_that_only_crawls_still_sees_the_link_die() -> None:
    times = after(*[2 * STALL_S] * 20)
    late = [t for t, age in zip(times, ages(times), strict=True) if age > STALE_S]
    assert late[0] <= LONGEST_S + STALE_S + 2 * STALL_S + 1e-9


def test_a_long_standstill_is_left_out_by_nothing() -> None:
    assert ages(after(1.01 * LONGEST_S))[-1] == pytest.approx(1.01 * LONGEST_S)


@pytest.mark.parametrize(('awake', 'left_out'), [(50, False), (250, True)])
def test_only_time_awake_earns_the_next_standstill(awake: int, left_out: bool) -> None:
    stall = Stall()
    beat = after(0.9, *[DT] * awake)
    ages(beat, stall)
    age = ages([beat[-1], beat[-1] + 0.9], stall)[-1]
    assert age == pytest.approx(0.0 if left_out else 0.9, abs=1e-9)


def test_a_pause_on_purpose_is_no_standstill() -> None:
    stall = Stall()
    stall.tick(0.0)
    stall.begin(0.5)
    stall.tick(0.5 + DT)
    assert stall.stood_still_s == 0.0
    assert stall.awake_s(0.5) == 0.5


def test_a_standstill_before_the_first_tick_is_left_out_too() -> None:
    stall = Stall()
    stall.begin(10.0)
    stall.tick(10.6)
    assert stall.stood_still_s == pytest.approx(0.6)
    assert stall.awake_s(10.6) - 9.99 == pytest.approx(0.01)
