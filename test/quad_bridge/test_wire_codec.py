"""One table of frames drives encoder and decoder; what else arrives is counted."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from fastcrc.crc16 import mcrf4xx
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common

from quad_bridge.errors import EncodeError
from quad_bridge.wire import frames as f
from quad_bridge.wire.codec import Decoder, Encoder

GOLDEN, *_ = GOLDENS = [
    bytes.fromhex(one['hex'])
    for one in json.loads(Path(__file__).with_name('golden_frames.json').read_text())
    if 'key' not in one
]
FRAMES = [frame for data in GOLDENS for frame in Decoder().feed(data)]
CYCLE, COMMAND, STATE = (
    next(frame for frame in FRAMES if isinstance(frame, kind))
    for kind in (f.Cycle, f.GainsCommand, f.GainsState)
)


@pytest.mark.parametrize(
    'frame',
    [
        f.RcChannels(0, (70000,)), f.ParamSet('ROLL_RATE_KP', 'much'), f.ParamSet('Größe', 1.0),
        f.Excitation((1.0, 2.0), 1, 0), f.Excitation((1.0, 2.0, 3.0), 1, 256),
        f.Standard('ATTITUDE'),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused_in_one_line(frame):
    with pytest.raises(EncodeError, match=r'\A[^\n]+\Z'):
        Encoder().encode(frame)


@pytest.mark.parametrize(
    ('numbers', 'overtaken', 'lost', 'restarts'),
    [
        ([2**32 - 2, 2**32 - 1, 300, 301, 303], [], 300 + 1, 0),  # across the counter's wrap
        ([5000, 5001, 0, 1], [], 0, 1), ([10, 12, 11, 13], [11], 1, 0),
    ],
)
def test_lost_cycles_and_restarts_are_counted_by_the_32_bit_counter(
    numbers, overtaken, lost, restarts
):
    decoder, encoder = Decoder(), Encoder()
    sent = [replace(CYCLE, cycle=n, time_us=4000 * n + 7) for n in numbers]
    frames = [frame for one in sent for frame in decoder.feed(encoder.encode(one))]
    assert [frame.cycle for frame in frames] == [n for n in numbers if n not in overtaken]
    assert (decoder.counts.lost_cycles, decoder.counts.restarts) == (lost, restarts)


def peer(system=1):
    return common.MAVLink(None, srcSystem=system, srcComponent=1)


PARAMETER = Encoder().encode(f.ParamValue('ROLL_RATE_KP', 9.0, 27, 3))
FLAGGED = GOLDEN[1:2] + b'\x03' + GOLDEN[3:-2]
OLD = peer().heartbeat_encode(2, 3, 0, 0, 4).pack(peer(), force_mavlink1=True)


@pytest.mark.parametrize(
    ('data', 'found', 'counts'),
    [
        (peer(9).gps_raw_int_encode(1, 3, 1, 1, 1, 1, 1, 1, 1, 9).pack(peer(9)),
         [f.Standard('GPS_RAW_INT')], {'standard': 1}),
        (b'\xfd\x02\0\0\x07\x09\x01\xff\xff\x77ab??', [], {'unknown': 1, 'garbage_bytes': 14}),
        # a log that is downloaded over the link holds frames of an earlier flight
        (peer().serial_control_encode(0, 0, 0, 0, len(PARAMETER), PARAMETER.ljust(70, b'\0'))
         .pack(peer()), [f.Standard('SERIAL_CONTROL')], {'standard': 1}),
        # in a message that only the sender knows, in sequence with its other messages
        (peer().heartbeat_encode(2, 3, 0, 0, 4).pack(peer()) + b'\xfd'
         + bytes([len(PARAMETER), 0, 0, 1, 1, 1, 255, 255, 119]) + PARAMETER + b'??',
         [f.Heartbeat(2, 3, system=1, component=1)], {'unknown': 1}),
        (OLD + OLD, [], {'old_version': 2, 'garbage_bytes': 2 * len(OLD)}),
        # signed, with flags of a later protocol, though its checksum is right
        (b'\xfd' + FLAGGED + mcrf4xx(FLAGGED + b'\xed').to_bytes(2, 'little') + bytes(13), [],
         {'garbage_bytes': len(GOLDEN) + 13, 'damaged': 1}),
        # a false start does not swallow the frame behind it
        (b'\xfd\x50', [], {'garbage_bytes': 2, 'damaged': 1}),
        (b'\xfd\x50\x00\x00', [], {'garbage_bytes': 4, 'damaged': 1}),
        (b'\xfd\x60\x01\x00\x00\x01\x01', [], {'garbage_bytes': 7, 'damaged': 1}),
    ],
)  # fmt: skip
def test_what_is_not_ours_is_counted_and_costs_no_frame(data, found, counts):
    decoder = Decoder()
    assert decoder.feed(data + GOLDEN) == [*found, CYCLE]
    seen = {k: v for k, v in vars(decoder.counts).items() if v and k not in {'bytes', 'frames'}}
    if 'damaged' in counts:
        seen['damaged'] = seen.pop('bad_crc', 0) + seen.pop('unknown', 0)
    assert seen == counts


def test_only_the_peer_is_listened_to_where_this_end_has_a_name():
    decoder = Decoder(own=(1, 191))
    station = Encoder(255, 190).encode(f.Heartbeat(type=6, autopilot=8))
    echo = Encoder(1, 191).encode(f.TimeSync(0, 5))
    other = Encoder(2, 1).encode(f.Battery(11.0))
    (first,) = decoder.feed(station)  # nobody has flown yet: it may be the peer
    assert first.system == 255
    assert decoder.feed(echo + Encoder(1, 191).encode(f.Heartbeat(autopilot=3))) == []
    assert decoder.peer is None
    assert decoder.feed(GOLDEN) == [CYCLE]
    assert decoder.peer == (1, 1)
    assert decoder.feed(other + station + echo) == []
    assert decoder.counts.foreign == 5
    decoder.feed(GOLDEN[:60])
    decoder.resync()  # and the half frame is forgotten
    assert decoder.feed(Encoder(2, 1).encode(CYCLE)) == [CYCLE]
    assert decoder.counts.garbage_bytes == 0


def test_values_that_cannot_be_are_not_handed_out():
    nan, inf = float('nan'), float('inf')
    bad = [
        replace(CYCLE, gyro=(nan, 0.0, 0.0)), replace(CYCLE, motors=(0.0, 0.0, 0.0, inf)),
        replace(CYCLE, accel=(0.0, nan, 0.0)), replace(CYCLE, motors=(-0.01, 0.0, 0.0, 0.0)),
        replace(CYCLE, attitude=(0.0, 6.31, 0.0)), replace(CYCLE, injection=9),
        *(replace(STATE, **{name: 7}) for name in ('phase', 'result', 'action')),
        replace(COMMAND, action=5), f.ParamValue('ROLL_RATE_KP', nan, 1, 0),
    ]  # fmt: skip
    decoder = Decoder(own=(1, 191))
    assert decoder.feed(b''.join(Encoder().encode(frame) for frame in bad)) == []
    assert (decoder.counts.implausible, decoder.counts.frames) == (len(bad), 0)


STREAM = b''.join(Encoder().encode(frame) for frame in FRAMES * 2)
SENT = {repr(frame) for frame in FRAMES}
PIECES = st.one_of(
    st.binary(max_size=300), st.sampled_from([Encoder().encode(frame) for frame in FRAMES]),
    st.integers(0, len(GOLDEN)).map(lambda cut: GOLDEN[:cut]),
    st.binary(max_size=40).map(lambda tail: b'\xfd' + tail))
SIZES, BYTES = st.integers(1, 300), st.binary(min_size=1, max_size=60)


@st.composite
def damaged(draw):
    """The stream of all frames with bytes replaced, missing, inserted, or spliced elsewhere."""
    data = bytearray(STREAM)
    for _ in range(draw(st.integers(1, 6))):
        at, other = (draw(st.integers(0, len(data) - 1)) for _ in range(2))
        spliced = SIZES.map(lambda n, other=other: bytes(data[other : other + n]))
        data[at : at + draw(st.integers(0, 60))] = draw(st.just(b'') | BYTES | spliced)
    return bytes(data)


def fed(data, step, **options):
    """Frames and decoder; the same whatever the split."""
    whole, split = Decoder(**options), Decoder(**options)
    found = [repr(x) for x in whole.feed(data)]
    parts = [data[i : i + step] for i in range(0, len(data), step)]
    assert [repr(x) for part in parts for x in split.feed(part)] == found
    assert split.counts == whole.counts
    assert whole.counts.bytes == len(data)
    return found, whole.counts


@given(damaged(), st.integers(1, 211))
def test_a_damaged_stream_gives_frames_that_were_sent_or_counted_errors(data, step):
    found, counts = fed(data, step, own=(1, 191))
    # a checksum of 16 bits lets 1 damaged frame in 65,536 pass: none of these examples does
    assert set(found) <= SENT
    lost = len(found) < len(FRAMES) * 2
    assert not lost or counts.bad_crc + counts.unknown + counts.garbage_bytes or data in STREAM


@given(st.lists(PIECES, max_size=12), st.integers(1, 97))
def test_any_bytes_in_any_split_give_the_same_frames_and_never_raise(pieces, step):
    fed(b''.join(pieces), step)
