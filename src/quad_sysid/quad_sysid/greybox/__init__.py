"""The contract's base as a grey box: exact drive, compiled free run, fit, error metric.

The room itself can be called: `quad_sysid.greybox(z)` fits the base to an IOData (direct.py),
beside `arx(z, …)` and the others. A module of this name cannot be a function as well.
"""

from __future__ import annotations

import sys
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from quad_sysid.greybox.direct import GreyBox
    from quad_sysid.record import IOData


class _Room(ModuleType):
    """This module, callable."""

    def __call__(self, z: IOData, *, gyro_filter_hz: float | None = None) -> GreyBox:
        """Fit the contract's base; see `quad_sysid.greybox.direct.fit_greybox`."""
        from quad_sysid.greybox.direct import fit_greybox

        return fit_greybox(z, gyro_filter_hz=gyro_filter_hz)


sys.modules[__name__].__class__ = _Room
