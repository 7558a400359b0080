"""The nodes as processes: a far end on a pseudo-terminal, the bridge, the logger, a real bag."""

import contextlib
import os
import select
import signal
import subprocess
import sys
import threading
import time
import tty
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')
import rclpy
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Vector3Stamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import Parameter, ParameterEvent, ParameterType, ParameterValue
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import qos_profile_sensor_data
from rosbags.highlevel import AnyReader
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu
from std_srvs.srv import SetBool, Trigger

from quad_bridge.qos import EVENT, STATE
from quad_bridge.wire import frames as f
from quad_bridge.wire.codec import Decoder, Encoder
from quad_bridge.wire.gain_names import WIRE_NAMES

CONFIG = Path(__file__).resolve().parents[2] / 'src' / 'quad_bridge' / 'config'
START = 'from quad_bridge.{0}_node import main; main()'
WAIT_S = 60.0
NUMBERS = 10_000
"""Cycles are numbered modulo this, 1e-3 rad/s each."""
DIAGNOSTICS = ('serial_bridge: link', 'serial_bridge: clock', 'bag_logger: recording')


class FarEnd(threading.Thread):
    """Sends 250 cycles a second, stamped by number; answers time and parameters, until stopped."""

    running: ClassVar[list['FarEnd']] = []

    def __init__(self, link, *, cycle=0, start_s=None, q=0.25):
        super().__init__(daemon=True)
        self.q, self.flags = q, 1
        self.link = link
        self.running.append(self)
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        os.set_blocking(self.master, False)
        link.symlink_to(os.ttyname(self.slave))
        self.encoder, self.decoder = Encoder(1, 1), Decoder()
        self.stopping, self.cycle = threading.Event(), cycle
        self.start_s = time.monotonic() if start_s is None else start_s
        self.questions, self.commands = 0, []
        """First parameters of what has been commanded; nothing is answered."""
        self.not_taken = set()
        """Numbers of the cycles that never came onto the wire: the bridge got no CPU."""

    def send(self, frame):
        """Whether the pseudo-terminal took it: it holds 0.15 s of what nobody reads."""
        data = self.encoder.encode(frame)
        with contextlib.suppress(BlockingIOError):
            return os.write(self.master, data) == len(data)
        return False

    def now_us(self):
        return int(1e6 * (time.monotonic() - self.start_s))

    def run(self):
        zero = (0.0, 0.0, 0.0)
        while not self.stopping.is_set():
            pause = self.start_s + 0.004 * self.cycle - time.monotonic()
            if select.select([self.master], [], [], max(pause, 0.0))[0]:
                self.answer(os.read(self.master, 4096))
            if pause > 0.0:
                continue
            number = self.cycle % NUMBERS
            gyro = (0.001 * number, self.q, 0.5)
            taken = self.send(
                f.Cycle(
                    4000 * self.cycle, self.cycle, gyro, (0.0, 0.0, -9.81), zero, zero, zero,
                    (0.5, 0.0, 0.0, 0.0), zero, (0.5,) * 4, self.flags,
                )
            )  # fmt: skip
            if not taken:
                self.not_taken.add(number)
            self.cycle += 1

    def unplug(self):
        self.stopping.set()
        self.join()
        self.link.unlink()
        os.close(self.slave)
        os.close(self.master)

    def answer(self, data):
        names = list(WIRE_NAMES.values())
        for frame in self.decoder.feed(data):
            if isinstance(frame, f.TimeSync):
                self.questions += 1
                self.send(f.TimeSync(1000 * self.now_us(), frame.ts1_ns))
            elif isinstance(frame, f.Command):
                self.commands.append(frame.parameters[0])
            elif isinstance(frame, f.ParamRequestList):
                for i, name in enumerate(names):
                    self.send(f.ParamValue(name, 0.5, len(names), i))


@pytest.fixture(autouse=True)
def _no_far_end_is_left():
    yield
    for far in FarEnd.running:
        far.stopping.set()
        if far.is_alive():
            far.join()
    FarEnd.running.clear()


@pytest.fixture
def environment(ros_domain):
    del ros_domain
    return dict(os.environ)


@pytest.fixture
def spawn(environment):
    started = []

    def start(name, *arguments):
        command = [sys.executable, '-c', START.format(name), '--ros-args', *arguments]
        process = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
        process.wait()
        process.stderr.close()


