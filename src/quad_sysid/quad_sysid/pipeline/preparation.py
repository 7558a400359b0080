"""The rules of the paper's section 2.6 on a record: filters, rates, bias, resonance, lost samples.

Nothing is changed here.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy import ndimage, signal, special

from quad_sysid.contract import AXES, FloatArray
from quad_sysid.pipeline.answer import Check
from quad_sysid.record import Record, finite_runs

BAND_HZ = 20.0 / (2.0 * np.pi)
"""Highest frequency of interest in the paper, 20 rad/s."""
RULE = 5.0
"""Cut-off over the band, and sample rate over cut-off, at least."""
WINDOW_S = 2.0
"""Window of the spectra, which resolves peaks half a hertz apart."""
PEAK = 6.0
"""Power of a peak over its surroundings that is worth a word, whatever its significance."""
LOWEST_PEAK_HZ = 8.0
"""Below it lie the dynamics that are to be identified."""
BIAS_RAD_S = 0.01
LOST_PCT = 1.0


def checks(record: Record, axis: str, gains: Mapping[str, float]) -> tuple[Check, ...]:
    """Every rule, kept or not, in the paper's order."""
    found = [_filter(gains), _rate(record, gains), _bias(record, axis), _lost(record, axis)]
    return (*(c for c in found if c is not None), *_resonances(record, axis))


def _filter(gains: Mapping[str, float]) -> Check:
    cut = gains.get('sensor.gyro_filter_hz')
    if not cut:
        return Check(
            'gyro filter', None,
            'its cut-off is not known (sensor.gyro_filter_hz): the lag and delay of the models '
            'contain it',
        )
    return Check(
        'gyro filter', kept=cut >= RULE * BAND_HZ,
        words=f'cut-off {cut:g} Hz, at least {RULE * BAND_HZ:.1f} Hz for a band up to 20 rad/s',
    )


def _rate(record: Record, gains: Mapping[str, float]) -> Check:
    rate = 1.0 / record.dt
    cut = gains.get('sensor.gyro_filter_hz') or RULE * BAND_HZ
    return Check(
        'sample rate', kept=rate >= RULE * cut,
        words=f'{rate:g} Hz, at least {RULE * cut:.0f} Hz behind a filter of {cut:.3g} Hz',
    )


def _bias(record: Record, axis: str) -> Check:
    """Mean rate while idle, else over the record, less what the measured angle has turned by."""
    index = AXES.index(axis)
    rate = record.rates[:, index]
    idle = [record.span(s) for s in record.segments if s.role == 'idle']
    spans = [span for span in idle if span[1] - span[0] > 1.0 / record.dt]
    where = 'while idle' if spans else 'over the record'
    known = np.isfinite(rate)
    if record.angles is not None:
        known &= np.isfinite(record.angles[:, index])
    turned, length = 0.0, 0
    for span in spans or [(0, record.n)]:
        for a, b in finite_runs(known, span):
            turned += float(rate[a:b].sum()) * record.dt
            length += b - a
            if record.angles is not None:
                turned -= float(record.angles[b - 1, index] - record.angles[a, index])
    if not length:
        return Check('gyro bias', None, 'no rate to take a mean of')
    mean = turned / (length * record.dt)
    beside = ' beside the measured angle' if record.angles is not None else ''
    return Check(
        'gyro bias', kept=abs(mean) < BIAS_RAD_S,
        words=f'mean rate {where}{beside} {mean:.2g} rad/s, limit {BIAS_RAD_S:g}; the black-box '
        'models are fitted about the means of the training',
    )


def _lost(record: Record, axis: str) -> Check:
    index = AXES.index(axis)
    good = np.isfinite(record.rates[:, index]) & np.isfinite(record.control[:, index + 1])
    lost = 100.0 * float(1.0 - good.mean())
    gaps = len(finite_runs(good, (0, record.n))) - 1
    return Check(
        'lost samples', kept=lost < LOST_PCT,
        words=f'{lost:.2g} % of the cycles lack rate or command, in {max(gaps, 0)} gaps; models '
        'are fitted between them, nothing is filled in',
    )


def _resonances(record: Record, axis: str) -> tuple[Check, ...]:
    """One check for each sensor of the axis: its spectrum has no narrow peak."""
    index = AXES.index(axis)
    mute = np.zeros(record.n, dtype=bool)
    for a, b in (record.span(s) for s in record.segments if s.signal == 'multisine'):
        mute[a:b] = True  # its lines would look like resonances
    sensors = [(f'gyro {axis} spectrum', record.rates[:, index])]
    if record.acceleration is not None:
        sensors += [(f'accelerometer {name} spectrum', record.acceleration[:, column])
                    for column, name in enumerate('xyz')]
    found = []
    for name, values in sensors:
        peaks = resonance_peaks(np.where(mute, np.nan, values), record.dt)
        if peaks is None:
            found.append(Check(name, None, 'too short a stretch for a spectrum'))
            continue
        told = ', '.join(f'{f:.3g} Hz ({10.0 * np.log10(ratio):.0f} dB)' for f, ratio in peaks[:4])
        found.append(
            Check(name, kept=not peaks, words=f'resonance peaks at {told}' if peaks
                  else f'no resonance peak above {LOWEST_PEAK_HZ:g} Hz')
        )
    return tuple(found)


def resonance_peaks(values: FloatArray, dt: float,
                    lowest_hz: float = LOWEST_PEAK_HZ) -> tuple[tuple[float, float], ...] | None:
    """Frequency (Hz) and power over the surroundings of each narrow peak, strongest first.

    Welch's spectrum over the unbroken stretches against its own running median; a peak must
    stand out of the scatter of the estimate at 0.1 % over all frequencies together. None where
    there is too little for a spectrum.
    """
    found = spectrum(values, dt)
    if found is None:
        return None
    f, density, count = found
    if not density.max() > 0.0:
        return ()
    width = max(9, round(10.0 * WINDOW_S) | 1)
    around = ndimage.median_filter(density, size=width, mode='nearest')
    ratio = density / np.maximum(around, 1e-12 * density.max())
    looked = (f >= lowest_hz) & (f < 0.95 * f[-1])
    freedom = 1.2 * count  # halves overlap, so neighbours in time are not independent
    level = float(special.chdtri(freedom, 1e-3 / max(int(looked.sum()), 1))) / freedom
    high = looked & (ratio > max(PEAK, 1.5 * level))
    peaks = [
        (float(f[i]), float(ratio[i])) for i in np.flatnonzero(high)
        if ratio[i] == ratio[max(i - 4, 0) : i + 5].max()
    ]
    return tuple(sorted(peaks, key=lambda item: -item[1]))


def spectrum(values: FloatArray, dt: float,
             window_s: float = WINDOW_S) -> tuple[FloatArray, FloatArray, int] | None:
    """Frequencies (m,) Hz, Welch's density (m,) per Hz over the unbroken stretches, its windows.

    None where there is too little for a spectrum.
    """
    size = round(window_s / dt)
    runs = [r for r in finite_runs(np.isfinite(values), (0, values.size)) if r[1] - r[0] >= size]
    spectra: list[FloatArray] = []
    weights: list[int] = []
    f = np.zeros(0)
    for a, b in runs:
        f, density = signal.welch(values[a:b] - values[a:b].mean(), 1.0 / dt, nperseg=size)
        spectra.append(np.asarray(density))
        weights.append(max(1, 2 * (b - a) // size - 1))
    count = sum(weights)
    if count < 4:
        return None
    density = np.average(spectra, axis=0, weights=weights)
    return f, np.asarray(density), count
