"""The aircraft as a whole, from its axes and its hover: what no axis tells alone.

A thrust, a mass and a length of arm enter torque and force as products: with the mass (or the
thrust) and the places of the motors the rest follows. Numbers and how they came about; no files.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from quad_sysid.axes import EVERY
from quad_sysid.contract import FloatArray
from quad_sysid.craft import Craft
from quad_sysid.model import AxisModel, Parameter
from quad_sysid.motion import GRAVITY, in_body, upright
from quad_sysid.record import Record

URDF = 'aircraft.urdf'
"""Its file in the folder of a report."""
LEAST_THROTTLE = 0.05
"""Below it the aircraft does not hover."""
BLOCK_S = 2.0
"""Blocks of hover whose mean throttle carries the weight."""
STEADY = 0.1
"""Share of gravity up to which the mean vertical acceleration of a block is allowed for."""
MIN_SAMPLES = 6
"""Means, or blocks, below which a fit of two numbers says nothing."""
FELL = 0.03
"""Relative change of the voltage that shows what the thrust makes of it."""
SHAKING_S = 0.2
"""Means over so long are without what shakes the accelerometer."""
FREE = 0.5
"""Free flight leaves at most this share of what a rig leaves of the accelerometer unexplained."""
AWAY = 0.3
"""m/s. Spread of a horizontal speed that no rig has."""
NEAR_TRIM = 0.35
"""rad. Leaning further, or turning faster (rad/s), it is not trimmed."""


@dataclass(frozen=True)
class Fact:
    """One number of the aircraft."""

    name: str
    value: float
    unit: str
    how: str
    std: float | None = None


@dataclass(frozen=True)
class Whole:
    """The facts of an aircraft, and its craft with mass and inertia where they follow."""

    facts: tuple[Fact, ...]
    craft: Craft
    is_known: bool = True
    """Whether a description says where its motors are, or a flight recorded them."""

    @property
    def urdf(self) -> str:
        """Its description for other tools; empty where the motors are not known."""
        return self.craft.to_urdf() if self.is_known else ''

    @property
    def tree(self) -> dict[str, object]:
        """The facts as plain values, for report.json."""
        return {'facts': [vars(fact) for fact in self.facts], 'urdf': self.urdf}


def whole_of(models: Mapping[str, AxisModel], records: Sequence[Record],
             mass_kg: float | None = None, thrust_n: float | None = None) -> Whole:
    """The facts of these models and flights; with a mass or the motors' full thrust more."""
    craft = records[0].craft
    mass_kg = craft.mass_kg if mass_kg is None else mass_kg
    facts, climb = [], models.get('climb')
    if climb is not None:
        gain = _base(climb, 'gain')
        if mass_kg is None and thrust_n is not None and gain.value > 0.0:
            mass_kg = thrust_n / gain.value
            facts.append(Fact('mass', mass_kg, 'kg', 'full thrust over the gain of the climb',
                              _times(gain.std, mass_kg / gain.value)))
        elif mass_kg is not None:
            thrust_n = gain.value * mass_kg
            facts.append(Fact('full_thrust', thrust_n, 'N', 'mass times the gain of the climb, '
                              'all motors together, by their slope at hover',
                              _times(gain.std, mass_kg)))
        else:
            facts.append(Fact('thrust_per_mass', gain.value, 'm/s² per unit command',
                              'gain of the climb; with --mass or --thrust the other follows',
                              gain.std))
    if mass_kg is not None and not any(fact.name == 'mass' for fact in facts):
        facts.insert(0, Fact('mass', mass_kg, 'kg', 'as given'))
    free = [record for record in records if flies(record)]
    facts += _hover(free)
    for name in ('climb', 'roll'):
        if name in models:
            lag = _base(models[name], 'lag')
            if lag.std is not None:  # else the data do not determine it
                facts.append(Fact('motor_lag', lag.value, 's', f'of {name}', lag.std))
            break
    inertia = _inertia(models, craft, thrust_n)
    facts += [Fact(f'inertia_{name}', value, 'kg m²', how) for name, value, how in inertia]
    facts += [fact for name in ('surge', 'sway', 'climb') if name in models
              for fact in _drag(models[name], mass_kg)]
    facts += _centre(free, craft)
    if mass_kg is not None and len(inertia) == len(craft.inertia or (0, 0, 0)):
        craft = replace(craft, mass_kg=mass_kg,
                        inertia=tuple(value for _, value, _ in inertia))  # type: ignore[arg-type]
    return Whole(tuple(facts), craft,
                 not craft.nominal or any(record.motors is not None for record in records))


