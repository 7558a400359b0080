"""Arguments, output and exit of this package's programs."""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Callable
from typing import NoReturn, TextIO, TypeVar

from quad_bridge.errors import QuadBridgeError

_T = TypeVar('_T')

BAD_INPUT, INTERRUPTED = 2, 130  # exit statuses (contract)
MAX_DIGITS = 30  # of a seed: Python refuses to convert very long ones, in words of its own


class OneLineParser(argparse.ArgumentParser):
    """An ArgumentParser whose errors are one line without the usage (exit status 2)."""

    def error(self, message: str) -> NoReturn:
        """End the program with status 2 and one line."""
        self.exit(BAD_INPUT, f'{self.prog}: {message}; see {self.prog} --help\n')


def positive(text: str) -> float:
    """Type of an argument: a finite number above 0."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f'must be a number above 0, found {text!r}')
    return value


def seed(text: str) -> int:
    """Type of an argument: seed of a random generator."""
    if not (text.isascii() and text.isdigit() and len(text) <= MAX_DIGITS):
        raise argparse.ArgumentTypeError(f'must be a whole number of 0 or more, found {text!r}')
    return int(text)


def say(text: str) -> bool:
    """Write to stdout at once; False where that fails (closed, `| head`, a full disk).

    Later output is dropped then, so that the work still gets done.
    """
    return _write(sys.stdout, text)


def complain(text: str) -> bool:
    """Write to stderr as `say` does to stdout."""
    return _write(sys.stderr, text)


def _write(stream: TextIO | None, text: str) -> bool:
    if stream is None:
        return False
    try:
        stream.write(text)
        stream.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
        return False
    return True


def ended_in_one_line(program: str, work: Callable[[], _T]) -> _T:
    """Return `work()`; an error that a user can correct ends the program with one line."""
    try:
        return work()
    except (QuadBridgeError, OSError) as error:
        complain(f'{program}: {one_line(error)}\n')
        sys.exit(BAD_INPUT)
    except KeyboardInterrupt:
        complain(f'{program}: interrupted\n')
        sys.exit(INTERRUPTED)


def one_line(error: Exception) -> str:
    """An error as one line, file before reason."""
    if isinstance(error, OSError) and error.filename:
        return f'{error.filename}: {error.strerror}'
    return ' '.join(str(error).split())
