"""The identified model of one axis, for the report, a designer, a file.

Frozen values only. estimate/stored.py makes it from a fit and runs it again; report/model_file.py
reads and writes its file.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

from quad_sysid.contract import FloatArray
from quad_sysid.craft import Craft, X
from quad_sysid.errors import BadInputError
from quad_sysid.model.effect import Effect
from quad_sysid.units import Units, with_error


@dataclass(frozen=True)
class Parameter:
    """One estimated number. `std` is None where no ordinary standard error exists (at a bound)."""

    name: str
    value: float
    std: float | None
    unit: str
    interval: tuple[float, float] | None = None
    """95 % interval where there is no `std` (one-sided at a bound); in reports, not stored."""


LAW = 'base'
"""Kind of the law of a base of one's own, which is no effect."""
UNLISTED = 'unlisted_physics'
"""Among an effect's rivals: a cause that the search did not compare with it."""


@dataclass(frozen=True)
class EffectEstimate:
    """An effect that was added to the base, with its parameters (contract, names of effects)."""

    name: str
    kind: str
    """`named`, `shape`, `mode` or `event`."""
    signals: tuple[str, ...]
    parameters: tuple[Parameter, ...]
    variant: str = ''
    """Distinguishes effects of one name, as in quad_sysid.effects."""
    settings: Mapping[str, object] = field(default_factory=dict)
    """Constants that its physics needs (knots, reference voltage)."""
    p_value: float = 1.0
    error_reduction_pct: float = 0.0
    probability: float = 1.0
    rivals: tuple[tuple[str, float], ...] = ()
    """Names of alternatives in its place, with their probabilities; one may be UNLISTED."""
    explains_pct: float = 0.0
    """Share of the squared error between base and reference that it takes away on its rung."""

    @property
    def listed_rivals(self) -> tuple[tuple[str, float], ...]:
        """The alternatives that can be put in its place."""
        return tuple((name, p) for name, p in self.rivals if name != UNLISTED)


@dataclass(frozen=True)
class NoiseEstimate:
    """The noise of a fit, from which its Kalman filter follows."""

    ratios: Mapping[str, float]
    """Noise parameters relative to the gyro's noise; names and units as in structure.NOISE."""
    scale: float
    """Scale of the innovations' Student's t distribution, rad/s."""
    degrees: float
    """Degrees of freedom."""
    gyro_rms: float
    """RMS of the gyro's noise before its filter, rad/s."""
    measured_rms: float
    """RMS of the measurement noise in the recorded rate, rad/s."""
    lines: tuple[tuple[float, float, float], ...] = ()
    """Lines in its noise (structure.LINE): RMS over the gyro's, frequency and width in Hz."""
    averaged: bool = False
    """Whether the gyro's noise is averaged over two cycles (structure.Structure)."""

    @property
    def disturbance_rms(self) -> float:
        """RMS of the torque disturbance, rad/s²."""
        return self.ratios['disturbance'] * self.gyro_rms

    @property
    def correlation_s(self) -> float:
        """Correlation time of the torque disturbance, s."""
        return self.ratios['correlation']


@dataclass(frozen=True)
class RungModel:
    """One rung of the explanation: the base with some effects, projected."""

    base: tuple[Parameter, ...]
    effects: tuple[EffectEstimate, ...]
    noise: NoiseEstimate
    explains_pct: float
    error: float
    """RMS of the free run on the held-out segments, rad/s."""


@dataclass(frozen=True)
class Outside:
    """A signal that leaves the range that it had in the training."""

    signal: str
    seconds: float
    """Time outside the range, s."""
    least: float
    """Smallest value in this flight."""
    most: float
    """Largest value in this flight."""
    low: float
    """Smallest value in the training."""
    high: float
    """Largest value in the training."""

    def __str__(self) -> str:
        return (f'{self.signal} is outside the range of the training for {self.seconds:.2g} s: '
                f'{self.least:.3g} to {self.most:.3g}, trained from {self.low:.3g} to '
                f'{self.high:.3g}')


