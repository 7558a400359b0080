"""The test signals of unit amplitude as functions of time, in one explicit table.

To add a signal is to add one dataclass here, its entry in SIGNALS and its test. No ramps, no
amplitudes, no schedule.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Protocol

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.one_line import shortened

TAPS: dict[int, tuple[int, ...]] = {2: (2, 1), 3: (3, 2), 4: (4, 3), 5: (5, 3), 6: (6, 5),
                                    7: (7, 6), 8: (8, 6, 5, 4), 9: (9, 5), 10: (10, 7),
                                    11: (11, 9), 12: (12, 6, 4, 1), 13: (13, 4, 3, 1),
                                    14: (14, 5, 3, 1), 15: (15, 14)}
"""Stages whose sum is fed back; primitive polynomials over GF(2)."""


def prbs_bits(register_bits: int, seed: int = 1) -> FloatArray:
    """One period (2^n - 1,) of ±1; `seed` selects the register's first state.

    Other seeds only shift the sequence of a register; use another number of bits where two records
    must differ. Raises BadInputError outside 2..15 bits.
    """
    if register_bits not in TAPS:
        raise BadInputError('prbs', 'register_bits must be a whole number from 2 to 15',
                            register_bits)
    length = 2**register_bits - 1
    state = (seed * 2_654_435_761) % length + 1
    taps = [stage - 1 for stage in TAPS[register_bits]]
    out = np.empty(length)
    for i in range(length):
        out[i] = 1.0 if state >> (register_bits - 1) & 1 else -1.0
        feedback = 0
        for tap in taps:
            feedback ^= state >> tap & 1
        state = (state << 1 | feedback) & length
    return out


def prbs(register_bits: int, clock_samples: int, amplitude: float,
         rng: np.random.Generator | int = 1) -> FloatArray:
    """One period ((2^n - 1) * clock_samples,) of ±amplitude, each bit held `clock_samples`.

    `rng` is a generator that draws the first state, or a seed.
    """
    if clock_samples < 1:
        raise BadInputError('prbs', 'clock_samples must be at least 1', clock_samples)
    seed = rng if isinstance(rng, int) else int(rng.integers(1, 2**31))
    return amplitude * np.repeat(prbs_bits(register_bits, seed), clock_samples)


class Waveform(Protocol):
    """A signal of peak 1."""

    def at(self, time_s: float) -> float:
        """Value at `time_s` s from the signal's start, within -1..1."""
        ...


@dataclass(frozen=True)
class Prbs:
    """Pseudo-random binary sequence, repeated after (2^register_bits - 1) * clock_s."""

    clock_s: float
    register_bits: int
    seed: int = 1

    @cached_property
    def _bits(self) -> FloatArray:
        return prbs_bits(self.register_bits, self.seed)

    def at(self, time_s: float) -> float:
        """Bit that the clock holds at `time_s`."""
        return float(self._bits[math.floor(time_s / self.clock_s + 1e-9) % len(self._bits)])


@dataclass(frozen=True)
class Square:
    """Square wave, positive first."""

    period_s: float

    def at(self, time_s: float) -> float:
        """Level at `time_s`."""
        return 1.0 if math.fmod(time_s / self.period_s + 1e-9, 1.0) < 0.5 else -1.0


@dataclass(frozen=True)
class Chirp:
    """Sine whose frequency grows exponentially from f0 to f1 over sweep_s, repeated."""

    f0_hz: float
    f1_hz: float
    sweep_s: float

    def at(self, time_s: float) -> float:
        """Sine at `time_s`."""
        growth = math.log(self.f1_hz / self.f0_hz) / self.sweep_s
        since = math.fmod(time_s, self.sweep_s)
        if abs(growth) < 1e-12:
            return math.sin(2.0 * math.pi * self.f0_hz * since)
        return math.sin(2.0 * math.pi * self.f0_hz * math.expm1(growth * since) / growth)


