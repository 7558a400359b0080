"""Settings of the `excitation` node, and the coverage that ends a training segment early.

Parameters with ranges and units; the band that a segment covers, from raw messages, with
quad_bridge.monitor's coherence, as the operator's `monitor` shows it. No ROS: the node declares
the parameters.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from quad_bridge.monitor.coverage import BAND, Coverage, Pairs, coverage, reachable
from quad_sysid.bags.cdr import IMU, VECTOR, decode
from quad_sysid.contract import AXES
from quad_sysid.errors import BadInputError
from quad_sysid.schedule_file import load_schedule
from quad_sysid.signals.guard import Limits
from quad_sysid.signals.schedule import Part, Schedule

MARGIN = 1.1
"""Factor by which the watched band reaches lower, so that other watchers agree."""
RATES = 5
"""Column of the first rate of a decoded Imu."""


@dataclass(frozen=True)
class Wanted:
    """What a training segment must cover before it may end early."""

    band_rad_s: tuple[float, float]
    least_s: float
    """Least duration of the segment, s."""


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
        """Begin another segment, or none."""
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
        """Why the segment may end now; empty if it may not."""
        if self._axis is None:
            return ''
        rates, inputs = decode(IMU, self._rates), decode(VECTOR, self._inputs)
        self._rates, self._inputs = [], []
        for stamp, row in zip(rates.stamps.tolist(), rates.values.tolist(), strict=True):
            self._pairs.rate(stamp, row[RATES + self._axis])
        for stamp, row in zip(inputs.stamps.tolist(), inputs.values.tolist(), strict=True):
            self._pairs.excitation(stamp, row[self._axis])
        parts, dt = self._pairs.parts()
        flown_s = dt * sum(x.size for x, _ in parts)
        if not parts:
            return ''
        low, high = reachable(self.wanted.band_rad_s, self._segment_s)
        self.found = coverage(parts, dt, (low / MARGIN, high))
        if flown_s < self.wanted.least_s or not self.found.enough:
            return ''
        return f'{low:.2g} to {high:g} rad/s covered after {flown_s:.0f} s'


FIRST_AUX = 4

NUMBERS = {
    'angle_limit_deg': (25.0, 1.0, 60.0, 'angle at which the excitation ends, degrees'),
    'imu_stale_s': (0.2, 0.02, 2.0, 'age of /imu/data at which it ends, s'),
    'rc_stale_s': (1.0, 0.1, 10.0, 'age of /rc/in at which it ends, once heard, s'),
    'battery_min_v': (0.0, 0.0, 100.0, 'pack voltage below which it ends, V; 0: not checked'),
    'stick_dead_band': (0.1, 0.0, 1.0, 'rig: stick deflection that ends it, 0..1'),
    'hover_deflection': (0.6, 0.0, 1.0, 'hover: stick deflection that ends it, 0..1'),
    'abort_threshold': (0.5, -1.0, 1.0, 'value of the abort switch that ends it, -1..1'),
    'ramp_out_s': (0.5, 0.0, 5.0, 'time to take the excitation back after an abort, s'),
    'amplitude_scale': (1.0, 0.05, 1.0, 'factor on all amplitudes of the schedule'),
    'band_low_rad_s': (BAND[0], 0.01, 100.0, 'end_when_covered: low end of the band, rad/s'),
    'band_high_rad_s': (BAND[1], 0.1, 1000.0, 'end_when_covered: its high end, rad/s'),
    'least_train_s': (20.0, 5.0, 600.0, 'end_when_covered: training that is flown anyway, s'),
}
"""Name → default, lowest, highest, description."""


@dataclass(frozen=True)
class Settings:
    """Settings of the node."""

    schedule: Schedule
    limits: Limits
    ramp_out_s: float
    rate_hz: int
    abort_axis: int | None
    """Index into the axes of /rc/in; None: no switch."""
    autostart: bool
    exit_when_done: bool
    wanted: Wanted | None = None
    """Coverage that ends a training segment early; None: none."""


def settings_from(
    schedule: Path, numbers: Mapping[str, float], aux: int, rate_hz: int,
    *, autostart: bool, exit_when_done: bool, end_when_covered: bool = False,
) -> Settings:
    """Settings from the parameters; raises BadInputError for a wrong schedule."""
    loaded = load_schedule(schedule).scaled(numbers['amplitude_scale'])
    limits = Limits(
        mount=loaded.mount, angle_rad=math.radians(numbers['angle_limit_deg']),
        imu_stale_s=numbers['imu_stale_s'], rc_stale_s=numbers['rc_stale_s'],
        battery_min_v=numbers['battery_min_v'], stick_dead_band=numbers['stick_dead_band'],
        hover_deflection=numbers['hover_deflection'],
        abort_threshold=numbers['abort_threshold'],
    )
    band = numbers['band_low_rad_s'], numbers['band_high_rad_s']
    if not band[0] < band[1]:
        raise BadInputError(
            'parameter band_low_rad_s', f'is not below band_high_rad_s {band[1]:g}', band[0],
            'lower it',
        )
    return Settings(
        loaded, limits, numbers['ramp_out_s'], rate_hz, FIRST_AUX + aux - 1 if aux else None,
        autostart, exit_when_done,
        Wanted(band, numbers['least_train_s']) if end_when_covered else None,
    )


def find_schedule(name: str, share: Callable[[], Path]) -> Path:
    """Path of a schedule: as given, or shipped under that name in the share directory."""
    given = Path(name).expanduser()
    if given.suffix or given.exists():
        return given
    try:
        folder = share() / 'config'
    except KeyError as error:
        raise BadInputError(
            'parameter schedule', 'names no file and the package is not installed', repr(name),
            'give the path of a YAML file',
        ) from error
    shipped = folder / f'{name}.yaml'
    if not shipped.exists():
        known = ', '.join(sorted(p.stem for p in folder.glob('schedule_*.yaml')))
        raise BadInputError(
            'parameter schedule', 'is neither a file nor a shipped schedule', repr(name),
            f'shipped are {known}',
        )
    return shipped
