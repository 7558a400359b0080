"""Reading in bulk equals rosbags' deserialiser bit for bit, whatever the messages look like."""

import numpy as np
import pytest
from rosbags.interfaces import Nodetype

from quad_sysid.bags import cdr
from quad_sysid.bags.cdr import BATTERY, FOUR, IMU, JOINTS, VECTOR, WRENCH

STORE = cdr.typestore()
TEXTS = ['base_link', '', 'a', 'imu', 'böse', 'base_linkbase_link']


def scalars(rng, kind, count=None):
    """Values of a basic type: any bits, so NaN, infinity and the like too."""
    if kind == 'string':
        return str(rng.choice(TEXTS))
    if kind == 'bool':
        return bool(rng.integers(2))
    found = np.frombuffer(rng.bytes(np.dtype(kind).itemsize * (count or 1)), kind)
    return found[0].item() if count is None else found.copy()


def content(rng, field):
    """What may stand in a field: (node type, details) as rosbags describes it."""
    kind, about = field
    if kind == Nodetype.BASE:
        return scalars(rng, about[0])
    if kind == Nodetype.NAME:
        return message(rng, about)
    (_, (base, _)), most = about
    if base == 'string':
        names = rng.permutation(FOUR.names) if rng.integers(2) else rng.choice(TEXTS, 5)
        return [str(name) for name in names[: rng.choice([0, 3, 4, 4, 4, 5])]]
    return scalars(rng, base, most if kind == Nodetype.ARRAY else int(rng.integers(6)))


def message(rng, msgtype):
    _, fields = STORE.fielddefs[msgtype]
    return STORE.types[msgtype](**{name: content(rng, field) for name, field in fields})


def serialised(rng, msgtype):
    """A list of messages: some alike, some of another layout, endianness, changed or cut."""
    out = []
    for _ in range(rng.integers(1, 7)):
        little = bool(rng.integers(10))
        raw = bytes(STORE.serialize_cdr(message(rng, msgtype), msgtype, little_endian=little))
        out += [raw] * rng.integers(1, 4)
        spoiled = bytearray(raw)  # in the first bytes, where lengths and texts lie
        spoiled[rng.integers(min(len(raw), 60))] = rng.integers(256)
        harm = (spoiled, raw[: rng.integers(len(raw) + 1)], raw + bytes(rng.integers(1, 10)))
        out += [bytes(harm[rng.integers(3)])] * rng.integers(2)
    return [out[i] for i in rng.permutation(len(out))]


def one_by_one(msgtype, raws):
    stamps, values, bad = [], [], 0
    for raw in raws:
        try:
            stamp, row = cdr._decode_one(msgtype, raw, FOUR)
        except Exception:  # noqa: BLE001  (whatever rosbags raises)
            bad += 1
            continue
        stamps.append(stamp)
        values.append(row)
    width = cdr.WIDTH.get(msgtype, FOUR.count)
    return stamps, np.array(values, float).reshape(len(values), width), bad


@pytest.mark.parametrize('msgtype', [IMU, JOINTS, BATTERY, WRENCH, VECTOR])
def test_bulk_equals_one_by_one(msgtype):
    for seed in range(40):
        raws = serialised(np.random.default_rng(seed), msgtype)
        got = cdr.decode(msgtype, raws)
        stamps, values, bad = one_by_one(msgtype, raws)
        assert (got.stamps.tolist(), got.unreadable) == (stamps, bad), seed
        np.testing.assert_array_equal(got.values.view(np.uint64), values.view(np.uint64))
