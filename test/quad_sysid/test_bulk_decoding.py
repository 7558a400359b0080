"""Reading in bulk equals rosbags' deserialiser bit for bit, whatever the messages look like."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.interfaces import Nodetype

from quad_sysid.bags import cdr
from quad_sysid.bags.cdr import (
    BATTERY,
    COLUMNS,
    IMU,
    JOINTS,
    MOTOR_NAMES,
    VECTOR,
    WRENCH,
    typestore,
)

TYPES = typestore().types
TEXTS = st.sampled_from(['base_link', '', 'a', 'imu', 'böse', 'base_linkbase_link'])
NUMBERS = st.floats(width=64)
MOTORS = st.one_of(st.permutations(MOTOR_NAMES), st.lists(TEXTS, max_size=5)).map(list)
SCALARS = {
    'float64': NUMBERS, 'float32': st.floats(width=32), 'uint8': st.integers(0, 255),
    'bool': st.booleans(), 'int32': st.integers(-(2**31), 2**31 - 1),
    'uint32': st.integers(0, 2**32 - 1), 'string': TEXTS,
}


def content(field):
    """What may stand in a field: (node type, details) as rosbags describes it."""
    kind, about = field
    if kind == Nodetype.BASE:
        return SCALARS[about[0]]
    if kind == Nodetype.NAME:
        return message(about)
    (_, (base, _)), most = about
    if base == 'string':
        return MOTORS
    low, high = (most, most) if kind == Nodetype.ARRAY else (0, 5)
    values = st.lists(SCALARS[base], min_size=low, max_size=high)
    return values.map(lambda v: np.array(v, base))


def message(msgtype):
    _, fields = typestore().fielddefs[msgtype]
    return st.builds(TYPES[msgtype], **{name: content(field) for name, field in fields})


MESSAGES = {msgtype: message(msgtype) for msgtype in (IMU, JOINTS, BATTERY, WRENCH, VECTOR)}


@st.composite
def spoiled(draw, raw):
    """Bytes changed, cut off or added."""
    data = bytearray(raw)
    kind = draw(st.sampled_from(['change', 'cut', 'add']))
    if kind == 'change':
        # in the first bytes, where lengths and texts lie
        data[draw(st.integers(0, min(len(data), 60) - 1))] = draw(st.integers(0, 255))
    elif kind == 'cut':
        del data[draw(st.integers(0, len(data))) :]
    else:
        data += bytes(draw(st.integers(1, 9)))
    return bytes(data)


@st.composite
def serialised(draw, msgtype):
    """A list of messages: some alike, some of another layout, endianness or spoiled."""
    out = []
    for message in draw(st.lists(MESSAGES[msgtype], min_size=1, max_size=6)):
        little = draw(st.integers(0, 9)) > 0
        raw = bytes(typestore().serialize_cdr(message, msgtype, little_endian=little))
        out += [raw] * draw(st.integers(1, 3))
        if draw(st.booleans()):
            out.append(draw(spoiled(raw)))
    return draw(st.permutations(out))


def one_by_one(msgtype, raws):
    stamps, values, bad = [], [], 0
    for raw in raws:
        try:
            stamp, row = cdr._decode_one(msgtype, raw)
        except Exception:  # noqa: BLE001  (whatever rosbags raises)
            bad += 1
            continue
        stamps.append(stamp)
        values.append(row)
    return stamps, np.array(values, float).reshape(len(values), len(COLUMNS[msgtype])), bad


@pytest.mark.parametrize('msgtype', list(MESSAGES))
def test_bulk_equals_one_by_one(msgtype):
    @settings(max_examples=60, deadline=None, derandomize=True)
    @given(serialised(msgtype))
    def check(raws):
        got = cdr.decode(msgtype, raws)
        stamps, values, bad = one_by_one(msgtype, raws)
        assert got.stamps.tolist() == stamps
        assert got.spoiled == bad
        np.testing.assert_array_equal(got.values.view(np.uint64), values.view(np.uint64))

    check()
