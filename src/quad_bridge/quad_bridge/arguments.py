"""The command line parser of this package's programs: what is wrong is said in one line."""

from __future__ import annotations

import argparse
import math
from typing import NoReturn

BAD_INPUT = 2
MOST_DIGITS = 30


class OneLineParser(argparse.ArgumentParser):
    """An ArgumentParser that leaves the usage to --help (contract, exit status 2)."""

    def error(self, message: str) -> NoReturn:
        """End the program."""
        self.exit(BAD_INPUT, f'{self.prog}: {message}; see {self.prog} --help\n')


def positive(text: str) -> float:
    """Type of an argument: a number above 0 that is finite."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f'must be a number above 0, found {text!r}')
    return value


def seed(text: str) -> int:
    """Type of an argument: what a random generator begins with."""
    if not (text.isascii() and text.isdigit() and len(text) <= MOST_DIGITS):
        raise argparse.ArgumentTypeError(f'must be a whole number of 0 or more, found {text!r}')
    return int(text)
