"""All parameters are read, in the order of their index, whatever the line loses."""

import zlib

from quad_bridge.wire.frames import ParamRequestList, ParamRequestRead, ParamValue
from quad_bridge.wire.params import ParamReader, checksum

OLD = {'A': 1.0, 'B': 2.0, 'C': 3.0}


def test_the_reader_asks_again_for_what_did_not_come():
    reader = ParamReader()
    assert reader.poll(0.0) == ParamRequestList()
    assert reader.poll(0.01) is None
    reader.take(ParamValue('A', 1.0, 3, 0), 0.02)
    reader.take(ParamValue('C', 3.0, 3, 2), 0.03)
    assert not reader.complete
    assert reader.ordered() == []
    assert reader.poll(0.5) == ParamRequestRead('', 1)
    reader.take(ParamValue('B', 2.0, 3, 1), 0.6)
    assert reader.complete
    assert reader.poll(9.0) is None
    assert reader.values == OLD
    assert reader.ordered() == ['A', 'B', 'C']


def test_the_checksum_is_the_crc_of_the_float32_bytes():
    assert checksum([1.0, -0.5]) == zlib.crc32(bytes.fromhex('0000803f 000000bf'))
    assert checksum([0.1]) == checksum([0.1 + 1e-10])
