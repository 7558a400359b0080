"""Set-up: what the wizard measures is what was built, through the firmware in C and back."""

import math
import os
import signal
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from flight_controller import FlightController, Port, Pty

from quad_bridge.errors import RefusedError
from quad_bridge.gains.table import ROWS, SET_UP, WIRE_NAMES
from quad_bridge.motor_test import frame
from quad_bridge.setup import measure, wizard
from quad_bridge.setup.talk import Talk
from quad_bridge.setup.wizard import load, save
from quad_bridge.virtual import hil
from quad_bridge.virtual.aircraft import boot
from quad_bridge.virtual.native import NativeFirmware
from quad_bridge.virtual.profile import Profile
from quad_bridge.wire import Encoder

CYCLE_US = 4000
ORDER = {'throttle': 1, 'roll': 3, 'pitch': 2, 'yaw': 4, 'kill': 7, 'arm': 6}  # of the receiver
WIRES = (3, 1, 4, 2)  # the output that leads to motor 1, 2, 3, 4
TURN = measure.turn(0.0, 0.0, math.pi / 2)  # the board, its nose to the right
OFFSET, SCALE = np.array([0.3, -0.2, 0.5]), np.array([1.03, 0.98, 1.01])
MAGNET = np.array([0.1, -0.25, 0.05])


class Built:
    """An aircraft that stands as it is told, its firmware in memory; `Talk.wait` runs it."""

    def __init__(self, stored=None):
        settings = boot(Profile())
        gains = settings.gains if stored is None else stored
        self.firmware = NativeFirmware(replace(settings, gains=gains).frame())
        self.firmware.arm(armed=False)
        self.time_us, self.pulses, self.turning = 0, self.rest(), 0.0
        self.force, self.fields = np.array([0.0, 0.0, -9.80665]), np.array([[0.2, 0.0, 0.4]])
        self.outputs, self.random = (0.0,) * 4, np.random.default_rng(1)
        self.battery_v = 12.0 / 10.1  # at the pin: a divider of 10.1

    @staticmethod
    def rest():
        pulses = [1500.0] * 9
        pulses[0], pulses[5], pulses[6] = 1100.0, 1000.0, 1000.0
        return pulses

    def now_s(self):
        return 1e-6 * self.time_us

    def wait(self, talk, seconds):
        for _ in range(max(1, round(1e6 * seconds / CYCLE_US))):
            talk.take(self.firmware.receive(talk.to_send(), self.time_us))
            raw = TURN.T @ self.force / SCALE + OFFSET + 0.02 * self.random.standard_normal(3)
            field = self.fields[self.random.integers(len(self.fields))]
            mag = TURN.T @ field + MAGNET
            chip = np.array([1.0, -1.0, -1.0])  # x forward, y left, z up
            row = np.concatenate([np.full(3, self.turning), chip * raw])
            slow = (self.battery_v, *(chip * mag), 1000.0 + 0.1 * self.random.random(), 20.0)
            data = hil.sensors(self.time_us, self.pulses, False, slow, np.array([row] * 4))
            self.outputs = hil.motors(self.firmware.cycle(data)).commands
            talk.take(self.firmware.send())
            self.time_us += CYCLE_US


class Person:
    """Answers the wizard, and does what it asks for."""

    answers = (('height mode', 'n'), ('deadband', '20'), ('the voltmeter', '12.0'),
               ('type OFF', 'off'))  # fmt: skip
    ways = (('throttle', 'down', 'up'), ('roll', 'left', 'right'), ('pitch', 'back', 'forward'),
            ('yaw', 'right', 'left'))  # fmt: skip

    def __init__(self, built):
        self.built, self.spun, self.told = built, [], []

    def __call__(self, words):
        assert 'again?' not in words, self.told[-1]
        self._hold(words)
        self._sticks(words)
        if 'which one was it' in words:
            return str(self.spun[-1])
        return next((answer for asked, answer in self.answers if asked in words), '')

    def _hold(self, words):
        built = self.built
        for name, force in measure.FORCES.items():
            if f'hold it {name}' in words:
                built.force = 9.80665 * np.array(force)
        if 'all directions' in words:
            points = built.random.standard_normal((400, 3))
            built.fields = 0.5 * points / np.linalg.norm(points, axis=1)[:, np.newaxis]
            built.force = np.array([0.0, 0.0, -9.80665])

    def _sticks(self, words):
        built = self.built
        if 'sticks' in words:
            built.pulses = built.rest()
        for name, less, more in self.ways:
            if f'hold {name} ' in words:
                built.pulses = built.rest()
                ends = (1900.0, 1080.0) if name == 'pitch' else (1100.0, 1890.0)  # reversed
                built.pulses[ORDER[name] - 1] = ends[more in words]
                assert less in words or more in words
        for name, switch in (('kill', 'kill switch'), ('arm', 'arming switch')):
            if words.startswith(f'  {switch}'):
                built.pulses[ORDER[name] - 1] = 1000.0 if 'off' in words else 2000.0


