"""The file with the key that both ends sign with, and the command `make_key`. No signing here.

A key is 32 random bytes, written as 64 hexadecimal digits, readable by its owner alone.
"""

from __future__ import annotations

import os
import secrets
import stat
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from quad_bridge.arguments import OneLineParser
from quad_bridge.errors import BadInputError
from quad_bridge.wire.signing import KEY_BYTES, Signing, signing_time

LARGEST = 4096
"""Bytes that a file with a key may have, white space included."""


def read_key(path: Path) -> bytes:
    """The 32 bytes of the key, from hexadecimal digits or raw.

    Raises BadInputError where the file cannot be read, may be read by others, or is no key.
    """
    where = f'key file {path}'
    try:
        # what is checked is what is read: one open file
        with path.open('rb') as file:
            mode = os.fstat(file.fileno()).st_mode
            data = file.read(LARGEST)
    except OSError as error:
        remedy = 'make one: ros2 run quad_bridge make_key FILE'
        raise BadInputError(where, f'cannot be read ({error.strerror})', remedy=remedy) from error
    if mode & (stat.S_IRWXG | stat.S_IRWXO):
        found = f'mode {stat.S_IMODE(mode):04o}'
        raise BadInputError(where, 'must be for its owner alone', found, f'chmod 600 {path}')
    if len(data) == KEY_BYTES:
        return data
    try:
        key = bytes.fromhex(data.decode('ascii'))
    except ValueError:
        key = b''
    if len(key) != KEY_BYTES:
        what = f'must hold {KEY_BYTES} bytes, or {2 * KEY_BYTES} hexadecimal digits'
        raise BadInputError(where, what, f'{len(data)} bytes')
    return key


def write_key(path: Path) -> None:
    """Write a new key, for its owner alone. Raises BadInputError; an existing file stays."""
    try:
        number = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except OSError as error:
        raise BadInputError(f'key file {path}', f'cannot be made ({error.strerror})') from error
    with os.fdopen(number, 'w', encoding='ascii') as file:
        file.write(secrets.token_hex(KEY_BYTES) + '\n')


def signing_from(path: Path | None, *, link_id: int = 0) -> Signing | None:
    """What signs and judges by the key in `path` and the system's clock; None without a path."""
    if path is None:
        return None
    return Signing(read_key(path), lambda: signing_time(time.time_ns()), link_id=link_id)


def main(argv: Sequence[str] | None = None) -> int:
    """`make_key FILE`: 0 when it was written, 2 with one line where it was not."""
    parser = OneLineParser(
        prog='make_key', description='Writes a new key for the link between bridge and STM32.'
    )
    parser.add_argument('file', type=Path, help='must not exist yet')
    given = parser.parse_args(argv)
    try:
        write_key(given.file)
    except BadInputError as error:
        sys.stderr.write(f'make_key: {error}\n')
        return 2
    sys.stdout.write(f'{given.file}: copy it to the other end, and nowhere else\n')
    return 0


if __name__ == '__main__':
    sys.exit(main())
