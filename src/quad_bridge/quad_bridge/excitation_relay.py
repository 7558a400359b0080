"""From /excitation/setpoint and /excitation/segment to Excitation frames. Pure.

The segment says where to inject; without a running segment nothing is forwarded. Where the
operator's enable is required and lost, the excitation ends, until the next segment begins.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from quad_bridge.arming import OperatorEnable
from quad_bridge.fresh import stale
from quad_bridge.status import OK, WARN, Status
from quad_bridge.wire.axes import flip_body
from quad_bridge.wire.frames import Cycle, Excitation, Flag, Injection, Vector3
from quad_bridge.wire.plausible import LARGEST

INJECTIONS = {'attitude': Injection.ATTITUDE, 'rate': Injection.RATE, 'control': Injection.CONTROL}


class ExcitationRelay:
    """Numbers and addresses the set-points of the running segment."""

    def __init__(self, valid_ms: int, enable: OperatorEnable | None = None) -> None:
        self._valid_ms = valid_ms
        self._enable = enable or OperatorEnable(required=False)
        self._lost = False
        self._seq = 0
        self._injection = Injection.NONE
        self.forwarded = 0
        self.dropped = 0
        self.reason = ''  # why the last dropped set-point was dropped; empty after a good one
        self.refusal = ''  # why the aircraft cannot be excited at all

    @property
    def injection(self) -> Injection:
        """Where the running segment injects."""
        return self._injection

    def status(self, last: Cycle | None, now_s: float) -> Status:
        """What is forwarded, and by the last cycle what the STM32 does with it."""
        flags = Flag(last.flags) if last is not None else Flag.NONE
        values = {
            'injection': self.injection.name.lower(),
            'set-points forwarded': self.forwarded,
            'set-points dropped': self.dropped,
            'flags of the STM32': ' '.join(str(f.name).lower() for f in Flag if f and f in flags),
        }
        disabled = self._enable.fault(now_s)
        level, text = OK, 'running' if Flag.EXCITATION in flags else 'idle'
        if self.reason:
            level, text = WARN, f'dropped: {self.reason}'
        elif Flag.STALE_SETPOINT in flags:
            level, text = WARN, 'the STM32 dropped a stale set-point'
        elif Flag.EXCITATION_REFUSED in flags:
            level, text = WARN, 'the STM32 refuses the excitation'
        elif disabled:
            text = f'disabled: {disabled}'
        return Status('excitation', level, text, values)

    def segment(self, parameters: Mapping[str, Any], age_s: float = 0.0) -> Excitation | None:
        """Take a segment's parameters; the frame that ends what was before, None in its midst.

        The STM32 refuses until it hears one, once it has refused. `age_s` by its stamp: one of
        earlier, as from a bag, changes nothing.
        """
        late = stale(age_s)
        if late:
            return self._drop(f'segment: {late}')
        running = parameters.get('segment') != 'idle' and parameters.get('signal') != 'none'
        wanted = INJECTIONS.get(str(parameters.get('injection', '')))
        before, self._lost = self._injection, False
        self._injection = wanted if running and wanted is not None else Injection.NONE
        if Injection.NONE in {before, self._injection}:
            return Excitation((0.0, 0.0, 0.0), int(Injection.NONE), self._next(), self._valid_ms)
        return None

    def tick(self, now_s: float) -> Excitation | None:
        """The frame that ends a running excitation where the operator has let go."""
        running = self._injection is not Injection.NONE and not self._lost
        if not running or not self._enable.fault(now_s):
            return None
        self._lost = True
        return Excitation((0.0, 0.0, 0.0), int(Injection.NONE), self._next(), self._valid_ms)

    def setpoint(
        self, x: float, y: float, z: float, now_s: float = 0.0, age_s: float = 0.0
    ) -> Excitation | None:
        """The frame of a set-point (FLU, the segment's unit); None where it must not be sent."""
        fault = self.refusal or self._enable.fault(now_s) or stale(age_s)
        if fault:
            return self._drop(fault)
        if self._lost:
            return self._drop('the operator has released the enable: start the next segment')
        if self._injection is Injection.NONE:
            return self._drop('no segment is running: publish /excitation/segment first')
        if not max(abs(x), abs(y), abs(z)) < LARGEST or math.isnan(x + y + z):
            return self._drop(f'set-point must lie within ±{LARGEST:g}: found {x}, {y}, {z}')
        self.forwarded += 1
        self.reason = ''
        return self._frame(flip_body((x, y, z)))

    def _frame(self, value: Vector3) -> Excitation:
        return Excitation(value, int(self._injection), self._next(), self._valid_ms)

    def _next(self) -> int:
        self._seq = (self._seq + 1) % 256
        return self._seq

    def _drop(self, reason: str) -> Excitation | None:
        self.dropped += 1
        self.reason = reason
        return None