@dataclass(frozen=True)
class Multisine:
    """Equal cosines at the harmonics of 1 / period_s within f0..f1, in Schroeder's phases.

    Source: Schroeder, IEEE Trans. Inf. Theory 16 (1970): phase -pi k (k - 1) / K of the k-th of K
    lines keeps the crest factor low.
    """

    f0_hz: float
    f1_hz: float
    period_s: float

    @cached_property
    def _lines(self) -> tuple[FloatArray, FloatArray, float]:
        first = max(1, math.ceil(self.f0_hz * self.period_s - 1e-9))
        last = math.floor(self.f1_hz * self.period_s + 1e-9)
        if last < first:
            raise BadInputError(
                'multisine', 'holds no harmonic of 1 / period_s between f0_hz and f1_hz',
                f'{self.f0_hz:g}..{self.f1_hz:g} Hz, {self.period_s:g} s', 'lengthen period_s',
            )
        k = np.arange(1, last - first + 2)
        omega: FloatArray = 2.0 * np.pi / self.period_s * np.arange(first, last + 1.0)
        phase: FloatArray = -np.pi * k * (k - 1) / len(k)
        lines = np.append(np.zeros(first), np.exp(1j * phase))
        peak = 8 * (last + 1) * float(np.abs(np.fft.irfft(lines, 16 * (last + 1))).max())
        return omega, phase, peak * 1.01

    def at(self, time_s: float) -> float:
        """Sum of the lines at `time_s`."""
        omega, phase, peak = self._lines
        return float(np.cos(omega * time_s + phase).sum() / peak)


@dataclass(frozen=True)
class Step3211:
    """3-2-1-1: levels held for 3, 2, 1, 1 units, 3 units of rest, then with the opposite sign.

    Source: Jategaonkar, Flight Vehicle System Identification, section 2.3.
    """

    unit_s: float

    def at(self, time_s: float) -> float:
        """Level at `time_s`."""
        turn, unit = divmod(time_s / self.unit_s + 1e-9, 10.0)
        sign = 1.0 if int(turn) % 2 == 0 else -1.0
        for end, level in ((3.0, 1.0), (5.0, -1.0), (6.0, 1.0), (7.0, -1.0)):
            if unit < end:
                return sign * level
        return 0.0


@dataclass(frozen=True)
class Silence:
    """No excitation."""

    def at(self, time_s: float) -> float:
        """Zero at any time."""
        del time_s
        return 0.0


SIGNALS: dict[str, type[Waveform]] = {'prbs': Prbs, 'square': Square, 'chirp': Chirp,
                                      'multisine': Multisine, '3211': Step3211, 'none': Silence}
"""Name in schedules and bags → signal; its fields are its parameters."""

WHOLE = {'register_bits', 'seed'}


def waveform(name: str, parameters: Mapping[str, object], where: str) -> Waveform:
    """Build a signal by name; raises BadInputError, naming `where`, for wrong parameters."""
    if name not in SIGNALS:
        raise BadInputError(where, 'signal is unknown', repr(name), f'use {", ".join(SIGNALS)}')
    kind = SIGNALS[name]
    names = parameter_names(name)
    unknown = [key for key in parameters if key not in names]
    if unknown:
        raise BadInputError(where, f'unknown key {shortened(", ".join(unknown))} for {name}',
                            remedy=f'it takes {", ".join(names) or "none"}')
    numbers = {key: _number(value, key, where) for key, value in parameters.items()}
    try:
        built: Waveform = kind(**numbers)
    except TypeError as error:
        absent = [f for f in names if f not in numbers and f != 'seed']
        raise BadInputError(where, f'signal {name} needs {", ".join(absent)}',
                            remedy='add it') from error
    try:
        built.at(0.0)
    except BadInputError as error:
        raise BadInputError(where, str(error)) from error
    return built


def _number(value: object, key: str, where: str) -> float | int:
    """`value` as a positive number, an integer for keys in WHOLE."""
    whole = key in WHOLE
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise BadInputError(where, f'{key} must be a number', repr(value))
    if value <= 0.0 or (whole and value != math.floor(value)):
        raise BadInputError(where, f'{key} must be a positive {"whole " * whole}number', value)
    return int(value) if whole else float(value)


def parameter_names(name: str) -> tuple[str, ...]:
    """Names of a signal's parameters."""
    return tuple(f.name for f in fields(SIGNALS[name]))  # type: ignore[arg-type]
