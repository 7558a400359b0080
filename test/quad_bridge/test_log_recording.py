"""A recording on a disk that is full, slow, read-only or gone: what is kept, counted and said."""

import errno
import os
import shutil
import struct
import threading
import time

import pytest
from node_process import until
from rosbags.highlevel import AnyReader

from quad_bridge import status as level
from quad_bridge.errors import BadInputError
from quad_bridge.log import mcap
from quad_bridge.log.recording import Gaps, Recording, recording_status
from quad_bridge.log.recover import recover
from quad_bridge.log.stored.files import recording_state
from quad_bridge.log.stored.scan import McapScan
from quad_bridge.log.writer import BagWriter, Limits
from quad_sysid.bags.storage import Storage

VECTOR = 'geometry_msgs/msg/Vector3Stamped'
TOPIC, LATCHED = '/setpoint/rates', '/robot_description'


@pytest.fixture
def bag(tmp_path):
    return tmp_path / 'bag'


def started(bag, **settings):
    recording = Recording(BagWriter(bag), **settings)
    recording.declare(TOPIC, VECTOR, ())
    return recording


def numbered(k):
    return struct.pack('<4xQ', k) + bytes(100)


def put(recording, numbers):
    for k in numbers:
        recording.put(TOPIC, 10**18 + k, numbered(k))


def numbers_in(bag):
    with AnyReader([bag]) as reader:
        messages = reader.messages([c for c in reader.connections if c.topic == TOPIC])
        return [struct.unpack_from('<Q', raw, 4)[0] for _, _, raw in messages]


@pytest.mark.parametrize(
    ('limit', 'size'), [({'capacity': 7}, 100), ({'capacity_bytes': 8_000_000}, 10**6)]
)
def test_what_waits_is_bounded_by_number_and_bytes_the_oldest_goes(bag, monkeypatch, limit, size):
    hangs, begun = threading.Event(), threading.Event()
    monkeypatch.setattr(mcap.os, 'fdatasync', lambda _: (begun.set(), hangs.wait(60.0)))
    recording = started(bag, **limit)
    put(recording, range(1))
    until(begun.is_set)
    for k in range(1, 51):
        recording.put(TOPIC, 10**18 + k, struct.pack('<4xQ', k) + bytes(size))
    waiting = recording.status.waiting
    hangs.set()
    status = recording.stop()
    assert waiting == 7
    assert (status.written, status.dropped, status.failure) == (8, 43, '')
    assert numbers_in(bag) == [0, *range(44, 51)]


def test_a_sync_that_stalls_for_a_second_loses_nothing_and_is_told(bag, monkeypatch):
    sync, stalls = os.fdatasync, [1.2]
    monkeypatch.setattr(
        mcap.os, 'fdatasync', lambda fd: (time.sleep(stalls.pop() if stalls else 0), sync(fd))
    )
    recording = started(bag)
    put(recording, range(3000))
    until(lambda: not stalls)
    put(recording, range(3000, 6000))
    status = recording.stop()
    assert (status.written, status.dropped, status.failure) == (6000, 0, '')
    assert numbers_in(bag) == list(range(6000))
    told = recording_status(status, '', 10**10)
    assert told.level == level.WARN
    assert f'the disk is slow: {status.longest_sync_s:.1f} s' in told.message
    assert status.longest_sync_s >= 1.2


class Fault:
    """An `os.write` that fails so often, for so many bytes at least, after some of them."""

    def __init__(self, number, times, *, least=5000, after=0):
        self.number, self.left, self.least, self.after = number, times, least, after
        self.write = os.write

    def __call__(self, fd, data):
        if self.left > 0 and len(data) > self.least:
            self.left -= 1
            self.write(fd, bytes(data[: self.after]))
            raise OSError(self.number, os.strerror(self.number))
        return self.write(fd, data)


@pytest.mark.parametrize(
    ('fault', 'failure', 'kept'),
    [
        # cut back, and done again in the room that is kept for the end
        (Fault(errno.ENOSPC, 1, after=3000), 'the bag is closed, whole up to here', 200),
        (Fault(errno.EROFS, 99, least=0), 'quad_bridge recover', 100),
    ],
)
def test_a_write_that_fails_costs_only_what_no_later_one_can_store(
    bag, monkeypatch, fault, failure, kept
):
    recording = started(bag)
    put(recording, range(100))
    file = bag / 'bag_0.mcap'
    until(lambda: len(list(McapScan(file.read_bytes()).messages())) == 100)  # synced
    monkeypatch.setattr(mcap.os, 'write', fault)
    put(recording, range(100, 200))
    until(lambda: failure in recording.status.failure)
    status = recording.stop()
    monkeypatch.undo()
    assert os.strerror(fault.number) in status.failure
    assert (status.written, status.dropped) == (kept, 200 - kept)
    assert kept < 200 or status.size == file.stat().st_size
    assert numbers_in(recover(bag).path if kept < 200 else bag) == list(range(kept))


def test_a_bag_is_not_called_whole_after_a_sync_that_failed(bag, monkeypatch):
    def fail_once(_):
        monkeypatch.setattr(mcap.os, 'fdatasync', lambda _: None)  # as Linux: it says so once
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(mcap.os, 'fdatasync', fail_once)
    recording = started(bag)
    put(recording, range(100))
    until(lambda: 'recover` says what of it the disk has kept' in recording.status.failure)
    assert 'whole up to here' not in recording.stop().failure


