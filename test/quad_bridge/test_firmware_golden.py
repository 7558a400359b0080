"""Frames that both languages must read and write to the same byte: golden_frames.json.

Each is checked by our codec, over pymavlink's generated Python, and by the generated C, both ways.
Characters stand in hexadecimal.
"""

import json
from pathlib import Path

import numpy as np
import pytest
from node_process import ended

from quad_bridge.wire import dialect
from quad_bridge.wire.codec import Decoder, Encoder
from quad_bridge.wire.frames import Cycle, Standard
from quad_bridge.wire.messages import FROM_MESSAGE, OFTEN
from quad_bridge.wire.signing import Signing

FRAMES = json.loads(Path(__file__).with_name('golden_frames.json').read_text(encoding='utf-8'))
each = pytest.mark.parametrize('golden', FRAMES, ids=lambda g: f'{g["message"]}-{g["sequence"]}')


def test_every_message_of_our_own_is_there():
    named = {g['message'] for g in FRAMES}
    used = {dialect.mavlink_map[number].msgname for number in {**FROM_MESSAGE, **OFTEN}}
    assert used <= named


@each
def test_our_codec_reads_it_and_writes_it_again(golden):
    signing = {}
    if 'key' in golden:
        # its first frame is stamped later than its start by one
        start = golden['time'] - 1
        key, link = bytes.fromhex(golden['key']), golden['link']
        signing = {'signing': Signing(key, lambda: start, link_id=link)}
    encoder = Encoder(golden['system'], golden['component'], **signing)
    encoder._mav.seq = golden['sequence']
    decoder = Decoder(**({'signing': Signing(key, lambda: start)} if signing else {}))
    (frame,) = decoder.feed(bytes.fromhex(golden['hex']))
    assert not isinstance(frame, Standard)
    if isinstance(frame, Cycle):
        for name, value in golden['fields'].items():
            found = getattr(frame, {'time_usec': 'time_us'}.get(name, name))
            assert np.array_equal(np.float32(found), np.float32(value)), name
    assert encoder.encode(frame).hex() == golden['hex']
    assert encoder.encode(frame)[4] == (golden['sequence'] + 1) % 256


def signature(golden, *names):
    return ''.join(f' @{name}={golden[name]}' for name in names if 'key' in golden)


def test_c_reads_and_writes_them(firmware):
    read = [f'decode {g["hex"]}{signature(g, "key")}' for g in FRAMES]
    write = [
        f'encode {g["message"]} {g["system"]} {g["component"]} {g["sequence"]} '
        + ' '.join(f'{name}={as_text(value)}' for name, value in g['fields'].items())
        + signature(g, 'key', 'link', 'time')
        for g in FRAMES
    ]
    run = ended(firmware('golden'), input=''.join(f'{line}\n' for line in read + write))
    lines = run.stdout.splitlines()
    for golden, line in zip(FRAMES, lines[: len(FRAMES)], strict=True):
        name, system, component, sequence, *fields = line.split(' ')
        assert name == golden['message']
        ids = (golden['system'], golden['component'], golden['sequence'])
        assert (int(system), int(component), int(sequence)) == ids
        found = dict(field.split('=', 1) for field in fields)
        for key, wanted in golden['fields'].items():
            assert as_text(wanted) == found[key], (name, key)
    assert lines[len(FRAMES) :] == [g['hex'] for g in FRAMES]


def as_text(value):
    """As the C side takes and prints it: nine digits tell any float32."""
    if isinstance(value, list):
        return ','.join(as_text(v) for v in value)
    return f'{value:.9g}' if isinstance(value, float) else str(value)
