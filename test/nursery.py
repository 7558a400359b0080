"""One Python that has imported what programs import, and forks them: a tenth of a start's cost.

`python nursery.py SOCKET` is that process; `Nursery` is its client. What a test is to see of the
imports needs a Python of its own (node_process.Started).
"""

from __future__ import annotations

import gc
import importlib
import json
import os
import select
import signal
import socket
import struct
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

MOST = 1 << 17
"""Bytes of a request."""
NUMBER = struct.Struct('i')
ONE_THREAD = {'OPENBLAS_NUM_THREADS': '1'}
"""A thread does not survive a fork. Nor may one begin after it: the tracing library below rclpy
cancels its own threads at exit, by numbers that a new thread of the fork may bear, and OpenBLAS
then waits for ever for the one it had."""


class Forked:
    """As `subprocess.Popen` for a process that the nursery has forked."""

    def __init__(self, told: int) -> None:
        """`told`: where its number comes, and its status when it has ended."""
        self._told, self._status = told, None
        self.pid = self._hear()

    def _hear(self) -> int:
        data = os.read(self._told, NUMBER.size)
        assert data, 'the nursery has ended'
        return int(NUMBER.unpack(data)[0])

    def _ended(self, wait_s: float) -> int | None:
        if self._status is None and select.select([self._told], [], [], wait_s)[0]:
            self._status = self._hear()
            os.close(self._told)
        return self._status

    def poll(self) -> int | None:
        return self._ended(0.0)

    def wait(self, timeout: float) -> int:
        status = self._ended(timeout)
        if status is None:
            raise subprocess.TimeoutExpired(str(self.pid), timeout)
        return status

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


class Nursery:
    """Forks `python -c CODE WORDS`, after it has imported `modules` for all that come later."""

    def __init__(self) -> None:
        self._line, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._process = subprocess.Popen(
            [sys.executable, __file__, str(there.fileno())], pass_fds=[there.fileno()],
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
            env={**os.environ, **ONE_THREAD},
        )  # fmt: skip
        there.close()

    def fork(
        self, modules: Sequence[str], code: str, words: Sequence[str], streams: Sequence[int],
        cwd: object = None, env: Mapping[str, str] | None = None,
    ) -> Forked:
        """`streams`: descriptors for its stdin, stdout and stderr."""
        about = {'modules': modules, 'code': code, 'words': words, 'cwd': str(cwd or Path.cwd()),
                 'env': {**(os.environ if env is None else env), **ONE_THREAD}}  # fmt: skip
        heard, told = os.pipe()
        socket.send_fds(self._line, [json.dumps(about).encode()], [*streams, told])
        os.close(told)
        return Forked(heard)

    def close(self) -> None:
        self._line.close()
        self._process.wait()


def serve(line: socket.socket) -> dict[str, Any]:
    """Fork as asked for. Returns in the new process, with what it is to be; ends with the line."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal's are for who started it
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    while True:
        data, given, *_ = socket.recv_fds(line, MOST, 4)
        if not data:
            os._exit(0)
        about = json.loads(data)
        for module in about['modules']:
            importlib.import_module(module)
        gc.freeze()  # no collection of a fork touches, and so copies, what was imported
        if not os.fork():  # one that waits for it, and says how it has ended
            *streams, told = given
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            if not (pid := os.fork()):
                signal.signal(signal.SIGINT, signal.default_int_handler)
                signal.signal(signal.SIGHUP, signal.SIG_DFL)
                for number, stream in enumerate(streams):
                    os.dup2(stream, number)
                for number in (*given, line.detach()):
                    os.close(number)
                return about
            for stream in streams:
                os.close(stream)
            os.write(told, NUMBER.pack(pid))
            os.write(told, NUMBER.pack(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])))
            os._exit(0)
        for number in given:
            os.close(number)


if __name__ == '__main__':
    wanted = serve(socket.socket(fileno=int(sys.argv[1])))
    os.chdir(wanted['cwd'])
    os.environ.clear()
    os.environ.update(wanted['env'])
    sys.argv = ['-c', *wanted['words']]
    exec(wanted['code'], {'__name__': '__main__'})  # noqa: S102
