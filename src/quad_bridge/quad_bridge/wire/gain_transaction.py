"""Writing a set of the STM32's parameters, all or none, as a state machine over frames. No I/O.

OPEN a copy, PARAM_SET each and have it read back, COMMIT with a checksum over the whole set, read
back what is active. Each step has a time-out and three repeats; where one fails, REVERT. `poll`
says what to send, `take` what came back; times in s on any steady clock.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from enum import Enum

from quad_bridge.errors import RefusedError
from quad_bridge.wire.frames import (
    GainsAction,
    GainsCommand,
    GainsResult,
    GainsState,
    ParamRequestRead,
    ParamSet,
    ParamValue,
)
from quad_bridge.wire.params import check_writable, checksum, float32

TIMEOUT_S = 0.25
RETRIES = 3
Request = GainsCommand | ParamSet | ParamRequestRead
Answer = GainsState | ParamValue


class Phase(Enum):
    """Where a transaction stands."""

    OPENING = 'opening'
    WRITING = 'writing'
    COMMITTING = 'committing'
    READING = 'reading back'
    UNDOING = 'undoing'
    DONE = 'done'
    FAILED = 'failed'


class Exchange:
    """One request, repeated until an answer satisfies it; `spent` when the repeats are used up."""

    def __init__(
        self, request: Request, answers: Callable[[Answer], bool],
        *, timeout_s: float = TIMEOUT_S, retries: int = RETRIES,
    ) -> None:  # fmt: skip
        self._request, self._answers = request, answers
        self._timeout_s, self._left = timeout_s, retries + 1
        self._deadline_s = -math.inf
        self.done = False

    def spent(self, now_s: float) -> bool:
        """True when the last repeat has had its time and no answer came."""
        return not self.done and self._left == 0 and now_s >= self._deadline_s

    def poll(self, now_s: float) -> Request | None:
        """The request where it is due."""
        if self.done or self._left == 0 or now_s < self._deadline_s:
            return None
        self._left -= 1
        self._deadline_s = now_s + self._timeout_s
        return self._request

    def take(self, answer: Answer) -> bool:
        """True where this answer completes the exchange."""
        self.done = self.done or self._answers(answer)
        return self.done

    def hurry(self) -> None:
        """Repeat at once: the answer was a wrong one."""
        self._deadline_s = -math.inf


def command(
    action: GainsAction, number: int, *, retries: int = RETRIES, check: int = 0, watch_ms: int = 0
) -> Exchange:
    """One action on the set and its answer, whatever its result."""

    def answers(answer: Answer) -> bool:
        return (
            isinstance(answer, GainsState)
            and answer.action == action
            and (answer.transaction == number or answer.result == GainsResult.WRONG_ID)
        )

    request = GainsCommand(int(action), number, check, watch_ms)
    return Exchange(request, answers, retries=retries)


class GainTransaction:
    """Writes `wanted` (wire names), all or none.

    `active` holds all parameters that the STM32 has, `order` their names by index. Raises
    RefusedError before anything is sent.
    """

    def __init__(
        self,
        wanted: Mapping[str, float],
        active: Mapping[str, float],
        order: Sequence[str],
        *,
        number: int,
        watch_ms: int,
    ) -> None:
        for name, value in wanted.items():
            check_writable(name, value)
            if name not in active or name not in order:
                raise RefusedError(f'{name}: the STM32 has not reported it; nothing to go back to')
        self._writes = {name: float32(value) for name, value in wanted.items()}
        merged = {**active, **self._writes}
        self._checksum = checksum([merged[name] for name in order])
        self._watch_ms = watch_ms
        self._queue: list[str] = []
        self.number = number
        self.phase = Phase.OPENING
        self.reason = ''
        """Why it failed, one line."""
        self.in_doubt = False
        """True where the STM32 did not answer the undoing either: it reverts by itself."""
        self._shown: dict[str, float] = {}
        self._exchange = command(GainsAction.OPEN, number)

    @property
    def finished(self) -> bool:
        """True when nothing more will be sent."""
        return self.phase in {Phase.DONE, Phase.FAILED}

    @property
    def shows_active(self) -> bool:
        """True where a PARAM_VALUE tells what is in force and not what stands in the copy."""
        return self.phase in {Phase.READING, Phase.DONE}

    def poll(self, now_s: float) -> Request | None:
        """The frame to send now, if any; also notices time-outs."""
        if self.finished:
            return None
        if self._exchange.spent(now_s):
            self._give_up(self._complaint())
        return None if self.finished else self._exchange.poll(now_s)

    def take(self, answer: Answer) -> None:
        """Use an answer; those to other questions are ignored."""
        if self.finished:
            return
        if isinstance(answer, ParamValue) and self._queue and answer.name == self._queue[0]:
            self._shown[answer.name] = answer.value
            if answer.value != self._writes[answer.name] and self.phase is Phase.WRITING:
                self._exchange.hurry()
        if not self._exchange.take(answer):
            return
        if isinstance(answer, GainsState):
            self._answered(answer)
        else:
            self._queue.pop(0)
            self._next()

    def abandon(self, reason: str) -> None:
        """Give up from outside: undo what was done so far."""
        if not self.finished and self.phase is not Phase.UNDOING:
            self._give_up(reason)

    def _answered(self, answer: GainsState) -> None:
        if self.phase is Phase.UNDOING:
            self.phase = Phase.FAILED
        elif answer.result != GainsResult.OK:
            words = GainsResult(answer.result).name.lower().replace('_', ' ')
            self._give_up(f'the STM32 refused the set: {words}')
        elif self.phase is Phase.OPENING:
            self.phase, self._queue = Phase.WRITING, list(self._writes)
            self._next()
        elif self.phase is Phase.COMMITTING:
            self.phase, self._queue = Phase.READING, list(self._writes)
            self._shown.clear()
            self._next()

    def _next(self) -> None:
        if not self._queue:
            if self.phase is Phase.READING:
                self.phase = Phase.DONE
                return
            self.phase = Phase.COMMITTING
            self._exchange = command(
                GainsAction.COMMIT, self.number, check=self._checksum, watch_ms=self._watch_ms
            )
            return
        name = self._queue[0]
        value = self._writes[name]
        writing = self.phase is Phase.WRITING
        request = ParamSet(name, value) if writing else ParamRequestRead(name)
        self._exchange = Exchange(
            request,
            lambda a: isinstance(a, ParamValue) and a.name == name and a.value == value,
        )

    def _complaint(self) -> str:
        tries = RETRIES + 1
        if self._queue and self._queue[0] in self._shown:
            name = self._queue[0]
            return f'{name}: the STM32 kept {self._shown[name]:g} not {self._writes[name]:g}'
        if self._queue:
            return f'{self._queue[0]}: no answer to {tries} tries while {self.phase.value}'
        return f'no answer to {tries} tries while {self.phase.value}'

    def _give_up(self, reason: str) -> None:
        if self.phase is Phase.UNDOING:
            self.reason += '; the undoing was not answered: the STM32 goes back by itself'
            self.in_doubt = True
            self.phase = Phase.FAILED
            return
        self.phase, self.reason, self._queue = Phase.UNDOING, reason, []
        self._exchange = command(GainsAction.REVERT, self.number)
