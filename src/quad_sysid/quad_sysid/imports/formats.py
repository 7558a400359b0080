"""The format of a log, by its first bytes or its topics, and its reader.

To add a format, add its reader beside this file and one entry to FORMATS.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from quad_sysid.errors import BadInputError
from quad_sysid.imports import ardupilot, betaflight, dataflash, mavros, px4
from quad_sysid.imports.log import ForeignLog
from quad_sysid.imports.rosbag import topics_of
from quad_sysid.imports.table import head_of, is_bag, plain


@dataclass(frozen=True)
class Source:
    """The start of a file, by which its format is recognised."""

    head: bytes
    """The first bytes, unpacked; none of a folder."""
    topics: dict[str, str]
    """Types by topic, of a bag."""


@dataclass(frozen=True)
class Format:
    """A format of logs. A file that none recognises is a table: CSV, an SD card, a bag."""

    name: str
    """Name with its article, such as `a PX4 log`."""
    recognises: Callable[[Source], bool]
    read: Callable[..., ForeignLog]
    """A function of the path and of the options named below."""
    options: tuple[str, ...] = ()
    """Names of options: `log`, the number of the log in a file of several; `messages`, a folder of
    .msg files."""
    also_table: bool = False
    """Whether a user who names columns may read it as a table too."""


FORMATS = (
    Format('a PX4 log', lambda of: of.head.startswith(b'ULog\x01\x12\x35'), px4.read),
    Format('an ArduPilot log',
           lambda of: dataflash.is_binary(of.head) or dataflash.is_text(of.head), ardupilot.read),
    Format('a blackbox log', lambda of: betaflight.ENCODED.search(of.head) is not None or (
        b'loopIteration' in of.head and b'gyroADC[0]' in of.head), betaflight.read, ('log',),
           also_table=True),
    Format('a bag of px4_msgs', lambda of: px4.is_bag(of.topics), px4.read_bag, ('messages',),
           also_table=True),
    Format('a bag of mavros', lambda of: mavros.is_bag(of.topics), mavros.read, ('messages',),
           also_table=True),
)


def format_of(path: Path) -> Format | None:
    """The format of a file, None for a table. Raises BadInputError where it cannot be read."""
    head = head_of(path)
    of = Source(head, topics_of(path) if is_bag(path, head) else {})
    return next((log_format for log_format in FORMATS if log_format.recognises(of)), None)


def check_single(path: Path, kind: str, log: int) -> None:
    """Raise BadInputError where --log asks for another than the only one that a file holds."""
    if log != 1:
        raise BadInputError(f'{path}: --log', f'{kind} holds one log', log, 'leave it out')


def read_log(
    path: Path, log_format: Format, log: int = 1, messages: Path | None = None
) -> ForeignLog:
    """Read a log; `log` counts those of a file that holds several. Raises BadInputError."""
    values: dict[str, Any] = {'log': log, 'messages': messages}
    if 'log' not in log_format.options:
        check_single(path, log_format.name, log)
    if messages is not None and 'messages' not in log_format.options:
        raise BadInputError(f'{path}: --messages', f'{log_format.name} needs no definitions',
                            messages, 'leave it out')
    with plain(path) as unpacked:
        read = log_format.read(unpacked, **{name: values[name] for name in log_format.options})
    return replace(read, source=str(path)) if unpacked != path else read
