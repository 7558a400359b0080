"""What is written to an aircraft's history of gains, and when its files are opened."""

from __future__ import annotations

import time
from collections.abc import Mapping
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from quad_bridge.aircraft_store import AircraftStore
from quad_bridge.gain_request import GainRequest


class GainLog:
    """The history of the aircraft that is connected; nothing is written before it is known."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._store: AircraftStore | None = None
        self._aircraft = ''
        self._last: Mapping[str, float] = {}
        self._count = 0

    @property
    def fault(self) -> str:
        """What keeps the history from being written."""
        return '' if self._store is None else self._store.fault

    def open(self, aircraft: str) -> dict[str, Any] | None:
        """Take this aircraft's files; its polarity record where it is another one than before."""
        if aircraft == self._aircraft:
            return None
        self._aircraft, self._last = aircraft, {}
        self._store = AircraftStore(self._folder, aircraft)
        return self._store.polarity()

    def identity(self) -> str:
        """A name for a new update."""
        self._count += 1
        return f'{datetime.now(timezone.utc):%Y%m%dT%H%M%S}-{self._count}'

    def found(self, active: Mapping[str, float]) -> None:
        """Gains read from the STM32: written where they are not those written last."""
        if active and active != self._last:
            self.write('active', active, reason='read from the STM32')

    def write(
        self,
        state: str,
        active: Mapping[str, float] | None = None,
        asked: GainRequest | None = None,
        **more: object,
    ) -> None:
        """One line: a set that is active now, or what became of an update."""
        if self._store is None:
            return
        entry: dict[str, object] = {'time': now_text(), 'clock_s': time.time(), 'state': state}
        if asked is not None:
            entry |= {'source': asked.source, 'model': asked.model, 'bag': asked.bag}
        if active is not None:
            self._last = active
            entry['gains'] = dict(active)
        entry |= more
        self._store.append({k: v for k, v in entry.items() if v not in ('', {}, None)})

    def keep_polarity(self, record: Mapping[str, Any]) -> None:
        """Replace the aircraft's polarity record."""
        if self._store is not None:
            self._store.keep_polarity({**record, 'time': now_text()})


def now_text() -> str:
    """UTC, to the millisecond."""
    return datetime.now(timezone.utc).isoformat(timespec='milliseconds')
