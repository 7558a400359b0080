"""A base of one's own in place of gain, lag, delay and damping: its law, its fit, what it lacks.

    motor = Base('motor', states=('speed',), parameters=(
        Quantity('k', 'rad/s² per V', 20.0), Quantity('damping', '1/s', 1.0)),
        rhs=lambda x, u, p: {'speed': p['k'] * u['u'] - p['damping'] * x['speed']})
    found = identify(base=motor, u=volts, y=speed, dt=0.002, units={'u': 'V'})

The law is one more term of a base whose built-in terms are nothing (Structure.law, zero_terms),
so that all that `identify` does is done with it. It is evaluated here, and nothing is fitted.
"""

from __future__ import annotations

import math
import pickle
import secrets
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError, NotInformativeError
from quad_sysid.estimate.fit import Fit, Problem, derivative_steps, start_of
from quad_sysid.model import LAW
from quad_sysid.model.checked import tried
from quad_sysid.model.data import AxisData, Span
from quad_sysid.model.effect import Effect, Part, Settings, Signals, Spec, required
from quad_sysid.model.structure import BASE
from quad_sysid.units import Units

Values: TypeAlias = Mapping[str, Any]
"""By name: (n,) states and inputs in the units of the arrays, or numbers."""
Law: TypeAlias = Callable[[Values, Values, Values], Mapping[str, Any]]
"""rhs(x, u, p) → the derivative of each state, per s."""
Step: TypeAlias = Callable[[Values, Values, Values, float], Mapping[str, Any]]
"""step(x, u, p, dt) → each state a cycle later."""

BUILT_IN_TERMS = tuple(spec.name for spec in BASE)
SIGNALS = ('battery', 'throttle', 'time')
"""Inputs beside the first, which is u; the time of each flight begins at 0."""
COLLINEAR = 3e-3
"""Smallest over largest singular value of scaled sensitivities, below which two are one."""
PARTNER_SHARE = 0.3
"""Share of a direction from which on a parameter is named with its partners."""


@dataclass(frozen=True)
class Quantity:
    """One parameter of a base: its unit, where the search starts, and how far it may be off."""

    name: str
    unit: str
    start: float
    positive: bool = True
    """Whether the prior is on the logarithm and `spread` a factor; else both are in its unit."""
    spread: float | None = None
    """One standard deviation; default: a factor of 10, or the size of the start (1 for 0)."""

    @property
    def spec(self) -> Spec:
        """The parameter as the fit takes it."""
        if self.positive:
            return Spec(self.name, self.unit, math.log(self.spread or 10.0),
                        math.log(self.start), log=True)
        return Spec(self.name, self.unit, self.spread or abs(self.start) or 1.0, self.start)


