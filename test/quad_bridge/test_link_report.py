"""What the bridge says of its link, clock, gains and excitation."""

from dataclasses import replace

import pytest
from flight_controller import STILL

pytest.importorskip('diagnostic_msgs.msg', reason='needs the ROS 2 message packages')

from quad_bridge.excitation_relay import ExcitationRelay
from quad_bridge.link.machine import Link
from quad_bridge.link.port import PortState, PortStatus
from quad_bridge.link.report import LinkReport, clock_status
from quad_bridge.status import ERROR, OK, WARN
from quad_bridge.wire import frames as f
from quad_bridge.wire.codec import Decoder, Encoder
from quad_bridge.wire.signing import Signing

OPEN = PortStatus(PortState.OPEN, '', 1, 0)


def cycle(number, flags=1):
    return Encoder().encode(replace(STILL, time_us=4000 * number, cycle=number, flags=flags))


def verdict(link, port=OPEN, report=None, now_s=1.0):
    """What is said of the link, since the last report or since the start."""
    status, _ = (report or LinkReport(link, 0.0)).entries(port, now_s)
    return status.level, status.message


def test_a_port_fault_a_silent_port_and_another_protocol_are_errors_in_their_own_words():
    for state in (PortState.NOT_THERE, PortState.BUSY, PortState.DENIED, PortState.HUNG_UP):
        assert verdict(Link(), PortStatus(state, 'why', 0, 0)) == (ERROR, f'port {state.value}')
    link = Link()
    assert verdict(link) == (ERROR, 'port open, but nothing arrives')
    link.receive(b'$GPGGA,1,2,3\r\n' * 10, 0)
    assert verdict(link) == (WARN, 'bytes arrive, no valid frame yet')
    link.receive(b'$GPGGA,1,2,3\r\n' * 200, 0)
    words = 'speaks another protocol or baud rate: no valid frame in 2940 bytes'
    assert verdict(link) == (ERROR, words)


def test_an_aircraft_of_a_broken_clock_is_told_what_to_set():
    key, today = bytes(range(32)), 2**45
    far = Signing(key, lambda: today)
    far.stamp = lambda: 2**48 - 2
    link = Link(Signing(key, lambda: today))
    link.receive(Encoder(1, 1, far).encode(f.Heartbeat(2, 12)), 0)
    level, text = verdict(link)
    assert level == ERROR
    assert 'signs with a time far ahead: set its clock' in text


def test_good_cycles_are_ok_and_new_losses_a_warning():
    link = Link()
    link.receive(cycle(1) + cycle(2), 0)
    report = LinkReport(link, 0.0)
    assert verdict(link, report=report) == (OK, 'control cycles arrive')
    link.receive(cycle(6), 0)
    lost = (WARN, '3 cycles lost since the last report')
    assert verdict(link, report=report, now_s=2.0) == lost
    assert verdict(link, report=report, now_s=2.1) == lost  # out of turn: of the time before
    link.receive(Encoder().encode(f.Heartbeat()), 0)
    assert verdict(link, report=report, now_s=3.0)[0] == ERROR


def test_the_clock_says_why_nothing_is_published():
    def told(now_s=0.0):
        return clock_status(link, 0, unset=False, now_s=now_s)

    link = Link()
    assert 'no answer to TIMESYNC' in told().message
    signed = Encoder(1, 1, Signing(bytes(range(32)), lambda: 2**45))
    link.receive(signed.encode(f.Heartbeat()), 0)
    assert 'answers only who has its key: set key_file' in told().message
    link.clock.add(0, 100, 200)
    assert 'not converged' in told().message
    for k in range(10):
        link.clock.add(1000 * k, 1000 * k + 100, 1000 * k + 200)
    assert told().level == OK
    late = told(4.0)
    assert (late.level, 'for 4 s: does the aircraft hear us?' in late.message) == (WARN, True)


def test_the_excitation_state_follows_the_flags():
    def told(flags):
        (frame,) = Decoder().feed(cycle(1, int(flags)))
        return relay.status(frame, 0.0)

    relay = ExcitationRelay(100)
    assert relay.status(None, 0.0).message == 'idle'
    status = told(f.Flag.ARMED | f.Flag.EXCITATION)
    assert status.message == 'running'
    assert status.values['flags of the STM32'] == 'armed excitation'
    assert 'stale' in told(f.Flag.STALE_SETPOINT).message
    relay.setpoint(0.1, 0.0, 0.0)
    assert 'no segment is running' in told(f.Flag.STALE_SETPOINT).message


def test_an_aircraft_that_does_not_read_is_told():
    link, port = Link(), PortStatus(PortState.OPEN, '', 1, 7)
    report = LinkReport(link, 0.0)
    for k, (level, words) in enumerate(((WARN, 'does not read'), (OK, 'cycles arrive')), 1):
        link.receive(cycle(k), 0)
        told = verdict(link, port, report, 1.0 * k)
        assert (told[0], words in told[1]) == (level, True)
