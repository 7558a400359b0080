"""The errors of quad_sysid: each message is one line that says what is wrong and what to do.

Commands exit with the error's `exit_status`.
"""

from __future__ import annotations

MAX_VALUE = 300
"""Characters of a value that a message shows; it may be a whole file."""


class QuadSysidError(Exception):
    """Root of all errors that a user can cause or correct; `exit_status` is the command's."""

    exit_status = 2


class BadInputError(QuadSysidError, ValueError):
    """A file, field or argument is wrong.

    `str()` is one line: ``<where>: <what>: found <value>; <remedy>``.
    """

    def __init__(self, where: str, what: str, value: object = None, remedy: str = '') -> None:
        text = f'{where}: {what}'
        if value is not None:
            text += f': found {shortened(value)}'
        if remedy:
            text += f'; {remedy}'
        super().__init__(' '.join(text.split()))


class NoSuchAttributeError(BadInputError, AttributeError):
    """A result lacks what was asked of it; `hasattr` says so too."""


class NotInformativeError(QuadSysidError):
    """The data are in order but cannot answer what was asked (exit status 3)."""

    exit_status = 3


def p_in_words(p: float) -> str:
    """A p-value in a message, to follow `p`: `= 0.03` or `< 0.0001`."""
    return '< 0.0001' if p < 1e-4 else f'= {p:.2g}'


def shortened(value: object) -> str:
    """A value as one line of a message that stays readable."""
    text = ' '.join(str(value).split())
    if len(text) <= MAX_VALUE:
        return text
    return f'{text[:MAX_VALUE]} … ({len(text)} characters)'
