"""The STM32F405's ELFs in QEMU: they fly what the Linux build flies, with whole sets of gains."""

import contextlib
import os
import re
import shutil
import socket
import struct
import subprocess
from dataclasses import replace
from functools import reduce
from itertools import pairwise

import numpy as np
import pytest
from node_process import ended

from quad_bridge.gains.protocol import checksum
from quad_bridge.gains.table import ROWS, WIRE_NAMES
from quad_bridge.virtual import hil
from quad_bridge.virtual.aircraft import Aircraft, boot
from quad_bridge.virtual.board import EMULATOR, MACHINE, EmulatedBoard
from quad_bridge.virtual.errors import RestartedError
from quad_bridge.virtual.physics import POSITION
from quad_bridge.virtual.process import Flight
from quad_bridge.virtual.profile import Profile, load_profile
from quad_bridge.virtual.receiver import Event, Receiver, channels_at
from quad_bridge.wire import Decoder
from quad_bridge.wire import frames as f
from quad_bridge.wire.codec import Encoder

MISSING = [name for name in (EMULATOR, 'arm-none-eabi-gcc') if shutil.which(name) is None]
pytestmark = [
    pytest.mark.qemu,
    pytest.mark.skipif(bool(MISSING), reason=f'not installed: {", ".join(MISSING)}'),
]
FLASH_BYTES, RAM_BYTES = 768 * 1024, 128 * 1024
KP, OLD, NEW = 'roll.rate.kp', pytest.approx(0.07448451), pytest.approx(0.1)
EXACT = ('-icount', 'shift=3,sleep=off')
"""An instruction takes 8 ns, as on the chip, whatever the host is busy with."""


class Emulated:
    """An aircraft on the emulated board, in lockstep: the calls of `virtual_aircraft.Endpoint`."""

    def __init__(self, elf, room, aircraft, script=None):
        self.aircraft, self._script = aircraft, script or Receiver()
        self._monitor = str(room / 'monitor')
        options = ('-monitor', f'unix:{self._monitor},server=on,wait=off')
        self.board, self.decoder, self.frames = EmulatedBoard(elf, options=options), Decoder(), []
        self.port = os.open(self.board.path, os.O_RDWR | os.O_NOCTTY)
        os.set_blocking(self.port, False)
        self.boot()

    def boot(self):
        """Once it listens it gets its settings."""
        while self.board.motors().time_us > 0:  # the last ones of before a reset
            pass
        self.board.send(boot(self.aircraft.profile).frame())

    def reset(self):
        """The chip's reset, in flight."""
        with socket.socket(socket.AF_UNIX) as monitor:
            monitor.connect(self._monitor)
            monitor.sendall(b'system_reset\n')
            self.boot()

    def receive(self, data, _now_ns=0):
        """Answers come with the cycles."""
        os.write(self.port, data)
        return b''

    def cycle(self):
        self.step()
        return self.hear()

    def step(self):
        """The motors of one cycle."""
        now_s = self.aircraft.cycle * self.aircraft.cycle_s
        self.board.send(self.aircraft.measure(channels_at(self._script, now_s)))
        motors = self.board.motors()
        self.aircraft.move(motors)
        return motors

    def hear(self):
        try:
            data = os.read(self.port, 65536)
        except BlockingIOError:
            return b''
        self.frames += self.decoder.feed(data)
        return data

    def told(self, kind):
        return [frame for frame in self.frames if isinstance(frame, kind)]

    def until_it_is_heard(self):
        """QEMU's port opens up to a second late."""
        while not self.told(f.Cycle):
            self.cycle()
        return self

    def gain(self, _name):
        """Roll's rate.kp, asked for beside the bridge."""
        self.frames.clear()
        self.receive(Encoder(1, 191).encode(f.ParamRequestRead('ROLL_RATE_KP')))
        while not (found := [x for x in self.told(f.ParamValue) if x.name == 'ROLL_RATE_KP']):
            self.cycle()
        return found[-1].value

    def close(self):
        os.close(self.port)
        self.board.close()


@pytest.fixture
def emulated(firmware, tmp_path):
    started = []

    def start(target, aircraft=None, script=None):
        aircraft = aircraft or Aircraft(Profile(), seed=1)
        started.append(Emulated(firmware(target), tmp_path, aircraft, script))
        return started[-1]

    yield start
    for board in started:
        board.close()


