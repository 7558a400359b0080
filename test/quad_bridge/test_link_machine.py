"""The bridge's side of the conversation: clock, stamps, restarts, who is heard; no I/O."""

from dataclasses import replace

import pytest
from flight_controller import HOST0_NS, Line

from quad_bridge.wire import frames as f
from quad_bridge.wire.codec import Encoder


@pytest.fixture
def line():
    line = Line()
    line.run(150)
    return line


def test_nothing_is_published_before_the_clock_has_converged(line):
    assert 0 < line.link.stamping.held < 150
    assert line.link.stamping.held + len(line.out) == 150
    stamped = line.out[-1]  # device time on the host clock
    assert abs(stamped.stamp_ns - (HOST0_NS + 1000 * stamped.frame.time_us)) < 20_000


def test_messages_of_one_cycle_share_its_stamp(line):
    line.out.clear()
    line.controller.late_us = 300  # the sticks' time has whole ms only
    us = line.controller.device_us + 4000
    others = (
        f.RcChannels(us // 1000, (1500,) * 9),
        f.SlowSensors(us, (0.1, 0.2, 0.3), 1000.0),
        f.Battery(11.0),
    )
    line.controller.also = lambda _: others
    line.run()
    assert len(line.out) == 5  # the compass and the barometer are two topics
    assert len({item.stamp_ns for item in line.out}) == 1


def test_a_stamp_in_the_future_is_held_back_and_does_not_stop_the_others(line):
    held, published = line.link.stamping.held, len(line.out)
    now = line.link.last_cycle
    line.hear(line.controller.encode(
        replace(now, time_us=now.time_us + 10**9, cycle=now.cycle + 1)
    ))  # fmt: skip
    line.run(8)  # they wait until TIMESYNC has told that the clock has not jumped
    assert line.link.stamping.held == held + 1
    assert len(line.out) == published + 8


def answered_by(station, line, ahead_ns):
    """Another one answers TIMESYNC, by a clock that is so far ahead of the aircraft's."""
    for _ in range(20):
        line.skip(12)
        line.link.tick(line.now_ns)
        for frame in line.controller.decoder.feed(line.link.to_send()):
            if isinstance(frame, f.TimeSync):
                line.hear(station.encode(f.TimeSync(line.since_ns + ahead_ns, frame.ts1_ns)))


def test_only_the_aircraft_answers_and_no_other_time_moves_the_clock():
    line, station = Line(), Encoder(255, 190)
    answered_by(station, line, 1_700_000_000_000_000_000)
    assert line.link.decoder.counts.foreign == 20
    line.controller.restart()
    line.fly(1.0)
    for _ in range(3):  # to questions of an earlier bridge, whose clock was ahead
        line.say(f.TimeSync(line.since_ns, line.now_ns + 10_000_000_000))
    assert line.link.clock.restarts == 0
    line.say(f.RcChannels(2**32 - 1, (1500,) * 9))
    line.fly(1.0)
    assert len(line.errors_ms()) > 400
    assert max(map(abs, line.errors_ms())) < 1.0
    assert line.link.stamping.device_time.wraps == 0


def test_who_sends_cycles_is_the_peer_whoever_was_heard_first():
    line, other = Line(), Encoder(255, 190)
    line.hear(other.encode(f.Heartbeat(autopilot=8)))
    assert line.link.peer is None  # it flies nothing
    line.hear(other.encode(f.Heartbeat(autopilot=3)))
    assert line.link.peer is not None
    answered_by(other, line, 50_000_000)
    assert line.link.clock.converged
    line.fly(1.0)
    assert max(map(abs, line.errors_ms())) < 1.0
    line.hear(other.encode(f.Heartbeat(autopilot=3)))
    assert line.link.decoder.peer == (1, 1)
    assert line.link.cycles == 250
    line.hear(other.encode(line.link.last_cycle))
    assert line.link.decoder.counts.foreign == 2  # heard a cycle too late to be the peer
    line.say(f.Heartbeat())
    line.link.send(f.Excitation((0.1, 0.0, 0.0), 1, 1))
    line.exchange()
    (sent,) = line.controller.told(f.Excitation)
    assert (sent.target_system, sent.target_component) == (1, 1)
