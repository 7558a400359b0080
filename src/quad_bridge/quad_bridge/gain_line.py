"""The bridge's side of the STM32's parameters: reads, writes, confirms, takes back. No I/O.

`poll` says what to send, `take` what came back; what happened waits in `events`. Whether gains may
be written, and whether a written set is good, is decided elsewhere (gain_gate.py, gain_watch.py).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

from quad_bridge.errors import RefusedError
from quad_bridge.gains.table import CONTRACT_NAMES
from quad_bridge.wire.frames import (
    GainsAction,
    GainsCommand,
    GainsPhase,
    GainsResult,
    GainsState,
    ParamRequestList,
    ParamRequestRead,
    ParamSet,
    ParamValue,
)
from quad_bridge.wire.gain_transaction import Exchange, GainTransaction, Phase, command
from quad_bridge.wire.params import ParamReader, checksum

Request = GainsCommand | ParamSet | ParamRequestList | ParamRequestRead
STUBBORN = 40
"""Repeats of CONFIRM and REVERT, 0.25 s apart: the STM32 decides by itself before they end."""
STATE_S = 1.0
"""Between questions for the state while it is not known."""


class What(Enum):
    """What happened to the parameters."""

    READ = 'all read'
    COMMITTED = 'committed and read back'
    FAILED = 'not taken over'
    CONFIRMED = 'confirmed'
    REVERTED = 'taken back'
    LOST = 'link lost'


@dataclass(frozen=True)
class GainEvent:
    """One event; `active` (contract names, SI) where the gains in force are known."""

    what: What
    active: Mapping[str, float] | None = None
    reason: str = ''
    by_stm32: bool = False
    """The STM32 has taken its gains back by itself."""


class GainLine:
    """Reader, transaction and single actions, one at a time."""

    def __init__(self) -> None:
        self.reader = ParamReader()
        self.state: GainsState | None = None
        """The STM32's last word on its sets; None where its firmware knows none."""
        self.events: list[GainEvent] = []
        self._transaction: GainTransaction | None = None
        self._action: tuple[GainsAction, Exchange, str] | None = None
        self._number = 0
        self._announced = False
        self._next_query_s = 0.0

    @property
    def active(self) -> dict[str, float]:
        """Gains and loop constants as last read back, contract names, SI."""
        values = self.reader.values
        return {CONTRACT_NAMES[w]: values[w] for w in sorted(values) if w in CONTRACT_NAMES}

    @property
    def busy(self) -> str:
        """What is being done, empty where nothing is."""
        if self._transaction is not None:
            return self._transaction.phase.value
        if self._action is not None:
            return self._action[0].name.lower()
        return '' if self.reader.complete else 'reading'

    def write(self, writes: Mapping[str, float], watch_ms: int) -> None:
        """Begin to write a set (wire names). Raises RefusedError before anything is sent."""
        if self.busy:
            raise RefusedError(f'the parameters are busy: {self.busy}')
        if self.state is None:
            raise RefusedError('the STM32 has not said that it takes sets of gains (QUAD_GAINS)')
        number = self.state.transaction % 255 + 1
        self._transaction = GainTransaction(
            writes, self.reader.values, self.reader.ordered(), number=number, watch_ms=watch_ms
        )
        self._number = number

    def confirm(self) -> None:
        """Keep the committed set."""
        self._act(GainsAction.CONFIRM, '')

    def revert(self, reason: str) -> None:
        """Take the committed set back; a transaction under way is undone."""
        if self._transaction is not None:
            self._transaction.abandon(reason)
        else:
            self._act(GainsAction.REVERT, reason)

    def poll(self, now_s: float) -> list[Request]:
        """What to send now; also notices time-outs."""
        if self._transaction is not None:
            found: Request | None = self._transaction.poll(now_s)
            if self._transaction.finished:
                self._finish(self._transaction)
        elif self._action is not None:
            found = self._action[1].poll(now_s)
            if self._action[1].spent(now_s):
                self._action_spent()
        else:
            found = self.reader.poll(now_s)
        wanted = [] if found is None else [found]
        if self.state is None and now_s >= self._next_query_s:
            self._next_query_s = now_s + STATE_S
            wanted.append(GainsCommand(int(GainsAction.QUERY), 0))
        return wanted

    def take(self, frame: ParamValue | GainsState, now_s: float) -> None:
        """Use an answer."""
        transaction, action = self._transaction, self._action
        if transaction is not None:
            transaction.take(frame)
        if isinstance(frame, ParamValue):
            if transaction is None or transaction.shows_active:
                self.reader.take(frame, now_s)
        else:
            self._state(frame)
        if action is not None and action[1].take(frame):
            self._acted(action)
        if transaction is not None and transaction.finished:
            self._finish(transaction)
        if self.reader.complete and not self._announced and self._transaction is None:
            self._announced = True
            self.events.append(GainEvent(What.READ, self.active))

    def restart(self) -> None:
        """The far end is a new one, or the same again: read all anew."""
        if self._transaction is not None or self._action is not None:
            self.events.append(GainEvent(What.LOST, reason='the link broke'))
        self._transaction = self._action = self.state = None
        self._number = 0
        self._next_query_s = 0.0
        self._read_again()

    def _state(self, frame: GainsState) -> None:
        first, self.state = self.state is None, frame
        by_itself = frame.result in {GainsResult.LINK_LOST, GainsResult.NOT_CONFIRMED}
        if by_itself and self._transaction is None:
            words = GainsResult(frame.result).name.lower().replace('_', ' ')
            self._action = None
            self.events.append(GainEvent(What.REVERTED, reason=words, by_stm32=True))
            self._read_again()
        elif self._transaction is not None or self._action is not None:
            return
        elif first and frame.phase != GainsPhase.IDLE and frame.transaction != self._number:
            # somebody before us has left a set unconfirmed
            self._number = frame.transaction
            self.revert('found unconfirmed gains of an earlier bridge')
        elif self.reader.complete and frame.phase != GainsPhase.STAGING:
            names = self.reader.ordered()
            if checksum([self.reader.values[n] for n in names]) != frame.checksum:
                self._read_again()

    def _act(self, action: GainsAction, reason: str) -> None:
        self._action = action, command(action, self._number, retries=STUBBORN), reason

    def _acted(self, action: tuple[GainsAction, Exchange, str]) -> None:
        self._action = None
        if action[0] is GainsAction.CONFIRM:
            self.events.append(GainEvent(What.CONFIRMED, self.active))
            return
        self.events.append(GainEvent(What.REVERTED, reason=action[2]))
        self._read_again()

    def _action_spent(self) -> None:
        self._action = None
        self.events.append(GainEvent(What.LOST, reason='the STM32 does not answer'))
        self._read_again()

    def _finish(self, transaction: GainTransaction) -> None:
        self._transaction = None
        if transaction.phase is Phase.DONE:
            self.events.append(GainEvent(What.COMMITTED, self.active))
            return
        self.events.append(GainEvent(What.FAILED, reason=transaction.reason))
        self._read_again()

    def _read_again(self) -> None:
        self.reader.restart()
        self._announced = False
