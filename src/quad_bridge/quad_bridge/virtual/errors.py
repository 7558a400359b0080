"""Errors of the virtual STM32's user, beside quad_bridge's own."""

from __future__ import annotations

from quad_bridge.errors import BadInputError, QuadBridgeError


class ConfigurationError(BadInputError):
    """A profile, event file or argument is wrong; `where` is the file with the path of keys."""


class EffectModuleError(QuadBridgeError):
    """A file given by --effect-module cannot be loaded, raises, or returns nonsense."""

    def __init__(self, where: str, what: str) -> None:
        super().__init__(' '.join(f'{where}: {what}'.split()))
