"""The operator's part: the dead-man switch, and a request to arm or to disarm. Pure.

COMMAND_ACK does not say which request it answers: arming is sent once, and nothing is armed while
an answer to an earlier request may still come; disarming passes at any time, and is sent again
until it is answered. Arming that was given up may still lie in a buffer on the way: where
the aircraft arms later, `late` says so; nothing is disarmed without a person, it may fly.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from quad_bridge.errors import RefusedError
from quad_bridge.wire.frames import Command, CommandAck

ARM_DISARM = 400
"""MAV_CMD_COMPONENT_ARM_DISARM."""
ANSWER_S = 1.0
"""An answer is waited for so long; a late one may come for as long again."""
ACCEPTED = 'accepted'
LATE_S = 60.0
"""So long a request may have lain on the way."""
AGAIN_S = 0.2
"""Between two disarms that nothing has answered."""
HELD_S = 0.5
"""After so long without a word the switch counts as let go."""
_RESULTS = (ACCEPTED, 'not now', 'denied', 'not supported', 'failed')


class OperatorEnable:
    """The dead-man switch, /operator/enable: alive or not. Times in s on a steady clock.

    Whoever holds it says `true` at 5 Hz or faster; half a second of silence counts as letting go.
    `required` False: needed only once somebody has held it: who takes a switch relies on it.
    """

    def __init__(self, *, required: bool) -> None:
        self.required = required
        self._heard_s = -math.inf
        self._on = False

    def take(self, on: bool, now_s: float) -> None:
        """A message has come."""
        self._on, self._heard_s = on, now_s
        self.required = True

    def fault(self, now_s: float) -> str:
        """Why nobody may excite or arm now, empty where somebody may."""
        if not self.required:
            return ''
        if now_s - self._heard_s > HELD_S:
            return f'/operator/enable is silent: publish true to it every {HELD_S / 2.5:g} s'
        return '' if self._on else "the operator's enable is off"


@dataclass(eq=False)
class _Asked:
    """One request, and who waits for its answer until when."""

    arm: bool
    last_s: float = -math.inf
    told: list[tuple[float, Callable[[str], None]]] = field(default_factory=list)


class Arming:
    """A request from its sending to the STM32's answer; safe in threads.

    Answers come in the order of what was sent. Each `told` is called once, with what became of
    its request.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._asked: _Asked | None = None
        self._sent: deque[_Asked] = deque()
        """What is not answered yet, one entry per command on the way, also of earlier requests."""
        self._owed_until_s = self._given_up_s = -math.inf

    def ask(self, arm: bool, told: Callable[[str], None], now_s: float) -> Command:
        """Take on a request; what to send. Raises RefusedError."""
        given_up: list[tuple[float, Callable[[str], None]]] = []
        with self._lock:
            self._expire(now_s)
            asked = self._asked
            if arm and (asked is not None or self._sent):
                raise RefusedError('an earlier request waits for its answer')
            if asked is None or asked.arm:
                given_up = self._end(now_s)
                asked = self._asked = _Asked(arm)
            asked.told.append((now_s + ANSWER_S, told))
            command = self._send(asked, now_s)
        for _, one in given_up:
            one('given up for a request to disarm')
        return command

    def tick(self, now_s: float, *, armed: bool = False) -> Command | None:
        """Give up where no answer has come; what to send again.

        `armed` says what the far end is: where it has armed, its answer alone was lost.
        """
        command, text = None, f'no answer in {ANSWER_S:g} s'
        with self._lock:
            asked = self._asked
            if asked is None:
                return None
            late = [told for until_s, told in asked.told if now_s > until_s]
            asked.told = [one for one in asked.told if now_s <= one[0]]
            if not asked.told:
                self._end(now_s)
                if asked.arm and armed:
                    text = ACCEPTED
                elif asked.arm:
                    self._given_up_s = now_s
            elif not asked.arm and now_s - asked.last_s >= AGAIN_S:
                command = self._send(asked, now_s)
        for told in late:
            told(text)
        return command

    def acknowledged(self, ack: CommandAck, now_s: float) -> None:
        """The STM32 has answered a command."""
        if ack.command != ARM_DISARM:
            return
        told: list[tuple[float, Callable[[str], None]]] = []
        with self._lock:
            self._expire(now_s)
            answered, asked = self._sent.popleft() if self._sent else None, self._asked
            if answered is None or asked is None:
                return
            # an answer to the disarm of before is as good for the one that waits
            if answered is asked or not (answered.arm or asked.arm):
                told = self._end(now_s)
        known = ack.result < len(_RESULTS)
        for _, one in told:
            one(_RESULTS[ack.result] if known else f'result {ack.result}')

    def late(self, now_s: float, *, armed: bool) -> str:
        """What is to be said of an aircraft that armed after it had been given up; once."""
        with self._lock:
            passed_s = now_s - self._given_up_s
            if not armed or passed_s > LATE_S:
                return ''
            self._given_up_s = -math.inf
        return (
            f'armed {passed_s:.0f} s after a request to arm was given up: disarm it if that is '
            'not wanted'
        )

    def end(self, why: str) -> None:
        """Nobody is there to answer any more; who waits is told why."""
        with self._lock:
            told = self._end(-math.inf)
        for _, one in told:
            one(why)

    def _send(self, asked: _Asked, now_s: float) -> Command:
        asked.last_s = now_s
        self._sent.append(asked)
        return Command(ARM_DISARM, (1.0 if asked.arm else 0.0,))

    def _end(self, now_s: float) -> list[tuple[float, Callable[[str], None]]]:
        """End the request that waits; who is to be told."""
        asked, self._asked = self._asked, None
        if asked is None:
            return []
        self._owed_until_s = now_s + ANSWER_S
        return asked.told

    def _expire(self, now_s: float) -> None:
        """Wait no more for answers to requests that ended long ago."""
        if now_s >= self._owed_until_s:
            self._sent = deque(one for one in self._sent if one is self._asked)