def split(bag, limits, *, back_s=0, described=0):
    """A bag of 450 messages in 0.45 s, whose clock is set back after the first 50.

    Before them stands a description of so many bytes, if any.
    """
    writer = BagWriter(bag, limits)
    if described:
        writer.add_topic(LATCHED, 'std_msgs/msg/String')
        writer.write(LATCHED, 10**18, bytes(described))
    writer.add_topic(TOPIC, VECTOR)
    for k in range(450):
        writer.write(TOPIC, 10**18 + k * 10**6 - (k >= 50) * back_s * 10**9, numbered(k))
        if k % 50 == 49:
            writer.flush()
    return writer


BY_TIME = Limits(split_s=0.1)


def test_what_closes_the_bag_is_set_aside_whatever_the_least_free_disk(bag, monkeypatch):
    begun = BagWriter(bag, Limits(reserve_bytes=0))
    assert 512 * os.fstat(begun._closing.fileno()).st_blocks >= 4_000_000
    begun.close()
    monkeypatch.setattr('quad_bridge.log.writer.free_bytes', lambda _: 3_000_000)
    with pytest.raises(BadInputError, match='needs 4 MB of free disk for a flight'):
        BagWriter(bag.with_name('second'), Limits(reserve_bytes=0))


@pytest.mark.parametrize(('limits', 'changed', 'files'), [
    (BY_TIME, {}, 5), (BY_TIME, {'back_s': 3600}, 4), (Limits(10_000), {}, 5),
    (Limits(10_000), {'described': 20_000}, 5),  # not at every flush
])
def test_a_bag_is_split_by_time_and_by_size_into_files_that_are_whole(bag, limits, changed, files):
    split(bag, limits, **changed).close()
    parts = list(bag.glob('*.mcap'))
    assert len(parts) == files
    assert sorted(numbers_in(bag)) == list(range(450))
    assert sorted(k for part in parts for k in numbers_in(part)) == list(range(450))


def test_what_a_new_file_repeats_is_in_order_whole_and_counted_apart(bag):
    writer = split(bag, BY_TIME, described=1000)
    writer.close()
    assert writer.counts == {LATCHED: 1, TOPIC: 450}
    firsts = []
    for part in sorted(bag.glob('*.mcap')):
        with AnyReader([part]) as reader:
            messages = [(c.topic, time_ns) for c, time_ns, _ in reader.messages()]
            assert reader.message_count == len(messages)
        assert [topic for topic, _ in messages].count(LATCHED) == 1
        assert messages[0] == (LATCHED, messages[1][1])
        firsts.append(messages[0][1] - 10**18)
    assert firsts == [k * 10**8 for k in range(5)]
    result = recover(bag)
    assert (result.sound, result.counts) == (True, {LATCHED: 5, TOPIC: 450})
    killed = split(bag.with_name('killed'), BY_TIME, described=1000)
    killed.abort()
    assert killed.counts == {LATCHED: 1, TOPIC: 450}
    assert recover(killed.path).counts == {LATCHED: 5, TOPIC: 450}


def test_of_a_split_bag_all_files_are_recovered_and_a_missing_one_is_told(bag):
    writer = split(bag, BY_TIME)
    storage = Storage(bag, (TOPIC,))
    assert sum(len(batch[TOPIC]) for batch in storage.batches()) == 450
    assert 'is still being recorded' in ''.join(storage.warnings)
    with pytest.raises(BadInputError, match='is still being recorded'):
        recover(bag)
    writer.abort()
    storage = Storage(bag, (TOPIC,))  # as another recorder's, that keeps no lock
    assert sum(len(batch[TOPIC]) for batch in storage.batches()) == 450
    assert 'is still being recorded, or its recorder was killed: read' in ''.join(storage.warnings)
    last = max(bag.glob('*.mcap'))
    os.utime(last, (0.0, 0.0))
    assert recording_state(last) == ''
    (bag / 'bag_5.mcap').touch()  # opened, nothing in it yet
    result = recover(bag)
    assert numbers_in(result.path) == list(range(450))
    assert 'bag_5.mcap: is empty' in '\n'.join(result.notes)
    shutil.rmtree(result.path)
    (bag / 'bag_1.mcap').unlink()
    result = recover(bag)
    assert result.messages == 350
    assert 'part 1 of the bag is missing' in '\n'.join(result.notes)


@pytest.mark.parametrize(
    ('numbers', 'publishers', 'lost'),
    [
        ([1, 2, 3], 1, 0),
        ([40, 41, 45, 46, 50], 1, 6),
        ([40, 41, 1, 2, 3], 1, 0),  # restarted
        ([40, 41, 2, 3, 5], 1, 1),  # restarted, its first message lost unseen
        ([40, 7, 41, 8, 42, 9], 2, 0),  # two of them
        ([40, 7, 43, 8, 44, 10], 2, 3),
        ([5, 1, 6, 2, 7], 2, 0),
        ([5, 6, 8, 9, 9], 2, 2),  # the second 9 ends the gap after 6
    ],
)
def test_gaps_are_counted(numbers, publishers, lost):
    gaps = Gaps()
    assert sum(gaps.lost_before(n, lambda: publishers) for n in numbers) == lost
