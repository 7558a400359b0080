"""A base of one's own in place of gain, lag, delay and damping: its law, its fit, what it lacks.

    motor = Base('motor', states=('speed',), parameters=(
        Quantity('k', 'rad/s² per V', 20.0), Quantity('damping', '1/s', 1.0)),
        rhs=lambda x, u, p: {'speed': p['k'] * u['u'] - p['damping'] * x['speed']})
    found = identify_base(motor, u=volts, y=speed, dt=0.002, units={'u': 'V'})

The law is an effect beside a built-in base that is held at nothing, so that likelihood, intervals,
candidates and the held-out test are those of `identify`.
"""

from __future__ import annotations

import math
import pickle
import secrets
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from scipy.optimize import least_squares
from threadpoolctl import threadpool_limits

from quad_sysid.arrays import records_of
from quad_sysid.bags import read_bag, split_segments
from quad_sysid.beside import side_by_side
from quad_sysid.contract import FloatArray
from quad_sysid.discover.accept import Unseen, rms
from quad_sysid.discover.base import fitted_from
from quad_sysid.discover.constants import EXPECTED, LEVEL
from quad_sysid.discover.screen import candidates, screen
from quad_sysid.discover.search import extended
from quad_sysid.effects import EFFECTS
from quad_sysid.errors import BadInputError, NotInformativeError
from quad_sysid.estimate import stored
from quad_sysid.estimate.fit import Fit, Problem, covariance
from quad_sysid.identified import Identified
from quad_sysid.model import EffectEstimate, Parameter
from quad_sysid.model.data import AxisData, Span, axis_data
from quad_sysid.model.effect import Effect, Part, Settings, Signals, Spec, required
from quad_sysid.model.structure import BASE, Structure
from quad_sysid.pipeline.usable import check_usable, together
from quad_sysid.record import Record
from quad_sysid.units import Units

Values: TypeAlias = Mapping[str, Any]
"""By name: (n,) states and inputs in the units of the arrays, or numbers."""
Law: TypeAlias = Callable[[Values, Values, Values], Mapping[str, Any]]
"""rhs(x, u, p) → the derivative of each state, per s."""
Step: TypeAlias = Callable[[Values, Values, Values, float], Mapping[str, Any]]
"""step(x, u, p, dt) → each state a cycle later."""

KEPT = tuple(spec.name for spec in BASE)
SIGNALS = ('battery', 'throttle', 'time')
"""Inputs beside the first, which is u."""
NOTHING = 1e-6
"""Standard deviation of what is held."""
MOST_EFFECTS = 4
REFITS = 6
"""Candidates that are fitted on each rung."""
MOST_RUNS = 20
ALIKE = 3e-3
"""Smallest over largest singular value of scaled sensitivities, below which two are one."""
SHOWN = 0.3
"""Share of a direction from which on a parameter is named with its partners."""


@dataclass(frozen=True)
class Quantity:
    """One parameter of a base: its unit, where the search starts, and how far it may be off."""

    name: str
    unit: str
    start: float
    positive: bool = True
    """Its prior is of the logarithm, `spread` a factor; else of the number, `spread` its unit."""
    spread: float | None = None
    """One standard deviation; default: a factor of 10, or the size of the start (1 for 0)."""

    @property
    def spec(self) -> Spec:
        """As the fit takes it."""
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
        for one in self.parameters:
            if not math.isfinite(one.start) or (one.positive and one.start <= 0.0):
                raise BadInputError(where, f'{one.name} must start at a positive number',
                                    one.start, 'or say positive=False')
        for name, word, known in (('output', self.output, self.states),
                                  ('position', self.position, ('', *self.states)),
                                  *(('keep', word, KEPT) for word in self.keep),
                                  *(('inputs', word, SIGNALS) for word in self.inputs[1:])):
            if word not in known:
                raise BadInputError(where, f'{name} must be among '
                                    f'{", ".join(filter(None, known))}', repr(word))
        self._try(where)

    def _try(self, where: str) -> None:
        """Raise BadInputError where the law gives no derivative of each state that needs one."""
        zeros = dict.fromkeys((*self.states, *self.inputs), np.zeros(2))
        try:
            found = self.moved(zeros, zeros, {p.name: p.start for p in self.parameters}, 0.01)
            for name in (self.output, *self.hidden):
                np.broadcast_to(np.asarray(found[name], dtype=float), 2)
        except Exception as error:
            raise BadInputError(where, 'its law cannot be evaluated',
                                f'{type(error).__name__}: {error}',
                                'it takes x, u, p by name and returns a dict') from error

    @property
    def hidden(self) -> tuple[str, ...]:
        """States that are neither the output nor its position."""
        return tuple(s for s in self.states if s not in (self.output, self.position))

    def moved(self, x: Values, u: Values, p: Values, dt: float) -> dict[str, Any]:
        """The derivative of each state, per s; of a `step`, its mean over the cycle."""
        if self.rhs is not None:
            return dict(self.rhs(x, u, p))
        later = required(self.step)(x, u, p, dt)
        return {name: (value - x[name]) / dt for name, value in later.items()}


