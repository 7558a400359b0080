"""Bags come back as written through rosbags' reader; what was flushed survives a kill."""

import shutil
import time
from datetime import datetime, timezone
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.typesys import Stores, get_typestore

from quad_bridge.bag_writer import BagWriter, free_paths, new_bag
from quad_bridge.errors import BadInputError
from quad_bridge.recording import Recording
from quad_bridge.recover import main, recover

STORE = get_typestore(Stores.ROS2_JAZZY)
VECTOR = 'geometry_msgs/msg/Vector3Stamped'
ZERO = QosTime(0, 0)
LATCHED = Qos(
    QosHistory.KEEP_LAST,
    10,
    QosReliability.RELIABLE,
    QosDurability.TRANSIENT_LOCAL,
    ZERO,
    ZERO,
    QosLiveliness.AUTOMATIC,
    ZERO,
    False,
)
KINDS = [
    ('mcap', 'none'), ('mcap', 'zstd'), ('mcap', 'lz4'), ('sqlite3', 'none'), ('sqlite3', 'zstd'),
]  # fmt: skip


def message(k):
    types = STORE.types
    stamp = types['builtin_interfaces/msg/Time'](sec=0, nanosec=k)
    header = types['std_msgs/msg/Header'](stamp=stamp, frame_id='base_link')
    vector = types['geometry_msgs/msg/Vector3'](x=float(k), y=0.0, z=-1.0)
    return bytes(STORE.serialize_cdr(types[VECTOR](header=header, vector=vector), VECTOR))


def write(path, n, storage='mcap', compression='none', *, close=True, every=100):
    writer = BagWriter(path, storage, compression)
    writer.add_topic('/setpoint/rates', VECTOR, (LATCHED,))
    writer.add_topic('/setpoint/attitude', VECTOR)
    for k in range(n):
        writer.write('/setpoint/rates', 1000 + k, message(k))
        if k % 10 == 0:
            writer.write('/setpoint/attitude', 1000 + k, message(-k % 1000))
        if k % every == every - 1:
            writer.flush()
    if close:
        writer.close()
    return writer


def read(path, topic='/setpoint/rates'):
    with AnyReader([path]) as reader:
        chosen = [c for c in reader.connections if c.topic == topic]
        return [(t, bytes(raw)) for _, t, raw in reader.messages(chosen)]


@pytest.mark.parametrize(('storage', 'compression'), KINDS)
def test_a_bag_comes_back_as_written(tmp_path, storage, compression):
    path = tmp_path / 'bag'
    write(path, 350, storage, compression)
    assert read(path) == [(1000 + k, message(k)) for k in range(350)]
    with AnyReader([path]) as reader:
        qos = {c.topic: c.ext.offered_qos_profiles for c in reader.connections}
        assert reader.message_count == 350 + 35
    assert [q.durability for q in qos['/setpoint/rates']] == [QosDurability.TRANSIENT_LOCAL]
    assert qos['/setpoint/attitude'] == []


def test_an_existing_bag_is_never_written_over(tmp_path):
    path = tmp_path / 'bag'
    write(path, 3)
    with pytest.raises(BadInputError, match='exists already'):
        BagWriter(path)
    assert len(read(path)) == 3


def test_a_free_path_is_numbered_where_the_second_is_taken(tmp_path):
    now = datetime(2024, 5, 6, 7, 8, 9, tzinfo=timezone.utc)
    for name in ('flight_20240506_070809', 'flight_20240506_070809_2'):
        # looked for before the other recorder's bag is there
        writer = new_bag(free_paths(tmp_path, 'flight', now), 'mcap', 'none')
        assert writer.path.name == name
        writer.close()
    with pytest.raises(BadInputError, match='exists already'):
        new_bag([tmp_path / name], 'mcap', 'none')


def test_a_folder_that_appears_at_the_last_moment_is_another_recorders(tmp_path, monkeypatch):
    (tmp_path / 'a').mkdir()
    monkeypatch.setattr('quad_bridge.bag_writer._check', lambda *_: None)
    monkeypatch.setattr('quad_bridge.bag_writer._check_space', lambda *_: None)
    assert new_bag([tmp_path / 'a', tmp_path / 'b'], 'mcap', 'none').path == tmp_path / 'b'
    assert list((tmp_path / 'a').iterdir()) == []


@pytest.mark.parametrize(
    ('arguments', 'text'),
    [(('lmdb', 'none'), 'storage must be'), (('mcap', 'rar'), 'compression must be')],
)
def test_wrong_settings_are_named(tmp_path, arguments, text):
    with pytest.raises(BadInputError, match=text):
        BagWriter(tmp_path / 'bag', *arguments)


def test_a_type_nobody_knows_is_refused(tmp_path):
    with pytest.raises(BadInputError, match='/x: message type is not a standard one'):
        BagWriter(tmp_path / 'bag').add_topic('/x', 'foo_msgs/msg/Bar')


@pytest.mark.parametrize(('storage', 'compression'), KINDS)
def test_what_was_flushed_is_recovered_after_a_kill(tmp_path, storage, compression):
    path = tmp_path / 'bag'
    writer = write(path, 350, storage, compression, close=False)
    killed = tmp_path / 'killed'
    shutil.copytree(path, killed)  # what the disk holds at the moment of a SIGKILL
    writer.abort()
    before = {p.name: p.read_bytes() for p in killed.iterdir()}
    result = recover(killed)
    assert result.path == tmp_path / 'killed_recovered'
    assert read(result.path) == [(1000 + k, message(k)) for k in range(300)]
    assert {p.name: p.read_bytes() for p in killed.iterdir()} == before
    with AnyReader([result.path]) as reader:
        qos = {c.topic: c.ext.offered_qos_profiles for c in reader.connections}
    assert [q.durability for q in qos['/setpoint/rates']] == [QosDurability.TRANSIENT_LOCAL]


