"""Bags come back as written; of damaged ones what is sound, and what was lost is told."""

import contextlib
import os
import random
import shutil
import sqlite3
import struct
import subprocess
from collections import Counter
from datetime import datetime, timezone

import lz4.frame
import pytest
from rosbags import interfaces as ros
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from quad_bridge.errors import BadInputError
from quad_bridge.log.recover import main, recover
from quad_bridge.log.stored import scan
from quad_bridge.log.stored.records import CHUNK, MAGIC, RECORD, end_of
from quad_bridge.log.stored.scan import McapScan
from quad_bridge.log.writer import BagWriter, Limits, free_paths, new_bag
from quad_sysid.bags.storage import Storage
from quad_sysid.errors import BadInputError as UnreadableError

VECTOR = 'geometry_msgs/msg/Vector3Stamped'
TOPICS = ('/setpoint/rates', '/setpoint/attitude')
EVERY = 40
"""Messages of a chunk."""
STEP_NS = 4_000_000
LATCHED = ros.Qos(
    ros.QosHistory.KEEP_LAST, 10, ros.QosReliability.RELIABLE, ros.QosDurability.TRANSIENT_LOCAL,
    ros.QosTime(0, 0), ros.QosTime(0, 0), ros.QosLiveliness.AUTOMATIC, ros.QosTime(0, 0), False,
)  # fmt: skip
PACKERS = {'none': None, 'zstd': scan.zstd.compress, 'lz4': lz4.frame.compress}


def made(path, n=400, *, closed=True, split_s=0.0):
    """Write a bag; what is in it."""
    rng = random.Random(7)
    writer = BagWriter(path, Limits(split_s=split_s))
    writer.add_topic(TOPICS[0], VECTOR, (LATCHED,))
    writer.add_topic(TOPICS[1], VECTOR)
    ledger = []
    for k in range(n):
        data = b'\0\1\0\0' + struct.pack('<I', k) + rng.randbytes(rng.randrange(40, 160))
        ledger.append((TOPICS[k % 3 == 0], 10**18 + k * STEP_NS, data))
        writer.write(*ledger[-1])
        if k % EVERY == EVERY - 1:
            writer.flush()
    (writer.close if closed else writer.abort)()
    return ledger


def records(data):
    """(begin, end) of all top-level records."""
    place = len(MAGIC)
    while (end := end_of(data, place, len(data))) is not None:
        yield place, end
        place = end


def positions(data, opcode):
    return [(begin, end) for begin, end in records(data) if data[begin] == opcode]


def packed(data, name):
    """The file of a killed recorder with its chunks compressed, as other recorders write them."""
    out = bytearray(MAGIC)
    for begin, end in records(data):
        record = data[begin:end]
        if record[0] == CHUNK and PACKERS[name]:
            small = PACKERS[name](record[49:])
            body = record[9:37] + struct.pack('<I', len(name)) + name.encode()
            body += struct.pack('<Q', len(small)) + small
            record = RECORD.pack(CHUNK, len(body)) + body
        out += record
    return bytes(out)


@pytest.fixture(scope='module')
def sound(tmp_path_factory):
    """A bag's file and ledger by (compression, closed)."""
    folder, bags = tmp_path_factory.mktemp('sound'), {}
    for closed in (True, False):
        ledger = made(folder / f'{closed}', closed=closed)
        data = (folder / f'{closed}' / f'{closed}_0.mcap').read_bytes()
        for name in ('none',) if closed else PACKERS:
            bags[name, closed] = (data if closed else packed(data, name)), ledger
    return bags


def stands_in(bag):
    """The messages of a bag, by rosbags; the durability that its topics offer is as written."""
    with AnyReader([bag]) as reader:
        offered = {c.topic: [q.durability for q in c.ext.offered_qos_profiles]
                   for c in reader.connections}  # fmt: skip
        assert offered == {TOPICS[0]: [ros.QosDurability.TRANSIENT_LOCAL], TOPICS[1]: []}
        return [(c.topic, time_ns, bytes(raw)) for c, time_ns, raw in reader.messages()]


def test_a_bag_comes_back_as_written_and_is_never_written_over(tmp_path):
    path = tmp_path / 'a' / 'b' / 'bag'  # folders are made
    ledger = made(path)
    assert stands_in(path) == ledger
    with pytest.raises(BadInputError, match='exists already'):
        BagWriter(path)
    with pytest.raises(BadInputError, match='/x: message type is not a standard one'):
        BagWriter(tmp_path / 'b').add_topic('/x', 'foo_msgs/msg/Bar')


