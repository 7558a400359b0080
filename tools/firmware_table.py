"""Measures the STM32's ELFs in QEMU for docs/results/firmware.md (`make firmware-table`).

Instructions are counted by the timer: with `-icount shift=N` each takes 2^N ns of its clock.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

from quad_bridge.virtual.aircraft import Aircraft, boot
from quad_bridge.virtual.board import EMULATOR, MACHINE, EmulatedBoard
from quad_bridge.virtual.profile import Profile
from quad_bridge.virtual.receiver import Channels
from quad_bridge.wire import Decoder
from quad_bridge.wire import frames as f
from quad_bridge.wire.codec import Encoder

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / 'docs/results/firmware.md'
SHIFT = 7
"""128 ns an instruction: the timer's microsecond counts eight of them."""
CYCLES = 2600
STATUS = re.compile(r'timing: latest (\d+), longest (\d+), stack (\d+)')


def size(elf: Path) -> tuple[int, int]:
    """Bytes of flash and of RAM, the stack's left out."""
    command = ['arm-none-eabi-size', str(elf)]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout  # noqa: S603
    text, data, bss = map(int, said.splitlines()[1].split()[:3])
    return text + data, data + bss


def timing(frames: list[f.Frame]) -> tuple[int, int, int]:
    """The board's last message: latest and longest cycle, µs of its timer, and stack, bytes."""
    said = [STATUS.match(x.text) for x in frames if isinstance(x, f.StatusText)]
    latest, longest, stack = [m for m in said if m][-1].groups()
    return int(latest), int(longest), int(stack)


def flown(elf: Path) -> tuple[int, int]:
    """Worst cycle in instructions and most stack in bytes, with all that the bridge asks."""
    aircraft = Aircraft(Profile(), seed=1)
    board = EmulatedBoard(elf, options=('-icount', f'shift={SHIFT}'))
    port = os.open(board.path, os.O_RDWR | os.O_NOCTTY)
    os.set_blocking(port, False)
    encoder, decoder, frames = Encoder(1, 191), Decoder(), []
    asks = [
        f.ParamRequestList(), f.GainsCommand(f.GainsAction.OPEN, 1), f.TimeSync(0, 1),
        f.ParamSet('ROLL_RATE_KP', 0.1), f.GainsCommand(f.GainsAction.REVERT, 1),
    ]  # fmt: skip
    board.motors()
    board.send(boot(aircraft.profile).frame())
    for cycle in range(CYCLES):
        board.send(aircraft.measure(Channels(roll=0.5 if cycle % 500 > 250 else 0.0)))
        aircraft.move(board.motors())
        if cycle % 4 == 0:
            wave = f.Excitation((0.1, 0.0, 0.0), int(f.Injection.ATTITUDE), cycle % 256)
            os.write(port, encoder.encode(asks[cycle // 100 % 5] if cycle % 100 == 0 else wave))
        try:
            frames += decoder.feed(os.read(port, 65536))
        except BlockingIOError:
            continue
    os.close(port)
    board.close()
    _, longest, stack = timing(frames)
    return 100 * round(10 * longest / 2**SHIFT), stack


def paced(elf: Path) -> tuple[int, set[int], int, int, int]:
    """Timing of a board without chips: cycles, µs between two, latest and longest, µs, stack."""
    frames: list[f.Frame] = []
    decoder = Decoder()
    command = [EMULATOR, '-M', MACHINE, '-display', 'none', '-monitor', 'none', '-serial', 'stdio',
               '-kernel', str(elf), '-icount', 'shift=3,sleep=off']  # fmt: skip
    with subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE) as run:  # noqa: S603
        while run.stdout and sum(isinstance(x, f.Cycle) for x in frames) < CYCLES:
            frames += decoder.feed(os.read(run.stdout.fileno(), 65536))
        run.kill()
    cycles = [x for x in frames if isinstance(x, f.Cycle)]
    between = {b.time_us - a.time_us for a, b in pairwise(cycles)}
    return len(cycles), between, *timing(frames)


def table(build: Path) -> str:
    """The rows."""
    hil, own = build / 'stm32f405.elf', build / 'flight.elf'
    (hil_flash, hil_ram), (own_flash, own_ram) = size(hil), size(own)
    instructions, hil_stack = flown(hil)
    count, between, latest, longest, own_stack = paced(own)
    rows = [
        ('', '`stm32f405.elf`: sensors on the second line', "`flight.elf`: the paper's chips"),
        ('---', '---', '---'),
        ('flash, bytes', f'{hil_flash:,}', f'{own_flash:,}'),
        ('RAM without stack, bytes', f'{hil_ram:,}', f'{own_ram:,}'),
        ('stack, high-water mark, bytes', f'{hil_stack:,}', f'{own_stack:,} (no chip answered)'),
        ('worst cycle, instructions', f'{instructions:,}', f'{longest * 125:,} (waits for chips)'),
        ('cycles, µs of TIM2 between them', 'paced by the simulation',
         f'{count:,}: {", ".join(map(str, sorted(between)))}'),
        ('latest start behind its due time, µs', '–', f'{latest}'),
    ]  # fmt: skip
    return '\n'.join(f'| {" | ".join(row)} |' for row in rows)


if __name__ == '__main__':
    begin, end = '<!-- make firmware-table -->\n', '<!-- end -->'
    measured = table(Path(sys.argv[1]))
    head, rest = PAGE.read_text(encoding='utf-8').split(begin)
    PAGE.write_text(f'{head}{begin}{measured}\n{end}{rest.split(end)[1]}', encoding='utf-8')
    sys.stdout.write(measured + '\n')
