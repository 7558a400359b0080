"""Damaged bags: nothing wrong comes back, only what was damaged is lost, and what is said holds.

Kills and cuts: test_log_kills.py.
"""

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


@pytest.mark.parametrize('closed', [True, False])
@pytest.mark.parametrize('bit', [3, 11, 12, 13, 14, 15, 16, 20, 40])
def test_a_chunks_damaged_length_costs_nothing(tmp_path, sound, bit, closed):
    data, ledger = sound['none', closed]
    data = bytearray(data)
    place, _ = positions(data, CHUNK)[2]
    length = int.from_bytes(data[place + 1 : place + 9], 'little') ^ 1 << bit
    data[place + 1 : place + 9] = length.to_bytes(8, 'little')
    damaged, got = read(tmp_path, data)
    assert got == ledger
    assert (damaged.lost, damaged.unread, damaged.mended) == (0, 0, 1)


@pytest.mark.parametrize('opcode', [0x02, 0x04, 0x05, 0x07, 0x0E, 0x0F, 0x16, 0x86])
def test_a_chunks_damaged_opcode_costs_nothing(tmp_path, sound, opcode):
    data, ledger = sound['zstd', False]
    data = bytearray(data)
    data[positions(data, CHUNK)[3][0]] = opcode
    damaged, got = read(tmp_path, data)
    assert got == ledger
    assert damaged.lost == 0


@pytest.mark.parametrize('closed', [True, False])
def test_a_damaged_chunk_is_counted_in_messages_and_never_complete(tmp_path, sound, closed):
    data, ledger = sound['lz4', closed]
    bag = tmp_path / 'bag.mcap'
    begin, end = positions(data, CHUNK)[4]
    bag.write_bytes(data[: begin + 60] + bytes(200) + data[begin + 260 :])
    result = recover(bag)
    said = '\n'.join(result.lines())
    assert result.lost == EVERY
    assert result.unread_bytes == end - begin
    assert f'at least {EVERY} messages are missing' in said
    assert 'complete' not in said
    assert ('its statistics count 400 messages' in said) is closed
    assert plain(DamagedMcap(result.path / 'bag_recovered_0.mcap').messages()) == (
        ledger[: 4 * EVERY] + ledger[5 * EVERY :]
    )


def test_a_damaged_chunk_does_not_hide_the_next_one(tmp_path, sound):
    data, ledger = sound['none', False]
    begin, _ = positions(data, CHUNK)[4]
    # bytes are missing from a chunk: by its lengths it ends within the next one
    _, got = read(tmp_path, data[: begin + 500] + data[begin + 1100 :])
    assert got == ledger[: 4 * EVERY] + ledger[5 * EVERY :]
    # and from the index behind it
    place, end = positions(data, MESSAGE_INDEX)[9]
    damaged, got = read(tmp_path, data[: end - 20] + data[end:])
    assert place < end - 20
    assert got == ledger
    assert damaged.lost == 0


def test_an_index_that_is_damaged_claims_no_loss(tmp_path, sound):
    data, ledger = sound['none', False]
    for place, end in positions(data, MESSAGE_INDEX)[::3]:
        for where in (0, 3, 9, 20, end - place - 3):
            noisy = bytearray(data)
            noisy[place + where] ^= 0x21
            damaged, got = read(tmp_path, noisy)
            assert got == ledger
            assert damaged.lost == 0


def test_an_end_within_the_data_is_none(tmp_path, sound):
    data, ledger = sound['none', True]
    (place, end), (_, second), *_ = (*positions(data, DATA_END), *positions(data, CHUNK))
    cut = positions(data, CHUNK)[5][0]
    damaged, got = read(tmp_path, data[:cut] + data[place:end] + data[cut:])
    assert second < cut
    assert got == ledger
    assert damaged.ended


def test_names_are_found_behind_a_damaged_first_chunk(tmp_path, sound):
    for key in (('zstd', True), ('zstd', False), ('none', False)):
        data, ledger = sound[key]
        begin, end = positions(data, CHUNK)[0]
        damaged, got = read(tmp_path, data[: begin + 9] + bytes(end - begin - 9) + data[end:])
        assert got == ledger[EVERY:]
        assert damaged.unnamed == 0
        assert not damaged.doubtful_names


def test_statistics_of_a_damaged_summary_do_not_count(tmp_path, sound):
    data, ledger = sound['none', True]
    assert summary_of(data).messages == len(ledger)
    place, _ = positions(data, STATISTICS)[0]
    noisy = bytearray(data)
    noisy[place + RECORD.size + 1] ^= 0x40
    assert summary_of(bytes(noisy)) is None
    damaged, got = read(tmp_path, noisy)
    assert got == ledger
    assert (damaged.lost, damaged.ended, damaged.complete) == (0, True, False)
    assert 'its summary is damaged' in '\n'.join(recover(tmp_path / 'damaged.mcap').notes)


