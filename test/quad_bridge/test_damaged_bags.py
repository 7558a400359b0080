"""Damaged bags: nothing wrong comes back, only what was damaged is lost, and what is said holds.

Kills and cuts: test_log_kills.py.
"""

import contextlib
import random
import sqlite3
import struct
from collections import Counter

import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from quad_bridge.bag_writer import BagWriter, Limits
from quad_bridge.damaged_mcap import DamagedMcap
from quad_bridge.damaged_sqlite import DamagedSqlite
from quad_bridge.errors import QuadBridgeError
from quad_bridge.mcap_records import (
    CHUNK,
    DATA_END,
    MESSAGE_INDEX,
    RECORD,
    STATISTICS,
    end_of,
    summary_of,
)
from quad_bridge.recover import recover

VECTOR = 'geometry_msgs/msg/Vector3Stamped'
TOPICS = ('/setpoint/rates', '/setpoint/attitude')
EVERY = 40
"""Messages of a chunk."""
STEP_NS = 4_000_000


def made(path, storage='mcap', compression='none', n=400, *, closed=True, split_s=0.0):
    """Write a bag; what is in it."""
    rng = random.Random(7)
    writer = BagWriter(path, storage, compression, Limits(split_s=split_s))
    for topic in TOPICS:
        writer.add_topic(topic, VECTOR)
    ledger = []
    for k in range(n):
        data = b'\0\1\0\0' + struct.pack('<I', k) + rng.randbytes(rng.randrange(40, 160))
        ledger.append((TOPICS[k % 3 == 0], 10**18 + k * STEP_NS, data))
        writer.write(*ledger[-1])
        if k % EVERY == EVERY - 1:
            writer.flush()
    (writer.close if closed else writer.abort)()
    return ledger


def plain(messages):
    return [(m.topic.name, m.time_ns, m.data) for m in messages]


def positions(data, opcode):
    """(begin, end) of all top-level records of one kind."""
    found, place = [], 8
    while (end := end_of(data, place, len(data))) is not None:
        if data[place] == opcode:
            found.append((place, end))
        place = end
    return found


@pytest.fixture(scope='module')
def sound(tmp_path_factory):
    """A bag's file and ledger by (compression, closed)."""
    folder = tmp_path_factory.mktemp('sound')
    bags = {}
    for compression in ('none', 'zstd', 'lz4'):
        for closed in (True, False):
            path = folder / f'{compression}_{closed}'
            ledger = made(path, 'mcap', compression, closed=closed)
            bags[compression, closed] = (path / f'{path.name}_0.mcap').read_bytes(), ledger
    return bags


def read(tmp_path, data):
    file = tmp_path / 'damaged.mcap'
    file.write_bytes(bytes(data))
    damaged = DamagedMcap(file)
    return damaged, plain(damaged.messages())


def flipped(data, place, mask):
    data = bytearray(data)
    data[place] ^= mask
    return data


def chunk(data, k):
    return positions(data, CHUNK)[k]


def end_within(data):
    ((begin, end),) = positions(data, DATA_END)
    cut, _ = chunk(data, 5)
    return data[:cut] + data[begin:end] + data[cut:]


def short_index(data):
    _, end = positions(data, MESSAGE_INDEX)[9]
    return data[: end - 20] + data[end:]


