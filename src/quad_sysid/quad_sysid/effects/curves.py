"""The matrix: each term of the base as a smooth curve of a signal.

Terms are torque, gain, damping, friction, lag and delay; a cell is one entry of CURVES. A curve is
a Gaussian process at knots, linear between them; two smoothnesses of each compete.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from quad_sysid.contract import FloatArray
from quad_sysid.effects.couplings import clock, over_training, turns
from quad_sysid.effects.torques import TRANSITION
from quad_sysid.model.data import AxisData
from quad_sysid.model.effect import Drive, Effect, Settings, Signals, Spec, required

SLOW_MOVES = 0.01
"""Share of its mean by which a slow signal must move to support a curve."""
SMOOTH = {'smooth': (6, 0.6), 'rough': (11, 0.2)}
"""Number of knots, and correlation length as a share of the signal's range. The knots of the first
are among those of the second."""
DRIFT = {'drift': (2, 1.0)}
"""For curves over time also a straight line, which continues after the training."""
HELD = ('time', 'battery')
"""Signals that change one way: outside the training's range the curve stays constant."""
KEPT = ('damping', 'delay')
"""Terms that have no sense below zero, where a slope may lead: the curve stays constant too."""
BEYOND = 0.5
"""Share of the range by which other curves continue straight outside it."""
UNITS = {'torque': 'rad/s²', 'gain': '1', 'damping': '1/s', 'lag': '1', 'delay': 's',
         'friction': 'rad/s²'}
ACTS_ON: dict[str, tuple[str, ...]] = {
    'torque': (), 'gain': ('command',), 'damping': ('rate',), 'friction': ('rate',),
    'lag': ('command',), 'delay': ('command',),
}
"""Term → the signal that its acceleration is proportional to."""
MISSING = {'angle': 'orientation', 'battery': 'battery voltage'}
"""What the bag lacks if a signal is absent."""


def measured(data: AxisData, name: str) -> FloatArray | str:
    """(n,) a signal before the fit, for the range of its knots; or a text: why it is unusable."""
    column = int(name[-1]) - 1 if name.startswith('other') else 0
    if name.startswith('other rate'):
        return turns(data, column) or np.nan_to_num(data.other_rates[:, column])
    if name.startswith('other angle'):
        lean = data.other_angles
        return 'the bag holds no orientation' if lean is None else lean[:, column]
    others = [i for i in range(3) if i != data.index]
    if name.startswith('other command'):
        signal = data.control[:, others[column] + 1]
        if np.std(over_training(data, signal)) < 0.05 * np.std(over_training(data, data.command)):
            return f'{name} hardly moves'
        return signal
    known: dict[str, FloatArray | None] = {
        'time': clock(data),
        'angle': data.angle, 'battery': data.battery_v, 'rate': data.rate,
        'command': data.command, 'throttle': data.control[:, 0],
    }
    found = known[name]
    return f'the bag holds no {MISSING[name]}' if found is None else found


def signal_of(s: Signals, name: str) -> FloatArray:
    """A signal in a matrix's word for it, along a flight or in a free run."""
    pair = {'other rate': s.other_rates, 'other angle': s.other_angles,
            'other command': s.other_commands}
    if name.startswith('other'):
        return required(pair[name[:-2]])[int(name[-1]) - 1]
    return required({
        'rate': s.rate, 'angle': s.angle, 'throttle': s.throttle, 'battery': s.battery_v,
        'time': s.time, 'command': s.lagged,
    }[name])


def shape_name(term: str, signal: str) -> str:
    """The contract's name of a term that depends on a signal."""
    kind = signal.rstrip(' 12').replace(' ', '_')
    return f'shape:{kind}' if term in ('torque', 'friction') else f'shape:{term}:{kind}'


def per_unit(
    term: str, s: Signals, transition: float = float(np.exp(TRANSITION.centre))
) -> FloatArray:
    """Acceleration per unit of a change of one term, rad/s² per its unit in UNITS."""
    if term == 'gain':
        return s.drive
    if term == 'damping':
        return -s.rate
    if term == 'delay':
        return -s.change
    if term == 'lag':  # of a change that is slow beside the lag itself
        return s.drive - s.command
    if term == 'friction':
        return -np.tanh(s.rate / max(transition, 1e-4))
    return np.ones_like(s.rate)