def interrupt(process):
    process.send_signal(signal.SIGINT)
    return process.wait(timeout=WAIT_S)


def numbers(imu):
    """The number of each cycle, from `FarEnd.run`."""
    return np.array([round(1000 * m.angular_velocity.x) for m in imu])


def lost(imu):
    """Numbers of the cycles between the first and the last that are not there."""
    index = numbers(imu)
    steps = np.diff(index) % NUMBERS
    assert steps.min() > 0  # none twice, none before another
    pairs = zip(index, steps, strict=False)
    return {int(first + k) % NUMBERS for first, step in pairs for k in range(1, step)}


def bag_in(folder):
    deadline = time.monotonic() + WAIT_S
    while time.monotonic() < deadline:
        bags = list(folder.glob('flight_*'))
        # Every node's diagnostics come once a second; the bag grows faster than that.
        held = b''.join(file.read_bytes() for bag in bags for file in bag.glob('*.mcap'))
        if len(held) > 100_000 and all(name.encode() in held for name in DIAGNOSTICS):
            return bags[0]
        time.sleep(0.2)
    raise AssertionError('no bag has grown, or it lacks diagnostics')


def test_wire_to_bag(tmp_path, spawn):
    far = FarEnd(tmp_path / 'tty')
    far.start()
    bags = tmp_path / 'bags'
    shared = ('--params-file', str(CONFIG / 'serial_bridge.yaml'))
    logger = spawn(
        'bag_logger', '-p', f'bag_logger:folder:={bags}', '-p', 'bag_logger:autostart:=true'
    )
    bridge = spawn('serial_bridge', *shared, '-p', f'serial_bridge:port:={tmp_path / "tty"}')
    bag = bag_in(bags)
    assert interrupt(logger) == 0
    assert interrupt(bridge) == 0
    far.stopping.set()
    far.join()

    with AnyReader([bag]) as reader:
        found = {}
        for connection, _, raw in reader.messages():
            decoded = reader.deserialize(raw, connection.msgtype)
            found.setdefault(connection.topic, []).append(decoded)
    imu = found['/imu/data']
    stamps = np.array([m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for m in imu])
    assert len(imu) > 100
    assert np.median(np.diff(stamps)) == pytest.approx(0.004, abs=5e-4)
    assert abs(stamps[-1] - time.time()) < 60.0
    assert lost(imu) <= far.not_taken  # no cycle lost from wire to bag
    assert imu[0].linear_acceleration.z == pytest.approx(9.81)
    assert imu[0].angular_velocity.y == -0.25
    for topic in ('/motors/command', '/control/wrench', '/setpoint/rates', '/setpoint/attitude'):
        others = {(m.header.stamp.sec, m.header.stamp.nanosec) for m in found[topic]}
        mine = {(m.header.stamp.sec, m.header.stamp.nanosec) for m in imu}
        assert len(mine ^ others) <= 2  # the first and the last may be cut
    (active,) = found['/gains/active']
    assert {p.name for p in active.changed_parameters} == set(WIRE_NAMES)
    states = {status.name for array in found['/diagnostics'] for status in array.status}
    assert set(DIAGNOSTICS) <= states


def test_a_logger_without_cpu_for_a_second_and_a_half_loses_nothing(tmp_path, spawn):
    far = FarEnd(tmp_path / 'tty')
    far.start()
    bags = tmp_path / 'bags'
    logger = spawn('bag_logger', '-p', f'folder:={bags}', '-p', 'autostart:=true')
    bridge = spawn('serial_bridge', '-p', f'port:={tmp_path / "tty"}')
    bag = bag_in(bags)
    os.kill(logger.pid, signal.SIGSTOP)
    time.sleep(1.5)
    os.kill(logger.pid, signal.SIGCONT)
    time.sleep(1.0)
    assert interrupt(bridge) == 0
    time.sleep(0.5)
    assert interrupt(logger) == 0
    with AnyReader([bag]) as reader:
        wanted = [c for c in reader.connections if c.topic == '/imu/data']
        found = [reader.deserialize(r, c.msgtype) for c, _, r in reader.messages(wanted)]
    assert len(found) > 600
    assert lost(found) <= far.not_taken


