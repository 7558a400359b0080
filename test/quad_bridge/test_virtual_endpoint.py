"""The virtual STM32 over the codec and over a real pty: parameters, excitation, pilot, process."""

from __future__ import annotations

import itertools
import math
import os
import select
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

from quad_bridge.virtual.aircraft import Aircraft
from quad_bridge.virtual.endpoint import NAMES, Endpoint
from quad_bridge.virtual.process import main
from quad_bridge.virtual.profile import Profile
from quad_bridge.virtual.receiver import Event, Receiver
from quad_bridge.wire import Decoder, Encoder
from quad_bridge.wire.frames import (
    Battery,
    Command,
    CommandAck,
    Cycle,
    Excitation,
    Flag,
    Heartbeat,
    Injection,
    ParamRequestList,
    ParamRequestRead,
    ParamSet,
    ParamValue,
    RcChannels,
    SlowSensors,
    StatusText,
    TimeSync,
)
from quad_bridge.wire.gain_names import CONTRACT_NAMES


class Peer:
    """A bridge in miniature, in memory."""

    def __init__(self, *events: Event, profile: Profile | None = None) -> None:
        self.endpoint = Endpoint(Aircraft(profile or Profile(), seed=1), Receiver(events=events))
        self.encoder, self.decoder = Encoder(1, 191), Decoder()

    def ask(self, frame):
        now_ns = round(self.endpoint.aircraft.cycle * 4e6)
        return self.decoder.feed(self.endpoint.receive(self.encoder.encode(frame), now_ns))

    def fly(self, cycles: int):
        return [f for _ in range(cycles) for f in self.decoder.feed(self.endpoint.cycle())]

    def cycles(self, count: int) -> list[Cycle]:
        return [f for f in self.fly(count) if isinstance(f, Cycle)]


def only(frames, kind):
    return [f for f in frames if isinstance(f, kind)]


def test_a_gain_write_is_read_back_as_float32_and_acts_at_once():
    peer = Peer()
    (answer,) = peer.ask(ParamSet('ROLL_RATE_KP', 0.06))
    assert answer.value == float(np.float32(0.06))
    assert peer.endpoint.aircraft.gains[0, 1] == float(np.float32(0.06))


@pytest.mark.parametrize('value', [-0.1, 1.5, 1e30, math.nan, math.inf])
def test_a_gain_out_of_bounds_is_refused_with_the_old_value(value):
    peer = Peer()
    (answer,) = peer.ask(ParamSet('PITCH_RATE_KP', value))
    assert answer.name == 'PITCH_RATE_KP'
    assert answer.value == pytest.approx(0.0744845, rel=1e-5)


def test_the_firmware_has_every_parameter_of_the_wire():
    assert set(NAMES) == set(CONTRACT_NAMES)


def test_all_parameters_are_listed_and_read_by_name_and_by_index():
    peer = Peer()
    listed = peer.ask(ParamRequestList())
    assert [f.name for f in listed] == list(NAMES)
    assert [f.index for f in listed] == list(range(len(NAMES)))
    by_index = peer.ask(ParamRequestRead('', index=NAMES.index('GYRO_FILT_HZ')))
    assert by_index == peer.ask(ParamRequestRead('GYRO_FILT_HZ'))
    assert by_index[0].value == 42.0
    assert isinstance(peer.ask(ParamRequestRead('NO_SUCH'))[0], StatusText)


def test_the_gyro_filter_can_be_changed_and_the_loop_rate_cannot():
    peer = Peer()
    before = peer.endpoint.aircraft.machine.chips.gyro_lp.copy()
    assert peer.ask(ParamSet('GYRO_FILT_HZ', 20.0))[0].value == 20.0
    assert not np.array_equal(before, peer.endpoint.aircraft.machine.chips.gyro_lp)
    assert peer.ask(ParamSet('GYRO_FILT_HZ', 1000.0))[0].value == 20.0
    assert peer.ask(ParamSet('LOOP_RATE_HZ', 500.0))[0].value == 250.0


def test_excitation_is_added_in_the_next_cycle_reported_and_dropped_when_stale():
    peer = Peer()
    peer.fly(50)
    peer.ask(Excitation((0.2, 0.0, 0.0), Injection.ATTITUDE, seq=7, valid_ms=100))
    first, *rest = peer.cycles(40)
    assert first.excitation == pytest.approx((0.2, 0.0, 0.0))
    assert first.attitude_setpoint[0] == pytest.approx(0.2)
    assert (first.excitation_seq, first.injection) == (7, Injection.ATTITUDE)
    assert first.flags & Flag.EXCITATION
    on = [bool(c.flags & Flag.EXCITATION) for c in rest]
    assert on == [True] * 25 + [False] * 14
    assert all(c.flags & Flag.STALE_SETPOINT for c in rest[25:])
    assert rest[-1].excitation == (0.0, 0.0, 0.0)


