"""The errors of the virtual STM32, beside quad_bridge's own."""

from __future__ import annotations

from quad_bridge.errors import BadInputError, QuadBridgeError


class ConfigurationError(BadInputError):
    """A profile, event file, effect module or argument is wrong; `where` is the file, and keys."""


class RestartedError(QuadBridgeError):
    """The firmware restarted in flight, and waits for settings that no flight has twice."""

    def __init__(self, cycle: int) -> None:
        super().__init__(f'the firmware restarted by itself in cycle {cycle}: see its watchdog')
