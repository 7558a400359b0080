"""What the data can carry: persistence of excitation, dead time, removal of means.

Design of excitation signals belongs to the room `signals`.
"""

from __future__ import annotations

import numpy as np

from quad_sysid.blackbox.arx import search_arx
from quad_sysid.blackbox.regression import (
    BLOCK_ROWS,
    check_informative,
    check_order,
    lagged,
    triangular,
)
from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.record import IOData


def excitation_order(u: FloatArray | IOData, max_order: int = 100, tolerance: float = 1e-6) -> int:
    """Order to which u is persistently exciting: rank of its Hankel matrix (Ljung 1999, 13.2).

    A constant has order 1, a sine 2, noise `max_order` (or what the length allows). Singular
    values below `tolerance` times the largest count as zero.
    """
    max_order = check_order('excitation_order', 'max_order', max_order, 1)
    if isinstance(u, IOData):
        parts = [u.u[start:stop] for start, stop in u.segments]
    else:
        parts = [np.asarray(u, dtype=float)]
    if any(part.ndim != 1 or not np.isfinite(part).all() for part in parts):
        raise BadInputError('excitation_order', 'u must be 1-D and finite')
    longest = max(part.size for part in parts)
    if longest < 2:
        raise BadInputError('excitation_order', 'u must have at least 2 samples', longest)
    order = min(max_order, (longest + 1) // 2)
    blocks = (lagged(part, range(order), start, min(part.size, start + BLOCK_ROWS))
              for part in parts
              for start in range(order - 1, part.size, BLOCK_ROWS))
    values = np.linalg.svd(triangular(blocks), compute_uv=False)
    return int(np.sum(values > tolerance * values[0])) if values[0] > 0.0 else 0


def delay_estimate(z: IOData, na: int = 8, nb: int = 4, nk_min: int = 0, nk_max: int = 20) -> int:
    """Delay nk in samples of the ARX model with the lowest BIC, na and nb up to those given."""
    nk_min = check_order('delay_estimate', 'nk_min', nk_min, 0)
    nk_max = check_order('delay_estimate', 'nk_max', nk_max, nk_min)
    na, nb = (check_order('delay_estimate', k, v, 1) for k, v in (('na', na), ('nb', nb)))
    check_informative('delay_estimate', z, na + nb, max(na, nk_max + nb - 1))
    found = search_arx(z, range(1, na + 1), range(1, nb + 1), range(nk_min, nk_max + 1),
                       criterion='bic')
    return found.model.nk


def detrend(z: IOData) -> IOData:
    """Take from u and y (and r) the common mean over all segments."""

    def centred(x: FloatArray) -> FloatArray:
        mean = np.concatenate([x[start:stop] for start, stop in z.segments]).mean()
        return np.asarray(x - mean)

    return IOData(u=centred(z.u), y=centred(z.y), dt=z.dt, r=None if z.r is None else centred(z.r),
                  segments=z.segments)
