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

    TABLE = 'a table'
    """CSV, Parquet, a Crazyflie's SD card, a bag of other topics."""
    PX4 = 'a PX4 log'
    ARDUPILOT = 'an ArduPilot log'
    BLACKBOX = 'a blackbox log'


READERS: Mapping[Kind, Callable[[Path], ForeignLog]] = {
    Kind.PX4: px4.read,
    Kind.ARDUPILOT: ardupilot.read,
}


def kind_of(path: Path) -> Kind:
    """The kind of a file; raises BadInputError where it cannot be read."""
    if path.is_dir():
        return Kind.TABLE
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
        return Kind.BLACKBOX
    if b'loopIteration' in head and b'gyroADC[0]' in head:
        return Kind.BLACKBOX
    return Kind.TABLE


def read_log(path: Path, kind: Kind, log: int = 1) -> ForeignLog:
    """Read a log of a kind that is no plain table; `log` counts those in one blackbox file.

    Raises BadInputError.
    """
    if kind is Kind.BLACKBOX:
        return betaflight.read(path, log)
    if log != 1:
        raise BadInputError(f'{path}: --log', f'{kind.value} holds one log', log, 'leave it out')
    return READERS[kind](path)
