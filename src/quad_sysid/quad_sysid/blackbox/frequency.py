"""Frequency response of a polynomial model, with the confidence that its covariance gives.

Estimates without a model stand in spectra.py.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from quad_sysid.blackbox.polynomial import ComplexArray, Model
from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError


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

    def magnitude_band(self, confidence: float = 0.99) -> tuple[FloatArray, FloatArray]:
        """Lower and upper bound (m,) of |G|, normal approximation."""
        width = float(special.ndtri(0.5 + 0.5 * confidence)) * self.magnitude_std
        return np.maximum(self.magnitude - width, 0.0), self.magnitude + width

    def _spread(self, direction: FloatArray) -> FloatArray:
        """Standard error along `direction` (m, 2), scaled to unit length."""
        if self.covariance is None:
            return np.full(self.w.size, np.nan)
        unit = direction / np.linalg.norm(direction, axis=1, keepdims=True)
        variance = np.einsum('mi,mij,mj->m', unit, self.covariance, unit)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def frequency_response(model: Model, w: FloatArray) -> FrequencyResponse:
    """Response of B/(A F) at w (m,) rad/s, with its covariance by the first-order formula.

    Raises BadInputError where w is negative, not finite or beyond the Nyquist frequency.
    """
    grid = np.atleast_1d(np.asarray(w, dtype=float))
    nyquist = np.pi / model.dt
    inside = np.isfinite(grid) & (grid >= 0.0) & (grid <= nyquist * 1.000001)
    if grid.ndim != 1 or not inside.all():
        raise BadInputError(
            'frequency_response', f'w must be 1-D and within 0..{nyquist:.6g} rad/s',
            grid[~inside][0] if grid.ndim == 1 else f'shape {grid.shape}',
        )
    q = np.exp(-1j * grid * model.dt)
    a, b, f = (_at(poly, q) for poly in (model.A, model.B, model.F))
    response = b / (a * f)
    covariance = None
    if model.covariance is not None:
        powers = [
            (-response / a)[:, None] * _powers(q, range(1, model.A.size)),
            (1.0 / (a * f))[:, None] * _powers(q, range(model.nk, model.B.size)),
            np.zeros((grid.size, model.C.size + model.D.size - 2)),
            (-response / f)[:, None] * _powers(q, range(1, model.F.size)),
        ]
        gradient = np.hstack(powers)
        parts = np.stack((gradient.real, gradient.imag), axis=1)
        covariance = parts @ model.covariance @ np.swapaxes(parts, 1, 2)
    return FrequencyResponse(w=grid, response=response, covariance=covariance)


def _at(poly: FloatArray, q: ComplexArray) -> ComplexArray:
    """Value of a polynomial in q⁻¹ at q⁻¹ = `q`."""
    return np.asarray(np.polynomial.polynomial.polyval(q, poly), dtype=complex)


def _powers(q: ComplexArray, exponents: range) -> ComplexArray:
    """(m, len(exponents)) powers of q⁻¹."""
    return np.asarray(q[:, None] ** np.array(exponents, dtype=int))
