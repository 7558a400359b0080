"""The schedule of a flight: timed parts, one axis each, and the excitation at any time.

Pure: a mapping (from YAML) in, a frozen Schedule out. Unknown keys are errors.
excitation_settings.py reads the file; guard.py ends a flight early.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate, pairwise

from quad_sysid.axes import EVERY
from quad_sysid.contract import AXES
from quad_sysid.errors import BadInputError
from quad_sysid.one_line import shortened
from quad_sysid.record import ROLES
from quad_sysid.signals.waveforms import Silence, Waveform, parameter_names, waveform

MOUNTS = ('rig', 'hover')
MAX_DURATION_S = 3600.0
"""Longest segment, s: an hour."""
RAMP_S = 0.5
"""Default time over which a segment begins and ends, so that it does not jerk."""
AMPLITUDE_DEG = 12.0  # a lively flight that stays well inside the angle limit
DEGREE = math.pi / 180.0

AMPLITUDES: dict[str, tuple[str, float, float, float]] = {
    'attitude': ('amplitude_deg', DEGREE, AMPLITUDE_DEG, 20.0),
    'rate': ('amplitude_deg_s', DEGREE, 30.0, 200.0), 'control': ('amplitude', 1.0, 0.03, 0.2),
}
"""Injection → key of the amplitude, its unit in SI, default and limit (paper: 20° at most)."""

CLIMB = 'climb'
PART_KEYS = ('segment', 'duration_s', 'signal', 'axis', 'injection', 'ramp_s')


@dataclass(frozen=True)
class Part:
    """One segment of the schedule."""

    role: str
    duration_s: float
    signal: str = 'none'
    axis: str = 'roll'
    injection: str = 'attitude'
    amplitude: float = 0.0
    """Amplitude in the unit of the injection: rad, rad/s or normalised command."""
    ramp_s: float = RAMP_S
    """The amplitude grows over this time at the start and falls over it at the end."""
    parameters: Mapping[str, float | int] = field(default_factory=dict)
    waveform: Waveform = field(default_factory=Silence)

    def at(self, time_s: float) -> float:
        """Excitation `time_s` s after the part's start; zero outside it."""
        if not 0.0 <= time_s < self.duration_s:
            return 0.0
        share = 1.0
        if self.ramp_s > 0.0:
            share = min(1.0, time_s / self.ramp_s, (self.duration_s - time_s) / self.ramp_s)
        return share * self.amplitude * self.waveform.at(time_s)

    def announcement(self) -> dict[str, float | int | str]:
        """Parameters of /excitation/segment."""
        names: dict[str, float | int | str] = {'segment': self.role, 'signal': self.signal,
                                               'axis': self.axis, 'injection': self.injection}
        if self.role != 'idle':
            names |= {'amplitude': self.amplitude, 'ramp_s': self.ramp_s, **self.parameters}
        return names


@dataclass(frozen=True)
class Schedule:
    """Parts in order of time."""

    parts: tuple[Part, ...]
    mount: str = 'rig'
    source: str = ''

    @property
    def starts_s(self) -> tuple[float, ...]:
        """Start of each part, s."""
        return (0.0, *accumulate(part.duration_s for part in self.parts[:-1]))

    @property
    def duration_s(self) -> float:
        """Length of the schedule, s."""
        return sum(part.duration_s for part in self.parts)

    @property
    def training_s(self) -> float:
        """Longest training segment of each axis, and of these the shortest, s; 0 without any."""
        longest: dict[str, float] = {}
        for part in self.parts:
            if part.role == 'train':
                longest[part.axis] = max(part.duration_s, longest.get(part.axis, 0.0))
        return min(longest.values(), default=0.0)

    def index(self, time_s: float) -> int | None:
        """Index of the part at `time_s`; None before the start and after the end."""
        if not 0.0 <= time_s < self.duration_s:
            return None
        return sum(1 for start in self.starts_s if start <= time_s) - 1

    def scaled(self, factor: float) -> Schedule:
        """The schedule with all amplitudes times `factor`."""
        parts = tuple(replace(part, amplitude=factor * part.amplitude) for part in self.parts)
        return replace(self, parts=parts)

    def sample(self, time_s: float) -> tuple[float, float, float]:
        """Excitation of roll, pitch, yaw at `time_s`, in the unit of the running part.

        Of the climb it is the third value, as the contract has it.
        """
        out = [0.0, 0.0, 0.0]
        index = self.index(time_s)
        if index is not None:
            part = self.parts[index]
            column = 2 if part.axis == CLIMB else AXES.index(part.axis)
            out[column] = part.at(time_s - self.starts_s[index])
        return out[0], out[1], out[2]