def test_it_fits(firmware):
    for elf in ('stm32f405.elf', 'flight.elf'):
        listed = ended('arm-none-eabi-size', firmware(elf))
        text, data, bss = map(int, listed.stdout.splitlines()[1].split()[:3])
        assert text + data < FLASH_BYTES
        assert data + bss < RAM_BYTES // 4


HELD = (Event(0.5, 'throttle', 0.32), Event(1.0, 'aux4', 1.0))
LOST = 1000
"""Cycle from which on a tenth of the thrust is lost."""
DESIGNED = {'climb.height.kp': 2.01, 'climb.rate.kp': 0.209, 'climb.rate.ki': 0.5,
            'climb.rate.kd': 0.0112}
"""What quad-tune design --axis climb gives for this aircraft: test_climb.py."""


def test_it_flies_and_holds_its_height_by_the_designed_gains_as_the_linux_build(emulated):
    """A tenth of the thrust is lost: how far it falls, and the error of three seconds."""
    profile, script = load_profile('hover'), Receiver(HELD)
    profile = replace(
        profile,
        firmware=replace(profile.firmware, gains={**profile.firmware.gains, **DESIGNED}))
    made, twin = (emulated('stm32f405.elf', Aircraft(profile, seed=3), script),
                  Aircraft(profile, seed=3))
    heights = []
    for k in range(LOST + 750):
        channels = channels_at(script, k * twin.cycle_s)
        made.board.send(made.aircraft.measure(channels))
        there = hil.motors(twin.firmware.cycle(twin.measure(channels)))
        for aircraft, motors in ((made.aircraft, made.board.motors()), (twin, there)):
            left = tuple((0.9 if k >= LOST else 1.0) * np.array(motors.commands))
            aircraft.move(replace(motors, commands=left))
            if k < 150:
                assert there.commands == pytest.approx(motors.commands, abs=1e-5)
        made.hear()
        heights.append([one.machine.state[POSITION + 2] for one in (made.aircraft, twin)])
    chip, linux = np.array(heights[LOST:]).T - heights[LOST][0]
    assert np.abs(chip - linux).max() < 0.01
    assert -chip.min() == pytest.approx(0.068, rel=0.15)
    assert np.sqrt(np.mean(chip**2)) == pytest.approx(0.050, rel=0.15)
    cycles = made.told(f.Cycle)
    assert len(cycles) > 1000
    assert {(b.cycle - a.cycle, b.time_us - a.time_us) for a, b in pairwise(cycles)} == {(1, 4000)}
    assert made.decoder.counts.bad_crc == 0


def test_a_loop_that_hangs_is_restarted_by_the_watchdog(emulated):
    made = emulated('hangs.elf')
    for _ in range(50):
        made.cycle()
    made.boot()  # it hangs, is restarted, and listens again
    made.until_it_is_heard()
    while not made.told(f.StatusText):
        made.cycle()
    assert made.told(f.StatusText)[0].text == 'restarted by the watchdog'


def test_a_flight_ends_where_its_board_restarts(firmware):
    board = EmulatedBoard(firmware('hangs.elf'))
    flight = Flight(Aircraft(Profile(), seed=1), board, lockstep=True)
    with contextlib.closing(board), pytest.raises(RestartedError, match='by itself in cycle'):
        all(flight.cycle() is None for _ in range(100_000))


def test_the_timer_keeps_250_hz_to_the_microsecond(firmware):
    """The paper's board without its chips: nothing answers, nothing arms, and no cycle is late."""
    command = (EMULATOR, '-M', MACHINE, '-display', 'none', '-monitor', 'none', '-serial', 'stdio')
    decoder, frames = Decoder(), []
    with subprocess.Popen(
        [*command, '-kernel', firmware('flight.elf'), *EXACT], stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
    ) as run:  # fmt: skip
        while not any('timing' in getattr(frame, 'text', '') for frame in frames):
            frames += decoder.feed(os.read(run.stdout.fileno(), 65536))
        run.kill()
    cycles = [frame for frame in frames if isinstance(frame, f.Cycle)]
    assert len(cycles) >= 1250
    assert {b.time_us - a.time_us for a, b in pairwise(cycles)} == {4000}
    assert not any(frame.flags & f.Flag.ARMED for frame in cycles)
    (timing,) = (x.text for x in frames if isinstance(x, f.StatusText) and 'timing' in x.text)
    assert int(re.search(r'latest (\d+)', timing)[1]) < 10  # us of its own timer


