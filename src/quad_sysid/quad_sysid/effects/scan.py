"""What the residual depends on: every signal at hand, as a curve, as a gain, with memory.

A torque that follows a known signal changes the free-run error linearly, so hundreds of signals
are judged without a fit: their responses are regressed on the training errors beside the base's
own Jacobian, blocked cross-validation as everywhere. Nothing here names an effect.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.effects.crossval import Comparison, compare, folds_of
from quad_sysid.effects.probes import Probe, probes_of
from quad_sysid.greybox import kernels
from quad_sysid.greybox.data import AxisData
from quad_sysid.greybox.fit import Fit
from quad_sysid.greybox.simulate import Simulator
from quad_sysid.greybox.structure import Effect, ParameterSpec, Settings, Term

RIDGE = 1e-3
"""Share of its own strength by which each probe is held back."""
CHANCE = 0.01
"""Level of a dependence, shared out over the groups."""
LEAST = 0.10
"""A dependence must lower the cross-validated error by this share to be spoken of."""


@dataclass(frozen=True)
class Dependence:
    """What cross-validation says of the residual's dependence on one group of signals."""

    name: str
    score: float
    """Cross-validated RMS error with the group, rad/s."""
    comparison: Comparison
    """Against the same model without it."""


def scan(sim: Simulator, fit: Fit) -> tuple[Dependence, ...]:
    """Every group of probes against the fitted structure on its training windows, best first."""
    plain = _cross_validated(sim, fit, np.zeros((*fit.errors.shape, 0)))
    out = []
    for name, members in _probes(sim, fit).items():
        errors = _cross_validated(sim, fit, responses(sim, fit, members))
        out.append(
            Dependence(
                name, float(np.sqrt(np.mean(errors))),
                compare(plain, errors, sim.windows, sim.data.dt),
            )
        )
    return tuple(sorted(out, key=lambda one: one.score))


def strongest(fit: Fit, found: Sequence[Dependence]) -> Dependence | None:
    """The foremost dependence that is beyond chance and worth its name, if any."""
    for one in found:
        if one.score < (1.0 - LEAST) * fit.rms and one.comparison.p_value < CHANCE / len(found):
            return one
    return None


def confirmed(train: Simulator, held_out: Simulator, fit: Fit, name: str) -> Comparison:
    """Whether a dependence learnt on the training windows lowers the error on held-out ones."""
    columns = responses(train, fit, _probes(train, fit)[name])
    free = np.flatnonzero(~fit.at_bound)
    j = np.concatenate([fit.jacobian[:, :, free], columns], axis=2)
    flat = j.reshape(-1, j.shape[2])
    size = np.linalg.norm(flat, axis=0)
    size[size == 0.0] = 1.0
    ridge = np.r_[np.full(free.size, 1e-12), np.full(columns.shape[2], RIDGE)]
    left = (flat / size).T @ (flat / size) + np.diag(ridge)
    shift = -np.linalg.solve(left, (flat / size).T @ fit.errors.ravel()) / size
    unseen = _held_out_fit(held_out, fit)
    columns = responses(held_out, unseen, _probes(held_out, unseen)[name])
    moved = np.concatenate([unseen.jacobian[:, :, free], columns], axis=2) @ shift
    return compare(
        np.mean(unseen.errors**2, axis=1), np.mean((unseen.errors + moved) ** 2, axis=1),
        held_out.windows, held_out.data.dt,
    )


def _held_out_fit(sim: Simulator, fit: Fit) -> Fit:
    """The same parameters with errors and Jacobian on other windows."""
    errors = sim.run(fit.structure, fit.theta).errors
    scale = np.array([spec.scale for spec in fit.structure.specs])
    scale[0] = max(0.1 * abs(float(fit.theta[0])), 1e-6)
    columns = []
    for i in range(fit.theta.size):
        moved = fit.theta.copy()
        moved[i] += 1e-3 * scale[i]
        columns.append((sim.run(fit.structure, moved).errors - errors) / (1e-3 * scale[i]))
    return replace(fit, errors=errors, jacobian=np.stack(columns, axis=2))


def _probes(sim: Simulator, fit: Fit) -> dict[str, list[Probe]]:
    """Probes along the motion as the model itself runs it inside the windows."""
    data = sim.data
    rate = np.nan_to_num(data.rate)
    angle = None if data.angle is None else data.angle.copy()
    for start, error in zip(sim.windows.starts, fit.errors, strict=True):
        inside = slice(start, start + sim.windows.length)
        rate[inside] += error
        if angle is not None:
            before = angle[max(start - 1, 0)]
            angle[inside] = before + data.dt * np.cumsum(rate[inside])
    return probes_of(data, fit.theta, rate, angle)


def responses(sim: Simulator, fit: Fit, members: Sequence[Probe]) -> FloatArray:
    """(windows, length, m) change of the free-run error by each probe's torque of unit size."""
    columns = []
    structure = fit.structure
    base = sim.run(structure, fit.theta).errors
    for probe in members:
        effect = _probe_effect(probe.signal)
        step = 1e-3 * max(float(np.sqrt(np.mean(base**2))), 1e-6)
        moved = sim.run(structure.with_effect(effect, {}), np.r_[fit.theta, step]).errors
        columns.append((moved - base) / step)
    return np.stack(columns, axis=2)


def _probe_effect(signal: FloatArray) -> Effect:
    """A torque that follows a signal (n,) in rad/s²."""

    def torque(_: AxisData, p: FloatArray, __: Settings) -> Term:
        return Term(kernels.SIGNAL, (p[0],), signal)

    return Effect(
        name='probe', signals=(), physics='', excite='', torque=torque,
        parameters=(ParameterSpec('size', 'rad/s²', -np.inf, np.inf, (0.0,), 1.0),),
    )


def _cross_validated(sim: Simulator, fit: Fit, columns: FloatArray) -> FloatArray:
    """(windows,) held-out squared errors of the linearised model with `columns` added."""
    free = np.flatnonzero(~fit.at_bound)
    j = np.concatenate([fit.jacobian[:, :, free], columns], axis=2)
    gram = np.einsum('wlp,wlq->wpq', j, j)
    score = np.einsum('wlp,wl->wp', j, fit.errors)
    size = np.sqrt(np.maximum(np.einsum('wpp->p', gram), 1e-300))
    ridge = np.r_[np.full(free.size, 1e-12), np.full(columns.shape[2], RIDGE)]
    out = np.empty(fit.errors.shape[0])
    for held, kept in folds_of(sim.windows, sim.data.dt):
        left = gram[kept].sum(axis=0) / np.outer(size, size) + np.diag(ridge)
        right = score[kept].sum(axis=0) / size
        shift = -np.linalg.solve(left, right) / size
        out[held] = np.mean((fit.errors[held] + j[held] @ shift) ** 2, axis=1)
    return out
