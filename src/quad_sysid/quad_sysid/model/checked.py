"""Effects of a user's own, each tried on made-up signals before any flight is: `checked`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from quad_sysid.contract import motors_from_wrench
from quad_sysid.errors import BadInputError
from quad_sysid.model.data import AxisData, axis_alone
from quad_sysid.model.effect import Effect, Signals, Spec
from quad_sysid.model.flight import Flight
from quad_sysid.model.structure import Structure

SIGNALS = (
    'rate', 'angle', 'command', 'throttle', 'battery', 'time', 'motors', 'direction', 'history',
    *(f'other {signal}{suffix}' for signal in ('rate', 'angle', 'command')
      for suffix in ('', ' 1', ' 2')),
    'product of other rates',
)
"""The words by which an effect says what it depends on (Effect.signals)."""


def checked(effects: object, where: str, library: Sequence[Effect] = ()) -> tuple[Effect, ...]:
    """The effects as a tuple; those that are not in the `library` are tested on made-up signals.

    Raises BadInputError, which names `where` they were listed, for what is no effect, has no name
    or that of another, or whose torque is none.
    """
    try:
        listed: tuple[object, ...] = tuple(effects)  # type: ignore[arg-type]
    except TypeError as error:
        raise BadInputError(where, 'must be a sequence of effects', type(effects).__name__,
                            'put it in brackets: (Mine(),)') from error
    known_as = {effect.label: effect for effect in library}
    by_label: dict[str, Effect] = {}
    for effect in listed:
        if not isinstance(effect, Effect):
            what = f'the class {effect.__name__}' if isinstance(effect, type) else repr(effect)
            raise BadInputError(where, 'must hold instances of quad_sysid.Effect', what,
                                'such as Mine(); the built-in ones are in quad_sysid.EFFECTS')
        other = known_as.get(effect.label)
        if effect.label in by_label or type(other or effect) is not type(effect):
            raise BadInputError(where, 'two effects have one name', effect.label,
                                'give yours a `name` of its own')
        by_label[effect.label] = effect
        if effect is not other:
            _check_fields(effect, f'{where}: {type(effect).__name__}')
            _try(effect, f'{where}: {type(effect).__name__}')
    return tuple(by_label.values())


def _check_fields(effect: Effect, where: str) -> None:
    """Raise BadInputError where the effect lacks what a fit and a report need."""
    for name, kind, remedy in (
        ('signals', str, "what it depends on, such as ('rate',)"),
        ('parameters', Spec, "such as (Spec('torque', 'rad/s²'),)"),
    ):
        value = getattr(effect, name)
        if not (isinstance(value, tuple) and value and all(isinstance(v, kind) for v in value)):
            raise BadInputError(where, f'`{name}` must be a tuple of {kind.__name__}', repr(value),
                                remedy)
    for signal in effect.signals:
        if signal not in SIGNALS:
            raise BadInputError(where, '`signals` holds an unknown one', repr(signal),
                                f'there are {", ".join(SIGNALS)}')
    if not effect.name or not isinstance(effect.name, str):
        raise BadInputError(where, 'has no name', remedy="such as name = 'my_effect'")


def _try(effect: Effect, where: str) -> None:
    """Raise BadInputError where its torque is no array of accelerations, or not linear."""
    linear = np.array([spec.spread is None for spec in effect.parameters])
    start = effect.centre()
    data, s = _made_up()
    steps = np.where(linear, [[1.0], [0.3]], 0.0) * (1.0 + np.arange(start.size))
    try:
        settings = effect.prepare(data)
        if isinstance(settings, str) or effect.states:
            return
        with np.errstate(all='ignore'):
            first, other, joint = (
                effect.torque(s, start + step, settings) for step in (*steps, steps.sum(axis=0))
            )
    except Exception as error:
        raise BadInputError(where, 'cannot be evaluated', f'{type(error).__name__}: {error}',
                            'see docs/extend.md') from error
    if first is None or other is None or joint is None:
        if not effect.moves_command or linear.any():
            raise BadInputError(where, 'adds no torque to which its parameters belong',
                                remedy='write `torque`, or `command` with a `spread` for each')
        return
    if np.shape(first) != s.rate.shape:
        raise BadInputError(where, '`torque` must give an array like s.rate',
                            f'{np.shape(first)} for {s.rate.shape}')
    if not np.isfinite([first, joint]).all():
        raise BadInputError(where, '`torque` must be finite', 'NaN or infinity',
                            'mind rates of 0 and below')
    if linear.any() and not np.allclose(joint, first + other, rtol=1e-6, atol=1e-9):
        names = ', '.join(spec.name for spec in effect.parameters if spec.spread is None)
        raise BadInputError(where, '`torque` is not linear in its parameters', names,
                            'give a `spread` to each that is an exponent, a limit or a frequency')


def _made_up() -> tuple[AxisData, Signals]:
    n, dt = 500, 0.004
    time = dt * np.arange(n, dtype=np.float64)
    wave, other = np.sin(9.0 * time), np.cos(5.0 * time)
    signals = np.stack([other, wave], axis=1)
    control = np.stack([0.5 + 0.1 * other, 0.1 * wave, 0.1 * other, 0.01 * wave], axis=1)
    data = replace(
        axis_alone(0.1 * wave, wave, dt, ((0, n),)), angle=0.1 * other, control=control,
        motors=motors_from_wrench(control), other_rates=signals, other_angles=0.1 * signals,
        battery_v=12.0 - 0.5 * time, validation=((0, n),),
    )
    flight, p = Flight(data, ((0, n),)), np.array([100.0, 0.04, 0.01, 0.0, 0.0])
    return data, flight.signals(Structure(), p, wave)
