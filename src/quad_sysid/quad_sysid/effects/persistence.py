"""Whether an effect stands when what is slow is taken out of the errors: against gusts and drift.

In closed loop the command answers to a slow disturbance; half a second of free run then sees the
two together, and an effect of the command, or a spring, seems to explain what wind did. Between
0.5 and 12 Hz the excitation is strong and the disturbance weak: an effect of the aircraft is as
large there as in the free run, what only follows the disturbance is not (the idea of Hausman's
test, 1978). Nothing is chosen here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import signal, stats

from quad_sysid.contract import FloatArray
from quad_sysid.effects.screening import vanishes
from quad_sysid.greybox.fit import RUNAWAY, Fit
from quad_sysid.greybox.levenberg import minimise
from quad_sysid.greybox.one_step import (
    ABRUPT,
    BAND_HZ,
    block_of_rows,
    least_squares,
    oversampling,
)
from quad_sysid.greybox.simulate import Simulator
from quad_sysid.greybox.structure import Structure

SLOWEST_HZ = 0.5
"""What is slower may be the disturbance's."""
LEFT_OVER = 0.4
"""An effect must keep this share of its size."""
CERTAIN = 3.0
"""Standard errors by which the share must be too small before an effect is turned down."""
LEVEL = 0.01
"""Of the test of an effect that is not gone where its parameters are zero."""
BIAS = 4
_OWN_TIME = frozenset({'time'})


@dataclass(frozen=True, eq=False)
class _Refined:
    theta: FloatArray
    free: np.ndarray
    covariance: FloatArray
    """Of the free parameters."""
    cost: float
    rows: float
    """Independent ones."""


def persists(sim: Simulator, fit: Fit, name: str) -> bool:
    """Whether the effect `name` of a free-run fit shows in the errors without what is slow.

    True where these cannot tell, and of effects that act by time alone: these are disturbances.
    """
    structure = fit.structure
    index = [e.name for e in structure.effects].index(name)
    effect, where = structure.effects[index], structure.slices()[index]
    if set(effect.signals) <= _OWN_TIME and any(p.name in ABRUPT for p in effect.parameters):
        return True
    own = _refined(sim, structure, fit.theta)
    if own is None:
        return True
    if vanishes(effect):
        return _keeps_its_size(fit, own, where)
    keep = np.ones(fit.theta.size, dtype=bool)
    keep[where] = False
    rest = _refined(sim, structure.without(name), fit.theta[keep])
    if rest is None:
        return True
    count = where.stop - where.start
    freedom = own.rows - own.free.size
    worth = (rest.cost - own.cost) / count / (own.cost / freedom)
    return float(stats.f.sf(max(worth, 0.0), count, freedom)) < LEVEL


def _keeps_its_size(fit: Fit, own: _Refined, where: slice) -> bool:
    """The share of the free run's size along its own direction, against its standard error."""
    scale = np.array([p.scale for p in fit.structure.specs[where]])
    free_run = fit.theta[where] / scale
    size = float(np.linalg.norm(free_run))
    if size == 0.0:
        return True
    along = free_run / size
    share = float(along @ (own.theta[where] / scale)) / size
    column = np.zeros(fit.theta.size)
    column[where] = along / scale
    reduced = column[own.free]
    error = float(np.sqrt(max(reduced @ own.covariance @ reduced, 0.0))) / size
    return share >= LEFT_OVER or 1.0 - share <= CERTAIN * error


def _refined(sim: Simulator, structure: Structure, theta: FloatArray) -> _Refined | None:
    """Fitted to the band-passed one-step errors; None where these cannot be had."""
    specs = structure.specs
    free = np.array(
        [i for i, s in enumerate(specs) if i != BIAS and s.name not in ABRUPT], dtype=np.int64
    )
    band = _band(sim)

    def errors(moved: FloatArray) -> FloatArray:
        whole = theta.copy()
        whole[free] = moved
        return _passed(sim, band, sim.run(structure, whole).innovations)

    lower, upper = (np.array([getattr(specs[i], k) for i in free]) for k in ('lower', 'upper'))
    scale = np.array([specs[i].scale for i in free])
    found = minimise(
        errors, theta[free], lower, upper, scale, max_iterations=8, tolerance=1e-4
    )
    if not np.isfinite(found.jacobian).all() or found.cost == 0.0:
        return None
    inside = ~found.at_bound
    linear = least_squares(
        found.jacobian[:, inside], found.residual, block_of_rows(sim), oversampling(sim)
    )
    whole = theta.copy()
    whole[free] = found.theta
    rows = found.residual.size / oversampling(sim)
    return _Refined(whole, free[inside], linear.covariance, found.cost, rows)


def _band(sim: Simulator) -> FloatArray:
    rate = 1.0 / sim.data.dt
    out: FloatArray = signal.butter(2, SLOWEST_HZ, 'highpass', fs=rate, output='sos')
    if 0.4 * rate > BAND_HZ:
        out = np.vstack([out, signal.butter(4, BAND_HZ, fs=rate, output='sos')])
    return out


def _passed(sim: Simulator, band: FloatArray, innovations: FloatArray) -> FloatArray:
    """(m,) of all spans, one after the other; what leads in begins at its own level."""
    tame = np.clip(np.nan_to_num(innovations), -RUNAWAY, RUNAWAY)
    head = round(0.2 / sim.data.dt)
    parts = [tame[a + 1 : b] - np.mean(tame[a + 1 : a + 1 + head]) for a, b in sim.spans]
    return np.concatenate([signal.sosfilt(band, part) for part in parts])
