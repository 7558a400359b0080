"""A recording on a disk that is full, slow, read-only or gone: what is kept, counted and said."""

import errno
import json
import os
import shutil
import struct
import subprocess
import sys
import time

import pytest
from probe import PATIENCE_S
from rosbags.highlevel import AnyReader

from quad_bridge import status as level
from quad_bridge.errors import BadInputError
from quad_bridge.log import mcap
from quad_bridge.log.recording import Gaps, Recording, RecordingStatus, recording_status
from quad_bridge.log.recover import recover
from quad_bridge.log.stored.scan import McapScan
from quad_bridge.log.writer import BagWriter, Limits

VECTOR = 'geometry_msgs/msg/Vector3Stamped'
TOPIC = '/setpoint/rates'


def started(path, **settings):
    recording = Recording(BagWriter(path), **settings)
    recording.declare(TOPIC, VECTOR, ())
    return recording


def numbered(k):
    return struct.pack('<4xQ', k) + bytes(100)


def put(recording, numbers):
    for k in numbers:
        recording.put(TOPIC, 10**18 + k, numbered(k))


def until(condition):
    end_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.01)


def numbers_in(bag):
    with AnyReader([bag]) as reader:
        return [struct.unpack_from('<Q', raw, 4)[0] for _, _, raw in reader.messages()]


def test_a_sync_that_stalls_for_a_second_loses_nothing_and_is_told(tmp_path, monkeypatch):
    sync, stalls = os.fdatasync, [1.2]
    monkeypatch.setattr(
        mcap.os, 'fdatasync', lambda fd: (time.sleep(stalls.pop() if stalls else 0), sync(fd))
    )
    recording = started(tmp_path / 'bag')
    begin_s = time.monotonic()
    for k in range(6000):  # 4,000 a second
        put(recording, [k])
        time.sleep(max(begin_s + k / 4000 - time.monotonic(), 0.0) if k % 16 == 0 else 0.0)
    status = recording.stop()
    assert (status.written, status.dropped, status.failure) == (6000, 0, '')
    assert numbers_in(tmp_path / 'bag') == list(range(6000))
    told = recording_status(status, '', 10**10)
    assert told.level == level.WARN
    assert f'the disk is slow: {status.longest_sync_s:.1f} s' in told.message
    assert status.longest_sync_s >= 1.2


def test_a_full_queue_drops_its_oldest_and_counts_them(tmp_path, monkeypatch):
    recording = started(tmp_path / 'bag', capacity=100)
    monkeypatch.setattr(recording, '_drain', lambda: None)
    put(recording, range(250))
    monkeypatch.undo()
    status = recording.stop()
    assert (status.written, status.dropped) == (100, 150)
    assert numbers_in(tmp_path / 'bag') == list(range(150, 250))
    assert '150 messages lost' in recording_status(status, '').message


def test_a_bag_that_is_removed_ends_the_recording_with_one_line(tmp_path):
    recording = started(tmp_path / 'bag')
    put(recording, range(10))
    until(lambda: recording.status.written == 10)
    shutil.rmtree(tmp_path / 'bag')
    until(lambda: recording.status.failure)
    put(recording, range(5))
    status = recording.stop()
    assert 'was removed or renamed' in status.failure
    assert '\n' not in status.failure
    assert status.dropped >= 5
    assert recording_status(status, '').level == level.ERROR


def test_a_disk_that_turns_read_only_keeps_what_was_synced(tmp_path, monkeypatch):
    recording = started(tmp_path / 'bag')
    put(recording, range(100))
    file = tmp_path / 'bag' / 'bag_0.mcap'
    until(lambda: len(list(McapScan(file.read_bytes()).messages())) == 100)  # synced

    def refuse(*_):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(mcap.os, 'write', refuse)
    put(recording, range(100, 150))
    until(lambda: 'recover' in recording.status.failure)
    status = recording.stop()
    monkeypatch.undo()
    assert 'Read-only file system' in status.failure
    assert 'quad_bridge recover' in status.failure
    assert (status.written, status.dropped) == (100, 50)
    assert numbers_in(recover(tmp_path / 'bag').path) == list(range(100))


