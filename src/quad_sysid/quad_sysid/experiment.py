"""Which excitation, within given limits, determines the parameters of a model best.

Each candidate is flown by the model and followed by its Kalman filter; the derivatives of the
innovations by the parameters are the information that the fit would have. Two rivals are
distinguished by `separate`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from quad_sysid.blackbox import Model
from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError, NotInformativeError
from quad_sysid.estimate.fit import Problem
from quad_sysid.estimate.stored import completed, plant_of
from quad_sysid.identified import Identified
from quad_sysid.loop.from_model import usual_signals
from quad_sysid.loop.plant import Flying
from quad_sysid.loop.simulation import simulate_cascade
from quad_sysid.model.effect import SMALL, Signals
from quad_sysid.pipeline.evaluate import NO_GAINS
from quad_sysid.record import IOData
from quad_sysid.result import model_of
from quad_sysid.signals import waveform
from quad_sysid.units import Units

CANDIDATES: Mapping[str, tuple[str, Mapping[str, float]]] = {
    **{f'prbs, clock {clock:g} s': ('prbs', {'clock_s': clock, 'register_bits': 9})
       for clock in (0.02, 0.05, 0.1, 0.25)},
    **{f'square, period {period:g} s': ('square', {'period_s': period})
       for period in (0.4, 1.0, 2.5)},
    'chirp, 0.2 to 8 Hz': ('chirp', {'f0_hz': 0.2, 'f1_hz': 8.0, 'sweep_s': 20.0}),
}
"""What is tried, each at full amplitude and at LOW of it: friction shows in small motion."""
LOW = 0.3
CRITERIA = ('D', 'A')
NEGLIGIBLE = 1e-12
"""What is smaller and has no standard error is no part of the model."""
LEAST = 1e-2
"""Least size of a parameter, of which the step for derivatives is a share."""


@dataclass(frozen=True)
class Experiment:
    """An excitation, and the standard errors that it should lead to."""

    name: str
    """Signal and its parameters."""
    amplitude: float
    """Peak of u, in its unit."""
    dt: float
    u: FloatArray
    """(n,) in its unit, an input every dt s."""
    std_now: Mapping[str, float | None]
    """Standard error of each parameter in the model, in its unit; None where it has none."""
    std_expected: Mapping[str, float]
    """With this experiment added to the data, in its unit; huge where neither tells it."""
    largest_rate: float
    """Largest |rate|, in its unit."""
    largest_angle: float
    """Largest |angle|, in its unit."""
    ranking: tuple[tuple[str, float], ...]
    """Every candidate and its criterion, best first: nats of information (D), or the root mean
    square of the relative standard errors (A)."""

    def __repr__(self) -> str:
        lines = [f'{self.name}, amplitude {self.amplitude:.3g}, {self.u.size * self.dt:g} s']
        for name, now in self.std_now.items():
            std_before = 'unknown' if now is None else f'{now:.2g}'
            lines.append(f'  {name}: standard error {std_before} -> {self.std_expected[name]:.2g}')
        return '\n'.join(lines)


def design_experiment(
    model: Any, *, amplitude: float, rate: float = math.inf, angle: float = math.inf,
    seconds: float = 30.0, criterion: str = 'D',
    progress: Callable[[str], object] = lambda _: None,
) -> Experiment:
    """The excitation of `seconds` that determines the model's parameters best.

    `model`: an identified axis or its result. `amplitude`, `rate`, `angle`: limits of |u| and of
    what the model then does, in the units of its arrays. `criterion`: `D`, the determinant of the
    information, or `A`, the sum of the relative variances. Raises BadInputError for wrong limits,
    NotInformativeError where no candidate stays within them.
    """
    target = model_of(getattr(model, 'model', model))
    if isinstance(target, Model):
        raise BadInputError('design_experiment', 'needs the model of an axis', 'a black box',
                            'design_excitation gives a signal for a band')
    for name, limit in (('amplitude', amplitude), ('rate', rate), ('angle', angle),
                        ('seconds', seconds)):
        if not limit > 0.0:
            raise BadInputError('design_experiment', f'{name} must be positive', limit)
    if criterion not in CRITERIA:
        raise BadInputError('design_experiment', 'criterion must be D or A', repr(criterion))
    units, n = target.units or Units(), round(seconds / target.dt)
    per_u, per_y, per_angle = map(abs, (units.per_command, units.per_rate, units.per_motion))
    names, shapes = [], []
    for name, (signal, parameters) in CANDIDATES.items():
        wave = waveform(signal, parameters, 'design_experiment')
        shape = np.array([wave.at(k * target.dt) for k in range(n)])
        for level in (1.0, LOW):
            names.append(name)
            shapes.append(level * shape)
    progress(f'{len(names)} candidates')
    commands, rates, angles = _within(target, amplitude * per_u * np.array(shapes), rate * per_y,
                                      angle * per_angle)
    every = _values(target)
    active = [i for i, (_, value, std) in enumerate(every) if abs(value) > NEGLIGIBLE or std]
    present = [every[i] for i in active]
    scores = []
    for i, name in enumerate(names):
        progress(name)
        information = _information(target, commands[i], rates[i], angles[i])
        information = information[np.ix_(active, active)]
        scores.append((_score(information, present, criterion), i, information))
    if not any(math.isfinite(score) for score, _, _ in scores):
        raise NotInformativeError('design_experiment: no candidate is informative within these '
                                  'limits; widen them or take longer')
    by_score = sorted(scores, key=lambda entry: -entry[0])
    _, best, information = by_score[0]
    sizes, values, vectors = _in_all(information, present)
    expected = sizes * np.sqrt(vectors**2 @ (1.0 / values))
    sign = 1.0 if criterion == 'D' else -1.0
    scales = {name: abs(target.in_units(replace(p, value=1.0, std=None, interval=None)).value)
              for name, p in target._named}  # noqa: SLF001 - of the same object
    return Experiment(
        name=names[best], amplitude=float(np.abs(commands[best]).max()) / per_u, dt=target.dt,
        u=units.command_in(commands[best]),
        std_now={name: None if std is None else scales.get(name, 1.0) * std
                 for name, _, std in present},
        std_expected={name: scales.get(name, 1.0) * float(value)
                      for (name, *_), value in zip(present, expected, strict=True)},
        largest_rate=float(np.abs(rates[best]).max()) / per_y,
        largest_angle=float(np.abs(angles[best]).max()) / per_angle,
        ranking=tuple((f'{names[i]}, amplitude {np.abs(commands[i]).max() / per_u:.3g}',
                       sign * score) for score, i, _ in by_score))


Known = tuple[str, float, float | None]
"""Name of a parameter as the fit takes it, its value and standard error."""


def _values(model: Identified) -> list[Known]:
    fitted = completed(model)
    structure = fitted.structure
    count = len(structure.names) - len(structure.noise)
    stored = {name: p.std for name, p in model._named}  # noqa: SLF001 - of the same object
    return [(name, float(value), stored.get(name)) for name, value in zip(
        structure.names[:count], structure.natural(fitted.theta), strict=False)]


def _within(model: Identified, commands: FloatArray, rate: float,
            angle: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The largest share of each command (w, n) with which the model stays within the limits."""
    def inside(shares: FloatArray) -> tuple[FloatArray, FloatArray, Any]:
        rates, angles = _flown(model, shares[:, None] * commands)
        within = (np.abs(rates).max(axis=1) <= rate) & (np.abs(angles).max(axis=1) <= angle)
        return rates, angles, within

    most = np.ones(len(commands))
    rates, angles, within = inside(most)
    least = np.where(within, 1.0, 0.0)
    for _ in range(6 if not within.all() else 0):  # halvings of the range: to 2 %
        middle = np.where(least == most, most, 0.5 * (least + most))
        *_, within = inside(middle)
        least, most = np.where(within, middle, least), np.where(within, most, middle)
    rates, angles, within = inside(least)
    within &= least > 0.0
    if not within.any():
        raise NotInformativeError('design_experiment: every candidate signal exceeds the limits, '
                                  'for instance because a constant torque drives the axis away; '
                                  'widen them, or excite in closed loop')
    return np.where(within, least, 0.0)[:, None] * commands, rates, angles


