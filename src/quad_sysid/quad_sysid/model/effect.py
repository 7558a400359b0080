"""What an effect is: its physics, written once, and its parameters.

The same `torque`, `command` or `actuate` serves the fit, the free run, the simulated loop, the
linearisation and the report. All see Signals, whose arrays are (n,) along a flight, (windows,) in
a free run, (flights,) in simulated ones. What an effect remembers are its states, which `advance`
carries from one cycle to the next. The effects themselves are in quad_sysid.effects; nothing is
fitted here.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from quad_sysid.contract import FloatArray
from quad_sysid.model.data import MISSING, AxisData, Span
from quad_sysid.units import Units

Settings = Mapping[str, Any]
Present = TypeVar('Present')


def required(value: Present | None) -> Present:
    """`value`, which an earlier step guarantees, such as a signal that `prepare` has checked."""
    if value is None:
        raise ValueError('what this effect or derivative needs was not provided')
    return value


LEAST_TRANSITION = 1e-4
"""Rate, rad/s, over which dry friction changes its sign at least."""
SHORTEST_S = 1e-5
"""A shorter lag or delay counts as none: no sampled flight shows it."""
SMALL = 1e-4
"""Step of numerical derivatives: of a parameter in its unit or its logarithm, of the rate in
rad/s, of a hidden state relative to its RMS."""


@dataclass(frozen=True)
class Spec:
    """One parameter: its unit, its prior, and where a search starts.

    The prior is normal about `centre` with standard deviation `spread`, in the logarithm where
    `log`. Without a `spread`, `torque` must be linear in the parameter; the standard deviation is
    then the value whose acceleration, at the flight's 97th percentile, is half of the axis' own.
    """

    name: str
    unit: str
    spread: float | None = None
    centre: float = 0.0
    log: bool = False
    positive: bool = False
    """No negative value is physical."""
    starts: tuple[float, ...] = ()
    """Values to start a search from, by default the centre. A search takes a parameter for linear
    that has none, is no logarithm and has its centre at 0."""


@dataclass(frozen=True)
class Signals:
    """The signals that an effect may depend on, arrays of one shape; None where not measured."""

    rate: FloatArray
    """rad/s"""
    angle: FloatArray | None
    """rad"""
    drive: FloatArray
    """Acceleration from the motors, mean over the cycle, rad/s²."""
    command: FloatArray
    """Gain times the delayed command, before the lag, rad/s²."""
    change: FloatArray
    """Rate of change of the drive, rad/s³."""
    lagged: FloatArray
    """The command behind delay and lag, normalised."""
    throttle: FloatArray
    """U1, normalised."""
    battery_v: FloatArray | None
    other_rates: tuple[FloatArray, FloatArray] | None
    """Rates of the other two axes, in the order of AXES, rad/s."""
    other_commands: tuple[FloatArray, FloatArray]
    """Normalised."""
    time: FloatArray
    """s from the first sample, several flights end to end."""
    other_angles: tuple[FloatArray, FloatArray] | None = None
    """rad"""
    motors: tuple[FloatArray, ...] | None = None
    """Commands of the motors, normalised."""
    since_start: FloatArray | None = None
    """s from the first sample of its own flight; None: as `time` (see `own_time`)."""
    hidden: FloatArray | None = None
    """(states, …) hidden states of the effect, if any, at the start of the cycle."""
    sent: FloatArray | None = None
    """The axis' command of this cycle on its way to the motors, normalised; for what acts before
    the torque, which sees it as the effects before it left it."""
    share: FloatArray | None = None
    """(motors,) part of the axis' command that one unit of each motor's command adds."""
    lag: float = 0.0
    """Lag of the base's motors, s."""
    delay: float = 0.0
    """Delay of the base, s."""
    dt: float = 0.0
    """Length of a cycle, s."""

    @property
    def own_time(self) -> FloatArray:
        """Time, s, from the first sample of its own flight."""
        return self.time if self.since_start is None else self.since_start

    @classmethod
    def at_rest(cls, time: FloatArray, throttle: FloatArray, **signals: Any) -> Signals:
        """Signals of three axes at rest, (n,) as `time` in s; `signals` replaces any of them."""
        zero = np.zeros_like(time)
        still = dict.fromkeys(('rate', 'angle', 'drive', 'command', 'change', 'lagged'), zero)
        others = dict.fromkeys(('other_rates', 'other_commands', 'other_angles'), (zero, zero))
        fields: dict[str, Any] = {**still, **others, 'battery_v': None, **signals}
        return cls(time=time, throttle=throttle, **fields)

    def replaced(self, **changes: Any) -> Signals:
        """A copy with these fields changed: dataclasses.replace, which takes ten times as long."""
        other = object.__new__(Signals)
        vars(other).update(vars(self) | changes)
        return other

    def at(self, k: int | NDArray[np.int64]) -> Signals:
        """The signals of one cycle, or of several."""
        fields: dict[str, Any] = {}
        cached: dict[int, FloatArray] = {}  # many are one array, of what is at rest
        for name, value in vars(self).items():
            if isinstance(value, tuple):
                fields[name] = tuple(array[..., k] for array in value)
            elif isinstance(value, np.ndarray) and name != 'share':
                if id(value) not in cached:
                    cached[id(value)] = value[..., k]
                fields[name] = cached[id(value)]
        return self.replaced(**fields)


