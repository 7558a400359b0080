"""The bridge's process and the C endpoint's, on a pty and over a signed network link."""

import contextlib
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2 or its wheels')

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Vector3Stamped
from rcl_interfaces.msg import Parameter, ParameterEvent, ParameterType, ParameterValue
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import Imu
from std_msgs.msg import Bool
from std_srvs.srv import SetBool

from quad_bridge.key_file import write_key
from quad_bridge.qos import EVENT, STATE, STREAM
from quad_bridge.wire import frames as f
from quad_bridge.wire.codec import Decoder, Encoder
from quad_bridge.wire.gain_names import WIRE_NAMES

PATIENCE_S = 40.0
START = 'from quad_bridge.serial_bridge_node import main; main()'
KP = 'roll.rate.kp'
PAPER_KP = 1.3 * np.degrees(1.0) / 1000.0
TRAIN = {'segment': 'train', 'signal': 'prbs', 'axis': 'roll', 'injection': 'rate'}


def event(values):
    """Values as a ParameterEvent."""
    message = ParameterEvent()
    for name, content in values.items():
        if isinstance(content, str):
            told = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=content)
        else:
            told = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=content)
        message.changed_parameters.append(Parameter(name=name, value=told))
    return message


class Client:
    """Somebody on the bridge's topics."""

    def __init__(self, domain):
        self.context = Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.node = node = Node('somebody', context=self.context)
        self.imu, self.applied, self.active, self.states = [], [], {}, {}
        subscribe, publish = node.create_subscription, node.create_publisher
        subscribe(Imu, '/imu/data', self.imu.append, STREAM)
        subscribe(Vector3Stamped, '/excitation/applied', self.applied.append, STREAM)
        subscribe(ParameterEvent, '/gains/active', self._on_active, STATE)
        subscribe(DiagnosticArray, '/diagnostics', self._on_diagnostics, EVENT)
        self.updates = publish(ParameterEvent, '/gains/update', EVENT)
        self.segments = publish(ParameterEvent, '/excitation/segment', STATE)
        self.setpoints = publish(Vector3Stamped, '/excitation/setpoint', STREAM)
        self.enable = publish(Bool, '/operator/enable', EVENT)
        self.arming = node.create_client(SetBool, '/serial_bridge/arm')
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(node)
        self.spinner = threading.Thread(target=self.executor.spin, daemon=True)
        self.spinner.start()

    def _on_active(self, message):
        self.active = {p.name: p.value.double_value for p in message.changed_parameters}

    def _on_diagnostics(self, message):
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            self.states[status.name.split(': ')[1]] = (status.message, values)

    def told(self, name):
        """The message of one entry of the diagnostics."""
        return self.states.get(name, ('', {}))[0]

    def until(self, condition, what, meanwhile=lambda: None):
        """Wait for it, doing something a hundred times a second."""
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < deadline, f'no {what}: {self.states}'
            meanwhile()
            time.sleep(0.01)

    def rest(self, seconds, meanwhile=lambda: None):
        end = time.monotonic() + seconds
        self.until(lambda: time.monotonic() > end, 'end', meanwhile)

    def excite(self):
        message = Vector3Stamped()
        message.vector.x = 0.25
        self.setpoints.publish(message)

    def arm(self, on):
        assert self.arming.wait_for_service(timeout_sec=PATIENCE_S)
        asked = self.arming.call_async(SetBool.Request(data=on))
        self.until(asked.done, 'answer', lambda: self.enable.publish(Bool(data=True)))
        return asked.result()

    def close(self):
        self.executor.shutdown()
        self.spinner.join(timeout=5.0)
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)


