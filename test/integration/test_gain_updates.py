"""Gains through the bridge, a pty and the virtual STM32: updates, refusals, the way back.

Faults of the line and bad sets are flown in test_gain_flights.py; here the processes,
the topics, the parameters and the services are the real ones. Time stands still while a test acts,
and passes in small steps while it waits.
"""

from __future__ import annotations

import json
import math
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from node_process import Started
from probe import Probe, content, event

from quad_bridge.lockstep import VARIABLE
from quad_sysid.loop.cascade import CascadeGains
from quad_sysid.model import AxisModel
from quad_sysid.model import Parameter as IdentifiedParameter
from quad_tuning.demo.processes import Crew
from quad_tuning.demo.stages import Aircraft
from quad_tuning.lqr import propose_lqr

pytestmark = [pytest.mark.timeout(1800), pytest.mark.usefixtures('workspace')]
KP, ANGLE = 'roll.rate.kp', 'roll.angle.kp'
OLD = {KP: 0.0744845, ANGLE: 3.0}
TURN_S = 0.4
"""So much simulated time passes between two looks of a test that waits."""


class Bench:
    """The aircraft's process and the bridge's, and the probe that wants gains."""

    def __init__(self, crew: Crew, probe: Probe):
        self.crew, self.probe = crew, probe
        crew.clock.hold()
        self.told = probe.listen('/diagnostics')
        self.heard = probe.listen('/gains/active')
        probe.advertise('/gains/update')
        self.state = crew.folder / 'state'
        self.stm32 = crew.folder / 'stm32'

    def start(self, **settings):
        aircraft = Aircraft('plain', 'roll', 1, 'rig')
        self.crew.start('virtual_stm32', aircraft.command(self.stm32, self.crew.socket))
        self.probe.until(lambda: self.crew.check('start') or self.stm32.exists())
        self.start_bridge(**settings)

    def start_bridge(self, **settings):
        own = {'port': str(self.stm32), 'state_folder': str(self.state), 'aircraft': 'test'}
        own |= settings
        self.crew.start_node('quad_bridge', 'serial_bridge', own)
        self.said('read back')
        self.until(lambda: self.probe.listeners('/gains/update'), 'a bridge')
        self.rest(2.5)

    def rest(self, seconds):
        """Let simulated time pass."""
        clock = self.crew.clock
        end_s = clock.now_s() + seconds
        clock.release()
        self.probe.until(
            lambda: self.crew.check('bench') or clock.now_s() >= end_s, 'time', pause_s=0.001
        )
        clock.hold()
        self.probe.listeners('/gains/update')  # it has heard what there was to hear

    def until(self, condition, what):
        def met():
            found = condition()
            if not found:
                self.rest(TURN_S)
            return found

        self.probe.until(met, what)

    def said(self, words):
        """Wait for words about gains in the diagnostics since the last request."""

        def heard():
            return [s for array in list(self.told) for s in array.status
                    if s.name == 'serial_bridge: gains']

        def there():
            return [s.message for s in heard() if words in s.message]

        try:
            self.until(there, words)
        except AssertionError as never:
            told = {s.message for s in heard()}
            raise AssertionError(f'{never}; heard: {told}; history: {self.history()}') from never
        return there()[-1]

    @property
    def active_gains(self):
        return {k: v for heard in list(self.heard) for k, v in content(heard).items()}

    def active(self, wanted):
        """Wait until /gains/active says these."""

        def so():
            told = self.active_gains
            return all(abs(told.get(n, math.inf) - v) < 1e-5 for n, v in wanted.items())

        self.until(so, wanted)

    def ask(self, *sets, source='test'):
        self.told.clear()
        now_ns = self.crew.clock.now_ns()
        said = (event({**one, 'source': source}, now_ns) for one in sets)
        self.probe.publish('/gains/update', *said)

    def set(self, name, value):
        """What the bridge's service answers."""
        answer = self.probe.set_gains({name: value})
        self.until(answer.done, 'the answer')
        return answer.result().result

    def quad_tune(self, *words: object, gives: dict[str, float]) -> str:
        """Run a command that gives these gains; what it prints.

        Time passes until the bridge has answered, and stands still then: new gains are watched for
        10 s only.
        """
        environment = {**os.environ, VARIABLE: str(self.crew.socket)}
        command = [sys.executable, '-m', 'quad_tuning.cli', *words]
        done = Started(command, self.crew.folder / 'quad_tune', env=environment)

        self.active(gives)
        self.probe.until(lambda: done.poll() is not None, 'its end')
        assert (done.poll(), done.said) == (0, '')
        return done.printed

    def history(self):
        lines = (self.state / 'test' / 'gains.jsonl').read_text().splitlines()
        return [json.loads(line) for line in lines]