class Curve(Effect):
    """One term of the base as a curve of one signal."""

    kind = 'shape'

    def __init__(self, term: str, signal: str, smoothness: str) -> None:
        self.term, self.signal, self.variant = term, signal, smoothness
        self.name = shape_name(term, signal)
        if signal.startswith('other'):
            self.variant += f' {signal[-1]}'
            self.others = (int(signal[-1]) - 1,)
        if term == 'friction':
            self.variant += ' friction'
        self.signals = (signal, *ACTS_ON[term])
        self.count, self.length = {**SMOOTH, **DRIFT}[smoothness]
        spread = {'lag': 0.5, 'delay': 0.01}.get(term)
        self.parameters = tuple(
            Spec(f'y{i}', UNITS[term], spread=spread) for i in range(self.count)
        ) + (TRANSITION,) * (term == 'friction')
        self.physics = f'{term} follows {signal} as a smooth curve'
        self.excite = f'let {signal} cover its range while the axis is excited'

    def prepare(self, data: AxisData) -> Settings | str:
        signal = measured(data, self.signal)
        if isinstance(signal, str):
            return signal
        used = over_training(data, signal)
        low, high = np.nanpercentile(used, [0.5, 99.5])
        if self.signal in ('throttle', 'battery') and high - low < SLOW_MOVES * abs(high):
            return f'{self.signal} hardly moves during training'
        if not high - low > 1e-9 * max(1.0, abs(high)):
            return f'{self.signal} does not move during training'
        if self.signal in ('rate', 'command'):
            far = max(abs(low), abs(high))
            z = np.linspace(-1.0, 1.0, self.count)
            knots = far * np.sign(z) * np.abs(z) ** 1.7  # dense around zero, where friction lives
            place = z
        else:
            knots = np.linspace(low, high, self.count)
            place = np.linspace(-1.0, 1.0, self.count)
        held = np.clip(used[np.isfinite(used)], knots[0], knots[-1])
        mean = [float(np.mean(np.interp(held, knots, hat))) for hat in np.eye(self.count)]
        if self.term == 'friction':  # the base has none
            mean = [0.0] * self.count
        elif self.signal == 'time':  # the base is what the flight ends with
            mean = [*[0.0] * (self.count - 1), 1.0]
        return {
            'knots': tuple(knots.tolist()), 'place': tuple(place.tolist()), 'mean': tuple(mean),
        }

    def _between(
        self, x: FloatArray, settings: Settings
    ) -> tuple[NDArray[np.int64], FloatArray]:
        """Index of the knot before each value, and the value's share (0..1) of the interval."""
        knots = np.array(settings['knots'])
        span = knots[-1] - knots[0]
        held = self.signal in HELD or self.term in KEPT
        below = 0.0 if held else BEYOND
        above = 1.0 if self.variant in DRIFT else below
        x = np.clip(x, knots[0] - below * span, knots[-1] + above * span)
        index = np.clip(np.searchsorted(knots, x, side='right') - 1, 0, knots.size - 2)
        return index, (x - knots[index]) / (knots[index + 1] - knots[index])

    def _along(self, x: FloatArray, p: FloatArray, settings: Settings) -> FloatArray:
        # less its mean over the training, so that the base's parameters keep their meaning
        y = p[: self.count] - float(np.dot(settings['mean'], p[: self.count]))
        index, share = self._between(x, settings)
        along: FloatArray = y[index] + share * (y[index + 1] - y[index])
        return along

    def _factor(self, s: Signals, p: FloatArray) -> FloatArray:
        return per_unit(self.term, s, float(p[-1]))

    def size(self, s: Signals, j: int, settings: Settings) -> FloatArray:
        return per_unit(self.term, s)

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray | None:
        if self.term == 'lag':
            return None
        return self._factor(s, p) * self._along(signal_of(s, self.signal), p, settings)

    def columns(
        self, s: Signals, p: FloatArray, linear: Sequence[int], settings: Settings
    ) -> FloatArray:
        """Derivatives by the values at all knots at once."""
        x = signal_of(s, self.signal)
        index, share = self._between(x, settings)
        factor = self._factor(s, p)
        out = np.zeros((x.size, self.count))
        rows = np.arange(x.size)
        out[rows, index] = 1.0 - share
        out[rows, index + 1] = share
        return (out - np.array(settings['mean'])) * factor[:, None]

    def actuate(self, data: AxisData, drive: Drive, p: FloatArray, settings: Settings) -> Drive:
        if self.term != 'lag':
            return drive
        signal = measured(data, self.signal)
        if isinstance(signal, str):
            raise ValueError(signal)  # noqa: TRY004 - why this flight cannot be used
        return replace(drive, lag=drive.lag * np.exp(self._along(signal, p, settings))[None, :])

    @property
    def moves_command(self) -> bool:
        return self.term == 'lag'

    def precision(self, settings: Settings, sizes: FloatArray) -> FloatArray:
        place = np.array(settings['place'])
        apart = (place[:, None] - place[None, :]) / (2.0 * self.length)
        kernel = np.exp(-0.5 * apart**2) + 1e-3 * np.eye(place.size)
        out = np.diag(sizes**-2.0)
        out[: place.size, : place.size] = np.linalg.inv(kernel) / sizes[0] ** 2
        return out

    def starts(self, data: AxisData, settings: Settings) -> Sequence[FloatArray]:
        more = TRANSITION.starts if self.term == 'friction' else ((),)
        return [np.r_[np.zeros(self.count), one] for one in more]

    def usual(self, p: FloatArray, settings: Settings) -> Mapping[str, float]:
        if self.signal not in ('throttle', 'battery'):
            return {}
        return {self.signal: 0.5 * float(settings['knots'][0] + settings['knots'][-1])}

    def readable(self, p: FloatArray, settings: Settings) -> dict[str, tuple[float, str]]:
        mean = float(np.dot(settings['mean'], p[: self.count]))
        return {
            spec.name: (float(v) - (mean if i < self.count else 0.0), spec.unit)
            for i, (spec, v) in enumerate(zip(self.parameters, p, strict=True))
        }


CELLS = {
    'torque': ('rate', 'angle', 'command', 'throttle', 'battery', 'time', 'other rate 1',
               'other rate 2', 'other angle 1', 'other angle 2', 'other command 1',
               'other command 2'),
    'gain': ('rate', 'angle', 'command', 'throttle', 'battery', 'time'),
    'damping': ('angle', 'command', 'throttle', 'battery', 'time'),
    'friction': ('rate', 'angle', 'command', 'throttle', 'time'),
    'lag': ('command', 'throttle', 'battery', 'time'),
    'delay': ('throttle', 'battery', 'time'),
}
"""Term → the signals that it may follow."""

CURVES = tuple(
    Curve(term, signal, smoothness)
    for term, signals in CELLS.items() for signal in signals
    for smoothness in ((*SMOOTH, *DRIFT) if signal == 'time' and term != 'friction' else SMOOTH)
)
