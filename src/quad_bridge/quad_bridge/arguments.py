"""The command line parser of this package's programs: what is wrong is said in one line."""

from __future__ import annotations

import argparse
from typing import NoReturn

BAD_INPUT = 2


class OneLineParser(argparse.ArgumentParser):
    """An ArgumentParser that leaves the usage to --help (contract, exit status 2)."""

    def error(self, message: str) -> NoReturn:
        """End the program."""
        self.exit(BAD_INPUT, f'{self.prog}: {message}; see {self.prog} --help\n')