def test_the_wizard_finds_how_it_is_built_and_the_firmware_flies_by_it(monkeypatch):
    built = Built()
    person = Person(built)
    talk = Talk(built.wait, built.now_s)
    wait = talk.wait

    def watched(seconds):
        wait(seconds)
        turned = [k for k, command in enumerate(built.outputs) if command > 0.0]
        if turned:
            person.spun.append(WIRES.index(turned[0] + 1) + 1)

    talk.wait = watched
    monkeypatch.setattr(wizard, 'COMPASS_S', 6.0)
    found = wizard.Wizard(talk, person, person.told.append).run()
    assert set(found) <= {row.name for row in SET_UP}
    assert {n: found.get(f'receiver.{n}_channel', ROWS[f'receiver.{n}_channel'].start[0])
            for n in ORDER} == ORDER  # fmt: skip
    assert found['receiver.hold_channel'] == 0.0
    assert (found['receiver.pitch_min_us'], found['receiver.pitch_max_us']) == (1900.0, 1080.0)
    assert found['board.yaw'] == pytest.approx(math.pi / 2, abs=1e-6)
    for i, axis in enumerate('xyz'):
        offset, scale = found[f'accel.offset_{axis}'], found[f'accel.scale_{axis}']
        assert (offset, scale) == (pytest.approx(OFFSET[i], abs=0.02),
                                   pytest.approx(SCALE[i], abs=0.003))  # fmt: skip
        assert found[f'compass.offset_{axis}'] == pytest.approx(MAGNET[i], abs=0.01)
    assert found['battery.divider'] == pytest.approx(10.1, rel=2e-3)
    now = {f'motors.output_{k}': float(k) for k in range(1, 5)} | found
    assert tuple(int(now[f'motors.output_{k}']) for k in range(1, 5)) == WIRES

    armed = []
    talk.wait = lambda seconds: (wait(seconds), armed.append(talk.cycle.flags & 1))
    wizard.Wizard(talk, person, person.told.append).run(['receiver'])
    assert not any(armed)  # though the arming switch was thrown, with the throttle down
    talk.wait = wait
    built.force, built.pulses = np.array([0.0, 0.0, -9.80665]), built.rest()
    built.pulses[ORDER['pitch'] - 1] = 1080.0
    talk.wait(1.5)
    assert talk.channels[:4] == (1500, 2000, 1000, 1500)  # forward is more, as /rc/in has it
    assert talk.cycle.accel == pytest.approx((0.0, 0.0, -9.80665), abs=0.05)
    assert talk.volts == pytest.approx(12.0, abs=0.02)
    built.pulses = built.rest()
    talk.wait(0.2)
    talk.spin(1, 0.1, 0.3)
    assert not any(built.outputs)  # it was stopped


def standing(stored=None):
    """Throttle down, switches off, its set-up known."""
    built = Built(stored)
    talk = Talk(built.wait, built.now_s)
    built.pulses = [1500.0, 1500.0, 1000.0, 1500.0, *[1000.0] * 5]
    talk.read()
    return built, talk


def test_a_motor_is_tested_only_disarmed_at_rest_and_no_longer_than_asked_for():
    built, talk = standing()
    rest = built.pulses
    kill, throttle = ([*rest[:k], us, *rest[k + 1 :]] for k, us in ((4, 2000.0), (2, 1300.0)))
    for built.turning, built.pulses in ((1.0, rest), (0.0, kill), (0.0, throttle)):
        talk.wait(0.2)
        with pytest.raises(RefusedError, match='not now'):
            talk.spin(1, 0.1, 0.1)
    built.pulses = rest
    talk.wait(2.2)
    with pytest.raises(RefusedError, match='denied'):
        talk.spin(1, 0.3, 0.1)  # too fast
    talk.spin(2, 0.1, 0.3)
    built.firmware.receive(Encoder(1, 191).encode(frame(2, 0.1, 10.0)), built.time_us)
    talk.wait(0.4)
    assert built.outputs == pytest.approx((0.0, 0.1, 0.0, 0.0))
    talk.wait(0.2)  # nobody asks again
    assert not any(built.outputs)


