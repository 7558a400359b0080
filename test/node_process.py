"""A node, or another program of the suite, as a process of a test: its words, signals, end."""

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from nursery import Nursery
from probe import PATIENCE_S
from rosbags.highlevel import AnyReader

PROGRAMS = {
    'serial_bridge': ('quad_bridge.start', 'quad_bridge.nodes.serial_bridge'),
    'bag_logger': ('quad_bridge.start', 'quad_bridge.nodes.bag_logger'),
    'monitor': ('quad_bridge.start', 'quad_bridge.nodes.monitor'),
    'excitation': ('quad_sysid.start_node', 'quad_sysid.excitation_node'),
    'identification': ('quad_sysid.start_node', 'quad_sysid.identification_node'),
    'virtual_stm32': ('quad_bridge.start', 'quad_bridge.virtual.process'),
    'main': ('quad_tuning.cli', 'quad_tuning.update_node'),
}
"""By name, `main` is `quad-tune`: where `ros2 run` would begin, and what it imports first."""
QUICKLY = """
from functools import partial
from quad_sysid.pipeline import identify
from quad_tuning import ensemble, pid
identify._black_boxes = lambda *_: 'left out'
pid.STARTS, pid.SHORTLIST, pid.GRID = 1, 20, (5, 7, 2, 4, 3)
ensemble.build = partial(ensemble.build, count=ensemble.DRAWS // 4)
"""
"""What the fixture `quickly` does, for another process: run before it begins."""
SIGNAL_AT_IMPORT = """
import importlib.abc, os, sys
class Signal(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name == {0!r}:
            try:
                os.kill(os.getpid(), {1})
            except KeyboardInterrupt as error:
                raise ImportError('an import that makes another error of it') from error
sys.meta_path.insert(0, Signal())
"""
"""Run before a program begins: it gets this signal as it imports this module."""
GRACE_S = 30.0
"""So long may a process take to end before it is killed; measures nothing."""


def node_command(
    name: str, namespace: str = '', files: Sequence[object] = (), broken: str = '',
    **parameters: object,
) -> list[str]:
    """The command that starts a node with these parameter files and parameters.

    `broken` is Python that is run before, for what fails without a cause outside.
    """
    words = [str(word) for file in files for word in ('--params-file', file)]
    for key, value in parameters.items():
        text = str(value).lower() if isinstance(value, bool) else str(value)
        words += ['-p', f'{key}:={text}']
    words += ['-r', f'__ns:={namespace}'] if namespace else []
    return [*program(name, broken), '--ros-args', *words]


def program(name: str, broken: str = '') -> list[str]:
    """The beginning of the command of a program of the suite."""
    begin, _ = PROGRAMS[name]
    code = f'{broken}\nimport sys; from {begin} import {name} as start; sys.exit(start())'
    return [sys.executable, '-c', code]


def recorded(bag: Path, *topics: str) -> dict[str, list[Any]]:
    """The messages of a bag by topic: of these, or of all."""
    found: dict[str, list[Any]] = {topic: [] for topic in topics}
    with AnyReader([bag]) as reader:
        wanted = [c for c in reader.connections if not topics or c.topic in topics]
        for connection, _, raw in reader.messages(wanted):
            message = reader.deserialize(raw, connection.msgtype)
            found.setdefault(connection.topic, []).append(message)
    return found


def until(
    condition: Callable[[], object], what: object = '', meanwhile: Callable[[], object] = bool
) -> None:
    """Wait for a condition; the bound is a safety net, not a measurement."""
    end_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end_s, f'never: {what}'
        meanwhile()
        time.sleep(0.002)


def ended(
    *words: object, env: Mapping[str, str] | None = None, **options: Any
) -> subprocess.CompletedProcess[str]:
    """A program that has run to its end: its status and words. `env`: beside the environment."""
    options = {'capture_output': True, 'text': True, 'timeout': PATIENCE_S, **options}
    return subprocess.run([*map(str, words)], check=False, env={**os.environ, **(env or {})},
                          **options)


def python(*words: object, **options: Any) -> subprocess.CompletedProcess[str]:
    return ended(sys.executable, *words, **options)


class Started:
    """A running process; what it says goes into files, so that it never waits for who reads."""

    def __init__(
        self, command: Sequence[object], files: Path, nursery: Nursery | None = None,
        **options: Any,
    ) -> None:
        """`nursery`: forks it where it is one of our programs."""
        self._out, self._err = files.with_suffix('.out'), files.with_suffix('.err')
        words = [str(word) for word in command]
        begun = re.search(r' import (\w+) as start', ' '.join(words[2:3]))
        _, module = PROGRAMS.get(begun[1], (None, None)) if begun else (None, None)
        none = Path(os.devnull)
        with self._out.open('w') as out, self._err.open('w') as err, none.open() as given:
            if nursery is None or module is None or words[:2] != [sys.executable, '-c']:
                options = {'stdout': out, 'stderr': err, **options}
                self.process: Any = subprocess.Popen(words, **options)
            else:
                streams = [given.fileno(), options.pop('stdout', out.fileno()),
                           options.pop('stderr', err.fileno())]
                self.process = nursery.fork([module], *words[2:3], words[3:], streams,
                                            **options)
        self.pid = self.process.pid

    @property
    def said(self) -> str:
        return self._err.read_text(errors='replace')

    @property
    def printed(self) -> str:
        return self._out.read_text(errors='replace')

    def poll(self) -> int | None:
        return self.process.poll()

    def send(self, number: int) -> None:
        self.process.send_signal(number)

    def wait(self) -> int:
        return self.process.wait(PATIENCE_S)

    def end(self, number: int = signal.SIGINT) -> int:
        """Send a signal; the exit status."""
        self.send(number)
        return self.wait()

    def leave(self) -> None:
        """Wait for the end that was asked for.

        A node that is killed may hold a lock in the memory that the middleware shares, and whoever
        still talks to it dies of that.
        """
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(GRACE_S)
        self.kill()

    def kill(self) -> None:
        self.process.kill()
        self.process.wait(PATIENCE_S)

    def until(self, condition: Callable[[], object], what: object = '') -> None:
        """Wait for a condition as long as the process lives."""

        def lives() -> None:
            assert self.poll() is None, f'ended with {self.poll()}: {self.said[-2000:]}'

        until(condition, what, lives)

    def says(self, words: str) -> None:
        self.until(lambda: words in self.said, words)
