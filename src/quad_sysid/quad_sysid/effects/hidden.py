"""Effects with a hidden state: it swings, relaxes, builds up or remembers what a signal was."""

from __future__ import annotations

import math

import numpy as np
from scipy.linalg import expm
from scipy.signal import lfilter

from quad_sysid.contract import FloatArray
from quad_sysid.effects.couplings import over_training
from quad_sysid.effects.curves import (
    ACTS_ON,
    SLOW_MOVES,
    UNITS,
    measured,
    per_unit,
    shape_name,
    signal_of,
)
from quad_sysid.effects.torques import PendulumStiffness
from quad_sysid.model import recursion
from quad_sysid.model.data import AxisData
from quad_sysid.model.effect import Effect, Settings, Signals, Spec, required
from quad_sysid.model.structure import BASE


class Linear(Effect):
    """Hidden states x' = A x + B input; subclasses give A and B."""

    kind = 'mode'
    name = 'mode'

    def driver(self, s: Signals, settings: Settings) -> FloatArray:
        """What drives the states: the rate."""
        return s.rate

    def system(self, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """A (m, m) and B (m,)."""
        raise NotImplementedError

    def _step(self, p: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
        a, b = self.system(p)
        m = b.size
        block = np.zeros((m + 1, m + 1))
        block[:m, :m], block[:m, m] = a * dt, b * dt
        e = expm(block)
        return np.ascontiguousarray(e[:m, :m]), np.ascontiguousarray(e[:m, m])

    def begun(self, data: AxisData, p: FloatArray, settings: Settings) -> FloatArray:
        """(states, n) of which each stretch's first column counts: where the states begin."""
        del p, settings
        return np.zeros((self.states, data.rate.size))

    def trace(
        self, data: AxisData, s: Signals, p: FloatArray, settings: Settings
    ) -> FloatArray:
        a, b = self._step(p, data.dt)
        out, moving = self.begun(data, p, settings), self.driver(s, settings)
        for start, stop in data.stretches:
            recursion.linear_states(moving, a, b, start, stop, out)
        return out

    def advance(
        self, x: FloatArray, s: Signals, p: FloatArray, settings: Settings, dt: float
    ) -> FloatArray:
        a, b = self._step(p, dt)
        return a @ x + b[:, None] * self.driver(s, settings)


class Relaxing(Linear):
    """A first-order state x' = rate - x / tau, an angle that decays."""

    states = 1
    parameters = (
        Spec('time_constant', 's', spread=1.2, centre=math.log(0.5), log=True,
             starts=(0.05, 0.2, 0.8, 3.0)),
        Spec('stiffness', 'rad/s² per rad'),
    )
    excite = 'a PRBS and slow steps of the angle'

    def system(self, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        return np.array([[-1.0 / p[0]]]), np.array([1.0])

    def size(self, s: Signals, j: int, settings: Settings) -> FloatArray:
        return 0.5 * s.rate


class SlowState(Relaxing):
    """A spring in series with a damper (a Maxwell element)."""

    variant = 'slow state'
    signals = ('rate', 'history')
    physics = "-k x, x' = rate - x / tau: a spring on a damper, a load that relaxes"

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        return -p[1] * required(s.hidden)[0]


class Pendulum(SlowState):
    """The pendulum's torque of the integrated rate.

    In free flight an accelerometer does not see the tilt, so the measured orientation is wrong.
    The true angle turns the aircraft; the rate's integral gives it over the memory.
    """

    name = PendulumStiffness.name
    kind = PendulumStiffness.kind
    variant = 'from the rate'
    parameters = (
        Spec('memory', 's', spread=0.7, centre=math.log(30.0), log=True, starts=(15.0, 60.0)),
        *PendulumStiffness.parameters,
    )
    physics = "-k sin(x), x' = rate - x / memory: centre of mass off the axis"
    excite = PendulumStiffness.excite

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        return -p[1] * np.sin(required(s.hidden)[0])


class Swinging(Linear):
    """A second-order mode excited by the rate, such as a swinging load."""

    variant = 'swinging'
    signals = ('rate', 'history')
    states = 2
    parameters = (
        Spec('frequency', 'Hz', spread=1.0, centre=math.log(3.0), log=True,
             starts=tuple(np.geomspace(0.5, 16.0, 14))),
        Spec('damping_ratio', '1', spread=0.8, centre=math.log(0.08), log=True,
             starts=(0.05, 0.2)),
        Spec('in_phase', '1/s'),
        Spec('quadrature', '1/s'),
    )
    physics = "z'' + 2 d w z' + w² z = w² rate; torque in_phase z + quadrature z'/w"
    excite = 'a chirp or PRBS through the mode'

    def system(self, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        w = 2.0 * math.pi * p[0]
        return np.array([[0.0, w], [-w, -2.0 * min(p[1], 1.0) * w]]), np.array([0.0, w])

    def size(self, s: Signals, j: int, settings: Settings) -> FloatArray:
        return s.rate

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        return p[2] * required(s.hidden)[0] + p[3] * required(s.hidden)[1]


class Hysteresis(Effect):
    """Dahl's friction, which builds up over an angle after each reversal."""

    name = 'mode'
    kind = 'mode'
    variant = 'hysteresis'
    signals = ('rate', 'history')
    states = 1
    parameters = (
        Spec('reach', 'rad', spread=1.0, centre=math.log(0.05), log=True,
             starts=(0.01, 0.03, 0.1, 0.3)),
        Spec('torque', 'rad/s²', positive=True),
    )
    physics = "-T x, x' = rate / reach (1 - x sign(rate)): friction that builds up (Dahl 1968)"
    excite = 'small and large motion with many reversals'

    def trace(
        self, data: AxisData, s: Signals, p: FloatArray, settings: Settings
    ) -> FloatArray:
        out = np.zeros((1, s.rate.size))
        for start, stop in data.stretches:
            recursion.built_up(s.rate, data.dt / max(float(p[0]), 1e-4), start, stop, out[0])
        return out

    def advance(
        self, x: FloatArray, s: Signals, p: FloatArray, settings: Settings, dt: float
    ) -> FloatArray:
        way = np.sign(s.rate)
        return way + (x - way) * np.exp(-np.abs(s.rate) * dt / max(float(p[0]), 1e-4))

    def size(self, s: Signals, j: int, settings: Settings) -> FloatArray:
        return np.ones_like(s.rate)

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        return -p[1] * required(s.hidden)[0]


class Memory(Linear):
    """One term of the base follows what a signal has lately been, not what it is.

    Airspeed follows the lean. What a signal's power heats is cold when a flight begins, and the
    base's parameters are those of the usual power; the power of the time is constant.
    """

    kind = 'shape'
    states = 1

    def __init__(self, term: str, signal: str) -> None:
        self.term, self.leans = term, 'angle' in signal
        self.name = shape_name(term, signal)
        self.variant = 'memory' + ' friction' * (term == 'friction')
        if signal.startswith('other'):
            self.variant += f' {signal[-1]}'
            self.others = (int(signal[-1]) - 1,)
        self.signals = (signal, *ACTS_ON[term], 'history')
        self.parameters = (
            Spec('time_constant', 's', spread=1.2, centre=math.log(3.0), log=True,
                 starts=(0.3, 1.5, 8.0, 40.0)),
            Spec('change', UNITS[term]),
        )
        source = '0' if signal == 'time' else f'{signal}² / mean({signal}²) - 1'
        source = signal if self.leans else source
        self.physics = f"{term} + change x, time_constant x' = {source} - x"
        self.excite = f'let {signal} rise and fall slowly while the axis is excited'

    def prepare(self, data: AxisData) -> Settings | str:
        signal = measured(data, self.signals[0])
        if isinstance(signal, str):
            return signal
        if self.signals[0] == 'time':
            return {}
        used = over_training(data, signal)
        if not np.nanstd(used) > SLOW_MOVES * abs(np.nanmean(used)):
            return f'{self.signals[0]} hardly moves during training'
        rest = float(np.nanmean(used)) if self.leans else 0.0
        return {'unit': float(np.nanmean((used - rest) ** 2)), 'rest': rest}

    def driver(self, s: Signals, settings: Settings) -> FloatArray:
        return self._push(signal_of(s, self.signals[0]), settings)

    def _push(self, signal: FloatArray, settings: Settings) -> FloatArray:
        if self.signals[0] == 'time':
            return np.ones_like(signal)
        unit, away = settings['unit'], signal - settings['rest']
        return away / math.sqrt(unit) if self.leans else away**2 / unit

    def begun(self, data: AxisData, p: FloatArray, settings: Settings) -> FloatArray:
        # from the start of the flight on, of which a fit sees segments and a gap ends a stretch
        whole, here = data.source or (data, np.arange(data.rate.size))
        signal = measured(whole, self.signals[0])
        if isinstance(signal, str):
            raise ValueError(signal)  # noqa: TRY004 - why this flight cannot be used
        a, b = self._step(p, data.dt)
        if self.signals[0] == 'command':  # the lag matters little here, and is not known
            keep = math.exp(-data.dt / math.exp(BASE[1].centre))
            signal = lfilter([1.0 - keep], [1.0, -keep], signal)
        push = self._push(np.nan_to_num(signal), settings)
        out = np.zeros((1, push.size))
        for start, stop in whole.flights or ((0, push.size),):
            recursion.linear_states(push, a, b, start, stop, out)
        return np.ascontiguousarray(out[:, here])

    def system(self, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        return np.array([[-1.0 / p[0]]]), np.array([1.0 / p[0]])

    def size(self, s: Signals, j: int, settings: Settings) -> FloatArray:
        return per_unit(self.term, s)

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        x = required(s.hidden)[0] - (not self.leans)
        out: FloatArray = p[1] * x * per_unit(self.term, s)
        return out


REMEMBERED = {
    'torque': ('angle', 'throttle', 'time', 'other angle 1', 'other angle 2'),
    'gain': ('command', 'throttle', 'time'),
    'damping': ('rate', 'throttle', 'time'),
    'friction': ('rate', 'throttle', 'time'),
}
"""Term → the signals whose past it may follow."""

HIDDEN = (
    SlowState(), Pendulum(), Swinging(), Hysteresis(),
    *(Memory(term, signal) for term, signals in REMEMBERED.items() for signal in signals),
)
