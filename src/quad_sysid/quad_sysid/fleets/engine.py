"""Rows for all bags that wait, as they come: by threads of this machine, or by Dask.

A bag is done while the results hold a row of it that answers what is asked; what is asked and is
not there is made. Nothing else is remembered, so a run that is ended continues with the next call,
beside others, and from wherever bags and results have been moved.
"""

from __future__ import annotations

import hashlib
import json
import platform
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from quad_sysid.errors import BadInputError
from quad_sysid.fleets.bag import FAILED, Job, Row, alone, blank, content_of, keep, look
from quad_sysid.fleets.place import Place

Work = Callable[[Job], Row]
SAMPLE = 10
"""Bags by which the cost of all is foretold."""
TIMEOUT_S = 30.0
"""Longest time for a scheduler to answer, and for a first worker to join it."""
SETTINGS = {
    'distributed.scheduler.allowed-failures': 1,  # a worker that dies: one more try
    'distributed.deploy.lost-worker-timeout': '1 day',  # a busy machine is slow to start it again
    'distributed.worker.profile.enabled': False,  # these three watch each process 2 to 100 times
    'distributed.admin.system-monitor.interval': '10 s',  # a second, which costs a tenth of a core
    'distributed.admin.tick.interval': '1 s',
}
"""Settings of Dask for processes of this machine."""
COMPARED = ('numpy', 'scipy', 'numba', 'dask', 'distributed')
"""Packages whose versions must be those of the client."""


