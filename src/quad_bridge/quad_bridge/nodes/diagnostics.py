"""Status entries of a node's parts as /diagnostics messages; no part is known here."""

from __future__ import annotations

import re
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from quad_bridge.nodes.fence import LogLimiter
from quad_bridge.status import Status

FIGURE = re.compile(r'\d+(\.\d+)?')
"""In the words of a state that lasts, such as for how long it has."""


class Changes:
    """Selects entries for the log: a state when it begins, not every second."""

    def __init__(self, limiter: LogLimiter) -> None:
        self._limiter = limiter
        self._messages: dict[str, str] = {}

    def new(self, entries: list[Status], now_s: float) -> list[Status]:
        """Entries whose message changed and may be logged."""
        states = {e.name: FIGURE.sub('', e.message) for e in entries}
        changed = [e for e in entries if self._messages.get(e.name) != states[e.name]]
        self._messages |= states
        return [e for e in changed if self._limiter.allow(e.name + e.message, now_s)]


def diagnostic_array(node: Any, hardware: str, entries: list[Status]) -> Any:
    """The message of all entries, named `<node>: <entry>`, of now."""
    array = DiagnosticArray()
    array.header.stamp = node.get_clock().now().to_msg()
    array.status = [
        DiagnosticStatus(
            name=f'{node.get_name()}: {entry.name}',
            level=bytes([entry.level]),
            message=entry.message,
            hardware_id=hardware,
            values=[KeyValue(key=k, value=str(v)) for k, v in entry.values.items()],
        )
        for entry in entries
    ]
    return array
