"""The bridge's process and the firmware's, on a pty and over a signed link.

The firmware is built with the sanitizers; a fault of theirs ends it.
"""

import os
import signal
import time
from pathlib import Path

import pytest
from flight_controller import Device, Pty, Relay
from node_process import ended, program
from probe import event, stamp_ns

from quad_bridge.key_file import write_key
from quad_bridge.virtual.native import VARIABLE
from quad_bridge.wire import frames as f
from quad_bridge.wire.codec import Encoder

TRAIN = event({'segment': 'train', 'signal': 'prbs', 'axis': 'roll', 'injection': 'rate'})
SETPOINT = {'vector': {'x': 0.25}}
HELD = {'frame_id': 'operator'}
OLD = {'stamp': {'sec': 1_000_000_000, 'nanosec': 1}}
"""The time of a recording."""
LASTS_NS = 10**9
"""A set-point counts for 0.1 s of the firmware's time, which a busy machine stretches."""
GAINS, EXCITATION = 'serial_bridge: gains', 'serial_bridge: excitation'


class Rig:
    """The C process, the bridge, and what the probe hears of them."""

    def __init__(self, host, folder, run, start, probe):
        self.path, self.folder, self.probe = host, folder, probe
        self.run, self.start, self.port = run, start, folder / 'stm32'
        self.imu, self.applied, self.told = (
            probe.listen(topic) for topic in ('/imu/data', '/excitation/applied', '/gains/active')
        )

    def start_host(self, *options):
        command = (*program('virtual_stm32'), '--link', self.port, *options)
        environment = {**os.environ, VARIABLE: str(self.path.parent)}
        self.host = self.run(*command, env=environment)
        self.host.until(lambda: 'virtual STM32 on' in self.host.printed)

    def says(self, name, words, *, since_ns=0):
        told = self.probe.diagnostics
        self.probe.until(lambda: words in told(name, since_ns=since_ns), words)

    def end_host(self):
        """What it counted; a fault of the sanitizers would show in its status."""
        assert self.host.end(signal.SIGTERM) == 0, self.host.said
        words = self.host.printed.splitlines()[-1].split()
        return {words[i]: int(words[i + 1]) for i in range(0, len(words), 2)}


@pytest.fixture
def rig(firmware, tmp_path, run, start, probe):
    (tmp_path / 'rig').mkdir()
    return Rig(firmware('checked/quad_firmware'), tmp_path / 'rig', run, start, probe)


def ended_and_stays_so(rig):
    """No excitation is added once the last set-point's time is over, in half a second of cycles.

    By stamps, which are of this machine's clock: what was added before may be heard late."""
    now_ns = time.time_ns() + LASTS_NS
    rig.probe.until(lambda: stamp_ns(rig.imu[-1]) > now_ns + 5 * 10**8, 'half a second of cycles')
    assert stamp_ns(rig.applied[-1]) < now_ns


def test_of_a_signed_link_only_the_key_commands_and_only_while_the_operator_holds(rig, probe):
    key = rig.folder / 'key'
    write_key(key)
    profile = rig.folder / 'disarmed.yaml'
    profile.write_text('extends: plain\nfirmware: {auto_arm: false}\n')
    rig.start_host('--key', key, '--profile', profile)
    with Relay(Device(rig.port), Pty(rig.folder / 'line')) as line:
        fly_and_intrude(rig, probe, line, key)
    counts = rig.end_host()
    assert counts['unsigned'] == 1
    assert counts['replayed'] > 5
    assert counts['forged'] == 0


def lets_go(rig):
    now_ns = time.time_ns()
    rig.probe.silence('/operator/enable')
    rig.says(EXCITATION, 'silent', since_ns=now_ns)