def harmed(data, rng):
    """The file with some damage, and where."""
    kind = rng.choice(['flip', 'cut', 'zero', 'page', 'tail', 'swap', 'remove', 'insert'])
    data, size, place = bytearray(data), len(data), rng.randrange(8, len(data))
    if kind == 'flip':
        places = [rng.randrange(8, size) for _ in range(rng.choice([1, 1, 2, 5, 20]))]
        for at in places:
            data[at] ^= 1 << rng.randrange(8)
        return data, [(at, at + 1) for at in places]
    if kind in {'cut', 'tail'}:
        return data[:place] + bytes(size - place if kind == 'tail' else 0), [(place, size)]
    if kind == 'swap':
        one, other = (4096 * k for k in rng.sample(range(1, size // 4096), 2))
        block = data[one : one + 4096]
        data[one : one + 4096] = data[other : other + 4096]
        data[other : other + 4096] = block
        return data, [(one, one + 4096), (other, other + 4096)]
    if kind == 'page':
        place = rng.randrange(1, size // 4096) * 4096
    length = min(4096 if kind == 'page' else rng.choice([1, 16, 300, 5000]), size - place)
    if kind == 'remove':
        return data[:place] + data[place + length :], [(place, place + length)]
    if kind == 'insert':
        return data[:place] + rng.randbytes(length) + data[place:], [(place - 1, place + 1)]
    data[place : place + length] = bytes(length)
    return data, [(place, place + length)]


@pytest.mark.parametrize('compression', ['none', 'zstd', 'lz4'])
@pytest.mark.parametrize('closed', [True, False])
def test_of_any_damage_only_the_damaged_chunks_are_lost(tmp_path, sound, compression, closed):
    data, ledger = sound[compression, closed]
    chunks = positions(data, CHUNK)
    rng = random.Random(f'{compression} {closed}')
    for _ in range(100):
        noisy, places = harmed(data, rng)
        damaged, got = read(tmp_path, noisy)
        missing = Counter(ledger) - Counter(got)
        touched = [
            k for k, (begin, end) in enumerate(chunks)
            if any(a < end and b > begin for a, b in places)
        ]  # fmt: skip
        may_go = {m for k in touched for m in ledger[k * EVERY : (k + 1) * EVERY]}
        if not damaged.unchecked:  # a chunk that is cut off besides has no checksum
            assert set(got) <= set(ledger)
        assert set(missing) <= may_go
        assert damaged.lost <= missing.total()
        assert not (missing and damaged.complete)
        if damaged.stated is not None:
            assert damaged.lost == missing.total()


# ---- sqlite3 ----------------------------------------------------------------------------------


def pages_of(tmp_path, compression='none', *, closed=True):
    ledger = made(tmp_path / 'bag', 'sqlite3', compression, closed=closed)
    return tmp_path / 'bag' / 'bag_0.db3', ledger


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


@pytest.mark.parametrize('place', [0, 16, 20, 28, 105, 300, 2100])
def test_a_damaged_header_or_schema_costs_no_message(tmp_path, place):
    file, ledger = pages_of(tmp_path)
    data = bytearray(file.read_bytes())
    data[place] ^= 0x81
    file.write_bytes(bytes(data))
    assert plain(DamagedSqlite(file).messages()) == ledger
    file.write_bytes(bytes(4096) + bytes(data[4096:]))
    damaged = DamagedSqlite(file)
    assert plain(damaged.messages()) == ledger
    assert (damaged.complete, damaged.unread) == (False, 4096)


def test_rows_that_are_no_messages_are_left_out_and_counted(tmp_path):
    file, ledger = pages_of(tmp_path)
    base = sqlite3.connect(file)
    base.execute('PRAGMA writable_schema=1')
    base.execute("UPDATE sqlite_master SET sql=replace(sql, 'NOT NULL', '')")
    base.commit()
    base.close()
    base = sqlite3.connect(file)
    for number, column, value in (
        (100, 'data', None), (101, 'timestamp', 'abc'), (102, 'data', 'text'), (103, 'data', 5),
        (104, 'topic_id', 77), (105, 'timestamp', -1),
    ):  # fmt: skip
        base.execute(f'UPDATE messages SET {column}=? WHERE id=?', (value, number))  # noqa: S608
    base.commit()
    base.close()
    result = recover(tmp_path / 'bag')
    assert result.messages == len(ledger) - 6
    assert result.lost == 6
    assert 'all its rows are there' not in '\n'.join(result.lines())


@pytest.mark.parametrize('compression', ['none', 'zstd'])
def test_noise_in_a_database_ends_in_messages_or_one_line(tmp_path, compression):
    file, ledger = pages_of(tmp_path, compression)
    data = file.read_bytes()
    rng = random.Random(compression)
    most, lines = 0, []
    for k in range(25):
        noisy, _ = harmed(data, rng)
        bag = tmp_path / f'x{k}.db3'
        bag.write_bytes(bytes(noisy))
        try:
            result = recover(bag)
        except QuadBridgeError as error:
            lines.append(str(error))
            continue
        assert result.messages + result.lost + result.undecodable <= len(ledger)
        most = max(most, result.messages)
    assert not any('\n' in line for line in lines)
    assert most == len(ledger)


# ---- the bag as a whole -----------------------------------------------------------------------


def test_what_the_files_cannot_tell_metadata_does(tmp_path):
    ledger = made(tmp_path / 'bag', closed=True, split_s=0.4)
    (tmp_path / 'bag' / 'bag_3.mcap').unlink()
    result = recover(tmp_path / 'bag')
    assert result.lost == len(ledger) - result.messages == 100
    assert 'metadata.yaml counts 400 messages' in '\n'.join(result.notes)


@pytest.mark.parametrize('storage', ['MCAP', 'SQLITE3'])
@pytest.mark.parametrize('first', [0, 1])
def test_both_types_of_a_topic_are_recovered(tmp_path, storage, first):
    store = get_typestore(Stores.ROS2_JAZZY)
    kinds = (VECTOR, 'std_msgs/msg/String')
    with Writer(tmp_path / 'bag', version=9, storage_plugin=StoragePlugin[storage]) as writer:
        connections = {}
        for kind in kinds[::-1] if first else kinds:
            connections[kind] = writer.add_connection('/a', kind, typestore=store)
        for k in range(30):
            kind = kinds[k % 3 == 0]
            writer.write(connections[kind], 1000 + k, b'\0\1\0\0' + bytes([k]))
    result = recover(tmp_path / 'bag')
    with AnyReader([result.path]) as reader:
        got = [(c.topic, c.msgtype, t) for c, t, _ in reader.messages()]
    assert got == [('/a', kinds[k % 3 == 0], 1000 + k) for k in range(30)]


def test_a_topic_whose_type_is_damaged_does_not_cost_the_others(tmp_path):
    file, ledger = pages_of(tmp_path)
    base = sqlite3.connect(file)
    base.execute("UPDATE topics SET type='geometry_msgs/msg/Vec' WHERE id=1")
    base.commit()
    base.close()
    result = recover(tmp_path / 'bag')
    assert result.counts == {TOPICS[1]: sum(topic == TOPICS[1] for topic, _, _ in ledger)}
    assert result.undecodable == len(ledger) - result.messages
    assert f'{TOPICS[0]}: left out' in '\n'.join(result.notes)


@pytest.mark.parametrize('storage', ['MCAP', 'SQLITE3'])
def test_a_type_of_ones_own_comes_back_with_its_hash(tmp_path, storage):
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg('float64 a\nstring b\n', 'mine/msg/Foo'))
    with Writer(tmp_path / 'bag', version=9, storage_plugin=StoragePlugin[storage]) as writer:
        own = writer.add_connection('/own', 'mine/msg/Foo', typestore=store)
        message = store.types['mine/msg/Foo'](a=1.5, b='x')
        writer.write(own, 1000, store.serialize_cdr(message, 'mine/msg/Foo'))
    with AnyReader([recover(tmp_path / 'bag').path]) as reader:
        ((connection, _, raw),) = reader.messages()
        assert reader.deserialize(raw, connection.msgtype).a == 1.5


@pytest.mark.parametrize('cut', [0, 3000])
@pytest.mark.parametrize('storage', ['MCAP', 'SQLITE3'])
def test_files_compressed_as_a_whole_are_unpacked(tmp_path, storage, cut):
    store = get_typestore(Stores.ROS2_JAZZY)
    writer = Writer(tmp_path / 'bag', version=9, storage_plugin=StoragePlugin[storage])
    writer.set_compression(CompressionMode.FILE, CompressionFormat.ZSTD)
    rng = random.Random(5)
    ledger = [('/a', 1000 + k, b'\0\1\0\0' + rng.randbytes(100)) for k in range(300)]
    with writer:
        topic = writer.add_connection('/a', VECTOR, typestore=store)
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


@pytest.mark.parametrize('compression', ['none', 'zstd', 'lz4'])
def test_of_a_chunk_that_is_cut_off_and_damaged_nothing_is_taken(tmp_path, sound, compression):
    data, ledger = sound[compression, False]
    begin, end = positions(data, CHUNK)[4]
    cut = begin + (end - begin) * 3 // 4
    whole, got = read(tmp_path, data[:cut])
    assert got[: 4 * EVERY] == ledger[: 4 * EVERY]
    assert set(got) <= set(ledger)
    if compression == 'none':
        assert len(got) > 4.5 * EVERY
        assert whole.unchecked == len(got) - 4 * EVERY
    # a block of something else before the cut
    block = random.Random(3).randbytes(1000)
    damaged, got = read(tmp_path, data[: cut - 1000] + block)
    assert got == ledger[: 4 * EVERY]
    assert damaged.bad_chunks == 1