def parse_schedule(content: object, source: str) -> Schedule:
    """Read a schedule from parsed YAML; raises BadInputError naming file, segment and key."""
    top = _mapping(content, source, ('schedule',), 'the file')
    body = _mapping(top.get('schedule'), source, ('mount', 'segments', 'ramp_s'), 'schedule')
    mount = _choice(body, 'mount', 'rig', MOUNTS, source)
    listed = body.get('segments')
    if not isinstance(listed, Sequence) or isinstance(listed, str) or not listed:
        raise BadInputError(source, 'schedule needs a list of segments', repr(listed),
                            'quad-sysid design-excitation --out FILE writes one')
    ramp_s = _number(body, 'ramp_s', RAMP_S, source, 0.0)
    parts = [_part(entry, f'{source}, segment {number}', ramp_s)
             for number, entry in enumerate(listed, 1)]
    for number, (before, part) in enumerate(pairwise(parts), 2):
        same = before.injection == part.injection and (before.axis == CLIMB) == (
            part.axis == CLIMB)
        if 'idle' not in {before.role, part.role} and not same:
            # set-points and announcements are separate: a late one would be read in a wrong unit
            raise BadInputError(f'{source}, segment {number}',
                                f'follows one of injection {before.injection}', part.injection,
                                'put an idle segment between them')
    return Schedule(tuple(parts), mount, source)


def _part(entry: object, where: str, ramp_s: float) -> Part:
    """One segment."""
    if not isinstance(entry, Mapping):
        raise BadInputError(where, 'must be a mapping of keys', repr(entry))
    role = _choice(entry, 'segment', '', ROLES, where)
    signal = str(entry.get('signal', 'none'))
    choice = _choice(entry, 'axis', 'roll', tuple(EVERY), where)
    axis = EVERY[choice].excited_as or choice
    climbs, moves = axis == CLIMB, axis != choice
    injection = _choice(entry, 'injection', 'control' if climbs else 'attitude',
                        ('control',) if climbs else ('attitude',) if moves else tuple(AMPLITUDES),
                        where)
    if (role == 'idle') != (signal == 'none'):
        raise BadInputError(
            where, f'segment {role} with signal {signal}',
            remedy='an idle segment has signal none; train and validation need a signal',
        )
    duration = _number(entry, 'duration_s', math.nan, where, 0.0, MAX_DURATION_S)
    if duration <= 0.0:
        raise BadInputError(where, 'duration_s must be positive', duration)
    if role == 'idle':
        _mapping(entry, where, PART_KEYS, 'an idle segment')
        return Part(role, duration, axis=axis, injection=injection)
    key, unit, default, limit = AMPLITUDES[injection]
    values = {k: v for k, v in entry.items() if k not in PART_KEYS and k != key}
    if any(str(k).startswith('amplitude') for k in values):
        raise BadInputError(where, f'the amplitude of injection {injection} is {key}',
                            ', '.join(map(str, values)))
    if signal == 'chirp':
        values.setdefault('sweep_s', duration)
    shape = waveform(signal, values, where)
    return Part(role, duration, signal, axis, injection,
                amplitude=unit * _number(entry, key, default, where, 0.0, limit),
                ramp_s=_number(entry, 'ramp_s', ramp_s, where, 0.0, duration / 2.0),
                parameters={name: getattr(shape, name) for name in parameter_names(signal)},
                waveform=shape)


def _choice(entry: Mapping[str, object], key: str, default: str, allowed: Sequence[str],
            where: str) -> str:
    """A value that must be one of `allowed`."""
    value = entry.get(key, default)
    if value not in allowed:
        raise BadInputError(where, f'{key} is unknown', repr(value), f'use {", ".join(allowed)}')
    return str(value)


def _mapping(value: object, where: str, keys: Sequence[str], what: str) -> Mapping[str, object]:
    """`value` as a mapping without keys other than `keys`."""
    if not isinstance(value, Mapping):
        raise BadInputError(where, f'{what} must hold {", ".join(keys)}', repr(value))
    unknown = [str(key) for key in value if key not in keys]
    if unknown:
        raise BadInputError(where, f'unknown key {shortened(", ".join(unknown))}',
                            remedy=f'{what} takes {", ".join(keys)}')
    return value


def _number(entry: Mapping[str, object], key: str, default: float, where: str, low: float,
            high: float = math.inf) -> float:
    """A finite number within low..high."""
    value = entry.get(key, default)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        if key not in entry:
            raise BadInputError(where, f'{key} is missing', remedy=f'add {key}: NUMBER')
        raise BadInputError(where, f'{key} must be a number', repr(value))
    if not low <= value <= high:
        raise BadInputError(where, f'{key} must lie in {low:g}..{high:g}', value)
    return float(value)
