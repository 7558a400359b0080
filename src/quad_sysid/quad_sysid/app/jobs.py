"""The queue of the app: each job is a process of a command, one after the other.

The command sees a terminal on its standard error, so that it says there what it is doing; what it
prints goes to a file. No HTTP here.
"""

from __future__ import annotations

import json
import os
import pty
import re
import signal
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from quad_sysid.arguments import NOT_ANSWERED
from quad_sysid.axes import ALL_WORDS

MOST_JOBS = 200
"""Jobs that are remembered; the oldest finished ones are forgotten."""
MOST_WAITING = 20
TOOK = 'took.json'
"""Kind, size and time of a finished job, in its folder: what the time left is judged by."""
STOP_S = 5.0
"""Time for a process to end by itself before it is killed."""
MOST_TEXT = 200_000
"""Characters of a job's output that are shown."""
ESCAPES = re.compile(r'\x1b\[[0-9;]*[A-Za-z]')
STATES = {0: 'done', NOT_ANSWERED: 'no answer'}
PROGRAMS = {'quad-sysid': 'quad_sysid.start', 'quad-tune': 'quad_tuning.start'}


@dataclass
class Job:
    """One call of a command."""

    number: int
    title: str
    program: str
    arguments: tuple[str, ...]
    folder: Path
    """Where its output and results are."""
    state: str = 'waiting'
    """`waiting`, `running`, `done`, `no answer` (status 3), `failed`, `stopped`."""
    doing: str = ''
    """What it says that it is doing."""
    begun: float = 0.0
    ended: float = 0.0
    process: subprocess.Popen[bytes] | None = field(default=None, repr=False)
    expected: float = 0.0
    """Time that it will take by earlier jobs, s; 0 where none is known."""

    def remaining_s(self) -> float | None:
        """Time that is left, s, by earlier jobs of its kind; None where nothing says so."""
        if self.state != 'running' or not self.expected:
            return None
        return max(0.0, self.expected - self.seconds)

    @property
    def size(self) -> int:
        """What it works on: bytes of its files, times axes."""
        paths = [Path(a) for a in self.arguments if a.startswith('/') and Path(a).exists()]
        files = [f for path in paths for f in (path.iterdir() if path.is_dir() else [path])
                 if f.is_file() and self.folder not in f.parents]
        axes = [len(ALL_WORDS[word]) for word in self.arguments if word in ALL_WORDS]
        return max(axes, default=1) * sum(f.stat().st_size for f in files)

    @property
    def seconds(self) -> float:
        """Time that it has run."""
        return (self.ended or time.monotonic()) - self.begun if self.begun else 0.0

    def text(self) -> str:
        """What it printed."""
        with suppress(OSError):
            return (self.folder / 'output.txt').read_text(
                encoding='utf-8', errors='replace')[-MOST_TEXT:]
        return ''


