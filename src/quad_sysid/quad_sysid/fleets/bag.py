"""One bag or log → one row of the fleet's table: the bags below a folder, and the work on each.

`alone` is that work wherever it runs, in a thread of this command, of a shard or of a Dask worker:
the thread keeps one process, which identifies one bag after the other. A bag that hangs or kills
its process so takes nothing else along. The mathematics is imported by these processes alone.
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
import resource
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

from quad_sysid import interrupt
from quad_sysid.contract import STORAGE
from quad_sysid.errors import BadInputError, QuadSysidError
from quad_sysid.files import escaped
from quad_sysid.fleets.place import Place

if TYPE_CHECKING:
    from quad_sysid.model.effect import Effect
    from quad_sysid.record import Record

Row = dict[str, Any]
ANSWERED, CANNOT_TELL, FAILED = 'answered', 'cannot_tell', 'failed'
LOGS = ('.ulg', '.bin', '.log', '.bbl', '.bfl')
"""Endings of raw logs, which are read as `quad-sysid import` reads them."""
COMPRESSED = ('.gz', '.xz', '.bz2')
BASE = ('gain', 'lag', 'delay', 'damping', 'bias')
"""Parameters of the base that every row holds, by axis."""
OF_AXIS = ('verdict', 'effects', 'error_before', 'error_after', 'effect_parameters', 'gains',
           *(f'{name}{end}' for name in BASE for end in ('', '_std')))
LONGEST = 220
"""Bytes of a name that is kept whole; file systems take 255, with an ending and a hash."""
TRIES = 2
"""How often a bag is begun whose process died."""
LIMIT_S = 3600.0
"""Default of the longest time for a bag."""


@dataclass(frozen=True)
class Job:
    """One bag to identify; small, as it is sent to a process, unless it is a record itself."""

    name: str
    """Path below the fleet's folder, which names it in the table; there a byte that is no UTF-8 is
    escaped."""
    aircraft: str = ''
    """First folder below the fleet's, empty where the bag lies in it directly."""
    folder: str = ''
    """Address of the fleet's folder."""
    files: tuple[tuple[str, int], ...] = ()
    """Name below that folder and bytes of each of its files."""
    stamp: str = ''
    """Names, sizes and times of its files."""
    out: str = ''
    """Address of the results; empty: none are kept."""
    record: Record | None = None
    """Record to identify where there is no bag."""
    axes: tuple[str, ...] = ()
    search_effects: bool = True
    effects: str = ''
    """Text of a file of one's own effects."""
    limit_s: float = LIMIT_S

    @property
    def asked(self) -> Row:
        """The fields of a row that state the request."""
        own = hashlib.blake2b(self.effects.encode(), digest_size=8).hexdigest()
        return {'axes': list(self.axes), 'effects': self.search_effects,
                **({'own_effects': own} if self.effects else {})}

    @property
    def source(self) -> str:
        """Path of the bag relative to the results, so that both can move; empty for a record."""
        if not self.files:
            return ''
        bag = f'{self.folder}/{self.place}'
        if '://' in self.folder or '://' in self.out:
            return bag
        return os.path.relpath(bag, self.out)

    @property
    def place(self) -> str:
        """Path of the bag below the folder; empty where the folder is the bag."""
        parts = self.files[0][0].split('/')[:self.name.count('/') + 1]
        return '/'.join(parts) if escaped('/'.join(parts)) == self.name else ''

    @property
    def row(self) -> str:
        """Name of the file with its row among the results."""
        return f'rows/{fits(self.name)}.json'


def fits(name: str) -> str:
    """A path whose parts a disk takes: one that is too long is cut, and ends with its hash."""
    return '/'.join(
        part if len(part.encode()) <= LONGEST else part.encode()[:LONGEST].decode(errors='ignore')
        + hashlib.blake2b(part.encode(), digest_size=8).hexdigest() for part in name.split('/'))


