"""What the keeper of the gains is told at the start, where it stands, and what it has to tell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path

from quad_bridge.gains.table import DEFAULT_BOUNDS, Bound
from quad_bridge.wire.frames import GainsState


class State(Enum):
    """What is going on with the gains."""

    IDLE = 'read back'
    CHECKING = 'checking polarity'
    WRITING = 'writing'
    WATCHING = 'watching'
    CONFIRMING = 'confirming'
    REVERTING = 'taking back'


@dataclass(frozen=True)
class KeeperSettings:
    """What the YAML says."""

    bounds: Mapping[str, Bound] = field(default_factory=lambda: DEFAULT_BOUNDS)
    sources: Sequence[str] = ('*',)
    polarity: str = 'auto'
    folder: Path = Path()
    aircraft: str = ''
    """Name of the folder of its files; empty: the STM32's unique number."""

    def name_of(self, state: GainsState | None) -> str:
        """Name of the folder of the aircraft that says this; '' while it is not known."""
        return self.aircraft or (f'{state.aircraft:016x}' if state is not None else '')


@dataclass(frozen=True)
class News:
    """One thing to tell: a line, and the gains where they are now known to be in force."""

    text: str
    fault: bool = False
    active: Mapping[str, float] | None = None
