"""Curves of one signal by their values at knots: where the knots lie, what the base already has.

Linear between knots that are laid where the training data lie. Which curves there are stands in
shapes.py.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.greybox.data import AxisData
from quad_sysid.greybox.structure import Effect, ParameterSpec, Prepared, Settings

KNOTS = 7
FINE_KNOTS = 21
"""Of a curve that turns often: detents, a hard stop."""
BROAD_KNOTS = 5
"""Of a curve that bends once, as drag does: three free values find it where twelve drown."""
RATE_KNOTS = 12
"""An even number: none lies at zero, where friction jumps."""


def range_of(data: AxisData, signal: FloatArray) -> tuple[float, float] | str:
    """1st and 99th percentile of the signal over the training segments."""
    values = np.concatenate([signal[a:b] for a, b in data.train])
    values = values[np.isfinite(values)]
    if values.size < 100:
        return 'the signal was not measured during training'
    low, high = np.percentile(values, [1.0, 99.0])
    if high - low < 1e-6 * max(1.0, abs(high)):
        return 'the signal does not move during training'
    return float(low), float(high)


def knots(
    found: tuple[float, float] | str, *, known: str, share: float = 0.0, count: int = KNOTS
) -> Settings | str:
    """Settings of a curve over a range, with what of it the base has `known`.

    `base`: its straight part and constant; `own`: its constant; `free`: nothing.
    """
    if isinstance(found, str):
        return found
    low, high = found
    far = max(abs(low), abs(high))
    if low < 0.0 < high and count % 2:
        low, high = -far, far  # a knot at zero, where one side may differ from the other
    warp = share * far
    if warp > 0.0:
        low, high, count = -far / (far + warp), far / (far + warp), RATE_KNOTS
    return {
        'first': low, 'step': (high - low) / (count - 1), 'count': float(count),
        'warp': warp, 'line': known,
    }


def number(settings: Settings, key: str) -> float:
    """One setting that must be a number."""
    value = settings[key]
    if not isinstance(value, float):
        raise TypeError(f'setting {key} of a curve must be a number')
    return value


def knot_positions(settings: Settings) -> FloatArray:
    """(count,) where the knots lie, in the signal's unit."""
    steps = np.arange(int(number(settings, 'count')), dtype=np.float64)
    z = np.asarray(number(settings, 'first') + number(settings, 'step') * steps)
    warp = number(settings, 'warp')
    return z if warp == 0.0 else np.asarray(warp * z / (1.0 - np.abs(z)))


def basis(settings: Settings) -> FloatArray:
    """(count, m) knot values that no straight line (or constant) contains: the base has those."""
    x = knot_positions(settings)
    known = [] if settings['line'] == 'free' else [np.ones(x.size)]
    if settings['line'] == 'base':
        known.append(x / np.abs(x).max())
    names = settings.get('besides', ())
    if isinstance(names, tuple):
        known += [NAMED_CURVES[name](x) for name in names if name in NAMED_CURVES]
    if not known:
        return np.eye(x.size)
    columns = np.stack([column / np.abs(column).max() for column in known], axis=1)
    complete: FloatArray = np.linalg.qr(columns, mode='complete')[0]
    return complete[:, columns.shape[1] :]


NAMED_CURVES: dict[str, Callable[[FloatArray], FloatArray]] = {
    'coulomb_friction': np.sign,
    'quadratic_drag': lambda x: x * np.abs(x),
    'pendulum_stiffness': np.sin,
    'cubic_stiffness': lambda x: x**3,
}
"""What a curve leaves out where the named effect is there as well."""


def besides(effect: Effect, settings: Settings, names: tuple[str, ...]) -> Prepared:
    """The curve that refines these named effects: without what they can say themselves."""
    if effect.variant == 'friction':
        constant = 'coulomb_friction' in names and settings['line'] == 'free'
        refined: Settings = {**settings, 'line': 'own'} if constant else settings
    else:
        kept = tuple(str(name) for name in names if name in NAMED_CURVES)
        refined = {**settings, 'besides': kept}
    free = basis(refined).shape[1]
    return replace(effect, parameters=effect.parameters[:free]), refined


def curve_values(p: FloatArray, settings: Settings) -> tuple[float, ...]:
    """What the compiled curve takes: z0, step, count, warp, then the knots' values."""
    head = [number(settings, key) for key in ('first', 'step', 'count', 'warp')]
    return (*head, *(basis(settings) @ p).tolist())


def knot_parameters(count: int, unit: str, scale: float) -> tuple[ParameterSpec, ...]:
    """Specs of the free coordinates of a curve, in the unit of its values."""
    return tuple(
        ParameterSpec(f'c{i}', unit, -np.inf, np.inf, (0.0,), scale) for i in range(count)
    )


def smooth(settings: Settings, size: float) -> FloatArray:
    """Rows of a weak prior: second differences of the knots' values are of this size."""
    bend: FloatArray = np.diff(np.eye(knot_positions(settings).size), 2, axis=0) @ basis(settings)
    return bend / size


def curve_of(
    effect: Effect, p: FloatArray, settings: Settings
) -> tuple[FloatArray, FloatArray]:
    """Knots x and values y of a fitted curve, for plots and for the closed loop.

    A curve of the command is the whole map (the command itself included).
    """
    x, values = knot_positions(settings), basis(settings) @ p
    return x, x + values if effect.name == 'shape:command' else values