def test_a_free_path_is_numbered_where_the_second_is_taken(tmp_path, monkeypatch):
    now = datetime(2024, 5, 6, 7, 8, 9, tzinfo=timezone.utc)
    for name in ('flight_20240506_070809', 'flight_20240506_070809_2'):
        # looked for before the other recorder's bag is there
        writer = new_bag(free_paths(tmp_path, 'flight', now))
        assert writer.path.name == name
        writer.close()
    with pytest.raises(BadInputError, match='exists already'):
        new_bag([tmp_path / name])
    # a folder that appears at the last moment is another recorder's
    (tmp_path / 'a').mkdir()
    monkeypatch.setattr('quad_bridge.log.writer._check_space', lambda *_: None)
    assert new_bag([tmp_path / 'a', tmp_path / 'b']).path == tmp_path / 'b'
    assert list((tmp_path / 'a').iterdir()) == []


def test_what_was_flushed_is_recovered_after_a_kill_and_nothing_is_overwritten(tmp_path, printed):
    killed, n = tmp_path / 'killed', 8 * EVERY
    ledger = made(killed, n + EVERY // 2, closed=False)
    before = {p.name: p.read_bytes() for p in killed.iterdir()}
    said = printed(main, killed)
    assert f'killed_recovered: {n} messages recovered; lost: ' in said
    assert 'ends without its index' in said
    count = sum(topic == TOPICS[0] for topic, *_ in ledger[:n])
    assert f'{count}  {TOPICS[0]}' in said
    assert stands_in(tmp_path / 'killed_recovered') == ledger[:n]
    assert {p.name: p.read_bytes() for p in killed.iterdir()} == before
    for out in (None, tmp_path / 'killed_recovered'):
        with pytest.raises(BadInputError, match='exists already'):
            recover(killed, out)


@pytest.mark.parametrize(
    ('name', 'content', 'text'),
    [
        ('absent', None, 'does not exist'), ('empty.mcap', b'', 'is empty'),
        ('text.mcap', b'time,rate\n', 'is not an mcap file'),
        ('bare.mcap', b'\x89MCAP0\r\n', 'holds no whole message'),
        ('table.csv', b'1,2', 'holds no .mcap or .db3 file'),
        ('junk.db3', b'no database' * 100, 'is a damaged sqlite3 file (file is not a database)')],
)
def test_what_cannot_be_recovered_ends_with_one_line_and_status_two(
    tmp_path, refused, name, content, text
):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    error = refused(main, path)
    assert name in error
    assert text in error
    assert [p.name for p in tmp_path.iterdir()] == ([name] if content is not None else [])


KINDS = [('none', True), ('none', False), ('zstd', False), ('lz4', False)]


def read(data):
    damaged = McapScan(bytes(data))
    return damaged, [(m.topic.name, m.time_ns, m.data) for m in damaged.messages()]


def flipped(data, place, mask):
    data = bytearray(data)
    data[place] ^= mask
    return data


@pytest.mark.parametrize('closed', [True, False])
def test_a_damaged_chunk_is_told_and_never_complete(tmp_path, sound, closed):
    data, ledger = sound['none', closed]
    bag = tmp_path / 'bag.mcap'
    begin, end = positions(data, CHUNK)[4]
    bag.write_bytes(data[: begin + 60] + bytes(200) + data[begin + 260 :])
    result = recover(bag)
    said = '\n'.join(result.lines())
    assert (result.lost, result.unread_bytes) == (EVERY if closed else 0, end - begin)
    assert (f'at least {EVERY} messages are missing' in said) is closed
    assert 'complete' not in said
    assert '1 chunks are not whole' in said
    assert ('its statistics count 400 messages' in said) is closed
    got = read((result.path / 'bag_recovered_0.mcap').read_bytes())[1]
    assert got == ledger[: 4 * EVERY] + ledger[5 * EVERY :]


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


def only_damaged_chunks_are_lost(bag, rng):
    data, ledger = bag
    noisy, places = harmed(data, rng)
    damaged, got = read(noisy)
    scanned, by_topic = McapScan(bytes(noisy)), {}
    for batch in scanned.batches(lambda topic: topic.name == TOPICS[0]):
        by_topic.setdefault(TOPICS[0], []).extend(batch.get(TOPICS[0], []))
    assert by_topic[TOPICS[0]] == [data for topic, _, data in got if topic == TOPICS[0]]
    for figure in ('returned', 'lost', 'unnamed', 'bad_chunks', 'ended'):
        assert getattr(scanned, figure) == getattr(damaged, figure), figure
    missing = Counter(ledger) - Counter(got)
    may_go = {
        m for k, (begin, end) in enumerate(positions(data, CHUNK))
        if any(a < end and b > begin for a, b in places)
        for m in ledger[k * EVERY : (k + 1) * EVERY]
    }  # fmt: skip
    if not damaged.unchecked:  # a chunk that is cut off besides has no checksum
        assert set(got) <= set(ledger)
    # or only damaged chunks named their topics
    assert set(missing) <= may_go or damaged.unnamed
    assert damaged.lost <= missing.total()
    assert not (missing and damaged.complete)
    if damaged.stated is not None:
        assert damaged.lost == missing.total()


COUNTS = [25, pytest.param(2300, marks=pytest.mark.long)]
"""Damaged bags of each kind: a sample, and some 9,200 in all."""


@pytest.mark.parametrize('count', COUNTS)
@pytest.mark.parametrize('kind', KINDS)
def test_of_any_damage_only_the_damaged_chunks_are_lost(sound, kind, count):
    rng = random.Random(f'{kind}')
    for _ in range(count):
        only_damaged_chunks_are_lost(sound[kind], rng)


@pytest.mark.parametrize('count', [8, pytest.param(300, marks=pytest.mark.long)])
@pytest.mark.parametrize('compression', PACKERS)
def test_a_file_cut_off_anywhere_gives_all_that_is_whole(sound, compression, count):
    data, ledger = sound[compression, False]
    rng, counts = random.Random(8), []
    for cut in sorted([*(rng.randrange(3000, len(data)) for _ in range(count)), len(data) - 1]):
        damaged, got = read(data[:cut])
        assert got == ledger[: len(got)]
        counts.append(len(got))
        assert damaged.unchecked == len(got) % EVERY
    assert counts == sorted(counts)
    assert counts[-1] == len(ledger)
    assert compression != 'none' or any(number % EVERY for number in counts)
    # more comes back where more is left: to the message, or to what of a compressed chunk is there
    assert len(set(counts)) > (count // 3 if compression == 'none' else 2)


STORE = get_typestore(Stores.ROS2_JAZZY)
each_storage = pytest.mark.parametrize('storage', ['MCAP', 'SQLITE3'])


def theirs(path, storage):
    return Writer(path, version=9, storage_plugin=StoragePlugin[storage])


def fill(writer):
    """Write a bag; what is in it."""
    rng = random.Random(5)
    ledger = [('/a', 1000 + k, b'\0\1\0\0' + rng.randbytes(100)) for k in range(400)]
    with writer:
        topic = writer.add_connection('/a', VECTOR, typestore=STORE)
        for _, time_ns, data in ledger:
            writer.write(topic, time_ns, data)
    return ledger


def unfinished(file):
    """Leave the file as a recorder does that is killed within a transaction."""
    with contextlib.closing(sqlite3.connect(file, isolation_level=None)) as base:
        base.execute('PRAGMA cache_size=5')  # so that the file is changed before the commit
        base.execute('BEGIN')
        base.executemany(
            'INSERT INTO messages VALUES(NULL, 1, ?, ?)', [(k, bytes(300)) for k in range(3000)]
        )
        kept = {p: p.read_bytes() for p in file.parent.iterdir()}
    for path, content in kept.items():
        path.write_bytes(content)


def leaf_zeroed(file):
    data = file.read_bytes()
    leaves = [p for p in range(4096, len(data), 4096) if data[p] == 0x0D and data[p + 4] > 10]
    file.write_bytes(data[: leaves[2]] + bytes(4096) + data[leaves[2] + 4096 :])


@pytest.mark.parametrize(
    ('damage', 'words', 'least'),
    [
        (unfinished, 'its last transaction was not finished', 400), (leaf_zeroed, 'Page', 350),
        (lambda file: os.truncate(file, file.stat().st_size - 1000), 'its last page is torn', 0),
        (lambda file: os.truncate(file, 4096 * 5), 'malformed', 0),
        (lambda file: file.write_bytes(flipped(file.read_bytes(), 100, 0x80)), 'malformed', 0)],
)
def test_a_damaged_sqlite3_file_is_answered_with_the_command_that_recovers_it(
    tmp_path, damage, words, least
):
    file = tmp_path / 'bag' / 'bag.db3'
    fill(theirs(file.parent, 'SQLITE3'))
    damage(file)
    before = {p.name: p.read_bytes() for p in tmp_path.rglob('*') if p.is_file()}
    readers = (lambda: recover(file.parent)), (lambda: list(Storage(file.parent, '/a').batches()))
    for use, kind in zip(readers, (BadInputError, UnreadableError), strict=True):
        with pytest.raises(kind) as caught:
            use()
        assert f'{file}: is a damaged sqlite3 file (' in str(caught.value)
        assert words in str(caught.value)
        command = str(caught.value).split('`')[1]
        assert command.startswith(f'sqlite3 {file} .dump | ')
        assert command.endswith(' | sqlite3 bag_recovered.db3')
    assert before == {p.name: p.read_bytes() for p in tmp_path.rglob('*') if p.is_file()}
    if shutil.which('sqlite3') and least:
        subprocess.run(['sh', '-c', command], cwd=tmp_path, check=True)
        assert recover(tmp_path / 'bag_recovered.db3').messages >= least


@pytest.mark.parametrize('wrong', ["timestamp = 'x'", 'timestamp = -5', 'topic_id = 9'])
def test_a_row_that_is_no_message_is_counted(tmp_path, wrong):
    file = tmp_path / 'bag' / 'bag.db3'
    fill(theirs(file.parent, 'SQLITE3'))
    with contextlib.closing(sqlite3.connect(file, isolation_level=None)) as base:
        base.execute(f'UPDATE messages SET {wrong} WHERE id = 7')  # noqa: S608
    result = recover(file.parent)
    assert (result.messages, result.undecodable, result.sound) == (399, 1, False)


def test_what_the_files_cannot_tell_metadata_does(tmp_path):
    ledger = made(tmp_path / 'bag', closed=True, split_s=0.4)
    (tmp_path / 'bag' / 'bag_3.mcap').unlink()
    result = recover(tmp_path / 'bag')
    assert result.lost == len(ledger) - result.messages == 100
    assert 'metadata.yaml counts 400 messages' in '\n'.join(result.notes)
    with theirs(tmp_path / 'empty', 'MCAP') as writer:
        topic = writer.add_connection('/a', VECTOR, typestore=STORE)
        for k in range(3):
            writer.write(topic, 1000 + k, b'\0\1\0\0' + bytes([k]) if k else b'')
    result = recover(tmp_path / 'empty')
    assert (result.messages, result.undecodable, result.lost) == (2, 1, 0)


@each_storage
@pytest.mark.parametrize('first', [0, 1])
def test_a_bag_without_metadata_is_recovered_with_all_its_types(tmp_path, storage, first):
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg('float64 a\nstring b\n', 'mine/msg/Foo'))
    own = store.types['mine/msg/Foo'](a=1.5, b='x')
    kinds = (VECTOR, 'std_msgs/msg/String')
    with theirs(tmp_path / 'bag', storage) as writer:
        order = kinds[::-1] if first else kinds
        made = {kind: writer.add_connection('/a', kind, typestore=store) for kind in order}
        for k in range(30):
            writer.write(made[kinds[k % 3 == 0]], 1000 + k, b'\0\1\0\0' + bytes([k]))
        topic = writer.add_connection('/own', 'mine/msg/Foo', typestore=store)
        writer.write(topic, 1030, store.serialize_cdr(own, 'mine/msg/Foo'))
    (tmp_path / 'bag' / 'metadata.yaml').unlink()
    result = recover(tmp_path / 'bag')
    assert (storage == 'SQLITE3') == ('all its rows are there' in '\n'.join(result.notes))
    with AnyReader([result.path]) as reader:
        *got, (connection, _, raw) = reader.messages()
        assert reader.deserialize(raw, connection.msgtype).a == own.a
    wanted = [('/a', kinds[k % 3 == 0], 1000 + k) for k in range(30)]
    assert [(c.topic, c.msgtype, time_ns) for c, time_ns, _ in got] == wanted


def test_messages_whose_definition_is_missing_are_copied_as_they_are(tmp_path):
    file = tmp_path / 'bag' / 'bag.db3'
    fill(theirs(file.parent, 'SQLITE3'))
    with contextlib.closing(sqlite3.connect(file, isolation_level=None)) as base:
        base.execute('DELETE FROM message_definitions')  # Humble's bags have none
        base.execute("UPDATE topics SET type = 'mine/msg/Foo'")
    result = recover(file.parent, tmp_path / 'copy')
    assert (result.messages, result.sound) == (400, True)
    with Reader(result.path) as reader:
        (connection,) = reader.connections
    assert (connection.msgtype, connection.msgdef.data) == ('mine/msg/Foo', '')


@each_storage
def test_files_compressed_as_a_whole_are_unpacked(tmp_path, storage):
    writer = theirs(tmp_path / 'bag', storage)
    writer.set_compression(CompressionMode.FILE, CompressionFormat.ZSTD)
    ledger = fill(writer)
    assert len(list((tmp_path / 'bag').glob('*.zstd'))) == 1
    assert recover(tmp_path / 'bag').sound  # so that it is copied only on demand
    assert [path.name for path in tmp_path.iterdir()] == ['bag']
    with AnyReader([recover(tmp_path / 'bag', tmp_path / 'copy').path]) as reader:
        assert [(c.topic, t, bytes(raw)) for c, t, raw in reader.messages()] == ledger
