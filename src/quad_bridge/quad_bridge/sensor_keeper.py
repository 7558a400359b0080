"""Estimates one aircraft's sensors before each flight, keeps them, says what to subtract.

Pure but for the aircraft's YAML. Cycles and the wish for an estimate come in; the node subtracts
`current` from what it publishes and tells it in `/diagnostics`. Not thread-safe: the node holds a
lock.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from quad_bridge.errors import BadInputError, RefusedError
from quad_bridge.sensors import aircraft_file
from quad_bridge.sensors.correction import NOTHING, Correction, Triple
from quad_bridge.sensors.rest import LEAST_S, RestEstimate
from quad_bridge.sensors.window import Sample, SensorWindow, at_rest
from quad_bridge.wire.axes import flip_body
from quad_bridge.wire.frames import Cycle, Flag

SAME_START_S = 2.0
"""The STM32 has not restarted where the time of its start agrees to this."""

MOST_TESLA, MOST_RAD_S = 1e-3, 1.0
"""No compass is off by more, nor a gyro at rest: a figure beyond is in another unit."""


@dataclass(frozen=True)
class Wanted:
    """An estimate to be made, of what stood when it was asked for."""

    why: str
    samples: tuple[Sample, ...]


class SensorKeeper:
    """See the module. Nothing but `estimate` raises."""

    def __init__(self, folder: Path, *, correct: bool) -> None:
        self.current = Correction()
        self.rest: RestEstimate | None = None
        """The last estimate since the STM32 has started."""
        self.words, self.warned = 'not estimated since the STM32 started', False
        self.fault = ''
        """What is wrong with the aircraft's file."""
        self.window = SensorWindow()
        self._folder, self._correct = folder, correct
        self._aircraft = ''
        self._armed = False
        self._wanted: Wanted | None = None
        self._fresh: Correction | None = None
        self._started_s = 0.0

    @property
    def path(self) -> Path | None:
        """The aircraft's file; None as long as it is not known whose."""
        return self._folder / self._aircraft / aircraft_file.NAME if self._aircraft else None

    @property
    def settled(self) -> bool:
        """Whether the last change has reached a published stamp."""
        return self._fresh is None

    # Every cycle.

    def cycle(self, frame: Cycle, clock_s: float) -> None:
        """Take one cycle at this system time; the one that arms wants an estimate."""
        armed = bool(frame.flags & Flag.ARMED)
        if armed and not self._armed:
            self.want('arming')
        self._armed = armed
        self._started_s = clock_s - 1e-6 * frame.time_us
        sample = (1e-6 * frame.time_us, *flip_body(frame.gyro), *flip_body(frame.accel))
        self.window.add(sample, standing=not armed)

    def stamped(self, stamp_ns: int) -> Correction:
        """What to subtract from the message that gets this stamp."""
        if self._fresh is not None:
            self.current, self._fresh = replace(self._fresh, since_ns=stamp_ns), None
        return self.current

    def restarted(self) -> None:
        """The STM32 has started anew: it has removed another bias of its own."""
        self.window.clear()
        self.rest = None
        self.words, self.warned = 'not estimated since the STM32 started', False
        self._armed = False
        self._adopt(gyro_bias=NOTHING)

    # When asked.

    def want(self, why: str) -> None:
        """Have an estimate made of what stands, where anything does."""
        samples = self.window.standing()
        if samples:
            self._wanted = Wanted(why, samples)

    def wanted(self) -> Wanted | None:
        """What `want` has left, once."""
        taken, self._wanted = self._wanted, None
        return taken

    def estimate(self, wanted: Wanted) -> RestEstimate:
        """The estimate, which takes milliseconds; raises RefusedError."""
        if self._armed and not wanted.samples:
            raise RefusedError('it is armed: biases are estimated with the motors off')
        return at_rest(wanted.samples)

    def refused(self, wanted: Wanted, why: str) -> str:
        """Note that there is no estimate; what to say. An earlier one stays in force."""
        held = wanted.samples[-1][0] - wanted.samples[0][0] if wanted.samples else 0.0
        self.warned = held >= LEAST_S
        earlier = '; the earlier one stays' if self.rest is not None else ''
        self.words = f'gyro bias not estimated ({wanted.why}): {why}{earlier}'
        return self.words

    def take(self, wanted: Wanted, found: RestEstimate) -> str:
        """Keep and apply an estimate; what to say."""
        now = datetime.now(timezone.utc)
        bias = ', '.join(f'{v:+.5f}' for v in found.gyro_bias)
        self.words = f'gyro bias {bias} rad/s at rest, {wanted.why} {now:%H:%M:%S} UTC'
        self.warned, self.rest = False, found
        self._adopt(gyro_bias=found.gyro_bias)
        self._keep(found, now, wanted.why)
        self._read()
        return self.words

    def aircraft(self, name: str) -> None:
        """Whose sensors these are; another aircraft's are forgotten, its own file is read."""
        if not name or name == self._aircraft:
            return
        if self._aircraft:
            self.restarted()
        self._aircraft = name
        self._read(resume=self.rest is None)
        if self.rest is not None:
            self._keep(self.rest, datetime.now(timezone.utc), 'before the aircraft was known')

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
        if resume and bias is not None and self._same_start(sections['rest']):
            self._adopt(gyro_bias=bias)
            self.words = 'gyro bias as estimated before, the STM32 has not restarted since'

    def _same_start(self, rest: dict[str, Any]) -> bool:
        started = rest.get('stm32_started_s')
        known = isinstance(started, float) and self._started_s > 0.0
        return known and abs(float(started or 0.0) - self._started_s) < SAME_START_S

    def _sections(self) -> dict[str, Any]:
        if self.path is None:
            return {}
        try:
            self.fault, found = '', aircraft_file.read(self.path)
        except BadInputError as error:
            self.fault, found = str(error), {}
        return found

    def _keep(self, found: RestEstimate, now: datetime, why: str) -> None:
        if self.path is None:
            return
        before = self._sections().get('rest')
        entry = aircraft_file.entry(found, now, f'the bridge, {why}')
        entry['stm32_started_s'] = round(self._started_s, 3)
        if isinstance(before, dict) and 'gyro_bias' in before:
            entry['before'] = {k: before[k] for k in ('measured', 'gyro_bias') if k in before}
        try:
            if not self.fault:
                aircraft_file.write(self.path, {'rest': entry})
        except BadInputError as error:
            self.fault = str(error)

    def _adopt(self, *, gyro_bias: Triple | None = None, hard_iron: Triple | None = None) -> None:
        now = self._fresh or self.current
        new = Correction(
            now.gyro_bias if gyro_bias is None else gyro_bias,
            now.hard_iron if hard_iron is None else hard_iron,
            now.since_ns,
        )
        if self._correct and new != now:
            self._fresh = new
