"""The format of a log, by its first bytes, and its reader.

To add a format, add its reader beside this file and one entry to FORMATS.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from quad_sysid.errors import BadInputError
from quad_sysid.imports import ardupilot, betaflight, px4
from quad_sysid.imports.log import ForeignLog
from quad_sysid.imports.table import head_of


@dataclass(frozen=True)
class Format:
    """A format of logs. A file that none recognises is a table: CSV, an SD card, a bag."""

    name: str
    """With its article, such as `a PX4 log`."""
    recognises: Callable[[bytes], bool]
    """Whether a file that begins with these bytes, unpacked, has this format."""
    read: Callable[..., ForeignLog]
    """Takes the path, and the number of the log where a file may hold several."""
    several: bool = False
    """Whether one file may hold several logs."""
    also_table: bool = False
    """Whether a user who names columns may read it as a table too."""


def _blackbox(head: bytes) -> bool:
    return head.startswith(b'H Product:Blackbox') or (
        b'loopIteration' in head and b'gyroADC[0]' in head
    )


FORMATS = (
    Format('a PX4 log', lambda head: head.startswith(b'ULog\x01\x12\x35'), px4.read),
    Format('an ArduPilot log', lambda head: head.startswith((b'\xa3\x95\x80', b'FMT, 128,')),
           ardupilot.read),
    Format('a blackbox log', _blackbox, betaflight.read, several=True, also_table=True),
)


def format_of(path: Path) -> Format | None:
    """The format of a file, None for a table. Raises BadInputError where it cannot be read."""
    head = head_of(path)
    return next((one for one in FORMATS if one.recognises(head)), None)


def read_log(path: Path, known: Format, log: int = 1) -> ForeignLog:
    """Read a log; `log` counts those of a file that holds several. Raises BadInputError."""
    if log != 1 and not known.several:
        raise BadInputError(f'{path}: --log', f'{known.name} holds one log', log, 'leave it out')
    more: dict[str, Any] = {'log': log} if known.several else {}
    return known.read(path, **more)
