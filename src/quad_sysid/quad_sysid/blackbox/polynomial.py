"""The polynomials of a model A y = (B/F) u + (C/D) e of one axis.

Values and what follows from them algebraically; no fitting, no simulation, no data. model.py has
what a model does with data.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from quad_sysid.contract import FloatArray

ComplexArray = npt.NDArray[np.complex128]


@dataclass(frozen=True)
class Polynomials:
    """A(q) y(t) = B(q)/F(q) u(t) + C(q)/D(q) e(t), polynomials in q⁻¹ (Ljung 1999, eq. 4.33).

    All polynomials start at q⁰; A, C, D, F are monic. B holds the delay as `nk` leading zeros, as
    in MATLAB's idpoly, so that B(q) u(t) is a plain convolution.
    """

    structure: str
    """ARX, ARMAX, OE, BJ, IV4 or CLRIV."""
    orders: Mapping[str, int]
    """Orders by name, such as {'na': 10, 'nb': 10, 'nk': 5}."""
    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    F: FloatArray
    nk: int
    """Delay in samples; 1 is one sample."""
    dt: float
    """Sample interval, s."""
    noise_variance: float
    """Variance of the innovation e, SSE/(N - p), in the output's unit squared."""
    covariance: FloatArray | None = None
    """(p, p) of `parameters`; None where the method gives none."""
    converged: bool = True
    iterations: int = 0
    samples: int = 0
    """N, the rows that the fit used."""
    loss: float = math.nan
    """V = SSE/N of the one-step errors on the rows of the fit."""
    approach: str = 'direct'
    warnings: tuple[str, ...] = field(default=())

    def __post_init__(self) -> None:
        """Take read-only copies of the arrays."""
        for name in ('A', 'B', 'C', 'D', 'F', 'covariance'):
            value = getattr(self, name)
            if value is not None:
                array = np.array(value, dtype=float)
                array.setflags(write=False)
                object.__setattr__(self, name, array)

    @property
    def parameters(self) -> FloatArray:
        """(p,) free coefficients: a1.., b_nk.., c1.., d1.., f1..."""
        return np.concatenate((self.A[1:], self.B[self.nk :], self.C[1:], self.D[1:], self.F[1:]))

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of `parameters`; b's index is its lag, as in the paper's Table 3."""
        names = [f'a{i}' for i in range(1, self.A.size)]
        names += [f'b{i}' for i in range(self.nk, self.B.size)]
        for letter, poly in (('c', self.C), ('d', self.D), ('f', self.F)):
            names += [f'{letter}{i}' for i in range(1, poly.size)]
        return tuple(names)

    @property
    def std(self) -> FloatArray | None:
        """(p,) standard errors of `parameters`."""
        if self.covariance is None:
            return None
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    @property
    def denominator(self) -> FloatArray:
        """A(q) F(q), the denominator of the plant B/(A F)."""
        return np.convolve(self.A, self.F)

    @property
    def poles(self) -> ComplexArray:
        """Poles of the plant B/(A F) in the z plane."""
        return np.roots(self.denominator).astype(complex)

    @property
    def stable(self) -> bool:
        """Whether every pole of the plant lies inside the unit circle."""
        return bool(np.all(np.abs(self.poles) < 1.0))

    @property
    def aic(self) -> float:
        """N ln V + 2 p, over the rows of this model's own fit."""
        return self.samples * math.log(self.loss) + 2.0 * self.parameters.size

    @property
    def bic(self) -> float:
        """N ln V + p ln N, over the rows of this model's own fit."""
        return self.samples * math.log(self.loss) + self.parameters.size * math.log(self.samples)

    @property
    def fpe(self) -> float:
        """Akaike's final prediction error V (1 + p/N) / (1 - p/N), as MATLAB's fpe."""
        share = self.parameters.size / max(self.samples, 1)
        return self.loss * (1.0 + share) / (1.0 - share)

    def __repr__(self) -> str:
        lines = [f'{self.name}: A y = (B/F) u + (C/D) e, {1.0 / self.dt:.6g} Hz, {self.approach}']
        for letter in 'ABCDF':
            poly = getattr(self, letter)
            terms = [f'{c:+.4g}' + (f' q^-{i}' if i else '') for i, c in enumerate(poly) if c]
            if poly.size > 1 or letter == 'B':
                lines.append(f'  {letter} = {" ".join(terms)}')
        if self.samples:
            lines.append(f'  loss {self.loss:.4g}, FPE {self.fpe:.4g}, {self.samples} samples')
        return '\n'.join([*lines, *(f'  {warning}' for warning in self.warnings)])

    @property
    def name(self) -> str:
        """Structure and orders as in the paper's Table 2, such as `ARX 10 10 5`."""
        return ' '.join([self.structure, *(str(value) for value in self.orders.values())])

    def to_control(self) -> Any:
        """The plant B/(A F) as `control.TransferFunction` (needs the package `control`)."""
        import control

        numerator, denominator = self.B, self.denominator
        length = max(numerator.size, denominator.size)
        num = np.trim_zeros(np.pad(numerator, (0, length - numerator.size)), 'f')
        den = np.pad(denominator, (0, length - denominator.size))
        return control.TransferFunction(num if num.size else np.zeros(1), den, self.dt)


def monic(tail: FloatArray) -> FloatArray:
    """[1, tail…]."""
    return np.concatenate(([1.0], tail))


def delayed(b: FloatArray, nk: int) -> FloatArray:
    """B(q) with its nk leading zeros."""
    return np.concatenate((np.zeros(nk), b))
