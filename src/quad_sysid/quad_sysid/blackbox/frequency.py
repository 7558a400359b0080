"""Frequency responses: of a model with the confidence of its covariance, and without any model.

Spectral analysis and coherence rest on the covariances of the data alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from quad_sysid.blackbox.polynomial import ComplexArray, Polynomials
from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.record import IOData

NO_POWER = 1e-15
"""Share of the largest below which an estimated spectrum, which can turn negative, counts as 0."""


@dataclass(frozen=True)
class SpectralEstimate:
    """A frequency response estimated without a model."""

    w: FloatArray
    """(m,) rad/s."""
    response: ComplexArray
    """(m,) output per input."""
    std: FloatArray
    """(m,) root of E|error of response|²."""
    coherence: FloatArray
    """(m,) magnitude-squared, 0..1."""
    noise_spectrum: FloatArray
    """(m,) of what the input does not explain, output unit² per (rad/sample), as Σ R(k) e^-jwk."""


def autocovariance(parts: Sequence[FloatArray], lags: int) -> FloatArray:
    """(lags + 1,) biased autocovariance over all parts, products never crossing their ends."""
    return cross_covariance(parts, parts, lags)[lags:]


def cross_covariance(x: Sequence[FloatArray], y: Sequence[FloatArray], lags: int) -> FloatArray:
    """(2 lags + 1,) biased covariance E x(t + k) y(t), k = -lags..lags, by FFT per part."""
    total, n = np.zeros(2 * lags + 1), 0
    for a, b in zip(x, y, strict=True):
        size = 1 << int(a.size + min(lags, a.size)).bit_length()
        product = np.fft.irfft(np.fft.rfft(a, size) * np.conj(np.fft.rfft(b, size)), size)
        k = min(lags, a.size - 1)
        total[lags : lags + k + 1] += product[: k + 1]
        if k:
            total[lags - k : lags] += product[-k:]
        n += a.size
    return total / max(n, 1)


def spa(z: IOData, w: FloatArray | None = None, window: int | None = None, *,
        joint: bool = False) -> SpectralEstimate:
    """Blackman-Tukey estimate of the response from u to y (Ljung 1999, eq. 6.48 and 6.57).

    w in rad/s (default 100 from one resolution to 0.9 Nyquist), `window` the Hann lag window's
    half-width in samples (default a tenth of the longest segment). `joint` takes the ratio of the
    responses to the reference z.r, which feedback does not bias. Raises BadInputError where u (or,
    `joint`, r) is constant.
    """
    longest = max(stop - start for start, stop in z.segments)
    half = max(2, longest // 10) if window is None else int(window)
    if not 1 < half < longest:
        raise BadInputError('spa', f'window must be 2..{longest - 1} samples', half)
    if joint and z.r is None:
        raise BadInputError('spa', 'joint needs the reference r', None, 'give IOData(…, r=…)')
    grid = np.geomspace(np.pi / (half * z.dt), 0.9 * np.pi / z.dt, 100) if w is None else (
        np.asarray(w, dtype=float))
    inside = np.isfinite(grid) & (grid >= 0.0) & (grid * z.dt <= np.pi + 1e-9)
    if grid.ndim != 1 or not inside.all():
        raise BadInputError('spa', f'w must be 1-D and within 0..{np.pi / z.dt:.6g} rad/s')
    source = z.r if joint and z.r is not None else z.u
    for name, x in (('u', z.u), ('r', source)):
        if np.ptp(z.inside(x)) == 0.0:
            raise BadInputError('spa', f'{name} is constant, it has no spectrum',
                                float(x[z.segments[0][0]]), 'use a stretch with excitation')
    lags = np.arange(-half, half + 1)
    weights = 0.5 * (1.0 + np.cos(np.pi * lags / half))
    kernel = np.exp(-1j * np.outer(grid * z.dt, lags)) * weights

    def centred(x: FloatArray) -> list[FloatArray]:
        parts = [x[start:stop] for start, stop in z.segments]
        mean = float(np.concatenate(parts).mean())
        return [part - mean for part in parts]

    def cross(x: list[FloatArray], y: list[FloatArray]) -> ComplexArray:
        return np.asarray(kernel @ cross_covariance(x, y, half))

    def auto(x: list[FloatArray]) -> FloatArray:
        spectrum = cross(x, x).real
        return np.maximum(spectrum, max(NO_POWER * float(spectrum.max()), np.finfo(float).tiny))

    u, y, s = centred(z.u), centred(z.y), centred(source)
    us, ys, uu, yy, ss = cross(u, s), cross(y, s), auto(u), auto(y), auto(s)
    response = ys / (us if joint else ss)
    residual = yy - 2.0 * (np.conj(response) * cross(y, u)).real + np.abs(response) ** 2 * uu
    noise = np.abs(residual) if joint else np.maximum(residual, 0.0)
    powerful = (ss > NO_POWER * ss.max()) & (yy > NO_POWER * yy.max())
    informative = np.maximum(np.abs(us) ** 2 / ss, np.finfo(float).tiny) if joint else uu
    return SpectralEstimate(
        w=grid, response=response, noise_spectrum=noise,
        std=np.sqrt(float(weights @ weights) / z.n * noise / informative),
        coherence=np.where(powerful, np.clip(np.abs(ys) ** 2 / (ss * yy), 0.0, 1.0), 0.0))


def coherence(z: IOData, w: FloatArray | None = None, window: int | None = None, *,
              joint: bool = False) -> tuple[FloatArray, FloatArray]:
    """Frequencies (m,) rad/s and squared coherence (m,) of u (or, `joint`, r) and y."""
    estimate = spa(z, w, window, joint=joint)
    return estimate.w, estimate.coherence


@dataclass(frozen=True)
class FrequencyResponse:
    """Response of the plant B/(A F) over w, with first-order uncertainty."""

    w: FloatArray
    """(m,) rad/s."""
    response: ComplexArray
    """(m,)"""
    covariance: FloatArray | None
    """(m, 2, 2) of (real, imaginary); None where the model has no covariance."""

    @property
    def magnitude(self) -> FloatArray:
        """(m,) |G|."""
        return np.asarray(np.abs(self.response))

    @property
    def phase(self) -> FloatArray:
        """(m,) unwrapped phase, rad."""
        return np.unwrap(np.angle(self.response))

    @property
    def magnitude_std(self) -> FloatArray:
        """(m,) standard error of the magnitude; NaN without a covariance."""
        return self._spread(np.column_stack((self.response.real, self.response.imag)))

    @property
    def phase_std(self) -> FloatArray:
        """(m,) standard error of the phase, rad; NaN without a covariance."""
        across = np.column_stack((-self.response.imag, self.response.real))
        return np.asarray(self._spread(across) / self.magnitude)

    def _spread(self, direction: FloatArray) -> FloatArray:
        """Standard error along `direction` (m, 2), scaled to unit length."""
        if self.covariance is None:
            return np.full(self.w.size, np.nan)
        unit = direction / np.linalg.norm(direction, axis=1, keepdims=True)
        variance = np.einsum('mi,mij,mj->m', unit, self.covariance, unit)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def frequency_response(model: Polynomials, w: FloatArray) -> FrequencyResponse:
    """Response of B/(A F) at w (m,) rad/s, with its covariance by the first-order formula.

    Raises BadInputError where w is negative, not finite or beyond the Nyquist frequency.
    """
    grid = np.atleast_1d(np.asarray(w, dtype=float))
    nyquist = np.pi / model.dt
    inside = np.isfinite(grid) & (grid >= 0.0) & (grid <= nyquist * 1.000001)
    if grid.ndim != 1 or not inside.all():
        raise BadInputError('frequency_response',
                            f'w must be 1-D and within 0..{nyquist:.6g} rad/s',
                            grid[~inside][0] if grid.ndim == 1 else f'shape {grid.shape}')
    q = np.exp(-1j * grid * model.dt)
    a, b, f = (np.polynomial.polynomial.polyval(q, poly) for poly in (model.A, model.B, model.F))
    response = np.asarray(b / (a * f), dtype=complex)
    covariance = None
    if model.covariance is not None:
        powers = q[:, None] ** np.arange(max(model.A.size, model.B.size, model.F.size))
        gradient = np.hstack((-(response / a)[:, None] * powers[:, 1 : model.A.size],
                              powers[:, model.nk : model.B.size] / (a * f)[:, None],
                              np.zeros((grid.size, model.C.size + model.D.size - 2)),
                              -(response / f)[:, None] * powers[:, 1 : model.F.size]))
        parts = np.stack((gradient.real, gradient.imag), axis=1)
        covariance = parts @ model.covariance @ np.swapaxes(parts, 1, 2)
    return FrequencyResponse(w=grid, response=response, covariance=covariance)
