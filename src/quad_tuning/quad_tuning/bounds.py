"""Conditions of every design: bounds of each gain, the step of one update, a usable model.

Pure checks; each raises DesignRefusedError with its reason. Gains that pass here pass the bridge's
gate with its default bounds.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from quad_sysid.autopilot_table import AUTOPILOT, TABLES
from quad_sysid.axes import EVERY
from quad_sysid.loop.cascade import TUNED, CascadeGains, contract_names, of_other_firmware
from quad_sysid.loop.from_model import share_outside
from quad_sysid.model import AxisModel
from quad_sysid.units import in_units_of
from quad_tuning.errors import DesignRefusedError
from quad_tuning.gain_table import AXES, CLIMB, DEFAULT_BOUNDS, OPTIONAL, PER_AXIS, Bound, Gain

DESIGNED = (*TUNED, 'd_filter_hz')
"""Fields of CascadeGains that a designer changes; the D filter only if the flight recorded it."""
SIGN_CONFIDENCE = 3.0
"""Least distance of the plant's gain from zero, in standard errors."""
FOREIGN_DRIVE = 0.5
"""Share of another axis' command in this axis' torque from which the motor order is in doubt."""


OUTER = (
    Gain('position.kp', '', '1/s', 'speed reference per error of the position', None,
         bound=Bound(0.05, 3.0)),
    Gain('rate.kp', '', 'rad s/m', 'lean per error of the speed', None, bound=Bound(0.005, 1.0)),
    Gain('rate.ki', '', 'rad/m', 'lean per integral of that error', None,
         bound=Bound(0.0, 1.0, small_step=0.01)),
    Gain('rate.kd', '', 'rad s²/m', 'lean per change of the measured speed', None,
         bound=Bound(0.0, 0.3, small_step=0.01)),
)
"""Of a position hold of the user's own, which stands in no firmware of ours."""
ROWS = {f'{axis}.{row.name}': row for axis in AXES for row in (*PER_AXIS, *OPTIONAL)} | {
    row.name: row for row in CLIMB} | {
    f'{axis}.{row.name}': row for axis, own in EVERY.items() if own.outer for row in OUTER}
"""Contract name of an axis' gain → its row in the bridge's table."""
BOUNDS: dict[str, Bound] = {name: DEFAULT_BOUNDS.get(name, row.bound)
                            for name, row in ROWS.items() if row.bound}
for _axis in AXES:  # more amplifies the gyro's noise
    BOUNDS[f'{_axis}.rate.kd'] = replace(BOUNDS[f'{_axis}.rate.kd'], upper=0.02)


CONSTANT = Bound(0.0, math.inf)
"""Of a filter that a firmware does not have: a design leaves it as it is."""


def bounds_of(axis: str, active: Mapping[str, float]) -> dict[str, Bound]:
    """The hard bounds of an axis' gains, and within them what an autopilot's parameters may be."""
    table = TABLES.get(int(active.get(AUTOPILOT, 0.0)))
    if table is None or axis not in AXES:  # of a loop around it, which is the user's own
        return BOUNDS
    unit, number = active.get(f'{axis}.rate.output_limit', 1.0), AXES.index(axis)
    limits = dict(BOUNDS)
    for name, (low, high) in table.limits(number, (unit, unit, unit)).items():
        bound = BOUNDS[name]
        limits[name] = replace(bound, lower=max(bound.lower, low), upper=min(bound.upper, high))
    return limits


def shared_by_axes(model: AxisModel) -> set[str]:
    """Contract names of the axis' gains that the flown firmware has once, for all axes.

    A design of one axis leaves them as they are, because it does not know the others' margins.
    """
    active, name = model.active_gains, contract_names(model.axis)['d_filter_hz']
    table = TABLES.get(int(active.get(AUTOPILOT, 0.0)))
    if table is None:  # of Betaflight and INAV: a blackbox log's gains
        return {name} if f'{model.axis}.rate.tpa_kp' in active else set()
    return {name} & table.in_common


def check_finite(gains: Mapping[str, float]) -> None:
    """Raise DesignRefusedError naming the first gain that is not a finite number."""
    for name, value in gains.items():
        if isinstance(value, bool) or not math.isfinite(value):
            raise DesignRefusedError(f'{name}: must be finite: found {value}')