def _base(model: AxisModel, name: str) -> Parameter:
    return next(p for p in model.base if p.name == name)


def _times(std: float | None, factor: float) -> float | None:
    return None if std is None else abs(factor) * std


def _drag(model: AxisModel, mass_kg: float | None) -> list[Fact]:
    """Drag over mass, or drag, of an axis that moves."""
    damping, axis = _base(model, 'damping'), EVERY[model.axis].name
    per, force = (1.0, '1/s') if mass_kg is None else (mass_kg, 'N s/m')
    out = [Fact(f'drag_{axis}', per * damping.value, force,
                'linear in the speed' + ('' if mass_kg else ', over the mass'),
                _times(damping.std, per))]
    for effect in model.effects:
        if effect.name == 'quadratic_drag':
            parameter = effect.parameters[0]
            unit = '1/m' if mass_kg is None else 'N s²/m²'
            out.append(Fact(f'quadratic_drag_{axis}', per * parameter.value, unit,
                            'times the speed squared' + ('' if mass_kg else ', over the mass'),
                            _times(parameter.std, per)))
    return out


def _inertia(models: Mapping[str, AxisModel], craft: Craft,
             thrust_n: float | None) -> list[tuple[str, float, str]]:
    """By axis: torque of the motors per command over the gain, where their arms are known."""
    if craft.inertia is not None:
        return [(axis, value, 'as the description says') for axis, value in
                zip(('roll', 'pitch', 'yaw'), craft.inertia, strict=True)]
    if thrust_n is None or craft.nominal:
        return []
    each, out = thrust_n / craft.count, []
    for column, axis, arms in ((1, 'roll', [m.y for m in craft.motors]),
                               (2, 'pitch', [-m.x for m in craft.motors])):
        gain = _base(models[axis], 'gain').value if axis in models else 0.0
        if gain > 0.0:
            torque = each * float(np.dot(arms, craft.mixer[:, column]))
            out.append((axis, torque / gain, 'thrust times arms over the gain'))
    if len(out) == 2:
        out.append(('yaw', out[0][1] + out[1][1], 'of a flat body: the sum of the other two'))
    return out


