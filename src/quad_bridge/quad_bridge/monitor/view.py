"""The dashboard: what is known → lines of text for a terminal. Pure; values only."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from quad_bridge.monitor.coverage import Coverage, needed_s, reachable

WIDTH = 79
BAR = 26
STALE_S = 3.0
"""Without news for this long a line says so."""
NEAR_LIMIT = 0.8
"""Share of the angle limit from which the line warns."""
LEVELS = ('ok', 'WARN', 'ERROR', 'stale')


@dataclass(frozen=True)
class Entry:
    """One status of /diagnostics."""

    level: int
    message: str
    values: Mapping[str, str] = field(default_factory=dict)
    at_s: float = 0.0


@dataclass
class State:
    """What was heard last; times in s of one monotonic clock."""

    entries: dict[str, Entry] = field(default_factory=dict)
    """By status name, such as `serial_bridge: link`."""
    rate_hz: float = 0.0
    imu_at_s: float = -math.inf
    angles_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    battery_v: float = math.nan
    bag: str = ''
    bag_state: str = ''
    segment: Mapping[str, str] = field(default_factory=dict)
    trained_s: float = 0.0
    validated_s: float = 0.0
    asked: tuple[float, float] | None = None
    """Band that the operator wants, rad/s; the segments may be too short for its low end."""
    coverage: Coverage | None = None
    done: set[str] = field(default_factory=set)
    """Axes that need no more, the running one not among them."""


def lines(state: State, now_s: float) -> list[str]:
    """One screen."""
    out = [
        _status(state, 'link', 'link', now_s), _imu(state, now_s),
        _status(state, 'clock', 'clock', now_s), _recording(state, now_s),
        _status(state, 'excitation', 'schedule', now_s), *_refusal(state), *_progress(state),
        _angles(state), _battery(state), _status(state, 'gains', 'gains', now_s),
    ]
    out += _coverage(state)
    return [line[:WIDTH] for line in out]


def wanted(state: State, asked: tuple[float, float]) -> tuple[float, float]:
    """Of the band that is asked for what the schedule's training segments can tell."""
    return reachable(asked, _value(state, 'schedule', 'train_s'))


def covered(state: State) -> bool:
    """Whether the running axis is covered; what was told aloud is not taken back."""
    return state.coverage is not None and state.coverage.enough


def suffices(state: State, validation_s: float) -> bool:
    """Whether the running axis is covered and validated."""
    return covered(state) and state.validated_s >= validation_s


def call(state: State, validation_s: float) -> str:
    """What the operator is told aloud, empty where nothing is to be said."""
    if state.coverage is None or not covered(state):
        return ''
    low, high = state.coverage.wanted
    band = f'{low:.2g} to {high:g} rad/s covered'
    axis = state.segment.get('axis', '')
    if not suffices(state, validation_s):
        return f'training suffices: {band}; go on to validation'
    left = [a for a in _axes(state) if a not in state.done and a != axis]
    if left:
        return f'{axis} suffices: {band}; {", ".join(left)} to come'
    return f'stop now: {band}'


def _axes(state: State) -> list[str]:
    """Axes that the running schedule trains, as far as the excitation tells."""
    entry = _entry(state, 'schedule')
    return entry.values.get('axes', '').split() if entry is not None else []


def _entry(state: State, end: str) -> Entry | None:
    """The status whose name ends in `: end`."""
    return next((e for n, e in state.entries.items() if n.endswith(f': {end}')), None)


def _value(state: State, end: str, key: str) -> float:
    """A number that a status carries, NaN where it does not."""
    entry = _entry(state, end)
    try:
        return float(entry.values[key]) if entry is not None else math.nan
    except (KeyError, ValueError):
        return math.nan


def _status(state: State, label: str, end: str, now_s: float) -> str:
    entry = _entry(state, end)
    if entry is None:
        return _line(label, '-', 'nothing heard')
    if now_s - entry.at_s > STALE_S:
        return _line(label, 'stale', f'no news for {now_s - entry.at_s:.0f} s: {entry.message}')
    return _line(label, LEVELS[min(entry.level, 3)], entry.message)


