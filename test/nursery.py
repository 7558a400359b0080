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
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

MOST = 1 << 17
"""Bytes of a request or an answer."""
ONE_THREAD = {'OPENBLAS_NUM_THREADS': '1'}
"""A thread does not survive a fork. Nor may one begin after it: the tracing library below rclpy
cancels its own threads at exit, by numbers that a new thread of the fork may bear, and OpenBLAS
then waits for ever for the one it had."""


class Forked:
    """As `subprocess.Popen` for a process that the nursery has forked."""

    def __init__(self, nursery: Nursery, pid: int) -> None:
        self._nursery, self.pid = nursery, pid

    def poll(self) -> int | None:
        return self._nursery.status_of(self.pid, 0.0)

    def wait(self, timeout: float) -> int:
        status = self._nursery.status_of(self.pid, timeout)
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
        self._ended: dict[int, int] = {}

    def fork(
        self, modules: Sequence[str], code: str, words: Sequence[str], streams: Sequence[int],
        cwd: object = None, env: Mapping[str, str] | None = None,
    ) -> Forked:
        """`streams`: descriptors for its stdin, stdout and stderr."""
        about = {'modules': modules, 'code': code, 'words': words, 'cwd': str(cwd or Path.cwd()),
                 'env': {**(os.environ if env is None else env), **ONE_THREAD}}  # fmt: skip
        socket.send_fds(self._line, [json.dumps(about).encode()], list(streams))
        while (begun := self._hear()) is None:
            pass
        return Forked(self, begun)

    def status_of(self, pid: int, wait_s: float) -> int | None:
        end_s = time.monotonic() + wait_s
        while pid not in self._ended:
            left_s = max(end_s - time.monotonic(), 0.0)
            if not select.select([self._line], [], [], left_s)[0]:
                return None
            self._hear()
        return self._ended[pid]

    def _hear(self) -> int | None:
        """The number of a process that has begun; of those that have ended the status is kept."""
        data = self._line.recv(MOST)
        assert data, 'the nursery has ended'
        told = json.loads(data)
        if 'ended' in told:
            self._ended[told['ended']] = told['status']
        return told.get('begun')

    def close(self) -> None:
        self._line.close()
        self._process.wait()


def serve(line: socket.socket) -> dict[str, Any]:
    """Fork as asked for. Returns in the new process, with what it is to be; ends with the line."""
    heard, wake = os.pipe()
    os.set_blocking(wake, False)
    signal.set_wakeup_fd(wake)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal's is for who started it
    while True:
        ready, _, _ = select.select([line, heard], [], [])
        if heard in ready:
            os.read(heard, 4096)
            for pid, status in iter(next_ended, None):
                line.send(json.dumps({'ended': pid, 'status': status}).encode())
        if line in ready:
            data, streams, *_ = socket.recv_fds(line, MOST, 3)
            if not data:
                os._exit(0)
            about = json.loads(data)
            for module in about['modules']:
                importlib.import_module(module)
            gc.freeze()  # no collection of a fork touches, and so copies, what was imported
            if not (pid := os.fork()):
                take_over(streams, [line.detach(), heard, wake])
                return about
            line.send(json.dumps({'begun': pid}).encode())
            for stream in streams:
                os.close(stream)


def take_over(streams: Sequence[int], others: Sequence[int]) -> None:
    """Have these streams, and nothing of the nursery's."""
    signal.set_wakeup_fd(-1)
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for number, stream in enumerate(streams):
        os.dup2(stream, number)
    for number in (*streams, *others):
        os.close(number)


def next_ended() -> tuple[int, int] | None:
    try:
        pid, status = os.waitpid(-1, os.WNOHANG)
    except ChildProcessError:
        return None
    return (pid, os.waitstatus_to_exitcode(status)) if pid else None


if __name__ == '__main__':
    wanted = serve(socket.socket(fileno=int(sys.argv[1])))
    os.chdir(wanted['cwd'])
    os.environ.clear()
    os.environ.update(wanted['env'])
    sys.argv = ['-c', *wanted['words']]
    exec(wanted['code'], {'__name__': '__main__'})  # noqa: S102