def fly_and_intrude(rig, probe, line, key):
    device, end = line.ends
    rig.start('serial_bridge', port=end.link, key_file=key, state_folder=rig.folder / 'state',
              require_enable='true')
    probe.meet('/gains/update', '/excitation/segment', '/excitation/setpoint', '/operator/enable')
    probe.until(lambda: len(rig.imu) > 100, 'cycles')
    probe.until(lambda: rig.told, 'parameters')

    # the operator
    arm = ('/serial_bridge/arm', 'std_srvs/srv/SetBool')
    answer = probe.call(*arm, data=True)
    assert (answer.success, '/operator/enable is silent' in answer.message) == (False, True)
    probe.publish('/operator/enable', {**HELD, **OLD}, every_s=0.02)  # as from a bag
    probe.until(lambda: 'its stamp is' in probe.call(*arm, data=True).message)
    probe.publish('/operator/enable', HELD, every_s=0.02)
    probe.until(lambda: 'armed already' in probe.call(*arm, data=True).message)
    lets_go(rig)
    probe.say_until(lambda: '/operator/enable is silent' in probe.diagnostics(GAINS),
                    '/gains/update', event({'source': 'test', 'roll.rate.kp': 0.08}))
    probe.publish('/excitation/segment', TRAIN)
    probe.publish('/excitation/setpoint', SETPOINT, every_s=0.01)
    rig.says(EXCITATION, 'dropped: /operator/enable is silent')
    assert not rig.applied
    probe.publish('/operator/enable', HELD, every_s=0.02)
    probe.say_until(lambda: len(rig.applied) > 50, '/excitation/segment', TRAIN)
    # a bag that is played beside it
    probe.publish('/excitation/setpoint', {**SETPOINT, 'header': OLD}, every_s=0.01)
    probe.publish('/excitation/segment', {**TRAIN, **OLD})
    probe.publish('/gains/update', {**event({'source': 'bag', 'roll.rate.kp': 0.1}), **OLD})
    rig.says(EXCITATION, 'dropped: its stamp is')
    rig.says(GAINS, 'gains of bag refused: its stamp is')
    ended_and_stays_so(rig)
    probe.publish('/excitation/setpoint', SETPOINT, every_s=0.01)
    lets_go(rig)
    probe.publish('/operator/enable', HELD, every_s=0.02)
    rig.says(EXCITATION, 'has released the enable')
    ended_and_stays_so(rig)

    # intruders: what was said before, and what bears no signature
    recorded = bytes(line.heard[-2000:])
    recorded = recorded[recorded.index(b'\xfd') :]
    for data in (Encoder(1, 191).encode(f.ParamSet('ROLL_RATE_KP', 0.5, 1, 1)), recorded):
        while data := data[device.write(data) :]:  # as fast as the firmware reads
            time.sleep(0.001)
    heard = len(rig.imu)
    probe.until(lambda: len(rig.imu) > heard + 250)
    for name in ('refused, unsigned', 'refused, other key'):
        assert probe.diagnostics('serial_bridge: link', name) == '0'


def test_it_takes_the_place_of_a_killed_ones_link_and_of_nothing_else(rig):
    rig.port.symlink_to('/dev/pts/of_a_killed_one')
    rig.start_host('--duration', '60')
    assert str(rig.port.readlink()).startswith('/dev/pts/')
    assert rig.port.exists()
    rig.port.unlink()
    rig.port.symlink_to('/dev/pts/of_another')  # that one's link stays
    rig.end_host()
    assert rig.port.is_symlink()
    rig.port.unlink()
    rig.port.write_text('mine')
    told = ended(*program('virtual_stm32'), '--link', rig.port)
    assert (told.returncode, told.stderr) == (
        2, f'virtual_stm32: {rig.port}: exists and is not a symbolic link\n')
    assert rig.port.read_text() == 'mine'
    assert list(rig.folder.iterdir()) == [rig.port]


def test_the_firmware_ends_with_its_simulation_and_the_simulation_with_it(rig):
    rig.start_host()
    firmware = child_of(rig.host.pid)
    rig.host.kill()
    rig.probe.until(lambda: not rig.port.is_symlink() and not Path(f'/proc/{firmware}').exists())
    rig.start_host()
    os.kill(child_of(rig.host.pid), signal.SIGKILL)
    assert rig.host.wait() == 1
    assert rig.host.said == 'virtual_stm32: the firmware ended with status -9\n'


def child_of(number):
    (child,) = Path(f'/proc/{number}/task/{number}/children').read_text().split()
    return int(child)
