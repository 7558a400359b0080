"""What the bridge says of its link, clock, gains and excitation."""

from dataclasses import replace

import pytest
from flight_controller import STILL

pytest.importorskip('diagnostic_msgs.msg', reason='needs the ROS 2 message packages')

from quad_bridge.link.machine import Link
from quad_bridge.link.port import PortState, PortStatus
from quad_bridge.link.report import LinkReport
from quad_bridge.status import ERROR, OK, WARN
from quad_bridge.wire import frames as f
from quad_bridge.wire.codec import Encoder
from quad_bridge.wire.signing import Signing

OPEN = PortStatus(PortState.OPEN, '', 1, 0)


def cycle(number, flags=1, **more):
    return Encoder(**more).encode(replace(STILL, time_us=4000 * number, cycle=number, flags=flags))


def far_ahead():
    """A frame of an aircraft whose clock is broken."""
    far = Signing(KEY, lambda: TODAY)
    far.stamp = lambda: 2**48 - 2
    return Encoder(1, 1, far).encode(f.Heartbeat(2, 12))


KEY, TODAY = bytes(range(32)), 2**45
NOISE, BEAT = b'$GPGGA,1,2,3\r\n', Encoder().encode(f.Heartbeat())
LOST, DROPS = '3 cycles lost since the last report', PortStatus(PortState.OPEN, '', 1, 7)
STORIES = {
    **{state.name: [(1.0, b'', PortStatus(state, 'why', 0, 0), ERROR, f'port {state.value}')]
       for state in (PortState.NOT_THERE, PortState.BUSY, PortState.DENIED, PortState.HUNG_UP)},
    'another protocol': [
        (1.0, b'', OPEN, ERROR, 'port open, but nothing arrives'),
        (1.1, NOISE * 10, OPEN, WARN, 'bytes arrive, no valid frame yet'),
        (1.2, NOISE * 200, OPEN, ERROR,
         'speaks another protocol or baud rate: no valid frame in 2940 bytes'),
    ],
    'a broken clock': [
        (1.0, far_ahead(), OPEN, ERROR, 'signs with a time far ahead: set its clock'),
    ],
    'a lost key': [
        (1.0, cycle(1, signing=Signing(KEY, lambda: TODAY)), OPEN, OK, 'control cycles arrive'),
        (2.0, cycle(2), OPEN, ERROR, 'the aircraft does not sign: give it the key'),
    ],
    'lost cycles': [
        (1.0, cycle(1) + cycle(2), OPEN, OK, 'control cycles arrive'),
        (2.0, cycle(6), OPEN, WARN, LOST),
        (2.1, b'', OPEN, WARN, LOST),  # out of turn: of the time before
        (3.0, BEAT, OPEN, ERROR, 'no control cycle since the last report'),
    ],
    'an aircraft that does not read': [
        (1.0, cycle(1), DROPS, WARN, 'does not read'), (2.0, cycle(2), DROPS, OK, 'arrive'),
    ],
}  # fmt: skip
"""When, what has arrived, at which port, and what is said."""


@pytest.mark.parametrize('story', STORIES.values(), ids=STORIES)
def test_the_link_says_what_is_wrong_in_its_own_words(story):
    signs = story in (STORIES['a broken clock'], STORIES['a lost key'])
    link = Link(Signing(KEY, lambda: TODAY) if signs else None)
    report = LinkReport(link, 0.0)
    for now_s, data, port, level, words in story:
        link.receive(data, 0)
        status, _ = report.entries(port, now_s)
        assert (status.level, words in status.message) == (level, True), status.message
