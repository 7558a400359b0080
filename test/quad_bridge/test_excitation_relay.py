"""The operator's dead-man switch: alive or not, and what the excitation relay makes of it."""

import pytest

pytest.importorskip('rcl_interfaces.msg', reason='needs the ROS 2 message packages')

from quad_bridge.arming import OperatorEnable
from quad_bridge.excitation_relay import ExcitationRelay
from quad_bridge.nodes.bridge_parameters import over_network
from quad_bridge.wire.frames import Injection

TRAIN = {'segment': 'train', 'signal': 'prbs', 'axis': 'roll', 'injection': 'rate'}


def test_half_a_second_of_silence_counts_as_letting_go():
    enable = OperatorEnable(required=True)
    assert 'silent' in enable.fault(0.0)
    enable.take(True, 1.0)
    assert enable.fault(1.5) == ''
    assert 'silent' in enable.fault(1.501)
    enable.take(False, 2.0)
    assert 'off' in enable.fault(2.0)


def test_where_nobody_needs_to_hold_it_who_has_taken_it_is_relied_on():
    enable = OperatorEnable(required=False)
    assert enable.fault(5.0) == ''
    enable.take(True, 6.0)
    assert enable.fault(6.4) == ''
    assert 'silent' in enable.fault(6.6)


def test_the_relay_ends_the_excitation_once_and_waits_for_the_next_segment():
    enable = OperatorEnable(required=True)
    relay = ExcitationRelay(100, enable)
    relay.segment(TRAIN)
    assert relay.setpoint(0.1, 0.0, 0.0, 0.9) is None
    assert 'silent' in relay.reason
    enable.take(True, 1.0)
    assert relay.tick(1.2) is None
    assert relay.setpoint(0.1, 0.0, 0.0, 1.2).injection == Injection.RATE
    end = relay.tick(1.6)
    assert (end.injection, end.value) == (Injection.NONE, (0.0, 0.0, 0.0))
    assert relay.tick(1.7) is None
    enable.take(True, 1.8)
    assert relay.setpoint(0.1, 0.0, 0.0, 1.9) is None  # not by itself: somebody had let go
    assert 'next segment' in relay.reason
    relay.segment(TRAIN)
    assert relay.setpoint(0.1, 0.0, 0.0, 1.9).injection == Injection.RATE


def test_what_leads_over_a_network():
    assert over_network('socket://localhost:5760')
    assert over_network('RFC2217://rig:4000')
    assert over_network('unknown://rig')
    for wire in ('/dev/ttyACM0', 'COM3', 'loop://', 'spy:///dev/ttyUSB0', 'hwgrep://FTDI'):
        assert not over_network(wire)
