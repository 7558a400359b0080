"""The error root of quad_sysid: each message is one line that names what is wrong and what helps.

Commands turn these into their exit status (contract.md, Commands); nothing else maps errors.
"""

from __future__ import annotations


class QuadSysidError(Exception):
    """Root of all errors that a user can cause or mend; `exit_status` is the command's."""

    exit_status = 2


class BadInputError(QuadSysidError, ValueError):
    """A file, field or argument is wrong.

    `str()` is the one line for stderr: ``<where>: <what>: found <value>; <remedy>``.
    """

    def __init__(self, where: str, what: str, found: object = None, remedy: str = '') -> None:
        text = f'{where}: {what}'
        if found is not None:
            text += f': found {found}'
        if remedy:
            text += f'; {remedy}'
        super().__init__(' '.join(text.split()))
        self.where = where


class NotInformativeError(QuadSysidError):
    """The data are in order but cannot answer what was asked (exit status 3)."""

    exit_status = 3