class Ears:
    """A node in the test's process that hears what nodes publish, and calls their services."""

    def __init__(self, domain):
        self.context = rclpy.Context()
        self.context.init(domain_id=int(domain))
        self.node = rclpy.create_node('ears', context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.heard = {}

    def listen(self, topic, kind=Imu):
        heard = self.heard.setdefault(topic, [])
        self.node.create_subscription(kind, topic, heard.append, qos_profile_sensor_data)
        return heard

    def until(self, condition):
        deadline = time.monotonic() + WAIT_S
        while not condition():
            assert time.monotonic() < deadline
            self.executor.spin_once(timeout_sec=0.05)

    def spin(self, seconds):
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            self.executor.spin_once(timeout_sec=0.05)

    def request(self, kind, name, request):
        client = self.node.create_client(kind, name)
        assert client.wait_for_service(timeout_sec=WAIT_S)
        return client.call_async(request)

    def answer(self, future):
        self.until(future.done)
        return future.result()

    def call(self, kind, name, request):
        return self.answer(self.request(kind, name, request))

    def transition(self, number):
        request = ChangeState.Request(transition=Transition(id=number))
        return self.call(ChangeState, '/serial_bridge/change_state', request).success

    def close(self):
        self.executor.shutdown()
        self.node.destroy_node()
        self.context.try_shutdown()


@pytest.fixture
def ears(environment):
    ears = Ears(environment['ROS_DOMAIN_ID'])
    yield ears
    ears.close()


def test_two_aircraft_on_one_machine_keep_apart(tmp_path, spawn, ears):
    left, right = (FarEnd(tmp_path / name, q=q) for name, q in (('left', 0.25), ('right', 0.75)))
    for far in (left, right):
        far.start()
    settings = ('-p', f'folder:={tmp_path / "bags"}', '-p', 'autostart:=true', '-r', '__ns:=/left')
    logger = spawn('bag_logger', *settings)
    for name in ('left', 'right'):
        spawn('serial_bridge', '-p', f'port:={tmp_path / name}', '-r', f'__ns:=/{name}')
    topics = [f'/{name}/imu/data' for name in ('left', 'right')]
    heard = [ears.listen(topic) for topic in topics]
    ears.until(lambda: min(len(h) for h in heard) > 300)
    assert {m.angular_velocity.y for m in heard[0]} == {-0.25}
    assert {m.angular_velocity.y for m in heard[1]} == {-0.75}
    # in the bag topics have the contract's names, so that every analysis reads it
    bag = bag_in(tmp_path / 'bags')
    assert interrupt(logger) == 0
    with AnyReader([bag]) as reader:
        wanted = [c for c in reader.connections if c.topic == '/imu/data']
        found = [reader.deserialize(r, c.msgtype) for c, _, r in reader.messages(wanted)]
    assert {m.angular_velocity.y for m in found} == {-0.25}


def test_a_manager_leads_the_bridge_through_its_states(tmp_path, spawn, ears):
    far = FarEnd(tmp_path / 'tty')
    far.start()
    settings = ('-p', f'port:={tmp_path / "tty"}', '-p', 'managed:=true')
    bridge = spawn('serial_bridge', *settings)
    heard = ears.listen('/imu/data')
    assert ears.transition(Transition.TRANSITION_CONFIGURE)
    ears.spin(1.0)
    assert heard == []
    for _ in range(2):
        assert ears.transition(Transition.TRANSITION_ACTIVATE)
        ears.until(lambda: len(heard) > 50)
        assert ears.transition(Transition.TRANSITION_DEACTIVATE)
        ears.spin(0.5)
        heard.clear()
        ears.spin(0.5)
        assert heard == []
    assert ears.transition(Transition.TRANSITION_CLEANUP)
    assert not ears.transition(Transition.TRANSITION_ACTIVATE)  # not before configure
    assert ears.transition(Transition.TRANSITION_CONFIGURE)
    assert ears.transition(Transition.TRANSITION_ACTIVATE)
    ears.until(lambda: len(heard) > 50)
    assert interrupt(bridge) == 0


def test_nothing_that_is_sent_or_left_unanswered_stops_the_bridge(tmp_path, spawn, ears):
    far = FarEnd(tmp_path / 'tty')
    far.start()
    bridge = spawn('serial_bridge', '-p', f'port:={tmp_path / "tty"}', '-p', 'managed:=true')
    link = ears.listen('/diagnostics', DiagnosticArray)
    arm = partial(ears.request, SetBool, '/serial_bridge/arm')
    refused = ears.answer(arm(SetBool.Request(data=False)))
    assert (refused.success, refused.message) == (False, 'the node is not active')
    for number in (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE):
        assert ears.transition(number)
    ears.until(lambda: len(link) > 1)
    # the far end answers no command: all goes on, and disarming passes at once
    told = len(link)
    refused = ears.answer(arm(SetBool.Request(data=True)))
    assert (refused.success, refused.message) == (False, 'it is armed already')
    far.flags = 0
    ears.spin(0.2)
    armed = arm(SetBool.Request(data=True))
    ears.until(lambda: far.commands)
    far.flags = 1
    checked = ears.request(Trigger, '/serial_bridge/check_polarity', Trigger.Request())
    disarmed = arm(SetBool.Request(data=False))
    assert 'request to disarm' in ears.answer(armed).message
    assert ears.answer(disarmed).message == 'the STM32: no answer in 1 s'
    assert far.commands.count(1.0) == 1
    assert far.commands.count(0.0) >= 3
    assert len(link) > told
    # what no frame, float or parser can take
    segment, update = (
        ears.node.create_publisher(ParameterEvent, topic, qos)
        for topic, qos in (('/excitation/segment', STATE), ('/gains/update', EVENT))
    )
    point = ears.node.create_publisher(Vector3Stamped, '/excitation/setpoint', 10)
    ears.until(lambda: point.get_subscription_count() and update.get_subscription_count())
    segment.publish(parameters(segment='train', signal='prbs', injection='rate'))
    ears.spin(0.2)
    huge = Vector3Stamped()
    huge.vector.x = 1e300
    for predicted in ('[' * 200_000, '[' * 4000, '{"roll.peak": 1%s}' % ('0' * 400)):
        update.publish(parameters(predicted=predicted))
        point.publish(huge)
    ears.spin(0.5)
    told = len(link)
    ears.until(lambda: len(link) > told + 1)
    values = {v.key: v.value for s in link[-1].status for v in s.values}
    assert 'failed callbacks' not in values
    assert int(values['set-points dropped']) == 3
    assert int(values['refused']) >= 3
    assert ears.transition(Transition.TRANSITION_DEACTIVATE)
    # the check needs a far end that is heard: this one says why it has ended
    assert not ears.answer(checked).success
    assert interrupt(bridge) == 0


def parameters(**texts):
    """The contract's ParameterEvent with strings."""
    kind = ParameterType.PARAMETER_STRING
    values = {n: ParameterValue(type=kind, string_value=v) for n, v in texts.items()}
    return ParameterEvent(changed_parameters=[Parameter(name=n, value=values[n]) for n in values])


def test_simulated_time_is_respected(tmp_path, spawn, ears):
    far = FarEnd(tmp_path / 'tty')
    far.start()
    clock = ears.node.create_publisher(Clock, '/clock', 10)
    begin_s = time.monotonic()

    def tick():
        message = Clock()
        now_ns = round(1e9 * (5000.0 + time.monotonic() - begin_s))
        message.clock.sec, message.clock.nanosec = divmod(now_ns, 10**9)
        clock.publish(message)

    heard = ears.listen('/imu/data')
    told = ears.listen('/diagnostics', DiagnosticArray)
    settings = ('-p', f'port:={tmp_path / "tty"}', '-p', 'use_sim_time:=true')
    bridge = spawn('serial_bridge', *settings)
    # a node's own clock stands still; its work and its words must not
    ears.until(lambda: any('nothing comes on /clock' in s.message for m in told for s in m.status))
    ears.until(lambda: far.questions > 8)
    assert heard == []
    ears.node.create_timer(0.01, tick)
    ears.until(lambda: len(heard) > 50)
    heard.clear()
    ears.until(lambda: len(heard) > 250)
    stamps = np.array([m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for m in heard])
    assert 5000.0 < stamps[0] < 5000.0 + WAIT_S
    assert np.median(np.diff(stamps)) == pytest.approx(0.004, abs=5e-4)
    assert interrupt(bridge) == 0


def test_a_system_clock_that_is_set_back_stops_nothing(tmp_path, set_back, spawn, ears):
    far = FarEnd(tmp_path / 'tty')
    far.start()
    spawn('serial_bridge', '-p', f'port:={tmp_path / "tty"}')
    imu, told = ears.listen('/imu/data'), ears.listen('/diagnostics', DiagnosticArray)
    ears.until(lambda: len(imu) > 50)
    set_back()
    # timers on the node's own clock would stand still for an hour
    ears.until(lambda: any('system clock was set' in s.message for m in told for s in m.status))
    asked, reports = far.questions, len(told)
    imu.clear()
    ears.until(lambda: far.questions > asked + 5 and len(told) > reports + 1 and len(imu) > 50)
    stamps = [m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for m in imu]
    assert all(0.0 < b - a < 1.0 for a, b in pairwise(stamps))
    assert abs(stamps[-1] - time.time()) < 60.0  # those of before


def values(arrays, name):
    """All values that /diagnostics had under `name`, by key, the last of each."""
    entries = [s for array in arrays for s in array.status if s.name == name]
    return {v.key: v.value for entry in entries for v in entry.values}


def told_again(diagnostics):
    """Whether the bridge says that it opened its port twice, and counted the gap."""
    link = values(diagnostics, 'serial_bridge: link')
    return link.get('times opened') == '2' and int(link['lost cycles']) > 0


def test_replugged_under_another_name_the_flight_goes_on(tmp_path, spawn, ears):
    first = FarEnd(tmp_path / 'ttyACM0')
    first.start()
    bags = tmp_path / 'bags'
    logger = spawn('bag_logger', '-p', f'folder:={bags}', '-p', 'autostart:=true')
    bridge = spawn('serial_bridge', '-p', f'port:={tmp_path}/ttyACM*')
    bag = bag_in(bags)
    first.unplug()
    time.sleep(1.0)
    # the STM32 has gone on meanwhile
    cycle = int((time.monotonic() - first.start_s) / 0.004)
    second = FarEnd(tmp_path / 'ttyACM1', cycle=cycle, start_s=first.start_s)
    imu = ears.listen('/imu/data')
    diagnostics = ears.listen('/diagnostics', DiagnosticArray)
    ears.until(lambda: values(diagnostics, 'serial_bridge: link'))
    imu.clear()
    second.start()
    ears.until(lambda: len(imu) > 250)
    ears.until(lambda: told_again(diagnostics))
    ears.spin(0.5)
    assert interrupt(bridge) == 0
    assert interrupt(logger) == 0
    said = bridge.stderr.read().count('\n')
    second.unplug()
    found = {}
    with AnyReader([bag]) as reader:
        for connection, _, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            found.setdefault(connection.topic, []).append(message)
    stamps = [m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for m in found['/imu/data']]
    steps = np.diff(stamps)
    assert steps.min() > 0.0
    index = numbers(found['/imu/data'])
    (gap,) = np.flatnonzero(np.diff(index) % NUMBERS > cycle - first.cycle)
    assert steps[gap] > 0.5
    assert len(stamps) - gap > 100  # it went on
    for part in (found['/imu/data'][: gap + 1], found['/imu/data'][gap + 1 :]):
        assert lost(part) <= first.not_taken | second.not_taken  # one gap, and no other
    link = values(found['/diagnostics'], 'serial_bridge: link')
    assert int(link['lost cycles']) >= cycle - first.cycle
    assert int(link['times opened']) == 2
    assert link['device'].endswith('ttyACM1')
    assert said < 15


@pytest.mark.parametrize(
    ('node', 'setting', 'text'),
    [
        ('serial_bridge', 'baudd:=9600', 'parameter baudd: is unknown'),
        ('serial_bridge', 'baud:=fast', 'baud'),
        ('serial_bridge', 'baud:=1', 'baud'),
        ('serial_bridge', 'bounds.roll.rate.kp:=[2.0, 1.0]', 'parameter bounds.roll.rate.kp'),
        ('bag_logger', 'storage:=tape', 'must be one of mcap, sqlite3'),
        ('bag_logger', 'topics:=[/nothing]', 'is no topic of the contract'),
    ],
)
def test_a_wrong_parameter_ends_a_node_with_one_line(spawn, node, setting, text):
    process = spawn(node, '-p', setting)
    assert process.wait(timeout=WAIT_S) == 2
    error = process.stderr.read()
    assert error.count('\n') == 1
    assert text in error


def test_the_configuration_files_are_rooted_at_their_nodes():
    for name in ('serial_bridge', 'bag_logger'):
        text = (CONFIG / f'{name}.yaml').read_text(encoding='utf-8')
        assert set(yaml.safe_load(text)) == {name}
        assert set(yaml.safe_load(text)[name]) == {'ros__parameters'}
