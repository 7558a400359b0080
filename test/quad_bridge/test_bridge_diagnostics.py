"""What the bridge says of its link, clock, gains and excitation."""

import math

import pytest

pytest.importorskip('diagnostic_msgs.msg', reason='needs the ROS 2 message packages')
from pymavlink.dialects.v20 import common

from quad_bridge import diagnostics as d
from quad_bridge.errors import RefusedError
from quad_bridge.excitation_relay import ExcitationRelay
from quad_bridge.gain_keeper import GainKeeper
from quad_bridge.gain_state import KeeperSettings
from quad_bridge.link import Link
from quad_bridge.serial_port import PortState, PortStatus
from quad_bridge.wire import frames as f
from quad_bridge.wire.codec import Counts, Encoder
from quad_bridge.wire.signing import Signing

OPEN = PortStatus(PortState.OPEN, '', 1, 0)
NOTHING = d.Since(0.0, Counts(), 0)
ZERO = (0.0, 0.0, 0.0)


def cycle(number, flags=1):
    frame = f.Cycle(
        4000 * number, number, ZERO, ZERO, ZERO, ZERO, ZERO, (0.0,) * 4, ZERO, (0.0,) * 4, flags
    )
    return Encoder().encode(frame)


def verdict(link, port=OPEN, since=NOTHING):
    status = d.link_status(port, link, since, 1.0, Counts())
    return status.level, status.message


def test_a_port_fault_a_silent_port_and_another_protocol_are_errors_in_their_own_words():
    for state in (PortState.NOT_THERE, PortState.BUSY, PortState.DENIED, PortState.HUNG_UP):
        assert verdict(Link(), PortStatus(state, 'why', 0, 0)) == (d.ERROR, f'port {state.value}')
    link = Link()
    assert verdict(link) == (d.ERROR, 'port open, but nothing arrives')
    link.receive(b'$GPGGA,1,2,3\r\n' * 10, 0)
    assert verdict(link) == (d.WARN, 'bytes arrive, no valid frame yet')
    link.receive(b'$GPGGA,1,2,3\r\n' * 200, 0)
    words = 'speaks another protocol or baud rate: no valid frame in 2940 bytes'
    assert verdict(link) == (d.ERROR, words)


def test_a_far_end_of_a_broken_clock_is_told_what_to_set():
    key, today = bytes(range(32)), 2**45
    far = Signing(key, lambda: today)
    far.stamp = lambda: 2**48 - 2
    link = Link(Signing(key, lambda: today))
    link.receive(Encoder(1, 1, far).encode(f.Heartbeat(2, 12)), 0)
    level, text = verdict(link)
    assert level == d.ERROR
    assert 'signs with a time far ahead: set its clock' in text


def test_a_controller_of_standard_messages_is_named_with_what_it_sends():
    link, peer = Link(), common.MAVLink(None, srcSystem=1, srcComponent=1)
    link.receive(peer.attitude_encode(1, 0, 0, 0, 0, 0, 0).pack(peer), 0)
    still = (0.0,) * 13
    link.receive(peer.highres_imu_encode(1, *still, 0x3F).pack(peer), 0)
    link.receive(peer.heartbeat_encode(2, 3, 0, 0, 4).pack(peer), 0)
    level, text = verdict(link)
    assert level == d.WARN
    assert 'only standard MAVLink messages arrive (ATTITUDE, HIGHRES_IMU)' in text


def test_good_cycles_are_ok_and_new_losses_a_warning():
    link = Link()
    link.receive(cycle(1) + cycle(2), 0)
    assert verdict(link) == (d.OK, 'control cycles arrive')
    since = d.Since(0.0, link.decoder.counts, link.cycles)
    link.receive(cycle(6), 0)
    assert verdict(link, since=since) == (d.WARN, '3 cycles lost since the last report')
    since = d.Since(1.0, link.decoder.counts, link.cycles)
    link.receive(Encoder().encode(f.Heartbeat()), 0)
    assert verdict(link, since=since)[0] == d.ERROR


def test_the_clock_says_why_nothing_is_published():
    link = Link()
    assert 'no answer to TIMESYNC' in d.clock_status(link).message
    link.clock.add(0, 100, 200)
    assert 'not converged' in d.clock_status(link).message
    for k in range(10):
        link.clock.add(1000 * k, 1000 * k + 100, 1000 * k + 200)
    assert d.clock_status(link).level == d.OK
    late = d.clock_status(link, now_ns=4_000_000_000)
    assert (late.level, 'for 4 s: does the far end hear us?' in late.message) == (d.WARN, True)


def test_a_refusal_stands_in_the_gain_state():
    link = Link()
    keeper = GainKeeper(KeeperSettings(), link.gains)
    assert 'has not reported' in d.gains_status(link, keeper).message
    with pytest.raises(RefusedError):
        keeper.ask({'roll.rate.kp': math.nan, 'source': 'me'}, 0.0)
    status = d.gains_status(link, keeper)
    words = 'gains of me refused: roll.rate.kp: must be finite: found nan'
    assert (status.level, status.message) == (d.ERROR, words)
    assert (status.values['refused'], status.values['writes acknowledged']) == (1, 0)


def test_the_excitation_state_follows_the_flags():
    link, relay = Link(), ExcitationRelay(100)
    assert d.excitation_status(relay, link).message == 'idle'
    link.receive(cycle(1, int(f.Flag.ARMED | f.Flag.EXCITATION)), 0)
    status = d.excitation_status(relay, link)
    assert status.message == 'running'
    assert status.values['flags of the STM32'] == 'armed excitation'
    link.receive(cycle(2, int(f.Flag.STALE_SETPOINT)), 0)
    assert 'stale' in d.excitation_status(relay, link).message
    relay.setpoint(0.1, 0.0, 0.0)
    assert 'no segment is running' in d.excitation_status(relay, link).message


def test_callbacks_that_fail_are_a_warning_for_as_long_as_they_come():
    assert d.callback_entries(0, 0) == []
    (now,) = d.callback_entries(3, 2)
    assert (now.level, now.values) == (d.WARN, {'failed callbacks': 3})
    assert now.message.startswith('2 callbacks failed')
    (later,) = d.callback_entries(3, 0)
    assert later.level == d.OK


def test_a_far_end_that_does_not_read_is_told():
    link, port = Link(), PortStatus(PortState.OPEN, 'x', dropped_writes=7, opened=1)
    verdicts = [
        d._flowing(port, 0, port.dropped_writes - since.dropped_writes)
        for since in (NOTHING, d.Since(1.0, link.decoder.counts, 0, 7))
    ]
    assert [level for level, _ in verdicts] == [d.WARN, d.OK]
    assert 'does not read' in verdicts[0][1]
