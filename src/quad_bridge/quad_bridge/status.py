"""One entry of /diagnostics, as a part of a node makes it. No ROS.

Levels are those of diagnostic_msgs/DiagnosticStatus.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

OK, WARN, ERROR = 0, 1, 2


@dataclass(frozen=True)
class Status:
    """One entry of /diagnostics."""

    name: str
    level: int
    message: str
    values: Mapping[str, object] = field(default_factory=dict)
