"""Reading and writing the STM32's parameters, as state machines over frames. No I/O, no timers.

`poll(now)` says what to send, `take(frame, now)` what came back; times in s on any steady clock.
A write counts only when PARAM_VALUE reads back the same float32; where one of a set cannot be
written, all that were are put back.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from enum import Enum

from quad_bridge.errors import RefusedError
from quad_bridge.wire.frames import ParamRequestList, ParamRequestRead, ParamSet, ParamValue

TIMEOUT_S = 0.25
RETRIES = 3
_FLOAT32_MAX = 3.4028234663852886e38


def float32(value: float) -> float:
    """The value as the wire carries it. `value` must be finite and inside float32's range."""
    return float(struct.unpack('<f', struct.pack('<f', value))[0])


def check_writable(name: str, value: float) -> None:
    """Raise RefusedError where the wire cannot carry the value or the name."""
    if not math.isfinite(value):
        raise RefusedError(f'{name}: must be finite: found {value}')
    if abs(value) > _FLOAT32_MAX:
        raise RefusedError(f'{name}: does not fit a float32: found {value}')
    if not (0 < len(name) <= 16 and name.isascii()):
        raise RefusedError(f'{name}: a wire name has 1 to 16 ASCII characters')


class Phase(Enum):
    """Where a transaction stands."""

    WRITING = 'writing'
    ROLLING_BACK = 'rolling back'
    DONE = 'done'
    FAILED = 'failed'


class ParamTransaction:
    """Writes a set of parameters, all or none.

    `wanted` and `previous` map wire names to values; `previous` is what a rollback restores and
    must hold every wanted name. Raises RefusedError before anything is sent.
    """

    def __init__(
        self,
        wanted: Mapping[str, float],
        previous: Mapping[str, float],
        *,
        timeout_s: float = TIMEOUT_S,
        retries: int = RETRIES,
    ) -> None:
        for name, value in wanted.items():
            check_writable(name, value)
            if name not in previous:
                raise RefusedError(f'{name}: the STM32 has not reported it; nothing to go back to')
        self._previous = {name: previous[name] for name in wanted}
        self._queue = [(name, float32(value)) for name, value in wanted.items()]
        self._timeout_s = timeout_s
        self._retries = retries
        self._attempts = 0
        self._deadline_s = -math.inf
        self._touched: list[str] = []
        self.phase = Phase.WRITING if self._queue else Phase.DONE
        self.reason = ''
        """Why it failed, one line; names what is in doubt where the rollback failed too."""
        self.read_back: dict[str, float] = {}
        """Wire name to the value last reported during the transaction."""

    @property
    def finished(self) -> bool:
        """True when nothing more will be sent."""
        return self.phase in {Phase.DONE, Phase.FAILED}

    def poll(self, now_s: float) -> ParamSet | None:
        """The frame to send now, if any; also notices time-outs."""
        if self.finished or now_s < self._deadline_s:
            return None
        name, value = self._queue[0]
        if self._attempts > self._retries:
            self._give_up(f'{name}: {self._complaint(name, value)}')
            return self.poll(now_s)
        if name not in self._touched:
            self._touched.append(name)
        self._attempts += 1
        self._deadline_s = now_s + self._timeout_s
        return ParamSet(name, value)

    def take(self, frame: ParamValue) -> None:
        """Use a reported value; those of other parameters are ignored."""
        if self.finished or frame.name != self._queue[0][0]:
            return
        name, value = self._queue[0]
        self.read_back[name] = frame.value
        if frame.value != value:
            self._deadline_s = -math.inf
            return
        self._queue.pop(0)
        self._next()
        if not self._queue:
            self.phase = Phase.DONE if self.phase is Phase.WRITING else Phase.FAILED

    def _next(self) -> None:
        self._attempts = 0
        self._deadline_s = -math.inf

    def _complaint(self, name: str, value: float) -> str:
        tries = self._retries + 1
        if name in self.read_back:
            return f'the STM32 kept {self.read_back[name]:g} instead of {value:g}'
        return f'no answer to {tries} writes'

    def _give_up(self, reason: str) -> None:
        if self.phase is Phase.ROLLING_BACK:
            in_doubt = ', '.join(name for name, _ in self._queue)
            self.reason += f'; rollback failed too, in doubt: {in_doubt}'
            self.phase = Phase.FAILED
            return
        self.phase = Phase.ROLLING_BACK
        self.reason = reason
        self.read_back = {}
        self._queue = [(n, float32(self._previous[n])) for n in reversed(self._touched)]
        self._next()


class ParamReader:
    """Reads all parameters: asks for the list, then for each one that did not come.

    `values` maps wire names to what the STM32 reports and is kept up to date by `take`.
    """

    def __init__(self, *, timeout_s: float = 0.5) -> None:
        self._timeout_s = timeout_s
        self._deadline_s = -math.inf
        self._count: int | None = None
        self._seen: set[int] = set()
        self.values: dict[str, float] = {}

    @property
    def complete(self) -> bool:
        """True when every index up to the reported count has come."""
        return self._count is not None and len(self._seen) >= self._count

    def restart(self) -> None:
        """Forget all: the far end may be another one."""
        self._count = None
        self._seen.clear()
        self.values.clear()
        self._deadline_s = -math.inf

    def poll(self, now_s: float) -> ParamRequestList | ParamRequestRead | None:
        """The request to send now, if any; one at a time, repeated after the time-out."""
        if self.complete or now_s < self._deadline_s:
            return None
        self._deadline_s = now_s + self._timeout_s
        if self._count is None:
            return ParamRequestList()
        missing = next(i for i in range(self._count) if i not in self._seen)
        return ParamRequestRead('', missing)

    def take(self, frame: ParamValue, now_s: float) -> None:
        """Use a reported value. An index beyond the count (an unsolicited echo) only sets it."""
        self.values[frame.name] = frame.value
        if frame.index >= frame.count:
            return
        self._count = frame.count
        self._seen.add(frame.index)
        waiting = len(self._seen) < self._count
        self._deadline_s = now_s + (0.1 if waiting and self._timeout_s > 0.1 else 0.0)
