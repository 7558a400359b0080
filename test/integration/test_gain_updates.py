"""Gains through the bridge, a pty and the virtual STM32: updates, refusals, the way back.

Faults of the line and bad sets are flown in test_gain_flights.py; here the processes,
the topics, the parameters and the services are the real ones. Time stands still while a test acts,
and passes in small steps while it waits.
"""

import json
import math
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from campaign import Turns
from probe import Probe, content, event

from quad_tuning.demo.processes import Crew
from quad_tuning.demo.stages import Aircraft

pytestmark = [pytest.mark.timeout(1800), pytest.mark.usefixtures('workspace')]
KP, ANGLE = 'roll.rate.kp', 'roll.angle.kp'
OLD = {KP: 0.0744845, ANGLE: 3.0}


class Bench(Turns):
    """The aircraft's process and the bridge's, and the probe that wants gains."""

    def __init__(self, crew: Crew, probe: Probe):
        super().__init__(crew, probe)
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

    def said(self, words):
        """Wait for words about gains in the diagnostics since the last request."""
        self.until(lambda: [s for array in list(self.told) for s in array.status
                            if s.name == 'serial_bridge: gains' and words in s.message], words)

    def active(self, wanted):
        def so():
            told = {k: v for heard in list(self.heard) for k, v in content(heard).items()}
            return all(abs(told.get(n, math.inf) - v) < 1e-5 for n, v in wanted.items())

        self.until(so, wanted)

    def ask(self, *sets, source='test'):
        self.told.clear()
        now_ns = self.crew.clock.now_ns()
        said = (event({**one, 'source': source}, now_ns) for one in sets)
        self.probe.deliver('/gains/update', *said)  # before time goes on

    def set(self, name, value):
        """What the bridge's service answers."""
        return self.answer(self.probe.set_gains({name: value})).result

    def history(self):
        lines = (self.state / 'test' / 'gains.jsonl').read_text().splitlines()
        return [json.loads(line) for line in lines]


@pytest.fixture
def bench(tmp_path: Path, ros_domain: int, probe: Probe) -> Iterator[Bench]:
    with Crew(tmp_path, ros_domain, lockstep=True) as crew:
        yield Bench(crew, probe)


def test_updates_parameters_services_and_a_killed_bridge(bench):
    bench.start(polarity='manual', sources=['test', 'a flood', '~/set_gains'])
    bench.ask({KP: 0.1})
    bench.said('call ~/check_polarity')
    answer = bench.call('/serial_bridge/check_polarity')
    assert answer.message == 'roll correct; pitch does not respond; yaw does not respond'
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
    bench.ask({'rollback': True})
    bench.said('rolled back, old gains: test asked for it')
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
    bench.start_bridge(sources=['test'], polarity='off')
    bench.active({ANGLE: 3.0})
    sets = [entry['gains'][ANGLE] for entry in bench.history() if 'gains' in entry]
    assert sets == [3.0, 4.0, 3.0, 5.0, 3.0]
