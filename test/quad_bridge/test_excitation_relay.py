"""The operator's dead-man switch: alive or not, and what the excitation relay makes of it."""

import pytest

pytest.importorskip('rcl_interfaces.msg', reason='needs the ROS 2 message packages')

from quad_bridge.arming import OperatorEnable
from quad_bridge.excitation_relay import ExcitationRelay
from quad_bridge.wire.codec import Encoder
from quad_bridge.wire.frames import Injection

TRAIN = {'segment': 'train', 'signal': 'prbs', 'axis': 'roll', 'injection': 'rate'}


@pytest.mark.parametrize('required', [True, False])
def test_half_a_second_of_silence_counts_as_letting_go(required):
    enable = OperatorEnable(required=required)
    assert ('silent' in enable.fault(0.0)) is required
    enable.take(0.0, 1.0)  # who has taken it is relied on, needed or not
    assert enable.fault(1.5) == ''
    assert 'silent' in enable.fault(1.501)
    enable.take(0.3, 2.0)  # it was held at 1.7
    assert enable.fault(2.199) == ''
    assert 'silent' in enable.fault(2.201)


@pytest.mark.parametrize('age_s', [-0.2, 0.6, 1e9])
def test_what_bears_a_stamp_of_another_time_commands_nothing_and_is_counted(age_s):
    """As set-points, segments and enables of a bag that is played beside a live aircraft."""
    enable = OperatorEnable(required=True)
    relay = ExcitationRelay(100, enable)
    enable.take(age_s, 1.0)
    assert 'its stamp is' in enable.fault(1.0)
    enable.take(0.0, 1.0)
    relay.segment({'segment': 'idle'}, age_s)  # the last word of a schedule, to a new bridge
    assert relay.status(None, 1.0).message == 'idle'
    relay.segment(TRAIN)
    assert relay.setpoint(0.1, 0.0, 0.0, 1.0, age_s) is None
    assert relay.segment({**TRAIN, 'injection': 'control'}, age_s) is None
    assert relay.segment({'segment': 'idle'}, age_s) is None
    assert (enable.refused, relay.dropped, 'its stamp is' in relay.reason) == (1, 3, True)
    assert relay.setpoint(0.1, 0.0, 0.0, 1.0, 0.4).injection == Injection.RATE


def test_the_relay_ends_the_excitation_once_and_waits_for_the_next_segment():
    enable = OperatorEnable(required=True)
    relay = ExcitationRelay(100, enable)
    relay.segment(TRAIN)
    assert relay.setpoint(0.1, 0.0, 0.0, 0.9) is None
    assert 'silent' in relay.reason
    enable.take(0.0, 1.0)
    assert relay.tick(1.2) is None
    assert relay.setpoint(0.1, 0.0, 0.0, 1.2).injection == Injection.RATE
    end = relay.tick(1.6)
    assert (end.injection, end.value) == (Injection.NONE, (0.0, 0.0, 0.0))
    assert relay.tick(1.7) is None
    enable.take(0.0, 1.8)
    assert relay.setpoint(0.1, 0.0, 0.0, 1.9) is None  # not by itself: somebody had let go
    assert 'next segment' in relay.reason
    relay.segment(TRAIN)
    assert relay.setpoint(0.1, 0.0, 0.0, 1.9).injection == Injection.RATE


def test_set_points_follow_the_segment():
    relay = ExcitationRelay(100)
    assert relay.setpoint(0.1, 0.2, 0.3) is None
    assert 'no segment is running' in relay.reason
    # what the STM32 refused before is forgotten by the frame that ends it
    assert relay.segment(TRAIN).injection == Injection.NONE
    assert relay.segment(TRAIN) is None
    frame = relay.setpoint(0.1, 0.2, 0.3)
    assert frame.value == (0.1, -0.2, -0.3)  # FLU to FRD
    assert (frame.injection, frame.valid_ms) == (Injection.RATE, 100)
    # what no frame can carry is dropped with its reason
    unfit = [1e300, -3.5e38, float('inf'), float('nan'), 1000.0]
    for value in unfit:
        assert relay.setpoint(0.0, value, 0.0) is None
        assert 'within ±1000' in relay.reason
    Encoder().encode(relay.setpoint(999.0, -999.0, 0.0))
    assert relay.reason == ''
    end = relay.segment({'segment': 'idle', 'signal': 'none', 'injection': 'rate'})
    assert end.injection == Injection.NONE
    assert relay.setpoint(0.1, 0.0, 0.0) is None
    assert (relay.forwarded, relay.dropped) == (2, 2 + len(unfit))


def test_a_set_point_on_its_way_when_its_segment_ended_is_no_fault():
    relay = ExcitationRelay(100)
    relay.segment(TRAIN, 0.0, 9.0)
    relay.segment({'segment': 'idle'}, 0.001, 10.001)
    assert relay.setpoint(0.1, 0.0, 0.0, 10.002, 0.006) is None
    assert relay.status(None, 10.1).message == 'idle'
    assert relay.setpoint(0.1, 0.0, 0.0, 10.003, 1e6) is None
    assert 'its stamp is 1000000.0 s old' in relay.status(None, 10.1).message  # as from a bag
    assert relay.setpoint(0.1, 0.0, 0.0, 10.006, 0.002) is None
    assert 'no segment is running' in relay.status(None, 10.1).message


def test_a_segment_of_the_climb_is_for_the_third_value_at_the_control_alone():
    relay = ExcitationRelay(100, OperatorEnable(required=False))
    relay.segment({**TRAIN, 'axis': 'climb', 'injection': 'control'})
    frame = relay.setpoint(0.0, 0.0, 0.05, 1.0)
    assert (frame.injection, frame.value[2]) == (Injection.THRUST, -0.05)
    relay.segment({**TRAIN, 'axis': 'climb'})  # no rate of it is known
    assert relay.setpoint(0.0, 0.0, 0.05, 1.0) is None
