"""The operator's part: the dead-man switch, and a request to arm or to disarm. Pure.

COMMAND_ACK does not say which request it answers: arming is sent once, and nothing is armed while
an answer to an earlier request may still come; disarming passes at any time, and is sent again
until it is answered. Arming that was given up may still lie in a buffer on the way: where
the aircraft arms later, `late` says so; nothing is disarmed without a person, it may fly.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable

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


class _Asked:
    """One request on the wire, and who waits for its answer until when."""

    def __init__(self, arm: bool) -> None:
        self.arm = arm
        self.sent = 0
        self.last_s = -math.inf
        self.told: list[tuple[float, Callable[[str], None]]] = []

    def send(self, now_s: float) -> Command:
        self.sent, self.last_s = self.sent + 1, now_s
        return Command(ARM_DISARM, (1.0 if self.arm else 0.0,))

    def late(self, now_s: float) -> list[Callable[[str], None]]:
        """Those whose time is up; they wait no longer."""
        late = [told for until_s, told in self.told if now_s > until_s]
        self.told = [one for one in self.told if now_s <= one[0]]
        return late


class Arming:
    """A request from its sending to the STM32's answer; safe in threads.

    Each `told` is called once, with what became of its request.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._asked: _Asked | None = None
        self._owed = {True: 0, False: 0}
        """So many answers to arming and to disarming may still come that nobody waits for."""
        self._owed_until_s = self._given_up_s = -math.inf

    def ask(self, arm: bool, told: Callable[[str], None], now_s: float) -> Command:
        """Take on a request; what to send. Raises RefusedError."""
        given_up: list[Callable[[str], None]] = []
        with self._lock:
            asked = self._asked
            if arm and (asked is not None or self._waits_for_owed(now_s)):
                raise RefusedError('an earlier request waits for its answer')
            if asked is not None and asked.arm:
                given_up = [one for _, one in asked.told]
                self._owe(asked, asked.sent, now_s)
                asked = None
            self._asked = asked = asked or _Asked(arm)
            asked.told.append((now_s + ANSWER_S, told))
            command = asked.send(now_s)
        for one in given_up:
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
            late = asked.late(now_s)
            if not asked.told:
                self._asked = None
                self._owe(asked, asked.sent, now_s)
                if asked.arm and armed:
                    text = ACCEPTED
                elif asked.arm:
                    self._given_up_s = now_s
            elif not asked.arm and now_s - asked.last_s >= AGAIN_S:
                command = asked.send(now_s)
        for told in late:
            told(text)
        return command

    def acknowledged(self, ack: CommandAck, now_s: float) -> None:
        """The STM32 has answered a command."""
        if ack.command != ARM_DISARM:
            return
        with self._lock:
            asked = self._asked
            if self._waits_for_owed(now_s):
                arm = self._owed[True] > 0  # arming came before the disarming that ended it
                self._owed[arm] -= 1
                if arm or asked is None or asked.arm:
                    return
                # an answer to the disarm of before is as good for the one that waits
                asked.sent += 1
            if asked is None:
                return
            self._asked = None
            self._owe(asked, asked.sent - 1, now_s)
        known = ack.result < len(_RESULTS)
        for _, told in asked.told:
            told(_RESULTS[ack.result] if known else f'result {ack.result}')

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
            asked, self._asked = self._asked, None
        for _, told in asked.told if asked is not None else ():
            told(why)

    def _waits_for_owed(self, now_s: float) -> bool:
        if now_s >= self._owed_until_s:
            self._owed = {True: 0, False: 0}
        return any(self._owed.values())

    def _owe(self, asked: _Asked, answers: int, now_s: float) -> None:
        self._owed[asked.arm] += answers
        self._owed_until_s = now_s + ANSWER_S