def test_a_write_that_fails_half_way_is_cut_back_and_done_again(tmp_path, monkeypatch):
    recording = started(tmp_path / 'bag')
    write, faults = os.write, [True]

    def half(fd, data):
        if faults and len(data) > 5000:
            faults.pop()
            write(fd, bytes(data[:3000]))
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(fd, data)

    monkeypatch.setattr(mcap.os, 'write', half)
    put(recording, range(200))
    until(lambda: recording.status.failure)
    status = recording.stop()
    assert 'No space left on device; the bag is closed, whole up to here' in status.failure
    assert (status.written, status.dropped) == (200, 0)
    assert numbers_in(tmp_path / 'bag') == list(range(200))


RECORD = """
recording.declare('/setpoint/rates', 'geometry_msgs/msg/Vector3Stamped', ())
k = 0
while not recording.status.failure and k < 40_000:
    for _ in range(8):
        recording.put('/setpoint/rates', 10**18 + k, struct.pack('<4xQ', k) + bytes(500))
        k += 1
    time.sleep(0.002)
status = recording.stop()
"""
FULL = """
import json, os, struct, sys, time
from pathlib import Path
from quad_bridge.log.writer import BagWriter, Limits
from quad_bridge.errors import BadInputError
from quad_bridge.log.recording import Recording
from rosbags.highlevel import AnyReader
folder = Path(sys.argv[1])
try:
    BagWriter(folder / 'large', Limits(reserve_bytes=20_000_000))
    refused = ''
except BadInputError as error:
    refused = str(error)
writer = BagWriter(folder / 'bag', Limits(reserve_bytes=5_000_000))
try:
    (folder / 'other').write_bytes(bytes(20_000_000))  # somebody else takes what is free
except OSError:
    pass
recording = Recording(writer)
""" + RECORD + """
with AnyReader([folder / 'bag']) as reader:
    found = [struct.unpack_from('<Q', raw, 4)[0] for _, _, raw in reader.messages()]
print(json.dumps({
    'refused': refused, 'failure': status.failure, 'written': status.written,
    'dropped': status.dropped, 'put': k, 'whole': found == list(range(len(found))),
    'found': len(found),
}))
"""


