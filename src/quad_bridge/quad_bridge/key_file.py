"""The file with the key that both ends sign with, and the command `make_key`. No signing here.

A key is 32 random bytes, written as 64 hexadecimal digits, readable by its owner alone. What is
accepted (docs/connect.md) is the same in firmware/boards/linux/terminal.c.
"""

from __future__ import annotations

import os
import secrets
import stat
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from quad_bridge.arguments import OneLineParser, ended_in_one_line, say
from quad_bridge.errors import BadInputError
from quad_bridge.wire.signing import KEY_BYTES, Signing, signing_time

LARGEST = 4096  # bytes that a file with a key may have, white space included
MAKE = 'make one: ros2 run quad_bridge make_key FILE'
_DIGITS = frozenset(b'0123456789abcdefABCDEF')
_SPACE = b' \t\n\r\v\f'


def read_key(path: Path) -> bytes:
    """The 32 bytes of the key, from 64 hexadecimal digits with white space around, or raw.

    Raises BadInputError where the file cannot be read, may be read by others, or is no key: also
    for 32 bytes that are digits themselves (half a key), and for all zeros.
    """
    where = f'key file {path}'
    try:
        # what is checked is what is read: one open file
        with path.open('rb') as file:
            bits = os.fstat(file.fileno()).st_mode
            data = file.read(LARGEST + 1)
    except OSError as error:
        raise BadInputError(where, f'cannot be read ({error.strerror})', remedy=MAKE) from error
    if bits & (stat.S_IRWXG | stat.S_IRWXO):
        mode = f'mode {stat.S_IMODE(bits):04o}'
        raise BadInputError(where, 'must be for its owner alone', mode, f'chmod 600 {path}')
    key = _key_in(data)
    if key is None:
        what = f'must hold {2 * KEY_BYTES} hexadecimal digits, or {KEY_BYTES} raw bytes'
        raise BadInputError(where, what, f'{len(data)} bytes', MAKE)
    if not any(key):
        raise BadInputError(where, 'is all zeros, which is no secret', remedy=MAKE)
    return key


def _key_in(data: bytes) -> bytes | None:
    """The key in a file's content; None where it holds none, or half of one."""
    text = data.strip(_SPACE)
    digits = _DIGITS.issuperset(text)
    if len(data) <= LARGEST and len(text) == 2 * KEY_BYTES and digits:
        return bytes.fromhex(text.decode('ascii'))
    return data if len(data) == KEY_BYTES and not digits else None


def write_key(path: Path) -> None:
    """Write a new key, for its owner alone. Raises BadInputError; an existing file stays."""
    text = secrets.token_hex(KEY_BYTES) + '\n'
    try:
        number = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(number, 'w', encoding='ascii') as file:
            file.write(text)
    except OSError as error:
        what = f'cannot be made ({error.strerror})'
        raise BadInputError(f'key file {path}', what, remedy='give another name') from error


def signing_from(path: Path | None) -> Signing | None:
    """Signing and checking by the key in `path` and the system's clock; None without a path."""
    if path is None:
        return None
    return Signing(read_key(path), lambda: signing_time(time.time_ns()))


def main(argv: Sequence[str] | None = None) -> int:
    """`make_key FILE`: 0 when it was written; ends with 2 and one line where it was not."""
    parser = OneLineParser(
        prog='make_key', description='Writes a new key for the link between bridge and STM32.'
    )
    parser.add_argument('file', type=Path, help='must not exist yet')
    args = parser.parse_args(argv)
    ended_in_one_line('make_key', lambda: write_key(args.file))
    say(f'{args.file}: copy it to the other end, and nowhere else\n')
    return 0


if __name__ == '__main__':
    sys.exit(main())
