"""Processes that work for a benchmark and end with it, however that ends."""

from __future__ import annotations

import ctypes
import os
import signal
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context


def pool(jobs: int) -> ProcessPoolExecutor:
    """A pool of so many processes.

    Left alone, one whose benchmark was killed waits for its next task for ever (Linux has a call
    against that).
    """
    return ProcessPoolExecutor(jobs, mp_context=get_context('spawn'), initializer=_end_with,
                               initargs=(os.getpid(),))


def _end_with(parent: int) -> None:
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG: when the parent dies
    if os.getppid() != parent:
        os._exit(1)
