"""Progress on a terminal: one line on stderr that is rewritten, with the remaining time.

How far a piece of work has come is told by its caller in words; where the words carry `n of m`,
or name a stage of an identification, the remaining time is estimated. Nothing is shown where
stderr is not a terminal.
"""

from __future__ import annotations

import re
import shutil
import sys
import time
from collections.abc import Callable, Sequence
from typing import TextIO

SHOW_AFTER_S = 1.0
"""Work that is done sooner shows no remaining time."""
LEAST_SHARE = 0.05
"""Before so much is done, no remaining time is estimated."""
STAGES = (('what is missing', 0.05), ('held-out', 0.40), ('black-box', 0.45), ('gains', 0.80))
"""Stage of an axis to its share of the time when it begins, measured on a flight of 90 s with
one effect."""
WRITING = 0.8
"""Share at which the report is drawn."""
COUNTED = re.compile(r'(\d+) of (\d+)')


class Progress:
    """Called with a line of words at each step, with an empty one at the end."""

    def __init__(self, stream: TextIO, axes: Sequence[str] = (),
                 clock: Callable[[], float] = time.monotonic) -> None:
        self._stream, self._axes, self._clock = stream, tuple(axes), clock
        self._start: float | None = None
        self._share = 0.0

    def __call__(self, line: str) -> None:
        """Show `line` with the time that remains, or wipe it where it is empty."""
        now = self._clock()
        if self._start is None:
            self._start = now
        self._share = max(self._share, self.share(line))
        elapsed = now - self._start
        text = line
        if line and elapsed > SHOW_AFTER_S:
            text += f'  ({duration(elapsed)} so far'
            if self._share >= LEAST_SHARE:
                text += f', about {duration(elapsed * (1.0 / self._share - 1.0))} left'
            text += ')'
        width = shutil.get_terminal_size().columns - 1
        print(f'\r\x1b[2K{text[:width]}', end='', file=self._stream, flush=True)

    def share(self, line: str) -> float:
        """How much of the work is done when `line` is said, 0 to 1."""
        counted = COUNTED.search(line)
        if counted and int(counted[2]):
            return min((int(counted[1]) - 1) / int(counted[2]), 1.0)
        if line.startswith('writing'):
            return WRITING
        axis, colon, stage = line.partition(': ')
        if not colon:
            return 0.0
        begun = next((share for name, share in STAGES if stage.startswith(name)), 0.0)
        if axis not in self._axes:
            return 0.0 if self._axes else WRITING * begun
        return WRITING * (self._axes.index(axis) + begun) / len(self._axes)


def duration(seconds: float) -> str:
    """`42 s` or `3 min 20 s`, to a resolution that an estimate deserves."""
    whole = max(1, round(seconds))
    if whole < 60:
        return f'{whole} s'
    if whole < 3600:
        return f'{whole // 60} min {10 * (whole % 60 // 10)} s'
    return f'{whole // 3600} h {whole % 3600 // 60} min'


def progress(*, quiet: bool = False, axes: Sequence[str] = ()) -> Callable[[str], None]:
    """What shows progress on this process' stderr: nothing where that is not a terminal."""
    if quiet or not sys.stderr.isatty():
        return lambda _: None
    return Progress(sys.stderr, axes)
