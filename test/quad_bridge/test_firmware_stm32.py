"""The STM32F405's ELF in QEMU: it flies what the Linux build flies; its watchdog bites."""

import os
import shutil
import subprocess
from itertools import pairwise

import pytest

from quad_bridge.virtual import hil
from quad_bridge.virtual.aircraft import Aircraft, boot
from quad_bridge.virtual.board import EMULATOR, EmulatedBoard
from quad_bridge.virtual.profile import Profile
from quad_bridge.virtual.receiver import Channels
from quad_bridge.wire import Decoder
from quad_bridge.wire import frames as f

MISSING = [name for name in (EMULATOR, 'arm-none-eabi-gcc') if shutil.which(name) is None]
pytestmark = pytest.mark.skipif(bool(MISSING), reason=f'not installed: {", ".join(MISSING)}')
FLASH_BYTES, RAM_BYTES = 768 * 1024, 128 * 1024


class Emulated:
    """An aircraft on the emulated board, in lockstep, and what its port says."""

    def __init__(self, elf):
        self.board, self.decoder = EmulatedBoard(elf), Decoder()
        self.port = os.open(self.board.path, os.O_RDWR | os.O_NOCTTY)
        os.set_blocking(self.port, False)
        self.frames = []
        self.board.motors()  # it listens

    def boot(self, profile):
        self.aircraft = Aircraft(profile, seed=1)
        self.board.send(boot(profile).frame())

    def fly(self, cycles):
        """The motors of each cycle."""
        flown = []
        for _ in range(cycles):
            self.board.send(self.aircraft.measure(Channels()))
            flown.append(self.board.motors())
            self.aircraft.move(flown[-1])
            self.hear()
        return flown

    def hear(self):
        try:
            self.frames += self.decoder.feed(os.read(self.port, 65536))
        except BlockingIOError:
            return

    def close(self):
        os.close(self.port)
        self.board.close()


@pytest.fixture
def emulated(firmware):
    """A function that starts a target of firmware/Makefile."""
    started = []

    def start(target):
        started.append(Emulated(firmware(target)))
        return started[-1]

    yield start
    for board in started:
        board.close()


def test_it_fits_and_flies_what_the_linux_build_flies(emulated, firmware):
    listed = subprocess.run(
        ['arm-none-eabi-size', firmware('stm32f405.elf')], capture_output=True, text=True,
        check=True,
    )  # fmt: skip
    text, data, bss = map(int, listed.stdout.splitlines()[1].split()[:3])
    assert text + data < FLASH_BYTES
    assert data + bss < RAM_BYTES // 4
    made, profile = emulated('stm32f405.elf'), Profile()
    made.boot(profile)
    flown = made.fly(150)
    twin = Aircraft(profile, seed=1)
    for motors in flown:
        there = hil.motors(twin.firmware.cycle(twin.measure(Channels())))
        assert there.commands == pytest.approx(motors.commands, abs=1e-5)
        twin.move(motors)
    cycles = [x for x in made.frames if isinstance(x, f.Cycle)]
    assert len(cycles) > 20  # QEMU's port opens up to a second late
    assert {(b.cycle - a.cycle, b.time_us - a.time_us) for a, b in pairwise(cycles)} == {(1, 4000)}
    assert made.decoder.counts.bad_crc == 0


def test_a_loop_that_hangs_is_restarted_by_the_watchdog(emulated):
    made = emulated('hangs.elf')
    made.boot(Profile())
    made.fly(50)  # it hangs now
    assert made.board.motors().commands == (0.0, 0.0, 0.0, 0.0)  # and listens again
    made.boot(Profile())
    made.fly(30)
    assert 'restarted by the watchdog' in [
        x.text for x in made.frames if isinstance(x, f.StatusText)
    ]
