"""The angular acceleration that a model leaves out, over what it may depend on. No drawing.

Over a short span h the identity (rate(t + h) - rate(t - h)) / 2h = mean of the acceleration holds
without any filter; the model's own acceleration is averaged alike and taken off. A model that
lacks nothing leaves noise about zero whatever the rate, the angle or the command are.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.greybox import drive
from quad_sysid.greybox.data import AxisData, Span
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
    out = {'rate': data.rate, 'command': acting(data, base)}
    if data.angle is not None:
        out['angle'] = data.angle
    return out


def acting(data: AxisData, base: Sequence[Parameter]) -> FloatArray:
    """(n,) mean over the short span of the command behind delay, lag and gyro filter; NaN at ends.

    From the exact drive response (greybox/drive.py), whose slope it is.
    """
    values = {p.name: p.value for p in base}
    known = drive.response(
        data.command, data.stretches, values['lag'], values['delay'], data.gyro_filter_hz,
        data.dt, data.realisation,
    )
    return _slope(known[4] if data.gyro_filter_hz is not None else known[0], data.dt)


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
    """Signal that the effect depends on, and its angular acceleration, rad/s², over it.

    A curve of the command is what it adds to gain * command. None for effects of another kind.
    """
    kind, _, name = effect.name.partition(':')
    entry = CURVES.get(effect.name)
    if entry is not None:
        name, function = entry[0], entry[1]({p.name: p.value for p in effect.parameters}, model.dt)
    elif kind == 'shape' and name in UNITS:
        x, y = (np.asarray(effect.settings.get(k, ()), dtype=float) for k in ('knots', 'values'))
        if x.ndim != 1 or x.size < 2 or x.shape != y.shape:
            return None
        function = _table(x, y)
    else:
        return None
    if name == 'command':
        gain = model.value('gain')
        return name, lambda u: gain * (function(u) - u)
    return name, function


def _table(x: FloatArray, y: FloatArray) -> Function:
    return lambda at: np.asarray(np.interp(at, x, y))


def left_out(
    data: AxisData, base: Sequence[Parameter], effects: Sequence[tuple[str, Function]] = ()
) -> FloatArray:
    """(n,) rad/s², what base and effects do not explain; NaN near gaps."""
    values = {p.name: p.value for p in base}
    at = variables(data, base)
    rest = values['bias'] - values['damping'] * data.rate
    averaged = values['gain'] * at['command']
    for name, function in effects:
        if name == 'command':  # already a mean over the span
            averaged = averaged + function(at[name])
        elif name in at:
            rest = rest + function(at[name])
    return _slope(data.rate, data.dt) - averaged - _mean(rest, data.dt)


def binned(
    x: FloatArray, y: FloatArray, spans: Sequence[Span], dt: float, bins: int = BINS
) -> Binned | None:
    """Means of y over bins of x inside `spans`; None where too little is known.

    The standard error takes blocks of BLOCK_S as clusters (Liang and Zeger 1986).
    """
    margin = _half(dt) + round(0.3 / dt)
    if not spans:
        return None
    inside = np.concatenate([np.arange(a + margin, max(a + margin, b)) for a, b in spans])
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