@dataclass(frozen=True)
class Base:
    """States, inputs and parameters of an axis, and the law that moves it."""

    name: str
    states: tuple[str, ...]
    parameters: tuple[Quantity, ...]
    rhs: Law | None = None
    """Either this or `step`; both are called with arrays (n,)."""
    step: Step | None = None
    output: str = ''
    """The measured rate; default: the first state."""
    position: str = ''
    """The state whose derivative is the output, measured as the angle; no law need give it."""
    inputs: tuple[str, ...] = ('u',)
    """Name of the array u, then of `battery`, `throttle`, `time`, where the law needs them."""
    keep: tuple[str, ...] = ()
    """Terms of the built-in base that are fitted too: gain, lag, delay, damping, bias. By `lag`
    and `delay` the law sees u behind them."""

    def __post_init__(self) -> None:
        """Check the names, and the law at the start; raises BadInputError."""
        where = f'base {self.name}'.rstrip()
        object.__setattr__(self, 'output', self.output or (self.states or ('',))[0])
        for name, words in (('states', self.states), ('inputs', self.inputs),
                            ('parameters', tuple(p.name for p in self.parameters))):
            if not words or len(set(words)) < len(words):
                raise BadInputError(where, f'{name} must be a tuple of different names', words)
        if (self.rhs is None) == (self.step is None):
            raise BadInputError(where, 'needs one of rhs and step')
        for parameter in self.parameters:
            start = parameter.start
            if not math.isfinite(start) or (parameter.positive and start <= 0.0):
                raise BadInputError(where, f'{parameter.name} must start at a positive number',
                                    start, 'or say positive=False')
        for name, word, allowed in (('output', self.output, self.states),
                                    ('position', self.position, ('', *self.states)),
                                    *(('keep', word, BUILT_IN_TERMS) for word in self.keep),
                                    *(('inputs', word, SIGNALS) for word in self.inputs[1:])):
            if word not in allowed:
                raise BadInputError(where, f'{name} must be among '
                                    f'{", ".join(filter(None, allowed))}', repr(word))
        tried(self.law(), where, 'it takes x, u, p by name and returns a dict')

    def law(self, units: Units | None = None) -> Effect:
        """The law as a stored model needs it: from_json(text, effects=(base.law(),)).

        units: of the arrays; a stored model knows those that it was identified from.
        """
        return _Law(self, units or Units())

    def problem(self, data: AxisData, units: Units | None) -> Problem:
        """The training with this base. Raises BadInputError where a signal was not measured."""
        law = self.law(units)
        settings = law.prepare(data)
        if isinstance(settings, str):
            raise BadInputError(f'base {self.name}', 'needs what was not measured', settings)
        zero_terms = [i for i, name in enumerate(BUILT_IN_TERMS) if name not in self.keep]
        return Problem(data, data.train, law=Part(law), zero_terms=zero_terms)

    @property
    def hidden(self) -> tuple[str, ...]:
        """States that are neither the output nor its position."""
        return tuple(s for s in self.states if s not in (self.output, self.position))

    def moved(self, x: Values, u: Values, p: Values, dt: float) -> dict[str, Any]:
        """The derivative of each state, per s, at mid-cycle; of a `step`, its mean over it."""
        if self.rhs is not None:
            return dict(self.rhs(x, u, p))
        start, half = dict(x), 0.5 * dt
        if self.position:
            start[self.position] = x[self.position] - half * x[self.output]
        for _ in range(3):  # to what the rate at mid-cycle says of that at the start
            later = required(self.step)(start, u, p, dt)
            slope = {name: (value - start[name]) / dt for name, value in later.items()}
            start[self.output] = x[self.output] - half * slope[self.output]
        return slope