@pytest.mark.parametrize('compression', ['none', 'zstd', 'lz4'])
def test_a_bag_cut_off_anywhere_gives_all_that_is_whole(tmp_path, compression):
    write(tmp_path / 'bag', 300, 'mcap', compression, every=50)
    data = (tmp_path / 'bag' / 'bag_0.mcap').read_bytes()
    rng = np.random.default_rng(8)
    counts = []
    for i, cut in enumerate(sorted(rng.integers(3000, len(data), 30))):
        damaged = tmp_path / f'cut{i}.mcap'
        damaged.write_bytes(data[:cut])
        result = recover(damaged)
        got = read(result.path)
        assert got == [(1000 + k, message(k)) for k in range(len(got))]
        counts.append(len(got))
    assert counts == sorted(counts)
    assert counts[-1] == 300
    # more comes back where more is left: to the message, or to the chunk where it is compressed
    assert len(set(counts)) > (20 if compression == 'none' else 3)


def test_the_summary_says_how_much_was_lost(tmp_path, capsys):
    write(tmp_path / 'bag', 200, every=50)
    file = tmp_path / 'bag' / 'bag_0.mcap'
    data = file.read_bytes()
    chunk = data.rfind(message(170))  # inside the last chunk of rates
    file.write_bytes(data[: chunk + 10])
    (tmp_path / 'bag' / 'metadata.yaml').unlink()
    main([str(tmp_path / 'bag')])
    out = capsys.readouterr().out
    assert 'bag_recovered: 187 messages over 0.00 s recovered; lost: ' in out
    assert '170  /setpoint/rates' in out


@pytest.mark.parametrize(
    ('name', 'content', 'text'),
    [
        ('absent', None, 'does not exist'),
        ('empty.mcap', b'', 'is empty'),
        ('text.mcap', b'time,rate\n', 'is no mcap file'),
        ('bare.mcap', b'\x89MCAP0\r\n', 'holds no whole message'),
        ('table.csv', b'1,2', 'holds no .mcap or .db3 file'),
        ('junk.db3', b'no database' * 100, 'holds no whole message'),
    ],
)
def test_what_cannot_be_recovered_ends_with_one_line_and_status_two(
    tmp_path, capsys, name, content, text
):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(SystemExit) as caught:
        main([str(path)])
    assert caught.value.code == 2
    error = capsys.readouterr().err
    assert error.count('\n') == 1
    assert name in error
    assert text in error
    assert sorted(p.name for p in tmp_path.iterdir()) == ([name] if content is not None else [])


def test_an_earlier_recovery_is_kept(tmp_path):
    write(tmp_path / 'bag', 5)
    recover(tmp_path / 'bag')
    with pytest.raises(BadInputError, match='exists already'):
        recover(tmp_path / 'bag')


def test_arguments_that_are_wrong_end_with_status_two(capsys):
    with pytest.raises(SystemExit) as caught:
        main([])
    assert caught.value.code == 2
    assert 'BAG' in capsys.readouterr().err


def test_a_recording_writes_everything_that_was_put(tmp_path):
    recording = Recording(BagWriter(tmp_path / 'bag'))
    recording.declare('/setpoint/rates', VECTOR, ())
    for k in range(5000):
        recording.put('/setpoint/rates', 1000 + k, message(k))
    status = recording.stop()
    assert (status.written, status.dropped, status.waiting, status.failure) == (5000, 0, 0, '')
    assert len(read(tmp_path / 'bag')) == 5000


class Stuck(BagWriter):
    """A disk that takes nothing more after `good` messages."""

    good = 10

    def write(self, topic, time_ns, data):
        if self.counts[topic] >= self.good:
            raise OSError(28, 'No space left on device')
        super().write(topic, time_ns, data)


def test_a_full_disk_ends_the_recording_with_its_reason_and_counts(tmp_path):
    recording = Recording(Stuck(tmp_path / 'bag'))
    recording.declare('/setpoint/rates', VECTOR, ())
    for k in range(11):
        recording.put('/setpoint/rates', 1000 + k, message(k))
    deadline = time.monotonic() + 10.0
    while not recording.status.failure and time.monotonic() < deadline:
        time.sleep(0.005)
    recording.put('/setpoint/rates', 5000, message(1))
    status = recording.stop()
    assert 'No space left on device' in status.failure
    assert status.failure.count('\n') == 0
    assert (status.written, status.dropped) == (10, 2)
    assert len(read(tmp_path / 'bag')) == 10


def test_a_full_queue_drops_and_counts(tmp_path):
    class Slow(BagWriter):
        def write(self, topic, time_ns, data):
            time.sleep(0.01)
            super().write(topic, time_ns, data)

    recording = Recording(Slow(tmp_path / 'bag'), capacity=5)
    recording.declare('/setpoint/rates', VECTOR, ())
    for k in range(50):
        recording.put('/setpoint/rates', 1000 + k, message(k))
    status = recording.stop()
    assert status.dropped > 0
    assert status.written + status.dropped == 50


def test_shared_folder_of_bags_is_made(tmp_path):
    path = Path(tmp_path, 'a', 'b', 'bag')
    write(path, 1)
    assert len(read(path)) == 1
