"""Where fetched logs lie: a `.part` that grows, which is the log once it is whole. Files only."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable
from pathlib import Path

from quad_bridge.wire.frames import LogData, LogEntry


class LogStore:
    """The folder of one aircraft's logs; `run` takes the work of writing, in order."""

    def __init__(self, run: Callable[[Callable[[], object]], None]) -> None:
        self.fault = ''  # what keeps a log from being written
        self.whole = ''  # path of the log that is complete; set from the thread that writes
        self._run = run
        self._folder, self._suffix = Path(), '.log'
        self._name = ''

    def open(self, folder: Path, suffix: str) -> None:
        """Use the folder and suffix of another aircraft."""
        self._folder, self._suffix = folder, suffix

    def there(self, entry: LogEntry) -> int:
        """Number of bytes of this log that are stored already."""
        self._name, self.fault, self.whole = f'log_{entry.number}_{entry.size}', '', ''
        if self._path(self._suffix).exists():
            return entry.size  # whole, however large the list took it for
        with contextlib.suppress(OSError):
            return self._path('.part').stat().st_size
        return 0

    def write(self, parts: Iterable[LogData]) -> None:
        """Append what has come in order."""
        path, ready = self._path('.part'), [*parts]
        if ready:
            self._run(lambda: self._append(path, ready))

    def finish(self) -> None:
        """Give the log its name, once all is written."""
        part, whole = self._path('.part'), self._path(self._suffix)
        self._run(lambda: self._rename(part, whole))

    def _path(self, suffix: str) -> Path:
        return self._folder / f'{self._name}{suffix}'

    def _append(self, path: Path, parts: list[LogData]) -> None:
        if self.fault:
            return  # what follows a part that is missing: the next fetch goes on from there
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open('r+b' if path.exists() else 'w+b') as file:
                file.seek(parts[0].offset)
                file.write(b''.join(part.data for part in parts))
        except OSError as error:
            self.fault = f'{path}: cannot be written ({error.strerror})'

    def _rename(self, part: Path, whole: Path) -> None:
        if self.fault:
            return
        try:
            if not whole.exists():
                with part.open('rb') as file:
                    os.fsync(file.fileno())  # or a power cut leaves a name without a log
                part.replace(whole)
            self.whole = str(whole)
        except OSError as error:
            self.fault = f'{part}: cannot be renamed ({error.strerror})'
