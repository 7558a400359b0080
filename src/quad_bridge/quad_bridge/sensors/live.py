"""Estimates the gyro's bias before each flight, from cycles at rest, and says what to subtract.

Cycles and the wish for an estimate come in; the node subtracts `stamped` from what it publishes
and reports it in `/diagnostics`. Cycles come in the port's thread, all else in the executor's; a
lock guards what both touch.
"""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import replace
from datetime import datetime, timezone
from typing import NamedTuple

import numpy as np

from quad_bridge.errors import RefusedError
from quad_bridge.sensors.correction import STATUS, Correction
from quad_bridge.sensors.rest import MIN_S, RestEstimate, estimate_at_rest
from quad_bridge.status import OK, WARN, Status
from quad_bridge.wire.axes import flip_body
from quad_bridge.wire.frames import Cycle, Flag

STANDING_S = MIN_S + 1.0  # duration of disarmed cycles that are kept for an estimate
MAX_SAMPLES = 8000  # most cycles that are kept, at any rate
NOT_YET = 'not estimated since the aircraft started'

Sample = tuple[float, float, float, float, float, float, float]
"""Device time in s, rates in rad/s, accelerations in m/s², FLU."""


class EstimateRequest(NamedTuple):
    """A requested estimate, with the samples at rest at that time."""

    why: str
    samples: tuple[Sample, ...]


class LiveSensors:
    """See the module. Nothing but `estimate` raises."""

    def __init__(self, *, correct: bool) -> None:
        """`correct`: subtract the bias; else it is only estimated."""
        self.current = Correction()
        self.rest: RestEstimate | None = None  # the last estimate since the STM32 has started
        self.words, self.warned = NOT_YET, False
        self._lock = threading.RLock()
        self._standing: deque[Sample] = deque(maxlen=MAX_SAMPLES)
        self._correct = correct
        self._armed = False
        self._request: EstimateRequest | None = None
        self._pending: Correction | None = self.current
        """Applies from the next stamp on; none at first, whatever another bridge subtracted."""

    @property
    def idle(self) -> bool:
        """Whether the last change has reached a published stamp."""
        return self._pending is None

    def status(self) -> Status:
        """Which bias is subtracted, from which stamp on, and what it was estimated from."""
        values: dict[str, object] = dict(self.current.entry())
        estimate = self.rest
        if estimate is not None:
            values |= {
                'gyro drift (rad/s per s)': ' '.join(f'{v:+.3g}' for v in estimate.gyro_drift),
                'gyro noise (rad/s RMS)': ' '.join(f'{v:+.3g}' for v in estimate.gyro_noise),
                'gravity measured off by (m/s²)': f'{estimate.acceleration_norm_error:+.4f}',
                'level offset roll, pitch (rad)': ' '.join(f'{v:+.5f}' for v in estimate.level),
                'stood (s)': f'{estimate.duration_s:.1f}',
            }
        return Status(STATUS, WARN if self.warned else OK, self.words, values)

    # Called in the port's thread.

    def cycle(self, frame: Cycle) -> None:
        """Take one cycle; the one that arms requests an estimate."""
        was_armed, self._armed = self._armed, bool(frame.flags & Flag.ARMED)
        time_s = 1e-6 * frame.time_us
        if self._armed:
            if not was_armed:
                self.want('arming')
                with self._lock:
                    self._standing.clear()
            return
        with self._lock:
            standing = self._standing
            if standing and time_s <= standing[-1][0]:
                standing.clear()  # its clock has wrapped, jumped or stands still
            standing.append((time_s, *flip_body(frame.gyro), *flip_body(frame.accel)))
            while time_s - standing[0][0] > STANDING_S:
                standing.popleft()

    def stamped(self, stamp_ns: int) -> Correction:
        """The bias to subtract from the message with this stamp."""
        if self._pending is not None:
            with self._lock:
                self.current, self._pending = replace(self._pending, since_ns=stamp_ns), None
        return self.current

    def restarted(self) -> None:
        """Handle a restart of the STM32, which has removed another bias itself."""
        with self._lock:
            self._standing.clear()
            self.rest = self._request = None
            self._armed, self.words, self.warned = False, NOT_YET, False
            self._pending = Correction()

    # Called in the executor's thread.

    def standing(self) -> tuple[Sample, ...]:
        """A copy of the latest samples at rest."""
        with self._lock:
            return tuple(self._standing)

    def want(self, why: str) -> None:
        """Have an estimate made of the samples at rest, if there are any."""
        samples = self.standing()
        if samples:
            self._request = EstimateRequest(why, samples)

    def request(self) -> EstimateRequest | None:
        """The request that `want` has left, once."""
        request, self._request = self._request, None
        return request

    def estimate(self, request: EstimateRequest) -> str:
        """Estimate and apply; what to say. Raises RefusedError; an earlier estimate stays."""
        rows = np.array(request.samples, dtype=float).reshape(-1, 7)
        try:
            if self._armed and not request.samples:
                what = 'it is armed: disarm it first; biases are estimated with the motors off'
                raise RefusedError(what)  # noqa: TRY301
            estimate = estimate_at_rest(rows[:, 0], rows[:, 1:4], rows[:, 4:])
        except RefusedError as why:
            self.warned = len(rows) > 0 and float(np.ptp(rows[:, 0])) >= MIN_S
            earlier = '; the earlier one stays' if self.rest is not None else ''
            self.words = f'gyro bias not estimated ({request.why}): {why}{earlier}'
            raise RefusedError(self.words) from why
        bias = ', '.join(f'{v:+.5f}' for v in estimate.gyro_bias)
        now = datetime.now(timezone.utc)
        self.words = f'gyro bias {bias} rad/s at rest, {request.why} {now:%H:%M:%S} UTC'
        self.warned, self.rest = False, estimate
        if self._correct:
            with self._lock:
                self._pending = Correction(estimate.gyro_bias)
        return self.words
