"""Run a structure with given parameters along measured data: one-step and free-run errors.

Calls the compiled loops with arrays; knows nothing of fitting or choosing.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.greybox import drive, kernels
from quad_sysid.greybox.data import AxisData, Span, Windows
from quad_sysid.greybox.structure import BASE_PARAMETERS, Structure

N_BASE = len(BASE_PARAMETERS)


@dataclass(frozen=True)
class Run:
    """What one pass gives. innovations (n,) NaN outside the spans; errors (windows, length)."""

    innovations: FloatArray
    errors: FloatArray

    @property
    def rms(self) -> float:
        """RMS of the free-run error over all windows, rad/s."""
        with np.errstate(over='ignore', invalid='ignore'):
            value = float(np.sqrt(np.mean(self.errors**2)))
        return value if np.isfinite(value) else float('inf')


@dataclass
class Simulator:
    """Runs structures over the same data, spans and windows; keeps the last drive response.

    `spans` are followed one by one; each is extended back over the unbroken stretch before it by
    `lead_s`, so that the state at the first window has settled.
    """

    data: AxisData
    spans: tuple[Span, ...]
    windows: Windows
    correction: FloatArray
    lead_s: float = 1.0
    _cache: dict[bytes, FloatArray] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        """Lay out the passes: merged spans with their lead, inside the stretches."""
        lead = round(self.lead_s / self.data.dt)
        passes: list[list[int]] = []
        for start, stop in sorted(self.spans):
            home = next(s for s in self.data.stretches if s[0] <= start < s[1])
            begin = max(home[0], start - lead)
            if passes and begin <= passes[-1][1] and passes[-1][0] >= home[0]:
                passes[-1][1] = max(passes[-1][1], stop)
            else:
                passes.append([begin, stop])
        self.passes = [(a, b) for a, b in passes]
        self.measured = np.stack(
            [self.data.rate[s : s + self.windows.length] for s in self.windows.starts]
        ) if self.windows.count else np.zeros((0, self.windows.length))
        self._gyro = drive.gyro_step(
            self.data.gyro_filter_hz, self.data.dt, self.data.realisation
        )
        self._no_signal = np.zeros((0, self.data.rate.size))
        self._angle = self.data.angle if self.data.angle is not None else np.zeros(1)

    def corrected(self, correction: FloatArray) -> Simulator:
        """The same passes with another state correction; the drive response is shared."""
        return replace(self, correction=correction)

    def run(self, structure: Structure, theta: FloatArray) -> Run:
        """One-step and free-run errors (prediction - measured) with parameters theta (p,)."""
        data = self.data
        known = self._response(structure, theta)
        codes, values, signals = self._terms(structure, theta)
        innovations = np.full(data.rate.size, np.nan)
        predicted = np.full((self.windows.count, self.windows.length), np.nan)
        for start, stop in self.passes:
            kernels.track(
                data.rate, self._angle, data.angle is not None, known,
                theta[0], theta[3], theta[4], data.dt, codes, values, signals,
                data.gyro_filter_hz is not None, self._gyro, self.correction, start, stop,
                self.windows.starts, self.windows.length, innovations, predicted,
            )
        return Run(innovations, predicted - self.measured)

    def commands(self, structure: Structure, theta: FloatArray) -> FloatArray:
        """(n,) command after the effects that act before delay and lag."""
        command = self.data.command
        for effect, settings, where in zip(
            structure.effects, structure.settings, structure.slices(), strict=True
        ):
            if effect.command is not None:
                command = effect.command(
                    self.data, command, theta[where], settings, theta[:N_BASE]
                )
        return command

    def _response(self, structure: Structure, theta: FloatArray) -> FloatArray:
        """Drive response, computed anew only where lag, delay or a command effect changed."""
        relevant = [theta[1:3]]
        names = []
        for effect, settings, where in zip(
            structure.effects, structure.settings, structure.slices(), strict=True
        ):
            if effect.command is not None:
                relevant.append(theta[where])
                names.append(f'{effect.name}/{effect.variant}/{sorted(settings.items())}')
        key = np.concatenate(relevant).tobytes() + ','.join(names).encode()
        found = self._cache.get(key)
        if found is None:
            if len(self._cache) > 12:
                self._cache.clear()
            found = drive.response(
                self.commands(structure, theta), tuple(self.passes), float(theta[1]),
                float(theta[2]), self.data.gyro_filter_hz, self.data.dt, self.data.realisation,
            )
            self._cache[key] = found
        return found

    def _terms(
        self, structure: Structure, theta: FloatArray
    ) -> tuple[np.ndarray, FloatArray, FloatArray]:
        """Codes (m,), values (m, q) and signals (m, n) of the added torques."""
        terms = [
            effect.torque(self.data, theta[where], settings)
            for effect, settings, where in zip(
                structure.effects, structure.settings, structure.slices(), strict=True
            )
            if effect.torque is not None
        ]
        if not terms:
            return np.zeros(0, dtype=np.int64), np.zeros((0, 1)), self._no_signal
        width = max(len(term.values) for term in terms)
        values = np.zeros((len(terms), width))
        for row, term in zip(values, terms, strict=True):
            row[: len(term.values)] = term.values
        signals = self._no_signal
        if any(term.signal is not None for term in terms):
            signals = np.zeros((len(terms), self.data.rate.size))
            for line, term in zip(signals, terms, strict=True):
                if term.signal is not None:
                    line[:] = term.signal
        return np.array([term.code for term in terms], dtype=np.int64), values, signals
