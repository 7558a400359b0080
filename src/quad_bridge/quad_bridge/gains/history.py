"""The files of each aircraft: every set of gains that was active, and its polarity check.

`<folder>/<aircraft>/gains.jsonl` is only ever appended to, one line per event, each on the disk
before the next; `polarity.json` and `flight.json`, how it last flew well, are replaced whole. A
thread of its own writes: a disk that takes seconds delays no control cycle and no confirmation.
`quad-tune history` reads the first file by itself.
"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import threading
import time
from collections.abc import Callable, Mapping
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from quad_bridge.gains.gate import GainRequest

Jobs = queue.SimpleQueue[Callable[[], object] | None]
SCHEMA = 'quad_bridge/gains/1'
HISTORY, POLARITY = 'gains.jsonl', 'polarity.json'
FLIGHT, TRIAL = 'flight', 'trial'
CLOSE_S = 2.0  # how long the last lines are waited for when the node ends


def default_folder() -> Path:
    """Folder for lasting files: `$ROS_HOME/quad_suite`, or in `~/.ros`."""
    ros_home = os.environ.get('ROS_HOME')
    return (Path(ros_home) if ros_home else Path.home() / '.ros') / 'quad_suite'


class Worker:
    """Runs jobs one after the other in a thread, which starts with the first."""

    def __init__(self) -> None:
        self._jobs = Jobs()
        self._thread: threading.Thread | None = None

    def __call__(self, job: Callable[[], object]) -> None:
        """Run `job` soon; it must not raise."""
        if self._thread is None:
            self._jobs = Jobs()  # the thread before may still hang in the disk, with its own
            self._thread = threading.Thread(
                target=_work, args=(self._jobs,), name='gain history', daemon=True
            )
            self._thread.start()
        self._jobs.put(job)

    def close(self) -> None:
        """Wait briefly for the remaining jobs."""
        if self._thread is not None:
            self._jobs.put(None)
            self._thread.join(timeout=CLOSE_S)
            self._thread = None


def _work(jobs: Jobs) -> None:
    while (job := jobs.get()) is not None:
        job()


class History:
    """The files of the connected aircraft; none is written before its name is known.

    Nothing raises: a full disk must not keep gains from being rolled back. `run` takes the work
    of writing, a `Worker` or something that does it at once.
    """

    def __init__(self, folder: Path, run: Callable[[Callable[[], object]], None]) -> None:
        self.fault = ''  # what keeps the files from being written
        self._folder, self._run = folder, run
        self._aircraft = ''
        self._last: Mapping[str, float] = {}
        self._count = 0

    def open(self, aircraft: str) -> dict[str, Any] | None:
        """Take this aircraft's files; what they say where it is another one than before.

        Reads small files: the polarity record, under `flight` how it last flew well, and under
        `trial` the gains to return to. Nothing of what was not kept, or is damaged.
        """
        if aircraft in {'', self._aircraft}:
            return None
        self._aircraft, self._last = aircraft, {}
        return self.stored(POLARITY) | self.stored(f'{FLIGHT}.json') | self.stored(f'{TRIAL}.json')

    def stored(self, name: str) -> dict[str, Any]:
        """Content of one of the aircraft's files that are replaced whole; {} without that file."""
        try:
            path = self._folder / self._aircraft / name
            content = json.loads(path.read_text(encoding='utf-8'))
        except (OSError, ValueError, RecursionError):
            return {}
        return content if isinstance(content, dict) else {}

    def leave(self, aircraft: str) -> bool:
        """Close the files of any other aircraft than this; whether there were such."""
        if self._aircraft in {'', aircraft}:
            return False
        self._aircraft, self._last = '', {}
        return True

    def identity(self) -> str:
        """A name for a new update."""
        self._count += 1
        return f'{datetime.now(timezone.utc):%Y%m%dT%H%M%S}-{self._count}'

    def note_active(self, active: Mapping[str, float]) -> None:
        """Store gains read from the aircraft, if they differ from the last ones stored."""
        if active and active != self._last:
            self.write('active', active, reason='read from the aircraft')

    def write(
        self,
        state: str,
        active: Mapping[str, float] | None = None,
        request: GainRequest | None = None,
        **more: object,
    ) -> None:
        """Write one line: a set that is now active, or the outcome of an update."""
        if not self._aircraft:
            return
        entry: dict[str, object] = {'time': now_text(), 'clock_s': time.time(), 'state': state}
        if request is not None:
            entry |= {'source': request.source, 'model': request.model, 'bag': request.bag}
        if active is not None:
            self._last = active
            entry['gains'] = dict(active)
        entry |= more
        record = {'schema': SCHEMA, **{k: v for k, v in entry.items() if v not in ('', {}, None)}}
        path, line = self._folder / self._aircraft / HISTORY, json.dumps(record, allow_nan=False)
        self._run(lambda: self._append(path, line))

    def keep_polarity(self, record: Mapping[str, Any]) -> None:
        """Replace the aircraft's polarity record."""
        self._keep(POLARITY, record)

    def keep_flight(self, figures: object) -> None:
        """Replace the figures of the aircraft's last good flight."""
        self._keep(f'{FLIGHT}.json', {FLIGHT: figures})

    def keep_trial(self, record: Mapping[str, object], done: Callable[[bool], None]) -> None:
        """Replace what a trial of gains has to return to; `done` gets whether it is there."""
        self._keep(f'{TRIAL}.json', record, done)

    def _keep(self, name: str, record: Mapping[str, Any],
              done: Callable[[bool], object] = bool) -> None:
        if self._aircraft:
            path = self._folder / self._aircraft / name
            text = json.dumps({**record, 'time': now_text()}, indent=1) + '\n'
            self._run(lambda: done(self._replace(path, text)))
        else:
            done(False)

    def _append(self, path: Path, line: str) -> None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            file = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT, 0o644)
            try:
                remaining = f'{_torn(file)}{line}\n'.encode()
                while remaining:  # a disk that fills up takes a part
                    remaining = remaining[os.write(file, remaining) :]
                os.fsync(file)
            finally:
                os.close(file)
            self.fault = ''
        except OSError as error:
            what = f'cannot be written ({error.strerror})'
            self.fault = f'{path}: {what}; no gains are taken that nobody could trace'
            self._last = {}  # not stored: when they are read again, they are written again

    def _replace(self, path: Path, text: str) -> bool:
        """Replace a file, on the disk when this returns; whether that was done."""
        temporary = path.with_suffix(f'.{os.getpid()}')
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with temporary.open('w', encoding='utf-8') as file:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(path)
        except OSError as error:
            self.fault = f'{path}: cannot be written ({error.strerror})'
            self._last = {}
            with contextlib.suppress(OSError):
                temporary.unlink()
            return False
        return True


def now_text() -> str:
    """UTC, to the millisecond."""
    return datetime.now(timezone.utc).isoformat(timespec='milliseconds')


def _torn(file: int) -> str:
    """A line end, if a crash left half a line."""
    size = os.fstat(file).st_size
    return '\n' if size and os.pread(file, 1, size - 1) != b'\n' else ''