def test_axes_on_the_wire_are_frd_and_turn_back_to_flu():
    peer = Peer()
    peer.ask(Excitation((0.0, 0.1, -0.2), Injection.CONTROL, seq=1))
    (cycle,) = peer.cycles(1)
    assert cycle.excitation == pytest.approx((0.0, 0.1, -0.2))
    assert cycle.control[2] - 0.1 == pytest.approx(0.0, abs=0.02)
    assert cycle.accel[2] == pytest.approx(-9.81, abs=0.2)
    # FRD pitch torque +0.1 is FLU -0.1: the front motors 3, 4 push
    assert min(cycle.motors[2:]) > max(cycle.motors[:2]) - 0.45
    assert sum(cycle.motors[2:]) > sum(cycle.motors[:2])


@pytest.mark.parametrize(
    ('event', 'flag'),
    [
        (Event(0.0, 'aux1', 1.0), Flag.RC_KILL),
        (Event(0.0, 'failsafe', 1.0), Flag.RC_FAILSAFE),
        (None, Flag.NONE),
    ],
)
def test_excitation_is_refused_when_killed_in_failsafe_or_too_large(event, flag):
    peer = Peer(*([] if event is None else [event]))
    size = 0.1 if event else 1.0
    peer.ask(Excitation((size, 0.0, 0.0), Injection.ATTITUDE, seq=1))
    (cycle,) = peer.cycles(1)
    assert cycle.flags & Flag.EXCITATION_REFUSED
    assert not cycle.flags & Flag.EXCITATION
    assert cycle.flags & flag == flag


def test_kill_switch_and_disarm_stop_the_motors_and_arming_starts_them():
    peer = Peer(Event(0.2, 'aux1', 1.0), Event(0.4, 'aux1', -1.0))
    cycles = peer.cycles(150)
    assert min(cycles[10].motors) > 0.2
    assert cycles[60].motors == (0.0, 0.0, 0.0, 0.0)
    assert min(cycles[120].motors) > 0.2
    assert peer.ask(Command(400, (0.0,))) == [CommandAck(400, 0)]
    assert peer.cycles(2)[1].motors == (0.0, 0.0, 0.0, 0.0)
    assert peer.ask(Command(400, (1.0,))) == [CommandAck(400, 0)]
    assert peer.cycles(2)[1].flags & Flag.ARMED
    assert peer.ask(Command(31000, ()))[0].result == 3


def test_sticks_move_the_reference_and_the_channels_and_failsafe_centres_them():
    peer = Peer(Event(0.1, 'roll', 0.5), Event(0.3, 'failsafe', 1.0))
    frames = peer.fly(100)
    cycles, rc = only(frames, Cycle), only(frames, RcChannels)
    assert cycles[40].attitude_setpoint[0] == pytest.approx(math.radians(15.0))
    assert cycles[90].attitude_setpoint[0] == 0.0
    assert rc[8].channels[0] == 1750
    assert len(rc[8].channels) == 9
    assert rc[-1].rssi == 0


def test_slow_messages_come_at_their_rates():
    frames = Peer().fly(500)
    counts = [len(only(frames, k)) for k in (Heartbeat, Battery, RcChannels, SlowSensors)]
    assert counts == [2, 20, 100, 100]
    assert only(frames, Battery)[0].voltage_v == pytest.approx(12.1, abs=0.2)
    assert only(frames, SlowSensors)[0].pressure_hpa == pytest.approx(1013.25, abs=0.2)


def test_a_low_battery_is_said_once_and_refuses_excitation():
    profile = Profile()
    airframe = profile.airframe
    battery = replace(airframe.battery, start_charge=0.05)
    peer = Peer(profile=replace(profile, airframe=replace(airframe, battery=battery)))
    frames = peer.fly(10)
    texts = [t.text for t in only(frames, StatusText)]
    assert len([t for t in texts if t.startswith('low battery')]) == 1
    peer.ask(Excitation((0.1, 0.0, 0.0), Injection.ATTITUDE, seq=1))
    assert peer.cycles(1)[0].flags & Flag.EXCITATION_REFUSED


def test_timesync_is_answered_with_device_time():
    peer = Peer()
    assert peer.ask(TimeSync(0, 123)) == [TimeSync(0, 123)]
    peer.fly(25)
    assert peer.ask(TimeSync(0, 456)) == [TimeSync(100_000_000, 456)]
    assert peer.ask(TimeSync(1, 456)) == []