def _line(label: str, level: str, text: str) -> str:
    return f'{label:<11} {level:<6} {text}'


def _imu(state: State, now_s: float) -> str:
    age = now_s - state.imu_at_s
    if not math.isfinite(age):
        return _line('imu', '-', 'no /imu/data yet')
    if age > 0.5:
        return _line('imu', 'ERROR', f'silent for {age:.1f} s')
    return _line('imu', 'ok', f'{state.rate_hz:.0f} Hz')


def _recording(state: State, now_s: float) -> str:
    entry = _entry(state, 'recording')
    if entry is not None and now_s - entry.at_s <= STALE_S and entry.level:
        return _line('recording', LEVELS[min(entry.level, 3)], entry.message)
    if not state.bag_state:
        return _line('recording', '-', 'nothing recorded')
    level = {'recording': 'ok', 'complete': 'ok', 'failed': 'ERROR'}.get(state.bag_state, '-')
    return _line('recording', level, f'{state.bag_state} {state.bag}')


def _refusal(state: State) -> list[str]:
    """What the bridge has against the excitation."""
    entry = _entry(state, 'excitation')
    if entry is None or entry.level == 0:
        return []
    return [_line('', LEVELS[min(entry.level, 3)], entry.message)]


def _progress(state: State) -> list[str]:
    entry, percent = _entry(state, 'schedule'), _value(state, 'schedule', 'progress_pct')
    if entry is None or math.isnan(percent):
        return []
    share = min(max(percent / 100.0, 0.0), 1.0)
    text = ' '.join(entry.values.get(k, '') for k in ('segment', 'signal', 'axis')).strip()
    return [f'{"":<18} {bar(share)} {100.0 * share:3.0f} % {text}']


def bar(share: float) -> str:
    """A bar such as `[####......]`."""
    full = round(BAR * share)
    return f'[{"#" * full}{"." * (BAR - full)}]'


def _angles(state: State) -> str:
    if not math.isfinite(state.imu_at_s):
        return _line('angles', '-', 'not measured')
    roll, pitch, yaw = state.angles_deg
    largest = max(abs(roll), abs(pitch))
    limit = _value(state, 'schedule', 'angle_limit_deg')
    level = 'WARN' if largest > NEAR_LIMIT * limit else 'ok'
    told = '' if math.isnan(limit) else f', limit {limit:g}'
    return _line('angles', level,
                 f'roll {roll:+6.1f}  pitch {pitch:+6.1f}  yaw {yaw:+7.1f} deg{told}')


def _battery(state: State) -> str:
    if not math.isfinite(state.battery_v):
        return _line('battery', '-', 'not measured')
    least = _value(state, 'schedule', 'battery_min_v')
    if least > 0.0:
        level = 'ERROR' if state.battery_v < least else 'ok'
        return _line('battery', level, f'{state.battery_v:.2f} V, excitation ends at {least:g} V')
    return _line('battery', 'ok', f'{state.battery_v:.2f} V')


def _coverage(state: State) -> list[str]:
    flown = f'{state.trained_s:.0f} s trained, {state.validated_s:.0f} s validated'
    axis = state.segment.get('axis', '')
    if state.coverage is None:
        little = f'{axis} too little yet to say'.strip()
        return [_line('coverage', '-', little), _line('', '', flown)]
    low, high = state.coverage.wanted
    if state.asked is not None and low > state.asked[0]:
        flown += f'; {state.asked[0]:g} rad/s needs {needed_s(state.asked[0]):.0f} s'
    band = state.coverage.band
    told = f'{band[0]:.2g} to {band[1]:.3g}' if band else 'nothing'
    return [
        _line('coverage', 'ok' if state.coverage.enough else '...',
              f'{axis} {told} of {low:.2g} to {high:g} rad/s'),
        f'{"":<18} {bar(state.coverage.share)} {100.0 * state.coverage.share:3.0f} %',
        _line('', '', flown),
    ]
