"""The loop in flight over frequency: tracking, sensitivity, margins, and what delays it. Pure.

The set-point is the instrument: what the pilot or the outer loop asked for is independent of the
noise, so S_yr / S_rr is the closed loop and S_yr / S_ur the plant from the command to the rate as
the controller sees it, feedback or not (Söderström and Stoica, System Identification, ch. 10).
With the gains of the log that plant gives the loop, its margins and its sensitivity. Without them
1 - S_yr / S_rr is the sensitivity only of a loop without feed-forward, and no margins are stated.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from quad_sysid.contract import FloatArray
from quad_sysid.logview.spectrum import starts_of
from quad_sysid.loop.cascade import CascadeGains, margins, weight_of
from quad_sysid.loop.linear import ComplexArray
from quad_sysid.pipeline.constants import COHERENT

FRAME_S = 2.0
"""Half a hertz between lines, as slow as a pilot steers."""
MIN_WINDOWS = 8
"""Frames from which a response is stated."""
LEAST_POWER = 1e-4
"""A line counts where the set-point has this share of its largest density."""
REFERENCE_HZ = 10.0
"""Frequency at which delays are stated where no crossover was measured."""
NEAR = 0.35
"""Distance of frequencies, in logarithms, whose phases give the delay at one."""
MIN_LINES = 3
"""Lines in a row that make a band; as many may lack in it."""


@dataclass(frozen=True)
class Spectra:
    """Means over frames of the spectra of reference r, command u and output y."""

    frequency_hz: FloatArray
    rr: FloatArray
    yy: FloatArray
    uu: FloatArray
    yr: ComplexArray
    ur: ComplexArray
    frames: int

    def coherence(self, cross: ComplexArray, power: FloatArray) -> FloatArray:
        """(f,) squared."""
        return np.abs(cross) ** 2 / np.maximum(self.rr * power, 1e-300)


@dataclass(frozen=True)
class Delay:
    """Delay of one part of the loop at the stated frequency."""

    part: str
    milliseconds: float
    degrees: float
    how: str
    """`measurement` or `settings`."""


@dataclass(frozen=True)
class LoopResponse:
    """One axis' rate loop over frequency."""

    frequency_hz: FloatArray
    """(f,) where set-point and rate are coherent."""
    tracking: ComplexArray
    """(f,) rate over set-point."""
    coherence: FloatArray
    bandwidth_hz: float
    """Frequency above which the tracking stays below -3 dB; NaN where it is not coherent there."""
    peak: float
    """Largest magnitude of the tracking."""
    peak_hz: float
    plant: ComplexArray | None = None
    """(f,) rad/s per unit of command; NaN where the command is not coherent."""
    loop: ComplexArray | None = None
    """(f,) loop gain by the gains of the log."""
    crossover_hz: float = np.nan
    phase_margin_deg: float = np.nan
    gain_margin_db: float = np.nan
    """NaN where the phase crosses 180° outside what is coherent."""
    sensitivity: float = np.nan
    """Largest |1 / (1 + L)| in the coherent band, and its frequency."""
    sensitivity_hz: float = np.nan
    delays: tuple[Delay, ...] = ()
    delay_hz: float = REFERENCE_HZ
    """The frequency at which they are stated."""


def spectra(r: FloatArray, u: FloatArray, y: FloatArray, usable: npt.NDArray[np.bool_],
            dt: float) -> Spectra | None:
    """Spectra over Hann windows, half overlapping, where all is good; None with too few."""
    size = round(FRAME_S / dt)
    starts = starts_of(usable & np.isfinite(r) & np.isfinite(y) & np.isfinite(u), size)
    if len(starts) < MIN_WINDOWS:
        return None
    window, cut = np.hanning(size + 1)[:size], starts[:, None] + np.arange(size)
    fr, fu, fy = (np.fft.rfft((x[cut] - x[cut].mean(axis=1, keepdims=True)) * window, axis=1)
                  for x in (r, u, y))
    scale = 2.0 * dt / (window @ window) / len(starts)

    def power(x: ComplexArray) -> FloatArray:
        return np.asarray(scale * np.sum(np.abs(x) ** 2, axis=0))

    def cross(x: ComplexArray) -> ComplexArray:
        return np.asarray(scale * np.sum(x * np.conj(fr), axis=0))

    lines = np.asarray(np.fft.rfftfreq(size, dt), float)
    return Spectra(lines, power(fr), power(fy), power(fu), cross(fy),
                   cross(fu), len(starts))


