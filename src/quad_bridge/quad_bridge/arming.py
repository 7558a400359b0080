"""A request to arm or to disarm, from its sending to the STM32's answer. Pure, safe in threads.

COMMAND_ACK does not say which request it answers: arming is sent once and nothing is armed while
an answer to it may still come; disarming passes at any time, and is sent again until answered.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass

from quad_bridge.errors import RefusedError
from quad_bridge.wire.frames import Command, CommandAck

ARM_DISARM = 400
"""MAV_CMD_COMPONENT_ARM_DISARM."""
ANSWER_S = 1.0
"""An answer is waited for so long; a late one may come for as long again."""
ACCEPTED = 'accepted'
_RESULTS = (ACCEPTED, 'not now', 'denied', 'not supported', 'failed')


@dataclass(frozen=True)
class _Asked:
    arm: bool
    until_s: float
    told: tuple[Callable[[str], None], ...]

    @property
    def command(self) -> Command:
        return Command(ARM_DISARM, (1.0 if self.arm else 0.0,))

    def tell(self, text: str) -> None:
        for told in self.told:
            told(text)


class Arming:
    """See the module. Each `told` is called once, with what became of its request."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._asked: _Asked | None = None
        self._owed_until_s = -math.inf
        """Until then an answer may be to arming that nobody waits for any more."""

    def ask(self, arm: bool, told: Callable[[str], None], now_s: float) -> Command:
        """Take on a request; what to send. Raises RefusedError."""
        with self._lock:
            earlier = self._asked
            if arm and (earlier is not None or now_s < self._owed_until_s):
                raise RefusedError('an earlier request waits for its answer')
            others = earlier.told if earlier is not None and not earlier.arm else ()
            self._asked = asked = _Asked(arm, now_s + ANSWER_S, (*others, told))
            if earlier is not None and earlier.arm:
                self._owed_until_s = now_s + ANSWER_S
        if earlier is not None and earlier.arm:
            earlier.tell('given up for a request to disarm')
        return asked.command

    def tick(self, now_s: float) -> Command | None:
        """Give up where no answer has come; what to send again."""
        with self._lock:
            asked = self._asked
            if asked is None or now_s <= asked.until_s:
                return asked.command if asked is not None and not asked.arm else None
            self._asked = None
            if asked.arm:
                self._owed_until_s = now_s + ANSWER_S
        asked.tell(f'no answer in {ANSWER_S:g} s')
        return None

    def acknowledged(self, ack: CommandAck, now_s: float) -> None:
        """The STM32 has answered a command."""
        if ack.command != ARM_DISARM:
            return
        with self._lock:
            owed, self._owed_until_s = now_s < self._owed_until_s, -math.inf
            if owed or self._asked is None:
                return
            asked, self._asked = self._asked, None
        known = ack.result < len(_RESULTS)
        asked.tell(_RESULTS[ack.result] if known else f'result {ack.result}')

    def end(self, why: str) -> None:
        """Nobody is there to answer any more."""
        with self._lock:
            asked, self._asked = self._asked, None
        if asked is not None:
            asked.tell(why)
