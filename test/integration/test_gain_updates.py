"""Gains through the bridge, a pty and the virtual STM32: updates, faults, the way back.

The same faults are told apart in test_bridge_gain_keeper.py, faster than time; here the processes,
the topics, the parameters and the services are the real ones.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import select
import signal
import subprocess
import sys
import threading
import tty
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2 or its wheels')

import rclpy
from rcl_interfaces.msg import Parameter, ParameterEvent, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Imu
from std_srvs.srv import Trigger

from quad_bridge.wire.codec import Decoder, Encoder
from quad_bridge.wire.frames import GainsAction, GainsCommand, ParamSet
from quad_sysid.loop.cascade import CascadeGains
from quad_sysid.model import AxisModel
from quad_sysid.model import Parameter as IdentifiedParameter
from quad_tuning.demo.domain import own_domain
from quad_tuning.demo.errors import StageFailedError
from quad_tuning.demo.observer import VOLATILE, Observer
from quad_tuning.demo.processes import Crew, executable
from quad_tuning.demo.stages import Aircraft
from quad_tuning.lqr_proposal import propose_lqr

PATIENCE_S = 60.0
OK, ERROR = 0, 2
KP, ANGLE = 'roll.rate.kp', 'roll.angle.kp'
OLD = {KP: 0.0744845, ANGLE: 3.0}
GAINS = 'serial_bridge: gains'


def value(content):
    if isinstance(content, str):
        return ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=content)
    if isinstance(content, bool):
        return ParameterValue(type=ParameterType.PARAMETER_BOOL, bool_value=content)
    return ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=content)


def parameters(values):
    return [Parameter(name=name, value=value(content)) for name, content in values.items()]


class Relay(threading.Thread):
    """A wire with faults: the STM32's pty on one side, one for the bridge on the other.

    What comes from the bridge passes `spoil`, frame by frame, unless `cut`.
    """

    def __init__(self, stm32: Path, link: Path):
        super().__init__(daemon=True)
        self.far = os.open(stm32, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        self.near, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self.near, False)
        link.symlink_to(os.ttyname(self._slave))
        self.spoil = lambda frame: [frame]
        self.cut = self.ended = False
        self.noise = np.random.default_rng(1)
        self.noisy = 0.0

    def run(self):
        decoder, encoder = Decoder(), Encoder(1, 191)
        while not self.ended:
            ready, _, _ = select.select([self.far, self.near], [], [], 0.05)
            for source in ready:
                with contextlib.suppress(OSError):
                    data = os.read(source, 65536)
                    if source == self.near:
                        frames = [x for f in decoder.feed(data) for x in self.spoil(f)]
                        data = b''.join(encoder.encode(frame) for frame in frames)
                    if not self.cut:
                        os.write(self.far if source == self.near else self.near, self.dirty(data))

    def dirty(self, data):
        """Flip bytes, one in `1 / noisy`."""
        if not self.noisy:
            return data
        flips = self.noise.random(len(data)) < self.noisy
        return bytes(b ^ 0x55 if flip else b for b, flip in zip(data, flips, strict=True))


class Bench:
    """The aircraft's process, the bridge's, an observer, and somebody who wants gains."""

    def __init__(self, crew: Crew, observer: Observer):
        self.crew, self.observer = crew, observer
        self.context = Context()
        rclpy.init(context=self.context, domain_id=crew.domain)
        self.node = Node('somebody', context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.spinner = threading.Thread(target=self.executor.spin, daemon=True)
        self.spinner.start()
        self.updates = self.node.create_publisher(ParameterEvent, '/gains/update', VOLATILE)
        self.peak_rad = 0.0
        self.state = crew.folder / 'state'
        self.stm32, self.port = crew.folder / 'stm32', crew.folder / 'port'

    def start(self, *, relay=False, profile='plain', mount='rig', **settings):
        aircraft = Aircraft(profile, 'roll', 1, mount)
        self.crew.start('virtual_stm32', aircraft.command(self.stm32))
        self.until(self.stm32.exists, 'the pseudo-terminal')
        self.relay = Relay(self.stm32, self.port) if relay else None
        if self.relay is not None:
            self.relay.start()
        self.start_bridge(**settings)

    def start_bridge(self, **settings):
        port = str(self.stm32 if self.relay is None else self.port)
        own = {'port': port, 'state_folder': str(self.state), 'aircraft': 'test', **settings}
        self.crew.start_node('quad_bridge', 'serial_bridge', own)
        self.said('read back')
        self.rest(2.5)

    def until(self, condition, what):
        self.observer.wait_for('bench', what, condition, PATIENCE_S, self.meanwhile)

    def meanwhile(self):
        self.crew.check('bench')

    def rest(self, seconds):
        stamp = self.node.get_clock().now
        end = stamp().nanoseconds + 1e9 * seconds
        self.until(lambda: stamp().nanoseconds > end, 'time')

    def said(self, words, name=GAINS):
        """Wait for a diagnostic with these words."""
        seen = self.observer.diagnostics
        self.until(lambda: name in seen and words in seen[name][1], words)
        return seen[name]

    def active(self, **wanted):
        """Wait until /gains/active says these (`roll_rate_kp` for `roll.rate.kp`)."""
        wanted = {name.replace('_', '.'): v for name, v in wanted.items()}
        told = self.observer.active_gains
        self.until(
            lambda: all(abs(told.get(n, math.inf) - v) < 1e-5 for n, v in wanted.items()),
            f'{wanted} in {told}',
        )

    def ask(self, values, source='test'):
        self.until(lambda: self.updates.get_subscription_count() > 0, 'a bridge that listens')
        message = ParameterEvent(changed_parameters=parameters({**values, 'source': source}))
        self.updates.publish(message)

    def call(self, kind, name, request):
        client = self.node.create_client(kind, name)
        self.until(client.service_is_ready, name)
        future = client.call_async(request)
        self.until(future.done, f'answer of {name}')
        return future.result()

    def set(self, **values):
        """`ros2 param set`; the result of the first."""
        wanted = {name.replace('_', '.'): v for name, v in values.items()}
        request = SetParameters.Request(parameters=parameters(wanted))
        return self.call(SetParameters, '/serial_bridge/set_parameters', request).results[0]

    def watch_imu(self):
        def look(imu):
            q = imu.orientation
            self.peak_rad = max(self.peak_rad, 2.0 * math.acos(min(1.0, abs(q.w))))

        self.node.create_subscription(Imu, '/imu/data', look, qos_profile_sensor_data)

    def history(self):
        lines = (self.state / 'test' / 'gains.jsonl').read_text().splitlines()
        return [json.loads(line) for line in lines]

    def close(self):
        if getattr(self, 'relay', None) is not None:
            self.relay.ended = True
            self.relay.join()
        self.executor.shutdown()
        self.spinner.join()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)


def paper_model():
    """Roll of the virtual aircraft on the rig, as an identification would hand it on."""
    values = {'gain': 435.0, 'lag': 0.043, 'delay': 0.008, 'damping': 0.4, 'bias': 0.0}
    deviations = {'gain': 4.0, 'lag': 5e-4, 'delay': 4e-4, 'damping': 0.05, 'bias': 0.02}
    return AxisModel(
        axis='roll', dt=0.004, gyro_filter_hz=42.0,
        base=tuple(IdentifiedParameter(n, v, deviations[n], '') for n, v in values.items()),
        parameter_names=tuple(values), covariance=np.diag([deviations[n] ** 2 for n in values]),
        active_gains=CascadeGains.default('roll').to_mapping('roll', constants=True),
        noise_rms=0.01,
    )  # fmt: skip


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    try:
        executable('quad_bridge', 'serial_bridge')
    except StageFailedError as missing:
        pytest.skip(f'needs the built workspace: {missing}')
    with own_domain() as domain, Crew(tmp_path, domain) as crew, Observer(domain) as observer:
        bench = Bench(crew, observer)
        try:
            yield bench
        finally:
            bench.close()


def test_updates_parameters_services_and_a_killed_bridge(bench):
    bench.start(polarity='manual', sources=['test', 'a flood', 'ros2 *', 'quad-tune*'])
    bench.ask({KP: 0.1})
    bench.said('call ~/check_polarity')
    answer = bench.call(Trigger, '/serial_bridge/check_polarity', Trigger.Request())
    assert answer.message == 'roll right; pitch silent; yaw silent'

    bench.ask({KP: 0.1}, 'a stranger')
    bench.said('gains of a stranger refused: the source is not allowed')
    bench.ask({KP: 0.1, ANGLE: 4.0})
    bench.active(roll_rate_kp=0.1, roll_angle_kp=4.0)
    for k in range(200):
        bench.ask({ANGLE: 5.0 + 0.01 * k}, 'a flood')
    bench.said('gains of a flood refused: an earlier update is in flight')
    refused = bench.set(roll_angle_kp=5.0)
    assert not refused.successful
    assert 'in flight' in refused.reason
    done = subprocess.run(
        [sys.executable, '-m', 'quad_tuning.cli', 'rollback', '--folder', str(bench.state)],
        env=bench.crew.environment(), capture_output=True, text=True, check=False, timeout=60,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, '')
    assert 'back to set 1 of' in done.stdout
    bench.said('rolled back, old gains: quad-tune rollback asked for it')
    bench.active(roll_rate_kp=OLD[KP], roll_angle_kp=3.0)

    for bad, words in (
        (math.nan, 'finite'), (math.inf, 'finite'), (-3.0, 'must lie in'), (99.0, 'must lie in'),
    ):
        assert words in bench.set(roll_angle_kp=bad).reason
    assert bench.set(roll_angle_kp=5.0).successful
    bench.active(roll_angle_kp=5.0)

    bridge = bench.crew.children['serial_bridge']
    bridge.process.send_signal(signal.SIGKILL)
    bridge.process.wait()
    bridge.may_end, bridge.ended = True, 0.0
    bench.observer.active_gains.clear()
    bench.observer.diagnostics.clear()
    bench.rest(2.5)
    bench.start_bridge(polarity='manual')
    bench.active(roll_angle_kp=3.0)
    sets = [entry['gains'][ANGLE] for entry in bench.history() if 'gains' in entry]
    assert sets == [3.0, 4.0, 3.0, 5.0, 3.0]


def test_a_wire_with_faults_never_leaves_half_a_set(bench):
    bench.start(relay=True, **{'bounds.roll.rate.kd': [0.0, 0.2, 2.0, 0.2]})
    relay, count = bench.relay, iter(range(10_000))

    def every_third(change):
        def spoil(frame):
            if isinstance(frame, (ParamSet, GainsCommand)) and next(count) % 3 == 0:
                return change(frame)
            return [frame]

        return spoil

    falsified = lambda x: [replace(x, value=1.1 * x.value) if isinstance(x, ParamSet) else x]  # noqa: E731
    for step, change in enumerate((lambda _: [], lambda x: [x, x], falsified)):
        relay.spoil, wanted = every_third(change), 0.08 + 0.01 * step
        bench.ask({KP: wanted, ANGLE: 4.0 + step, 'roll.rate.ki': 0.001})
        bench.active(roll_rate_kp=wanted, roll_angle_kp=4.0 + step)
        bench.ask({'rollback': True})
        bench.said('rolled back')
        bench.active(roll_rate_kp=OLD[KP], roll_angle_kp=3.0)
    relay.spoil = lambda frame: [frame]
    relay.noisy = 1e-4
    bench.ask({KP: 0.09, ANGLE: 4.5})
    bench.active(roll_rate_kp=0.09, roll_angle_kp=4.5)
    bench.ask({'rollback': True})
    bench.active(roll_rate_kp=OLD[KP], roll_angle_kp=3.0)
    relay.noisy = 0.0

    bench.ask({ANGLE: 5.0, 'roll.rate.kd': 0.1})  # the YAML lets it pass, the STM32 does not
    assert 'ROLL_RATE_KD: the STM32 kept' in bench.said('not taken over')[1]
    bench.active(roll_rate_kp=OLD[KP], roll_angle_kp=3.0)

    def cut_at_commit(frame):
        if isinstance(frame, GainsCommand) and frame.action == GainsAction.COMMIT:
            relay.cut = True
        return [frame]

    relay.spoil = cut_at_commit
    bench.ask({KP: 0.1, ANGLE: 5.0})
    bench.until(lambda: relay.cut, 'the cut')
    bench.observer.active_gains.clear()
    bench.rest(3.0)
    relay.cut, relay.spoil = False, lambda frame: [frame]
    bench.active(roll_rate_kp=OLD[KP], roll_angle_kp=3.0)
    level, text, _ = bench.said('not taken over')
    assert (level, 'committing' in text) == (ERROR, True)


def test_the_second_control_mode_comes_in_by_quarters_and_goes_back_at_once(bench, tmp_path):
    design = tmp_path / 'gains.json'
    proposal = propose_lqr(paper_model())
    axes = {'roll': {'gains': proposal.gains, 'figures': proposal.figures}}
    design.write_text(json.dumps({'schema': 'quad_tuning/design/1', 'axes': axes}))
    bench.start(sources=['test', 'quad-tune*'])
    bench.watch_imu()
    done = subprocess.run(
        [sys.executable, '-m', 'quad_tuning.cli', 'send', str(design)],
        env=bench.crew.environment(), capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, '')
    bench.active(roll_lqr_share=1.0)
    sets = [entry['gains'] for entry in bench.history() if 'gains' in entry]
    shares = [gains['roll.lqr.share'] for gains in sets]
    assert shares[:3] == pytest.approx([0.0, 0.25, 0.5], rel=1e-3)
    assert (shares[-1], max(shares)) == (1.0, 1.0)
    assert sets[1]['roll.lqr.k_angle'] == pytest.approx(proposal.gains['roll.lqr.k_angle'])
    bench.ask({'rollback': True})
    bench.said('rolled back, old gains')
    bench.active(roll_lqr_share=0.0)
    bench.rest(0.5)
    assert math.degrees(bench.peak_rad) < 4.0


def test_a_destabilising_set_is_taken_back_before_twenty_degrees(bench):
    wide = {f'bounds.{axis}.rate.kp': [0.001, 1.0] for axis in ('roll', 'pitch')}
    bench.start(profile='hover', mount='hover', **wide)
    bench.watch_imu()
    bench.ask({KP: 0.6, 'pitch.rate.kp': 0.6})
    bench.said('rolled back, old gains')
    bench.active(roll_rate_kp=OLD[KP])
    bench.rest(1.0)
    assert math.degrees(bench.peak_rad) < 20.0
    assert 'rolled back' in [entry['state'] for entry in bench.history()]
