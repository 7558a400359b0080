"""The bridge's link and the virtual STM32 with one key, in memory; and somebody without it."""

from dataclasses import replace

import pytest

pytest.importorskip('diagnostic_msgs.msg', reason='needs the ROS 2 message packages')

from quad_bridge.diagnostics import clock_status
from quad_bridge.link import Link
from quad_bridge.virtual.aircraft import Aircraft
from quad_bridge.virtual.endpoint import Endpoint
from quad_bridge.virtual.profile import load_profile
from quad_bridge.virtual.receiver import Receiver
from quad_bridge.wire import frames as f
from quad_bridge.wire.codec import Decoder, Encoder
from quad_bridge.wire.signing import Signing

CYCLE_NS = 4_000_000
KEY = bytes(range(32))


class Pair:
    """Both ends; `key` of the aircraft may differ from the bridge's."""

    def __init__(self, key=KEY, *, signed=True):
        aircraft = Aircraft(replace(load_profile('plain'), mount='rig'), seed=1)
        self.now_ns = 1_000_000_000
        self.stm32 = Endpoint(aircraft, Receiver(), self.signing(key))
        self.link = Link(self.signing(KEY) if signed else None)
        self.link.opened()
        self.recorded = b''

    def signing(self, key):
        return Signing(key, lambda: self.now_ns // 10_000)

    def run(self, cycles=500):
        stamped = 0
        for number in range(cycles):
            stamped += len(self.link.receive(self.stm32.cycle(), self.now_ns))
            if number % 12 == 0:
                self.link.tick(self.now_ns)
            data = self.link.drain()
            self.recorded += data
            self.link.receive(self.stm32.receive(data, self.now_ns), self.now_ns)
            self.now_ns += CYCLE_NS
        return stamped


def test_with_one_key_all_is_as_without():
    pair = Pair()
    assert pair.run() > 400
    assert pair.link.gains.reader.complete
    counts = pair.link.decoder.counts
    assert counts.unsigned == counts.forged == counts.replayed == counts.lost_cycles == 0


def test_with_another_key_nothing_is_heard_on_either_side():
    pair = Pair(bytes(32))
    assert pair.run(250) == 0
    assert pair.link.decoder.counts.forged > 250
    assert not pair.link.gains.reader.complete


def test_a_bridge_without_the_key_is_told_so():
    pair = Pair(signed=False)
    pair.run(250)
    assert pair.link.decoder.counts.unverified > 250
    assert not pair.link.gains.reader.complete
    assert 'see key_file' in clock_status(pair.link).message


def test_a_recording_and_the_unsigned_are_not_obeyed():
    pair = Pair()
    pair.run(250)
    ask = f.ParamRequestRead('YAW_ANG_KP')
    assert pair.stm32.receive(Encoder(1, 191).encode(ask), pair.now_ns) == b''
    assert pair.stm32.receive(pair.recorded, pair.now_ns) == b''
    pair.link.send(ask)
    answer = pair.stm32.receive(pair.link.drain(), pair.now_ns)
    (value,) = Decoder().feed(answer)
    assert isinstance(value, f.ParamValue)