def on_a_small_disk(tmp_path, megabytes, script):
    """Run a script on a tmpfs of its own; what it printed as JSON."""
    mount = f'mount -t tmpfs -o size={megabytes}m none "$1" && shift && exec "$@"'
    command = ['unshare', '-rm', 'sh', '-c', mount, 'sh', str(tmp_path)]
    if shutil.which('unshare') is None or subprocess.run(
        [*command, 'true'], check=False, capture_output=True
    ).returncode:
        pytest.skip('no mount namespaces here: a disk of known size cannot be had')
    done = subprocess.run(
        [*command, sys.executable, '-c', script, str(tmp_path)],
        capture_output=True, text=True, check=False, timeout=PATIENCE_S,
        env={**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path), 'TMPDIR': str(tmp_path)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_a_full_disk_ends_with_a_sound_bag(tmp_path):
    told = on_a_small_disk(tmp_path, 16, FULL)
    assert 'needs 24 MB of free disk for a flight' in told['refused']
    assert 'No space left' in told['failure']
    assert 'the bag is closed, whole up to here' in told['failure']
    assert told['whole']
    assert told['found'] == told['written']
    assert told['written'] + told['dropped'] == told['put']


def test_a_folder_that_takes_no_bag_is_refused_in_one_line(tmp_path):
    (tmp_path / 'file').write_text('here')
    with pytest.raises(BadInputError, match='cannot write a bag here') as caught:
        BagWriter(tmp_path / 'file' / 'bag')
    assert '\n' not in str(caught.value)
    with pytest.raises(BadInputError, match=r'needs \d+ MB of free disk .* lower reserve_mb'):
        BagWriter(tmp_path / 'bag', limits=Limits(reserve_bytes=10**15))
    assert not (tmp_path / 'bag').exists()


RECOVER = """
import json, sys
from pathlib import Path
from quad_bridge.log.writer import BagWriter
from quad_bridge.errors import BadInputError
from quad_bridge.log.recover import recover
folder = Path(sys.argv[1])
writer = BagWriter(folder / 'bag')
writer.add_topic('/setpoint/rates', 'geometry_msgs/msg/Vector3Stamped')
for k in range(20_000):
    writer.write('/setpoint/rates', 10**18 + k, bytes(500))
writer.flush()
writer.abort()
try:
    recover(folder / 'bag')
    said = ''
except BadInputError as error:
    said = str(error)
print(json.dumps({'said': said, 'left': sorted(p.name for p in folder.iterdir())}))
"""


def test_a_recovery_without_room_is_refused_in_one_line(tmp_path):
    told = on_a_small_disk(tmp_path, 20, RECOVER)
    assert 'bag_recovered: cannot be written: No space left on device; make room' in told['said']
    assert told['left'] == ['bag']


def test_whatever_goes_wrong_in_the_writers_thread_ends_the_recording(tmp_path):
    recording = started(tmp_path / 'bag')
    put(recording, range(10))
    recording.put(TOPIC, -5, numbered(10))  # no time of an mcap file
    until(lambda: recording.status.failure)
    put(recording, range(11, 20))
    status = recording.stop()
    assert 'writing failed' in status.failure
    assert status.dropped >= 9
    assert numbers_in(tmp_path / 'bag') == list(range(status.written))


# ---- one bag, several files -------------------------------------------------------------------


@pytest.mark.parametrize('limits', [Limits(split_s=0.1), Limits(split_bytes=20_000)])
def test_a_bag_is_split_by_time_and_by_size(tmp_path, limits):
    writer = BagWriter(tmp_path / 'bag', limits)
    writer.add_topic(TOPIC, VECTOR)
    for k in range(1000):
        writer.write(TOPIC, 10**18 + k * 1_000_000, numbered(k))
        if k % 100 == 99:
            writer.flush()
    writer.close()
    files = list((tmp_path / 'bag').glob('*.mcap'))
    assert len(files) >= 5
    assert numbers_in(tmp_path / 'bag') == list(range(1000))
    # each file of the bag is whole in itself
    assert sorted(k for file in files for k in numbers_in(file)) == list(range(1000))


def test_a_clock_set_back_does_not_end_the_splitting(tmp_path):
    writer = BagWriter(tmp_path / 'bag', limits=Limits(split_s=0.1))
    writer.add_topic(TOPIC, VECTOR)
    for k in range(450):
        back_ns = 3600 * 10**9 if k >= 50 else 0
        writer.write(TOPIC, 10**18 + k * 1_000_000 - back_ns, numbered(k))
    writer.close()
    assert len(list((tmp_path / 'bag').glob('*.mcap'))) == 4


def test_of_a_split_bag_all_files_are_recovered_and_a_missing_one_is_told(tmp_path):
    writer = BagWriter(tmp_path / 'bag', limits=Limits(split_s=0.1))
    writer.add_topic(TOPIC, VECTOR)
    for k in range(450):
        writer.write(TOPIC, 10**18 + k * 1_000_000, numbered(k))
    writer.flush()
    writer.abort()
    (tmp_path / 'bag' / 'bag_5.mcap').touch()  # opened, nothing in it yet
    result = recover(tmp_path / 'bag')
    assert numbers_in(result.path) == list(range(450))
    assert 'bag_5.mcap: is empty' in '\n'.join(result.notes)
    shutil.rmtree(result.path)
    (tmp_path / 'bag' / 'bag_1.mcap').unlink()
    result = recover(tmp_path / 'bag')
    assert result.messages == 350
    assert 'part 1 of the bag is missing' in '\n'.join(result.notes)


# ---- what is said, and what the middleware lost -----------------------------------------------


def test_the_status_warns_of_losses_and_names_a_failure(tmp_path):
    def status(free_bytes=10**10, **changes):
        base = {'written': 5, 'waiting': 0, 'dropped': 0, 'lost': 0, 'failure': ''}
        entry = recording_status(RecordingStatus(tmp_path, **{**base, **changes}), '', free_bytes)
        return entry.level, entry.message

    assert status() == (level.OK, 'recording')
    assert status(dropped=2, lost=1) == (level.WARN, 'recording, 3 messages lost')
    assert 'nearly full: 50 MB are free' in status(free_bytes=50_000_000)[1]
    assert status(failure='disk is full') == (level.ERROR, 'disk is full')
    assert recording_status(None, '').message == 'idle'


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


def test_publishers_are_asked_for_only_where_no_turn_fits():
    gaps, asked = Gaps(), []
    for n in (7, 8, 9, 12, 13):
        gaps.lost_before(n, lambda: asked.append(1) or 1)
    assert len(asked) == 2
