"""The polynomial model A y = (B/F) u + (C/D) e of one axis.

Values and what follows from them algebraically; no fitting, no simulation, no data.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError

if TYPE_CHECKING:
    from quad_sysid.blackbox.frequency import FrequencyResponse
    from quad_sysid.blackbox.residuals import ResidualTest
    from quad_sysid.record import IOData

ComplexArray = npt.NDArray[np.complex128]
ORDERS_OF = {'ARX': ('na', 'nb', 'nk'), 'ARMAX': ('na', 'nb', 'nc', 'nk'),
             'OE': ('nb', 'nf', 'nk'), 'BJ': ('nb', 'nc', 'nd', 'nf', 'nk')}
"""Structure → its orders, as MATLAB counts them."""


@dataclass(frozen=True)
class Model:
    """A(q) y(t) = B(q)/F(q) u(t) + C(q)/D(q) e(t), polynomials in q⁻¹ (Ljung 1999, eq. 4.33).

    All polynomials start at q⁰; A, C, D, F are monic. B holds the delay as `nk` leading zeros, as
    in MATLAB's idpoly, so that B(q) u(t) is a plain convolution.
    """

    structure: str
    """ARX, ARMAX, OE, BJ, IV4 or CLRIV."""
    orders: Mapping[str, int]
    """Such as {'na': 10, 'nb': 10, 'nk': 5}."""
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

    def simulate(self, u: npt.ArrayLike, x0: npt.ArrayLike | None = None) -> FloatArray:
        """(n,) free run on inputs u (n,); see blackbox.simulate."""
        from quad_sysid.blackbox.simulate import simulate

        return simulate(self, np.asarray(u, dtype=float),
                        None if x0 is None else np.asarray(x0, dtype=float))

    def predict(self, z: IOData, horizon: float = 1) -> FloatArray:
        """(n,) predicted output, `horizon` samples ahead; see blackbox.predict."""
        from quad_sysid.blackbox.simulate import predict

        return predict(self, z, horizon)

    def compare(self, z: IOData, horizon: float = math.inf) -> float:
        """Fit on z in per cent, by default of the free run."""
        from quad_sysid.blackbox.simulate import compare

        return compare(z, self, horizon=horizon)[0]

    def residuals(self, z: IOData) -> ResidualTest:
        """Tests of the one-step errors on z; see blackbox.residual_test."""
        from quad_sysid.blackbox.residuals import residual_test

        return residual_test(z, self)

    def bode(self, w: npt.ArrayLike | None = None) -> FrequencyResponse:
        """Response at w (m,), rad/s, by default at 200 up to the Nyquist frequency."""
        from quad_sysid.blackbox.frequency import frequency_response

        nyquist = np.pi / self.dt
        grid = np.geomspace(1e-3 * nyquist, 0.999 * nyquist, 200) if w is None else w
        return frequency_response(self, np.asarray(grid, dtype=float))

    def step(self, gains: Any, size: float = 0.2, seconds: float = 2.0) -> Any:
        """The angle's answer to a step of its reference (rad) in a cascade of these gains.

        `gains`: CascadeGains. See loop.simulation.LoopResponse.
        """
        from quad_sysid.loop.simulation import simulate_polynomial_cascade

        steps = np.full(round(seconds / self.dt), size)
        return simulate_polynomial_cascade(self.denominator, self.B, gains, steps, self.dt)

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
        """Such as `ARX 10 10 5`, as the paper's Table 2 writes it."""
        return ' '.join([self.structure, *(str(value) for value in self.orders.values())])

    def with_parameters(self, theta: FloatArray) -> Model:
        """Build the same model with other free coefficients (p,)."""
        sizes = [self.A.size - 1, self.B.size - self.nk, self.C.size - 1, self.D.size - 1]
        a, b, c, d, f = np.split(np.asarray(theta, dtype=float), np.cumsum(sizes))
        return replace(self, A=monic(a), B=delayed(b, self.nk), C=monic(c), D=monic(d), F=monic(f))

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


def polynomial_model(B: Sequence[float] | FloatArray, *, dt: float,
                     A: Sequence[float] | FloatArray = (1.0,),
                     C: Sequence[float] | FloatArray = (1.0,),
                     D: Sequence[float] | FloatArray = (1.0,),
                     F: Sequence[float] | FloatArray = (1.0,), nk: int | None = None,
                     noise_variance: float = 1.0, structure: str | None = None) -> Model:
    """Build a model from known polynomials; B with its leading zeros, from which nk is read."""
    named = {'A': A, 'B': B, 'C': C, 'D': D, 'F': F}
    polys = {key: np.asarray(poly, dtype=float) for key, poly in named.items()}
    for key, poly in polys.items():
        if poly.ndim != 1 or poly.size == 0 or not np.isfinite(poly).all():
            raise BadInputError('polynomial_model', f'{key} must be a finite 1-D polynomial',
                                poly.tolist())
        if key != 'B' and poly[0] != 1.0:
            raise BadInputError('polynomial_model', f'{key} must start with 1', float(poly[0]))
    if not (math.isfinite(dt) and dt > 0):
        raise BadInputError('polynomial_model', 'dt must be a positive number of seconds', dt)
    nonzero = np.flatnonzero(polys['B'])
    if nonzero.size == 0:
        raise BadInputError('polynomial_model', 'B must not be zero', polys['B'].tolist())
    delay = int(nonzero[0]) if nk is None else nk
    if not 0 <= delay <= int(nonzero[0]):
        raise BadInputError('polynomial_model',
                            f'nk must be 0..{int(nonzero[0])}, the leading zeros of B', delay)
    sizes = {f'n{key.lower()}': poly.size - 1 for key, poly in polys.items()}
    sizes |= {'nb': polys['B'].size - delay, 'nk': delay}
    kind = next(name for name, orders in ORDERS_OF.items()
                if name == 'BJ' or all(key in orders or not size for key, size in sizes.items()))
    return Model(structure=structure or kind, orders={key: sizes[key] for key in ORDERS_OF[kind]},
                 nk=delay, dt=dt, noise_variance=noise_variance, A=polys['A'], B=polys['B'],
                 C=polys['C'], D=polys['D'], F=polys['F'])