PAGE_BYTES, PAGES_AT = 128 * 1024, 0x080C0000


NEARLY_FULL = 2 * (PAGE_BYTES // (4 * len(ROWS) + 12)) - 8


def kept_sets(number):
    """The flash after so many confirmed sets; roll.rate.kp is their number / 10000."""
    names = ''.join(name.ljust(16, '\0') for name in WIRE_NAMES.values()).encode()
    layout = reduce(lambda h, c: (h ^ c) * 16777619 & 0xFFFFFFFF, names, 2166136261)
    values = {name: row.start[0] for name, row in ROWS.items()}
    pages = [b'', b'']
    for k in range(1, number + 1):
        values[KP] = 1e-4 * k
        packed = struct.pack(f'<{len(values)}f', *values.values())
        check = checksum(list(values.values())) ^ (k * 2654435761 & 0xFFFFFFFF)
        record = struct.pack('<2I', k, layout) + packed + struct.pack('<I', check)
        pages[k > PAGE_BYTES // len(record)] += record
    return b''.join(page.ljust(PAGE_BYTES, b'\xff') for page in pages)


def test_a_flash_full_of_sets_holds_up_neither_boot_nor_loop(firmware, tmp_path):
    """By the flight board's own watchdog; the set that is confirmed cannot be kept in QEMU."""
    (tmp_path / 'pages').write_bytes(kept_sets(NEARLY_FULL))
    command = (EMULATOR, '-M', MACHINE, '-display', 'none', '-monitor', 'none', '-serial', 'stdio',
               '-kernel', firmware('strict.elf'), *EXACT, '-device',
               f'loader,file={tmp_path / "pages"},addr={PAGES_AT:#x},force-raw=on')  # fmt: skip
    decoder, encoder, frames = Decoder(), Encoder(1, 191), []
    asked = (f.ParamRequestRead('ROLL_RATE_KP'), f.GainsCommand(f.GainsAction.OPEN, 5),
             f.GainsCommand(f.GainsAction.CONFIRM, 5))  # fmt: skip

    def heard(kind):
        return [frame for frame in frames if isinstance(frame, kind)]

    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as run:
        while not heard(f.Cycle):
            frames += decoder.feed(os.read(run.stdout.fileno(), 65536))
        run.stdin.write(b''.join(map(encoder.encode, asked)))
        run.stdin.flush()
        while not any(x.text.startswith(('timing', 'restarted')) for x in heard(f.StatusText)):
            frames += decoder.feed(os.read(run.stdout.fileno(), 65536))
        run.kill()
    said = [x.text for x in heard(f.StatusText)]
    assert not any('watchdog' in text for text in said)
    assert 'flash: these gains end with the power' in said
    assert heard(f.ParamValue)[0].value == pytest.approx(1e-4 * NEARLY_FULL)
    assert {b.cycle - a.cycle for a, b in pairwise(heard(f.Cycle))} == {1}


@pytest.mark.parametrize(
    ('fault', 'gain'), [('noise', NEW), ('cut', OLD), ('reset', OLD)],
    ids=['corrupted', 'cut in the watch', 'reset'],
)
def test_it_flies_the_old_gains_or_the_new_ones(bench, emulated, fault, gain):
    """What else a line does to a set is walked through in test_gain_protocol.py."""

    def board(aircraft, script):
        return emulated('stm32f405.elf', aircraft, script).until_it_is_heard()

    made = bench(endpoint=board)
    if fault == 'noise':
        made.up.noise = made.down.noise = 2e-4  # a frame in thirty
    made.ask(roll_rate_kp=0.1)
    made.fly_until('in force')
    if fault == 'cut':
        made.cut = True
        made.fly(3.0)
    elif fault == 'reset':
        made.endpoint.reset()
        made.fly(2.0)
        assert made.told[KP] == OLD  # and the bridge knows
    assert made.gain(KP) == gain
