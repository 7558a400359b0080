"""The operator's part: the dead-man switch, and a request to arm or to disarm. Pure.

COMMAND_ACK does not say which request it answers. So arming is sent once, and nothing is armed
while an answer to an earlier request may still come; disarming passes at any time, and is sent
again until it is answered. A request to arm that was given up may still lie in a buffer on the
way: where the aircraft arms later, `late` says so. Nothing is disarmed without a person: it may
fly.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable

from quad_bridge.aircraft import ACCEPTED, outcome_of
from quad_bridge.errors import RefusedError
from quad_bridge.fresh import stale
from quad_bridge.wire.frames import Command, CommandAck, Frame

ARM_DISARM = 400  # MAV_CMD_COMPONENT_ARM_DISARM
ANSWER_S = 1.0  # an answer is waited for so long; a late one may come for as long again
LATE_S = 60.0  # so long a request may have lain on the way
AGAIN_S = 0.2  # interval at which an unanswered disarm is repeated
AGAIN_WITHIN_S = 2.0  # longest time between two calls that disarm in flight
HELD_S = 0.5  # after so long without a message the switch counts as let go


class OperatorEnable:
    """The dead-man switch, /operator/enable: alive or not. Times in s on a steady clock.

    Whoever holds it says so at 5 Hz or faster, with the time of now; half a second after the last
    stamp it counts as let go. What is stamped otherwise, as from a bag, holds nothing. Where it
    is not `required` it counts once somebody has held it: who takes it relies on it.
    """

    def __init__(self, *, required: bool) -> None:
        self.required = required
        self.refused, self.reason = 0, ''  # messages with a stamp of another time, and the last
        self._held_s = self._last_s = -math.inf

    def take(self, age_s: float, now_s: float) -> None:
        """Take a message that was stamped `age_s` ago."""
        self.reason, self._last_s = stale(age_s), now_s
        if self.reason:
            self.refused += 1
            return
        self._held_s = max(self._held_s, now_s - max(age_s, 0.0))
        self.required = True

    def is_held(self, now_s: float) -> bool:
        """Whether somebody holds it, required or not."""
        return now_s - self._held_s <= HELD_S

    def fault(self, now_s: float) -> str:
        """Why excitation and arming are refused now; empty if they are allowed."""
        if not self.required or self.is_held(now_s):
            return ''
        if self.reason and now_s - self._last_s <= HELD_S:  # else nobody says anything any more
            return f'/operator/enable: {self.reason}'
        return f'/operator/enable is silent: publish to it every {HELD_S / 2.5:g} s'


class SecondCall:
    """Disarming in flight lets it fall, so it takes a second call or the pilot's own switch."""

    def __init__(self) -> None:
        self._first_s = -math.inf

    def fault(self, now_s: float, *, flies: bool) -> str:
        """Why a call to disarm does nothing yet; empty where it does."""
        first_s, self._first_s = self._first_s, -math.inf
        if not flies or now_s - first_s <= AGAIN_WITHIN_S:
            return ''
        self._first_s = now_s
        return (
            f'it flies: call again within {AGAIN_WITHIN_S:g} s to let it fall, or use the '
            "pilot's switch"
        )


class _Request:
    """One request, with its caller and deadline."""

    def __init__(self, arm: bool) -> None:
        self.arm, self.last_s = arm, -math.inf
        self.replies: list[tuple[float, Callable[[str], None]]] = []


class Arming:
    """A request from its sending to the STM32's answer; safe in threads.

    Answers come in the order of what was sent. Each `reply` is called once, with what became of
    its request.
    """

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._request: _Request | None = None
        self._sent: deque[_Request] = deque()  # one per command on the way, of earlier ones too
        self._owed_until_s = self._abandoned_s = -math.inf

    def ask(self, arm: bool, reply: Callable[[str], None], now_s: float) -> Frame:
        """Accept a request; returns the frame to send. Raises RefusedError."""
        with self._lock:
            self._expire(now_s)
            request = self._request
            if arm and (request is not None or self._sent):
                raise RefusedError('an earlier request is not answered yet; try again in a moment')
            if request is None or request.arm:
                self._end('given up for a request to disarm', now_s)
                request = self._request = _Request(arm)
            request.replies.append((now_s + ANSWER_S, reply))
            return self._send(request, now_s)

    def tick(self, now_s: float, *, armed: bool = False) -> Frame | None:
        """Give up where no answer has come; what to send again.

        `armed` says what the aircraft is: where it has armed, only its answer was lost.
        """
        with self._lock:
            request, text = self._request, f'no answer in {ANSWER_S:g} s'
            if request is None:
                return None
            late = [reply for until_s, reply in request.replies if now_s > until_s]
            request.replies = [reply for reply in request.replies if now_s <= reply[0]]
            if not request.replies:
                if request.arm and armed:
                    text = ACCEPTED
                elif request.arm:
                    self._abandoned_s = now_s
                self._end(text, now_s)
            for reply in late:
                reply(text)
            is_due = request.replies and not request.arm and now_s - request.last_s >= AGAIN_S
            return self._send(request, now_s) if is_due else None

    def acknowledged(self, ack: CommandAck, now_s: float) -> None:
        """Take the STM32's answer to a command."""
        with self._lock:
            self._expire(now_s)
            if ack.command != ARM_DISARM or not self._sent:
                return
            answered, request = self._sent.popleft(), self._request
            # an answer to the disarm of before is as good for the one that waits
            if request is not None and (answered is request or not (answered.arm or request.arm)):
                self._end(outcome_of(ack.result), now_s)

    def late(self, now_s: float, *, armed: bool) -> str:
        """A warning, once, where the aircraft arms after the request was given up."""
        with self._lock:
            passed_s = now_s - self._abandoned_s
            if not armed or passed_s > LATE_S:
                return ''
            self._abandoned_s = -math.inf
        words = f'armed {passed_s:.0f} s after a request to arm was given up'
        return f'{words}: disarm it if that is not wanted'

    def end(self, why: str) -> None:
        """End all requests with this reason, because no answer can come."""
        with self._lock:
            self._end(why, -math.inf)

    def _send(self, request: _Request, now_s: float) -> Frame:
        request.last_s = now_s
        self._sent.append(request)
        return Command(ARM_DISARM, (1.0 if request.arm else 0.0,))

    def _end(self, text: str, now_s: float) -> None:
        """End the waiting request and answer its caller."""
        request, self._request = self._request, None
        if request is not None:
            self._owed_until_s = now_s + ANSWER_S
            for _, reply in request.replies:
                reply(text)

    def _expire(self, now_s: float) -> None:
        """Wait no more for answers to requests that ended long ago."""
        if now_s >= self._owed_until_s:
            self._sent = deque(request for request in self._sent if request is self._request)
