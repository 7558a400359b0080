"""One motor that spins on the ground, for who looks which one it is and how it turns. Pure.

MAV_CMD_DO_MOTOR_TEST, repeated while the operator holds the enable and the time lasts: the
firmware stops the motor half a second after the last request, and refuses all where it is armed,
was in motion in the last two seconds, or does not hear its pilot's switches.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping

from quad_bridge.aircraft import ACCEPTED, outcome_of
from quad_bridge.arming import OperatorEnable
from quad_bridge.errors import RefusedError
from quad_bridge.wire.frames import Command, CommandAck

COMMAND = 209  # MAV_CMD_DO_MOTOR_TEST
MOTORS = 4
MAX_THROTTLE, MAX_S = 0.25, 5.0  # the throttle: QUAD_TEST_THROTTLE of the firmware
USUAL_THROTTLE, USUAL_S = 0.08, 2.0  # turns a propeller, lifts nothing
VALID_S, AGAIN_S = 0.4, 0.15  # one lost request is bridged, a dead line stops the motor
ANSWER_S = 1.0  # without an answer


def frame(motor: int, throttle: float, valid_s: float = VALID_S) -> Command:
    """Give the request; throttle 0 stops the motor."""
    return Command(COMMAND, (float(motor), 0.0, 100.0 * throttle, valid_s, 1.0))


def read(values: Mapping[str, object]) -> tuple[int, float, float]:
    """Motor, throttle and seconds of a request. Raises RefusedError for a meaningless one."""
    request = {'throttle': USUAL_THROTTLE, 'duration_s': USUAL_S, **values}
    unknown = sorted(request.keys() - {'motor', 'throttle', 'duration_s'})
    if unknown:
        raise RefusedError(f'{unknown[0]} is not known; known are motor, throttle, duration_s')
    motor = request.get('motor')
    if isinstance(motor, bool) or not isinstance(motor, int) or not 1 <= motor <= MOTORS:
        raise RefusedError(f'motor: must be a whole number of 1 to {MOTORS}: found {motor!r}')
    numbers = []
    for name, most in (('throttle', MAX_THROTTLE), ('duration_s', MAX_S)):
        value = request[name]
        number = float(value) if isinstance(value, int | float) else math.nan
        if isinstance(value, bool) or not 0.0 < number <= most:
            raise RefusedError(f'{name}: must lie above 0 and up to {most:g}: found {value!r}')
        numbers.append(number)
    return motor, numbers[0], numbers[1]


class MotorTest:
    """One test at a time, safe in threads; `reply` is called once with the outcome.

    Times are s on a steady clock.
    """

    def __init__(self, enable: OperatorEnable) -> None:
        self._enable, self._lock = enable, threading.Lock()
        self._reply: Callable[[bool, str], None] | None = None
        self._motor, self._throttle = 0, 0.0
        self._start_s = self._until_s = self._sent_s = -math.inf
        self._acknowledged = False

    @property
    def running(self) -> bool:
        """Whether a motor spins, or is asked to."""
        return self._reply is not None

    def ask(
        self, values: Mapping[str, object], reply: Callable[[bool, str], None], now_s: float,
        *, armed: bool | None,
    ) -> Command:  # fmt: skip
        """Begin; the frame to send. Raises RefusedError."""
        motor, throttle, duration_s = read(values)
        if self.running:
            raise RefusedError('a motor is being tested already')
        if armed is None:
            raise RefusedError('nothing is received from the aircraft, so it may be armed')
        if armed:
            raise RefusedError('it is armed: disarm it; motors are tested on the ground')
        if not self._enable.is_held(now_s):
            raise RefusedError('hold /operator/enable: the motor stops when you release it')
        self._reply, self._motor, self._throttle = reply, motor, throttle
        self._start_s, self._until_s, self._acknowledged = now_s, now_s + duration_s, False
        return self._send(now_s)

    def tick(self, now_s: float) -> Command | None:
        """Give the frame to send now: the request again, or that which stops the motor."""
        if not self.running:
            return None
        if not self._enable.is_held(now_s):
            return self.end('/operator/enable was let go')
        if not self._acknowledged and now_s - self._start_s > ANSWER_S:
            return self.end(f'no answer in {ANSWER_S:g} s')
        if now_s >= self._until_s:
            words = f'motor {self._motor} spun at {100.0 * self._throttle:.0f} %'
            return self.end(words, is_success=self._acknowledged)
        return self._send(now_s) if now_s - self._sent_s >= AGAIN_S else None

    def acknowledged(self, ack: CommandAck) -> None:
        """Take the aircraft's answer."""
        if not self.running or ack.command != COMMAND:
            return
        words = outcome_of(ack.result)
        self._acknowledged = self._acknowledged or words == ACCEPTED
        if words != ACCEPTED:
            why = ('it must be disarmed, level and at rest for 2 s, with a receiver that works, '
                   'throttle down, kill switch off, and a set-up without fault')  # fmt: skip
            self.end(f'the aircraft says {words}' + (f': {why}' if words == 'not now' else ''))

    def end(self, words: str, *, is_success: bool = False) -> Command | None:
        """Stop; the frame that does, which need not arrive."""
        with self._lock:
            reply, self._reply = self._reply, None
        if reply is not None:
            reply(is_success, words)
        return frame(self._motor, 0.0) if reply is not None else None

    def _send(self, now_s: float) -> Command:
        self._sent_s = now_s
        return frame(self._motor, self._throttle)
