"""The virtual STM32 over the codec and over a real pty: what test_firmware_endpoint.py has not."""

from __future__ import annotations

import math
import os
import select
import signal
import subprocess
import sys
from itertools import pairwise

import numpy as np
import pytest
from probe import PATIENCE_S
from virtual_aircraft import Endpoint

from quad_bridge.gains.protocol import checksum
from quad_bridge.gains.table import WIRE_NAMES
from quad_bridge.virtual import process as virtual_process
from quad_bridge.virtual.aircraft import Aircraft
from quad_bridge.virtual.process import main
from quad_bridge.virtual.profile import Profile
from quad_bridge.virtual.receiver import Event, Receiver
from quad_bridge.wire import Decoder, Encoder
from quad_bridge.wire import frames as f


class Peer:
    """A bridge in miniature, in memory."""

    def __init__(self, *events: Event) -> None:
        self.endpoint = Endpoint(Aircraft(Profile(), seed=1), Receiver(events=events))
        self.encoder, self.decoder = Encoder(1, 191), Decoder()

    def ask(self, frame):
        now_ns = round(self.endpoint.aircraft.cycle * 4e6)
        return self.decoder.feed(self.endpoint.receive(self.encoder.encode(frame), now_ns))

    def fly(self, cycles: int):
        return [x for _ in range(cycles) for x in self.decoder.feed(self.endpoint.cycle())]

    def cycles(self, count: int) -> list[f.Cycle]:
        return only(self.fly(count), f.Cycle)


def only(frames, kind):
    return [x for x in frames if isinstance(x, kind)]


def test_gains_and_filters_are_float32_and_act_at_once():
    peer = Peer()
    (late,) = peer.ask(f.ParamSet('ROLL_RATE_KP', 0.06))
    assert late.value != float(np.float32(0.06))  # no copy is open: it came late, or from nobody
    peer.ask(f.GainsCommand(f.GainsAction.OPEN, 1))
    written = {'ROLL_RATE_KP': 0.06, 'GYRO_FILT_HZ': 20.0}
    for name, value in written.items():
        assert peer.ask(f.ParamSet(name, value))[0].value == float(np.float32(value))
    listed = [*peer.ask(f.ParamRequestList()), *peer.fly(40)]
    values = {x.name: x.value for x in only(listed, f.ParamValue)}
    copied = [values[name] for name in WIRE_NAMES.values()]
    peer.ask(f.GainsCommand(f.GainsAction.COMMIT, 1, checksum(copied), 9000))
    assert peer.endpoint.gain('roll.rate.kp') == float(np.float32(0.06))
    slow, fast = (np.std([c.gyro[1] for c in p.cycles(250)]) for p in (peer, Peer()))
    assert slow < 0.8 * fast


def test_axes_on_the_wire_are_frd_and_turn_back_to_flu():
    peer = Peer()
    peer.ask(f.Excitation((0.0, 0.1, -0.2), f.Injection.CONTROL, seq=1))
    (cycle,) = peer.cycles(1)
    assert cycle.excitation == pytest.approx((0.0, 0.1, -0.2))
    assert cycle.control[2] - 0.1 == pytest.approx(0.0, abs=0.02)
    assert cycle.accel[2] == pytest.approx(-9.81, abs=0.2)
    # FRD pitch torque +0.1 is FLU -0.1: the front motors 3, 4 push
    assert min(cycle.motors[2:]) > max(cycle.motors[:2]) - 0.45
    assert sum(cycle.motors[2:]) > sum(cycle.motors[:2])


def test_sticks_move_the_reference_and_the_channels_and_failsafe_centres_them():
    peer = Peer(Event(0.1, 'roll', 0.5), Event(0.3, 'failsafe', 1.0))
    frames = peer.fly(100)
    cycles, rc = only(frames, f.Cycle), only(frames, f.RcChannels)
    assert cycles[40].attitude_setpoint[0] == pytest.approx(math.radians(15.0))
    assert cycles[90].attitude_setpoint[0] == 0.0
    assert (rc[8].channels[0], len(rc[8].channels), rc[-1].rssi) == (1750, 9, 0)


# The process.


@pytest.fixture
def process(tmp_path):
    """Starts the process; it and what it has opened are ended afterwards."""
    link, started = tmp_path / 'stm32', []

    def start(*options):
        command = [sys.executable, '-m', 'quad_bridge.virtual.process', '--link', str(link)]
        started.append(subprocess.Popen(
            [*command, *options], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        ))  # fmt: skip
        return started[0], link

    yield start
    started[0].kill()
    started[0].communicate()