def check_bounds(gains: Mapping[str, float], flown: Mapping[str, float] | None = None) -> None:
    """Raise DesignRefusedError naming the first gain outside its hard bounds or unknown.

    A gain of `flown`, and all between it and the bounds, is admissible: it flies.
    """
    check_finite(gains)
    known = flown or {}
    for name, value in gains.items():
        bound = BOUNDS.get(name)
        if bound is None:
            raise DesignRefusedError(f'{name}: is not a gain that a designer may change')
        low, high = _with_flown(bound, known.get(name, bound.lower))
        if not low <= value <= high:
            raise DesignRefusedError(
                f'{name}: must lie in {bound.lower:g} .. {bound.upper:g} '
                f'{ROWS[name].unit}: found {value:g}'
            )


def reachable(field: str, active: float, axis: str) -> tuple[float, float]:
    """Lowest and highest value of one gain (field of CascadeGains) that one update may set."""
    bound = BOUNDS.get(contract_names(axis)[field], CONSTANT)
    (low, high), (least, most) = bound.one_step(active), _with_flown(bound, active)
    return max(low, least), min(high, most)


def _with_flown(bound: Bound, flown: float) -> tuple[float, float]:
    """The hard bounds, and what flies. Of our firmware none flies outside: see `flown_gains`."""
    return min(bound.lower, flown), max(bound.upper, flown)


def by_contract(gains: CascadeGains, axis: str, active: Mapping[str, float]) -> dict[str, float]:
    """The designed gains by the contract's names; without those that `active` lacks."""
    names = {name: field for field, name in contract_names(axis).items() if field in DESIGNED}
    return {name: float(getattr(gains, field)) for name, field in names.items() if name in active}


def steps_to(target: CascadeGains, active: CascadeGains, axis: str) -> tuple[CascadeGains, ...]:
    """The steps from `active` to `target`, each within the limit."""
    path: list[CascadeGains] = []
    now = active
    for _ in range(64):
        if now == target:
            return tuple(path)
        values = {}
        for field in DESIGNED:
            low, high = reachable(field, getattr(now, field), axis)
            values[field] = min(max(getattr(target, field), low), high)
        following = replace(target, **values)
        if following == now:
            break
        now = following
        path.append(now)
    raise DesignRefusedError('the wanted gains lie outside the hard bounds')


LARGEST_RELATIVE_STD = {'gain': 0.2, 'lag': 0.4}
"""Largest relative standard error with which margins over draws are meaningful."""
LARGEST_DELAY_STD_CYCLES = 1.5
LARGEST_OUTSIDE = 0.25
"""Largest acceleration of all that the loop cannot hold, over the drive's."""
MIN_THROTTLE_MARGIN = 0.05
"""Throttle that must be left on either side of the hover."""
BAND_REACH = 2.0
"""Factor (one octave) by which the crossover may leave the model's trusted band."""


def check_model(model: AxisModel) -> None:
    """Refuse a model that its data forbid, with the wrong sign, not finite or too uncertain."""
    own = 'gains are designed for the built-in base only' if model.law else ''
    _refuse(model, filter(None, [model.no_gains_because, own]))
    check_polarity(model)
    _refuse(model, _uncertain(model))


def check_polarity(model: AxisModel) -> None:
    """Refuse a gain of the wrong or an uncertain sign, and a plant driven by another axis.

    If the motors' order is not the mixer's, an axis' command drives it backwards, not at all, or
    less than another axis' command does.
    """
    _refuse(model, _wrong_way(model))


def _refuse(model: AxisModel, reasons: Iterator[str]) -> None:
    """Raise DesignRefusedError for the first reason."""
    for reason in reasons:
        raise DesignRefusedError(f'{model.axis}: {reason}')


def _wrong_way(model: AxisModel) -> Iterator[str]:
    gain = model.in_units(next(p for p in model.base if p.name == 'gain'))
    order = "check the motors' order and spin, and the gyro's axes"
    rate, unit = in_units_of(model.units, 'rate'), gain.unit
    if not math.isfinite(gain.value):
        yield f'the plant gain is {gain.value}; identify again'
    if gain.value <= 0.0:
        yield (f'a positive command lowers the {rate} (plant gain {gain.value:.4g} {unit}, must '
               f'be positive); {order}')
    if gain.std is None or not math.isfinite(gain.std):
        yield ('the plant gain has no standard error, so its sign is not sure; '
               'fly a longer excitation')
    elif gain.value - SIGN_CONFIDENCE * gain.std <= 0.0:
        yield (f'the plant gain {gain.value:.4g} +- {gain.std:.2g} {unit} may be zero or '
               f'negative; {order}, or excite more')
    for effect in model.effects:
        share = next((p.value for p in effect.parameters if p.name == 'fraction'), 0.0)
        if effect.name == 'cross_axis_input' and abs(share) > FOREIGN_DRIVE:
            yield f"another axis' command drives it with {share:.2f} of its own; {order}"