def test_a_set_up_that_cannot_fly_does_not_arm_and_nothing_of_it_changes_armed():
    built, talk = standing()
    talk.write({'receiver.arm_channel': 6.0, 'motors.output_1': 2.0})
    talk.wait(0.1)
    built.pulses[5] = 2000.0
    talk.wait(0.1)
    assert not talk.cycle.flags & 1
    assert any('two motors on one output' in text for text in talk.texts)
    built.pulses[5] = 1000.0
    talk.write({'motors.output_1': 1.0})
    talk.wait(0.1)
    built.pulses[5] = 2000.0
    talk.wait(0.1)
    assert talk.cycle.flags & 1
    with pytest.raises(RefusedError, match='kept 1 instead of 3'):
        talk.write({'motors.output_1': 3.0})


@pytest.mark.parametrize('restored', [False, True])
def test_one_that_is_the_same_as_the_tables_is_written_too(restored):
    """A firmware that could not read its own in flash waits for one that is confirmed."""
    built, talk = standing([math.nan] * len(WIRE_NAMES))
    built.pulses[5] = 2000.0
    talk.wait(0.1)
    built.pulses[5] = 1000.0
    talk.wait(0.1)
    assert not talk.cycle.flags & 1
    assert 'set-up: the stored one cannot be read, do it anew' in talk.texts
    if restored:
        same = {row.name: row.start[0] for row in SET_UP}
        assert wizard.written(talk, same) == {}
    else:
        assert wizard.Wizard(talk, lambda _: '', lambda _: None).run(['motors']) == {}
    talk.wait(0.1)
    built.pulses[5] = 2000.0
    talk.wait(0.1)
    assert talk.cycle.flags & 1


def test_what_does_not_fit_is_refused_in_words():
    rest, low, high = [1500.0] * 9, [1500.0] * 9, [1500.0] * 9
    with pytest.raises(RefusedError, match='roll: no channel moved'):
        measure.stick('roll', rest, low, high)
    high[0], high[1] = 1900.0, 1850.0
    with pytest.raises(RefusedError, match='channels 1 and 2 moved'):
        measure.stick('roll', rest, low, high)
    raw = {name: np.array([0.0, 0.0, -9.8]) for name in measure.FORCES}
    with pytest.raises(RefusedError, match='no sound accelerometer'):
        measure.six_positions(raw)
    flat = np.random.default_rng(1).standard_normal((200, 3)) * (0.4, 0.4, 0.01)
    with pytest.raises(RefusedError, match='all directions'):
        measure.compass(flat)


def test_a_position_may_be_off_by_some_degrees_and_must_be_still():
    built, talk = standing()
    angles = np.radians(np.random.default_rng(3).uniform(-8.0, 8.0, (6, 3)))
    raw = {n: TURN.T @ measure.turn(*off) @ (9.80665 * np.array(v)) / SCALE + OFFSET
           for (n, v), off in zip(measure.FORCES.items(), angles, strict=True)}  # fmt: skip
    found = measure.six_positions(raw)
    for i, axis in enumerate('xyz'):
        assert found[f'accel.offset_{axis}'] == pytest.approx(OFFSET[i], abs=0.005)
        assert found[f'accel.scale_{axis}'] == pytest.approx(SCALE[i], abs=0.0005)

    def turned(seconds):  # at 0.3 rad/s, whose range is none
        for _ in range(round(seconds / 0.05)):
            built.force = measure.turn(0.015, 0.0, 0.0) @ built.force
            built.wait(talk, 0.05)

    built.turning, talk.wait = 0.3, turned
    with pytest.raises(RefusedError, match='it moved'):
        talk.force()


def test_any_turn_of_the_board_is_found():
    """Not only quarter turns; up to what a hand can hold."""
    rng = np.random.default_rng(2)
    for _ in range(20):
        angles = rng.uniform((-3.0, -1.4, -3.0), (3.0, 1.4, 3.0))
        rotation = measure.turn(*angles)
        raw = {n: rotation.T @ (9.80665 * np.array(v)) / SCALE + OFFSET
               for n, v in measure.FORCES.items()}  # fmt: skip
        found = measure.six_positions(raw)
        made = measure.turn(*(found[f'board.{a}'] for a in ('roll', 'pitch', 'yaw')))
        assert np.abs(made - rotation).max() < 0.27  # a quarter turn is taken where it is near
        assert found['accel.scale_x'] == pytest.approx(SCALE[0], abs=0.02)