def paper_model():
    """Roll of the virtual aircraft on the rig, as an identification would hand it on."""
    base = (('gain', 435.0, 4.0), ('lag', 0.043, 5e-4), ('delay', 0.008, 4e-4),
            ('damping', 0.4, 0.05), ('bias', 0.0, 0.02))
    return AxisModel(
        axis='roll', dt=0.004, gyro_filter_hz=42.0,
        base=tuple(IdentifiedParameter(*one, '') for one in base),
        parameter_names=tuple(name for name, *_ in base),
        covariance=np.diag([std**2 for *_, std in base]),
        active_gains=CascadeGains.default('roll').to_mapping('roll', constants=True),
    )


@pytest.fixture
def bench(tmp_path: Path, ros_domain: int, probe: Probe) -> Iterator[Bench]:
    with Crew(tmp_path, ros_domain, lockstep=True) as crew:
        yield Bench(crew, probe)


def test_updates_parameters_services_a_killed_bridge_and_the_second_control_mode(bench, tmp_path):
    bench.start(polarity='manual', sources=['test', 'a flood', '~/set_gains', 'quad-tune*'])
    bench.ask({KP: 0.1})
    bench.said('call ~/check_polarity')
    answer = bench.probe.ask('/serial_bridge/check_polarity')
    bench.until(answer.done, 'the check')
    assert answer.result().message == 'roll right; pitch silent; yaw silent'
    bench.rest(1.0)

    bench.ask({KP: 0.1}, source='a stranger')
    bench.said('gains of a stranger refused: the source is not allowed')
    bench.ask({KP: 0.1, ANGLE: 4.0})
    bench.active({KP: 0.1, ANGLE: 4.0})
    bench.ask(*({ANGLE: 5.0 + 0.01 * k} for k in range(200)), source='a flood')
    bench.said('gains of a flood refused: an earlier update is in flight')
    refused = bench.set(ANGLE, 5.0)
    bench.told.clear()
    assert not refused.successful
    assert 'in flight' in refused.reason
    bench.ask({KP: 0.1}, source='a stranger')  # the last of this publisher: the flood is over
    bench.said('gains of a stranger refused')
    bench.told.clear()
    told = bench.quad_tune('rollback', '--folder', bench.state, gives=OLD)
    assert 'back to set 1 of' in told
    bench.said('rolled back, old gains: quad-tune rollback asked for it')
    bench.active(OLD)

    for bad, words in ((math.nan, 'finite'), (99.0, 'must lie in')):
        assert words in bench.set(ANGLE, bad).reason
    assert bench.set(ANGLE, 5.0).successful
    bench.active({ANGLE: 5.0})

    bridge = bench.crew.children['serial_bridge']
    bridge.process.send_signal(signal.SIGKILL)
    bridge.process.wait()
    bridge.ended = True
    bench.heard.clear()
    bench.told.clear()
    bench.rest(2.5)
    bench.start_bridge(sources=['test', 'quad-tune*'], polarity='off')
    bench.active({ANGLE: 3.0})
    sets = [entry['gains'][ANGLE] for entry in bench.history() if 'gains' in entry]
    assert sets == [3.0, 4.0, 3.0, 5.0, 3.0]

    # the second control mode comes in by quarters and goes back at once
    design = tmp_path / 'gains.json'
    proposal = propose_lqr(paper_model())
    axes = {'roll': {'gains': proposal.gains, 'figures': proposal.figures}}
    design.write_text(json.dumps({'schema': 'quad_tuning/design/1', 'axes': axes}))
    bench.quad_tune('send', design, gives={'roll.lqr.share': 1.0})
    sets = [entry['gains'] for entry in bench.history() if 'gains' in entry][4:]
    shares = [gains['roll.lqr.share'] for gains in sets]
    assert shares[:3] == pytest.approx([0.0, 0.25, 0.5], rel=1e-3)
    assert (shares[-1], max(shares)) == (1.0, 1.0)
    assert sets[1]['roll.lqr.k_angle'] == pytest.approx(proposal.gains['roll.lqr.k_angle'])
    bench.ask({'rollback': True})
    bench.said('rolled back, old gains')
    bench.active({'roll.lqr.share': 0.0})
