"""The acceleration that a model leaves out, and what its effects add, over signals. No drawing.

Over a short span h, (rate(t + h) - rate(t - h)) / 2h is the mean of the acceleration. The model's
acceleration along its Kalman filter's rate, averaged over the same span, is subtracted. Every
curve is the effect's own physics.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from quad_sysid.contract import FloatArray
from quad_sysid.effects.curves import Shape, signal_of
from quad_sysid.effects.events import Clocked
from quad_sysid.estimate.fit import SETTLE_S, Fit, Problem, covariance
from quad_sysid.loop.from_model import signals_at, torque_at
from quad_sysid.model.data import SLOPE_S, Span
from quad_sysid.model.effect import ActingEffect, Drive, Effect, Part, Signals, per_unit
from quad_sysid.record import INDEPENDENT_S
from quad_sysid.units import COMMAND

MIN_IN_A_BIN = 40
"""Fewer samples give no standard error, since neighbours are not independent."""
GRID = 301

OVER = {'rate': ('rate', 'rad/s'), 'angle': ('angle', 'rad'), 'command': ('lagged', COMMAND),
        'throttle': ('throttle', 'norm.'), 'battery': ('battery_v', 'V'), 'time': ('time', 's'),
        'other rate': ('other_rates', 'rad/s'), 'other command': ('other_commands', 'norm.'),
        'other angle': ('other_angles', 'rad'),
        'product of other rates': ('other_rates', '(rad/s)²')}
"""Signals over which effects are drawn, as fields of Signals, with their units."""


Label: TypeAlias = tuple[str, str]
"""A quantity and its SI unit."""


@dataclass(frozen=True)
class Binned:
    """Means over bins of equal count; (m,) each, `spread` is the standard error of the mean."""

    x: FloatArray
    mean: FloatArray
    spread: FloatArray


@dataclass(frozen=True)
class Drawn:
    """An effect over its variable: its physics with a band of 95 %."""

    over: Label
    """Label of x."""
    label: Label
    """Label of y."""
    x: FloatArray
    y: FloatArray
    band: FloatArray
    """Half width."""
    axis: str
    """Whose signal x is; '' where it is of none."""
    plain: FloatArray | None = None
    """The curve of the base alone, where it is not zero."""


@dataclass(frozen=True)
class Replay:
    """A fitted structure along the training segments."""

    problem: Problem
    fit: Fit

    @property
    def signals(self) -> Signals:
        """The signals on which effects depend."""
        return self.problem.flight.signals(self.fit.structure, self.fit.values, self.fit.rate)

    def acceleration(self, without: int | None = None) -> FloatArray:
        """(n,) mean over each cycle, rad/s², also without one effect."""
        structure, values = self.fit.structure, self.fit.values
        followed = self.followed()
        if without is not None:
            followed = {i: x for i, x in followed.items() if i != without}
            values = np.delete(values, structure.slices[without])
            structure = structure.minus(without)
        accelerations = self.problem.flight.pushed(structure, values, self.fit.rate)
        mean: FloatArray = 0.5 * (accelerations.known[0] + accelerations.known[1])
        wander = self.problem.flight.wander(structure, values, self.fit.rate)
        for column, x in zip(wander.T, followed.values(), strict=True):
            mean = mean + column * x
        return mean + accelerations.slope * self.fit.rate

    def followed(self) -> dict[int, FloatArray]:
        """Index of each wandering effect → (n,) its coefficient as the filter followed it."""
        structure = self.fit.structure
        wandering = [i for i, part in enumerate(structure.parts) if part.effect.wanders]
        first = structure.states - len(wandering)
        return {i: self.fit.prediction.states[:, first + j] for j, i in enumerate(wandering)}

    def seen(self, signal: FloatArray) -> FloatArray:
        """(n,) mean of a signal per cycle over the span of a slope, delayed as the gyro is."""
        half = _half(self.problem.data.dt)
        total = np.concatenate([[0.0], np.cumsum(self._late(signal, 0.0))])
        out = np.full(signal.size, np.nan)
        if signal.size > 2 * half:
            out[half:-half] = (total[2 * half : -1] - total[: -2 * half - 1]) / (2.0 * half)
        return out

    def at_samples(self, signal: FloatArray) -> FloatArray:
        """(n,) at the samples, a signal of the middle of each cycle, delayed as the gyro is."""
        return self._late(signal, 0.5)

    def _late(self, signal: FloatArray, cycles: float) -> FloatArray:
        flight = self.problem.flight
        index = np.arange(signal.size, dtype=float)
        return np.interp(index - cycles - flight.late / self.problem.data.dt, index, signal)

    def left_out(self) -> FloatArray:
        """(n,) acceleration that the model does not explain, rad/s²; NaN near gaps."""
        data = self.problem.data
        return _slope(data.rate, data.dt) - self.seen(self.acceleration())

    def added(self, index: int) -> FloatArray:
        """(n,) acceleration of one effect, mean over the short span, rad/s²."""
        return self.seen(self.acceleration() - self.acceleration(index))


def variables(replay: Replay) -> dict[str, FloatArray]:
    """Rate, angle (where measured) and the command behind delay and lag; (n,) each."""
    s = replay.signals
    out = {'rate': replay.at_samples(s.rate), 'command': replay.at_samples(s.lagged)}
    if s.angle is not None:
        out['angle'] = replay.at_samples(s.angle)
    return out


def weight(replay: Replay, part: Part) -> FloatArray | None:
    """(n,) acceleration per unit of the term that the effect changes; None for one with states."""
    if part.effect.states or part.effect.moves_command:
        return None
    return replay.seen(per_unit(part.effect.term, replay.signals))


@dataclass(frozen=True)
class Over:
    """What an effect is drawn over."""

    label: Label
    axis: str
    """Whose signal it is; '' where it is of none."""
    values: FloatArray
    """(n,) at the samples."""
    moved: Callable[[FloatArray], dict[str, Any]]
    """The fields of Signals that go over x (m,) with it."""


def over(replay: Replay, part: Part) -> Over:
    """The first signal of an effect, or the phase of one that repeats itself."""
    if hertz := _frequency(replay, part):
        turn = 2.0 * np.pi * hertz
        phase = (turn * replay.at_samples(replay.signals.time)) % (2.0 * np.pi)
        return Over(('phase', 'rad'), '', phase, lambda x: {'time': x / turn})
    data, signal = replay.problem.data, part.effect.signals[0]
    name = signal.rstrip(' 12') if signal.startswith('other') else signal
    field, unit = OVER[name]
    values = getattr(replay.signals, field)
    if name == 'time' and isinstance(part.effect, Shape) and not part.effect.wanders:
        values = signal_of(replay.signals, name)
    if 'other' in name:
        which, product = (*part.effect.others, 0)[0], name.startswith('product')
        axis, fill = data.other_axes[which], np.ones if product else np.zeros
        label = name if product else f'{name.removeprefix("other ")} of {axis}'
        values = values and (values[0] * values[1] if product else values[which])

        def moved(x: FloatArray) -> dict[str, Any]:
            pair = x, fill(x.size)
            return {field: pair[::-1] if which and not product else pair}
    else:
        axis = data.axis if name in ('rate', 'angle', 'command') else ''
        label = 'acting command' if name == 'command' else name

        def moved(x: FloatArray) -> dict[str, Any]:
            return {field: x}
    known = np.full_like(data.rate, np.nan) if values is None else values
    return Over((label, unit), axis, replay.at_samples(known), moved)


def _frequency(replay: Replay, part: Part) -> float:
    """Frequency at which an effect repeats itself, Hz; 0: it does not."""
    if type(part.effect).repeats_hz is Effect.repeats_hz:
        return 0.0
    index = replay.fit.structure.parts.index(part)
    where = replay.fit.structure.slices[index]
    return part.effect.repeats_hz(replay.fit.values[where])


def is_curve(part: Part) -> bool:
    """Whether an effect is a curve over a signal: no map of the command, and without memory."""
    return part.effect.term not in ('command', 'response') and not part.effect.states


def drawn(replay: Replay, index: int) -> Drawn:
    """A curve's own physics over its variable, with the band of its parameters' errors."""
    structure, theta = replay.fit.structure, replay.fit.theta
    part, where = structure.parts[index], structure.slices[index]
    if part.effect.wanders:
        inside = past_start(replay.problem.spans, replay.problem.data.dt)
        x, y = over(replay, part).values[inside], replay.followed()[index][inside]
        return Drawn(('time', 's'), LABELS['gain'], x, y, np.zeros(x.size), '')
    along = over(replay, part)
    evaluate, x = _picture(replay, part, along)

    def at(moved: FloatArray) -> FloatArray:
        return evaluate(structure.natural(moved)[where])

    raw = covariance(replay.problem, replay.fit)[where, where]
    columns = []
    for j, deviation in enumerate(np.sqrt(np.diag(raw))):
        step = np.zeros(theta.size)
        step[where.start + j] = 0.5 * deviation
        columns.append((at(theta + step) - at(theta - step)) / max(deviation, 1e-300))
    slope = np.stack(columns, axis=1)
    spread = np.sqrt(np.maximum(np.einsum('ni,ij,nj->n', slope, raw, slope), 0.0))
    plain = np.ones(GRID) if part.effect.term == 'lag' else None
    return Drawn(along.label, LABELS[part.effect.term], x, at(theta), 1.96 * spread, along.axis,
                 plain)


Evaluate = Callable[[FloatArray], FloatArray]
REST = {'throttle': 0.0, 'battery': 1.0}
UNIT = {'gain': {'drive': 1.0}, 'delay': {'change': -1.0}, 'damping': {'rate': -1.0},
        'friction': {'rate': -1.0}}
"""One unit of what an effect changes, by its term."""
LABELS = {'torque': ('torque / inertia', 'rad/s²'), 'gain': ('change of the gain', '1'),
          'damping': ('change of the damping', '1/s'),
          'friction': ('friction / inertia', 'rad/s²'),
          'delay': ('change of the delay', 's'), 'lag': ('factor of the lag', '1')}


def _picture(replay: Replay, part: Part, along: Over) -> tuple[Evaluate, FloatArray]:
    """How to evaluate an effect, and over what."""
    term, hertz = part.effect.term, _frequency(replay, part)
    inside = past_start(replay.problem.spans, replay.problem.data.dt)
    low, high = (0.0, 2.0 * np.pi) if hertz else np.nanpercentile(along.values[inside],
                                                                  [0.5, 99.5])
    x = np.linspace(low, high, GRID)
    if isinstance(part.effect, Clocked):
        return partial(part.effect.later, x / (2.0 * np.pi * hertz)), x
    if term == 'lag':
        return _lag(part, x), x
    unit = {signal: value * np.ones(GRID) for signal, value in UNIT.get(term, {}).items()}
    signals = unit | along.moved(x)

    def evaluate(p: FloatArray) -> FloatArray:
        usual = REST | dict(part.effect.usual(p, part.settings))
        return np.asarray(torque_at(ActingEffect(part, p), usual, GRID, **signals))

    return evaluate, x


def _lag(part: Part, x: FloatArray) -> Evaluate:
    """The lag's factor over its signal, whichever that is."""
    n = x.size
    drive = Drive(np.zeros((1, n)), np.ones(1), np.ones((1, n)))

    def evaluate(p: FloatArray) -> FloatArray:
        s = signals_at(ActingEffect(part, p), REST, n, sent=x, throttle=x, battery_v=x, time=x)
        return np.asarray(part.effect.actuate(drive, s, p, part.settings).lag[0])

    return evaluate


