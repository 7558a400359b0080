"""Stamps after silence: a burst keeps its own, an aircraft that restarted gets its new clock's."""

import pytest
from flight_controller import CYCLE_NS, HOST0_NS, FlightController, Line, sticks

from quad_bridge.link.guards import AGREES_NS, PAST_NS, PATIENCE_NS, LateGuard, StepGuard
from quad_bridge.wire import frames as f


def sticks_ms(line):
    """Stamps of the sticks minus the host time by their device time."""
    boot_ms = 4.0 * line.controller.boot
    found = [
        1e-6 * (item.stamp_ns - HOST0_NS) - item.frame.time_ms - boot_ms
        for item in line.out
        if isinstance(item.frame, f.RcChannels)
    ]
    assert len(found) > 30
    return found


def assert_true(line, bound_ms=1.0):
    assert max(map(abs, [*line.errors_ms(), *sticks_ms(line)])) < bound_ms


def flown(seconds=2.0):
    line = Line(FlightController(also=sticks))
    line.fly(seconds)
    return line


@pytest.mark.parametrize(('uptime_s', 'silence_s'), [(2.0, 3.0), (1.0, 2.0), (2.0, 4.9), (0.6, 2)])
def test_a_restart_that_nobody_heard_is_found_though_the_counter_is_higher(uptime_s, silence_s):
    line = flown(uptime_s)
    line.lose(silence_s, restart_after=0.3)
    held, line.out = line.link.stamping.held, []
    line.say(*sticks_of(line))
    line.fly(2.0)
    assert line.link.last_cycle.cycle > 250 * uptime_s  # its counter has not gone back
    assert_true(line)
    # told by the first round trip, 20 ms; then eight for the new clock, a tick apart each
    assert 0 < line.link.stamping.held - held < 250
    assert line.link.decoder.counts.restarts == 1


def sticks_of(line):
    yield f.RcChannels(line.controller.device_us // 1000, (1500,) * 9)


def test_sticks_that_come_before_the_cycle_do_not_end_the_wait_for_an_answer():
    """Restarted unheard, TIMESYNC deaf for 0.4 s more: sticks tell nothing of the past."""
    line = flown()
    line.lose(3.0, restart_after=0.3)
    line.out = []
    for k in range(350):
        line.controller.unanswered = (f.TimeSync,) if k <= 100 else ()
        line.skip()
        line.hear(line.controller.encode(*sticks_of(line), line.controller.frame()))
        line.attend()
    assert line.link.decoder.counts.restarts == 1
    assert len(line.errors_ms()) > 100
    assert_true(line)


def test_what_a_host_that_stood_still_finds_waiting_keeps_its_stamps():
    line = flown()
    held, kept = line.link.stamping.held, b''
    for _ in range(250):
        line.skip()
        kept += line.controller.encode(line.controller.frame(), *sticks(line.controller))
    for begin in range(0, len(kept), 4095):  # read in pieces of 16 ms: meanwhile time goes on
        line.skip(4)
        line.hear(kept[begin : begin + 4095])
        line.attend()
    line.fly(1.0)
    assert line.link.stamping.held == held
    assert_true(line)
    assert line.rising()
    assert (line.link.decoder.counts.restarts, line.link.clock.restarts) == (0, 0)


@pytest.mark.parametrize('answers', [True, False])
def test_a_silence_alone_costs_nothing(answers):
    line = flown()
    line.lose(3.0)
    line.controller.unanswered = () if answers else (f.TimeSync,)
    held, line.out = line.link.stamping.held, []
    line.fly(1.0)
    assert line.link.stamping.held == held
    assert len(line.out) == 300
    assert_true(line)


def test_a_line_that_is_late_for_good_is_taken_for_what_it_is_after_one_round_trip():
    line = flown()
    held, line.delay = line.link.stamping.held, 50  # 200 ms on the way, TIMESYNC is not
    line.fly(2.0)
    assert line.link.stamping.held == held
    assert max(map(abs, line.errors_ms())) < 1.0
    assert line.link.clock.restarts == 0


def test_what_comes_late_beside_no_cycle_waits_no_longer_than_patience():
    """The control task hangs, the radio's frames go on 250 ms late, TIMESYNC is silent."""
    line = flown(3.0)
    line.controller.unanswered = (f.TimeSync,)
    line.out, waiting = [], []
    for k in range(500):
        line.skip(5)
        us = line.controller.device_us - 250_000
        line.hear(line.controller.encode(f.RcChannels(us // 1000, (1500,) * 9)))
        line.attend()
        waiting.append(k + 1 - len(line.out))
    assert max(waiting) <= 2 * PATIENCE_NS / (5 * CYCLE_NS) + 2
    assert len(line.out) > 465


@pytest.mark.parametrize(
    ('away_s', 'restart_after', 'restarts'), [(8.0, None, 0), (8.0, 1.0, 1), (0.5, 0.1, 1)]
)
def test_another_start_is_seen_when_the_port_is_opened_anew(away_s, restart_after, restarts):
    line = flown(3.0)
    line.lose(away_s, restart_after=restart_after)
    line.link.opened()
    line.fly(2.0)
    assert line.link.decoder.counts.restarts == restarts
    assert max(map(abs, line.errors_ms())) < 1.0


def test_a_time_of_32_bits_that_wraps_while_the_cable_is_out_is_no_other_start():
    line = Line(FlightController(bits=32))
    line.controller.clock_us = 2**32 - 5_000_000
    line.fly(3.0)
    line.lose(4.0)
    line.link.opened()
    line.fly(1.0)
    assert line.link.last_cycle.time_us < 4_000_000
    assert line.link.decoder.counts.restarts == 0


@pytest.mark.parametrize(
    ('off_ms', 'round_trip_ms', 'gone'),
    [
        (1, 2, False), (3500, 2, True), (-3500, 2, True),
        (300, 700, False),  # a trip through the same jam
        (3500, 700, True),
    ],
)  # fmt: skip
def test_a_round_trip_decides_whose_lateness_it_is(off_ms, round_trip_ms, gone):
    guard = LateGuard()
    assert guard.step(PAST_NS + 1, 0, anew=True)
    guard.trip(-1, 1e12, 0)  # asked before
    assert guard.waiting
    guard.trip(5_000_000, 1e6 * off_ms, 1_000_000 * round_trip_ms)
    assert guard.gone == gone
    assert gone or not guard.waiting


def test_a_round_trip_that_is_off_does_not_end_the_wait_for_one_that_tells():
    guard = StepGuard()
    assert [guard.step(*cycle, 0) for cycle in ((0, 0), (1, 4000), (2, 11_000))][-1]
    for off_ns, waits in ((AGREES_NS + 1, True), (AGREES_NS - 1, False)):
        guard.trip(0, off_ns, accepted=True)  # a slow one, which bounds no better
        assert guard.waiting is waits
