"""The dashboard: the latest values as lines of text for a terminal. Pure."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import PurePath
from typing import NamedTuple

from quad_bridge.monitor.coverage import Coverage, needed_s, reachable

WIDTH, BAR = 79, 26
STALE_S = 3.0  # without news for this long a line says so
NEAR_LIMIT = 0.8  # share of the angle limit from which the line warns
LEVELS = ('ok', 'WARN', 'ERROR', 'stale')


class Entry(NamedTuple):
    """One status entry of /diagnostics, and when it arrived."""

    level: int
    message: str
    values: Mapping[str, str] = {}  # never written
    at_s: float = 0.0

    @property
    def word(self) -> str:
        """The level as the screen shows it."""
        return LEVELS[min(self.level, 3)]


@dataclass
class State:
    """The latest values; times in s of one monotonic clock."""

    entries: dict[str, Entry] = field(default_factory=dict)  # `serial_bridge: link` and others
    rate_hz: float = 0.0
    imu_at_s: float = -math.inf
    angles_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """NaN where they are not measured."""
    battery_v: float = math.nan
    battery_at_s: float = math.inf
    bag: str = ''
    bag_state: str = ''
    bag_at_s: float = -math.inf
    """When the logger last said what it does."""
    segment: Mapping[str, str] = field(default_factory=dict)
    trained_s: float = 0.0
    validated_s: float = 0.0
    target_band: tuple[float, float] | None = None
    """Band that the operator wants, rad/s; the segments may be too short for its low end."""
    coverage: Coverage | None = None
    done: set[str] = field(default_factory=set)
    """Axes whose data suffice, without the running one."""

    def lines(self, now_s: float) -> list[str]:
        """One screen."""
        out = [
            self._status('link', 'link', now_s), self._imu(now_s),
            self._status('clock', 'clock', now_s), self._recording(now_s),
            self._status('excitation', 'schedule', now_s), *self._progress(), self._angles(now_s),
            self._battery(now_s), self._status('gains', 'gains', now_s), *self._coverage(),
        ]  # fmt: skip
        return [line[:WIDTH] for line in out]

    def reachable_band(self, band: tuple[float, float]) -> tuple[float, float]:
        """The part of the band `band` that the schedule's training segments can cover."""
        return reachable(band, self._value('train_s'))

    @property
    def covered(self) -> bool:
        """Whether the band of the running axis is covered."""
        return self.coverage is not None and self.coverage.enough

    def suffices(self, validation_s: float) -> bool:
        """Whether the running axis is covered and validated."""
        return self.covered and self.validated_s >= validation_s

    def call(self, validation_s: float) -> str:
        """The call to the operator; empty where there is none."""
        if self.coverage is None or not self.covered:
            return ''
        low, high = self.coverage.target
        band, axis = f'{low:.2g} to {high:g} rad/s covered', self.segment.get('axis', '')
        if not self.suffices(validation_s):
            return f'training suffices: {band}; go on to validation'
        schedule = self._entry('schedule')
        axes = schedule.values.get('axes', '').split() if schedule is not None else []
        remaining = [a for a in axes if a not in self.done and a != axis]
        if remaining:
            return f'{axis} suffices: {band}; {", ".join(remaining)} to come'
        return f'stop now: {band}'

    def _entry(self, end: str) -> Entry | None:
        """The status whose name ends in `: end`."""
        return next((e for n, e in self.entries.items() if n.endswith(f': {end}')), None)

    def _value(self, key: str) -> float:
        """A number in the schedule's status; NaN where it has none."""
        entry = self._entry('schedule')
        try:
            return float(entry.values[key]) if entry is not None else math.nan
        except (KeyError, ValueError):
            return math.nan

    def _status(self, label: str, end: str, now_s: float) -> str:
        entry = self._entry(end)
        if entry is None:
            return _line(label, '-', 'nothing received')
        age_s = now_s - entry.at_s
        if age_s > STALE_S:
            return _line(label, 'stale', f'no news for {age_s:.0f} s: {entry.message}')
        return _line(label, entry.word, entry.message)

    def _imu(self, now_s: float) -> str:
        age = now_s - self.imu_at_s
        if not math.isfinite(age):
            return _line('imu', '-', 'no /imu/data yet')
        if age > 0.5:
            return _line('imu', 'ERROR', f'silent for {age:.1f} s')
        return _line('imu', 'ok', f'{self.rate_hz:.0f} Hz')

    def _recording(self, now_s: float) -> str:
        entry, bag = self._entry('recording'), PurePath(self.bag).name  # a line is short
        if entry is not None:
            age_s = now_s - entry.at_s
            if age_s > STALE_S and self.bag_state == 'recording':
                # in slow simulated time every node's report is as late
                others = any(now_s - e.at_s <= STALE_S for e in self.entries.values())
                return _line('recording', 'ERROR' if others else 'stale',
                             f'no news of the logger for {age_s:.0f} s, which recorded {bag}')
            if age_s <= STALE_S and entry.level:
                return _line('recording', entry.word, entry.message)
            if (self.bag_state == 'recording' and entry.at_s > self.bag_at_s
                    and 'path' not in entry.values):
                return _line('recording', 'ERROR', f'nothing is recorded any more: {bag} did '
                             'not end')
        if not self.bag_state:
            return _line('recording', '-', 'nothing recorded')
        level = {'recording': 'ok', 'complete': 'ok', 'failed': 'ERROR'}.get(self.bag_state, '-')
        return _line('recording', level, f'{self.bag_state} {bag}')

    def _progress(self) -> list[str]:
        """Why the bridge refuses the excitation, and the progress of the schedule."""
        refusal, entry = self._entry('excitation'), self._entry('schedule')
        lines = []
        if refusal is not None and refusal.level:
            lines.append(_line('', refusal.word, refusal.message))
        percent = self._value('progress_pct')
        if entry is not None and not math.isnan(percent):
            text = ' '.join(entry.values.get(k, '') for k in ('segment', 'signal', 'axis'))
            lines.append(_bar(min(max(percent / 100.0, 0.0), 1.0), text))
        return lines

    def _angles(self, now_s: float) -> str:
        if not math.isfinite(self.imu_at_s):
            return _line('angles', '-', 'not measured')
        if now_s - self.imu_at_s > STALE_S:
            return _line('angles', 'stale', f'no news for {now_s - self.imu_at_s:.0f} s')
        roll, pitch, yaw = self.angles_deg
        if not math.isfinite(roll + pitch + yaw):
            return _line('angles', '-', 'not measured')
        limit = self._value('angle_limit_deg')
        level = 'WARN' if max(abs(roll), abs(pitch)) > NEAR_LIMIT * limit else 'ok'
        text = f'roll {roll:+6.1f}  pitch {pitch:+6.1f}  yaw {yaw:+7.1f} deg'
        return _line('angles', level, text if math.isnan(limit) else f'{text}, limit {limit:g}')

    def _battery(self, now_s: float) -> str:
        if not math.isfinite(self.battery_v):
            return _line('battery', '-', 'not measured')
        if now_s - self.battery_at_s > STALE_S:
            return _line('battery', 'stale', f'no news for {now_s - self.battery_at_s:.0f} s')
        least, text = self._value('battery_min_v'), f'{self.battery_v:.2f} V'
        if not least > 0.0:
            return _line('battery', '-', f'{text}, not watched (battery_min_v)')
        text += f', excitation ends at {least:g} V'
        return _line('battery', 'ERROR' if self.battery_v < least else 'ok', text)

    def _coverage(self) -> list[str]:
        flown = f'{self.trained_s:.0f} s trained, {self.validated_s:.0f} s validated'
        axis, coverage = self.segment.get('axis', ''), self.coverage
        if coverage is None:
            little = f'{axis} too little yet to say'.strip()
            return [_line('coverage', '-', little), _line('', '', flown)]
        low, high = coverage.target
        if self.target_band is not None and low > self.target_band[0]:
            flown += f'; {self.target_band[0]:g} rad/s needs {needed_s(self.target_band[0]):.0f} s'
        band = f'{coverage.band[0]:.2g} to {coverage.band[1]:.3g}' if coverage.band else 'nothing'
        text = f'{axis} {band} of {low:.2g} to {high:g} rad/s'
        level = 'ok' if coverage.enough else '...'
        return [_line('coverage', level, text), _bar(coverage.share), _line('', '', flown)]


def _line(label: str, level: str, text: str) -> str:
    return f'{label:<11} {level:<6} {text}'


def _bar(share: float, text: str = '') -> str:
    """A bar such as `[####......]  40 %` below the texts."""
    full = round(BAR * share)
    return f'{"":<18} [{"#" * full}{"." * (BAR - full)}] {100.0 * share:3.0f} % {text}'.rstrip()
