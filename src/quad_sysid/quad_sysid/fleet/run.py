"""The run over a fleet: finds bags, skips what is done, hands the rest to Dask, keeps each row.

Rows lie in a journal that grows line by line: a line is written when its bag is done, so a run
that is killed goes on where it stood.
"""

from __future__ import annotations

import json
import os
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from quad_sysid.errors import BadInputError
from quad_sysid.files import make_folder, write_whole
from quad_sysid.fleet.row import FAILED, REAL, TEXT, WHOLE, Job, Row, look

STORAGE = ('.mcap', '.db3', '.mcap.zstd', '.db3.zstd')


def bags(folder: Path) -> list[Path]:
    """Sorted; a folder with storage files in it and metadata.yaml, or a torn bag, is one bag.

    Raises BadInputError where there is no such folder or no bag in it.
    """
    if not folder.is_dir():
        raise BadInputError(str(folder), 'is not a folder',
                            remedy='give the one that holds the bags')
    found = []
    for root, folders, files in os.walk(folder):
        here = Path(root)
        stored = [name for name in files if name.endswith(STORAGE)]
        named = any(name.startswith(f'{here.name}_') for name in stored)  # as recorders name them
        if 'metadata.yaml' in files or named:
            folders.clear()
            found.append(here)
        else:
            found += [here / name for name in stored if name.endswith('.mcap')]
    if not found:
        raise BadInputError(str(folder), 'holds no bag (a rosbag2 folder or an .mcap file)',
                            remedy='check the path')
    return sorted(found)


def fingerprint(bag: Path) -> str:
    """Size and latest change of a bag's files."""
    files = [bag] if bag.is_file() else [p for p in bag.iterdir() if p.is_file()]
    stats = [p.stat() for p in files]
    return f'{sum(s.st_size for s in stats)}-{max((s.st_mtime_ns for s in stats), default=0)}'


JOURNAL = 'rows.jsonl'
TABLE = 'fleet.parquet'


