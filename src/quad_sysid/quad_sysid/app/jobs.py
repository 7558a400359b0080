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

from quad_sysid.app.folder import RefusedError
from quad_sysid.arguments import NOT_ANSWERED
from quad_sysid.axes import ALL_WORDS
from quad_sysid.files import escaped

MOST_JOBS = 200
"""Jobs that are remembered; the oldest finished ones are forgotten."""
MOST_WAITING = 20
JOB_FILE = 'job.json'
"""What a job was and what became of it, in its folder: the next start of the app shows it, and by
size and time of those that are done the time left is judged."""
STOP_S = 5.0
"""Time for a process to end by itself before it is killed."""
MOST_TEXT = 200_000
"""Characters of a job's output that are shown."""
OUTPUT = 'output.txt'
OWN = '\0'
"""Begins an argument that lies in the job's own folder; no word of a command line can hold it."""
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
    """Folder of its output and results."""
    state: str = 'waiting'
    """`waiting`, `running`, `done`, `no answer` (status 3), `failed`, `stopped`."""
    doing: str = ''
    """Its last line of progress."""
    start_s: float = 0.0
    ended: float = 0.0
    process: subprocess.Popen[bytes] | None = field(default=None, repr=False)
    expected: float = 0.0
    """Expected duration by earlier jobs, s; 0 where there was none."""
    after: Sequence[Job] = ()
    """Jobs whose bags it reads: without them it is not begun."""

    def remaining_s(self) -> float | None:
        """Remaining time, s, by earlier jobs of its kind; None where there was none."""
        if self.state != 'running' or not self.expected:
            return None
        return max(0.0, self.expected - self.seconds)

    @property
    def size(self) -> int:
        """Amount of its work: bytes of its files, times the number of axes."""
        paths = [Path(a) for a in self.arguments if a.startswith('/') and Path(a).exists()]
        files = [f for path in paths for f in (path.iterdir() if path.is_dir() else [path])
                 if f.is_file() and self.folder not in f.parents]
        axes = [len(ALL_WORDS[word]) for word in self.arguments if word in ALL_WORDS]
        return max(axes, default=1) * sum(f.stat().st_size for f in files)

    @property
    def seconds(self) -> float:
        """Time that it has run."""
        return (self.ended or time.monotonic()) - self.start_s if self.start_s else 0.0

    def keep(self) -> None:
        """Write title, command and outcome into its folder."""
        with suppress(OSError):
            (self.folder / JOB_FILE).write_text(json.dumps({
                'title': self.title, 'program': self.program, 'arguments': self.arguments,
                'state': self.state, 'doing': self.doing, 'seconds': self.seconds,
                'size': self.size}))

    def say(self, line: str) -> None:
        """Append a line to its output, unless it is there."""
        self.doing = line
        with suppress(OSError), (self.folder / OUTPUT).open('a', encoding='utf-8') as out:
            out.write('' if line in self.text() else f'{line}\n')

    def text(self) -> str:
        """The output that it printed, its last MOST_TEXT characters."""
        with suppress(OSError):
            return (self.folder / OUTPUT).read_text(
                encoding='utf-8', errors='replace')[-MOST_TEXT:]
        return ''


class Queue:
    """Jobs in the order of their coming, one at a time, in a thread of its own."""

    def __init__(self, place: Path) -> None:
        """`place`: the folder of their folders, which may hold those of an earlier start."""
        self._place = place
        self._jobs = {job.number: job for job in earlier_jobs(place)}
        self._wake = threading.Condition()
        self._closed = False
        self._last = max(self._jobs, default=0)
        self._thread = threading.Thread(target=self._work, name='jobs', daemon=True)
        self._thread.start()

    def add_all(self, commands: Sequence[tuple[str, str, Sequence[str]]]) -> Job:
        """Put all, or none, at the end (RefusedError: too many wait). The last needs the rest."""
        *before, last = commands
        with self._wake:
            if sum(job.state == 'waiting' for job in self._jobs.values()) >= MOST_WAITING:
                raise RefusedError(f'{MOST_WAITING} jobs wait already: stop some')
            return self.add(*last, after=[self.add(*one) for one in before])

    def add(self, title: str, program: str, arguments: Sequence[str],
            after: Sequence[Job] = ()) -> Job:
        """Put a job at the end and make its folder."""
        with self._wake:
            number = self._last + 1
            while (folder := self._place / f'{number:03d}').exists():
                number += 1
            self._last = number
            folder.mkdir(parents=True)
            full_arguments = tuple(str(folder / a.removeprefix(OWN)) if a.startswith(OWN) else a
                                   for a in arguments)
            job = Job(number, escaped(title), program, full_arguments, folder, after=after)
            self._jobs[number] = job
            job.keep()
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
                job.keep()
                return
            if job.state != 'running' or job.process is None:
                return
            job.state, process = 'stopped', job.process
        _end(process)

    def promised(self) -> set[str]:
        """Paths that jobs will read or write which have not ended."""
        with self._wake:
            return {a for job in self._jobs.values() if not job.ended for a in job.arguments}

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
                job.start_s = time.monotonic()
                lacks = next((one for one in job.after if one.state != 'done'), None)
                if lacks is not None:
                    job.state, job.ended = lacks.state, job.start_s
                    job.say(f'{lacks.title}: {lacks.doing or lacks.state}')
                    job.keep()
                    continue
                output, terminal = pty.openpty()
                try:
                    job.state, job.expected = 'running', expected(job)
                    with (job.folder / OUTPUT).open('wb') as out:
                        job.process = _begin(job, out.fileno(), terminal)
                except OSError as error:
                    job.state, job.ended = 'failed', time.monotonic()
                    job.say(f'{error.filename}: {error.strerror}; check the folder and the disk')
                    job.keep()
                    os.close(output)
                    continue
                finally:
                    os.close(terminal)
                job.keep()
            follow(job, output)
            status = job.process.wait()
            with self._wake:
                job.ended = time.monotonic()
                if job.state == 'running':
                    job.state = STATES.get(status, 'failed')
            job.keep()


