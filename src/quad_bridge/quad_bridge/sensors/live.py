"""Estimates one aircraft's sensor offsets before each flight, stores and applies them.

Cycles and the wish for an estimate come in; the node subtracts `current` from what it publishes
and tells it in `/diagnostics`. Cycles come in the port's thread, all else in the executor's, where
the aircraft's YAML is read and written; a lock of its own guards what both touch.
"""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from quad_bridge.errors import BadInputError, RefusedError
from quad_bridge.sensors import aircraft_file
from quad_bridge.sensors.correction import NOTHING, STATUS, Correction
from quad_bridge.sensors.rest import LEAST_S, RestEstimate, estimate_at_rest
from quad_bridge.status import OK, WARN, Status
from quad_bridge.wire.axes import flip_body
from quad_bridge.wire.frames import Cycle, Flag

STANDING_S = LEAST_S + 1.0  # of cycles without armed motors are kept for an estimate
SAME_START_S = 2.0  # the STM32 has not restarted where the time of its start agrees to this
MOST_TESLA, MOST_RAD_S = 1e-3, 1.0
"""Largest plausible offset of compass and gyro; a larger one is in another unit."""
NOT_YET = 'not estimated since the STM32 started'

Sample = tuple[float, float, float, float, float, float, float]
"""Device time in s, rates in rad/s, accelerations in m/s², FLU."""


class Wanted(NamedTuple):
    """A requested estimate, with the samples at rest at that time."""

    why: str
    samples: tuple[Sample, ...]