class Journal:
    """The journal in a folder; the last line of a bag counts."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / JOURNAL
        make_folder(folder)

    def rows(self) -> dict[str, Row]:
        """Rows by bag; a line that a kill cut off is left out."""
        found: dict[str, Row] = {}
        try:
            text = self._path.read_text(encoding='utf-8')
        except FileNotFoundError:
            return found
        for row in map(_row, text.splitlines()):
            if row is not None:
                found[row['bag']] = row
        return found

    def add(self, row: Row) -> None:
        """Append one row and have the disk keep it."""
        with self._path.open('a+b') as stream:
            if stream.tell():
                stream.seek(-1, os.SEEK_END)
                if stream.read(1) != b'\n':  # a kill cut the last line off
                    stream.write(b'\n')
            stream.write((json.dumps(row) + '\n').encode())
            stream.flush()
            os.fsync(stream.fileno())


def _row(line: str) -> Row | None:
    try:
        row = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return row if isinstance(row, dict) and 'bag' in row else None


def write_table(rows: Sequence[Row], path: Path) -> Path:
    """Write rows as Parquet with fixed columns and types; needs pyarrow."""
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError as error:
        raise BadInputError(str(path), 'needs the package pyarrow',
                            remedy='pip install pyarrow') from error
    schema = pa.schema([*((name, pa.string()) for name in TEXT),
                        *((name, pa.int64()) for name in WHOLE),
                        *((name, pa.float64()) for name in REAL)])
    content = {name: [row.get(name) for row in rows] for name in schema.names}
    sink = pa.BufferOutputStream()
    parquet.write_table(pa.table(content, schema=schema), sink)
    write_whole(path, sink.getvalue().to_pybytes())
    return path


AHEAD = 4
"""Bags in the queue per worker: thousands need not all be described to the scheduler at once."""
LOOK_S = 1.0
"""Interval at which the workers are counted, s."""
ENDED = ('closing', 'closed', 'failed')
"""States of a process' keeper (Dask's nanny) that starts no worker any more."""
SETTINGS = {
    'distributed.deploy.lost-worker-timeout': '1 day',  # a busy machine is slow to start it again
    'distributed.scheduler.allowed-failures': 0,  # a bag is tried again here, and by itself
}
"""Settings of Dask for processes of this machine."""


@dataclass(frozen=True)
class Request:
    """Options of a fleet run."""

    folder: Path
    out: Path
    axes: tuple[str, ...] = ()
    search_effects: bool = True
    scheduler: str = ''
    """Address of a Dask scheduler; empty: processes of this machine."""
    workers: int = 0
    """Processes; 0: one per core."""
    keep_reports: bool = False
    again: bool = False
    """Look at bags anew that failed before."""


def jobs(request: Request) -> list[Job]:
    """Every bag of the fleet; raises BadInputError where there is none."""
    found = []
    for bag in bags(request.folder):
        below = bag.relative_to(request.folder)
        found.append(Job(
            bag=str(bag.resolve()), name=str(below) if below.parts else bag.name,
            aircraft=below.parts[0] if len(below.parts) > 1 else '', fingerprint=fingerprint(bag),
            axes=request.axes, search_effects=request.search_effects,
            keep=str((request.out / 'reports').resolve()) if request.keep_reports else '',
        ))
    return found


def waiting(every: Sequence[Job], done: Mapping[str, Row], *, again: bool) -> list[Job]:
    """Those that have no row yet, or whose files changed since, or that failed (`again`)."""
    return [
        job for job in every
        if job.name not in done or done[job.name].get('fingerprint') != job.fingerprint
        or (again and done[job.name]['status'] == FAILED)
    ]


def run(request: Request, progress: Callable[[str], None] = lambda _: None,
        work: Callable[[Job], Row] = look) -> list[Row]:
    """Look at all bags that wait; the rows of all bags of the folder, in their order."""
    every = jobs(request)
    journal = Journal(request.out)
    todo = waiting(every, journal.rows(), again=request.again)
    if todo:
        with _client(request, len(todo)) as client:
            for number, row in enumerate(_rows(client, todo, work), 1):
                journal.add(row)
                progress(f'bag {min(number + 1, len(todo))} of {len(todo)}, {row["bag"]} '
                         f'{row["status"]}')
    progress('')
    done = journal.rows()
    return [done[job.name] for job in every if job.name in done]


@contextmanager
def _client(request: Request, count: int) -> Iterator[Any]:
    try:
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise BadInputError('fleet', 'needs the package distributed (Dask)',
                            remedy='pip install "quad_sysid[fleet]"') from error
    if request.scheduler:
        try:
            client = Client(request.scheduler, timeout='20s', set_as_default=False)
        except (OSError, ValueError) as error:
            raise BadInputError('--scheduler', 'cannot be reached', request.scheduler,
                                'check the address, or leave it out') from error
        with client:
            yield client
        return
    import dask

    workers = min(request.workers or os.cpu_count() or 1, count)
    with (
        dask.config.set(SETTINGS),
        LocalCluster(n_workers=workers, threads_per_worker=1, processes=True,
                     dashboard_address=None, silence_logs='ERROR', memory_limit=0) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        yield client


def _rows(client: Any, todo: Sequence[Job], work: Callable[[Job], Row]) -> Iterator[Row]:
    """Rows as they come; a bag whose worker died is a row that says so.

    A dying worker takes along what else was handed to it: those bags are tried again, one at a
    time, at the end, so that only the one that kills is blamed.
    """
    suspects: list[Job] = []
    ahead = AHEAD * max(1, sum(client.nthreads().values()))
    for bags_now, width in ((todo, ahead), (suspects, 1)):
        queue = deque(bags_now)
        running: dict[Any, Job] = {}
        while queue or running:
            while queue and len(running) < width:
                job = queue.popleft()
                running[client.submit(work, job, pure=False)] = job
            done = _done(client, list(running))
            if not done:
                for job in (*running.values(), *queue, *(suspects if width > 1 else ())):
                    yield _dead(job, 'no worker is left, and none can be started')
                return
            for future in done:
                job, error = running.pop(future), future.exception()
                if error is None:
                    yield future.result()
                elif width > 1:
                    suspects.append(job)
                else:
                    yield _dead(job, f'its worker died ({type(error).__name__})')
                future.release()


def _done(client: Any, running: Sequence[Any]) -> Sequence[Any]:
    """Finished tasks, as soon as there are any; none where no worker is left."""
    from distributed import TimeoutError as Pending
    from distributed import wait

    while True:
        with suppress(Pending), client.as_current():
            return list(wait(running, timeout=LOOK_S, return_when='FIRST_COMPLETED').done)
        nannies = getattr(client.cluster, 'workers', None)  # None: a scheduler elsewhere
        if nannies is not None and all(n.status.name in ENDED for n in nannies.values()):
            return []


def _dead(job: Job, reason: str) -> Row:
    return {'bag': job.name, 'aircraft': job.aircraft, 'fingerprint': job.fingerprint,
            'status': FAILED, 'reason': reason, 'seconds': 0.0}
