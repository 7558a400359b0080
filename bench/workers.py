"""Processes that work for a benchmark and end with it, however that ends."""

from __future__ import annotations

import ctypes
import os
import signal
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context


@contextmanager
def pool(jobs: int) -> Iterator[ProcessPoolExecutor]:
    """A pool of so many processes, which begins nothing more once a result was an error.

    Left alone, one whose benchmark was killed waits for its next task for ever (Linux has a call
    against that).
    """
    with ProcessPoolExecutor(jobs, mp_context=get_context('spawn'), initializer=_end_with,
                             initargs=(os.getpid(),)) as executor:
        try:
            yield executor
        except BaseException:
            executor.shutdown(wait=False, cancel_futures=True)
            raise


def _end_with(parent: int) -> None:
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG: when the parent dies
    if os.getppid() != parent:
        os._exit(1)
