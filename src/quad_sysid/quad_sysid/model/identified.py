"""The identified model of one axis, as it is handed on: to the report, to a designer, to a file.

Frozen values only: how a fit becomes one, and how it is run again, stands in estimate/stored.py,
its file in report/model_file.py.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from quad_sysid.contract import FloatArray
from quad_sysid.model.effect import Effect


@dataclass(frozen=True)
class Parameter:
    """One estimated number. `std` is None where no ordinary standard error exists (at a bound)."""

    name: str
    value: float
    std: float | None
    unit: str
    interval: tuple[float, float] | None = None
    """95 %, where `std` does not give it: at a bound one-sided. Told in reports, not stored."""


@dataclass(frozen=True)
class EffectEstimate:
    """An effect that was added to the base, with its parameters (contract, names of effects)."""

    name: str
    kind: str
    """`named`, `shape`, `mode` or `event`."""
    signals: tuple[str, ...]
    parameters: tuple[Parameter, ...]
    variant: str = ''
    """Tells effects of one name apart, as in quad_sysid.effects."""
    settings: Mapping[str, object] = field(default_factory=dict)
    """What is not estimated but needed to run it again (knots, reference voltage)."""
    p_value: float = 1.0
    error_reduction_pct: float = 0.0
    probability: float = 1.0
    rivals: tuple[tuple[str, float], ...] = ()
    """Names of what explains the data nearly as well, with probabilities."""


@dataclass(frozen=True)
class NoiseEstimate:
    """The noise of a fit: what its Kalman filter follows from, and how large it is."""

    ratios: Mapping[str, float]
    """White torque noise, torque disturbance and so on over the gyro's noise, as named and with
    the units of plant.NOISE."""
    scale: float
    """Of the innovations' distribution, Student's t, rad/s."""
    degrees: float
    """Its degrees of freedom."""
    gyro_rms: float
    """RMS of the gyro's noise before its filter, rad/s."""
    measured_rms: float
    """RMS of the measurement noise in the recorded rate, rad/s."""
    lines: tuple[tuple[float, float, float], ...] = ()
    """Lines of vibration in the recorded rate: RMS over the gyro's noise, frequency, width, Hz."""

    @property
    def disturbance_rms(self) -> float:
        """RMS of the torque disturbance, rad/s²."""
        return self.ratios['disturbance'] * self.gyro_rms

    @property
    def correlation_s(self) -> float:
        """Correlation time of the torque disturbance, s."""
        return self.ratios['correlation']


@dataclass(frozen=True)
class AxisModel:
    """The completed continuous-time model of one axis.

    d(rate)/dt = drive - damping * rate + bias + effects, where drive is gain * command behind the
    delay and a first-order lag; the measured rate is behind the gyro filter where that is known.
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
    """(p, p) behind the gyro filter as it is modelled, where a parameter's `std` also holds what
    is not known of its form; NaN rows for parameters that have no ordinary standard error."""
    active_gains: Mapping[str, float] = field(default_factory=dict)
    """What /gains/active said during the flight, all axes and loop constants."""
    mean_battery_v: float | None = None
    noise: NoiseEstimate | None = None
    """Of the completed model."""
    trusted_band_rad_s: tuple[float, float] | None = None
    """Where the data support the model, rad/s."""
    plain: tuple[Parameter, ...] = ()
    """The base fitted alone, what `before` is measured with; empty: the base above."""
    plain_noise: NoiseEstimate | None = None
    own_effects: tuple[Effect, ...] = field(default=(), repr=False)
    """Effects beside those of quad_sysid.effects that `effects` and their rivals may name."""

    @property
    def noise_rms(self) -> float | None:
        """RMS of the measurement noise of the rate, rad/s."""
        return None if self.noise is None else self.noise.measured_rms

    def value(self, name: str) -> float:
        """Value of a base parameter, or of `<effect>.<parameter>`."""
        for parameter in self.base:
            if parameter.name == name:
                return parameter.value
        effect_name, _, parameter_name = name.partition('.')
        for effect in self.effects:
            if effect.name == effect_name:
                for parameter in effect.parameters:
                    if parameter.name == parameter_name:
                        return parameter.value
        raise KeyError(name)


@dataclass(frozen=True)
class GainProposal:
    """A designer's answer: gains of one axis on the contract's terms, or why there are none."""

    gains: Mapping[str, float] | None
    """Such as `roll.angle.kp`, `roll.rate.kp`; None where the design is refused."""
    refused_because: str = ''
    figures: Mapping[str, float] = field(default_factory=dict)
    """What the design promises and what the old gains gave: phase_margin_deg, rise_time_s, …,
    each also as `<name>_before`."""
    steps: tuple[Mapping[str, float], ...] = ()
    """The updates that lead to the target, each within the step limit; the last is the target."""
    used: tuple[tuple[str, str], ...] = ()
    """Effect (or rival) and, in words, what the design made of it."""
    schedule: tuple[tuple[float, Mapping[str, float]], ...] = ()
    """Battery voltage, V, and the gains for it, where the plant's gain follows the voltage."""


Designer = Callable[[AxisModel], GainProposal]
"""What the entry point group `quad_sysid.designers` offers."""
