"""The excitation node as a process: topics, services, diagnostics, its end."""

from __future__ import annotations

import math
import os
import re
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

rclpy = pytest.importorskip('rclpy', reason='needs ROS 2 (rclpy)')

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from geometry_msgs.msg import Vector3Stamped  # noqa: E402
from rcl_interfaces.msg import ParameterEvent  # noqa: E402
from rclpy.context import Context  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rclpy.qos import DurabilityPolicy, QoSProfile  # noqa: E402
from sensor_msgs.msg import Imu, Joy  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

SCHEDULE = """
schedule:
  ramp_s: 0.1
  segments:
    - {segment: idle, duration_s: 0.8}
    - {segment: train, signal: prbs, axis: pitch, duration_s: 1.0, clock_s: 0.1, register_bits: 5}
    - {segment: idle, duration_s: 0.5}
"""
RUN = 'from quad_sysid.excitation_node import main; main()'
LATCHED = QoSProfile(depth=20, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Aircraft:
    """Publishes what the guard wants to see and records what the node says."""

    def __init__(self, domain: int) -> None:
        self.context = Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.node = rclpy.create_node('aircraft', context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.segments: list[dict] = []
        self.starts_s: list[float] = []
        self.setpoints: list[tuple[float, float, float]] = []
        self.state: dict[str, str] = {}
        self.failsafe = 0
        self.silent = False
        self.paused_s = 0.0
        """The longest time without /imu/data, where this process itself got no CPU."""
        self._published_s = math.inf
        node = self.node
        self._imu = node.create_publisher(Imu, '/imu/data', 10)
        self._joy = node.create_publisher(Joy, '/rc/in', 10)
        node.create_subscription(ParameterEvent, '/excitation/segment', self._segment, LATCHED)
        node.create_subscription(Vector3Stamped, '/excitation/setpoint', self._setpoint, 100)
        node.create_subscription(DiagnosticArray, '/diagnostics', self._diagnose, 10)
        node.create_timer(0.02, self._publish)

    def _publish(self) -> None:
        imu = Imu()
        imu.orientation.w = 1.0
        if not self.silent:
            self._imu.publish(imu)
            now_s = time.monotonic()
            self.paused_s = max(self.paused_s, now_s - self._published_s)
            self._published_s = now_s
        axes = [0.0, 0.0, 0.5, 0.0, -1.0, -1.0, -1.0, -1.0, -1.0]
        self._joy.publish(Joy(axes=axes, buttons=[self.failsafe]))

    def _segment(self, message) -> None:
        self.starts_s.append(message.stamp.sec + 1e-9 * message.stamp.nanosec)
        kinds = {2: 'integer_value', 3: 'double_value', 4: 'string_value'}
        self.segments.append(
            {p.name: getattr(p.value, kinds[p.value.type]) for p in message.changed_parameters}
        )

    def _setpoint(self, message) -> None:
        self.setpoints.append((message.vector.x, message.vector.y, message.vector.z))

    def _diagnose(self, message) -> None:
        for status in message.status:
            if status.name == 'excitation: schedule':
                self.state = {entry.key: entry.value for entry in status.values}

    def until(self, condition, seconds: float = 60.0) -> None:
        end = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < end, (self.state, self.segments, len(self.setpoints))
            self.executor.spin_once(timeout_sec=0.05)

    def call(self, name: str):
        client = self.node.create_client(Trigger, name)
        self.until(client.service_is_ready)
        future = client.call_async(Trigger.Request())
        self.until(future.done)
        return future.result()

    def forget(self) -> None:
        """Make ready for another flight."""
        for heard in (self.segments, self.starts_s, self.setpoints, self.state):
            heard.clear()
        self.paused_s = 0.0

    def close(self) -> None:
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)


@pytest.fixture
def aircraft(ros_domain):
    aircraft = Aircraft(ros_domain)
    yield aircraft
    aircraft.close()


@pytest.fixture
def start(tmp_path, aircraft):
    del aircraft
    file = tmp_path / 'schedule.yaml'
    file.write_text(SCHEDULE)
    running = []

    def begin(**parameters):
        # This process publishes the aircraft's data and may itself stand still on a busy host.
        parameters = {'schedule': file, 'imu_stale_s': 1.5, **parameters}
        options = [word for k, v in parameters.items() for word in ('-p', f'{k}:={v}')]
        process = subprocess.Popen(
            [sys.executable, '-c', RUN, '--ros-args', *options],
            stderr=subprocess.PIPE, text=True, env={**os.environ},
        )
        running.append(process)
        return process

    yield begin
    for process in running:
        process.kill()
        process.wait()


def stood_still(ended) -> list[float]:
    """The standstills (s) that a node told of which has ended."""
    _, said = ended.communicate(timeout=60)
    return [float(x) for x in re.findall(r'stood still for ([0-9.]+) s', said)]


def test_a_schedule_is_flown_and_the_process_ends(aircraft, start):
    processes = []
    for _ in range(6):
        aircraft.forget()
        processes.append(start(autostart='true', exit_when_done='true'))
        aircraft.until(lambda: processes[-1].poll() is not None)
        if not any(t > 0.2 for t in stood_still(processes[-1])):
            break  # no segment was slept through
    else:
        pytest.skip('no CPU: the node stood still for longer than 0.2 s in each of six flights')
    assert processes[-1].returncode == 0
    aircraft.until(lambda: aircraft.state.get('state') == 'done')
    aircraft.until(lambda: len(aircraft.segments) == 4)
    assert [s['segment'] for s in aircraft.segments] == ['idle', 'train', 'idle', 'idle']
    train = aircraft.segments[1]
    assert (train['signal'], train['axis'], train['injection']) == ('prbs', 'pitch', 'attitude')
    assert train['register_bits'] == 5
    assert train['amplitude'] == pytest.approx(0.2094, abs=1e-4)
    assert 100 < len(aircraft.setpoints) <= 251
    assert max(abs(s[1]) for s in aircraft.setpoints) == pytest.approx(0.2094, abs=1e-4)
    assert all(s[0] == s[2] == 0.0 for s in aircraft.setpoints)
    assert 'complete' in aircraft.state['reason']


def test_started_by_service_and_ended_by_failsafe(aircraft, start):
    start()
    aircraft.until(lambda: aircraft.state.get('state') == 'ready')
    assert not aircraft.setpoints
    assert aircraft.call('/excitation/start').success
    aircraft.until(lambda: len(aircraft.setpoints) > 20)
    aircraft.failsafe = 1
    aircraft.until(lambda: aircraft.state.get('state') == 'aborted')
    assert 'failsafe' in aircraft.state['reason']
    aircraft.until(lambda: aircraft.segments[-1].get('reason'))
    assert aircraft.segments[-1]['signal'] == 'none'
    assert aircraft.setpoints[-1] == (0.0, 0.0, 0.0)
    refused = aircraft.call('/excitation/start')
    assert not refused.success
    assert 'failsafe' in refused.message


def test_simulated_time_that_nobody_tells_flies_nothing_and_says_so(aircraft, start):
    start(use_sim_time='true')
    aircraft.until(lambda: aircraft.state.get('state') == 'ready')
    refused = aircraft.call('/excitation/start')
    assert (refused.success, '/clock' in refused.message) == (False, True), refused.message
    assert not aircraft.setpoints


LONG = """
schedule:
  ramp_s: 0.1
  segments:
    - {segment: train, signal: prbs, axis: pitch, duration_s: 60.0, clock_s: 0.1, register_bits: 5}
    - {segment: validation, signal: square, axis: pitch, duration_s: 1.0, period_s: 0.5}
"""


@pytest.mark.parametrize('answers', [True, False])
def test_training_ends_when_the_rate_answers_the_whole_band(aircraft, start, tmp_path, answers):
    """Stamps, not the clock, say how long was flown: 8 s of them come in 2 s."""
    (tmp_path / 'long.yaml').write_text(LONG)
    process = start(schedule=tmp_path / 'long.yaml', autostart='true', exit_when_done='true',
                    end_when_covered='true', band_low_rad_s='2.0', least_train_s='5.0')
    node = aircraft.node
    imu = node.create_publisher(Imu, '/imu/data', 100)
    applied = node.create_publisher(Vector3Stamped, '/excitation/applied', 100)
    rng = np.random.default_rng(1)
    levels = np.repeat(rng.choice([-0.2, 0.2], 500), 25)
    aircraft.until(lambda: len(aircraft.setpoints) > 20)
    aircraft.until(lambda: imu.get_subscription_count() and applied.get_subscription_count())
    rate = angle = 0.0
    for k in range(levels.size if answers else 2000):
        if len(aircraft.segments) > 1:
            break
        rate += 0.08 * (3.0 * (levels[k] - angle) - rate)
        angle += 0.004 * rate
        message, vector = Imu(), Vector3Stamped()
        for stamp in (message.header.stamp, vector.header.stamp):
            stamp.sec, stamp.nanosec = divmod(10**9 + k * 4_000_000, 10**9)
        message.orientation.w, vector.vector.y = 1.0, float(levels[k])
        message.angular_velocity.y = rate if answers else float(rng.standard_normal())
        imu.publish(message)
        applied.publish(vector)
        if k % 20 == 0:
            time.sleep(0.02)
            aircraft.executor.spin_once(timeout_sec=0.0)
    if not answers:
        end = time.monotonic() + 3.0
        aircraft.until(lambda: time.monotonic() > end)
        assert [s['segment'] for s in aircraft.segments] == ['train']
        return
    aircraft.until(lambda: process.poll() is not None)
    assert process.returncode == 0
    aircraft.until(lambda: len(aircraft.segments) == 3)
    assert [s['segment'] for s in aircraft.segments] == ['train', 'validation', 'idle']
    began, validated, ended = aircraft.starts_s
    assert validated - began < 30.0
    assert ended - validated == pytest.approx(1.0, abs=0.3)


def test_a_standstill_of_the_node_itself_is_no_stale_link(aircraft, start):
    processes = []
    for _ in range(6):
        aircraft.forget()
        process = start(autostart='true', exit_when_done='true', imu_stale_s=0.4)
        processes.append(process)
        aircraft.until(lambda: len(aircraft.setpoints) > 20)
        process.send_signal(signal.SIGSTOP)
        end = time.monotonic() + 0.6
        while time.monotonic() < end:
            aircraft.executor.spin_once(timeout_sec=0.05)
        process.send_signal(signal.SIGCONT)
        aircraft.until(lambda: processes[-1].poll() is not None)
        slept = stood_still(processes[-1])
        if aircraft.paused_s < 0.3 and sum(slept) < 0.95:
            break  # undisturbed: this process went on publishing, and the node slept but once
    else:
        pytest.skip(f'no CPU: /imu/data paused {aircraft.paused_s:.2f} s, {slept} s asleep')
    aircraft.until(lambda: aircraft.state.get('state') in {'done', 'aborted'})
    assert max(slept) > 0.5
    assert aircraft.state['reason'] == 'the schedule is complete'


def test_a_silent_link_ends_it(aircraft, start, tmp_path):
    (tmp_path / 'long.yaml').write_text(LONG)
    start(schedule=tmp_path / 'long.yaml', autostart='true')
    aircraft.until(lambda: len(aircraft.setpoints) > 20)
    aircraft.silent = True
    aircraft.until(lambda: aircraft.state.get('state') == 'aborted')
    assert '/imu/data is' in aircraft.state['reason']


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_takes_the_excitation_back(aircraft, start, number):
    process = start(autostart='true')
    aircraft.until(lambda: len(aircraft.setpoints) > 20)
    process.send_signal(number)
    aircraft.until(lambda: process.poll() is not None)
    assert process.returncode == 0
    aircraft.until(lambda: aircraft.segments[-1]['segment'] == 'idle')
    assert aircraft.setpoints[-1] == (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ('parameters', 'words'),
    [
        ({'schedule': '/does/not/exist.yaml'}, 'exist.yaml: cannot be read'),
        ({'shedule': 'x'}, 'parameter shedule: is unknown'),
        ({'angle_limit_deg': '90.0'}, 'angle_limit_deg'),
        ({'band_low_rad_s': '30.0'}, 'band_low_rad_s: is not below band_high_rad_s 20'),
    ],
)
def test_wrong_parameters_end_in_one_line(start, parameters, words):
    process = start(**parameters)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 2
    lines = [line for line in error.splitlines() if line.startswith('excitation: ')]
    assert len(lines) == 1
    assert words in lines[0]


def test_a_system_clock_that_is_set_back_does_not_stop_a_schedule(
    set_back, aircraft, start, tmp_path
):
    (tmp_path / 'long.yaml').write_text(LONG)
    process = start(schedule=tmp_path / 'long.yaml', autostart='true')
    aircraft.until(lambda: len(aircraft.setpoints) > 100)
    set_back()
    before, elapsed_s = len(aircraft.setpoints), float(aircraft.state.get('elapsed_s', 0.0))
    aircraft.until(lambda: len(aircraft.setpoints) > before + 500)
    aircraft.until(lambda: float(aircraft.state['elapsed_s']) > elapsed_s + 1.0)
    assert aircraft.state['state'] == 'running'
    assert process.poll() is None