class _Law(Effect):
    """A base's law as an effect."""

    kind = 'base'

    def __init__(self, base: Base, units: Units) -> None:
        self.base, self.units, self.name = base, units, base.name
        self.parameters = tuple(one.spec for one in base.parameters)
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

    def _seen(self, s: Signals) -> tuple[dict[str, Any], dict[str, Any]]:
        """States that are measured and inputs, in the units of the arrays."""
        base, units = self.base, self.units
        x: dict[str, Any] = {base.output: s.rate / units.per_rate}
        if base.position:
            x[base.position] = required(s.angle) / units.per_motion
        u: dict[str, Any] = {base.inputs[0]: (s.lagged - units.zero_command) / units.per_command}
        known = {'battery': s.battery_v, 'throttle': s.throttle, 'time': s.time}
        return x, u | {name: known[name] for name in base.inputs[1:]}

    def _named(self, p: FloatArray) -> dict[str, float]:
        return {one.name: float(value) for one, value in zip(
            self.base.parameters, p, strict=True)}

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray | None:
        """Acceleration, rad/s²."""
        del settings
        x, u = self._seen(s)
        x |= {name: required(s.hidden)[i] for i, name in enumerate(self.base.hidden)}
        found = self.base.moved(x, u, self._named(p), s.dt or 1e-3)[self.base.output]
        return np.array(np.broadcast_to(self.units.per_rate * np.asarray(found), s.rate.shape),
                        dtype=np.float64)

    def _ahead(self, hidden: Any, x: Values, u: Values, p: Values, dt: float) -> list[Any]:
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
        del settings
        return np.stack(self._ahead(x, *self._seen(s), self._named(p), s.dt))

    def trace(self, s: Signals, p: FloatArray, settings: Settings, stretches: Sequence[Span],
              begun: FloatArray | None = None) -> FloatArray:
        """(states, n) hidden states at the start of each cycle, from number to number."""
        del settings, begun
        named, out = self._named(p), np.zeros((self.states, s.time.size))
        x, u = ({name: value.tolist() for name, value in one.items()} for one in self._seen(s))
        for start, stop in stretches:
            hidden = [0.0] * self.states
            for k in range(start, stop):
                out[:, k] = hidden
                hidden = self._ahead(hidden, {name: value[k] for name, value in x.items()},
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


class _Held(Problem):
    """A problem in which the built-in base's terms are nothing, but for those that are kept."""

    def __init__(self, data: AxisData, keep: Sequence[str]) -> None:
        super().__init__(data, data.train)
        self.held = [i for i, name in enumerate(KEPT) if name not in keep]

    def sizes(self, structure: Structure) -> FloatArray:
        """(p,) prior standard deviations."""
        out = super().sizes(structure)
        out[self.held] = NOTHING
        return out

    def centres(self, structure: Structure) -> FloatArray:
        """(p,) prior means; a lag and a delay of nothing."""
        out = super().centres(structure)
        nothing = np.array([0.0, math.log(1e-5), math.log(1e-7), 0.0, 0.0])
        out[self.held] = nothing[self.held]
        return out


@dataclass(frozen=True)
class OwnRung:
    """One rung of the ladder from the base upwards."""

    effects: tuple[str, ...]
    explains_pct: float
    """Of what the base misses of the last rung, on the training."""
    error: float
    """RMS of the free run over 0.5 s on the held-out data, in the unit of the rate."""
    p_value: float
    """Of its last effect, on the held-out data."""


@dataclass(frozen=True)
class BaseResult:
    """A base of one's own, fitted, completed and judged."""

    model: Identified
    """Runs as any other: simulate, predict, compare, residuals, bode, step, to_control."""
    verdict: str
    """`effects_added`, `no_missing_effect` or `not_searched`."""
    parameters: Mapping[str, Parameter]
    """Of the base's law, in their units, with standard errors."""
    effects: tuple[EffectEstimate, ...]
    """What was added to it."""
    ladder: tuple[OwnRung, ...]
    """From the base alone to the last effect that the held-out data confirm."""
    errors: Mapping[str, float]
    """RMS over free runs of 0.5 s of held-out data: hold, before, after; noise_floor."""
    undetermined: tuple[str, ...]
    """Parameters that the data cannot give, each with its partners."""

    def __str__(self) -> str:
        lines = [f'{self.model.axis}: {self.verdict}']
        lines += [f'  {name} {p.value:.4g}' + ('' if p.std is None else f' ± {p.std:.2g}')
                  + f' {p.unit}' for name, p in self.parameters.items()]
        lines += [f'  {" and ".join(rung.effects) or "the base"}: error {rung.error:.4g}, '
                  f'explains {rung.explains_pct:.0f} %' for rung in self.ladder]
        return '\n'.join([*lines, *(f'  {line}' for line in self.undetermined)])


def undetermined(base: Base, flights: Any = None, **arrays: Any) -> tuple[str, ...]:
    """Before any fit: the parameters that these data cannot give, each with its partners.

    By the sensitivities of the innovations at the start values. Arguments as identify_base.
    """
    data, units, _ = _data(flights, arrays)
    problem, structure, theta = _begun(base, data, units)
    return _undetermined(base, problem, structure, theta)


def identify_base(base: Base, flights: Any = None, *, effects: Sequence[Effect] = EFFECTS,
                  progress: Callable[[str], object] = lambda _: None,
                  **arrays: Any) -> BaseResult:
    """Fit a base of one's own, add what it lacks, and judge it on the held-out data.

    `flights` and the arrays (u, y, dt, t, angle, signals, reference, units, train, validate): as
    identify. `effects`: the candidates, `()` for none. Raises BadInputError for wrong input,
    NotInformativeError where the law cannot be fitted to the data.
    """
    data, units, records = _data(flights, arrays)
    with threadpool_limits(limits=1):
        check_usable(data, records)
        problem, structure, theta = _begun(base, data, units)
        progress(f'fitting {base.name}')
        fitted = fitted_from(problem, structure, theta)
        if fitted is None:
            raise NotInformativeError(f'base {base.name}: its fit diverges from the start values '
                                      'that were given; start nearer, or simulate it first')
        problem.measure(fitted)
        rungs = _ladder(problem, fitted, effects, progress)
        rungs[0] = _as_good_as_it_can_be(problem, fitted, rungs[-1][0]), {}
        progress('held-out data')
        return _judged(base, data, units, problem, rungs, searched=bool(effects))


def _data(flights: Any, arrays: Mapping[str, Any]) -> tuple[AxisData, Units, Sequence[Record]]:
    given = {name: one for name, one in arrays.items() if one is not None}
    axis = given.pop('axis', 'roll')
    if isinstance(flights, str | Path | Record):
        record = flights if isinstance(flights, Record) else read_bag(flights)
        records = [record]
        axis = next((s.axis for s in record.segments if s.role == 'train'), axis)
    else:
        records = records_of(flights, axis=axis, **given)
    records = list(together([split_segments(one, axes=(axis,)) for one in records]))
    return axis_data(records, axis), records[0].units or Units(), records


def _begun(base: Base, data: AxisData, units: Units) -> tuple[_Held, Structure, FloatArray]:
    law = _Law(base, units)
    settings = law.prepare(data)
    if isinstance(settings, str):
        raise BadInputError(f'base {base.name}', 'needs what was not measured', settings)
    problem = _Held(data, base.keep)
    structure = Structure((Part(law, settings),))
    theta = problem.centres(structure)
    if 'gain' in base.keep:
        theta[0] = problem.acceleration / max(float(np.std(problem.data.command)), 1e-9)
    return problem, structure, theta


def _undetermined(base: Base, problem: Problem, structure: Structure,
                  theta: FloatArray) -> tuple[str, ...]:
    """Directions of the law's parameters in which the innovations do not move."""
    sizes = problem.sizes(structure)
    steps = np.where(sizes > 1.0, 1e-4 * sizes, np.where(sizes < 1e-2, 1e-3 * sizes, 1e-4))
    own = structure.slices()[0]
    found = problem.flight.predict(structure, theta, sweeps=3, steps=steps)
    if found.jacobian is None:
        raise NotInformativeError(f'base {base.name}: it runs away at the start values')
    names = [one.name for one in base.parameters]
    columns = found.jacobian[problem.rows][:, own] * sizes[own]
    length = np.linalg.norm(columns, axis=0)
    noise = float(np.nanstd(found.innovation[problem.rows]))
    lines = [f'{name}: the data do not depend on it' for name, size in zip(
        names, length, strict=True) if size < noise]
    moving = [i for i, size in enumerate(length) if size >= noise]
    if len(moving) > 1:
        _, values, ways = np.linalg.svd(columns[:, moving] / length[moving], full_matrices=False)
        for value, way in zip(values, ways, strict=True):
            if value < ALIKE * values[0]:
                first, *rest = (names[moving[i]] for i in np.argsort(-np.abs(way))
                                if abs(way[i]) > SHOWN)
                lines.append(f'{first}: only together with {" and ".join(rest)}; hold one of them')
    return tuple(lines)


def _ladder(problem: Problem, base: Fit, effects: Sequence[Effect],
            progress: Callable[[str], object]) -> list[tuple[Fit, dict[str, float]]]:
    """The fits of the rungs, and of each the odds of the effects that were tried on it."""
    parts = [part for part in candidates(problem, effects)[0]
             if part.effect.moves_command or part.effect.term in ('torque', 'damping', 'friction')]
    counts = Counter(part.effect.name for part in parts)
    rungs: list[tuple[Fit, dict[str, float]]] = [(base, {})]
    for _ in range(MOST_EFFECTS):
        parent = rungs[-1][0]
        known = parent.structure.labels
        rest = [part for part in parts if part.effect.label not in known]
        price = {part.effect.label: math.log(EXPECTED / len(counts) / counts[part.effect.name])
                 for part in rest}
        hopeful = [one for one in screen(problem, parent, rest)
                   if one.nats + price[one.part.effect.label] > 0.0][:REFITS]
        fits = [one for one in side_by_side(
            [partial(extended, problem, parent, one) for one in hopeful]) if one is not None]
        scores = {fit.structure.labels[-1]:
                  fit.evidence - parent.evidence + price[fit.structure.labels[-1]] for fit in fits}
        if not scores or max(scores.values()) <= 0.0:
            break
        best = max(fits, key=lambda fit: scores[fit.structure.labels[-1]])
        total = float(np.logaddexp.reduce([0.0, *scores.values()]))
        odds = {'nothing': math.exp(-total)}
        for fit in fits:
            name = fit.structure.parts[-1].effect.name
            odds[name] = odds.get(name, 0.0) + math.exp(
                scores[fit.structure.labels[-1]] - total)
        rungs.append((best, odds))
        progress(f'added {best.structure.parts[-1].effect.name}')
    return rungs


def _as_good_as_it_can_be(problem: _Held, base: Fit, best: Fit) -> Fit:
    """The base with the parameters that run best over the training's windows of 0.5 s.

    By its likelihood it follows disturbances that are none. Begun from its own parameters and
    from those that it has beside the effects, with the best fit's states; then its noise.
    """
    flight, windows = problem.flight, problem.data.windows(problem.spans)
    own = base.theta.size - len(base.structure.noise)
    free = [i for i in range(own) if i not in problem.held]
    states = best.prediction.states[:, : 4 + 2 * base.structure.lines]
    begun = replace(best.prediction, states=states)

    def errors(values: FloatArray) -> FloatArray:
        theta = base.theta.copy()
        theta[free] = values
        with np.errstate(all='ignore'):
            run = flight.free_run(base.structure, theta, windows, prediction=begun)
        return np.clip(np.nan_to_num(run, nan=1e6), -1e6, 1e6).ravel()

    scale = problem.sizes(base.structure)[free]
    tried = [least_squares(errors, start[free], x_scale=scale, max_nfev=MOST_RUNS)
             for start in ([base.theta] if best is base else [base.theta, best.theta])]
    theta = base.theta.copy()
    theta[free] = min(tried, key=lambda one: float(one.cost)).x
    anew = fitted_from(problem, base.structure, theta, rate=best.rate, still=tuple(range(own)))
    return anew or base


def _judged(base: Base, data: AxisData, units: Units, problem: Problem,
            rungs: Sequence[tuple[Fit, dict[str, float]]], *, searched: bool) -> BaseResult:
    unseen = Unseen(data, data.validation)
    errors = [rms(unseen.errors(fit)) for fit, _ in rungs]
    kept, p_values = 1, [1.0]
    for i in range(1, len(rungs)):
        p = unseen.p_value(rungs[i][0], rungs[i - 1][0])
        if p > LEVEL or errors[i] >= errors[i - 1]:
            break
        kept, p_values = i + 1, [*p_values, p]
    chosen = rungs[kept - 1][0]
    windows = problem.data.windows(problem.spans)
    missed = [float(np.mean(problem.flight.free_run(
        fit.structure, fit.theta, windows, prediction=fit.prediction) ** 2))
        for fit, _ in rungs[:kept]]
    gained = missed[0] - missed[-1]
    explains = [100.0 * (missed[0] - one) / gained if gained > 0.0 else 0.0 for one in missed]
    told = stored.readings(problem, chosen, covariance(problem, chosen))
    noise = stored.noise_of(chosen)
    judged: list[dict[str, Any]] = [{}]
    for i in range(1, kept):
        odds, name = dict(rungs[i][1]), rungs[i][0].structure.parts[-1].effect.name
        judged.append({
            'p_value': p_values[i], 'probability': odds.pop(name), 'rivals': tuple(odds.items()),
            'explains_pct': explains[i] - explains[i - 1],
            'error_reduction_pct': 100.0 * (1.0 - errors[i] / errors[i - 1])})
    found = stored.effects_of(chosen, told, judged)
    law = chosen.structure.parts[0].effect
    model = Identified(
        axis=data.axis, dt=data.dt, gyro_filter_hz=data.gyro_filter_hz,
        base=tuple(p if p.name in base.keep else Parameter(p.name, 0.0, None, p.unit)
                   for p in told.base), effects=found,
        parameter_names=told.names, covariance=told.covariance, noise=noise,
        mean_throttle=float(np.mean(data.training(data.control[:, 0]))), craft=data.craft,
        units=units, own_effects=(law,))
    scale = 1.0 / units.per_rate
    verdict = 'effects_added' if kept > 1 else 'no_missing_effect' if searched else 'not_searched'
    return BaseResult(
        model, verdict, {p.name: p for p in found[0].parameters}, found[1:],
        tuple(OwnRung(tuple(part.effect.name for part in rungs[i][0].structure.parts[1:]),
                      explains[i], scale * errors[i], p_values[i]) for i in range(kept)),
        {'hold': scale * rms(unseen.holding(unseen.windows)), 'before': scale * errors[0],
         'after': scale * errors[kept - 1], 'noise_floor': scale * noise.measured_rms},
        _undetermined(base, problem, rungs[0][0].structure, rungs[0][0].theta))

