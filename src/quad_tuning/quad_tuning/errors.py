"""The error root of quad_tuning. A refusal is an answer: it says why no gains came."""

from __future__ import annotations

from quad_sysid.errors import NotInformativeError


class QuadTuningError(Exception):
    """Root of all errors of this package."""


class DesignRefusedError(QuadTuningError, NotInformativeError):
    """The model does not allow a design; `str()` is the one-line reason (exit status 3)."""