def flies(record: Record) -> bool:
    """Whether speed or accelerometer show free flight; False where a rig would look alike.

    On a rig an accelerometer shows gravity, whose direction turns with the attitude; in flight it
    shows the thrust, which stays along z and follows the throttle, until drag holds a fast lean.
    """
    if record.velocity is not None:
        over_ground = record.velocity[:, :2]
        usable = over_ground[np.isfinite(over_ground)]
        if usable.size and usable.std() > AWAY:
            return True
    if record.acceleration is None:
        return False
    thrust, count = record.control[:, 0], max(2, round(SHAKING_S / record.dt))
    angles = np.zeros_like(record.rates) if record.angles is None else record.angles
    gravity = in_body(np.tile((0.0, 0.0, GRAVITY), (record.n, 1)), angles)
    axes = slice(2 if record.angles is None else 0, 3)
    rows = record.n // count * count
    measured, on_rig, thrust = (array[:rows].reshape(rows // count, count, -1).mean(axis=1)
                                for array in (record.acceleration, gravity, thrust))
    usable = np.isfinite(measured + on_rig + thrust).all(axis=1) & (thrust[:, 0] > LEAST_THROTTLE)
    if usable.sum() < MIN_SAMPLES:
        return False
    measured, on_rig, thrust = measured[usable], on_rig[usable], thrust[usable]
    in_flight = GRAVITY * thrust / thrust.mean() * (0.0, 0.0, 1.0)
    left = [(measured - predicted)[:, axes].var(axis=0).sum() for predicted in (in_flight, on_rig)]
    return bool(left[0] < FREE * left[1])


def _hover(records: Sequence[Record]) -> list[Fact]:
    """Throttle of the hover, and what becomes of it as the battery sinks."""
    if not records:
        return []
    throttle, volts = (np.concatenate(parts) for parts in zip(*map(_steady, records), strict=True))
    if throttle.size < MIN_SAMPLES:
        return []
    out = [Fact('hover_throttle', float(np.median(throttle)), '1',
                'median U1 while the vertical speed is steady',
                float(np.std(throttle) / math.sqrt(throttle.size)))]
    is_finite = np.isfinite(volts)
    x, y = np.log(volts[is_finite]), np.log(throttle[is_finite])
    if is_finite.sum() >= MIN_SAMPLES and np.ptp(x) > FELL:
        from scipy.stats import linregress  # slow to import

        line = linregress(x, y)
        out.append(Fact('battery_exponent', -float(line.slope), '1',
                        'thrust follows this power of the voltage, by the throttle of the hover',
                        float(line.stderr)))
    return out


def _steady(record: Record) -> tuple[FloatArray, FloatArray]:
    """(k,) mean throttle and voltage of the blocks in which nothing accelerates upwards."""
    share = np.ones(record.n) if record.angles is None else upright(record.angles)
    lift, size = share * record.control[:, 0], max(2, round(BLOCK_S / record.dt))
    count = record.n // size

    def blocks(values: FloatArray) -> FloatArray:
        return values[: count * size].reshape(count, size)

    up = None if record.velocity is None else record.velocity[:, 2]
    if up is None or not np.isfinite(up).any() or not count:
        return np.zeros(0), np.zeros(0)
    measured = np.flatnonzero(np.isfinite(up))
    speed = blocks(np.interp(np.arange(record.n), measured, up[measured]))
    lifted, volts = blocks(lift), np.full(count, np.nan)
    if record.battery_v is not None:
        volts = blocks(record.battery_v).mean(axis=1)
    # what the block's change of speed took of the lift is given back
    gained = (speed[:, -1] - speed[:, 0]) / (size * record.dt) / GRAVITY
    mean = lifted.mean(axis=1)
    steady = np.isfinite(mean) & (mean > LEAST_THROTTLE) & (np.abs(gained) < STEADY) \
        & (np.abs(speed).max(axis=1) > 0.0)
    return mean[steady] / (1.0 + gained[steady]), volts[steady]


def _centre(records: Sequence[Record], craft: Craft) -> list[Fact]:
    """Where the thrust acts on the whole while nothing turns: there the centre of mass is."""
    places = np.array([[motor.x, motor.y] for motor in craft.motors])
    centres = []
    for record in records:
        if record.motors is None or record.motors.shape[1] != craft.count:
            continue
        total = record.motors.sum(axis=1)
        calm = (total > LEAST_THROTTLE * craft.count) & (
            np.abs(np.nan_to_num(record.rates)).max(axis=1) < NEAR_TRIM)
        if calm.sum() * record.dt > BLOCK_S:
            centres.append((record.motors[calm] @ places) / total[calm, None])
    if not centres:
        return []
    middle = np.concatenate(centres)
    arm = float(np.abs(places).max())
    scale, unit = (100.0 / arm, '% of the arm') if craft.nominal else (1.0, 'm')
    blocks = max(1, round(middle.shape[0] * records[0].dt / BLOCK_S))
    spread = np.std(middle, axis=0) / math.sqrt(blocks)
    return [Fact(f'centre_of_mass_{axis}', float(scale * middle[:, i].mean()), unit,
                 f'{word} of the middle of the motors, by the trim of equal motors',
                 float(scale * spread[i]))
            for i, (axis, word) in enumerate((('x', 'ahead'), ('y', 'left')))]
