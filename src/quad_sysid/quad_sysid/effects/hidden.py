"""Effects with a hidden state: it swings, relaxes, builds up or remembers what a signal was."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
from scipy.linalg import expm
from scipy.signal import lfilter

from quad_sysid.contract import AXES, FloatArray
from quad_sysid.effects.constants import SLOW_MOVES
from quad_sysid.effects.curves import COUNT, Shape, Smooth, over_knots, signal_of
from quad_sysid.effects.torques import Torque
from quad_sysid.model import laws
from quad_sysid.model.data import AxisData, Span
from quad_sysid.model.effect import (
    UNITS,
    Effect,
    Settings,
    Signals,
    Spec,
    per_unit,
    required,
    size_of_term,
)
from quad_sysid.model.structure import BASE
from quad_sysid.model.traced import Traced, operation_of

System = tuple[FloatArray, FloatArray]
"""A (m, m) and B (m,) of x' = A x + B input."""
LAGUERRE = 8
"""Number of states of a linear response."""
DEGREE = 4
"""Highest degree of polynomials over a signal."""
FADES = 0.7
"""Size of a coefficient beside that of one degree less: the less a form bends, the likelier."""
EDGE = 1.1
"""A polynomial goes on for a tenth of its half range, and is constant from there on."""
GYRO_MOTORS = 4
"""Motors for which this is stated: its number of coefficients is fixed."""
GYRO_TERMS = tuple(itertools.product(range(GYRO_MOTORS), range(1, DEGREE + 1)))
"""Motor and degree of each term that a gyro may show."""


def polynomials(x: FloatArray) -> FloatArray:
    """(…, DEGREE + 1) Legendre polynomials of x (…), constant beyond EDGE."""
    x = np.clip(x, -EDGE, EDGE)
    rows = [np.ones_like(x), x]
    for k in range(1, DEGREE):
        rows.append(((2 * k + 1) * x * rows[k] - k * rows[k - 1]) / (k + 1))
    return np.stack(rows, axis=-1)


def ring(frequency_hz: float, damping_ratio: float) -> System:
    """A second-order mode z'' + 2 d w z' + w² z = w² u; its states are z and z' / w."""
    w = 2.0 * math.pi * frequency_hz
    return np.array([[0.0, w], [-w, -2.0 * damping_ratio * w]]), np.array([0.0, w])


def behind_lag(lag_s: float) -> System:
    """A first-order lag of lag_s, whose state is the recent mean of its input."""
    return np.array([[-1.0 / lag_s]]), np.array([1.0 / lag_s])


def step_of(a: FloatArray, b: FloatArray, dt: float) -> System:
    """The system's exact step over `dt` s with a held input."""
    return _step(a.tobytes(), b.tobytes(), dt)


@lru_cache(maxsize=1024)
def _step(rows: bytes, column: bytes, dt: float) -> System:
    # derivatives by all other parameters ask for the same step again
    b = np.frombuffer(column)
    m = b.size
    block = np.zeros((m + 1, m + 1))
    block[:m, :m], block[:m, m] = np.frombuffer(rows).reshape(m, m) * dt, b * dt
    e = expm(block)
    return np.ascontiguousarray(e[:m, :m]), np.ascontiguousarray(e[:m, m])


def followed(stretches: Sequence[Span], moving: FloatArray, a: FloatArray, b: FloatArray,
             out: FloatArray) -> None:
    """States of a step (a, b) into `out` (m, n), in each stretch from its first column on."""
    moving = np.ascontiguousarray(moving)
    for start, stop in stretches:
        laws.linear_states(moving, a, b, start, stop, out)