UNITS = {'torque': 'rad/s²', 'gain': '1', 'damping': '1/s', 'lag': '1', 'delay': 's',
         'friction': 'rad/s²'}
"""Term of the base → the unit in which it changes."""
TRANSITION = Spec('transition', 'rad/s', spread=1.0, centre=math.log(0.005), log=True,
                  starts=(0.003, 0.04))
"""Rate over which friction changes its sign."""


def per_unit(term: str, s: Signals, transition: float = math.exp(TRANSITION.centre)) -> FloatArray:
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
        return -np.tanh(s.rate / max(transition, LEAST_TRANSITION))
    return np.ones_like(s.rate)


@dataclass(frozen=True)
class Drive:
    """Commands between mixer and motors: each channel has a lag and a share of the axis.

    Arrays end in the shape of the signals, (n,) along a flight.
    """

    commands: FloatArray
    """(c, n) normalised, held over a cycle."""
    row: FloatArray
    """(c,) share of each channel in the axis' command."""
    lag: FloatArray
    """(c, n) s."""
    factors: FloatArray = field(default_factory=lambda: np.zeros((1, 2, 6)))
    """(c, 2, 6) knots and values of a curve: the logarithm of a factor on the lag over the
    distance that a motor still has to go. It is zero for channels beyond those given."""
    ages: FloatArray | None = None
    """(2, n) how many cycles ago the commands were sent that act in each cycle, before and after
    they change, linear between two commands; None: by the base's delay."""
    fraction: FloatArray | None = None
    """(n,) share of the cycle before they change."""

    def behind(self, delay: FloatArray) -> Drive:
        """The commands behind a delay (n,), in cycles."""
        delay = np.maximum(delay, 0.0)
        cycles = np.floor(delay + 1e-9)
        return Drive(self.commands, self.row, self.lag, self.factors,
                     np.stack([cycles + 1.0, cycles]), np.maximum(delay - cycles, 0.0))

    def __post_init__(self) -> None:
        missing = self.row.size - len(self.factors)
        if missing:
            more = np.zeros((missing, *self.factors.shape[1:]))
            object.__setattr__(self, 'factors', np.concatenate([self.factors, more]))


class FitResidual(Protocol):
    """The residual of a fit, from which effects take their start values."""

    @property
    def data(self) -> AxisData:
        """The flight."""
        ...

    def lines(self, effect: Effect) -> Sequence[float]:
        """Frequencies (Hz) at which the effect's term swings."""
        ...

    def edges(self) -> Sequence[float]:
        """Times (s) at which a torque may begin or end."""
        ...

    def steps(self) -> Sequence[FloatArray]:
        """Steps in which motors may take their commands, each with one level."""
        ...