HARMLESS = {
    **{f'length, bit {bit}': (('none', True, False),
       lambda d, bit=bit: flipped(d, chunk(d, 2)[0] + 1 + bit // 8, 1 << bit % 8))
       for bit in (3, 11, 12, 13, 14, 15, 16, 20, 40)},
    **{f'opcode {code:#x}': (('zstd', False),
       lambda d, code=code: flipped(d, chunk(d, 3)[0], CHUNK ^ code))
       for code in (0x02, 0x04, 0x05, 0x07, 0x0E, 0x0F, 0x16, 0x86)},
    **{f'index {k}, byte {at}': (('none', False),
       lambda d, k=k, at=at: flipped(d, positions(d, MESSAGE_INDEX)[k][0] + at, 0x21))
       for k in (0, 9) for at in (0, 3, 9, 20)},
    'an index with bytes missing': (('none', False), short_index),
    # the length of that chunk, read a byte too late, looks like a footer
    'an index with a byte missing before chunk 6': (('lz4', True, False),
       lambda d: d[: chunk(d, 6)[0] - 100] + d[chunk(d, 6)[0] - 99 :]),
    'an end within the data': (('none', True), end_within),
    'statistics': (('none', True),
       lambda d: flipped(d, positions(d, STATISTICS)[0][0] + RECORD.size + 1, 0x40)),
}  # fmt: skip
"""Damage that costs no message: which files, and how it is made."""


@pytest.mark.parametrize('name', HARMLESS)
def test_what_can_be_read_around_costs_no_message(tmp_path, sound, name):
    (compression, *kinds), damage = HARMLESS[name]
    for closed in kinds:
        data, ledger = sound[compression, closed]
        damaged, got = read(tmp_path, damage(data))
        assert got == ledger
        assert (damaged.lost, damaged.unread if 'length' in name else 0) == (0, 0)
        assert damaged.mended == 1 or 'length' not in name
        assert damaged.ended or 'end' not in name


def test_statistics_of_a_damaged_summary_do_not_count(tmp_path, sound):
    data, ledger = sound['none', True]
    assert summary_of(data).messages == len(ledger)
    noisy = bytes(HARMLESS['statistics'][1](data))
    assert summary_of(noisy) is None
    damaged, _ = read(tmp_path, noisy)
    assert (damaged.ended, damaged.complete) == (True, False)
    assert 'its summary is damaged' in '\n'.join(recover(tmp_path / 'damaged.mcap').notes)


@pytest.mark.parametrize('closed', [True, False])
def test_a_damaged_chunk_is_counted_in_messages_and_never_complete(tmp_path, sound, closed):
    data, ledger = sound['lz4', closed]
    bag = tmp_path / 'bag.mcap'
    begin, end = chunk(data, 4)
    bag.write_bytes(data[: begin + 60] + bytes(200) + data[begin + 260 :])
    result = recover(bag)
    said = '\n'.join(result.lines())
    assert (result.lost, result.unread_bytes) == (EVERY, end - begin)
    assert f'at least {EVERY} messages are missing' in said
    assert 'complete' not in said
    assert ('its statistics count 400 messages' in said) is closed
    assert plain(DamagedMcap(result.path / 'bag_recovered_0.mcap').messages()) == (
        ledger[: 4 * EVERY] + ledger[5 * EVERY :]
    )


def test_a_damaged_chunk_does_not_hide_the_next_one_nor_the_names(tmp_path, sound):
    data, ledger = sound['none', False]
    begin, _ = chunk(data, 4)
    # bytes are missing from a chunk: by its lengths it ends within the next one
    _, got = read(tmp_path, data[: begin + 500] + data[begin + 1100 :])
    assert got == ledger[: 4 * EVERY] + ledger[5 * EVERY :]
    for key in (('zstd', True), ('zstd', False), ('none', False)):
        data, ledger = sound[key]
        begin, end = chunk(data, 0)
        damaged, got = read(tmp_path, data[: begin + 9] + bytes(end - begin - 9) + data[end:])
        assert got == ledger[EVERY:]
        assert (damaged.unnamed, bool(damaged.doubtful_names)) == (0, False)


HARMS = ('flip', 'cut', 'tail', 'zero', 'page', 'swap', 'remove', 'insert')


def harmed(data, rng):
    """The file with some damage, and where."""
    kind, data, size = rng.choice(HARMS), bytearray(data), len(data)
    if kind == 'flip':
        places = [rng.randrange(8, size) for _ in range(rng.choice([1, 1, 2, 5, 20]))]
        for at in places:
            data[at] ^= 1 << rng.randrange(8)
        return data, [(at, at + 1) for at in places]
    if kind == 'swap':
        one, other = (4096 * k for k in rng.sample(range(1, size // 4096), 2))
        first, second = data[one : one + 4096], data[other : other + 4096]
        data[one : one + 4096], data[other : other + 4096] = second, first
        return data, [(one, one + 4096), (other, other + 4096)]
    begin = rng.randrange(1, size // 4096) * 4096 if kind == 'page' else rng.randrange(8, size)
    wide = {'page': 4096, 'cut': size, 'tail': size}.get(kind) or rng.choice([1, 16, 300, 5000])
    end = min(begin + wide, size)
    if kind == 'insert':
        return data[:begin] + rng.randbytes(wide) + data[begin:], [(begin - 1, begin + 1)]
    zeros = b'' if kind in {'cut', 'remove'} else bytes(end - begin)
    return data[:begin] + zeros + data[end:], [(begin, end)]


def only_damaged_chunks_are_lost(tmp_path, bag, rng):
    data, ledger = bag
    noisy, places = harmed(data, rng)
    damaged, got = read(tmp_path, noisy)
    if damaged.doubtful_names:  # they stand in a damaged chunk alone, and recover says so
        ledger, got = ([('', *m[1:]) for m in messages] for messages in (ledger, got))
    missing = Counter(ledger) - Counter(got)
    may_go = {
        m for k, (begin, end) in enumerate(positions(data, CHUNK))
        if any(a < end and b > begin for a, b in places)
        for m in ledger[k * EVERY : (k + 1) * EVERY]
    }  # fmt: skip
    if not damaged.unchecked:  # a chunk that is cut off besides has no checksum
        assert set(got) <= set(ledger)
    assert set(missing) <= may_go
    assert damaged.lost <= missing.total()
    assert not (missing and damaged.complete)
    if damaged.stated is not None:
        assert damaged.lost == missing.total()


COUNTS = [12, pytest.param(2300, marks=pytest.mark.long)]
"""Damaged bags of each kind: a sample, and some 13,800 in all."""


@pytest.mark.parametrize('count', COUNTS)
@pytest.mark.parametrize('compression', ['none', 'zstd', 'lz4'])
@pytest.mark.parametrize('closed', [True, False])
def test_of_any_damage_only_the_damaged_chunks_are_lost(
    tmp_path, sound, compression, closed, count
):
    rng = random.Random(f'{compression} {closed}')
    for _ in range(count):
        only_damaged_chunks_are_lost(tmp_path, sound[compression, closed], rng)


@pytest.mark.parametrize('compression', ['none', 'zstd', 'lz4'])
def test_of_a_chunk_that_is_cut_off_and_damaged_nothing_is_taken(tmp_path, sound, compression):
    data, ledger = sound[compression, False]
    begin, end = chunk(data, 4)
    cut = begin + (end - begin) * 3 // 4
    whole, got = read(tmp_path, data[:cut])
    assert got[: 4 * EVERY] == ledger[: 4 * EVERY]
    assert set(got) <= set(ledger)
    if compression == 'none':
        assert len(got) > 4.5 * EVERY
        assert whole.unchecked == len(got) - 4 * EVERY
    # a block of something else before the cut
    damaged, got = read(tmp_path, data[: cut - 1000] + random.Random(3).randbytes(1000))
    assert got == ledger[: 4 * EVERY]
    assert damaged.bad_chunks == 1


# ---- sqlite3 ----------------------------------------------------------------------------------


def pages_of(tmp_path, compression='none', *, closed=True):
    ledger = made(tmp_path / 'bag', 'sqlite3', compression, closed=closed)
    return tmp_path / 'bag' / 'bag_0.db3', ledger


def edit(file, *statements):
    with contextlib.closing(sqlite3.connect(file)) as base, base:
        for statement in statements:
            base.execute(statement)


@pytest.mark.parametrize('closed', [True, False])
def test_zeroed_pages_are_counted_in_rows_and_pages(tmp_path, closed):
    file, ledger = pages_of(tmp_path, closed=closed)
    data = file.read_bytes()
    leaves = [p for p in range(4096, len(data), 4096) if data[p] == 0x0D and data[p + 4] > 10]
    place = leaves[len(leaves) // 2]
    file.write_bytes(data[:place] + bytes(4096) + data[place + 4096 :])
    result = recover(tmp_path / 'bag')
    got = plain(DamagedSqlite(result.path / 'bag_recovered_0.db3').messages())
    assert set(got) < set(ledger)
    assert result.lost == len(ledger) - len(got) == data[place + 4]
    assert result.unread_bytes == 4096
    assert f'1 of {len(data) // 4096} pages are not whole' in '\n'.join(result.notes)


def test_rows_lost_at_the_end_are_known_by_the_index(tmp_path):
    file, ledger = pages_of(tmp_path, closed=False)
    data = bytearray(file.read_bytes())
    last = data.rfind(ledger[-1][2]) // 4096 * 4096
    data[last : last + 200] = bytes(200)
    file.write_bytes(bytes(data))
    damaged = DamagedSqlite(file)
    got = plain(damaged.messages())
    assert 0 < len(got) < len(ledger)
    assert damaged.lost == len(ledger) - len(got)


def test_a_damaged_header_or_schema_costs_no_message(tmp_path):
    file, ledger = pages_of(tmp_path)
    data = file.read_bytes()
    for place in (0, 16, 20, 28, 105, 300, 2100):
        file.write_bytes(flipped(data, place, 0x81))
        assert plain(DamagedSqlite(file).messages()) == ledger, place
    file.write_bytes(bytes(4096) + data[4096:])
    damaged = DamagedSqlite(file)
    assert plain(damaged.messages()) == ledger
    assert (damaged.complete, damaged.unread) == (False, 4096)


def test_rows_that_are_no_messages_are_left_out_and_counted(tmp_path):
    file, ledger = pages_of(tmp_path)
    edit(file, 'PRAGMA writable_schema=1',
         "UPDATE sqlite_master SET sql=replace(sql, 'NOT NULL', '')")  # fmt: skip
    values = ('data=NULL', "timestamp='a'", "data='text'", 'data=5', 'topic_id=77', 'timestamp=-1')
    edit(file, *(f'UPDATE messages SET {v} WHERE id={k}' for k, v in enumerate(values, 100)))  # noqa: S608
    result = recover(tmp_path / 'bag')
    assert result.messages == len(ledger) - 6
    assert result.lost == 6
    assert 'all its rows are there' not in '\n'.join(result.lines())


@pytest.mark.parametrize('count', [8, pytest.param(300, marks=pytest.mark.long)])
@pytest.mark.parametrize('compression', ['none', 'zstd'])
def test_noise_in_a_database_ends_in_messages_or_one_line(tmp_path, compression, count):
    file, ledger = pages_of(tmp_path, compression)
    data, rng, most = file.read_bytes(), random.Random(f'{compression} 2'), 0
    for k in range(count):
        bag = tmp_path / f'x{k}.db3'
        bag.write_bytes(harmed(data, rng)[0])
        try:
            result = recover(bag)
        except QuadBridgeError as error:
            assert '\n' not in str(error)  # noqa: PT017
            continue
        assert result.messages + result.lost + result.undecodable <= len(ledger)
        most = max(most, result.messages)
    assert most == len(ledger)


# ---- the bag as a whole -----------------------------------------------------------------------


def test_what_the_files_cannot_tell_metadata_does(tmp_path):
    ledger = made(tmp_path / 'bag', closed=True, split_s=0.4)
    (tmp_path / 'bag' / 'bag_3.mcap').unlink()
    result = recover(tmp_path / 'bag')
    assert result.lost == len(ledger) - result.messages == 100
    assert 'metadata.yaml counts 400 messages' in '\n'.join(result.notes)


def theirs(path, storage):
    """A writer of rosbags."""
    return Writer(path, version=9, storage_plugin=StoragePlugin[storage])


each_storage = pytest.mark.parametrize('storage', ['MCAP', 'SQLITE3'])
STORE = get_typestore(Stores.ROS2_JAZZY)


@each_storage
@pytest.mark.parametrize('first', [0, 1])
def test_both_types_of_a_topic_are_recovered(tmp_path, storage, first):
    kinds = (VECTOR, 'std_msgs/msg/String')
    with theirs(tmp_path / 'bag', storage) as writer:
        order = kinds[::-1] if first else kinds
        made = {kind: writer.add_connection('/a', kind, typestore=STORE) for kind in order}
        for k in range(30):
            writer.write(made[kinds[k % 3 == 0]], 1000 + k, b'\0\1\0\0' + bytes([k]))
    result = recover(tmp_path / 'bag')
    with AnyReader([result.path]) as reader:
        got = [(c.topic, c.msgtype, t) for c, t, _ in reader.messages()]
    assert got == [('/a', kinds[k % 3 == 0], 1000 + k) for k in range(30)]


def test_a_topic_whose_type_is_damaged_does_not_cost_the_others(tmp_path):
    file, ledger = pages_of(tmp_path)
    edit(file, "UPDATE topics SET type='geometry_msgs/msg/Vec' WHERE id=1")
    result = recover(tmp_path / 'bag')
    assert result.counts == {TOPICS[1]: sum(topic == TOPICS[1] for topic, _, _ in ledger)}
    assert result.undecodable == len(ledger) - result.messages
    assert f'{TOPICS[0]}: left out' in '\n'.join(result.notes)


@each_storage
def test_a_type_of_ones_own_comes_back_with_its_hash(tmp_path, storage):
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg('float64 a\nstring b\n', 'mine/msg/Foo'))
    with theirs(tmp_path / 'bag', storage) as writer:
        own = writer.add_connection('/own', 'mine/msg/Foo', typestore=store)
        message = store.types['mine/msg/Foo'](a=1.5, b='x')
        writer.write(own, 1000, store.serialize_cdr(message, 'mine/msg/Foo'))
    with AnyReader([recover(tmp_path / 'bag').path]) as reader:
        ((connection, _, raw),) = reader.messages()
        assert reader.deserialize(raw, connection.msgtype).a == 1.5


@each_storage
@pytest.mark.parametrize('cut', [0, 3000])
def test_files_compressed_as_a_whole_are_unpacked(tmp_path, storage, cut):
    writer = theirs(tmp_path / 'bag', storage)
    writer.set_compression(CompressionMode.FILE, CompressionFormat.ZSTD)
    rng = random.Random(5)
    ledger = [('/a', 1000 + k, b'\0\1\0\0' + rng.randbytes(100)) for k in range(300)]
    with writer:
        topic = writer.add_connection('/a', VECTOR, typestore=STORE)
        for _, time_ns, data in ledger:
            writer.write(topic, time_ns, data)
    (file,) = (tmp_path / 'bag').glob('*.zstd')
    file.write_bytes(file.read_bytes()[: file.stat().st_size - cut])
    if cut and storage == 'MCAP':
        file.write_bytes(file.read_bytes()[:20_000])
    try:
        result = recover(tmp_path / 'bag')
    except QuadBridgeError as error:
        assert cut  # of one frame that is cut off there may be nothing
        assert '\n' not in str(error)  # noqa: PT017
        return
    with AnyReader([result.path]) as reader:
        got = [(c.topic, t, bytes(raw)) for c, t, raw in reader.messages()]
    assert set(got) <= set(ledger)
    assert len(got) + result.lost == len(ledger)


def test_a_clock_that_was_set_back_is_no_time_without_messages(tmp_path):
    writer = BagWriter(tmp_path / 'bag')
    writer.add_topic(TOPICS[0], VECTOR)
    for k in range(100):
        back_ns = 3600 * 10**9 if k >= 50 else 0
        writer.write(TOPICS[0], 10**18 + k * 10**8 - back_ns, bytes(40))
    writer.close()
    said = recover(tmp_path / 'bag').lines()
    assert '100 messages over 9.80 s' in said[0]
    assert not any('nothing for' in line for line in said)
