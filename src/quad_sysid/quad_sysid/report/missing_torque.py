"""The angular acceleration that a model leaves out, over what it may depend on. No drawing.

Over a short span h the identity (rate(t + h) - rate(t - h)) / 2h = mean of the acceleration holds
without any filter; the model's own acceleration is averaged alike and taken off. A model that
lacks nothing leaves noise about zero whatever the rate, the angle or the command are.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from quad_sysid.contract import FloatArray
from quad_sysid.effects.discover import Discovery
from quad_sysid.greybox import drive, kernels
from quad_sysid.greybox.data import AxisData, Span
from quad_sysid.greybox.structure import Structure, Term
from quad_sysid.loop.from_model import CURVES
from quad_sysid.model import AxisModel, EffectEstimate, Parameter

HALF_SPAN_S = 0.025
BLOCK_S = 1.0
BINS = 17
LEAST_IN_A_BIN = 40

Function = Callable[[FloatArray], FloatArray]
UNITS = {'rate': 'rad/s', 'angle': 'rad', 'command': 'norm.'}


@dataclass(frozen=True)
class Binned:
    """Means over bins of equal count; (m,) each, `spread` is the standard error of the mean."""

    x: FloatArray
    mean: FloatArray
    spread: FloatArray


def variables(data: AxisData, base: Sequence[Parameter]) -> dict[str, FloatArray]:
    """Rate and angle as measured, and the command as it acts, behind delay and lag; (n,) each."""
    out = {'rate': data.rate, 'command': acting(data, base, data.command)}
    if data.angle is not None:
        out['angle'] = data.angle
    return out


def acting(data: AxisData, base: Sequence[Parameter], command: FloatArray) -> FloatArray:
    """(n,) mean over the short span of a command behind delay, lag and gyro filter; NaN at ends.

    From the exact drive response (greybox/drive.py), whose slope it is.
    """
    values = {p.name: p.value for p in base}
    known = drive.response(
        command, data.stretches, values['lag'], values['delay'], data.gyro_filter_hz,
        data.dt, data.realisation,
    )
    return _slope(known[4] if data.gyro_filter_hz is not None else known[0], data.dt)


def contributions(found: Discovery, model: AxisModel) -> tuple[FloatArray, ...]:
    """(n,) rad/s² that each effect of the model adds, mean over the short span; NaN at ends.

    Empty where the model has no effects or is not the one that discovery chose.
    """
    structure, theta, data = found.chosen.structure, found.chosen.theta, found.data
    if [e.name for e in structure.effects] != [e.name for e in model.effects]:
        return ()
    sim = found.chosen_simulator
    whole = acting(data, model.base, sim.commands(structure, theta))
    out = []
    for i, (effect, estimate, where) in enumerate(
        zip(structure.effects, model.effects, structure.slices(), strict=True)
    ):
        added = np.zeros(data.rate.size)
        if effect.command is not None:
            others = [k for k in range(len(model.effects)) if k != i]
            less = Structure(
                tuple(structure.effects[k] for k in others),
                tuple(structure.settings[k] for k in others),
            )
            keep = np.ones(theta.size, dtype=bool)
            keep[where] = False
            without = acting(data, model.base, sim.commands(less, theta[keep]))
            added = model.value('gain') * (whole - without)
        if effect.torque is not None:
            term = effect.torque(data, theta[where], structure.settings[i])
            added = added + _mean(_torque(data, term, curve(estimate, model)), data.dt)
        out.append(added)
    return tuple(out)


def _torque(
    data: AxisData, term: Term, shape: tuple[str, Function] | None
) -> FloatArray:
    """(n,) rad/s² of one term at the measured rate and angle."""
    if term.signal is not None:
        if term.code == kernels.SIGNAL:
            return term.values[0] * term.signal
        return -term.values[0] * data.rate * term.signal
    if shape is None:
        return np.full(data.rate.size, np.nan)
    at = data.rate if shape[0] == 'rate' else data.angle
    return np.full(data.rate.size, np.nan) if at is None else shape[1](at)


def _slope(signal: FloatArray, dt: float) -> FloatArray:
    """(n,) mean slope over 2 HALF_SPAN_S around each sample; NaN at the ends."""
    half = _half(dt)
    out = np.full(signal.size, np.nan)
    if signal.size > 2 * half:
        out[half:-half] = (signal[2 * half :] - signal[: -2 * half]) / (2.0 * half * dt)
    return out


def _mean(signal: FloatArray, dt: float) -> FloatArray:
    """(n,) mean over the same span by the trapezoidal rule; NaN at the ends."""
    half = _half(dt)
    weights = np.full(2 * half + 1, 0.5 / half)
    weights[[0, -1]] *= 0.5
    out = np.full(signal.size, np.nan)
    if signal.size > 2 * half:
        out[half:-half] = np.convolve(signal, weights, mode='valid')
    return out


def _half(dt: float) -> int:
    return max(1, round(HALF_SPAN_S / dt))


def curve(effect: EffectEstimate, model: AxisModel) -> tuple[str, Function] | None:
    """`rate` or `angle`, and the effect's angular acceleration, rad/s², over it.

    None for effects that are no curve of one of these two.
    """
    kind, _, name = effect.name.partition(':')
    entry = CURVES.get(effect.name)
    if entry is not None and entry[0] in ('rate', 'angle'):
        return entry[0], entry[1]({p.name: p.value for p in effect.parameters}, model.dt)
    if kind == 'shape' and name in ('rate', 'angle'):
        x, y = (np.asarray(effect.settings.get(k, ()), dtype=float) for k in ('knots', 'values'))
        if x.ndim == 1 and x.size > 1 and x.shape == y.shape:
            return name, _table(x, y)
    return None


def _table(x: FloatArray, y: FloatArray) -> Function:
    return lambda at: np.asarray(np.interp(at, x, y))


def left_out(
    data: AxisData, base: Sequence[Parameter], added: Sequence[FloatArray] = ()
) -> FloatArray:
    """(n,) rad/s², what the base and the `contributions` do not explain; NaN near gaps."""
    values = {p.name: p.value for p in base}
    rest = values['bias'] - values['damping'] * data.rate
    given = values['gain'] * acting(data, base, data.command) + _mean(rest, data.dt)
    for one in added:
        given = given + one
    return _slope(data.rate, data.dt) - given


def settled(spans: Sequence[Span], dt: float) -> npt.NDArray[np.int64]:
    """Indices inside `spans`, less the 0.3 s at each start in which lag and filter settle."""
    margin = _half(dt) + round(0.3 / dt)
    none = np.zeros(0, dtype=np.int64)
    return np.concatenate([none, *(np.arange(a + margin, b, dtype=np.int64) for a, b in spans)])


def binned(
    x: FloatArray, y: FloatArray, spans: Sequence[Span], dt: float, bins: int = BINS
) -> Binned | None:
    """Means of y over bins of x inside `spans`; None where too little is known.

    The standard error takes blocks of BLOCK_S as clusters (Liang and Zeger 1986).
    """
    inside = settled(spans, dt)
    good = inside[np.isfinite(x[inside]) & np.isfinite(y[inside])]
    if good.size < 4 * LEAST_IN_A_BIN or np.ptp(x[good]) <= 0.0:
        return None
    x, y = x[good], y[good]
    edges = _edges(x, bins)
    number = np.clip(np.searchsorted(edges, x, side='right') - 1, 0, edges.size - 2)
    count = np.bincount(number, minlength=edges.size - 1).astype(float)
    keep = count >= LEAST_IN_A_BIN
    if keep.sum() < 3:
        return None
    safe = np.maximum(count, 1.0)
    middle = np.bincount(number, x, minlength=count.size) / safe
    mean = np.bincount(number, y, minlength=count.size) / safe
    block = np.unique(good // max(1, round(BLOCK_S / dt)), return_inverse=True)[1].reshape(-1)
    sums = np.bincount(number * (int(block.max()) + 1) + block, y - mean[number],
                       minlength=count.size * (int(block.max()) + 1))
    spread = np.sqrt(np.sum(sums.reshape(count.size, -1) ** 2, axis=1)) / safe
    return Binned(middle[keep], mean[keep], spread[keep])


def _edges(x: FloatArray, bins: int) -> FloatArray:
    """Half way between equal counts and equal widths, from the 0.5th to the 99.5th percentile."""
    share = np.linspace(0.005, 0.995, bins + 1)
    counts = np.quantile(x, share)
    widths = np.linspace(counts[0], counts[-1], bins + 1)
    return np.unique(0.5 * (counts + widths))
