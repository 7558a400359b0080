"""The bridge's side of the conversation, with a far end made of the same codec."""

from dataclasses import replace
from itertools import pairwise

import pytest

from quad_bridge.errors import RefusedError
from quad_bridge.excitation_relay import ExcitationRelay
from quad_bridge.gain_line import What
from quad_bridge.link import Link
from quad_bridge.virtual.gain_store import GainStore
from quad_bridge.wire import frames as f
from quad_bridge.wire.codec import Decoder, Encoder
from quad_bridge.wire.gain_names import WIRE_NAMES
from quad_bridge.wire.params import float32

HOST0_NS = 7_000_000_000


class FarEnd:
    """A minimal STM32 on a line without jitter, driven in steps of 4 ms."""

    def __init__(self, link, bits=64):
        self.mask = (1 << bits) - 1
        self.link, self.encoder, self.decoder = link, Encoder(1, 1), Decoder()
        self.values = {wire: float32(0.5) for wire in WIRE_NAMES.values()}
        self.excitations, self.out = [], []
        self.store = GainStore(self.values, lambda *_: True, 7)
        self.now_us, self.cycle = 0, 0

    @property
    def host_ns(self):
        return HOST0_NS + 1000 * self.now_us

    def step(self, *frames):
        self.now_us += 4000
        self.cycle += 1
        zero = (0.0, 0.0, 0.0)
        cycle = f.Cycle(
            self.now_us & self.mask,
            self.cycle,
            zero,
            zero,
            zero,
            zero,
            zero,
            (0.0,) * 4,
            zero,
            (0.0,) * 4,
            1,
        )
        for frame in (cycle, *frames):
            self.out += self.link.receive(self.encoder.encode(frame), self.host_ns)
        if self.cycle % 12 == 0:
            self.link.tick(self.host_ns)
        self.answer()

    def answer(self):
        while data := self.link.drain():
            for frame in self.decoder.feed(data):
                for reply in self.replies(frame):
                    received = self.encoder.encode(reply)
                    self.out += self.link.receive(received, self.host_ns + 200_000)

    def replies(self, frame):
        names = list(self.values)
        if isinstance(frame, f.TimeSync):
            yield f.TimeSync(1000 * (self.now_us & self.mask) + 100_000, frame.ts1_ns)
        elif isinstance(frame, f.ParamRequestList):
            for i, name in enumerate(names):
                yield f.ParamValue(name, self.store.active[name], len(names), i)
        elif isinstance(frame, (f.ParamSet, f.ParamRequestRead)):
            if isinstance(frame, f.ParamSet):
                self.store.write(frame.name, frame.value)
            value = self.store.shown(frame.name)
            yield f.ParamValue(frame.name, value, len(names), names.index(frame.name))
        elif isinstance(frame, f.GainsCommand):
            yield self.store.take(frame, 1e-6 * self.now_us)
        elif isinstance(frame, f.Excitation):
            self.excitations.append(frame)


@pytest.fixture
def far():
    far = FarEnd(Link())
    far.link.opened()
    for _ in range(150):
        far.step()
    return far


def test_nothing_is_published_before_the_clock_has_converged(far):
    assert 0 < far.link.held < 150
    assert far.link.held + len(far.out) == 150


def test_stamps_are_device_time_on_the_host_clock(far):
    stamped = far.out[-1]
    assert abs(stamped.stamp_ns - (HOST0_NS + 1000 * stamped.frame.time_us)) < 20_000


