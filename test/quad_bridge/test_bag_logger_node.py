"""The logger as a process: what it records, loses and refuses."""

import shutil
import signal
from pathlib import Path

import pytest
from node_process import recorded
from probe import content, stamp
from rosbags.highlevel import AnyReader

from quad_bridge.craft import LAYOUTS

TOPICS = ('/setpoint/attitude', '/setpoint/rates', '/excitation/setpoint', '/excitation/applied')
RECORDING = 'bag_logger: recording'
LOST, WRITTEN = 'messages lost (middleware)', 'messages written'


@pytest.fixture
def logger(start, tmp_path):
    settings = {'folder': tmp_path, 'autostart': True, 'topics': list(TOPICS)}
    return lambda **more: start('bag_logger', **{**settings, **more})


class Load:
    """Numbered messages on four topics."""

    def __init__(self, probe):
        self.probe, self.count = probe, 0

    def publish(self, number):
        first, self.count = self.count, self.count + number
        for k, topic in enumerate(TOPICS):
            self.probe.publish(
                topic,
                *(
                    {'header': stamp(0), 'vector': {'x': n}}
                    for n in range(first + k, self.count, 4)
                ),
            )

    def arrive(self, number):
        """Publish so many, no more at once than the middleware holds, and await them."""
        for part in range(0, number, 3600):
            self.publish(min(3600, number - part))
            self.probe.until(lambda: self.written + self.lost == self.count)

    @property
    def written(self):
        return int(self.probe.diagnostics(RECORDING, WRITTEN) or 0)

    @property
    def lost(self):
        return int(self.probe.diagnostics(RECORDING, LOST) or 0)


@pytest.fixture
def load(probe):
    return Load(probe)


def bags(folder):
    return list(folder.glob('flight_*'))


def numbers_in(bag):
    return sorted(m.vector.x for messages in recorded(bag, *TOPICS).values() for m in messages)


def uses_shared_memory(process):
    """In which a starved logger would go deaf."""
    return 'fastrtps_port' in Path(f'/proc/{process.pid}/maps').read_text()


def test_a_start_that_fails_is_answered_with_its_reason(monkeypatch, probe, logger):
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'SUBNET')
    process = logger(prefix=300 * 'a', autostart=False)
    answer = probe.call('/bag_logger/start')
    assert (answer.success, 'File name too long' in answer.message) == (False, True)
    assert process.poll() is None
    assert not uses_shared_memory(process)


def test_what_the_middleware_loses_is_counted_to_the_last_message(tmp_path, probe, logger, load):
    process = logger()
    probe.meet(*TOPICS)
    load.arrive(400)
    process.send(signal.SIGSTOP)  # a machine that has no time for the logger
    load.publish(12_000)
    process.send(signal.SIGCONT)
    probe.until(lambda: load.written > 400)
    while load.written + load.lost < load.count:  # what is lost shows by what comes after it
        load.publish(4)
        heard = len(probe.listen('/diagnostics'))
        probe.until(lambda heard=heard: len(probe.listen('/diagnostics')) > heard + 2)
    assert process.end() == 0
    (bag,) = bags(tmp_path)
    lost = load.count - len(numbers_in(bag))
    assert lost > 1000
    assert load.lost == lost
    assert probe.diagnostics(RECORDING) == f'recording, {lost} messages lost'


def test_what_is_published_comes_into_the_next_bag_where_the_first_was_lost(
    tmp_path, probe, logger, load
):
    bags_told = probe.listen('/logger/bag')
    process = logger(split_s=1)
    probe.meet(*TOPICS)
    assert not uses_shared_memory(process)
    load.arrive(400)
    (lost,) = bags(tmp_path)
    shutil.rmtree(lost)
    told = probe.listen('/diagnostics')
    process.says('was removed or renamed; the bag is gone, unless it was moved')
    heard = len(told)
    probe.until(lambda: len(told) > heard + 2)
    for array in told[heard + 1 :]:  # an error until the next recording, not for a second
        (entry,) = (one for one in array.status if one.name == RECORDING)
        assert (entry.level, 'was removed or renamed' in entry.message) == (2, True)
    # refused as long as the first one records
    probe.until(lambda: probe.call('/bag_logger/start').success)
    (bag,) = bags(tmp_path)
    probe.until(lambda: probe.diagnostics(RECORDING, 'path') == str(bag))
    load.count = 0
    load.arrive(4000)
    while len(list(bag.glob('*.mcap'))) < 3:
        load.arrive(40)
    assert process.end(signal.SIGTERM) == 0
    assert 'Traceback' not in process.said
    probe.until(lambda: content(bags_told[-1])['state'] == 'complete')
    assert content(bags_told[-1])['path'] == str(bag)
    assert numbers_in(bag) == list(range(load.count))
    with AnyReader([bag]) as reader:
        qos = {c.topic: c.ext.offered_qos_profiles for c in reader.connections}
    assert [q.reliability.name for q in qos['/setpoint/rates']] == ['RELIABLE']


def test_only_a_description_other_than_its_own_is_said_to_be_left_aside(probe, logger):
    topic = '/robot_description'
    node = logger(topics=[topic], robot_description='x')
    probe.advertise(topic)
    probe.deliver(topic, {'data': LAYOUTS['x'].to_urdf()})
    probe.deliver(topic, {'data': LAYOUTS['plus'].to_urdf()})
    node.says('that of another node is left aside')
    assert node.said.count('left aside') == 1