def loop_response(measured: Spectra, dt: float, gains: Mapping[str, float],
                  axis: str) -> LoopResponse | None:
    """The closed loop, and with gains its margins; None where nothing is coherent.

    dt: the controller's cycle, s, which may be shorter than the log's.
    """
    f = measured.frequency_hz
    coherence = measured.coherence(measured.yr, measured.yy)
    excited = np.zeros(1, bool) if len(f) < 2 else \
        measured.rr >= LEAST_POWER * measured.rr[1:].max()
    used = (coherence >= COHERENT) & excited & (f > 0.0)
    used &= np.cumsum(~used & (f > 0.0) & (f > f[np.argmax(used)])) <= MIN_LINES
    if used.sum() < MIN_LINES:
        return None
    f, tracking = f[used], (measured.yr[used] / measured.rr[used])
    level = np.abs(tracking)
    peak = int(np.argmax(level))
    common = {'frequency_hz': f, 'tracking': tracking, 'coherence': coherence[used],
              'bandwidth_hz': _bandwidth(f, level),
              'peak': float(level[peak]), 'peak_hz': float(f[peak])}
    driven = measured.coherence(measured.ur, measured.uu)[used] >= COHERENT
    if driven.sum() < MIN_LINES:
        return LoopResponse(**common)
    plant = np.where(driven, measured.yr[used] / np.where(driven, measured.ur[used], 1.0), np.nan)
    controller = feedback(gains, axis, f, dt)
    if controller is None:
        return LoopResponse(**common, plant=plant)
    loop = plant * controller
    inside = np.isfinite(loop)
    of = margins(loop[inside][None], 2.0 * np.pi * f[inside])
    crossover = float(of.crossover_rad_s[0]) / (2.0 * np.pi)
    sensitivity = np.where(inside, np.abs(1.0 / (1.0 + np.where(inside, loop, 0.0))), -np.inf)
    worst = int(np.argmax(sensitivity))

    if not crossover > 0.0:
        return LoopResponse(**common, plant=plant, loop=loop)

    def finite(value: float) -> float:
        return value if np.isfinite(value) else np.nan

    return LoopResponse(
        **common, plant=plant, loop=loop, crossover_hz=crossover,
        phase_margin_deg=finite(float(of.phase_margin_deg[0])),
        gain_margin_db=finite(float(of.gain_margin_db[0])),
        sensitivity=float(sensitivity[worst]), sensitivity_hz=float(f[worst]))


def _bandwidth(f: FloatArray, level: FloatArray) -> float:
    """Frequency from which on the level stays below -3 dB, between the lines by its logarithm.

    0 dB is what the lowest lines say: at rest, if they reach near it, by the straight line of
    1 / level² over f², as a slow loop has fallen there already. NaN where the level never falls,
    or falls among these lines.
    """
    lowest, inverse = f[:MIN_LINES], level[:MIN_LINES]**-2.0
    at_rest = float(np.polyfit(lowest**2, inverse, 1)[1] if lowest[-1] > 2.5 * lowest[0] else
                    np.median(inverse))
    if not at_rest > 0.0:
        return float('nan')
    least = np.sqrt(0.5 / at_rest)
    if not level.max() >= least:
        return float('nan')
    last = int(np.flatnonzero(level >= least)[-1])
    if not MIN_LINES <= last + 1 < len(level):
        return float('nan')
    above, below = np.log(level[last] / least), np.log(least / level[last + 1])
    return float(f[last] * (f[last + 1] / f[last])**(above / (above + below)))


def feedback(gains: Mapping[str, float], axis: str, frequency_hz: FloatArray,
             dt: float) -> ComplexArray | None:
    """(f,) response from -rate to command, by the contract's gains; None without kp."""
    if f'{axis}.rate.kp' not in gains:
        return None
    return np.asarray(-_cascade(gains, axis).response(2.0 * np.pi * frequency_hz, dt)[0])


def derivative(gains: Mapping[str, float], axis: str, frequency_hz: FloatArray,
               dt: float) -> ComplexArray:
    """(f,) the D part over minus the rate, behind its filters."""
    alone = replace(_cascade(gains, axis), rate_kp=0.0, rate_ki=0.0, output_filter_hz=0.0)
    omega = 2.0 * np.pi * np.maximum(frequency_hz, 1e-6)  # an integrator has no response at 0
    return np.asarray(-alone.response(omega, dt)[0])


