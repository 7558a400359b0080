"""When a training segment has told enough: the excitation node's watch over the band it covers.

Raw messages in, one sentence out. Coherence is quad_bridge.monitor's, the same as the operator's
`monitor` shows; what ends then is signals/player.py's.
"""

from __future__ import annotations

from dataclasses import dataclass

from quad_bridge.monitor.coverage import Coverage, Pairs, coverage, reachable
from quad_sysid.bags.cdr import IMU, VECTOR, decode
from quad_sysid.contract import AXES
from quad_sysid.signals.schedule import Part

MARGIN = 1.1
"""The band is watched so much further down: others who watch, losing other cycles, agree."""
RATES = 5
"""Column of the first rate of a decoded Imu."""


@dataclass(frozen=True)
class Wanted:
    """What a training segment must cover before it may end early."""

    band_rad_s: tuple[float, float]
    least_s: float
    """It is flown so long at least."""


class CoverageWatch:
    """Coverage of the running training segment; every segment counts by itself."""

    def __init__(self, wanted: Wanted) -> None:
        self.wanted = wanted
        self.found: Coverage | None = None
        self._axis: int | None = None
        self._segment_s = 0.0
        self._pairs = Pairs()
        self._rates: list[bytes] = []
        self._inputs: list[bytes] = []

    def begin(self, part: Part | None) -> None:
        """Another segment, or none, begins."""
        training = part is not None and part.role == 'train'
        self._axis = AXES.index(part.axis) if part is not None and training else None
        self._segment_s = part.duration_s if part is not None else 0.0
        self._pairs.clear()
        self._rates, self._inputs, self.found = [], [], None

    def imu(self, raw: bytes) -> None:
        """Take one /imu/data as CDR."""
        if self._axis is not None:
            self._rates.append(raw)

    def applied(self, raw: bytes) -> None:
        """Take one /excitation/applied as CDR."""
        if self._axis is not None:
            self._inputs.append(raw)

    def look(self) -> str:
        """Why the segment may end now; empty where it may not."""
        if self._axis is None:
            return ''
        rates, inputs = decode(IMU, self._rates), decode(VECTOR, self._inputs)
        self._rates, self._inputs = [], []
        for stamp, row in zip(rates.stamps.tolist(), rates.values.tolist(), strict=True):
            self._pairs.rate(stamp, row[RATES + self._axis])
        for stamp, row in zip(inputs.stamps.tolist(), inputs.values.tolist(), strict=True):
            self._pairs.excitation(stamp, row[self._axis])
        parts, dt = self._pairs.parts()
        flown_s = self._pairs.cycles * dt
        if not parts:
            return ''
        low, high = reachable(self.wanted.band_rad_s, self._segment_s)
        self.found = coverage(parts, dt, (low / MARGIN, high))
        if flown_s < self.wanted.least_s or not self.found.enough:
            return ''
        return f'{low:.2g} to {high:g} rad/s covered after {flown_s:.0f} s'
