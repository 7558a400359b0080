"""The error of the virtual STM32's user, beside quad_bridge's own."""

from __future__ import annotations

from quad_bridge.errors import BadInputError


class ConfigurationError(BadInputError):
    """A profile, event file, effect module or argument is wrong; `where` is the file, and keys."""