def shard_of(every: Sequence[Job], shard: str) -> list[Job]:
    """Part `i/n` of the bags, by their names, so that a new bag moves no other.

    Raises BadInputError where that is no part.
    """
    number, _, count = shard.partition('/')
    if not (number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
        raise BadInputError('--shard', 'must be i/n with i from 1 to n', shard, 'for example 3/50')
    return [job for job in every if zlib.crc32(job.name.encode()) % int(count) == int(number) - 1]


def known(every: Sequence[Job]) -> dict[str, Row]:
    """The rows among the results that can be read, by the names of their bags."""
    rows = {}
    stored = Place(every[0].out).read([job.row for job in every]) if every and every[0].out else {}
    for job in every:
        try:
            row = json.loads(stored[job.row])
        except (KeyError, ValueError, RecursionError):
            continue
        if isinstance(row, dict) and 'status' in row:
            rows[job.name] = row
    return rows


def _done(job: Job, row: Row | None) -> bool:
    """Whether a row answers what is asked of this bag.

    Raises BadInputError where it is of another bag.
    """
    if row is None or row['status'] == FAILED:
        return False
    same = row.get('stamp') == job.stamp or (
        bool(job.files) and row.get('content') == content_of(job))
    if not same and row.get('source', '') != job.source:
        raise BadInputError('--out', f'{job.out} holds the results of another bag',
                            row.get('source'), 'choose another place')
    return same and bool(row.get('asked') == job.asked)


def run(every: Sequence[Job], workers: int = 1, cluster: str = '', *,
        show: Callable[[str], None] = lambda _: None, log: Callable[[str], None] = lambda _: None,
        work: Work = look, sample: bool = False) -> list[Row]:
    """Identify the bags that are not done; the rows of all that are then, in their order.

    `cluster`: address or file of a Dask scheduler, or `local`; empty: `workers` processes of this
    machine. `show` is done the progress, `log` each bag and the cost. `sample`: SAMPLE bags only.
    """
    before = known(every)
    rows = {job.name: before[job.name] for job in every if _done(job, before.get(job.name))}
    todo = [job for job in every if job.name not in rows]
    first = todo[::max(1, len(todo) // SAMPLE)][:SAMPLE]
    todo = first if sample else first + [job for job in todo if job not in first]
    waiting = len(every) - len(rows)
    log(f'{len(every)} bags, {waiting} to do')
    start, new = time.monotonic(), []
    engine = partial(_by_dask, cluster=cluster) if cluster else _by_threads
    for row in engine(todo, workers, work) if todo else ():
        rows[row['bag']] = row
        new.append(row)
        elapsed_s = time.monotonic() - start
        remaining = duration(elapsed_s / len(new) * (waiting - len(new)))
        done = f'bag {len(new)} of {waiting}, {row["bag"]} {row["status"]}'
        log(f'{done} in {row["seconds"]:.1f} s, {remaining} left'
            + (f' ({row["reason"]})' if row['reason'] else ''))
        show(f'{done}, {remaining} left')
        if len(new) == SAMPLE or len(new) == len(todo) < SAMPLE:
            log(cost(new, waiting, elapsed_s))
    show('')
    return [rows[job.name] for job in every if job.name in rows]


def cost(rows: Sequence[Row], count: int, elapsed_s: float) -> str:
    """Words on the cost of `count` bags, by `rows` that were finished within elapsed_s."""
    if not (able := [row for row in rows if row['status'] != FAILED]):
        return 'no bag could be read, so what they cost is not known'
    cpu, size, stored = (sum(row.get(name, 0) for row in able) / len(able)
                         for name in ('cpu_s', 'bytes', 'kept_bytes'))
    rest = max(0, count - len(rows))
    peak = max(row.get('peak_mb', 0.0) for row in able)
    return (f'{len(able)} bags took {cpu:.2g} s of CPU each, at most {peak:.0f} MB of memory, '
            f'{size / 1e6:.2g} MB to read, {stored / 1e6:.2g} MB of results; the other {rest}: '
            f'{duration(cpu * rest)} of CPU, {duration(elapsed_s / len(rows) * rest)} at this '
            f'pace, {size * rest / 1e9:.2g} GB to read, {stored * rest / 1e9:.2g} GB of results')


def duration(seconds: float) -> str:
    """A time in the unit that suits it."""
    for size, unit in ((86_400.0, 'days'), (3_600.0, 'h'), (60.0, 'min')):
        if seconds >= 1.5 * size:  # 80 min, not 1.3 h
            return f'{seconds / size:.1f} {unit}'
    return f'{seconds:.0f} s'


def _by_threads(todo: Sequence[Job], workers: int, work: Work) -> Iterator[Row]:
    """Each thread has a process (bag.py)."""
    from concurrent.futures import ThreadPoolExecutor, as_completed

    with ThreadPoolExecutor(workers) as threads:
        waiting = [threads.submit(alone, job, work) for job in todo]
        try:
            for future in as_completed(waiting):
                yield future.result()
        finally:
            threads.shutdown(cancel_futures=True)


def _by_dask(todo: Sequence[Job], workers: int, work: Work, cluster: str) -> Iterator[Row]:
    """Each thread of each worker has a process (bag.py); Dask says who does what, and again."""
    with _client(cluster, workers) as client:
        from distributed import as_completed

        _compare(client, todo[0])
        names = [f'{job.name} {time.monotonic_ns()}' for job in todo]
        futures = client.map(partial(alone, work=work), todo, key=names, pure=False)
        of_future = dict(zip(names, todo, strict=True))
        coming = as_completed(futures, loop=client.loop)
        del futures  # each is let go when its row is there
        for future in coming:
            job, error = of_future.pop(future.key), future.exception()
            if error is None:
                yield future.result()
            else:
                yield keep(job, blank(job, f'its worker died ({type(error).__name__})'))


@contextmanager
def _client(cluster: str, workers: int) -> Iterator[Any]:
    """A client of the scheduler that is named, or of one of this machine."""
    try:
        import dask
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise BadInputError('--cluster', f'needs the package {error.name}',
                            remedy="pip install 'quad_sysid[cluster]'") from error
    if cluster == 'local':
        with (dask.config.set(SETTINGS),
              LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=':0',
                           memory_limit=0, silence_logs='ERROR') as own,
              Client(own, set_as_default=False) as client):
            yield client
        return
    where = {'scheduler_file': cluster} if Path(cluster).is_file() else {'address': cluster}
    try:
        client = Client(**where, timeout=TIMEOUT_S, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise BadInputError('--cluster', 'cannot be reached', cluster,
                            'name a scheduler such as tcp://host:8786, its file, or local'
                            ) from error
    with client:
        yield client


def _compare(client: Any, job: Job) -> None:
    """Raise BadInputError where a worker differs from here, or sees other bags or results."""
    try:
        client.wait_for_workers(1, timeout=TIMEOUT_S)
    except TimeoutError:
        raise BadInputError('--cluster', 'has no worker', remedy='start some: dask worker ADDRESS'
                            ) from None
    check = f'.{time.time_ns()}.check'
    if job.out:
        Place(job.out).write(check, check)
    try:
        answers = client.run(about_here, job, check, on_error='return')
    finally:
        if job.out:
            Place(job.out).remove(check)
    own = about_here(job, '')
    for worker, answer in answers.items():
        if isinstance(answer, Exception):
            raise BadInputError(f'--cluster: {worker}', 'cannot work on a bag',
                                f'{type(answer).__name__}: {answer}',
                                "pip install 'quad_sysid[cluster]' there, as it is here")
        for name, value in answer.items():
            if value != own[name]:
                raise BadInputError(f'--cluster: {worker}', f'its {name} is not as here',
                                    value, f'here it is {own[name]}: make them the same')


def about_here(job: Job, check: str) -> dict[str, str]:
    """Versions of what computes, and whether the bag and the results are seen from here."""
    import quad_sysid

    digest = hashlib.blake2b(digest_size=4)
    here = Path(quad_sysid.__file__).parent
    for path in sorted(here.rglob('*.py')):
        digest.update(path.read_bytes())
    about = {'quad_sysid': digest.hexdigest(), 'Python': platform.python_version()}
    for name in COMPARED:
        about[name] = 'missing'
        with suppress(PackageNotFoundError):
            about[name] = version(name)
    if job.out:
        is_same = not check or check in Place(job.out).read([check])
        about['view of the results'] = job.out if is_same else 'another folder'
    if job.files:
        try:
            Place(job.folder).ends(*job.files[0])
            about['view of the bags'] = job.folder
        except OSError as error:
            about['view of the bags'] = f'{type(error).__name__}: {error}'
    return about