@pytest.mark.parametrize(('step', 'answers', 'told'), [
    ('motors', ['x', 'n'], "must be a number of 800 to 2200: found 'x'"),
    ('motors', ['1000', '1100', '', '1000', '2000', 'n'], 'must be at least 200 µs above'),
    ('battery', ['60', 'n'], 'battery.divider: 50.5 1 lies outside 1 to 40'),
    ('outputs', ['on', 'n'], 'no motor is spun with a propeller on'),
    ('outputs', ['OFF', '', '', '', 'n', *['', '', ''] * 3, 'n'], 'motor 1: swap two of its'),
])
def test_a_wrong_answer_is_said_and_what_is_not_agreed_to_is_not_written(step, answers, told):
    _, talk = standing()
    talk.wait(2.2)  # at rest for as long as a motor wants
    said, given = [], iter(answers)
    assert wizard.Wizard(talk, lambda _: next(given), said.append).run([step]) == {}
    assert told in ' '.join(said)
    assert next(given, None) is None


def test_a_file_is_restored_through_the_port_and_a_bad_one_is_named(tmp_path, printed, refused):
    values = {row.name: row.start[0] for row in SET_UP} | {'battery.divider': 9.5}
    kept, bad, port = tmp_path / 'a' / 'setup.yaml', tmp_path / 'bad.yaml', tmp_path / 'tty'
    save(kept, 'one', values | {'battery.divider': 8.5})
    for _ in range(2):
        save(kept, 'one', values)
    (earlier,) = kept.parent.glob('setup_*.yaml')
    assert load(earlier)['battery.divider'] == 8.5
    assert load(kept) == pytest.approx(values)
    bad.write_text('set_up: {motors.output_1: 9}\n', encoding='utf-8')
    for wrong, words in ((['--restore', bad], 'bad.yaml: motors.output_1'), (
            ['--restore', tmp_path], 'is no file of setup'), (['engine'], "no step 'engine'"),
            (['--port', 'socket://rig:5760'], '--key: is required')):
        assert words in refused(wizard.main, *wrong)
    with Port(FlightController(), Pty(port)) as there:
        own = ['--port', port, '--folder', tmp_path]
        assert 'it is armed' in refused(wizard.main, *own)
        said = printed(wizard.main, *own, '--restore', kept)
        (file,) = {*tmp_path.glob('*/setup.yaml')} - {kept}
        assert said == f'1 values written\n{file}\n'
        assert load(file)['battery.divider'] == 9.5
        entry = load(file) | {'battery.divider': 7.5}
        save(file, 'one', entry)
        assert 'it is armed' in refused(wizard.main, *own)
        assert load(file) == entry
    assert there.controller.store.of([WIRE_NAMES['battery.divider']], 'good') == (9.5,)


@pytest.mark.parametrize(('number', 'before', 'status'), [
    (signal.SIGHUP, signal.SIG_DFL, 130), (signal.SIGTERM, signal.SIG_DFL, 130),
    (signal.SIGHUP, signal.SIG_IGN, 2),  # under nohup it goes on, to the end of its input
])
def test_a_terminal_that_goes_away_ends_it_with_all_that_was_written_saved(
    tmp_path, monkeypatch, request, number, before, status
):
    request.addfinalizer(partial(signal.signal, number, signal.signal(number, before)))
    answers = iter(['1100', '2000', 'y'])

    def asked(_words):
        answer = next(answers, None)
        if answer is None:
            os.kill(os.getpid(), number)
            raise EOFError
        return answer

    monkeypatch.setattr('builtins.input', asked)
    controller = FlightController()
    controller.flags = 0
    with Port(controller, Pty(tmp_path / 'tty')), pytest.raises(SystemExit) as ended:
        wizard.main(['--port', str(tmp_path / 'tty'), '--folder', str(tmp_path), 'motors',
                     'battery'])
    assert ended.value.code == status
    (file,) = tmp_path.glob('*/setup.yaml')
    assert load(file)['motors.pulse_min_us'] == 1100.0
