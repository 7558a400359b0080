"""The excitation node as a process: topics, services, diagnostics, its end.

The test stands in for the aircraft and owns the clock (quad_bridge/lockstep.py): the node is told
the time cycle by cycle, and it does not matter how long it takes over one.
"""

import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock, call

import pytest
from node_process import Started
from probe import Probe, content, entries, event, stamp

from quad_bridge.lockstep import START_NS, VARIABLE
from quad_bridge.virtual.line import Line
from quad_sysid.excitation_node import ExcitationNode

SCHEDULE = """
schedule:
  ramp_s: 0.1
  segments:
    - {segment: idle, duration_s: 0.8}
    - {segment: train, signal: prbs, axis: pitch, duration_s: 1.0, clock_s: 0.1, register_bits: 5}
    - {segment: idle, duration_s: 0.5}
"""
LONG = """
schedule:
  ramp_s: 0.1
  segments:
    - {segment: train, signal: prbs, axis: pitch, duration_s: 60.0, clock_s: 0.1, register_bits: 5}
    - {segment: validation, signal: square, axis: pitch, duration_s: 1.0, period_s: 0.5}
"""
CYCLE_NS = 4_000_000
SETPOINT = '/excitation/setpoint'
UPRIGHT = {'w': 1.0, 'x': 0.0, 'y': 0.0, 'z': 0.0}


class Aircraft:
    """Tells the time, publishes what the guard wants to see, and records what the node says."""

    def __init__(self, probe: Probe, folder: Path) -> None:
        self.probe, self.path = probe, folder / 'line'
        self.line = Line(self.path)
        self.cycle = 0
        self.failsafe, self.silent = 0, False
        self.aux, self.volts = [-1.0] * 5, 0.0
        self.events = probe.listen('/excitation/segment')
        self.heard = probe.listen(SETPOINT)
        self.told = probe.listen('/diagnostics')
        for topic in ('/imu/data', '/rc/in', '/battery', '/diagnostics', '/excitation/applied',
                      '/excitation/segment'):
            probe.advertise(topic)

    @property
    def now_ns(self) -> int:
        return START_NS + self.cycle * CYCLE_NS

    @property
    def segments(self) -> list[dict[str, Any]]:
        return [content(event) for event in list(self.events)]

    @property
    def setpoints(self) -> list[tuple[float, float, float]]:
        return [(m.vector.x, m.vector.y, m.vector.z) for m in list(self.heard)]

    @property
    def state(self) -> dict[str, str]:
        said = entries(self.told).get('excitation: schedule')
        return {} if said is None else said.values

    def step(self, cycles: int = 1) -> None:
        """Let so many cycles' time pass at once, as soon as the node is ready for it."""
        self.line.attend(0.0 if self.line.ready else 0.005)
        if not self.line.ready:
            return
        self.cycle += cycles
        self.line.tell(self.now_ns)
        if self.cycle % 5 == 0 or cycles > 1:
            self.publish()

    def leap(self, cycles: int) -> None:
        """Let so many cycles' time pass at once, however long the node takes to be ready."""
        before = self.cycle

        def done() -> bool:
            self.step(cycles)
            return self.cycle > before

        self.probe.until(done, 'the node is ready', pause_s=0.0)

    def publish(self) -> None:
        axes = [0.0, 0.0, 0.5, 0.0, *self.aux]
        self.probe.publish('/rc/in', {'axes': axes, 'buttons': [self.failsafe]})
        if self.volts:
            self.probe.publish('/battery', {'voltage': self.volts})
        if not self.silent:
            header = stamp(self.now_ns)
            self.probe.publish('/imu/data', {'header': header, 'orientation': UPRIGHT})
            self.line.published['/imu/data'] = self.now_ns

    def flags(self, told: str) -> None:
        values = [{'key': 'flags of the STM32', 'value': told}]
        self.probe.deliver('/diagnostics', {'status': [
            {'name': 'serial_bridge: excitation', 'values': values}]})

    def until(self, condition: Callable[[], object], what: object = '') -> None:
        def met() -> object:
            found = condition()
            if not found:
                self.step()
            return found

        self.probe.until(met, what, pause_s=0.0)

    def until_state(self, state: str) -> None:
        self.until(lambda: self.state.get('state') == state, state)

    def until_taken_back(self) -> None:
        self.probe.until(lambda: self.segments[-1]['segment'] == 'idle')
        self.probe.until(lambda: self.setpoints[-1] == (0.0, 0.0, 0.0))

    def call(self, service: str) -> Any:
        answer = self.probe.ask(service)
        self.until(answer.done, service)
        return answer.result()


@pytest.fixture
def aircraft(probe: Probe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Aircraft]:
    aircraft = Aircraft(probe, tmp_path)
    monkeypatch.setenv(VARIABLE, str(aircraft.path))
    yield aircraft
    aircraft.line.close()


