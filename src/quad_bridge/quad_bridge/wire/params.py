"""Reading the STM32's parameters, as a state machine over frames. No I/O, no timers.

`poll(now)` says what to send, `take(frame, now)` what came back; times in s on any steady clock.
Writing is gain_transaction.py's.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Sequence

from quad_bridge.errors import RefusedError
from quad_bridge.wire.frames import ParamRequestList, ParamRequestRead, ParamValue

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


def checksum(values: Sequence[float]) -> int:
    """CRC-32 over all parameters in the order of their index, as QUAD_GAINS has it."""
    return zlib.crc32(struct.pack(f'<{len(values)}f', *values))


class ParamReader:
    """Reads all parameters: asks for the list, then for each one that did not come.

    `values` maps wire names to what the STM32 reports and is kept up to date by `take`.
    """

    def __init__(self, *, timeout_s: float = 0.5) -> None:
        self._timeout_s = timeout_s
        self._deadline_s = -math.inf
        self._count: int | None = None
        self._names: dict[int, str] = {}
        self.values: dict[str, float] = {}

    @property
    def complete(self) -> bool:
        """True when every index up to the reported count has come."""
        return self._count is not None and len(self._names) >= self._count

    def ordered(self) -> list[str]:
        """Names in the order of their index; empty before all have come."""
        return [self._names[i] for i in sorted(self._names)] if self.complete else []

    def restart(self) -> None:
        """Forget all: the far end may be another one."""
        self._count = None
        self._names.clear()
        self.values.clear()
        self._deadline_s = -math.inf

    def poll(self, now_s: float) -> ParamRequestList | ParamRequestRead | None:
        """The request to send now, if any; one at a time, repeated after the time-out."""
        if self.complete or now_s < self._deadline_s:
            return None
        self._deadline_s = now_s + self._timeout_s
        if self._count is None:
            return ParamRequestList()
        missing = next(i for i in range(self._count) if i not in self._names)
        return ParamRequestRead('', missing)

    def take(self, frame: ParamValue, now_s: float) -> None:
        """Use a reported value. An index beyond the count (an unsolicited echo) only sets it."""
        self.values[frame.name] = frame.value
        if frame.index >= frame.count:
            return
        self._count = frame.count
        self._names[frame.index] = frame.name
        waiting = len(self._names) < self._count
        self._deadline_s = now_s + (0.1 if waiting and self._timeout_s > 0.1 else 0.0)