def start(tmp_path, *options: str):
    link = tmp_path / 'stm32'
    command = [sys.executable, '-m', 'quad_bridge.virtual.process', '--link', str(link)]
    process = subprocess.Popen(
        [*command, *options], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    deadline = time.monotonic() + 60.0
    while not link.is_symlink() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    return process, link


def test_the_process_serves_a_real_pty_and_ends_cleanly(tmp_path):
    process, link = start(tmp_path)
    try:
        port = os.open(link, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        encoder, decoder, frames = Encoder(1, 191), Decoder(), []
        os.write(port, encoder.encode(TimeSync(0, 77)))
        os.write(port, encoder.encode(ParamSet('ROLL_ANG_KP', 3.5)))
        deadline = time.monotonic() + 30.0
        while len(only(frames, Cycle)) < 300 and time.monotonic() < deadline:
            if select.select([port], [], [], 0.1)[0]:
                frames += decoder.feed(os.read(port, 65536))
        os.close(port)
    finally:
        process.send_signal(signal.SIGTERM)
        _, errors = process.communicate(timeout=20)
    numbers = [c.cycle for c in only(frames, Cycle)]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    assert len(numbers) >= 300
    assert only(frames, Heartbeat)
    assert only(frames, TimeSync)[0].ts1_ns == 77
    assert only(frames, ParamValue)[0].value == 3.5
    assert (process.returncode, errors) == (0, '')
    assert not link.is_symlink()
    assert decoder.counts.bad_crc == 0


def test_a_stalled_process_catches_up_without_losing_a_cycle(tmp_path):
    process, link = start(tmp_path)
    decoder, cycles = Decoder(), []
    try:
        port = os.open(link, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        deadline = time.monotonic() + 30.0
        stalled = False
        while len(cycles) < 250 and time.monotonic() < deadline:
            if select.select([port], [], [], 0.05)[0]:
                cycles += only(decoder.feed(os.read(port, 65536)), Cycle)
            if len(cycles) > 50 and not stalled:
                stalled = True
                process.send_signal(signal.SIGSTOP)
                time.sleep(0.3)
                process.send_signal(signal.SIGCONT)
        os.close(port)
    finally:
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=20)
    assert process.returncode == 0
    assert len(cycles) >= 250
    assert {b.cycle - a.cycle for a, b in itertools.pairwise(cycles)} == {1}
    assert {b.time_us - a.time_us for a, b in itertools.pairwise(cycles)} == {4000}


def test_the_process_does_not_block_when_nobody_reads(tmp_path):
    process, _ = start(tmp_path, '--duration', '2')
    output, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (0, '')
    assert 'bytes dropped' in output


EFFECT = 'import numpy as np\ndef effect(t_s, rates, angles, thrusts, battery_v):\n    '


@pytest.mark.parametrize(
    ('source', 'said'),
    [
        (EFFECT + 'raise KeyError("x")\n', 'KeyError'),
        (EFFECT + 'return [1.0, 2.0]\n', 'three finite torques'),
        (EFFECT + 'return [np.nan, 0.0, 0.0]\n', 'three finite torques'),
        (EFFECT + 'return "up"\n', 'ValueError'),
        ('x = 1\n', 'no function effect'),
        ('import nowhere_to_be_found\n', 'cannot be loaded'),
        (None, 'not a readable Python file'),
    ],
)
def test_a_bad_effect_module_is_one_line_and_status_2(tmp_path, capsys, source, said):
    path = tmp_path / 'bad.py'
    if source is not None:
        path.write_text(source, encoding='utf-8')
    handlers = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    try:
        status = main(['--effect-module', str(path), '--duration', '0.1'])
    finally:
        signal.signal(signal.SIGINT, handlers[0])
        signal.signal(signal.SIGTERM, handlers[1])
    error = capsys.readouterr().err
    assert status == 2
    assert error.count('\n') == 1
    assert str(path) in error
    assert said in error


def test_an_effect_module_acts_in_the_process(tmp_path, capsys):
    path, seen = tmp_path / 'push.py', tmp_path / 'seen'
    path.write_text(
        f'calls = 0\n{EFFECT}global calls\n    calls += 1\n'
        f'    open({str(seen)!r}, "w").write(str(calls))\n    return np.array([0.1, 0, 0])\n',
        encoding='utf-8',
    )
    handlers = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    try:
        assert main(['--effect-module', str(path), '--duration', '0.2']) == 0
    finally:
        signal.signal(signal.SIGINT, handlers[0])
        signal.signal(signal.SIGTERM, handlers[1])
    assert int(seen.read_text(encoding='utf-8')) == 200
    capsys.readouterr()
