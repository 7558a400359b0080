"""Independent calls side by side on the cores of this machine. No mathematics here."""

from __future__ import annotations

import ctypes
import gc
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

TASKS = Path('/proc/self/task')
"""The threads of this process, those of libraries included (Linux; no other system has it)."""

WIDE = 2
"""Bytes of a call's number in the pipe from which processes take the next one."""


def side_by_side(calls: Sequence[Callable[[], Any]]) -> list[Any]:
    """Results of independent calls, in their order; each may be made in a forked process.

    A fork is safe only where no other thread holds a lock, so it is left to processes with one
    thread: the command line's, but not a node's or a notebook's, where the calls follow each
    other. A call whose result did not come whole is made here, so errors are raised as they are.
    """
    if not _single_threaded() or multiprocessing.parent_process() is not None or not calls:
        return [call() for call in calls]
    cores = min(len(calls), len(os.sched_getaffinity(0)))
    context = multiprocessing.get_context('fork')
    try:
        queue, put = os.pipe()
    except OSError:
        return [call() for call in calls]
    os.write(put, b''.join(place.to_bytes(WIDE, 'big') for place in range(cores, len(calls))))
    os.close(put)
    started = []
    gc.freeze()  # a collection of garbage would visit all there is, and copy what processes share
    try:
        with suppress(OSError):  # no memory for another process
            for first in range(1, cores):
                receiver, sender = context.Pipe(duplex=False)
                some = calls, first, queue, sender, os.getpid()
                process = context.Process(target=_make, args=some)
                process.start()
                sender.close()
                started.append((process, receiver))
        results = {place: calls[place]() for place in _numbers(0, queue)}
        for _, receiver in started:
            with suppress(Exception):  # its last, or killed, or what it sent cannot be unpacked
                while True:
                    place, result = receiver.recv()
                    results[place] = result
        return [results[place] if place in results else call() for place, call in enumerate(calls)]
    finally:
        gc.unfreeze()
        os.close(queue)
        for process, receiver in started:
            process.kill()
            process.join()
            receiver.close()


def _numbers(first: int, queue: int) -> Iterator[int]:
    """A process' first call, then the next ones that are left in the pipe."""
    yield first
    while number := os.read(queue, WIDE):
        yield int.from_bytes(number, 'big')


def _make(
    calls: Sequence[Callable[[], Any]], first: int, queue: int, sender: Connection, parent: int
) -> None:
    """The calls' results to the parent, up to the first that fails; ends silently with it.

    They are sent once all are there: a pipe is full after 64 kB, and the parent reads it last.
    """
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG: when the parent dies
    results: list[tuple[int, Any]] = []
    with suppress(Exception):  # the parent makes the call itself and meets the error
        for place in _numbers(first, queue):
            if os.getppid() != parent:
                return
            results.append((place, calls[place]()))
    with suppress(Exception):  # what cannot be packed, the parent makes itself
        for result in results:
            sender.send(result)


def _single_threaded() -> bool:
    return TASKS.is_dir() and len(list(TASKS.iterdir())) == 1
