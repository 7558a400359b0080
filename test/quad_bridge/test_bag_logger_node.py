"""The logger as a process: every storage, killed and restarted, its budget, what it refuses."""

import os
import shutil
import signal
import subprocess
import sys
import time

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')
import rclpy
from geometry_msgs.msg import Vector3Stamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from rosbags.highlevel import AnyReader
from rosgraph_msgs.msg import Clock
from std_msgs.msg import String
from std_srvs.srv import Trigger

from quad_bridge.recover import recover
from quad_sysid.bags.storage import Storage

START = 'from quad_bridge.bag_logger_node import main; main()'
TOPICS = ('/setpoint/attitude', '/setpoint/rates', '/excitation/setpoint', '/excitation/applied')
WAIT_S = 60.0
BURST = 400
LOST_S = 1.0
"""What a kill may cost."""


@pytest.fixture
def environment(ros_domain):
    del ros_domain
    return dict(os.environ)


@pytest.fixture
def logger(environment):
    started = []

    def start(folder, **settings):
        given = {'folder': folder, 'autostart': 'true', **settings}
        arguments = [a for name, value in given.items() for a in ('-p', f'{name}:={value}')]
        command = [sys.executable, '-c', START, '--ros-args', *arguments]
        process = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
        process.wait()
        process.stderr.close()


class Load:
    """Publishes numbered messages on four topics."""

    def __init__(self):
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = rclpy.create_node('load', context=self.context)
        qos = QoSProfile(depth=1000)
        self.publishers = [self.node.create_publisher(Vector3Stamped, t, qos) for t in TOPICS]
        self.message = Vector3Stamped()
        self.message.header.frame_id = 'base_link'
        self.count = 0
        self.moments = []
        """When how many had been published."""

    def wait(self):
        end_s = time.monotonic() + WAIT_S
        while any(p.get_subscription_count() < 1 for p in self.publishers):
            assert time.monotonic() < end_s
            time.sleep(0.05)

    def wait_for_logger(self):
        end_s = time.monotonic() + WAIT_S
        while 'bag_logger' not in self.node.get_node_names():
            assert time.monotonic() < end_s
            time.sleep(0.05)

    def run(self, seconds, rate):
        begin_s, first = time.monotonic(), self.count
        while (passed := time.monotonic() - begin_s) < seconds:
            # what this process had no time for is left out, not sent in one burst
            first = min(first, self.count + BURST - int(passed * rate))
            while self.count - first < passed * rate:
                self.message.vector.x = float(self.count)
                self.publishers[self.count % len(TOPICS)].publish(self.message)
                self.count += 1
            self.moments.append((time.monotonic(), self.count))
            time.sleep(0.002)

    def close(self):
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)


@pytest.fixture
def load(environment):
    del environment
    load = Load()
    yield load
    load.close()


def numbers_in(bag):
    with AnyReader([bag]) as reader:
        chosen = [c for c in reader.connections if c.topic in TOPICS]
        return [reader.deserialize(raw, c.msgtype).vector.x for c, _, raw in
                reader.messages(chosen)]  # fmt: skip


@pytest.mark.parametrize(
    'settings', [{'storage': 'sqlite3'}, {'compression': 'lz4', 'split_s': 1}]
)
def test_four_thousand_messages_a_second_come_into_the_bag(tmp_path, logger, load, settings):
    process = logger(tmp_path, **settings)
    load.wait()
    time.sleep(0.5)
    load.run(3.0, 4000)
    time.sleep(0.5)
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=WAIT_S) == 0
    (bag,) = tmp_path.glob('flight_*')
    assert sorted(numbers_in(bag)) == [float(k) for k in range(load.count)]
    parts = len(list(bag.iterdir())) - 1  # beside metadata.yaml
    assert parts >= 3 if 'split_s' in settings else parts == 1
    with AnyReader([bag]) as reader:
        qos = {c.topic: c.ext.offered_qos_profiles for c in reader.connections}
    assert [q.reliability.name for q in qos['/setpoint/rates']] == ['RELIABLE']


def test_what_the_middleware_loses_is_counted_to_the_last_message(tmp_path, logger, load):
    process = logger(tmp_path)
    load.wait()
    time.sleep(0.3)
    load.run(0.5, 1000)
    process.send_signal(signal.SIGSTOP)  # a machine that has no time for the logger
    load.run(3.0, 4000)
    process.send_signal(signal.SIGCONT)
    time.sleep(1.0)
    load.run(2.5, 1000)
    time.sleep(1.5)
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=WAIT_S) == 0
    (bag,) = tmp_path.glob('flight_*')
    found = len(numbers_in(bag))
    with AnyReader([bag]) as reader:
        chosen = [c for c in reader.connections if c.topic == '/diagnostics']
        *_, last = (reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages(chosen))
    told = {v.key: v.value for v in last.status[0].values}
    assert found < load.count - 1000
    assert int(told['messages lost (middleware)']) == load.count - found
    assert last.status[0].message == f'recording, {load.count - found} messages lost'


def test_a_killed_logger_leaves_a_bag_that_is_read_and_recovered(tmp_path, logger, load):
    process = logger(tmp_path)
    load.wait()
    time.sleep(0.3)
    load.run(3.0, 1500)
    last_s = time.monotonic() - LOST_S
    process.kill()
    process.wait()
    published = max(count for moment_s, count in load.moments if moment_s < last_s)
    assert published > 1000
    (bag,) = tmp_path.glob('flight_*')
    storage = Storage(bag, TOPICS)
    read = sum(len(raws) for batch in storage.batches() for raws in batch.values())
    assert 'metadata.yaml is missing' in storage.warnings[0]
    result = recover(bag)
    got = sorted(numbers_in(result.path))
    assert len(got) == read
    assert got[:published] == [float(k) for k in range(published)]


