"""The paper's Table 1: joint input-output identification under feedback.

The direct approach is any estimator on (u, y) as recorded. Here u is replaced by one without
noise, out of the external reference, and any estimator then fits the plant. The indirect
approach stands in indirect.py.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from quad_sysid.blackbox.arx import arx
from quad_sysid.blackbox.polynomial import Model
from quad_sysid.blackbox.prediction_error import oe
from quad_sysid.blackbox.simulate import predict
from quad_sysid.blackbox.start_values import inside, stabilised
from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.record import IOData

LOOP_ORDER = 20
"""Of the ARX model behind instruments, which need not be exact."""
STAGE_ORDER = 6
"""Of the output error model of the loop: what it misses biases the plant."""

Fit = Callable[[IOData], Model]


def joint(z: IOData, fit: Fit, *, order: int = STAGE_ORDER) -> Model:
    """Joint input-output: u and y as outputs of r; `fit` runs on the part of u that r explains.

    The two-stage method (Van den Hof, Schrama 1993), right whatever the noise and unknown the
    controller. `order` is that of the loop's response from r. Fit an output error or BJ
    structure. Needs r, else BadInputError.
    """
    clean = noise_free('joint', z, z.u, z.r, order)
    return replace(fit(replace(z, u=clean)), approach='joint')


def noise_free(
    where: str, z: IOData, x: FloatArray, external: FloatArray | None, order: int | None = None,
    *, name: str = 'the reference r',
) -> FloatArray:
    """(n,) what the external signal alone explains of x: free run of a model from r to x.

    A high-order ARX model, or, with `order`, an output error model of that order. Raises
    BadInputError, naming `where` and the signal's `name`, where it is missing or cannot serve.
    """
    if external is None:
        raise BadInputError(
            where, 'needs the external reference r', None, 'give IOData(…, r=…)'
        )
    r = np.asarray(external, dtype=float)
    if r.shape != z.u.shape:
        raise BadInputError(where, f'{name} must have {z.u.size} samples', r.shape)
    inside = np.concatenate([r[start:stop] for start, stop in z.segments])
    if not np.isfinite(inside).all():
        raise BadInputError(where, f'{name} must be finite in all segments')
    if np.ptp(inside) == 0.0:
        raise BadInputError(where, f'{name} is constant, it drives nothing', float(inside[0]),
                            'use a stretch with excitation')
    if np.array_equal(r, x):
        return r
    try:
        loop = IOData(u=r, y=x, dt=z.dt, segments=z.segments)
        model = _loop_model(loop, order)
    except BadInputError as error:
        raise BadInputError(where, f'no response from {name} can be fitted ({error})') from error
    return np.asarray(np.nan_to_num(predict(model, loop, np.inf)))


def _loop_model(loop: IOData, order: int | None) -> Model:
    if order is not None:
        return oe(loop, order, order, 0)
    longest = max(stop - start for start, stop in loop.segments)
    high = max(1, min(LOOP_ORDER, longest // 20))
    return stabilised_plant(arx(loop, high, high, 0))


def stabilised_plant(model: Model) -> Model:
    """Reflect the roots of A and F into the unit circle, so that the free run stays bounded."""
    return replace(stabilised(model), A=inside(model.A))