def test_messages_of_one_cycle_share_its_stamp(far):
    far.out.clear()
    now = far.now_us + 4000
    rc = f.RcChannels(now // 1000, (1500,) * 9)
    far.step(rc, f.SlowSensors(now, (0.1, 0.2, 0.3), 1000.0), f.Battery(11.0))
    assert len(far.out) == 4
    assert len({item.stamp_ns for item in far.out}) == 1


def test_gains_are_announced_once_after_connecting(far):
    (event,) = far.link.gains.events
    assert event.what is What.READ
    assert set(event.active) == set(WIRE_NAMES)
    assert set(event.active.values()) == {0.5}


def write(far, **writes):
    far.link.gains.events.clear()
    far.link.gains.write(writes, 10_000)
    for _ in range(50):
        far.step()
    return far.link.gains.events


def test_written_gains_are_announced_after_read_back(far):
    (event,) = write(far, ROLL_RATE_KP=0.1)
    assert event.what is What.COMMITTED
    assert event.active['roll.rate.kp'] == float32(0.1)
    assert far.store.active['ROLL_RATE_KP'] == float32(0.1)
    far.link.gains.write({'ROLL_RATE_KP': 0.2}, 1)
    with pytest.raises(RefusedError, match='busy'):
        far.link.gains.write({'ROLL_RATE_KP': 0.1}, 1)


def test_taken_back_gains_are_read_again(far):
    write(far, ROLL_RATE_KP=0.1)
    far.link.gains.events.clear()
    far.link.gains.revert('why')
    for _ in range(50):
        far.step()
    back, again = far.link.gains.events
    assert (back.what, back.reason, back.by_stm32) == (What.REVERTED, 'why', False)
    assert again.active['roll.rate.kp'] == 0.5


def test_what_somebody_else_has_changed_is_read_again(far):
    far.link.gains.events.clear()
    far.store.write('YAW_RATE_KP', 0.25)
    far.step(far.store.state())
    for _ in range(50):
        far.step()
    (event,) = far.link.gains.events
    assert event.active['yaw.rate.kp'] == 0.25


def test_an_unconfirmed_set_of_an_earlier_bridge_is_taken_back(far):
    write(far, ROLL_RATE_KP=0.1)
    far.link.opened()
    far.link.gains.events.clear()
    for _ in range(100):
        far.step()
    assert What.REVERTED in [event.what for event in far.link.gains.events]
    assert far.store.active['ROLL_RATE_KP'] == 0.5


def test_gains_cannot_be_written_before_the_stm32_has_reported():
    with pytest.raises(RefusedError):
        Link().gains.write({'ROLL_RATE_KP': 0.1}, 0)


def test_a_restart_of_the_stm32_holds_the_stamps_back_and_reads_the_gains_again(far):
    before = far.link.held
    far.now_us, far.cycle = 0, 0
    far.step()
    assert far.link.decoder.counts.restarts == 1
    assert far.link.held == before + 1
    # the device counts from zero again: its offset to the host has changed, and is found again


def test_no_stamp_runs_backwards_over_restart_and_wrap(far):
    far.now_us = 2**32 - 4_000_000  # a jump, as if the bridge had been away
    far.link.opened()
    for k in range(2000):
        if k == 1400:
            far.now_us, far.cycle = 2**33, 0
        far.step()
    stamps = [item.stamp_ns for item in far.out]
    assert len(stamps) > 1500
    assert min(b - a for a, b in pairwise(stamps)) > 0
    assert far.link.decoder.restarts == 1


def test_a_stamp_in_the_future_is_held_back_and_does_not_stop_the_others(far):
    held, told = far.link.held, len(far.out)
    bad = replace(far.link.last_cycle, time_us=far.now_us + 10**9, cycle=far.cycle + 1)
    far.link.receive(far.encoder.encode(bad), far.host_ns)
    for _ in range(8):  # they wait until TIMESYNC has told that the clock has not jumped
        far.step()
    assert far.link.held == held + 1
    assert len(far.out) == told + 8


def test_another_far_end_is_heard_once_the_first_is_silent(far):
    other = Encoder(7, 1)
    assert far.link.receive(other.encode(f.StatusText(4, 'me too')), far.host_ns) == []
    far.link.tick(far.host_ns + 4_000_000_000)
    (told,) = far.link.receive(other.encode(f.StatusText(4, 'now me')), far.host_ns)
    assert told.frame.text == 'now me'
    assert far.link.decoder.counts.foreign == 1


def test_device_time_of_32_bits_goes_on_through_its_wrap():
    far = FarEnd(Link(), bits=32)
    far.link.opened()
    far.now_us = 2**32 - 3_000_000
    for _ in range(1500):
        far.step()
    stamps = [item.stamp_ns for item in far.out]
    assert len(stamps) > 1350
    assert {round((b - a) / 1e5) for a, b in pairwise(stamps)} == {40}
    assert far.link.stamping.device_time.wraps == 1
    assert far.link.clock.state.restarts == 0


def test_the_bridge_addresses_the_peer_it_has_heard(far):
    far.step(f.Heartbeat())
    far.link.send(f.Excitation((0.1, 0.0, 0.0), 1, 1))
    far.answer()
    assert (far.excitations[-1].target_system, far.excitations[-1].target_component) == (1, 1)


def test_set_points_follow_the_segment():
    relay = ExcitationRelay(100)
    assert relay.setpoint(0.1, 0.2, 0.3) is None
    assert 'no segment is running' in relay.reason
    segment = {'segment': 'train', 'signal': 'prbs', 'axis': 'pitch', 'injection': 'rate'}
    assert relay.segment(segment) is None
    frame = relay.setpoint(0.1, 0.2, 0.3)
    assert frame.value == (0.1, -0.2, -0.3)  # FLU to FRD
    assert frame.injection == f.Injection.RATE
    assert frame.valid_ms == 100
    assert relay.setpoint(float('nan'), 0.0, 0.0) is None
    end = relay.segment({'segment': 'idle', 'signal': 'none', 'injection': 'rate'})
    assert end.injection == f.Injection.NONE
    assert relay.setpoint(0.1, 0.0, 0.0) is None
    assert (relay.forwarded, relay.dropped) == (1, 3)


@pytest.mark.parametrize('value', [1e300, -3.5e38, float('inf'), float('nan'), 1000.0])
def test_a_set_point_that_no_frame_can_carry_is_dropped_with_its_reason(far, value):
    relay = ExcitationRelay(100)
    relay.segment({'segment': 'train', 'signal': 'prbs', 'injection': 'rate'})
    assert relay.setpoint(0.0, value, 0.0) is None
    assert 'within ±1000' in relay.reason
    far.link.send(relay.setpoint(999.0, -999.0, 0.0))
    assert relay.reason == ''


class Shaky(FarEnd):
    """A far end whose clock is set, or whose cycles come unevenly: true time is the host's."""

    set_us = 0

    def true_errors_ms(self):
        """By how much each stamp is off the time at which its cycle began."""
        cycles = [s for s in self.out if isinstance(s.frame, f.Cycle)]
        begun = {k: HOST0_NS + 4_000_000 * k for k in range(self.cycle + 1)}
        return [1e-6 * (s.stamp_ns - begun[s.frame.cycle]) for s in cycles]

    def sent_cycle(self):
        zero = (0.0, 0.0, 0.0)
        return f.Cycle(
            self.now_us + self.set_us, self.cycle, zero, zero, zero, zero, zero, (0.0,) * 4, zero,
            (0.0,) * 4, 1,
        )  # fmt: skip

    def run(self, cycles, late_us=lambda _k: 0):
        for _ in range(cycles):
            self.cycle += 1
            self.now_us = 4000 * self.cycle + late_us(self.cycle)
            data = self.encoder.encode(self.sent_cycle())
            self.out += self.link.receive(data, self.host_ns)
            if self.cycle % 12 == 0:
                self.link.tick(self.host_ns)
            self.answer()

    def replies(self, frame):
        if isinstance(frame, f.TimeSync):
            yield f.TimeSync(1000 * (self.now_us + self.set_us) + 100_000, frame.ts1_ns)


@pytest.mark.parametrize('set_ms', [40.0, -40.0, 3.0, -3.0, 2500.0, -2500.0])
def test_no_cycle_is_stamped_wrongly_when_the_far_ends_clock_is_set(set_ms):
    link = Link()
    far = Shaky(link)
    link.opened()
    far.run(800)
    held = link.held
    far.set_us = round(1000 * set_ms)
    far.run(1500)
    errors = far.true_errors_ms()
    assert max(map(abs, errors)) < 1.0  # ms
    assert link.stamping.guard.alarms == 1
    assert link.clock.state.restarts == 1
    # until eight new round trips are in: half a second and the one that told
    assert 0 < link.held - held < 250
    assert len(errors) == far.cycle - link.held


def test_cycles_that_come_unevenly_are_neither_lost_nor_wrong():
    link = Link()
    far = Shaky(link)
    link.opened()
    far.run(500)
    held = link.held
    far.run(5000, late_us=lambda k: 3000 if k % 50 == 0 else 0)
    assert link.held == held
    assert link.clock.state.restarts == 0
    # doubled twice, what may be off covers them
    assert 0 < link.stamping.guard.alarms <= 4
    late = [e for e in far.true_errors_ms() if e > 2.5]
    assert len(late) == 100  # the late ones bear the time at which they began
    assert len(far.out) == far.cycle - link.held
    stamps = [s.stamp_ns for s in far.out]
    assert all(b > a for a, b in pairwise(stamps))


def test_a_far_end_that_no_longer_answers_timesync_is_not_held_back_for_long():
    link = Link()
    far = Shaky(link)
    link.opened()
    far.run(500)
    held, before = link.held, len(far.out)
    far.replies = lambda _frame: ()
    far.run(10)
    far.run(1, late_us=lambda _k: 3000)
    far.run(40)
    assert len(far.out) == before + 10  # waits
    far.run(60)
    assert link.held == held
    assert len(far.out) == before + 111