def jobs(folder: str | Path, out: str | Path, **fields: Any) -> list[Job]:
    """Every bag and raw log below a folder, sorted; `fields` are those of Job.

    Raises BadInputError where there is no such folder or no bag in it.

    A folder with storage files and metadata.yaml, or with files that are named after it as
    recorders do, is one bag; so is an .mcap file elsewhere. A folder that cannot be opened counts
    as a bag, so that its row says so.
    """
    place, results = Place(folder), Place(out)
    if place.store is None and not place.path.is_dir():
        raise BadInputError(str(folder), 'is not a folder',
                            remedy='give the one that holds the bags')
    files = {name: about for name, about in place.files().items()
             if not f'{place.address}/{name}'.startswith(f'{results.address}/')}
    by_folder: dict[str, list[str]] = {}
    for name in files:
        by_folder.setdefault(PurePosixPath(name).parent.as_posix(), []).append(name)
    bags: dict[str, list[str]] = {}
    for here, names in sorted(by_folder.items()):
        path = PurePosixPath(here)
        if any(above.as_posix() in bags for above in (path, *path.parents)):
            continue
        own = PurePosixPath(place.address if here == '.' else here).name
        stored = [name for name in names if name.endswith(STORAGE)]
        if any(PurePosixPath(name).name == 'metadata.yaml' for name in names) or any(
                PurePosixPath(name).name.startswith(f'{own}_') for name in stored):
            bags[here] = names
        else:
            bags |= {name: [name] for name in names
                     if name.endswith('.mcap') or _is_log(name) or files[name][1] == 'closed'}
    if not bags:
        raise BadInputError(str(folder), 'holds no bag (a rosbag2 folder, an .mcap file or a log)',
                            remedy='check the path')
    return [_job(place, results, bag, tuple(names), files, fields)
            for bag, names in sorted(bags.items())]


def of_records(records: Sequence[Record], aircraft: Sequence[str] = (), out: str = '',
               **fields: Any) -> list[Job]:
    """Records as jobs, named by aircraft and source; those of one name are numbered.

    Raises BadInputError where `aircraft` is not one for each.
    """
    if aircraft and len(aircraft) != len(records):
        raise BadInputError('fleet: aircraft', f'must be one for each of {len(records)} records',
                            len(aircraft))
    every: dict[str, Job] = {}
    for number, record in enumerate(records):
        craft = aircraft[number] if aircraft else ''
        name = '/'.join(part for part in (craft, PurePosixPath(record.source).name) if part)
        name = name if name not in every else f'{name}.{number}'
        digest = hashlib.blake2b(record.rates.tobytes() + record.control.tobytes(), digest_size=8)
        every[name] = Job(name, craft, stamp=digest.hexdigest(), record=record,
                          out=Place(out).address if out else '', **fields)
    return list(every.values())


def _is_log(name: str) -> bool:
    path = PurePosixPath(name.lower())
    return (PurePosixPath(path.stem) if path.suffix in COMPRESSED else path).suffix in LOGS


def _job(place: Place, results: Place, bag: str, names: tuple[str, ...],
         files_below: Mapping[str, tuple[int, str]], fields: Mapping[str, Any]) -> Job:
    about = [(PurePosixPath(name).name, *files_below[name]) for name in names]
    parts = PurePosixPath(escaped(bag)).parts
    return Job(
        name=escaped(bag if parts else PurePosixPath(place.address).name),
        aircraft=parts[0] if len(parts) > 1 else '', folder=place.address,
        files=tuple((name, files_below[name][0]) for name in names),
        stamp=hashlib.blake2b(repr(about).encode(), digest_size=8).hexdigest(),
        out=results.address, **fields)


def content_of(job: Job) -> str:
    """Hash that identifies a bag wherever it is: names and sizes of its files, and their ends."""
    place, digest = Place(job.folder), hashlib.blake2b(digest_size=16)
    for name, size in job.files:
        own = escaped(PurePosixPath(name).name)
        digest.update(f'{own} {size} '.encode() + place.ends(name, size))
    return digest.hexdigest()