def test_after_a_recording_that_failed_the_logger_records_the_next(tmp_path, logger, load):
    process = logger(tmp_path)
    load.wait()
    load.run(1.0, 1000)
    (lost,) = tmp_path.glob('flight_*')
    shutil.rmtree(lost)
    client = load.node.create_client(Trigger, '/bag_logger/start')
    executor = SingleThreadedExecutor(context=load.context)
    executor.add_node(load.node)
    started, end_s = False, time.monotonic() + WAIT_S
    while not started and time.monotonic() < end_s:  # refused as long as the first one records
        answer = client.call_async(Trigger.Request())
        executor.spin_until_future_complete(answer, timeout_sec=5.0)
        started = answer.result() is not None and answer.result().success
        time.sleep(0.2)
    executor.shutdown()
    assert started
    load.wait()
    load.run(1.0, 1000)
    time.sleep(0.5)
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=WAIT_S) == 0
    said = process.stderr.read()
    assert 'was removed or renamed; the bag is gone, unless it was moved' in said
    assert 'Traceback' not in said
    (bag,) = tmp_path.glob('flight_*')
    assert len(numbers_in(bag)) > 500


@pytest.mark.parametrize(
    ('settings', 'text'),
    [
        ({'reserve_mb': 1_000_000}, 'MB of free disk for a flight'),
        ({'disk_budget_mb': 100}, 'exceed the disk budget'),
        ({'storage': 'sqlite3', 'compression': 'lz4'}, 'lz4 exists in mcap only'),
        ({'split_mb': -1}, 'split_mb'),
        ({'folder': '/proc/nowhere', 'reserve_mb': 0}, 'cannot write a bag here'),
        ({'prefix': 300 * 'a'}, 'File name too long'),
    ],
)
def test_what_cannot_be_recorded_ends_the_node_with_one_line(tmp_path, logger, settings, text):
    process = logger(**{'folder': tmp_path, **settings})
    assert process.wait(timeout=WAIT_S) == 2
    error = process.stderr.read()
    assert error.count('\n') == 1
    assert text in error
    assert not list(tmp_path.glob('flight_*'))


def test_a_start_that_fails_is_answered_with_its_reason(tmp_path, logger, load):
    process = logger(tmp_path, prefix=300 * 'a', autostart='false')
    client = load.node.create_client(Trigger, '/bag_logger/start')
    assert client.wait_for_service(timeout_sec=WAIT_S)
    executor = SingleThreadedExecutor(context=load.context)
    executor.add_node(load.node)
    answer = client.call_async(Trigger.Request())
    executor.spin_until_future_complete(answer, timeout_sec=WAIT_S)
    executor.shutdown()
    assert not answer.result().success
    assert 'File name too long' in answer.result().message
    assert process.poll() is None


def test_the_oldest_bags_make_room_where_the_settings_say_so(tmp_path, logger):
    for i in range(3):
        bag = tmp_path / f'flight_2001010{i}_000000'
        bag.mkdir()
        (bag / 'data.mcap').write_bytes(bytes(10_000_000))
        (bag / 'metadata.yaml').write_text('')
    settings = {'disk_budget_mb': 40, 'reserve_mb': 15, 'delete_oldest': 'true'}
    process = logger(tmp_path, **settings)
    end_s, bags = time.monotonic() + WAIT_S, []
    while not bags and time.monotonic() < end_s:
        time.sleep(0.05)
        bags = [b for b in tmp_path.glob('flight_*') if '2001' not in b.name]
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=WAIT_S) == 0
    assert 'deleted the oldest bag' in process.stderr.read()
    assert sorted(b.name[:15] for b in tmp_path.glob('flight_2001*')) == [
        'flight_20010101', 'flight_20010102',
    ]  # fmt: skip
    assert len(bags) == 1


def test_a_publisher_of_another_type_is_told_by_name(tmp_path, logger, load):
    other = load.node.create_publisher(String, '/rc/in', 10)
    process = logger(tmp_path)
    load.wait()
    told = next(line for line in process.stderr if 'which is not recorded' in line)
    assert '/rc/in: a publisher has type std_msgs/msg/String' in told
    assert 'sensor_msgs/msg/Joy' in told
    load.node.destroy_publisher(other)


def test_two_loggers_of_one_folder_record_both(tmp_path, logger, load):
    processes = [logger(tmp_path) for _ in range(3)]  # at the same moment
    load.wait()
    for process in processes:
        assert any('recording: ' in line for line in process.stderr)
        process.send_signal(signal.SIGINT)
        assert process.wait(WAIT_S) == 0
    assert [(bag / 'metadata.yaml').is_file() for bag in tmp_path.glob('flight_*')] == 3 * [True]


def test_simulated_time_that_nobody_tells_is_waited_for(tmp_path, logger, load):
    process = logger(tmp_path, use_sim_time='true')
    load.wait_for_logger()
    load.run(2.0, 100)  # two reports
    assert list(tmp_path.glob('flight_*')) == []
    clock = load.node.create_publisher(Clock, '/clock', 10)
    end_s, told = time.monotonic() + WAIT_S, Clock()
    while not list(tmp_path.glob('flight_*')) and time.monotonic() < end_s:
        told.clock.sec += 1
        clock.publish(told)
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=WAIT_S) == 0
    assert len(list(tmp_path.glob('flight_*'))) == 1