class Linked(Effect):
    """Hidden states x' = A x + B input of each of its inputs, by default behind a lag of p[0]."""

    def system(self, p: FloatArray, s: Signals) -> System:
        """A and B from the parameters and what the signals say of base and cycle."""
        return behind_lag(float(p[0]))

    def inputs(self, s: Signals, settings: Settings) -> Sequence[FloatArray]:
        """The inputs of the states, each (n,)."""
        return (s.rate,)

    def _step(self, s: Signals, p: FloatArray) -> System:
        return step_of(*self.system(p, s), s.dt)

    def trace(self, s: Signals, p: FloatArray, settings: Settings, stretches: Sequence[Span],
              start_states: FloatArray | None = None) -> FloatArray:
        out = self.begin(s, p, settings) if start_states is None else start_states
        a, b = self._step(s, p)
        for signal, states in zip(self.inputs(s, settings), out.reshape(-1, b.size, out.shape[1]),
                                  strict=True):
            followed(stretches, signal, a, b, states)
        return out

    def advance(self, x: FloatArray, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        a, b = self._step(s, p)
        return np.concatenate([
            np.tensordot(a, x[i * b.size : (i + 1) * b.size], 1) + np.multiply.outer(b, signal)
            for i, signal in enumerate(self.inputs(s, settings))
        ])


class Linear(Linked, Torque):
    """A torque of such states."""

    kind = 'mode'

    def size(self, s: Signals, j: int, settings: Settings) -> FloatArray:
        return s.rate


class Summing(Linear):
    """A linear response whose states sum up the rate."""

    def size(self, s: Signals, j: int, settings: Settings) -> FloatArray:
        return 0.5 * s.rate

    def inputs_in_flight(
        self, s: Signals, followed: Callable[[FloatArray], FloatArray]
    ) -> Signals:
        return replace(s, rate=followed(s.rate))


class Hysteresis(Effect):
    """Dahl's friction, which builds up over an angle after each reversal."""

    name = 'mode:hysteresis'
    kind = 'mode'
    size = size_of_term
    signals = ('rate', 'history')
    states = 1
    parameters = (
        Spec('reach', 'rad', spread=1.0, centre=math.log(0.05), log=True,
             starts=(0.01, 0.03, 0.1, 0.3)),
        Spec('torque', 'rad/s²', positive=True),
    )

    def advance(self, x: FloatArray, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        sign = np.where(s.rate > 0.0, 1.0, -1.0)
        return sign + (x - sign) * np.exp(-np.abs(s.rate) * s.dt / max(float(p[0]), 1e-4))

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        return -p[1] * required(s.hidden)[0]


def each_ahead(name: str, arrays: Sequence[FloatArray], numbers: Sequence[float],
               results: int) -> FloatArray:
    """(results, …) a compiled law of one cycle on arrays (…) of one shape, or it is noted."""
    if any(isinstance(x, Traced) for x in arrays):
        return np.stack(operation_of(name, arrays, numbers, results))
    rows = np.broadcast_arrays(*arrays)
    out = np.empty((results, rows[0].size))
    law = laws.all_loose_ahead if name == 'loose' else laws.all_yielded
    law(*(np.ascontiguousarray(x.ravel()) for x in rows), *numbers, out)
    return out.reshape(results, *rows[0].shape)


PULL = Spec('pull', '1/s²', spread=1.0, centre=math.log(60.0), log=True,
            starts=(20.0, 60.0, 180.0))
REACH = Spec('reach', 'rad', spread=1.2, centre=math.log(0.1), log=True,
             starts=(0.02, 0.07, 0.2, 0.6))
SPRING = Spec('frequency', 'Hz', spread=1.0, centre=0.0, log=True,
              starts=(0.1, 0.5, 1.0, 2.0, 4.0, 8.0))
DAMPER = Spec('damping', '1/s', spread=1.0, centre=math.log(2.0), log=True, starts=(0.7, 3.0))
WEIGHT, INERTIA = Spec('weight', 'rad/s²'), Spec('inertia', '1', spread=0.3)
LOADS = {
    'leaning': (('rate', 'history', 'angle'), (SPRING, DAMPER, PULL, WEIGHT, INERTIA)),
    'turning': (('rate', 'history'), (SPRING, DAMPER, REACH, WEIGHT, INERTIA)),
    'driven': (('command', 'history'), (  # a mount: stiffer, and of all the drive
        replace(SPRING, centre=math.log(8.0), starts=(4.0, 8.0, 16.0)),
        replace(DAMPER, centre=math.log(10.0), starts=(7.0, 30.0)),
        replace(REACH, centre=math.log(0.01), starts=(0.003, 0.01, 0.03)), WEIGHT,
        replace(INERTIA, spread=1.0),
    )),
}
"""What moves the load → the signals and the parameters."""


class Load(Effect):
    """A mass on a damped spring between two stops, by its weight and what it does to its mount.

    Gravity pulls it to the side as the aircraft leans (rig), or the aircraft turns beneath it.
    The spring hardens towards the stops, w² z / (1 - z²) with z = -1 to 1, as finitely extensible
    ones do (Warner 1972); without a spring it is a loose load. What the drive moves behind such a
    spring, a gyro on its pads or an arm, gets its acceleration through it.
    """

    kind = 'mode'
    states = 2
    size = size_of_term

    def __init__(self, moved: str) -> None:
        self.moved = moved
        self.name, self.variant = ('mode:soft_mount', '') if moved == 'driven' \
            else ('mode:loose_load', moved)
        self.signals, self.parameters = LOADS[moved]
        self.axes = AXES if moved == 'leaning' else ()

    def _inputs(self, s: Signals, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """What pulls the mass and how its mount moves, per unit of z."""
        zero, reach = np.zeros_like(s.rate), max(float(p[2]), 1e-4)
        if self.moved == 'leaning':
            return -p[2] * np.sin(required(s.angle)), zero
        return (zero, s.rate / reach) if self.moved == 'turning' else (s.drive / reach, zero)

    def begin(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        moved = self._inputs(s, p)[1]
        return np.stack([np.zeros_like(moved), moved])

    def _ahead(self, x: FloatArray, s: Signals, p: FloatArray) -> FloatArray:
        """(3, …) the states a cycle later, and what pushed the mass meanwhile."""
        w = 2.0 * math.pi * float(p[0])
        pull, moved = self._inputs(s, p)
        return each_ahead('loose', (pull, moved, x[0], x[1]), (w, float(p[1]), s.dt), 3)

    def advance(self, x: FloatArray, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        return self._ahead(x, s, p)[:2]

    def _per_unit(self, s: Signals, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(…,) acceleration per unit of its weight, and of its inertia."""
        hidden = required(s.hidden)
        z, acceleration = hidden[0], self._ahead(hidden, s, p)[2]
        ratio = float(p[2]) if self.moved != 'leaning' else 1.0 / float(p[2])
        directly = s.drive if self.moved == 'driven' else 0.0
        return z, -(directly + ratio * acceleration)  # ratio: rad or s² per unit of z

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        weight, inertia = self._per_unit(s, p)
        return p[3] * weight + p[4] * inertia

    def columns(self, s: Signals, p: FloatArray, linear: Sequence[int],
                settings: Settings) -> FloatArray:
        return np.stack(self._per_unit(s, p), axis=-1)[..., np.array(linear) - 3]


class Yielding(Effect):
    """A state that flows off by a cubic law: the simplest that yields, leaks to one side or snaps.

    x' = push - (slope x + lean x² + x³) / time_constant; its torque is -T x.
    The cusp's normal form (Thom 1972; Strogatz, Nonlinear Dynamics and Chaos, 3.6). With slope > 0
    a spring on a damper that gives way, with lean a valve, with slope < 0 two places of rest.
    """

    name = 'mode:yielding'
    kind = 'mode'
    states = 1
    size = size_of_term

    def __init__(self, moved: str) -> None:
        self.moved = self.variant = moved
        drive, unit, usual = {'turning': ('rate', 'rad', 0.1), 'leaning': ('angle', 'rad', 0.1),
                              'driven': ('command', '1', 0.05)}[moved]
        self.signals = (drive, 'history')
        self.parameters = (
            Spec('reach', unit, spread=1.2, centre=math.log(usual), log=True,
                 starts=(0.2 * usual, 0.7 * usual, 2.0 * usual)),
            Spec('time_constant', 's', spread=1.5, centre=math.log(0.3), log=True,
                 starts=(0.03, 0.2, 1.2)),
            # pairs: yields, snaps, leaks to either side
            Spec('slope', '1', spread=2.0, starts=(0.3, -1.0, 1.0, 1.0)),
            Spec('lean', '1', spread=1.0, starts=(0.0, 0.0, 1.5, -1.5)),
            Spec('torque', 'rad/s²'),
        )

    def starts(self, data: AxisData, settings: Settings) -> Sequence[FloatArray]:
        reach, time_constant, *shape = (spec.starts for spec in self.parameters[:4])
        return [
            np.array([*values, *pair, 0.0])
            for values in itertools.product(reach, time_constant)
            for pair in zip(*shape, strict=True)
        ]

    def _flow(self, s: Signals, p: FloatArray) -> tuple[FloatArray, float, float, float]:
        """Push, slope, lean and 1 / time constant."""
        reach, flow = max(float(p[0]), 1e-4), 1.0 / max(float(p[1]), 1e-3)
        push = s.rate / reach if self.moved == 'turning' else flow / reach * (
            required(s.angle) if self.moved == 'leaning' else s.lagged
        )
        return push, float(p[2]), float(p[3]), flow

    def advance(self, x: FloatArray, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        push, *law = self._flow(s, p)
        return each_ahead('yielded', (x[0], push), (*law, s.dt), 1)

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        return -p[4] * required(s.hidden)[0]


class Memory(Shape, Linear):
    """One term of the base follows what a signal has lately been, not what it is.

    Airspeed follows the lean. What a signal's power heats is cold when a flight begins, and the
    base's parameters are those of the usual power; the power of the time is constant.
    """

    states = 1

    def __init__(self, term: str, signal: str) -> None:
        self.leans = 'angle' in signal
        self.parameters = (
            Spec('time_constant', 's', spread=1.2, centre=math.log(3.0), log=True,
                 starts=(0.3, 1.5, 8.0, 40.0)),
            Spec('change', UNITS[term]),
        )
        self.shaped(term, signal, 'memory', 'history')

    def prepare(self, data: AxisData) -> Settings | str:
        signal = data.signal(self.signal)
        if isinstance(signal, str):
            return signal
        if self.signal == 'time':
            return {}
        used = data.training(signal)
        if not np.nanstd(used) > SLOW_MOVES * abs(np.nanmean(used)):
            return f'{self.signal} hardly moves during training'
        usual = float(np.nanmean(used)) if self.leans else 0.0
        return {'unit': float(np.nanmean((used - usual) ** 2)), 'rest': usual}

    def inputs(self, s: Signals, settings: Settings) -> Sequence[FloatArray]:
        return (self._push(signal_of(s, self.signal), settings),)

    def steady(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        return np.stack(self.inputs(s, settings)) if self.leans else np.ones((1, *s.time.shape))

    def factors(self, p: FloatArray, settings: Settings) -> FloatArray:
        """Factors on what it changes, cold and warm."""
        return 1.0 + np.array([-p[1], 0.0, p[1]])

    def _push(self, signal: FloatArray, settings: Settings) -> FloatArray:
        if self.signal == 'time':
            return np.ones_like(signal)
        unit, deviation = settings['unit'], signal - settings['rest']
        return deviation / math.sqrt(unit) if self.leans else deviation**2 / unit

    def states_at_start(self, data: AxisData, p: FloatArray, settings: Settings) -> FloatArray:
        # from the start of the flight on, of which a fit sees segments and a gap ends a stretch
        flight, rows = data.whole
        signal = flight.signal(self.signal)
        if isinstance(signal, str):
            raise ValueError(signal)  # noqa: TRY004 - why this flight cannot be used
        if self.signal == 'command':  # the lag matters little here, and is not known
            keep = math.exp(-data.dt / math.exp(BASE[1].centre))
            signal = lfilter([1.0 - keep], [1.0, -keep], signal)
        push = self._push(np.nan_to_num(signal), settings)
        out = np.zeros((1, push.size))
        step = step_of(*behind_lag(float(p[0])), data.dt)
        followed(flight.flights or ((0, push.size),), push, *step, out)
        return np.ascontiguousarray(out[:, rows])

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        x = required(s.hidden)[0] - (not self.leans)
        return p[1] * x * per_unit(self.term, s)


class MemoryCurve(Smooth, Memory):
    """A smooth curve over what a signal has lately been (Wiener 1958)."""

    first = 1

    def __init__(self, term: str, signal: str) -> None:
        super().__init__(term, signal)
        self.parameters = (self.parameters[0], *self.valued(Spec('y', UNITS[term])))
        self.shaped(term, signal, 'memory curve', 'history')

    def prepare(self, data: AxisData) -> Settings | str:
        settings = super().prepare(data)
        if isinstance(settings, str):
            return settings
        quick = np.array(self.parameters[0].starts[:1])
        training = data.training(self.states_at_start(data, quick, settings)[0])
        low, high = np.nanpercentile(training, [0.5, 99.5])
        usual, knots = 0.0 if self.leans else 1.0, np.linspace(low, high, COUNT)
        return {
            **settings, 'knots': tuple(knots.tolist()),
            'mean': tuple(float(np.interp(usual, knots, hat)) for hat in np.eye(COUNT)),
        }

    def factors(self, p: FloatArray, settings: Settings) -> FloatArray:
        return 1.0 + over_knots(np.array(settings['knots']), p[1:], settings)

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        curve = over_knots(required(s.hidden)[0], p[1:], settings)
        return curve * per_unit(self.term, s)


class Shown(Linked, Shape):
    """The gyro shows a curve of each motor's speed beside the rate; its change acts as a torque.

    Vibration that it rectifies grows with the speed of the motors, most with that of the worst
    one; currents shift its ground. Polynomials of each motor's command behind a lag.
    """

    states = 4
    others = 0, 1
    parameters = (
        Spec('time_constant', 's', spread=0.7, centre=math.log(0.05), log=True,
             starts=(0.02, 0.05, 0.15)),
        *(Spec(f'motor_{i + 1}_{k}', 'rad/s', spread=0.1) for i, k in GYRO_TERMS),
    )

    def __init__(self) -> None:
        self.shaped('torque', 'throttle', 'shown by the gyro', 'command', 'motors', 'history')

    def prepare(self, data: AxisData) -> Settings | str:
        if data.motors.shape[1] != GYRO_MOTORS:
            return f'it needs the commands of {GYRO_MOTORS} motors'
        low, high = np.percentile(data.training(data.motors), [0.5, 99.5])
        if not high - low > SLOW_MOVES * high:
            return 'the flight holds no motor commands that move'
        middle, half = 0.5 * float(low + high), 0.5 * float(high - low)
        return {'middle': middle, 'half': half}

    def inputs(self, s: Signals, settings: Settings) -> Sequence[FloatArray]:
        return [(motor - settings['middle']) / settings['half'] for motor in required(s.motors)]

    def begin(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        return np.stack(self.inputs(s, settings))

    @property
    def linear(self) -> list[int]:
        return list(range(1, len(self.parameters)))

    def columns(self, s: Signals, p: FloatArray, linear: Sequence[int],
                settings: Settings) -> FloatArray:
        x, dt = required(s.hidden), s.dt
        ahead = self.advance(x, s, p, settings)
        change = (polynomials(ahead) - polynomials(x)) / dt
        return np.stack([change[i, ..., k] for i, k in GYRO_TERMS], axis=-1)

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        return self.columns(s, p, self.linear, settings) @ p[1:]

    def precision(self, settings: Settings, sizes: FloatArray) -> FloatArray:
        fading = [FADES ** (k - 1) for _, k in GYRO_TERMS]
        return np.diag((sizes * np.r_[1.0, fading]) ** -2.0)


REMEMBERED = {
    'torque': ('angle', 'throttle', 'time', 'other angle 1', 'other angle 2'),
    'gain': ('command', 'throttle', 'time'),
    'damping': ('rate', 'throttle', 'time'),
    'friction': ('rate', 'throttle', 'time'),
}
"""Term → the signals whose past it may follow."""


def _relaxing(p: FloatArray, _: Signals) -> System:
    return np.array([[-1.0 / p[0]]]), np.array([1.0])


def _laguerre(p: FloatArray, _: Signals) -> System:
    """Orthogonal states; with eight of them they remember some 16 time constants (Wahlberg 1991).

    There are none of the rate, which would also describe a gyro's coloured noise.
    """
    a, ones = 1.0 / float(p[0]), np.ones((LAGUERRE, LAGUERRE))
    return -a * np.eye(LAGUERRE) - 2.0 * a * np.tril(ones, -1), a * ones[0]


HIDDEN: tuple[Effect, ...] = (
    Summing(
        'mode:slow_state', ('rate', 'history'),
        (
            Spec('time_constant', 's', spread=1.2, centre=math.log(0.5), log=True,
                 starts=(0.05, 0.2, 0.8, 3.0)),
            Spec('stiffness', 'rad/s² per rad'),
        ),
        lambda s, p: -p[1] * required(s.hidden)[0], system=_relaxing, states=1,
    ),
    # in free flight an accelerometer does not see the tilt, so the measured orientation is wrong;
    # the true angle turns the aircraft, and the rate's integral gives it over the memory
    Summing(
        'pendulum_stiffness', ('rate', 'history'),
        (
            Spec('memory', 's', spread=0.7, centre=math.log(30.0), log=True, starts=(15.0, 60.0)),
            Spec('stiffness', 'rad/s² per rad'),
        ),
        lambda s, p: -p[1] * np.sin(required(s.hidden)[0]), system=_relaxing, states=1,
        kind='named', variant='from the rate', axes=AXES,
    ),
    Linear(
        'mode:swinging', ('rate', 'history'),
        (
            Spec('frequency', 'Hz', spread=1.0, centre=math.log(3.0), log=True,
                 starts=tuple(np.geomspace(0.5, 16.0, 14))),
            Spec('damping_ratio', '1', spread=0.8, centre=math.log(0.08), log=True,
                 starts=(0.05, 0.2)),
            Spec('in_phase', '1/s'), Spec('quadrature', '1/s'),
        ),
        lambda s, p: p[2] * required(s.hidden)[0] + p[3] * required(s.hidden)[1],
        system=lambda p, _: ring(float(p[0]), min(float(p[1]), 1.0)), states=2,
    ),
    Hysteresis(),
    *(Load(moved) for moved in LOADS),
    *(Yielding(moved) for moved in ('turning', 'leaning', 'driven')),
    Linear(
        'mode:response', ('command', 'history'),
        (
            Spec('time_constant', 's', spread=0.5, centre=math.log(0.2), log=True,
                 starts=(0.1, 0.3)),
            *(Spec(f'c{i}', UNITS['gain']) for i in range(LAGUERRE)),
        ),
        lambda s, p: np.tensordot(p[1:], required(s.hidden), 1), system=_laguerre, states=LAGUERRE,
        term='gain', inputs=lambda s, _: (s.drive,), size=lambda s, *_: s.drive,
    ),
    *(Memory(term, signal) for term, signals in REMEMBERED.items() for signal in signals),
    *(MemoryCurve(term, signal) for term, signals in REMEMBERED.items() for signal in signals
      if signal != 'time'), Shown(),
)
