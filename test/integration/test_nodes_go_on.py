"""Nodes that meet bad input say so in /diagnostics and go on: ports, gains, bags."""

from __future__ import annotations

import fcntl
import math
import os
import tty
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2 or its wheels')

import rclpy
from rcl_interfaces.msg import Parameter, ParameterEvent, ParameterType, ParameterValue
from rclpy.context import Context
from rclpy.node import Node

from quad_bridge.virtual.flight_bag import write_bag
from quad_bridge.virtual.simulation import Excited, fly
from quad_tuning.demo.domain import own_domain
from quad_tuning.demo.errors import StageFailedError
from quad_tuning.demo.observer import STATE, VOLATILE, Observer
from quad_tuning.demo.processes import Crew, executable
from quad_tuning.demo.stages import Aircraft

PATIENCE_S = 60.0
OK, WARN, ERROR = 0, 1, 2


class Bench:
    """A crew, an observer, and somebody who publishes events."""

    def __init__(self, crew: Crew, observer: Observer) -> None:
        self.crew, self.observer = crew, observer
        self.context = Context()
        rclpy.init(context=self.context, domain_id=crew.domain)
        self.node = Node('somebody', context=self.context)
        self.gains = self.node.create_publisher(ParameterEvent, '/gains/update', VOLATILE)
        self.bags = self.node.create_publisher(ParameterEvent, '/logger/bag', STATE)

    def until(
        self, name: str, level: int, words: str, meanwhile: Callable[[], object] = lambda: None
    ) -> Mapping[str, str]:
        """Wait for a diagnostic of this level with these words; all processes must live."""

        def said() -> bool:
            found = self.observer.diagnostics.get(name)
            return found is not None and found[0] == level and words in found[1]

        self.observer.wait_for(
            name, f'"{words}" of level {level}', said, PATIENCE_S,
            lambda: (self.crew.check(name), meanwhile()),
        )  # fmt: skip
        return self.observer.diagnostics[name][2]

    def say_bag(self, path: Path) -> None:
        self.bags.publish(event({'path': str(path), 'state': 'complete'}))

    def close(self) -> None:
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)


def event(values: Mapping[str, float | str]) -> ParameterEvent:
    message = ParameterEvent()
    for name, value in values.items():
        if isinstance(value, str):
            content = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=value)
        else:
            content = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=value)
        message.changed_parameters.append(Parameter(name=name, value=content))
    return message


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


def test_the_bridge_outlives_every_bad_port_and_refuses_bad_gains(bench, tmp_path):
    link = tmp_path / 'tty'
    bench.crew.start_node('quad_bridge', 'serial_bridge', {'port': str(link)})
    bench.until('serial_bridge: link', ERROR, 'not there')

    master, slave = os.openpty()
    tty.setraw(slave)
    link.symlink_to(os.ttyname(slave))
    bench.until('serial_bridge: link', ERROR, 'nothing arrives')
    sentence = b'$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\r\n'
    bench.until(
        'serial_bridge: link', ERROR, 'another protocol', lambda: os.write(master, 9 * sentence)
    )
    link.unlink()
    os.close(slave)
    os.close(master)
    bench.until('serial_bridge: link', ERROR, 'not there')

    master, slave = os.openpty()
    tty.setraw(slave)
    fcntl.flock(slave, fcntl.LOCK_EX)
    link.symlink_to(os.ttyname(slave))
    bench.until('serial_bridge: link', ERROR, 'busy')
    link.unlink()
    os.close(slave)
    os.close(master)

    bench.crew.start('virtual_stm32', Aircraft('plain', 'roll', 1).command(link))
    bench.until('serial_bridge: link', OK, 'control cycles arrive')
    bench.until('serial_bridge: gains', OK, 'read back')
    flown = dict(bench.observer.active_gains)
    for value in (math.nan, math.inf, -1.0, 1e6):
        bench.gains.publish(event({'roll.rate.kp': value, 'source': f'test {value}'}))
        bench.until('serial_bridge: gains', ERROR, f'gains of test {value} refused: roll.rate.kp')
    assert bench.observer.active_gains == flown


@pytest.mark.parametrize(
    ('name', 'value', 'words'),
    [
        ('train', '5:1', 'parameter train: needs two times START:END'),
        ('inertia', 'abc', 'inertia: needs three positive numbers'),
        ('axes', ['sideways'], 'axis: must be of roll, pitch, yaw, all'),
        ('autoupdate', True, 'parameter autoupdate: is unknown; is it auto_update'),
    ],
)
def test_a_wrong_parameter_ends_the_identification_before_any_flight(bench, name, value, words):
    bench.crew.start_node('quad_sysid', 'identification', {name: value})
    with pytest.raises(StageFailedError, match=f'status 2: identification: .*{words}'):
        bench.observer.wait_for(
            'start', 'end', lambda: False, PATIENCE_S, lambda: bench.crew.check('start')
        )


def flight(folder: Path) -> Path:
    """A bag of the plain profile, flown faster than time."""
    rng = np.random.default_rng(1)

    def prbs(seconds: float) -> np.ndarray:
        n = round(250 * seconds)
        return math.radians(12) * np.repeat(rng.choice([-1.0, 1.0], n // 23 + 1), 23)[:n]

    parts = [Excited(1.0, prbs(24.0)), Excited(26.0, prbs(10.0), role='validation')]
    return write_bag(fly('plain', parts, 37.0, 1), folder / 'flight')


def test_the_identification_outlives_bad_bags_and_sends_gains_only_where_asked(bench, tmp_path):
    flown = flight(tmp_path)
    nothing = tmp_path / 'nothing'
    nothing.mkdir()
    out = tmp_path / 'report'
    name = 'identification: identification'
    quiet = {'axes': ['roll'], 'out': str(out)}
    bench.crew.start_node('quad_sysid', 'identification', quiet, called='quiet')
    bench.until(name, OK, 'waiting')
    bench.say_bag(tmp_path / 'no_such_bag')
    bench.until(name, ERROR, 'no_such_bag: no such bag')
    # Two at once: the second waits for the first.
    bench.say_bag(nothing)
    bench.say_bag(flown)
    values = bench.until(name, OK, 'auto_update is off')
    assert values['bag'] == str(flown)
    assert (out / 'report.json').exists()
    assert bench.observer.updates == []

    bench.crew.stop('quiet')
    bench.observer.diagnostics.clear()
    told = {**quiet, 'auto_update': True}
    bench.crew.start_node('quad_sysid', 'identification', told, called='told')
    values = bench.until(name, OK, 'gains: sent')
    assert values['report'] == str(tmp_path / 'report.1' / 'report.json')
    bench.observer.wait_for('update', 'gains', lambda: bool(bench.observer.updates), PATIENCE_S)
    sent = bench.observer.updates[-1]
    assert {'roll.angle.kp', 'roll.rate.kp', 'source'} <= set(sent)
    assert str(flown) in str(sent['source'])
