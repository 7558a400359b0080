"""The errors of quad_sysid: each message is one line that says what is wrong and what to do.

Commands exit with the error's `exit_status`.
"""

from __future__ import annotations


class QuadSysidError(Exception):
    """Root of all errors that a user can cause or correct; `exit_status` is the command's."""

    exit_status = 2


class BadInputError(QuadSysidError, ValueError):
    """A file, field or argument is wrong.

    `str()` is one line: ``<where>: <what>: found <value>; <remedy>``.
    """

    def __init__(self, where: str, what: str, found: object = None, remedy: str = '') -> None:
        text = f'{where}: {what}'
        if found is not None:
            text += f': found {found}'
        if remedy:
            text += f'; {remedy}'
        super().__init__(' '.join(text.split()))


class NotInformativeError(QuadSysidError):
    """The data are in order but cannot answer what was asked (exit status 3)."""

    exit_status = 3
