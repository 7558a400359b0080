"""The bridge's link and the virtual STM32 with one key, in memory; and somebody without it."""

from dataclasses import replace

import pytest
from flight_controller import Line

pytest.importorskip('diagnostic_msgs.msg', reason='needs the ROS 2 message packages')

from quad_bridge.link.machine import Link
from quad_bridge.link.report import clock_status
from quad_bridge.virtual.aircraft import Aircraft
from quad_bridge.virtual.endpoint import Endpoint
from quad_bridge.virtual.profile import load_profile
from quad_bridge.virtual.receiver import Receiver
from quad_bridge.wire import frames as f
from quad_bridge.wire.codec import Decoder, Encoder
from quad_bridge.wire.signing import Signing

KEY = bytes(range(32))


class Signed(Line):
    """Both ends; `key` of the aircraft may differ from the bridge's."""

    def __init__(self, key=KEY, *, signed=True):
        self.steps, self.host0_ns = 0, 1_000_000_000
        aircraft = Aircraft(replace(load_profile('plain'), mount='rig'), seed=1)
        endpoint = Endpoint(aircraft, Receiver(), self.signing(key))
        super().__init__(endpoint, Link(self.signing(KEY) if signed else None))

    def signing(self, key):
        return Signing(key, lambda: self.now_ns // 10_000)


def test_with_one_key_all_is_as_without():
    pair = Signed()
    pair.run(500)
    assert len(pair.out) > 400
    assert pair.gains.active
    counts = pair.link.decoder.counts
    assert counts.unsigned == counts.forged == counts.replayed == counts.lost_cycles == 0


def test_with_another_key_nothing_is_heard_on_either_side():
    pair = Signed(bytes(32))
    pair.run(250)
    assert pair.out == []
    assert pair.link.decoder.counts.forged > 250
    assert not pair.gains.active


def test_a_bridge_without_the_key_is_told_so():
    pair = Signed(signed=False)
    pair.run(250)
    assert pair.link.decoder.counts.unverified > 250
    assert not pair.gains.active
    assert 'see key_file' in clock_status(pair.link, 0, unset=False, now_s=1.0).message


def test_a_recording_and_the_unsigned_are_not_obeyed():
    pair, recorded = Signed(), []
    carry = pair.up.carry
    pair.up.carry = lambda data: recorded.append(data) or carry(data)
    pair.run(250)
    stm32 = pair.controller
    ask = f.ParamRequestRead('YAW_ANG_KP')
    assert stm32.receive(Encoder(1, 191).encode(ask), pair.since_ns) == b''
    assert stm32.receive(b''.join(recorded), pair.since_ns) == b''
    pair.link.send(ask)
    (value,) = Decoder().feed(stm32.receive(pair.link.to_send(), pair.since_ns))
    assert isinstance(value, f.ParamValue)