@dataclass(frozen=True)
class AxisModel:
    """The completed continuous-time model of one axis.

    d(rate)/dt = drive - damping * rate + bias + effects; drive is gain * command after the delay
    and a first-order lag; the measured rate is that after the gyro filter where it is known.
    """

    axis: str
    dt: float
    """Control cycle, s."""
    gyro_filter_hz: float | None
    """Cut-off of the 2nd-order Butterworth filter the model contains, Hz; None: not contained."""
    base: tuple[Parameter, ...]
    """gain (rad/s² per unit command), lag (s), delay (s), damping (1/s), bias (rad/s²)."""
    effects: tuple[EffectEstimate, ...] = ()
    parameter_names: tuple[str, ...] = ()
    """Order of rows and columns of `covariance`: `gain`, …, then `<effect>.<parameter>`."""
    covariance: FloatArray | None = None
    """(p, p) for the gyro filter as modelled (a parameter's `std` also contains the uncertainty
    of the filter's form); NaN rows for parameters without a standard error."""
    active_gains: Mapping[str, float] = field(default_factory=dict)
    """Gains and loop constants of all axes from /gains/active during the flight."""
    mean_battery_v: float | None = None
    mean_throttle: float | None = None
    """U1 in the training."""
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Least and largest value in the training of each signal that the model depends on."""
    noise: NoiseEstimate | None = None
    """Noise of the completed model."""
    trusted_band_rad_s: tuple[float, float] | None = None
    """Band in which the data support the model, rad/s."""
    plain: tuple[Parameter, ...] = ()
    """Rung 0, the base alone, for the error `before`; empty: the base above."""
    plain_noise: NoiseEstimate | None = None
    rungs: tuple[RungModel, ...] = ()
    """The explanation above rung 0; empty where nothing was missing."""
    held_out: tuple[float, float] | None = None
    """RMS errors of the free run and of holding the last rate on the held-out segments, rad/s."""
    reference: AxisModel | None = None
    """The model that predicts best, with which gains are designed; None: this one."""
    no_gains_because: str = ''
    """Why no gains may be designed with it: its data could not tell, or its motors are swapped."""
    craft: Craft = X
    """The airframe: place and spin of each motor."""
    units: Units | None = None
    """Units of the arrays that it was identified from; None: of a bag, the contract's."""
    own_effects: tuple[Effect, ...] = field(default=(), repr=False)
    """Effects from outside quad_sysid.effects that `effects` and rivals may name; the first may be
    the law of a base of one's own, whose parameters are in `base`."""

    def __repr__(self) -> str:
        parts = ' and '.join(effect.name for effect in self.effects)
        return '\n'.join([
            f'{self.axis} at {1.0 / self.dt:.6g} Hz: {self.law.name if self.law else "the base"}'
            + (parts and f' with {parts}'),
            *(f'  {name} {f"{p.value:.4g}" if p.std is None else with_error(p.value, p.std)} '
              f'{p.unit}' for name, p in self.parameters.items()),
        ])

    @property
    def law(self) -> Effect | None:
        """The law of a base of one's own; None of the built-in base."""
        return next((effect for effect in self.own_effects if effect.kind == LAW), None)

    @property
    def parameters(self) -> dict[str, Parameter]:
        """Base and effects by `name` and `effect.name`, in the units of the arrays."""
        return {name: self.in_units(p) for name, p in self._named if self.shows(p)}

    @property
    def predicting(self) -> AxisModel:
        """The model that predicts best."""
        return self.reference or self

    @property
    def noise_rms(self) -> float | None:
        """RMS of the measurement noise of the rate, rad/s."""
        return None if self.noise is None else self.noise.measured_rms

    @property
    def _named(self) -> list[tuple[str, Parameter]]:
        return [(p.name, p) for p in self.base] + [
            (f'{effect.name}.{p.name}', p) for effect in self.effects for p in effect.parameters
        ]

    def is_rung(self, rung: RungModel) -> bool:
        """Whether a rung of the explanation has the effects of this model, in the same forms."""
        laws, own = (sorted((effect.name, effect.variant) for effect in effects)
                     for effects in (rung.effects, self.effects))
        return laws == own

    def in_units(self, p: Parameter) -> Parameter:
        """A parameter in the units of the user's arrays; one of a user's law already is."""
        if self.units is None or (self.law and p.name.startswith(f'{self.law.name}.')):
            return p
        unit, factor = self.units.parameter(p.unit)
        return replace(p, value=factor * p.value, unit=unit,
                       std=None if p.std is None else abs(factor) * p.std,
                       interval=p.interval and (factor * p.interval[0], factor * p.interval[1]))

    def shows(self, p: Parameter) -> bool:
        """Whether a parameter is one of the model, and no built-in term that a law replaces."""
        return self.law is None or p.value != 0.0 or p.std is not None

    def value(self, name: str) -> float:
        """Value of a base parameter, or of `<effect>.<parameter>`."""
        for label, parameter in self._named:
            if label == name:
                return parameter.value
        raise BadInputError('model', 'has no such parameter', repr(name),
                            f'it has {", ".join(label for label, _ in self._named)}')


BEFORE = '_before'
"""Ends the name of a figure of the gains that flew."""


@dataclass(frozen=True)
class GainProposal:
    """A designer's answer: gains of one axis by the contract's names, or why there are none."""

    gains: Mapping[str, float] | None
    """Values by names such as `roll.angle.kp`; None where the design is refused."""
    refused_because: str = ''
    figures: Mapping[str, float] = field(default_factory=dict)
    """Predicted figures: phase_margin_deg, rise_time_s, …; those of the old gains end in
    BEFORE, and so do these gains themselves."""
    left_out: Mapping[str, str] = field(default_factory=dict)
    """Effects that the margins do not hold, and why."""
    steps: tuple[Mapping[str, float], ...] = ()
    """Updates that lead to the target, each within the step limit; the last is the target."""


Designer = Callable[[AxisModel], GainProposal]
"""An entry of the entry point group `quad_sysid.designers`."""