def blank(job: Job, reason: str = '') -> Row:
    """The row of a bag that failed."""
    return {'bag': job.name, 'aircraft': job.aircraft, 'status': FAILED, 'reason': reason,
            'asked': job.asked, 'stamp': job.stamp, 'bytes': sum(size for _, size in job.files),
            'seconds': 0.0}


def keep(job: Job, row: Row) -> Row:
    """Write a row among the results, if there are any."""
    if job.out:
        Place(job.out).write(job.row, json.dumps(row))
    return row


def look(job: Job) -> Row:
    """The row of a bag; an error of any kind becomes a row that says so."""
    start, cpu = time.monotonic(), time.process_time()
    row = blank(job)
    try:
        row |= _identified(job)
    except QuadSysidError as error:
        row['reason'] = str(error)
    except Exception as error:  # noqa: BLE001  one bad bag never stops the run
        row['reason'] = f'{type(error).__name__}: {error}'
    row['reason'] = escaped(row['reason'])
    row['seconds'] = round(time.monotonic() - start, 3)
    row['cpu_s'] = round(time.process_time() - cpu, 3)
    row['peak_mb'] = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0, 1)
    return row


def _identified(job: Job) -> Row:
    from quad_sysid.effects import EFFECTS
    from quad_sysid.result import identify

    effects = _own_effects(job.effects) if job.effects else ()
    candidates = (*EFFECTS, *effects) if job.search_effects else ()
    record, row = _read(job)
    result = identify(record, job.axes, effects=candidates)
    row |= {'status': ANSWERED if result.answered else CANNOT_TELL,
            'reason': '' if result.answered else result.reasons, 'start_ns': record.t0_ns,
            'length_s': record.n * record.dt, 'sample_rate_hz': 1.0 / record.dt,
            'warnings': len(record.warnings)}
    if job.out:
        with Place(job.out).filled(f'bags/{fits(job.name)}') as folder:
            result.save(folder, html=False, pictures=False)
            row['kept_bytes'] = sum(p.stat().st_size for p in folder.iterdir() if p.is_file())
    specs = {(effect.name, effect.variant, spec.name): spec.centre == 0.0 and not spec.log
             for effect in (*EFFECTS, *effects) for spec in effect.parameters}
    for axis, tree in result.report['axes'].items():
        row |= {f'{axis}_{name}': value for name, value in _of_axis(tree, specs).items()}
    return row


def _read(job: Job) -> tuple[Record, Row]:
    """The flight as a record, and what the row keeps of where it came from."""
    from quad_sysid.bags import read_bag
    from quad_sysid.imports.formats import format_of, read_log
    from quad_sysid.imports.to_bag import record_of

    if job.record is not None:
        return replace(job.record, source=job.name), {}
    with Place(job.folder).fetched(job.place, [name for name, _ in job.files]) as path:
        if not _is_log(job.name):
            record = read_bag(path)
        elif log_format := format_of(path):
            record = record_of(read_log(path, log_format)).record
        else:
            raise BadInputError(job.name, 'is of no known format of logs',
                                remedy='turn it into a bag by quad-sysid import')
    return replace(record, source=job.name), {'source': job.source, 'content': content_of(job)}


@functools.lru_cache(maxsize=1)
def _own_effects(text: str) -> tuple[Effect, ...]:
    """The effects in the text of a user's file, which need not be on this machine."""
    from quad_sysid.arguments import own_effects

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, 'effects.py')
        path.write_text(text, encoding='utf-8')
        return own_effects(str(path))


