"""Ctrl-C in the process of a command: one line and status 130, wherever it comes.

Python raises KeyboardInterrupt in whatever runs: inside of numba, an import or a lock of logging,
which make another error of it or drop it. So the process of a command (start.py) ends in the
handler of the signal, and nothing is unwound. Its processes end with it; what is half written is
in temporary folders, which Python removes at exit. Whoever calls `main` in a process of his own
keeps his handlers.
"""

from __future__ import annotations

import atexit
import io
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType

INTERRUPTED = 130
"""Exit status (contract, Commands)."""
GRACE_S = 5.0
"""So long may another process take to remove what it has half written."""

ending = False
"""Whether this process ends, so that its threads start no other one."""
starting = threading.Lock()
"""A thread holds it while it looks at `ending` and starts a process."""


def take_over(program: str = '', *, terminated: bool = False) -> None:
    """End this process on SIGINT, in the words of `program` if it has a name.

    Does nothing where the process was started to ignore it, as in the background of a script.
    `terminated`: end on SIGTERM instead, and leave SIGINT to whoever sends that.
    """
    owner = os.getpid()

    def end(number: int, _: FrameType | None) -> None:
        global ending  # noqa: PLW0603
        signal.signal(number, signal.SIG_DFL)  # a second one ends it at once
        if os.getpid() == owner:  # else one of its processes, which has just been forked
            ending = True
            sys.stderr = io.StringIO()  # what its threads lose by the end is no error
            with starting:
                pass
            _end_processes()
            atexit._run_exitfuncs()  # noqa: SLF001  sys.exit would unwind
            if program:
                _say(f'{program}: interrupted\n')
        os._exit(INTERRUPTED)

    number = signal.SIGTERM if terminated else signal.SIGINT
    if signal.getsignal(number) is not signal.SIG_IGN:
        signal.signal(number, end)


def _end_processes() -> None:
    if 'multiprocessing' not in sys.modules:
        return
    import multiprocessing

    children = multiprocessing.active_children()
    for process in children:
        process.terminate()
    for process in children:
        process.join(GRACE_S)
        process.kill()


def _say(line: str) -> None:
    """Write to stderr, past its buffer, which may be in use; over a line of progress."""
    with suppress(OSError):
        wiped = '\r\x1b[2K' if os.isatty(2) else ''
        os.write(2, f'{wiped}{line}'.encode())


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Let the signals that end a process wait for what must not be half done; milliseconds."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
