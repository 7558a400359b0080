"""A node's own standstill is excused once, a silent link never."""

from __future__ import annotations

from quad_sysid.signals.stall import LONGEST_S, STALL_S, Stall

DT = 0.004


def excused(times: list[float]) -> list[bool]:
    stall = Stall()
    return [stall.tick(time) for time in times]


def test_an_even_beat_is_never_excused() -> None:
    assert not any(excused([k * DT for k in range(1000)]))


def test_the_first_tick_after_a_standstill_is_excused_and_the_next_is_not() -> None:
    assert excused([0.0, DT, DT + 0.34, 2 * DT + 0.34]) == [False, False, True, False]


def test_a_node_that_only_crawls_still_judges_every_second_tick() -> None:
    assert excused([k * 2 * STALL_S for k in range(6)]) == [False, True, False, True, False, True]


def test_a_long_standstill_is_excused_by_nothing() -> None:
    assert excused([0.0, 1.01 * LONGEST_S]) == [False, False]


def test_a_pause_on_purpose_is_no_standstill() -> None:
    stall = Stall()
    stall.tick(0.0)
    stall.reset()
    assert not stall.tick(0.5)
    assert stall.stood_still_s == 0.0