def _slope(signal: FloatArray, dt: float) -> FloatArray:
    """(n,) mean slope over 2 SLOPE_S around each sample; NaN at the ends."""
    half = _half(dt)
    out = np.full(signal.size, np.nan)
    if signal.size > 2 * half:
        out[half:-half] = (signal[2 * half :] - signal[: -2 * half]) / (2.0 * half * dt)
    return out


def _half(dt: float) -> int:
    return max(1, round(SLOPE_S / dt))


def past_start(spans: Sequence[Span], dt: float) -> npt.NDArray[np.int64]:
    """Indices inside `spans`, less the time at each start in which lag and filter settle."""
    margin = _half(dt) + round(SETTLE_S / dt)
    none = np.zeros(0, dtype=np.int64)
    return np.concatenate([none, *(np.arange(a + margin, b, dtype=np.int64) for a, b in spans)])


def binned(x: FloatArray, y: FloatArray, spans: Sequence[Span], dt: float, bins: int = 17,
           weights: FloatArray | None = None) -> Binned | None:
    """Means of y (n,) over bins of x (n,) inside `spans`; None for too few samples.

    With weights (n,) the factor by which they explain y, by least squares in each bin. The
    standard error takes blocks of INDEPENDENT_S as clusters (Liang and Zeger 1986).
    """
    f = np.ones_like(x) if weights is None else weights
    inside = past_start(spans, dt)
    samples = inside[np.isfinite(x[inside]) & np.isfinite(y[inside]) & np.isfinite(f[inside])]
    if samples.size < 4 * MIN_IN_A_BIN or np.ptp(x[samples]) <= 0.0:
        return None
    x, y, f = x[samples], y[samples], f[samples]
    edges = _edges(x, bins)
    number = np.clip(np.searchsorted(edges, x, side='right') - 1, 0, edges.size - 2)
    count = np.bincount(number, minlength=edges.size - 1).astype(float)
    power = np.maximum(np.bincount(number, f**2, minlength=count.size), 1e-300)
    keep = (count >= MIN_IN_A_BIN) & (power > 1e-6 * power.max())
    if keep.sum() < 3:
        return None
    middle = np.bincount(number, x, minlength=count.size) / np.maximum(count, 1.0)
    mean = np.bincount(number, f * y, minlength=count.size) / power
    independent = max(1, round(INDEPENDENT_S / dt))
    block = np.unique(samples // independent, return_inverse=True)[1].reshape(-1)
    sums = np.bincount(number * (int(block.max()) + 1) + block, f * (y - mean[number] * f),
                       minlength=count.size * (int(block.max()) + 1))
    spread = np.sqrt(np.sum(sums.reshape(count.size, -1) ** 2, axis=1)) / power
    return Binned(middle[keep], mean[keep], spread[keep])


def _edges(x: FloatArray, bins: int) -> FloatArray:
    """Half way between equal counts and equal widths, from the 0.5th to the 99.5th percentile."""
    share = np.linspace(0.005, 0.995, bins + 1)
    counts = np.quantile(x, share)
    widths = np.linspace(counts[0], counts[-1], bins + 1)
    return np.unique(0.5 * (counts + widths))
