"""Bags come back as written through rosbags' reader; what was flushed survives a kill."""

import shutil
import struct
from datetime import datetime, timezone

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

from quad_bridge.errors import BadInputError
from quad_bridge.log.recover import main, recover
from quad_bridge.log.writer import BagWriter, free_paths, new_bag

VECTOR = 'geometry_msgs/msg/Vector3Stamped'
ZERO = QosTime(0, 0)
LATCHED = Qos(
    QosHistory.KEEP_LAST, 10, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL, ZERO, ZERO,
    QosLiveliness.AUTOMATIC, ZERO, False,
)  # fmt: skip


def message(k):
    """What is stored is not looked into."""
    return struct.pack('<4xQ', k) + bytes(60)


def write(path, n, *, close=True):
    writer = BagWriter(path)
    writer.add_topic('/setpoint/rates', VECTOR, (LATCHED,))
    writer.add_topic('/setpoint/attitude', VECTOR)
    for k in range(n):
        writer.write('/setpoint/rates', 1000 + k, message(k))
        if k % 10 == 0:
            writer.write('/setpoint/attitude', 1000 + k, message(-k % 1000))
        if k % 100 == 99:
            writer.flush()
    if close:
        writer.close()
    return writer


def read(path, topic='/setpoint/rates'):
    with AnyReader([path]) as reader:
        chosen = [c for c in reader.connections if c.topic == topic]
        return [(t, bytes(raw)) for _, t, raw in reader.messages(chosen)]


def written(n):
    return [(1000 + k, message(k)) for k in range(n)]


def durabilities(path):
    with AnyReader([path]) as reader:
        profiles = {c.topic: c.ext.offered_qos_profiles for c in reader.connections}
    return {topic: [q.durability for q in qos] for topic, qos in profiles.items()}


DURABILITIES = {'/setpoint/rates': [QosDurability.TRANSIENT_LOCAL], '/setpoint/attitude': []}


def test_a_bag_comes_back_as_written_and_is_never_written_over(tmp_path):
    path = tmp_path / 'a' / 'b' / 'bag'  # folders are made
    write(path, 350)
    with pytest.raises(BadInputError, match='exists already'):
        BagWriter(path)
    with pytest.raises(BadInputError, match='/x: message type is not a standard one'):
        BagWriter(tmp_path / 'b').add_topic('/x', 'foo_msgs/msg/Bar')
    assert read(path) == written(350)
    assert durabilities(path) == DURABILITIES
    with AnyReader([path]) as reader:
        assert reader.message_count == 350 + 35


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


def test_what_was_flushed_is_recovered_after_a_kill_and_nothing_is_overwritten(tmp_path, capsys):
    path, killed = tmp_path / 'bag', tmp_path / 'killed'
    writer = write(path, 350, close=False)
    shutil.copytree(path, killed)  # what the disk holds at the moment of a SIGKILL
    writer.abort()
    before = {p.name: p.read_bytes() for p in killed.iterdir()}
    main([str(killed)])
    said = capsys.readouterr().out
    assert 'killed_recovered: 330 messages recovered; lost: ' in said
    assert 'ends without its index' in said
    assert '300  /setpoint/rates' in said
    recovered = tmp_path / 'killed_recovered'
    assert read(recovered) == written(300)
    assert durabilities(recovered) == DURABILITIES
    assert {p.name: p.read_bytes() for p in killed.iterdir()} == before
    with pytest.raises(BadInputError, match='exists already'):
        recover(killed)


@pytest.mark.parametrize(
    ('name', 'content', 'text'),
    [
        ('absent', None, 'does not exist'),
        ('empty.mcap', b'', 'is empty'),
        ('text.mcap', b'time,rate\n', 'is not an mcap file'),
        ('bare.mcap', b'\x89MCAP0\r\n', 'holds no whole message'),
        ('table.csv', b'1,2', 'holds no .mcap or .db3 file'),
        ('junk.db3', b'no database' * 100, 'is a damaged sqlite3 file (file is not a database)'),
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
    error = capsys.readouterr().err
    assert (caught.value.code, error.count('\n')) == (2, 1)
    assert name in error
    assert text in error
    assert [p.name for p in tmp_path.iterdir()] == ([name] if content is not None else [])