@pytest.fixture
def fly(
    aircraft: Aircraft, start: Callable[..., Started], tmp_path: Path
) -> Callable[..., Started]:
    """Start the node on a schedule; on return it takes part and hears the aircraft."""

    def begin(schedule: str = SCHEDULE, **parameters: Any) -> Started:
        file = tmp_path / 'schedule.yaml'
        file.write_text(schedule)
        process = start('excitation', schedule=file, **parameters)
        topics = ('/imu/data', '/rc/in')

        def there() -> bool:
            assert process.poll() is None, process.said
            aircraft.line.attend(0.0)
            return bool(aircraft.line.names and all(map(aircraft.probe.listeners, topics)))

        aircraft.probe.until(there, 'the node')
        return process

    return begin


def test_of_two_nodes_that_excite_the_second_does_not_start(aircraft, fly):
    aircraft.probe.advertise(SETPOINT)
    fly(LONG)  # without a battery's voltage it would not start anyway
    aircraft.until(lambda: f'another node publishes {SETPOINT} too' in aircraft.call(
        '/excitation/start').message)


def test_what_keeps_it_from_starting_and_what_ends_it(aircraft, fly):
    process = fly(LONG, battery_min_v=10.2)
    aircraft.until_state('ready')
    assert not aircraft.setpoints
    aircraft.aux[1] = 1.0  # aux 2 arms on the project's own board: it is no abort switch

    def refused(words: str) -> None:
        answer = aircraft.call('/excitation/start')
        assert (answer.success, words in answer.message) == (False, True), answer.message

    def begin(setpoints: int = 20) -> None:
        aircraft.until(lambda: aircraft.call('/excitation/start').success)
        begun = len(aircraft.heard)
        aircraft.until(lambda: len(aircraft.heard) > begun + setpoints)

    def ended(words: str) -> None:
        aircraft.until(lambda: words in aircraft.state['reason'], words)
        aircraft.until_state('aborted')
        aircraft.until(lambda: aircraft.segments[-1].get('reason'))
        assert aircraft.segments[-1]['signal'] == 'none'
        aircraft.until_taken_back()

    refused('no voltage on /battery yet')
    aircraft.volts = 11.5
    begin()
    aircraft.failsafe = 1
    ended('failsafe')
    refused('failsafe')
    aircraft.failsafe = 0
    begin(200)  # what the STM32 refused before the start counts no more
    aircraft.flags('armed excitation_refused')
    ended('the STM32 refuses the excitation')
    aircraft.flags('armed')
    other = {'segment': 'train', 'signal': 'prbs', 'axis': 'roll', 'injection': 'attitude'}
    begin(200)
    late = event(other) | {'stamp': vars(aircraft.events[-1].stamp)}  # begun in the same cycle
    aircraft.probe.deliver('/excitation/segment', event(other, START_NS))  # as from a bag
    aircraft.probe.deliver('/excitation/segment', late)
    ended('another node publishes /excitation/segment too')
    begin()
    aircraft.aux[2] = 1.0
    ended('abort switch')
    aircraft.aux[2] = -1.0
    begin()
    aircraft.silent = True
    ended('/imu/data is 0.2')
    aircraft.silent = False
    begin()
    process.send(signal.SIGTERM)
    aircraft.until(lambda: process.poll() is not None, 'its end')
    assert process.poll() == 0
    aircraft.until_taken_back()


def test_a_standstill_of_the_node_itself_is_no_stale_link(aircraft, fly):
    process = fly(autostart=True, exit_when_done=True, imu_stale_s=0.4)
    aircraft.until(lambda: len(aircraft.heard) > 20)
    aircraft.leap(150)  # 0.6 s without a word, as after SIGSTOP
    aircraft.until(lambda: process.poll() is not None, 'its end')
    aircraft.probe.until(lambda: aircraft.state.get('state') in {'done', 'aborted'})
    assert 'stood still for 0.60 s' in process.said
    assert aircraft.state['reason'] == 'the schedule is complete'


def test_a_slow_schedule_looks_at_the_angles_with_each_set_point():
    node = MagicMock(_ticks=0, **{'_settings.rate_hz': 20, '_stall.stood_still_s': 0.0})
    for _ in range(4):
        ExcitationNode._tick(node)
    assert node._readings.mock_calls == 4 * [call(decode_angles=True)]


BROKEN = """
from quad_sysid.signals.player import Player
def broken(*_): raise ArithmeticError('as the test wants')
Player.stop = broken
"""


def test_a_callback_that_fails_ends_the_excitation_and_a_service_answers(aircraft, fly):
    process = fly(LONG, broken=BROKEN)
    aircraft.until_state('ready')
    assert aircraft.call('/excitation/start').success
    aircraft.until(lambda: len(aircraft.heard) > 20)
    answer = aircraft.call('/excitation/stop')
    assert (answer.success, answer.message) == (False, 'the service failed: as the test wants')
    aircraft.until_state('aborted')
    assert aircraft.state['reason'] == 'a callback failed: ArithmeticError: as the test wants'
    aircraft.until_taken_back()
    assert process.poll() is None