class _Law(Effect):
    """A base's law as an effect."""

    kind = LAW

    def in_units(self, units: Units | None) -> Effect:
        """The same law for arrays in other units."""
        return self.base.law(units)

    def __init__(self, base: Base, units: Units) -> None:
        self.base, self.units, self.name = base, units, base.name
        self.parameters = tuple(parameter.spec for parameter in base.parameters)
        self.states = len(base.hidden)
        self.signals = ('rate', 'command', *(['angle'] if base.position else []),
                        *(s for s in SIGNALS if s in base.inputs),
                        *(['history'] if base.hidden else []))
        self.number = secrets.randbits(62)
        _LAWS[self.number] = self

    def __reduce__(self) -> tuple[Any, ...]:
        """By its number in this process and those forked of it; elsewhere by its base."""
        try:
            stored = pickle.dumps((self.base, self.units))
        except (pickle.PicklingError, AttributeError, TypeError):  # a law in a lambda
            stored = b''
        return _law_of, (self.number, stored)

    def _states_and_inputs(self, s: Signals, settings: Settings
                           ) -> tuple[dict[str, Any], dict[str, Any]]:
        """States that are measured and inputs, in the units of the arrays."""
        base, units = self.base, self.units
        x: dict[str, Any] = {base.output: s.rate / units.per_rate}
        if base.position:
            x[base.position] = required(s.angle) / units.per_motion
        sent = np.zeros_like(s.lagged) if settings.get('silent') else s.lagged
        u: dict[str, Any] = {base.inputs[0]: (sent - units.zero_command) / units.per_command}
        signals = {'battery': s.battery_v, 'throttle': s.throttle, 'time': s.own_time}
        return x, u | {name: signals[name] for name in base.inputs[1:]}

    def _named(self, p: FloatArray) -> dict[str, float]:
        return {parameter.name: float(value) for parameter, value in zip(
            self.base.parameters, p, strict=True)}

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray | None:
        """Acceleration, rad/s²; silent: without a command."""
        x, u = self._states_and_inputs(s, settings)
        x |= {name: required(s.hidden)[i] for i, name in enumerate(self.base.hidden)}
        slope = self.base.moved(x, u, self._named(p), s.dt or 1e-3)[self.base.output]
        out = np.empty(s.rate.shape)
        out[...] = self.units.per_rate * np.asarray(slope)
        return out

    def _step(self, hidden: Any, x: Values, u: Values, p: Values, dt: float) -> list[Any]:
        """Hidden states a cycle later: by the midpoint rule, or by the base's step."""
        names = self.base.hidden
        slope = self.base.moved({**x, **dict(zip(names, hidden, strict=True))}, u, p, dt)
        if self.base.step is None:
            middle = {name: h + 0.5 * dt * slope[name] for name, h in zip(
                names, hidden, strict=True)}
            slope = self.base.moved({**x, **middle}, u, p, dt)
        return [h + dt * slope[name] for name, h in zip(names, hidden, strict=True)]

    def advance(self, x: FloatArray, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        """Hidden states a cycle later."""
        return np.stack(self._step(x, *self._states_and_inputs(s, settings), self._named(p), s.dt))

    def cycles(self, s: Signals, p: FloatArray, settings: Settings, stretches: Sequence[Span],
               first: Sequence[FloatArray]) -> FloatArray:
        """As Effect, from number to number."""
        named, out = self._named(p), np.zeros((self.states, s.time.size))
        x, u = self._states_and_inputs(s, settings)
        for (start, stop), begin in zip(stretches, first, strict=True):
            hidden = [*begin]
            for k in range(start, stop):
                out[:, k] = hidden
                hidden = self._step(hidden, {name: value[k] for name, value in x.items()},
                                    {name: value[k] for name, value in u.items()}, named, s.dt)
        return out


_LAWS: dict[int, _Law] = {}


def _law_of(number: int, stored: bytes) -> _Law:
    if number in _LAWS:
        return _LAWS[number]
    if not stored:
        raise BadInputError('base', 'its law cannot be read in another process', 'a lambda',
                            'write it as a function of a module')
    return _Law(*pickle.loads(stored))  # noqa: S301 - what __reduce__ wrote


def lacking(base: Base, problem: Problem, fitted: Fit | None = None) -> tuple[str, ...]:
    """Parameters that these data cannot give, each with its partners, at a fit of the base.

    Where the innovations do not move, or move alike. Without a fit at the start values; raises
    NotInformativeError where the law runs away there.
    """
    structure, theta = (problem.plain, start_of(problem)) if fitted is None else (
        fitted.structure, fitted.theta)
    sizes, where = problem.sizes(structure), structure.placed[0][1]
    prediction = problem.flight.predict(structure, theta, sweeps=3, steps=derivative_steps(sizes))
    if prediction.jacobian is None:
        raise NotInformativeError(f'base {base.name}: it runs away at the start values; start '
                                  'nearer, or simulate it first')
    names = [parameter.name for parameter in base.parameters]
    columns = prediction.jacobian[problem.rows][:, where] * sizes[where]
    length = np.linalg.norm(columns, axis=0)
    noise = float(np.nanstd(prediction.innovation[problem.rows]))
    lines = [f'{name}: the data do not depend on it' for name, size in zip(
        names, length, strict=True) if size < noise]
    moving = [i for i, size in enumerate(length) if size >= noise]
    if len(moving) > 1:
        _, values, basis = np.linalg.svd(columns[:, moving] / length[moving], full_matrices=False)
        for value, way in zip(values, basis, strict=True):
            if value < COLLINEAR * values[0]:
                first, *rest = (names[moving[i]] for i in np.argsort(-np.abs(way))
                                if abs(way[i]) > PARTNER_SHARE)
                lines.append(f'{first}: only together with {" and ".join(rest)}; hold one of them')
    return tuple(lines)
