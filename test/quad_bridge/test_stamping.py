"""Stamps after silence: a burst keeps its own, a far end begun anew gets its new clock's."""

from itertools import pairwise

import pytest

from quad_bridge.link import Link
from quad_bridge.wire import frames as f
from quad_bridge.wire.clock import DeviceTime
from quad_bridge.wire.codec import Decoder, Encoder
from quad_bridge.wire.late_guard import PAST_NS, PATIENCE_NS, LateGuard

HOST0_NS, CYCLE_NS = 7_000_000_000, 4_000_000
ZERO = (0.0, 0.0, 0.0)
MS = 1_000_000


class Line:
    """A far end that boots when told; a line that loses or holds up. The gyro numbers cycles."""

    def __init__(self, *, answers=True):
        self.link, self.encoder, self.decoder = Link(), Encoder(1, 1), Decoder()
        self.answers, self.number, self.boot = answers, 0, 0
        self.out, self.bits = [], 64
        self.link.opened()

    @property
    def host_ns(self):
        return HOST0_NS + self.number * CYCLE_NS

    @property
    def device_us(self):
        return (self.number - self.boot) * CYCLE_NS // 1000 % (1 << self.bits)

    def sent(self):
        gyro = (1e-3 * self.number, 0.0, 0.0)
        cycle = f.Cycle(
            self.device_us, self.number - self.boot, gyro, ZERO, ZERO, ZERO, ZERO, (0.0,) * 4,
            ZERO, (0.0,) * 4, 1,
        )  # fmt: skip
        data = self.encoder.encode(cycle)
        if self.number % 5 == 0:
            data += self.encoder.encode(f.RcChannels(self.device_us // 1000, (1500,) * 9))
        return data

    def hear(self, data, late_ns=0):
        self.out += self.link.receive(data, self.host_ns + late_ns)

    def tick(self):
        if self.number % 12 == 0:
            self.link.tick(self.host_ns)
        for frame in self.decoder.feed(self.link.drain()):
            if isinstance(frame, f.TimeSync) and self.answers:
                told = f.TimeSync(1000 * self.device_us + 100_000, frame.ts1_ns)
                self.hear(self.encoder.encode(told), 200_000)

    def fly(self, seconds):
        for _ in range(round(250 * seconds)):
            self.number += 1
            self.hear(self.sent())
            self.tick()

    def lose(self, seconds, *, restart_after=None):
        """Nothing arrives; the far end may boot meanwhile."""
        begin = self.number
        answers, self.answers = self.answers, False
        for _ in range(round(250 * seconds)):
            self.number += 1
            if restart_after is not None and self.number == begin + round(250 * restart_after):
                self.boot = self.number
            self.tick()
        self.answers = answers

    def hold_up(self, seconds):
        """What arrives waits in the kernel, is read in pieces, each of which takes its time."""
        kept = b''
        for _ in range(round(250 * seconds)):
            self.number += 1
            kept += self.sent()
        for begin in range(0, len(kept), 4095):
            self.number += 4  # 16 ms: meanwhile new bytes arrive
            self.hear(kept[begin : begin + 4095])
            self.tick()

    def errors_ms(self):
        """Stamp minus the time at which the cycle began."""
        cycles = [s for s in self.out if isinstance(s.frame, f.Cycle)]
        return [
            1e-6 * (s.stamp_ns - HOST0_NS) - 4.0 * round(1e3 * s.frame.gyro[0]) for s in cycles
        ]

    def sticks_ms(self):
        """Stamps of the sticks minus the host time by their device time, now that it is known."""
        return [
            1e-6 * (s.stamp_ns - HOST0_NS) - s.frame.time_ms - 4.0 * self.boot
            for s in self.out
            if isinstance(s.frame, f.RcChannels)
        ]


@pytest.mark.parametrize(('uptime_s', 'silence_s'), [(2.0, 3.0), (1.0, 2.0), (2.0, 4.9), (0.6, 2)])
def test_a_restart_that_nobody_heard_is_found_though_the_counter_is_higher(uptime_s, silence_s):
    line = Line()
    line.fly(uptime_s)
    line.lose(silence_s, restart_after=0.3)
    before, held = len(line.out), line.link.held
    line.hear(line.encoder.encode(f.RcChannels(line.device_us // 1000, (1500,) * 9)))
    line.fly(2.0)
    assert line.link.last_cycle.cycle > 250 * uptime_s  # its counter has not gone back
    assert max(map(abs, line.errors_ms())) < 1.0
    line.out = line.out[before:]
    assert len(line.sticks_ms()) > 50
    assert max(map(abs, line.sticks_ms())) < 1.0
    # told by the first round trip, 20 ms; then eight for the new clock, a tick apart each
    assert 0 < line.link.held - held < 250
    assert line.link.decoder.restarts == 1
    assert line.link.gains.state is None


def test_what_a_host_that_stood_still_finds_waiting_keeps_its_stamps():
    line = Line()
    line.fly(2.0)
    held = line.link.held
    line.hold_up(1.0)
    line.fly(1.0)
    assert line.link.held == held
    errors = line.errors_ms()
    assert len(errors) == len({s.frame.gyro for s in line.out if isinstance(s.frame, f.Cycle)})
    assert max(map(abs, errors)) < 1.0
    assert max(map(abs, line.sticks_ms())) < 1.0
    stamps = [s.stamp_ns for s in line.out if isinstance(s.frame, f.Cycle)]
    assert all(b > a for a, b in pairwise(stamps))
    assert line.link.decoder.restarts == 0
    assert line.link.clock.state.restarts == 0


@pytest.mark.parametrize('answers', [True, False])
def test_a_silence_alone_costs_nothing(answers):
    line = Line()
    line.fly(2.0)
    line.lose(3.0)
    line.answers = answers
    held, before = line.link.held, len(line.out)
    line.fly(1.0)
    assert line.link.held == held
    assert len(line.out) - before == 300
    assert max(map(abs, line.errors_ms())) < 1.0


def test_a_line_that_is_late_for_good_is_taken_for_what_it_is_after_one_round_trip():
    line = Line()
    line.fly(2.0)
    held = line.link.held
    kept = [line.sent() for line.number in range(line.number + 1, line.number + 51)]
    for _ in range(500):  # 200 ms on the way, TIMESYNC is not
        line.number += 1
        kept.append(line.sent())
        line.hear(kept.pop(0))
        line.tick()
    assert line.link.held == held
    assert max(map(abs, line.errors_ms())) < 1.0
    assert line.link.clock.state.restarts == 0


def test_only_the_far_end_answers_and_no_other_time_moves_the_clock():
    line, station = Line(), Encoder(255, 190)
    for _ in range(20):
        line.number += 12
        line.link.tick(line.host_ns)
        for frame in line.decoder.feed(line.link.drain()):
            if isinstance(frame, f.TimeSync):
                unix = f.TimeSync(1_700_000_000_000_000_000, frame.ts1_ns)
                line.hear(station.encode(unix))
    assert line.link.decoder.counts.foreign == 20
    line.boot = line.number
    line.fly(1.0)
    line.hear(line.encoder.encode(f.RcChannels(2**32 - 1, (1500,) * 9)))
    line.fly(1.0)
    assert len(line.errors_ms()) > 400
    assert max(map(abs, line.errors_ms())) < 1.0
    assert line.link.stamping.device_time.wraps == 0


def test_who_sends_cycles_is_the_far_end_whoever_was_heard_first():
    line, other = Line(), Encoder(255, 190)
    line.hear(other.encode(f.Heartbeat(autopilot=3)))
    assert line.link.peer is not None
    line.fly(1.0)
    line.hear(other.encode(f.Heartbeat(autopilot=3)))
    assert line.link.decoder.peer == (1, 1)
    assert line.link.cycles == 250
    line.hear(other.encode(line.link.last_cycle))
    assert line.link.decoder.counts.foreign == 2  # heard a cycle too late to be the far end
    line.link.send(f.Command(400))
    (command,) = [c for c in line.decoder.feed(line.link.drain()) if isinstance(c, f.Command)]
    assert command.target_system in {0, 1}


@pytest.mark.parametrize(
    ('away_s', 'restart_after', 'restarts'), [(8.0, None, 0), (8.0, 1.0, 1), (0.5, 0.1, 1)]
)
def test_another_start_is_seen_when_the_port_is_opened_anew(away_s, restart_after, restarts):
    line = Line()
    line.fly(3.0)
    line.lose(away_s, restart_after=restart_after)
    line.link.opened()
    line.fly(2.0)
    assert line.link.decoder.restarts == restarts
    assert max(map(abs, line.errors_ms())) < 1.0


def test_a_time_of_32_bits_that_wraps_while_the_cable_is_out_is_no_other_start():
    line = Line()
    line.boot = -(2**32 - 5_000_000) // 4000
    line.bits = 32
    line.fly(3.0)
    line.lose(4.0)
    line.link.opened()
    line.fly(1.0)
    assert line.link.last_cycle.time_us < 4_000_000
    assert line.link.decoder.restarts == 0


def test_a_time_that_is_only_looked_at_or_false_by_far_is_no_wrap():
    time = DeviceTime()
    assert time.extend(1_000, 60) == 1_000
    assert time.peek(2**32 - 1, 60) == 2**32 - 1
    assert time.extend(2_000, 60) == 2_000
    assert time.extend(10**15, 60_000_000) == 10**15
    assert time.extend(3_000, 60_000_000) == 3_000
    assert time.wraps == 0


LATE = PAST_NS + 1


def waiting(late_ns=LATE, *, anew):
    guard = LateGuard()
    assert guard.step(late_ns, 0, anew=anew)
    return guard


def test_what_catches_up_was_late():
    guard = waiting(anew=True)
    assert not guard.step(PAST_NS, 10 * MS, anew=False)
    assert not guard.gone


@pytest.mark.parametrize(
    ('off_ns', 'round_trip_ns', 'gone'),
    [
        (1 * MS, 2 * MS, False),
        (3500 * MS, 2 * MS, True),
        (-3500 * MS, 2 * MS, True),
        (300 * MS, 700 * MS, False),  # a trip through the same jam
        (3500 * MS, 700 * MS, True),
    ],
)
def test_a_round_trip_tells(off_ns, round_trip_ns, gone):
    guard = waiting(anew=True)
    guard.trip(-1, 1e12, 0)  # asked before
    assert guard.waiting
    guard.trip(5 * MS, off_ns, round_trip_ns)
    assert guard.gone == gone
    assert gone or not guard.waiting


def test_lateness_that_is_known_needs_no_second_explanation_but_more_of_it_does():
    guard = waiting(2 * LATE, anew=False)
    guard.trip(MS, 0.0, MS)
    assert not guard.step(2 * LATE + PAST_NS, 20 * MS, anew=False)
    assert guard.step(2 * LATE + PAST_NS + 1, 30 * MS, anew=False)


@pytest.mark.parametrize('anew', [True, False])
def test_without_a_round_trip_the_uptime_decides(anew):
    guard = waiting(anew=anew)
    assert guard.step(LATE, PATIENCE_NS, anew=False)
    assert not guard.step(LATE, PATIENCE_NS + 1, anew=False)
    assert guard.gone == anew


def test_what_comes_late_beside_no_cycle_waits_no_longer_than_patience():
    """The control task hangs, the radio's frames go on 250 ms late, TIMESYNC is silent."""
    line = Line()
    line.fly(3.0)
    line.answers, heard = False, len(line.out)
    for k in range(500):
        line.number += 5
        us = line.device_us - 250_000
        line.hear(line.encoder.encode(f.RcChannels(us // 1000, (1500,) * 9)))
        line.tick()
        assert len(line.link.stamping._waiting) <= 2 * PATIENCE_NS / (5 * CYCLE_NS) + 2, k
    late = [s for s in line.out[heard:] if isinstance(s.frame, f.RcChannels)]
    assert len(late) > 465


def test_sticks_that_come_before_the_cycle_do_not_end_the_wait_for_an_answer():
    """Restarted unheard, TIMESYNC deaf for 0.4 s more: sticks tell nothing of the past."""
    line = Line()
    line.fly(2.0)
    line.lose(3.0, restart_after=0.3)
    before, line.answers = len(line.out), False
    for k in range(350):
        line.number += 1
        line.answers = k > 100
        line.hear(line.encoder.encode(f.RcChannels(line.device_us // 1000, (1500,) * 9)))
        line.hear(line.sent())
        line.tick()
    line.out = line.out[before:]
    assert line.link.decoder.restarts == 1
    assert len(line.errors_ms()) > 100
    assert max(map(abs, line.errors_ms())) < 1.0
    assert max(map(abs, line.sticks_ms())) < 1.0