class Effect:
    """A physical effect that the base lacks; a subclass changes command, motors or torque."""

    name: str = ''
    kind: str = 'named'
    signals: tuple[str, ...] = ()
    """Names of the signals that the effect depends on; reports draw it over the first."""
    motors: tuple[int, ...] = ()
    """Motors (from 0) that differ from the others; empty: no single one does."""
    axes: tuple[str, ...] = ()
    """The axes that it exists on; none: all."""
    others: tuple[int, ...] = ()
    """The other axes (0, 1) that the effect depends on."""
    term: str = 'torque'
    """The part of the base that it changes: torque, gain, damping, friction, lag, delay, command,
    or response (of the motors)."""
    variant: str = ''
    """Distinguishes effects of one name, such as the other axis of a coupling."""
    parameters: tuple[Spec, ...] = ()
    states: int = 0
    """Number of hidden states, which `advance` drives by the signals; of what acts on single
    motors, of each."""
    happens: bool = False
    """Whether it begins at a time, which a part of the flight may not hold."""
    wanders: bool = False
    """Whether it is a coefficient that the filter follows: noise whose RMS and correlation time
    (s) are the two parameters; `torque` is linear in the coefficient, s.hidden[0], and zero
    without it."""

    def prepare(self, data: AxisData) -> Settings | str:
        """Settings from the training data, or a text: why it cannot be tested on them."""
        why = self.lacking(data)
        if not why and len(self.others) == 1:
            return {'other': data.other_axes[self.others[0]]}
        return why or {}

    def lacking(self, data: AxisData) -> str:
        """Why the data lack what it depends on; empty where they do not."""
        signals = (data.signal(word) for word in self.signal_names
                 if word in MISSING or word.startswith('other'))
        why = next((signal for signal in signals if isinstance(signal, str)), '')
        if not why and 'motors' in self.signals:
            why = data.lacking_motors(single=len(self.motors) == 1)
        return why

    def in_units(self, units: Units | None) -> Effect:
        """The effect for arrays in these units; only the law of a base of one's own has any."""
        del units
        return self

    @property
    def signal_names(self) -> list[str]:
        """The names of its signals for AxisData.signal; what goes one way is left out."""
        names = [s for s in self.signals
                 if s in ('angle', 'throttle', 'battery', 'rate', 'command')]
        kinds = [s.rstrip(' 12') for s in self.signals if s.startswith('other')]
        kinds += ['other rate'] * ('product of other rates' in self.signals)
        return names + [f'{kind} {index + 1}' for kind in kinds for index in self.others]

    def command(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        """Command of the axis after the effect; s.sent is that before it."""
        return required(s.sent)

    def actuate(self, drive: Drive, s: Signals, p: FloatArray, settings: Settings) -> Drive:
        """The motors' lags after the effect."""
        return drive

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray | None:
        """Acceleration that it adds, rad/s²; None: it adds none."""
        return None

    def centre(self) -> FloatArray:
        """(p,) parameters in their units at the centres of their priors; 0 without a spread."""
        return np.array([
            0.0 if spec.spread is None else (np.exp(spec.centre) if spec.log else spec.centre)
            for spec in self.parameters
        ])

    def size(self, s: Signals, j: int, settings: Settings) -> FloatArray:
        """Acceleration per unit of a parameter without a spread, the others at their centre."""
        return self.columns(s, self.centre(), [j], settings)[:, 0]

    def columns(
        self, s: Signals, p: FloatArray, linear: Sequence[int], settings: Settings
    ) -> FloatArray:
        """(n, len(linear)) acceleration per unit of parameters in which it is linear, at p."""
        steps, torque = SMALL * np.eye(p.size)[linear], required(self.torque(s, p, settings))
        torques = [required(self.torque(s, p + step, settings)) - torque for step in steps]
        return np.stack(torques, axis=1) / SMALL

    def starts(self, data: AxisData, settings: Settings) -> Sequence[FloatArray]:
        """Start values in their units; those of parameters taken for linear are ignored."""
        grid = [
            spec.starts or (centre,)
            for spec, centre in zip(self.parameters, self.centre(), strict=True)
        ]
        return [np.array(values) for values in itertools.product(*grid)]

    def starts_by_residual(self, fit: FitResidual, settings: Settings) -> Sequence[FloatArray]:
        """Start values where a fit leaves something, by default `starts`."""
        return self.starts(fit.data, settings)

    def repeats_hz(self, p: FloatArray) -> float:
        """Frequency at which it repeats itself, Hz; 0: it does not.

        Each flight has its own phase, which `in_another_flight` takes.
        """
        return 0.0

    def readable(self, p: FloatArray, settings: Settings) -> Mapping[str, tuple[float, str]]:
        """Name → (value, unit) as a report shows the parameters."""
        return {
            spec.name: (float(value), spec.unit)
            for spec, value in zip(self.parameters, p, strict=True)
        }

    def fitted(self, values: Mapping[str, float], settings: Settings) -> FloatArray:
        """The inverse of `readable`: (p,) parameters in their units."""
        return np.array([values[spec.name] for spec in self.parameters])

    def in_another_flight(self, p: FloatArray, settings: Settings, phase: float) -> FloatArray:
        """Parameters for another flight: for an event the values after it; phase in rad."""
        return p

    def begin(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        """(states, …) hidden states at the start of a flight, of which `s` is the first cycle."""
        return np.zeros((self.states, *s.time.shape))

    def steady(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        """(states, …) hidden states in the middle of a flight, at which a loop is judged."""
        return self.begin(s, p, settings)

    def advance(
        self, x: FloatArray, s: Signals, p: FloatArray, settings: Settings
    ) -> FloatArray:
        """(states, …) hidden states a cycle of s.dt later, for signals held over it."""
        raise NotImplementedError

    def inputs_in_flight(
        self, s: Signals, followed: Callable[[FloatArray], FloatArray]
    ) -> Signals:
        """The signals that move its hidden states along a flight.

        followed: a rate (n,) as it follows the measured one where that is slow.
        """
        return s

    def states_at_start(
        self, data: AxisData, p: FloatArray, settings: Settings
    ) -> FloatArray | None:
        """(states, n) where each stretch begins, by its first sample; None: as `begin` says."""
        return None

    def trace(
        self, s: Signals, p: FloatArray, settings: Settings, stretches: Sequence[Span],
        start_states: FloatArray | None = None,
    ) -> FloatArray:
        """(states, n) hidden states at the start of each cycle, in each stretch from its start.

        What `advance` says of arrays (n,): what it makes of its states is noted once and repeated
        by compiled code.
        """
        from quad_sysid.model import laws  # numba is slow to import
        from quad_sysid.model.traced import Listing, Untraceable

        first = [start_states[:, start] if start_states is not None else
                 self.begin(s.at(start), p, settings) for start, _ in stretches]
        listing, out = Listing(s.time.size), np.zeros((len(first[0]), s.time.size))
        x: Any = listing.inputs(len(out), 1)
        try:
            following = listing.places(self.advance(x, s.replaced(hidden=x), p, settings)).ravel()
        except (Untraceable, TypeError, IndexError, ValueError):
            return self.cycles(s, p, settings, stretches, first)
        code, inputs, indices = listing.repeated(following)
        for (start, stop), begin in zip(stretches, first, strict=True):
            registers = np.array(listing.start)[:, None]
            registers[: len(out), 0] = begin
            laws.carried(code, *listing.numbers(1), registers, inputs[..., None], indices,
                         following, start, stop, out[..., None])
        return out

    def cycles(
        self, s: Signals, p: FloatArray, settings: Settings, stretches: Sequence[Span],
        first: Sequence[FloatArray],
    ) -> FloatArray:
        """The hidden states (states, n) in plain Python, where `advance` cannot be recorded.

        `first` has those (states,) at the start of each stretch.
        """
        out = np.zeros((len(first[0]), s.time.size))
        for (start, stop), begin in zip(stretches, first, strict=True):
            x = begin
            for k in range(start, stop):
                out[:, k] = x
                x = self.advance(x, s.at(k).replaced(hidden=x), p, settings)
        return out

    def longest_s(self, p: FloatArray) -> float:
        """The most by which it makes the delay longer, s."""
        return 0.0

    def usual(self, p: FloatArray, settings: Settings) -> Mapping[str, float]:
        """Signal (`throttle`, `battery`) → the value at which a loop is judged."""
        return {'throttle': settings['throttle']} if 'throttle' in settings else {}

    def precision(self, settings: Settings, sizes: FloatArray) -> FloatArray:
        """(p, p) precision of the prior of its parameters, in the coordinates of the fit.

        sizes (p,): standard deviation of each.
        """
        return np.diag(sizes**-2.0)

    def __repr__(self) -> str:
        kind = type(self).__name__
        return f'{kind}()' if 'name' in vars(type(self)) else f'{kind}({self.label!r})'

    @property
    def linear(self) -> list[int]:
        """The parameters in which `torque` is linear."""
        return [j for j, spec in enumerate(self.parameters) if spec.spread is None]

    @property
    def moves_command(self) -> bool:
        """Whether it acts before the torque."""
        kind = type(self)
        return kind.command is not Effect.command or kind.actuate is not Effect.actuate

    @property
    def remembers_command(self) -> bool:
        """Whether what it remembers follows the command."""
        own_states = bool(self.states) and not self.moves_command
        return 'command' in self.signals and (own_states or 'history' in self.signals)

    @property
    def label(self) -> str:
        """Name and variant."""
        return f'{self.name}/{self.variant}' if self.variant else self.name


def size_of_term(effect: Effect, s: Signals, j: int, settings: Settings) -> FloatArray:
    """The `size` of an effect whose parameters count as one of the term it changes."""
    del j, settings
    return per_unit(effect.term, s)


@dataclass(frozen=True)
class Part:
    """An effect in a structure, with the settings that the training data gave it."""

    effect: Effect
    settings: Settings = field(default_factory=dict)


class ActingEffect(NamedTuple):
    """An effect with its parameters (p,) in their units, as it acts in one flight."""

    part: Part
    p: FloatArray

    @property
    def effect(self) -> Effect:
        """The physics of the effect."""
        return self.part.effect
