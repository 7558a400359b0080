"""The firmware's process: its Linux build, or the STM32's own ELF in QEMU. No physics here."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import socket
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

from quad_bridge.virtual import hil
from quad_bridge.virtual.errors import ConfigurationError
from quad_bridge.virtual.native import PROGRAM, built_file

ELF, EMULATOR, MACHINE = 'stm32f405.elf', 'qemu-system-arm', 'netduinoplus2'
END_S = 10.0  # after which a firmware that does not end is killed
START_S = 60.0  # until the emulator must answer: a busy machine takes many seconds


class EndedError(Exception):
    """The firmware's process has ended, after a message that says why."""


class Board:
    """Sensors to the firmware, motors from it: the second line, at the first is the bridge."""

    def __init__(self, line: socket.socket, process: subprocess.Popen[bytes]) -> None:
        self._line, self._process = line, process

    @classmethod
    def linux(cls, *options: str | Path) -> Board:
        """The Linux build, with options of its own (boards/linux/main.c)."""
        line, board_end = socket.socketpair()
        with board_end:
            command = ['virtual_stm32', *map(str, options)]
            return cls(line, subprocess.Popen(  # noqa: S603
                command, executable=built_file(PROGRAM), stdin=board_end.fileno()
            ))  # fmt: skip

    def send(self, frame: bytes) -> None:
        """Give it a frame; EndedError where it has ended."""
        try:
            self._line.sendall(frame)
        except OSError as error:
            raise EndedError from error

    def motors(self) -> hil.Motors:
        """The firmware's motor commands; raises EndedError where its process has ended."""
        try:
            frame = self._line.recv(hil.MOTORS_BYTES, socket.MSG_WAITALL)
        except OSError as error:
            raise EndedError from error
        if len(frame) < hil.MOTORS_BYTES:
            raise EndedError
        return hil.motors(frame)

    @property
    def running(self) -> bool:
        """Whether it has not ended by itself."""
        return self._process.poll() is None

    def close(self) -> int:
        """Hang up, which ends it; its status."""
        self._line.close()
        try:
            return self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            return self._process.wait()


class EmulatedBoard(Board):
    """USART1 is a pseudo-terminal of QEMU's, USART2 a socket to the simulation.

    `options` are QEMU's own.
    """

    def __init__(self, elf: Path, link: Path | None = None, options: Sequence[str] = ()) -> None:
        emulator = shutil.which(EMULATOR)
        if emulator is None:
            remedy = 'on Debian and Ubuntu apt install qemu-system-arm'
            raise ConfigurationError('--qemu', f'{EMULATOR} is not installed', remedy=remedy)
        with tempfile.TemporaryDirectory() as folder, socket.socket(socket.AF_UNIX) as listener:
            path = str(Path(folder) / 'line')
            listener.bind(path)
            listener.listen()
            listener.settimeout(START_S)
            process = subprocess.Popen(  # noqa: S603
                [emulator, '-M', MACHINE, '-display', 'none', '-monitor', 'none',
                 '-kernel', str(elf), '-chardev', 'pty,id=bridge', '-serial', 'chardev:bridge',
                 '-chardev', f'socket,id=simulation,path={path}',
                 '-serial', 'chardev:simulation', *options],
                stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            )  # fmt: skip
            try:
                line, _ = listener.accept()
            except OSError as error:
                process.kill()
                text = process.communicate()[0].decode(errors='replace')
                raise ConfigurationError('--qemu', f'{EMULATOR} did not start: {text}') from error
        line.settimeout(None)
        super().__init__(line, process)
        self.path, self._link = self._pseudo_terminal(), link
        if link is not None:
            temporary = link.with_name(f'.{link.name}.{os.getpid()}')
            temporary.symlink_to(self.path)
            temporary.replace(link)

    def _pseudo_terminal(self) -> str:
        output = self._process.stdout.readline().decode() if self._process.stdout else ''
        match = re.search(r'/dev/pts/\d+', output)
        if match is None:
            self._process.kill()
            raise ConfigurationError('--qemu', f'{EMULATOR} names no port: {output}')
        return match[0]

    def close(self) -> int:
        """End it; 0 where it ran until now."""
        ended = self._process.poll()
        self._process.kill()
        super().close()
        if self._link is not None:
            with contextlib.suppress(OSError):
                if str(self._link.readlink()) == self.path:
                    self._link.unlink()
        return 0 if ended is None else 1