def earlier_jobs(place: Path) -> list[Job]:
    """The latest jobs of earlier starts; what had not ended then is stopped."""
    jobs, now = [], time.monotonic()
    paths = sorted(place.glob(f'*/{JOB_FILE}'), key=lambda path: path.lstat().st_mtime)
    for path in paths[-MOST_JOBS:]:
        with suppress(OSError, ValueError, TypeError, KeyError):
            tree = json.loads(path.read_text(encoding='utf-8'))
            kind, *more = map(str, tree['arguments'])
            job = Job(int(path.parent.name), str(tree['title']), str(tree['program']),
                      (kind, *more), path.parent, str(tree['state']), str(tree['doing']),
                      now - float(tree['seconds']), now)
            if job.state in {'waiting', 'running'}:
                job.state, job.doing = 'stopped', 'the app ended first: start it again'
            jobs.append(job)
    return jobs


def expected(job: Job) -> float:
    """Time that a job will take, by the earlier ones of its kind: their median per byte."""
    per_byte = []
    for path in sorted(job.folder.parent.glob(f'*/{JOB_FILE}'))[-MOST_JOBS:]:
        with suppress(OSError, ValueError, TypeError, KeyError):
            tree = json.loads(path.read_text(encoding='utf-8'))
            is_same_kind = tree['state'] == 'done' and tree['arguments'][0] == job.arguments[0]
            if is_same_kind and tree['size'] > 0:
                per_byte.append(tree['seconds'] / tree['size'])
    return statistics.median(per_byte) * job.size if per_byte else 0.0


def _begin(job: Job, out: int, terminal: int) -> subprocess.Popen[bytes]:
    code = f'import sys; from {PROGRAMS[job.program]} import main; sys.exit(main())'
    return subprocess.Popen(  # noqa: S603 - our own program, its arguments checked by the server
        [sys.executable, '-c', code, *job.arguments], stdin=subprocess.DEVNULL, stdout=out,
        stderr=terminal, start_new_session=True, cwd=job.folder,
        env={**os.environ, 'COLUMNS': '200', 'OPENBLAS_NUM_THREADS': '1'})


def follow(job: Job, terminal: int) -> None:
    """Read what the command says until it ends; a line that it does not wipe is an error's."""
    last, rest = '', ''
    while True:
        try:
            raw = os.read(terminal, 4096)
        except OSError:  # the other end is closed
            break
        if not raw:
            break
        rest += raw.decode('utf-8', errors='replace')
        *lines, rest = re.split(r'\r?\n', rest)
        last = next(filter(None, map(_seen, reversed(lines))), last)
        job.doing = _seen(rest) or (last if lines else '') or job.doing
    os.close(terminal)
    if last := _seen(rest) or last:
        job.say(last)


def _seen(line: str) -> str:
    """What stands on a line of the terminal after all that wiped it."""
    return ESCAPES.sub('', line).rpartition('\r')[2].strip()


def _end(process: subprocess.Popen[bytes]) -> None:
    """Ask the process and its children to end, then kill them."""
    for number, timeout_s in ((signal.SIGINT, STOP_S), (signal.SIGKILL, STOP_S)):
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, number)
        with suppress(subprocess.TimeoutExpired):
            process.wait(timeout_s)
            return
