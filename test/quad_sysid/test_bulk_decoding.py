"""Reading in bulk equals rosbags' deserialiser bit for bit, whatever the messages look like."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from quad_sysid.bags import cdr
from quad_sysid.bags.cdr import BATTERY, COLUMNS, IMU, JOINTS, MOTOR_NAMES, VECTOR, WRENCH
from quad_sysid.bags.layout import typestore

TYPES = typestore().types
TEXTS = st.sampled_from(['base_link', '', 'a', 'imu', 'böse', 'base_linkbase_link'])
NUMBERS = st.floats(width=64)
SMALL = st.floats(width=32)


def vector():
    return st.builds(TYPES['geometry_msgs/msg/Vector3'], x=NUMBERS, y=NUMBERS, z=NUMBERS)


def header():
    stamp = st.builds(
        TYPES['builtin_interfaces/msg/Time'],
        sec=st.integers(-(2**31), 2**31 - 1), nanosec=st.integers(0, 2**32 - 1),
    )
    return st.builds(TYPES['std_msgs/msg/Header'], stamp=stamp, frame_id=TEXTS)


def array(numbers, dtype, low, high):
    return st.lists(numbers, min_size=low, max_size=high).map(lambda v: np.array(v, dtype))


def imu():
    quaternion = st.builds(
        TYPES['geometry_msgs/msg/Quaternion'], x=NUMBERS, y=NUMBERS, z=NUMBERS, w=NUMBERS
    )
    nine = array(NUMBERS, np.float64, 9, 9)
    return st.builds(
        TYPES[IMU], header=header(), orientation=quaternion, orientation_covariance=nine,
        angular_velocity=vector(), angular_velocity_covariance=nine,
        linear_acceleration=vector(), linear_acceleration_covariance=nine,
    )


def joints():
    names = st.one_of(
        st.permutations(MOTOR_NAMES), st.just([]), st.lists(TEXTS, max_size=5),
    ).map(list)
    some = array(NUMBERS, np.float64, 0, 5)
    effort = st.one_of(array(NUMBERS, np.float64, 4, 4), some)
    return st.builds(
        TYPES[JOINTS], header=header(), name=names, position=some, velocity=some, effort=effort
    )


def battery():
    cells = array(SMALL, np.float32, 0, 4)
    plain = dict.fromkeys(
        ('voltage', 'temperature', 'current', 'charge', 'capacity', 'design_capacity',
         'percentage'), SMALL,
    )  # fmt: skip
    states = dict.fromkeys(
        ('power_supply_status', 'power_supply_health', 'power_supply_technology'),
        st.integers(0, 255),
    )
    return st.builds(
        TYPES[BATTERY], header=header(), present=st.booleans(), cell_voltage=cells,
        cell_temperature=cells, location=TEXTS, serial_number=TEXTS, **plain, **states,
    )


def wrench():
    inner = st.builds(TYPES['geometry_msgs/msg/Wrench'], force=vector(), torque=vector())
    return st.builds(TYPES[WRENCH], header=header(), wrench=inner)


MESSAGES = {
    IMU: imu(), JOINTS: joints(), BATTERY: battery(), WRENCH: wrench(),
    VECTOR: st.builds(TYPES[VECTOR], header=header(), vector=vector()),
}  # fmt: skip


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


def test_signalling_not_a_numbers_keep_their_bits():
    raw = bytearray(0)
    stamp = TYPES['builtin_interfaces/msg/Time'](sec=1, nanosec=2)
    head = TYPES['std_msgs/msg/Header'](stamp=stamp, frame_id='base_link')
    vector3 = TYPES['geometry_msgs/msg/Vector3'](x=0.0, y=1.0, z=2.0)
    raw += typestore().serialize_cdr(TYPES[VECTOR](header=head, vector=vector3), VECTOR)
    raw[-24:-16] = struct.pack('<Q', 0x7FF0_0000_DEAD_BEEF)
    got = cdr.decode(VECTOR, [bytes(raw)])
    assert got.values.view(np.uint64)[0, 0] == 0x7FF0_0000_DEAD_BEEF