class LiveSensors:
    """See the module. Nothing but `estimate` raises."""

    def __init__(self, folder: Path, *, correct: bool) -> None:
        self.current = Correction()
        self.rest: RestEstimate | None = None  # the last estimate since the STM32 has started
        self.words, self.warned = NOT_YET, False
        self.fault = ''  # what is wrong with the aircraft's file
        self._lock = threading.RLock()
        self._standing: deque[Sample] = deque()
        self._folder, self._correct = folder, correct
        self._aircraft = ''
        self._armed = False
        self._wanted: Wanted | None = None
        self._fresh: Correction | None = None  # in force from the next stamp on
        self._started_s = 0.0

    @property
    def path(self) -> Path | None:
        """The aircraft's file; None until the aircraft is known."""
        return self._folder / self._aircraft / aircraft_file.NAME if self._aircraft else None

    @property
    def settled(self) -> bool:
        """Whether the last change has reached a published stamp."""
        return self._fresh is None

    def status(self) -> Status:
        """Which offsets are subtracted, from which stamp on, and what they were estimated from."""
        values: dict[str, object] = dict(self.current.told())
        found = self.rest
        if found is not None:
            values |= {
                'gyro drift (rad/s per s)': ' '.join(f'{v:+.3g}' for v in found.gyro_drift),
                'gyro noise (rad/s RMS)': ' '.join(f'{v:+.3g}' for v in found.gyro_noise),
                'gravity measured off by (m/s²)': f'{found.acceleration_norm_error:+.4f}',
                'level offset roll, pitch (rad)': ' '.join(f'{v:+.5f}' for v in found.level),
                'stood (s)': f'{found.duration_s:.1f}',
            }
        values['kept in'] = self.path or 'nowhere: the aircraft is not known'
        warned = self.fault or self.warned
        return Status(STATUS, WARN if warned else OK, self.fault or self.words, values)

    # In the port's thread.

    def cycle(self, frame: Cycle, clock_s: float) -> None:
        """Take one cycle at this system time; the one that arms requests an estimate."""
        before, self._armed = self._armed, bool(frame.flags & Flag.ARMED)
        time_s = 1e-6 * frame.time_us
        self._started_s = clock_s - time_s
        if self._armed:
            if not before:
                self.want('arming')
                with self._lock:
                    self._standing.clear()
            return
        with self._lock:
            standing = self._standing
            if standing and time_s < standing[-1][0]:
                standing.clear()  # its clock has wrapped or jumped
            standing.append((time_s, *flip_body(frame.gyro), *flip_body(frame.accel)))
            while time_s - standing[0][0] > STANDING_S:
                standing.popleft()

    def stamped(self, stamp_ns: int) -> Correction:
        """Offsets to subtract from the message with this stamp."""
        if self._fresh is not None:
            with self._lock:
                self.current, self._fresh = replace(self._fresh, since_ns=stamp_ns), None
        return self.current

    def restarted(self) -> None:
        """Handle a restart of the STM32, which has removed another bias itself."""
        with self._lock:
            self._standing.clear()
            self.rest, self._armed = None, False
            self.words, self.warned = NOT_YET, False
            self._adopt(gyro_bias=NOTHING)

    # In the executor's.

    def standing(self) -> tuple[Sample, ...]:
        """A copy of what stood last."""
        with self._lock:
            return tuple(self._standing)

    def want(self, why: str) -> None:
        """Have an estimate made of what stands, where anything does."""
        samples = self.standing()
        if samples:
            self._wanted = Wanted(why, samples)

    def wanted(self) -> Wanted | None:
        """What `want` has left, once."""
        taken, self._wanted = self._wanted, None
        return taken

    def estimate(self, wanted: Wanted) -> str:
        """Estimate, keep and apply; what to say. Raises RefusedError; an earlier one stays."""
        rows = np.array(wanted.samples, dtype=float).reshape(-1, 7)
        try:
            if self._armed and not wanted.samples:
                raise RefusedError('it is armed: biases are estimated with the motors off')  # noqa: TRY301
            found = estimate_at_rest(rows[:, 0], rows[:, 1:4], rows[:, 4:])
        except RefusedError as why:
            self.warned = len(rows) > 0 and float(np.ptp(rows[:, 0])) >= LEAST_S
            earlier = '; the earlier one stays' if self.rest is not None else ''
            self.words = f'gyro bias not estimated ({wanted.why}): {why}{earlier}'
            raise RefusedError(self.words) from why
        now = datetime.now(timezone.utc)
        bias = ', '.join(f'{v:+.5f}' for v in found.gyro_bias)
        self.words = f'gyro bias {bias} rad/s at rest, {wanted.why} {now:%H:%M:%S} UTC'
        self.warned, self.rest = False, found
        self._adopt(gyro_bias=found.gyro_bias)
        self._keep(found, wanted.why)
        self._read()
        return self.words

    def aircraft(self, name: str) -> None:
        """Set the aircraft: forget another one's offsets and read its file."""
        if not name or name == self._aircraft:
            return
        if self._aircraft:
            self.restarted()
        self._aircraft = name
        self._read(resume=self.rest is None)
        if self.rest is not None:
            self._keep(self.rest, 'before the aircraft was known')

    # The file.

    def _read(self, *, resume: bool = False) -> None:
        """Take the compass's offset from the file; with `resume` the bias of this power-up too."""
        sections = self._sections()
        try:
            iron = aircraft_file.three(sections, 'compass', 'offset', MOST_TESLA) or NOTHING
            bias = aircraft_file.three(sections, 'rest', 'gyro_bias', MOST_RAD_S)
        except BadInputError as error:
            self.fault = f'{self.path}: {error}'
            return
        self._adopt(hard_iron=iron)
        if resume and bias is not None and self._started_s > 0.0:
            started_s = sections['rest'].get('stm32_started_s')
            if isinstance(started_s, float) and abs(started_s - self._started_s) < SAME_START_S:
                self._adopt(gyro_bias=bias)
                self.words = 'gyro bias as estimated before, the STM32 has not restarted since'

    def _sections(self) -> dict[str, Any]:
        try:
            self.fault = ''
            return aircraft_file.read(self.path) if self.path is not None else {}
        except BadInputError as error:
            self.fault = str(error)
            return {}

    def _keep(self, found: RestEstimate, why: str) -> None:
        before = self._sections().get('rest')
        if self.path is None or self.fault:
            return
        entry = aircraft_file.entry(found, datetime.now(timezone.utc), f'the bridge, {why}')
        entry['stm32_started_s'] = round(self._started_s, 3)
        if isinstance(before, dict) and 'gyro_bias' in before:
            entry['before'] = {k: before[k] for k in ('measured', 'gyro_bias') if k in before}
        try:
            aircraft_file.write(self.path, {'rest': entry})
        except BadInputError as error:
            self.fault = str(error)

    def _adopt(self, **offsets: Any) -> None:
        """Subtract these offsets (`gyro_bias`, `hard_iron`) from the next stamp on."""
        with self._lock:
            now = self._fresh or self.current
            new = replace(now, **offsets)
            if self._correct and new != now:
                self._fresh = new