class Rig:
    """Starts the processes, ends them, and keeps what the C one says at its end."""

    def __init__(self, host, folder, domain):
        self.host_path, self.folder, self.domain = host, folder, domain
        self.port = folder / 'stm32'
        self.environment = {
            **os.environ,
            'ROS_DOMAIN_ID': str(domain),
            'ROS_LOG_DIR': str(folder / 'log'),
            'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        }
        self.started = []

    def start_host(self, *options):
        self.host = subprocess.Popen(
            [self.host_path, '--link', self.port, *options], stdout=subprocess.PIPE, text=True
        )
        self.started.append(self.host)
        assert 'quad host on' in self.host.stdout.readline()

    def start_bridge(self, **settings):
        own = {'port': self.port, 'state_folder': self.folder / 'state', 'polarity': "'off'"}
        given = [
            part
            for name, value in {**own, **settings}.items()
            for part in ('-p', f'serial_bridge:{name}:={value}')
        ]
        self.bridge = subprocess.Popen(
            [sys.executable, '-c', START, '--ros-args', *given],
            env=self.environment,
            stderr=subprocess.PIPE,
            text=True,
        )
        self.started.append(self.bridge)

    def end_host(self):
        """What it counted; a fault of the sanitizers would show in its status."""
        self.host.send_signal(signal.SIGTERM)
        told, _ = self.host.communicate(timeout=PATIENCE_S)
        assert self.host.returncode == 0
        words = told.split()
        return {words[i]: int(words[i + 1]) for i in range(0, len(words), 2)}

    def close(self):
        for process in self.started:
            process.kill()
            process.wait()
            for stream in (process.stdout, process.stderr):
                if stream is not None:
                    stream.close()


@pytest.fixture
def rig(firmware, tmp_path, ros_domain):
    made = Rig(firmware('quad_host_checked'), tmp_path, ros_domain)
    yield made
    made.close()


@pytest.fixture
def client(rig):
    made = Client(rig.domain)
    yield made
    made.close()


def stamps(messages):
    return np.array([m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for m in messages])


def test_topics_clock_parameters_gains_and_the_way_back(rig, client):
    rig.start_host()
    rig.start_bridge()
    client.until(lambda: len(client.imu) > 500, 'cycles')
    taken = stamps(list(client.imu))[250:]
    assert np.median(np.diff(taken)) == pytest.approx(0.004, abs=2e-5)
    assert np.all(np.diff(taken) > 0.0)
    assert client.imu[-1].linear_acceleration.z == pytest.approx(9.81, abs=0.01)
    client.until(lambda: client.told('clock') == 'converged', 'clock')

    client.until(lambda: len(client.active) == 27, 'parameters')
    assert set(client.active) <= set(WIRE_NAMES)
    assert client.active[KP] == pytest.approx(PAPER_KP, rel=1e-6)

    client.updates.publish(event({'source': 'test', KP: 9.0}))
    client.until(lambda: KP in client.told('gains'), 'refusal')
    assert client.active[KP] == pytest.approx(PAPER_KP, rel=1e-6)

    client.updates.publish(event({'source': 'test', KP: 0.09}))
    client.until(lambda: client.active[KP] == np.float32(0.09), 'step')
    client.until(lambda: 'watching' in client.told('gains'), 'watch')
    client.until(lambda: client.told('gains') == 'read back', 'confirmation')

    client.updates.publish(event({'source': 'test', KP: 0.1}))
    client.until(lambda: client.active[KP] == np.float32(0.1), 'step')
    assert client.states['link'][1]['bad CRC'] == '0'
    rig.bridge.kill()
    rig.bridge.wait()
    texts, value = listen(rig.port, until='link lost: last good gains restored')
    assert texts
    assert value == np.float32(0.09)  # the last confirmed, not the first
    counts = rig.end_host()
    assert counts['frames'] > 50
    assert counts['bad'] == counts['dropped'] == 0


def listen(port, until):
    """Texts from the port until one is said; and the gain that is then in force."""
    number = os.open(port, os.O_RDWR | os.O_NOCTTY)
    decoder, encoder, texts, value = Decoder(), Encoder(1, 191), [], None
    deadline = time.monotonic() + PATIENCE_S
    while value is None and time.monotonic() < deadline:
        if not select.select([number], [], [], 0.1)[0]:
            continue
        for frame in decoder.feed(os.read(number, 65536)):
            if isinstance(frame, f.StatusText):
                texts.append(frame.text)
            elif isinstance(frame, f.ParamValue):
                value = frame.value
        if until in texts:
            os.write(number, encoder.encode(f.ParamRequestRead('ROLL_RATE_KP')))
            texts, until = [until], ''
    os.close(number)
    return texts, value


def test_an_excitation_passes_and_the_dead_man_ends_it(rig, client):
    rig.start_host()
    rig.start_bridge()
    client.until(lambda: len(client.imu) > 100, 'cycles')
    client.segments.publish(event(TRAIN))
    client.until(lambda: len(client.applied) > 50, 'excitation', client.excite)
    assert client.applied[-1].vector.x == 0.25
    rates = [m.angular_velocity.x for m in client.imu[-25:]]
    assert max(rates) > 0.02  # the plant follows
    client.until(lambda: 'stale' in client.told('excitation'), 'dead-man')
    last = len(client.applied)
    client.rest(0.5)
    assert len(client.applied) == last


class Network(threading.Thread):
    """Carries a pty's bytes to whoever connects, as a radio would; `heard` is theirs."""

    def __init__(self, port):
        super().__init__(daemon=True)
        self.server = socket.create_server(('127.0.0.1', 0))
        self.url = f'socket://127.0.0.1:{self.server.getsockname()[1]}'
        self.number = os.open(port, os.O_RDWR | os.O_NOCTTY)
        self.heard = b''
        self.stopping = False

    def run(self):
        peer, _ = self.server.accept()
        with contextlib.suppress(OSError), peer:
            while not self.stopping:
                for ready in select.select([peer, self.number], [], [], 0.05)[0]:
                    if ready is peer:
                        data = peer.recv(65536)
                        if not data:
                            return
                        self.heard += data
                        os.write(self.number, data)
                    else:
                        peer.sendall(os.read(self.number, 65536))

    def close(self):
        self.stopping = True
        self.join()
        self.server.close()
        os.close(self.number)


def test_over_a_network_only_the_key_commands_and_only_while_the_operator_holds(rig, client):
    key = rig.folder / 'key'
    write_key(key)
    rig.start_host('--key', key, '--disarmed')
    network = Network(rig.port)
    network.start()
    rig.start_bridge(port=network.url, key_file=key, polarity='auto')
    client.until(lambda: len(client.imu) > 100, 'cycles')
    client.until(lambda: KP in client.active, 'parameters')

    # the operator
    hold = lambda: client.enable.publish(Bool(data=True))  # noqa: E731
    assert client.arming.wait_for_service(timeout_sec=PATIENCE_S)
    asked = client.arming.call_async(SetBool.Request(data=True))
    client.until(asked.done, 'answer')
    assert not asked.result().success
    assert '/operator/enable is silent' in asked.result().message
    client.rest(0.5, hold)
    armed = client.arm(True)
    assert armed.success, armed.message

    client.rest(0.8)  # nobody holds it any more
    client.updates.publish(event({'source': 'test', KP: 0.08}))
    client.until(lambda: '/operator/enable is silent' in client.told('gains'), 'no pulses')
    client.segments.publish(event(TRAIN))
    client.rest(0.5, client.excite)
    assert not client.applied
    client.segments.publish(event(TRAIN))
    both = lambda: (hold(), client.excite())  # noqa: E731
    client.until(lambda: len(client.applied) > 50, 'excitation', both)
    client.rest(0.8, client.excite)
    last = len(client.applied)
    client.until(lambda: 'had let go' in client.told('excitation'), 'refusal', both)
    assert len(client.applied) == last

    # intruders: what was said before, and what bears no signature
    recorded = network.heard[-2000:]
    recorded = recorded[recorded.index(b'\xfd') :]
    os.write(network.number, Encoder(1, 191).encode(f.ParamSet('ROLL_RATE_KP', 0.5, 1, 1)))
    os.write(network.number, recorded)
    client.rest(1.0)
    told = client.states['link'][1]
    assert [told[n] for n in ('refused, unsigned', 'refused, other key')] == ['0', '0']
    network.close()
    counts = rig.end_host()
    assert counts['unsigned'] == 1
    assert counts['replayed'] > 5
    assert counts['forged'] == 0


@pytest.mark.parametrize(
    ('settings', 'text'),
    [
        ({'port': 'socket://127.0.0.1:1'}, 'is required where the port is a network URL'),
        ({'key_file': '/nowhere/key'}, 'cannot be read'),
    ],
)
def test_no_key_no_network(rig, settings, text):
    rig.start_bridge(**settings)
    assert rig.bridge.wait(timeout=PATIENCE_S) == 2
    error = rig.bridge.stderr.read()
    assert (error.count('\n'), text in error, 'make_key' in error) == (1, True, True)


def test_a_host_takes_the_place_of_a_killed_ones_link_and_of_nothing_else(rig):
    rig.port.symlink_to('/dev/pts/of_a_killed_host')
    rig.start_host('--duration', '60')
    assert str(rig.port.readlink()).startswith('/dev/pts/')
    assert rig.port.exists()
    rig.port.unlink()
    rig.port.symlink_to('/dev/pts/of_another')  # that one's link stays
    rig.end_host()
    assert rig.port.is_symlink()
    rig.port.unlink()
    rig.port.write_text('mine')
    told = refused(rig.host_path, '--link', rig.port)
    assert told == f'quad_host: {rig.port}: exists and is not a symbolic link\n'
    assert rig.port.read_text() == 'mine'
    assert list(rig.folder.iterdir()) == [rig.port]


def refused(*command):
    """What a command with wrong arguments says."""
    run = subprocess.run(command, capture_output=True, text=True, check=False, timeout=PATIENCE_S)
    assert run.returncode == 2
    return run.stderr


@pytest.mark.parametrize(
    ('given', 'words'),
    [
        (['--duration', 'soon'], '--duration: must be seconds'),
        (['--duration', 'nan'], '--duration: must be seconds'),
        (['--duration', '1e30'], '--duration: must be seconds'),
        (['--duration', '5x'], '--duration: must be seconds'),
        (['--link'], '--link: needs a value'),
        (['--key', ''], '--key: needs a value'),
        (['--rate', '3'], '--rate: known are --link PATH'),
        (['--link', '/nowhere/port'], '/nowhere/port: No such file or directory'),
    ],
)
def test_what_the_host_does_not_understand_it_says(firmware, given, words):
    told = refused(firmware('quad_host_checked'), *given)
    assert (told.count('\n'), words in told) == (1, True), told