def _of_axis(tree: Mapping[str, Any], specs: Mapping[tuple[str, str, str], bool]) -> Row:
    """The row's values of one axis, by OF_AXIS, from its tree in report.json.

    Gain, lag and the rest are those beside the effects: alone they take up what the effects do.
    """
    effects = {
        f'{e["name"]}.{p["name"]}': {
            'value': p['value'], 'std': p['std'], 'unit': p['unit'],
            'vanishes': specs.get((e['name'], e.get('variant', ''), p['name']), False)}
        for e in tree['effects'] if e['kind'] == 'named' for p in e['parameters']}
    parameters = {p['name']: p for p in tree['completed']['parameters']}
    return {'verdict': tree['verdict'], 'effects': ','.join(e['name'] for e in tree['effects']),
            'error_before': tree['error']['before'], 'error_after': tree['error']['after'],
            'effect_parameters': json.dumps(effects), 'gains': json.dumps(tree.get('gains')),
            'base_units': {name: entry['unit'] for name, entry in parameters.items()},
            **{f'{name}{end}': parameters.get(name, {}).get(field)
               for name in BASE for end, field in (('', 'value'), ('_std', 'std'))}}


def alone(job: Job, work: Callable[[Job], Row]) -> Row:
    """The row of a bag, made in this thread's process and kept among the results.

    A process that dies costs its bag one more try; one that takes too long is ended.
    """
    for attempt in range(1, TRIES + 1):
        process = getattr(_here, 'process', None) or _Process()
        _here.process = process
        row, reason = process.ask(job, work)
        if row is not None:
            return keep(job, row)
        _here.process = None
        if not reason.startswith('its process died') or attempt == TRIES:
            break
    return keep(job, blank(job, f'{reason}, {TRIES} times' if attempt == TRIES else reason))


_here = threading.local()


class _Process:
    """A process that identifies one bag after the other for one thread."""

    def __init__(self) -> None:
        # imported here: no other command starts processes
        import multiprocessing
        from multiprocessing import forkserver, resource_tracker

        multiprocessing.current_process().daemon = False  # a Dask worker, which may have none
        context = multiprocessing.get_context('forkserver')
        context.set_forkserver_preload(
            ['quad_sysid.pipeline.identify', 'quad_sysid.report.document'])
        with interrupt.starting:
            if interrupt.ending:
                raise SystemExit
            resource_tracker.ensure_running()  # which lets the signals in again
            # a terminal sends SIGINT to all, and this process ends them
            with interrupt.uninterrupted():
                forkserver.ensure_running()
            self._pipe, remote = context.Pipe()
            self._process = context.Process(target=_serve, args=(remote,), daemon=True)
            self._process.start()
        remote.close()

    def ask(self, job: Job, work: Callable[[Job], Row]) -> tuple[Row | None, str]:
        """The row, or why there is none; this process is of no use any more then."""
        try:
            self._pipe.send((work, job))
            if self._pipe.poll(job.limit_s):
                return self._pipe.recv(), ''
            reason = f'took longer than {job.limit_s:g} s'
        except (OSError, EOFError):
            self._process.join(interrupt.GRACE_S)
            code = self._process.exitcode or 0
            how = f'status {code}' if code >= 0 else (
                f'{signal.Signals(-code).name}; is there memory enough?' if -code == signal.SIGKILL
                else signal.Signals(-code).name)
            reason = f'its process died ({how})'
        self._process.terminate()
        self._process.join(interrupt.GRACE_S)
        self._process.kill()
        self._pipe.close()
        return None, reason


def _serve(pipe: Any) -> None:
    """What a process does: rows for jobs, until nobody asks any more.

    The command's end ends it, and it leaves nothing half done.
    """
    import multiprocessing

    interrupt.take_over(terminated=True)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})  # the server's, see above
    parent = multiprocessing.parent_process()

    def follow() -> None:
        if parent is not None:
            parent.join()
            os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=follow, daemon=True).start()
    with suppress(EOFError):
        while True:
            work, job = pipe.recv()
            pipe.send(work(job))
