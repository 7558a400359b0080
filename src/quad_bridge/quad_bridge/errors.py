"""The error root of quad_bridge: each message is one line that names what was wrong and helps.

Commands turn these into their exit status (contract, Commands); nodes into /diagnostics.
"""

from __future__ import annotations

from quad_bridge.one_line import one_line


class QuadBridgeError(Exception):
    """Root of all errors that a user or the aircraft can cause or mend."""

    exit_status = 2


class BadInputError(QuadBridgeError, ValueError):
    """A file, field, parameter or argument is wrong.

    `str()` is the one line for stderr: ``<where>: <what>: found <value>; <remedy>``.
    """

    def __init__(self, where: str, what: str, value: object = None, remedy: str = '') -> None:
        super().__init__(one_line(where, what, value, remedy))
        self.where = where


class EncodeError(QuadBridgeError, ValueError):
    """A frame of ours does not fit its message: a number out of range, a name too long."""


class RefusedError(QuadBridgeError, ValueError):
    """Wanted gains that must not reach the aircraft; `str()` names gain, value and bound."""
