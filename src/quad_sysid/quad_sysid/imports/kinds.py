"""Which kind of log a file is, by its first bytes, and the reader for it.

To add a kind is to add one entry to READERS and its recognition here.
"""

from __future__ import annotations

import gzip
from collections.abc import Callable, Mapping
from enum import Enum
from pathlib import Path

from quad_sysid.errors import BadInputError
from quad_sysid.imports import ardupilot, betaflight, px4
from quad_sysid.imports.log import ForeignLog

ULOG = b'ULog\x01\x12\x35'
DATAFLASH = b'\xa3\x95\x80'
RAW_BLACKBOX = b'H Product:Blackbox'
HEAD = 65536


class Kind(Enum):
    """What a file to be imported is."""

    CSV = 'a table'
    PX4 = 'a PX4 log'
    ARDUPILOT = 'an ArduPilot log'
    BETAFLIGHT = 'a Betaflight blackbox table'


READERS: Mapping[Kind, Callable[[Path], ForeignLog]] = {
    Kind.PX4: px4.read,
    Kind.ARDUPILOT: ardupilot.read,
    Kind.BETAFLIGHT: betaflight.read,
}


def kind_of(path: Path) -> Kind:
    """The kind of a file; raises BadInputError where it cannot be read or is still encoded."""
    try:
        with path.open('rb') as stream:
            head = stream.read(HEAD)
        if head[:2] == b'\x1f\x8b':
            with gzip.open(path) as packed:
                head = packed.read(HEAD)
    except (OSError, EOFError) as error:
        reason = getattr(error, 'strerror', None) or str(error)
        raise BadInputError(str(path), f'cannot be read ({reason})', remedy='check it') from error
    if head.startswith(ULOG):
        return Kind.PX4
    if head.startswith((DATAFLASH, b'FMT, 128,')):
        return Kind.ARDUPILOT
    if head.startswith(RAW_BLACKBOX):
        raise BadInputError(
            str(path), 'is a blackbox log still encoded', remedy='decode it with blackbox_decode '
            '(or export CSV from the Blackbox Explorer) and import that',
        )
    if b'loopIteration' in head and b'gyroADC[0]' in head:
        return Kind.BETAFLIGHT
    return Kind.CSV


def read_log(path: Path, kind: Kind) -> ForeignLog:
    """Read a log of a kind that is no plain table; raises BadInputError."""
    return READERS[kind](path)
