"""From /excitation/setpoint and /excitation/segment to the aircraft's excitation. Pure.

The segment says where to inject; without a running segment nothing is forwarded. Where the
operator's enable is required and lost, the excitation ends, until the next segment begins.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from quad_bridge.aircraft import INJECTIONS, Ability, Aircraft, Quad
from quad_bridge.arming import OperatorEnable
from quad_bridge.fresh import stale
from quad_bridge.status import OK, WARN, Status
from quad_bridge.wire.frames import Cycle, Flag, Frame, Injection
from quad_bridge.wire.plausible import LARGEST


class ExcitationRelay:
    """Hands on the set-points of the running segment."""

    def __init__(
        self, valid_ms: int, enable: OperatorEnable | None = None,
        aircraft: Callable[[], Aircraft] | None = None,
    ) -> None:
        self._valid_ms = valid_ms
        quad = Quad()
        self._aircraft = aircraft or (lambda: quad)
        self._enable = enable or OperatorEnable(required=False)
        self._lost, self._ended_s = False, -math.inf  # by the stamp of what ended the last segment
        self.injection = Injection.NONE  # of the running segment
        self.forwarded = 0
        self.dropped = 0
        self.reason = ''  # why the last dropped set-point was dropped; empty after a good one

    def status(self, last: Cycle | None, now_s: float) -> Status:
        """The forwarded excitation, and its use by the STM32 in the last cycle."""
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
            why = self._aircraft().cannot(Ability.EXCITE)
            level, text = WARN, why or 'the STM32 refuses the excitation' + (
                ' of U1: its firmware may be older than the axis climb'
                if self.injection is Injection.THRUST else '')
        elif disabled:
            text = f'disabled: {disabled}'
        return Status('excitation', level, text, values)

    def segment(
        self, parameters: Mapping[str, Any], age_s: float = 0.0, now_s: float = -math.inf
    ) -> Frame | None:
        """Take a segment's parameters; the frame that ends what was before, None in its midst.

        The STM32 refuses until it hears one, once it has refused. `age_s` by its stamp: one of
        earlier, as from a bag, changes nothing.
        """
        running = parameters.get('segment') != 'idle' and parameters.get('signal') != 'none'
        late = stale(age_s)
        if late:
            if running or self.injection is not Injection.NONE:  # else it changes nothing anyway
                self._drop(f'segment: {late}')
            return None
        injection = INJECTIONS.get(str(parameters.get('injection', '')))
        if parameters.get('axis') == 'climb':  # the third of the values
            injection = Injection.THRUST if injection is Injection.CONTROL else None
        previous, self._lost = self.injection, False
        self.injection = injection if running and injection is not None else Injection.NONE
        self._ended_s = now_s - age_s
        end = self._aircraft().abort() if Injection.NONE in {previous, self.injection} else None
        self._aircraft().segment(parameters if self.injection is not Injection.NONE else None)
        return end

    def tick(self, now_s: float) -> Frame | None:
        """The frame that ends a running excitation where the operator has let go."""
        running = self.injection is not Injection.NONE and not self._lost
        if not running or not self._enable.fault(now_s):
            return None
        self._lost = True
        return self._aircraft().abort()

    def setpoint(
        self, x: float, y: float, z: float, now_s: float = 0.0, age_s: float = 0.0
    ) -> Frame | None:
        """The frame of a set-point (FLU, the segment's unit); None where it must not be sent."""
        aircraft = self._aircraft()
        fault = aircraft.cannot(Ability.EXCITE) or self._enable.fault(now_s) or stale(age_s)
        if self._lost:
            fault = fault or 'the operator has released the enable: start the next segment'
        elif self.injection is Injection.NONE:
            if not fault and now_s - age_s < self._ended_s:
                return None  # it was on its way when its segment ended
            fault = fault or 'no segment is running: publish /excitation/segment first'
        elif not max(abs(x), abs(y), abs(z)) < LARGEST or math.isnan(x + y + z):
            fault = fault or f'set-point must lie within ±{LARGEST:g}: found {x}, {y}, {z}'
        if fault:
            self._drop(fault)
            return None
        self.forwarded += 1
        self.reason = ''
        return aircraft.excite((x, y, z), self.injection, self._valid_ms)

    def _drop(self, reason: str) -> None:
        self.dropped += 1
        self.reason = reason