@pytest.fixture
def port(process):
    """The process, its link, and a function that reads frames until a condition holds."""
    running, link = process()
    while not link.is_symlink():
        assert running.poll() is None, running.communicate()
    number, decoder, frames = os.open(link, os.O_RDWR | os.O_NOCTTY), Decoder(), []

    def read(until):
        while not until(frames):
            assert select.select([number], [], [], 60.0)[0], 'the process is silent'
            frames.extend(decoder.feed(os.read(number, 65536)))
        assert decoder.counts.bad_crc == 0
        return frames

    read.running, read.link, read.number = running, link, number
    yield read
    os.close(number)


def ended(running, number):
    running.send_signal(number)
    _, errors = running.communicate(timeout=PATIENCE_S)
    return running.returncode, errors


def test_a_stalled_process_catches_up_without_losing_a_cycle(port):
    seen = len(only(port(lambda x: len(only(x, f.Cycle)) > 50), f.Cycle))
    os.kill(port.running.pid, signal.SIGSTOP)
    select.select([], [], [], 0.3)  # that it stands still for a while is all that matters
    os.kill(port.running.pid, signal.SIGCONT)
    cycles = only(port(lambda x: len(only(x, f.Cycle)) > seen + 200), f.Cycle)
    assert {(b.cycle - a.cycle, b.time_us - a.time_us) for a, b in pairwise(cycles)} == {(1, 4000)}
    assert ended(port.running, signal.SIGINT)[0] == 0


def test_the_process_does_not_block_when_nobody_reads(process):
    output, errors = process('--duration', '1.2')[0].communicate()
    assert errors == ''
    assert 'bytes dropped' in output


EFFECT = 'import numpy as np\ndef effect(t_s, rates, angles, thrusts, battery_v):\n    '


@pytest.fixture
def handlers():
    """The process takes the signals; they are given back afterwards."""
    kept = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in kept.items():
        signal.signal(number, handler)


@pytest.mark.usefixtures('handlers')
@pytest.mark.parametrize(
    ('source', 'said'),
    [
        (EFFECT + 'raise KeyError("x")\n', 'KeyError'),
        (EFFECT + 'return [1.0, 2.0]\n', 'three finite torques'),
        (EFFECT + 'return [np.nan, 0.0, 0.0]\n', 'three finite torques'),
        (EFFECT + 'return "up"\n', 'ValueError'),
        (EFFECT + 'raise SystemExit(5)\n', 'effect() at t = 0.000 s: SystemExit: 5'),
        ('import sys\nsys.exit(3)\n', 'SystemExit: 3'),
        ('x = 1\n', 'no function effect'),
        ('import nowhere_to_be_found\n', 'cannot be loaded'),
        (None, 'not a readable Python file'),
    ],
)
def test_a_bad_effect_module_is_one_line_and_status_2(tmp_path, capsys, source, said):
    path = tmp_path / 'bad.py'
    if source is not None:
        path.write_text(source, encoding='utf-8')
    status = main(['--effect-module', str(path), '--duration', '0.1'])
    error = capsys.readouterr().err
    assert (status, error.count('\n')) == (2, 1)
    assert str(path) in error
    assert said in error


@pytest.mark.usefixtures('handlers')
def test_an_effect_module_acts_in_the_process(tmp_path):
    path, seen = tmp_path / 'push.py', tmp_path / 'seen'
    path.write_text(
        f'calls = 0\n{EFFECT}global calls\n    calls += 1\n'
        f'    open({str(seen)!r}, "w").write(str(calls))\n    return np.array([0.1, 0, 0])\n',
        encoding='utf-8',
    )
    assert main(['--effect-module', str(path), '--duration', '0.2']) == 0
    assert int(seen.read_text(encoding='utf-8')) == 200


@pytest.mark.usefixtures('handlers')
def test_an_interrupt_while_it_prepares_is_one_line(capsys, monkeypatch):
    def interrupted(*_given, **_named):
        raise KeyboardInterrupt

    monkeypatch.setattr(virtual_process, 'prepared', interrupted)
    assert main([]) == 130
    assert capsys.readouterr().err == 'virtual_stm32: interrupted\n'
