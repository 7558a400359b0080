"""The firmware's sets of parameters: active, the copy being written, and the last good one. Pure.

The wire's QUAD_GAINS messages act on it (quad_suite.xml). Without a word from the bridge, or
without its CONFIRM in time, a watched set is taken back here, by the firmware itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from quad_bridge.gains.protocol import checksum
from quad_bridge.wire.frames import (
    GainsAction,
    GainsCommand,
    GainsPhase,
    GainsResult,
    GainsState,
)

LINK_DEAD_S = 2.0
"""Silence after which the bridge is taken as gone."""


class GainStore:
    """`active` maps wire names to values in the order of their index; `version` counts changes."""

    def __init__(
        self, active: Mapping[str, float], fits: Callable[[str, float], bool], aircraft: int
    ) -> None:
        self.active = dict(active)
        self.version = 0
        self._fits, self._aircraft = fits, aircraft
        self._good = dict(active)
        self._copy: dict[str, float] | None = None
        self._number = 0
        self._watching = False
        self._deadline_s = math.inf
        self._heard_s = 0.0

    @property
    def phase(self) -> GainsPhase:
        """What is reported."""
        if self._copy is not None:
            return GainsPhase.STAGING
        return GainsPhase.WATCH if self._watching else GainsPhase.IDLE

    def shown(self, name: str) -> float:
        """What PARAM_VALUE says: the copy while one is open."""
        return (self.active if self._copy is None else self._copy)[name]

    def write(self, name: str, value: float) -> None:
        """PARAM_SET: into the copy, if it fits. Without a copy it may be a late one: nothing."""
        if self._copy is not None and self._fits(name, value):
            self._copy[name] = value

    def heard(self, now_s: float) -> None:
        """A frame of the bridge has come."""
        self._heard_s = now_s

    def take(self, asked: GainsCommand, now_s: float) -> GainsState:
        """Act on QUAD_GAINS; its answer."""
        try:
            action = GainsAction(asked.action)
        except ValueError:
            return self._state(GainsAction.QUERY, GainsResult.WRONG_ID)
        result = GainsResult.OK
        if action is GainsAction.OPEN:
            if self._number != asked.transaction or self._copy is None:
                self._copy, self._number = dict(self.active), asked.transaction
        elif action is not GainsAction.QUERY and asked.transaction != self._number:
            result = GainsResult.WRONG_ID
        elif action is GainsAction.COMMIT:
            result = self._commit(asked, now_s)
        elif action is GainsAction.CONFIRM:
            self._good, self._watching = dict(self.active), False
        elif action is GainsAction.REVERT:
            self._revert()
        return self._state(action, result)

    def tick(self, now_s: float) -> GainsState | None:
        """Once a cycle: the state to send where the firmware has reverted by itself."""
        if self._copy is None and not self._watching:
            return None
        if now_s - self._heard_s > LINK_DEAD_S:
            self._revert()
            return self._state(GainsAction.QUERY, GainsResult.LINK_LOST)
        if self._watching and now_s > self._deadline_s:
            self._revert()
            return self._state(GainsAction.QUERY, GainsResult.NOT_CONFIRMED)
        return None

    def state(self) -> GainsState:
        """What is sent once a second."""
        return self._state(GainsAction.QUERY, GainsResult.OK)

    def _commit(self, asked: GainsCommand, now_s: float) -> GainsResult:
        if self._copy is None:
            # repeated after a lost answer
            same = asked.checksum == checksum(list(self.active.values()))
            return GainsResult.OK if same and self._watching else GainsResult.CHECKSUM
        if asked.checksum != checksum(list(self._copy.values())):
            return GainsResult.CHECKSUM
        self.active, self._copy = self._copy, None
        self._watching, self._deadline_s = True, now_s + 1e-3 * asked.watch_ms
        self.version += 1
        return GainsResult.OK

    def _revert(self) -> None:
        self._copy, self._watching = None, False
        self.active = dict(self._good)
        self.version += 1

    def _state(self, action: GainsAction, result: GainsResult) -> GainsState:
        return GainsState(
            aircraft=self._aircraft,
            checksum=checksum(list(self.active.values())),
            transaction=self._number,
            action=int(action),
            result=int(result),
            phase=int(self.phase),
        )
