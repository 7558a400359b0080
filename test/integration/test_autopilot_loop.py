"""The loop on PX4 and ArduPilot through processes: excite, log, fetch, identify, send, watch.

The stand-ins of flying_autopilot.py fly in lockstep behind a pseudo-terminal; nodes, services and
topics are the real ones. Faults and refusals are test_autopilots.py's. A trial lasts some seconds,
and a second call to disarm must come within two of simulated time: it passes only while the test
waits (campaign.Turns).
"""

import json
import sys
from pathlib import Path

import pytest
from campaign import Turns

from quad_sysid.bags import read_bag
from quad_tuning.demo.processes import Crew

pytestmark = [pytest.mark.timeout(1800), pytest.mark.usefixtures('workspace')]
STAND_IN = Path(__file__).resolve().parents[1] / 'flying_autopilot.py'
SET_BOOL = 'std_srvs/srv/SetBool'
SCHEDULES = {
    'px4': """
schedule:
  mount: hover
  ramp_s: 0.3
  segments:
    - {segment: idle, duration_s: 1.0}
    - {segment: train, signal: prbs, axis: roll, injection: attitude, amplitude_deg: 8.0,
       duration_s: 14.0, clock_s: 0.092, register_bits: 9, seed: 1}
    - {segment: validation, signal: prbs, axis: roll, injection: attitude, amplitude_deg: 8.0,
       duration_s: 6.0, clock_s: 0.092, register_bits: 8, seed: 2}
    - {segment: idle, duration_s: 1.0}
""",
    'ardupilot': """
schedule:
  mount: hover
  ramp_s: 0.5
  segments:
    - {segment: idle, duration_s: 1.0}
    - {segment: train, signal: chirp, axis: roll, injection: control, amplitude: 0.06,
       duration_s: 26.0, f0_hz: 0.8, f1_hz: 8.0}
    - {segment: idle, duration_s: 2.5}
""",
}
GAIN = 2 * 9.218 * 0.225 * 2**0.5 / 0.0135
"""Of the virtual aircraft about roll: rad/s² per U2."""


@pytest.mark.long  # minutes each
@pytest.mark.parametrize('name', SCHEDULES)
def test_the_loop_closes(name, tmp_path, ros_domain, probe):
    (tmp_path / 'schedule.yaml').write_text(SCHEDULES[name])
    told = probe.listen('/diagnostics')
    with Crew(tmp_path, ros_domain, lockstep=True) as crew:
        port, turns = tmp_path / 'tty', Turns(crew, probe)
        crew.start('autopilot', [sys.executable, STAND_IN, name, '--link', port, '--lockstep',
                                 crew.socket, '--hz', '125'])  # fmt: skip
        probe.until(lambda: crew.check('start') or port.exists(), 'the stand-in')
        bridge = {'port': str(port), 'state_folder': str(tmp_path / 'state'), 'gains': 'allow',
                  'excitation': 'allow'}  # fmt: skip
        crew.start_node('quad_bridge', 'serial_bridge', bridge)
        crew.start_node('quad_bridge', 'bag_logger', {'folder': str(tmp_path), 'prefix': 'flight'})
        schedule = {'schedule': str(tmp_path / 'schedule.yaml'), 'abort_aux': 0}
        crew.start_node('quad_sysid', 'excitation', schedule)
        crew.start_node('quad_sysid', 'identification', {
            'folder': str(tmp_path), 'axes': ['roll']})

        def until(node, words, key=''):
            def there():
                crew.check(node)
                told[:-40] = []
                return words in probe.diagnostics(node, key)

            turns.until(there, f'{node}: {words}')

        def killed(node):
            """What it has begun ends without it."""
            crew.children[node].process.kill()
            crew.children[node].process.wait()
            crew.children[node].ended = True

        def fly(up):
            answer = turns.call('/serial_bridge/arm', SET_BOOL, data=up)
            if not up:
                answer = turns.call('/serial_bridge/arm', SET_BOOL, data=up)  # it flies: again
            assert answer.success, answer.message

        until('serial_bridge: gains', 'it is not armed')
        fly(True)
        assert turns.call('/bag_logger/start').success
        until('serial_bridge: gains', 'read back')
        if name == 'px4':  # in OFFBOARD nobody excites any more: the pilot's mode is given back
            assert turns.call('/excitation/start').success
            until('serial_bridge: excitation', 'running')
            killed('excitation')
            until('serial_bridge: excitation', 'schedule has been silent')
            crew.start_node('quad_sysid', 'excitation', schedule)
            until('excitation: schedule', 'ready', 'state')
            until('serial_bridge: gains', 'read back')
        turns.until(lambda: turns.call('/excitation/start').success, 'its first /imu/data')
        until('excitation: schedule', 'done', 'state')
        fly(False)
        assert turns.call('/bag_logger/stop').success
        until('identification: identification', 'done', 'state')
        report = Path(probe.diagnostics('identification: identification', 'report'))
        tree = json.loads(report.read_text())
        assert tree['bags'][0].endswith('_log')  # the autopilot's own log was the better half
        record = read_bag(Path(tree['bags'][0]))
        assert record.dt == pytest.approx(0.004)
        base = {p['name']: p['value'] for p in tree['axes']['roll']['base']['parameters']}
        assert base['gain'] == pytest.approx(GAIN, rel=0.1)
        gains = tree['axes']['roll']['gains']
        assert gains

        fly(True)
        until('serial_bridge: gains', 'read back')
        (history,) = (tmp_path / 'state').glob('*/gains.jsonl')
        if name == 'ardupilot':  # killed during the trial: the next bridge takes it back
            probe.set_gains(gains)
            until('serial_bridge: gains', 'watching')
            killed('serial_bridge')
            crew.start_node('quad_bridge', 'serial_bridge', bridge)
            until('serial_bridge: gains', 'found a trial of an earlier bridge')
            trial = json.loads(history.with_name('trial.json').read_text())
            assert 'trial' not in trial
        answer = turns.answer(probe.set_gains(gains)).result
        while 'does not hover' in answer.reason:  # a bridge that has begun wants 2 s of calm
            turns.rest(0.4)
            answer = turns.answer(probe.set_gains(gains)).result
        assert answer.successful or 'on trial' in answer.reason, answer.reason
        turns.until(lambda: '"confirmed"' in history.read_text(), 'watch')
        fly(False)
