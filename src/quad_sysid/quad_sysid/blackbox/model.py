"""A polynomial model of one axis as an object that runs: simulated, predicted, compared, tested.

The work is done in the modules named below; polynomial.py has the polynomials, and no fit is here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from quad_sysid.blackbox.frequency import FrequencyResponse, frequency_response
from quad_sysid.blackbox.polynomial import Polynomials, delayed, monic
from quad_sysid.blackbox.residuals import ResidualTest, residual_test
from quad_sysid.blackbox.simulate import compare, predict, simulate
from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.record import IOData

ORDERS_OF = {'ARX': ('na', 'nb', 'nk'), 'ARMAX': ('na', 'nb', 'nc', 'nk'),
             'OE': ('nb', 'nf', 'nk'), 'BJ': ('nb', 'nc', 'nd', 'nf', 'nk')}
"""Structure → its orders, as MATLAB counts them."""


@dataclass(frozen=True, repr=False)
class Model(Polynomials):
    """A(q) y(t) = B(q)/F(q) u(t) + C(q)/D(q) e(t), polynomials in q⁻¹ (Ljung 1999, eq. 4.33)."""

    def with_parameters(self, theta: FloatArray) -> Model:
        """Build the same model with other free coefficients (p,)."""
        sizes = [self.A.size - 1, self.B.size - self.nk, self.C.size - 1, self.D.size - 1]
        a, b, c, d, f = np.split(np.asarray(theta, dtype=float), np.cumsum(sizes))
        return replace(self, A=monic(a), B=delayed(b, self.nk), C=monic(c), D=monic(d), F=monic(f))

    def simulate(self, u: npt.ArrayLike, x0: npt.ArrayLike | None = None) -> FloatArray:
        """(n,) free run on inputs u (n,); see blackbox.simulate."""
        return simulate(self, np.asarray(u, dtype=float),
                        None if x0 is None else np.asarray(x0, dtype=float))

    def predict(self, z: IOData, horizon: float = 1) -> FloatArray:
        """(n,) predicted output, `horizon` samples ahead; see blackbox.predict."""
        return predict(self, z, horizon)

    def compare(self, z: IOData, horizon: float = math.inf) -> float:
        """Fit on z in per cent, by default of the free run."""
        return compare(z, self, horizon=horizon)[0]

    def residuals(self, z: IOData) -> ResidualTest:
        """Tests of the one-step errors on z; see blackbox.residual_test."""
        return residual_test(z, self)

    def bode(self, w: npt.ArrayLike | None = None) -> FrequencyResponse:
        """Response at w (m,), rad/s, by default at 200 up to the Nyquist frequency."""
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
