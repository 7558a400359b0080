"""Independent calls side by side on the cores of this machine. No mathematics here."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

TASKS = Path('/proc/self/task')
"""The threads of this process, those of libraries included (Linux)."""


def side_by_side(calls: Sequence[Callable[[], Any]]) -> list[Any]:
    """Results of independent calls, in their order; each may be made in a forked process.

    A fork is safe only where no other thread holds a lock, so it is left to processes with one
    thread: the command line's, but not a node's or a notebook's, where the calls follow each
    other. A call whose process gave no result is made here, so errors are raised as they are.
    """
    cores = min(len(calls), len(os.sched_getaffinity(0)))
    if cores < 2 or multiprocessing.parent_process() is not None or not _single_threaded():
        return [call() for call in calls]
    context = multiprocessing.get_context('fork')
    started = []
    try:
        for first in range(1, cores):
            receiver, sender = context.Pipe(duplex=False)
            process = context.Process(target=_make, args=(calls[first::cores], sender))
            process.start()
            sender.close()
            started.append((first, process, receiver))
        results = {place: calls[place]() for place in range(0, len(calls), cores)}
        for first, _, receiver in started:
            with suppress(EOFError):
                for place in range(first, len(calls), cores):
                    results[place] = receiver.recv()
        return [results[place] if place in results else call() for place, call in enumerate(calls)]
    finally:
        for _, process, receiver in started:
            process.kill()
            process.join()
            receiver.close()


def _make(calls: Sequence[Callable[[], Any]], sender: Connection) -> None:
    """The calls' results to the parent, up to the first that fails; Ctrl-C ends it silently."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    with suppress(Exception):  # the parent makes the call itself and meets the error
        for call in calls:
            sender.send(call())


def _single_threaded() -> bool:
    return sys.platform == 'linux' and sum(1 for _ in TASKS.iterdir()) == 1