class Queue:
    """Jobs in the order of their coming, one at a time, in a thread of its own."""

    def __init__(self) -> None:
        self._jobs: dict[int, Job] = {}
        self._wake = threading.Condition()
        self._closed = False
        self._last = 0
        self._thread = threading.Thread(target=self._work, name='jobs', daemon=True)
        self._thread.start()

    def add(self, title: str, program: str, arguments: Sequence[str], place: Path) -> Job:
        """Put a job at the end; its folder is made in `place`. ValueError where too many wait."""
        with self._wake:
            if sum(job.state == 'waiting' for job in self._jobs.values()) >= MOST_WAITING:
                raise ValueError(f'{MOST_WAITING} jobs wait already: stop some')
            number = self._last + 1
            while (folder := place / f'{number:03d}').exists():
                number += 1
            self._last = number
            folder.mkdir(parents=True)
            placed = tuple(str(folder / a.removeprefix('@')) if a.startswith('@') else a
                           for a in arguments)
            job = Job(number, title, program, placed, folder)
            self._jobs[number] = job
            for old in [j for j in self._jobs.values() if j.ended][:-MOST_JOBS]:
                del self._jobs[old.number]
            self._wake.notify()
            return job

    def get(self, number: int) -> Job | None:
        """A job by its number."""
        with self._wake:
            return self._jobs.get(number)

    def all(self) -> list[Job]:
        """All jobs, the latest first."""
        with self._wake:
            return sorted(self._jobs.values(), key=lambda job: -job.number)

    def stop(self, job: Job) -> None:
        """End a job, or take it from the queue."""
        with self._wake:
            if job.state == 'waiting':
                job.state, job.ended = 'stopped', time.monotonic()
                return
            if job.state != 'running' or job.process is None:
                return
            job.state, process = 'stopped', job.process
        _end(process)

    def close(self) -> None:
        """End everything."""
        with self._wake:
            self._closed = True
            jobs = list(self._jobs.values())
            self._wake.notify()
        for job in jobs:
            self.stop(job)
        self._thread.join(2.0 * STOP_S)

    def _work(self) -> None:
        while True:
            with self._wake:
                waiting = [j for j in self._jobs.values() if j.state == 'waiting']
                while not waiting and not self._closed:
                    self._wake.wait()
                    waiting = [j for j in self._jobs.values() if j.state == 'waiting']
                if self._closed:
                    return
                job = min(waiting, key=lambda j: j.number)
                job.state, job.begun = 'running', time.monotonic()
                job.expected = expected(job)
                ours, theirs = pty.openpty()
                try:
                    with (job.folder / 'output.txt').open('wb') as out:
                        job.process = _begin(job, out.fileno(), theirs)
                except OSError as error:
                    job.state, job.doing, job.ended = 'failed', str(error), time.monotonic()
                    os.close(ours)
                    continue
                finally:
                    os.close(theirs)
            _follow(job, ours)
            status = job.process.wait()
            with self._wake:
                job.ended = time.monotonic()
                if job.state == 'running':
                    job.state = STATES.get(status, 'failed')
            if job.state == 'done':
                with suppress(OSError):
                    (job.folder / TOOK).write_text(json.dumps(
                        [job.arguments[0], job.size, job.seconds]))


def expected(job: Job) -> float:
    """Time that a job will take, by the earlier ones of its kind: their median per byte."""
    per_byte = []
    for path in sorted(job.folder.parent.glob(f'*/{TOOK}'))[-MOST_JOBS:]:
        with suppress(OSError, ValueError, TypeError):
            kind, size, seconds = json.loads(path.read_text())
            if kind == job.arguments[0] and size > 0:
                per_byte.append(seconds / size)
    return statistics.median(per_byte) * job.size if per_byte else 0.0


def _begin(job: Job, out: int, terminal: int) -> subprocess.Popen[bytes]:
    code = f'import sys; from {PROGRAMS[job.program]} import main; sys.exit(main())'
    return subprocess.Popen(  # noqa: S603 - our own program, its arguments checked by the server
        [sys.executable, '-c', code, *job.arguments], stdin=subprocess.DEVNULL, stdout=out,
        stderr=terminal, start_new_session=True, cwd=job.folder,
        env={**os.environ, 'COLUMNS': '200', 'OPENBLAS_NUM_THREADS': '1'})


def _follow(job: Job, terminal: int) -> None:
    """Read what the command says until it ends; what is no progress is an error's line."""
    output, rest = [], ''
    while True:
        try:
            raw = os.read(terminal, 4096)
        except OSError:  # the other end is closed
            break
        if not raw:
            break
        rest += raw.decode('utf-8', errors='replace')
        *lines, rest = re.split(r'[\r\n]', rest)
        lines_now = [clean for line in lines if (clean := ESCAPES.sub('', line).strip())]
        output += lines_now
        latest = ESCAPES.sub('', rest).strip() or (lines_now[-1] if lines_now else '')
        job.doing = latest or job.doing
    os.close(terminal)
    last = ESCAPES.sub('', rest).strip() or (output[-1] if output else '')
    job.doing = last
    if last:
        with suppress(OSError), (job.folder / 'output.txt').open('a', encoding='utf-8') as out:
            out.write('' if last in job.text() else f'{last}\n')


def _end(process: subprocess.Popen[bytes]) -> None:
    """Ask the process and its children to end, then kill them."""
    for number, patience in ((signal.SIGINT, STOP_S), (signal.SIGKILL, STOP_S)):
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, number)
        with suppress(subprocess.TimeoutExpired):
            process.wait(patience)
            return