def _uncertain(model: AxisModel) -> Iterator[str]:
    named = [(p.name, p.value) for p in model.base]
    named += [(f'{e.name}.{p.name}', p.value) for e in model.effects for p in e.parameters]
    for name, value in named:
        if not math.isfinite(value):
            yield f'{name} is {value}; identify again'
    names = model.parameter_names
    if model.covariance is None or not names:
        yield 'the model has no covariance, so no margin can be assured; identify again'
    shape = np.shape(np.asarray(model.covariance))
    if shape != (len(names), len(names)):
        yield f'the covariance is {shape}, the parameters are {len(names)}; identify again'
    stds = np.sqrt(np.maximum(np.diag(np.asarray(model.covariance, dtype=float)), 0.0))
    known = dict(zip(names, map(float, stds), strict=True))
    if not math.isfinite(known.get('gain', math.nan)):
        yield 'the covariance lacks the plant gain; identify again'
    for name, largest in LARGEST_RELATIVE_STD.items():
        value, std = model.value(name), known.get(name, math.nan)
        if std > max(largest * abs(value), model.dt if name == 'lag' else 0.0):
            yield (f'{name} {value:.4g} +- {std:.2g} is too uncertain (at most '
                   f'{100 * largest:.0f} %); fly a longer or stronger excitation')
    std = known.get('delay', math.nan)
    if std > LARGEST_DELAY_STD_CYCLES * model.dt:
        yield (f'delay {model.value("delay"):.4g} +- {std:.2g} s is too uncertain (at most '
               f'{LARGEST_DELAY_STD_CYCLES * model.dt:.2g} s); fly a faster excitation')


def check_inside(model: AxisModel) -> None:
    """Refuse a model of which a large part, the sum of all, cannot be in the loop of its axis."""
    shares = share_outside(model)
    if sum(shares.values()) > LARGEST_OUTSIDE:
        raise DesignRefusedError(
            f'{model.axis}: {" and ".join(shares)} may take {100 * sum(shares.values()):.0f} % of '
            'the drive, by motion of the other axes: no margin of this loop holds that; remove '
            'the cause, or tune by hand'
        )


def flown_gains(model: AxisModel) -> CascadeGains:
    """The gains of the flight; refused where they are unknown, out of bounds, or of the LQR."""
    names = [contract_names(model.axis)[field] for field in TUNED]
    missing = [name for name in names if name not in model.active_gains]
    if model.active_gains.get(f'{model.axis}.lqr.share', 0.0) > 0.0:
        raise DesignRefusedError(
            f'{model.axis}: the flight was flown by state feedback ({model.axis}.lqr.share is not '
            '0); a design starts from the cascade: set the share to 0 and fly again'
        )
    if missing:
        raise DesignRefusedError(
            f"{model.axis}: the flight's gains are not known ({missing[0]} missing); record "
            '/gains/active, or state those of a table (quad-sysid import --gain)'
        )
    flown = {name: model.active_gains[name] for name in names}
    if not flown[names[0]]:
        raise DesignRefusedError(
            f'{model.axis}: {names[0]} is 0, so the stick commanded the rate, and a design is of '
            'the loops of rate and angle; fly in a mode that holds the angle, or state its gain'
        )
    check_bounds(flown, flown if of_other_firmware(model.active_gains, model.axis) else None)
    return CascadeGains.from_mapping(model.active_gains, model.axis)


def within_thrust(gains: CascadeGains, model: AxisModel) -> CascadeGains:
    """The gains with the limit of the command that the motors leave about the hover's throttle.

    Raises DesignRefusedError where they leave too little.
    """
    span, hover = EVERY[model.axis].trial.throttle, model.mean_throttle
    if span is None or hover is None:
        return gains
    margin = min(hover - span[0], span[1] - hover)
    if margin < MIN_THROTTLE_MARGIN:
        raise DesignRefusedError(
            f'{model.axis}: it hovers at a throttle of {hover:.2f}, and the loop may use '
            f'{span[0]:g} .. {span[1]:g}: too little is left to climb and sink by'
        )
    return replace(gains, output_limit=min(gains.output_limit, margin))


def check_band(model: AxisModel, crossover_rad_s: float) -> None:
    """Refuse a model whose trusted band does not contain the flown loop's crossover."""
    band = model.trusted_band_rad_s
    if band is None or not math.isfinite(crossover_rad_s):
        return
    low, high = band
    if not low / BAND_REACH <= crossover_rad_s <= high * BAND_REACH:
        raise DesignRefusedError(
            f'{model.axis}: the model is trusted in {low:.2g} .. {high:.2g} rad/s, the loop '
            f'crosses over at {crossover_rad_s:.2g} rad/s; excite that band'
        )
