"""Child processes of one run in a ROS domain of its own: started, watched, measured, stopped.

Knows nothing of topics or stages; the demo and the end-to-end tests both use it.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import yaml
from ament_index_python.packages import (
    PackageNotFoundError,
    get_package_prefix,
    get_package_share_directory,
)

from quad_bridge.lockstep import VARIABLE, Clock, Participant


class StageFailedError(Exception):
    """A stage of the demo ended without its result; `str()` is the one line for the user."""

    def __init__(self, stage: str, reason: str) -> None:
        super().__init__(f'{stage}: {" ".join(reason.split())}')
        self.reason = reason


PORT_BASE, PORT_GAIN, PORT_GUARD = 7400, 250, 249
"""Ports of a domain start at 7400 + 250 * domain (DDSI-RTPS 9.6.2.3); the last is our guard."""
DISCOVERY_OFFSETS = (0, 10, 12, 14)
"""Multicast, and unicast of the first three participants."""
LOWEST, HIGHEST = 1, 100
"""Above 101 the ports of Linux' own ephemeral range begin."""


@contextlib.contextmanager
def own_domain() -> Iterator[int]:
    """A domain id that nobody on this machine uses, held until the block ends.

    Raises OSError where all of them are in use.
    """
    span = HIGHEST - LOWEST + 1
    first = os.getpid() % span
    for step in range(span):
        domain = LOWEST + (first + step) % span
        with contextlib.ExitStack() as guard:
            if _in_use(domain, PORT_GUARD, guard, '127.0.0.1'):
                continue
            with contextlib.ExitStack() as probes:  # do participants look for each other here?
                used = any(_in_use(domain, offset, probes) for offset in DISCOVERY_OFFSETS)
            if not used:
                yield domain
                return
    raise OSError('no free ROS domain id between 1 and 100 on this machine')


def _in_use(domain: int, offset: int, sockets: contextlib.ExitStack, host: str = '') -> bool:
    """Whether somebody has this port of a domain; else `sockets` keeps it."""
    port = sockets.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    try:
        port.bind((host, PORT_BASE + PORT_GAIN * domain + offset))
    except OSError:
        return True
    return False


STOP_TIMEOUT_S = 8.0
"""How long a process may take to end after SIGINT before it is killed."""


def executable(package: str, name: str) -> Path:
    """The file that `ros2 run package name` starts; raises StageFailedError where it is not."""
    try:
        path = Path(get_package_prefix(package)) / 'lib' / package / name
    except (PackageNotFoundError, OSError):
        raise StageFailedError(
            'start', f'{package} is not in this workspace; run make build and source install/'
        ) from None
    if not path.exists():
        raise StageFailedError('start', f'{package} has no executable {name}; run make build')
    return path


@dataclass
class Child:
    """One process and its log."""

    name: str
    process: subprocess.Popen[bytes]
    log: Path
    ended: bool = False
    may_end: bool = False
    """Whether it is in order when the process ends by itself with status 0."""

    def last_words(self) -> str:
        """The last line of its log that says something."""
        try:
            lines = self.log.read_text(errors='replace').splitlines()
        except OSError:
            return 'no log'
        return next((line.strip() for line in reversed(lines) if line.strip()), 'its log is empty')


@dataclass
class Crew:
    """All processes of one run, in a folder for their logs and one ROS domain.

    A context manager: leaving it stops everything, whatever happened.
    """

    folder: Path
    domain: int
    children: dict[str, Child] = field(default_factory=dict)
    lockstep: bool = False
    """Whether they share simulated time, which waits for the slowest of them."""
    clock: Clock = field(default_factory=Clock)
    _folder: tempfile.TemporaryDirectory[str] | None = None
    """The folder of the socket, whose path must be short."""

    @property
    def socket(self) -> Path | None:
        """Path of the socket of the lockstep; None outside of it."""
        return None if self._folder is None else Path(self._folder.name) / 'lockstep'

    def __enter__(self) -> Crew:
        """Make the log folder and, in lockstep, take part."""
        (self.folder / 'logs').mkdir(parents=True, exist_ok=True)
        if self.lockstep:
            self._folder = tempfile.TemporaryDirectory(prefix='quad_')
            self.clock = Participant(Path(self._folder.name) / 'lockstep', 'observer')
        return self

    def __exit__(self, *_: object) -> None:
        """Stop everything."""
        self.stop()
        if self._folder is not None:
            self.clock.close()
            self._folder.cleanup()

    def environment(self) -> dict[str, str]:
        """The whole environment of this process, confined to the run's domain and folder."""
        lockstep = {} if self.socket is None else {VARIABLE: str(self.socket)}
        return {**os.environ, **lockstep, 'ROS_DOMAIN_ID': str(self.domain),
                'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
                'ROS_LOG_DIR': str(self.folder / 'logs' / 'ros'), 'PYTHONUNBUFFERED': '1'}

    def start(self, name: str, command: Sequence[str | Path], *, may_end: bool = False) -> Child:
        """Start `command` in a process group of its own, output to logs/`name`.log."""
        log = self.folder / 'logs' / f'{name}.log'
        with log.open('ab') as out:
            process = subprocess.Popen(  # noqa: S603
                [str(part) for part in command],
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=subprocess.STDOUT,
                env=self.environment(),
                start_new_session=True,
            )
        self.children[name] = Child(name, process, log, may_end=may_end)
        return self.children[name]

    def start_node(self, package: str, name: str, parameters: Mapping[str, object], *,
                   called: str = '') -> Child:
        """Start a node with its package's own configuration, if any, and these parameters.

        They are kept in a YAML file beside its log; `called` names both where one node runs twice.
        """
        called = called or name
        values = self.folder / 'logs' / f'{called}.yaml'
        values.write_text(yaml.safe_dump({'/**': {'ros__parameters': dict(parameters)}}))
        shipped = Path(get_package_share_directory(package)) / 'config' / f'{name}.yaml'
        files = [path for path in (shipped, values) if path.exists()]
        arguments = [part for path in files for part in ('--params-file', path)]
        return self.start(called, [executable(package, name), '--ros-args', *arguments])

    def check(self, stage: str) -> None:
        """Raise StageFailedError naming the first one that died."""
        for child in self.children.values():
            status = None if child.ended else child.process.poll()
            if status is None:
                continue
            child.ended = True
            if not (child.may_end and status == 0):
                raise StageFailedError(
                    stage, f'{child.name} ended with status {status}: {child.last_words()}'
                )

    def stop(self, *names: str) -> None:
        """SIGINT to the named ones (default: all, the last started first), then SIGKILL."""
        chosen = [self.children[name] for name in names] or list(self.children.values())[::-1]
        running = [child for child in chosen if not child.ended]
        for child in running:
            _signal_group(child, signal.SIGINT)
        deadline = time.monotonic() + STOP_TIMEOUT_S
        for child in running:
            with contextlib.suppress(subprocess.TimeoutExpired):
                child.process.wait(max(0.0, deadline - time.monotonic()))
            _signal_group(child, signal.SIGKILL)
            child.process.wait()
            child.ended = True


def _signal_group(child: Child, number: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child.process.pid, number)