def _cascade(gains: Mapping[str, float], axis: str) -> CascadeGains:
    """The log's controller as a linear one; what the log does not name is not there."""
    name = f'{axis}.rate.d_filter_hz'
    linear = {key: value for key, value in gains.items() if not key.endswith('limit')}
    return CascadeGains.from_mapping(
        {f'{axis}.rate.ki': 0.0, f'{axis}.rate.kd': 0.0, name: 0.0, **linear}, axis)


def first_order(cutoff_hz: float, frequency_hz: FloatArray, dt: float) -> ComplexArray:
    """(f,) a first-order filter as a firmware computes it, backward Euler; 1 where it is off."""
    weight = weight_of(cutoff_hz, dt)
    return np.asarray(weight / (1.0 - (1.0 - weight) * np.exp(-2j * np.pi * frequency_hz * dt)))


def butterworth(cutoff_hz: float, frequency_hz: FloatArray) -> ComplexArray:
    """(f,) a second-order Butterworth low-pass; 1 where it is off."""
    if not cutoff_hz > 0.0:
        return np.ones(len(frequency_hz), complex)
    x = frequency_hz / cutoff_hz
    return np.asarray(1.0 / (1.0 - x**2 + 1j * np.sqrt(2.0) * x))


def notch(centre_hz: float, width_hz: float, frequency_hz: FloatArray) -> ComplexArray:
    """(f,) a second-order notch; 1 where it is off."""
    if not (centre_hz > 0.0 and width_hz > 0.0):
        return np.ones(len(frequency_hz), complex)
    distance = centre_hz**2 - frequency_hz**2
    return np.asarray(distance / (distance + 1j * width_hz * frequency_hz))


def measured_delay(part: str, before: FloatArray, after: FloatArray,
                   usable: npt.NDArray[np.bool_], dt: float, at_hz: float) -> Delay | None:
    """The delay of a part whose input and output were logged, from the phase around `at_hz`."""
    between = spectra(before, before, after, usable, dt)
    if between is None:
        return None
    f = between.frequency_hz
    used = (between.coherence(between.yr, between.yy) >= COHERENT) & (f > 0.0)
    seconds = _delay_at(f[used], between.yr[used], at_hz)
    return None if seconds is None else of_seconds(part, seconds, at_hz, 'measurement')


def of_seconds(part: str, seconds: float, at_hz: float, how: str) -> Delay:
    """A delay with the phase that it costs at a frequency."""
    return Delay(part, 1e3 * seconds, 360.0 * at_hz * seconds, how)


def of_filter(part: str, response: ComplexArray, at_hz: float, how: str) -> Delay:
    """The delay of a filter by its response (1,) at `at_hz`."""
    return of_seconds(part, -float(np.angle(response[0])) / (2.0 * np.pi * at_hz), at_hz, how)


def at_crossover(loop: LoopResponse | None) -> float:
    """The frequency at which delays are stated: the crossover, or REFERENCE_HZ within the band."""
    if loop is None:
        return REFERENCE_HZ
    if np.isfinite(loop.crossover_hz):
        return loop.crossover_hz
    return float(np.clip(REFERENCE_HZ, loop.frequency_hz[0], loop.frequency_hz[-1]))


def plant_delay(loop: LoopResponse, at_hz: float) -> float | None:
    """Delay, s, from command to angular acceleration at a frequency, Hz; None if not measured."""
    if loop.plant is None:
        return None
    is_finite = np.isfinite(loop.plant)
    f = loop.frequency_hz[is_finite]
    if len(f) < MIN_LINES or not f[0] <= at_hz <= f[-1]:
        return None
    return _delay_at(f, loop.plant[is_finite] * 1j * f, at_hz)


def _delay_at(frequency_hz: FloatArray, response: ComplexArray, at_hz: float) -> float | None:
    """Seconds at one frequency, from a parabola over frequency through the phases around it.

    A delay is a straight line there, a lag bends. The phase is counted from the lowest line on,
    since a long delay turns it more than once before.
    """
    near = np.abs(np.log(frequency_hz / at_hz)) < NEAR
    if near.sum() < MIN_LINES:
        return None
    fitted = np.polyfit(frequency_hz[near] - at_hz, np.unwrap(np.angle(response))[near], 2)
    return -float(fitted[2]) / (2.0 * np.pi * at_hz)
