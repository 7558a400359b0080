"""What is kept on disk of one aircraft: every set of gains that was active, and its check. Files.

`<folder>/<aircraft>/gains.jsonl` is only ever appended to, one line per event, each in one write;
`polarity.json` is replaced whole. `quad-tune history` reads the first by itself.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

SCHEMA = 'quad_bridge/gains/1'
HISTORY, POLARITY = 'gains.jsonl', 'polarity.json'


def default_folder() -> Path:
    """Where ROS keeps what outlives a process: `$ROS_HOME/quad_suite`, or in `~/.ros`."""
    home = os.environ.get('ROS_HOME')
    return (Path(home) if home else Path.home() / '.ros') / 'quad_suite'


class AircraftStore:
    """The files of one aircraft; what goes wrong with the disk stands in `fault`, nothing raises.

    A full disk must not keep gains from being rolled back.
    """

    def __init__(self, folder: Path, aircraft: str) -> None:
        self.folder = folder / aircraft
        self.fault = ''

    def append(self, event: Mapping[str, Any]) -> None:
        """Add one line to the history, on the disk when this returns."""
        line = json.dumps({'schema': SCHEMA, **event}, allow_nan=False) + '\n'
        path = self.folder / HISTORY
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            file = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT, 0o644)
            try:
                os.write(file, (_torn(file) + line).encode())
                os.fsync(file)
            finally:
                os.close(file)
            self.fault = ''
        except OSError as error:
            self.fault = f'{path}: cannot be written ({error.strerror}); gains are not kept'

    def polarity(self) -> dict[str, Any]:
        """What the last check found, {} where there was none or its file is damaged."""
        path = self.folder / POLARITY
        try:
            found = json.loads(path.read_text(encoding='utf-8'))
        except (OSError, ValueError, RecursionError):
            return {}
        return found if isinstance(found, dict) else {}

    def keep_polarity(self, found: Mapping[str, Any]) -> None:
        """Replace what is kept of the check."""
        path = self.folder / POLARITY
        fresh = path.with_suffix(f'.{os.getpid()}')
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            fresh.write_text(json.dumps(found, indent=1) + '\n', encoding='utf-8')
            fresh.replace(path)
        except OSError as error:
            self.fault = f'{path}: cannot be written ({error.strerror})'
            with contextlib.suppress(OSError):
                fresh.unlink()


def _torn(file: int) -> str:
    """A line end where a crash left half a line behind."""
    size = os.fstat(file).st_size
    return '\n' if size and os.pread(file, 1, size - 1) != b'\n' else ''
