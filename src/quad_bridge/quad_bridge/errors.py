"""The error root of quad_bridge: each message is one line that names what was wrong and helps.

Commands turn these into their exit status (contract, Commands); nodes into /diagnostics.
"""

from __future__ import annotations

MAX_VALUE = 300
"""Characters of a value that a message shows; it may be a whole file."""


class QuadBridgeError(Exception):
    """Root of all errors that a user or the aircraft can cause or mend."""

    exit_status = 2


class BadInputError(QuadBridgeError, ValueError):
    """A file, field, parameter or argument is wrong.

    `str()` is the one line for stderr: ``<where>: <what>: found <value>; <remedy>``.
    """

    def __init__(self, where: str, what: str, value: object = None, remedy: str = '') -> None:
        text = f'{where}: {what}'
        if value is not None:
            text += f': found {shortened(value)}'
        if remedy:
            text += f'; {remedy}'
        super().__init__(' '.join(text.split()))
        self.where = where


class EncodeError(QuadBridgeError, ValueError):
    """A frame of ours does not fit its message: a number out of range, a name too long."""


class RefusedError(QuadBridgeError, ValueError):
    """Wanted gains that must not reach the aircraft; `str()` names gain, value and bound."""


def shortened(value: object) -> str:
    """A value as one line of a message that stays readable."""
    text = ' '.join(str(value).split())
    if len(text) <= MAX_VALUE:
        return text
    return f'{text[:MAX_VALUE]} … ({len(text)} characters)'