def _flown(model: Identified, commands: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(w, n) measured rates and angles for commands (w, n) from rest, all side by side."""
    usual, n = usual_signals(model), commands.shape[1]
    times = np.asarray(model.dt * (np.arange(n) + 0.5), dtype=np.float64)
    around = Signals.at_rest(times, np.full(n, usual['throttle']),
                             battery_v=np.full(n, usual['battery']))
    run = simulate_cascade(Flying(plant_of(model), around, steady=False), NO_GAINS, np.zeros(n),
                           model.dt, control_excitation=commands)
    return run.rate, run.angle


def _information(model: Identified, command: FloatArray, rate: FloatArray,
                 angle: FloatArray) -> FloatArray:
    """(p, p) of the parameters in their units, from the derivatives of the innovations."""
    fitted, units = completed(model), model.units or Units()
    structure, theta = fitted.structure, fitted.theta
    count = theta.size - len(structure.noise)
    if not command.any():
        return np.zeros((count, count))
    z = IOData(units.command_in(command), units.rate_in(rate), model.dt)
    data, spans = model._data_of(z)  # noqa: SLF001 - of the same object
    still = np.zeros((rate.size, 2))
    problem = Problem(replace(data, angle=angle, other_rates=still, other_angles=still), spans)
    logs = np.array([spec.log for spec in structure.specs])
    steps = SMALL * np.where(logs, 1.0, np.maximum(np.abs(theta), LEAST))
    prediction = problem.flight.predict(structure, theta, sweeps=2, steps=steps)
    if prediction.jacobian is None:
        return np.zeros((count, count))
    values = structure.natural(theta)[:count]
    rows = prediction.jacobian[problem.rows][:, :count] / np.where(logs[:count], values, 1.0)
    return np.asarray(rows.T @ rows * fitted.tail.information / fitted.tail.scale**2)


def _in_all(information: FloatArray, parameters: Sequence[Known]) -> tuple[FloatArray, ...]:
    """Sizes (p,) of the parameters; (p,) and (p, p) eigenvalues and -vectors in units of these.

    Of the information with that of the data so far; what neither holds has next to none.
    """
    sizes = np.array([abs(value) or std or 1.0 for _, value, std in parameters])
    present = np.diag([0.0 if not std else std**-2.0 for _, _, std in parameters])
    values, vectors = np.linalg.eigh((information + present) * np.outer(sizes, sizes))
    return sizes, np.maximum(values, 1e-12), vectors


def _score(information: FloatArray, parameters: Sequence[Known], criterion: str) -> float:
    """What a candidate brings, the more the better; minus infinity for nothing."""
    if not information.any() or not np.isfinite(information).all():
        return -math.inf
    values = _in_all(information, parameters)[1]
    if criterion == 'D':
        return 0.5 * float(np.sum(np.log(values)))
    return -math.sqrt(float(np.mean(1.0 / values)))
