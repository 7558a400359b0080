"""The errors of quad_sysid: each message is one line that says what is wrong and what to do.

Commands exit with the error's `exit_status`.
"""

from __future__ import annotations

from quad_sysid.one_line import one_line


class QuadSysidError(Exception):
    """Root of all errors that a user can cause or correct; `exit_status` is the command's."""

    exit_status = 2


class BadInputError(QuadSysidError, ValueError):
    """A file, field or argument is wrong.

    `str()` is one line: ``<where>: <what>: found <value>; <remedy>``.
    """

    def __init__(self, where: str, what: str, value: object = None, remedy: str = '') -> None:
        super().__init__(one_line(where, what, value, remedy))


class NoSuchAttributeError(BadInputError, AttributeError):
    """A result lacks what was asked of it; `hasattr` says so too."""


class NotInformativeError(QuadSysidError):
    """The data are in order but cannot answer what was asked (exit status 3)."""

    exit_status = 3


def p_in_words(p: float) -> str:
    """A p-value in a message, to follow `p`: `= 0.03` or `< 0.0001`."""
    return '< 0.0001' if p < 1e-4 else f'= {p:.2g}'
