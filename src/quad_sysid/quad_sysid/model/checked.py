"""Effects of a user's own, each tried on made-up signals before any flight is read: `checked`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from quad_sysid.contract import FloatArray, motors_from_wrench
from quad_sysid.errors import BadInputError
from quad_sysid.model.data import AxisData, axis_alone
from quad_sysid.model.effect import ActingEffect, Effect, Part, Signals, Spec, required
from quad_sysid.model.flight import Flight
from quad_sysid.model.identified import LAW
from quad_sysid.model.plant import drive_of
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
            tried(effect, f'{where}: {type(effect).__name__}')
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
    names = [spec.name for spec in effect.parameters]
    if len(set(names)) < len(names):
        raise BadInputError(where, 'two parameters have one name', ', '.join(names))
    for spec in effect.parameters:
        follows = spec.spread is None and not spec.log
        if not (follows or 0.0 < (spec.spread or 0.0) < math.inf):
            raise BadInputError(where, f'{spec.name}: `spread` must be a positive number',
                                spec.spread, 'leave it out only where `torque` is linear in it')
    if not effect.name or not isinstance(effect.name, str):
        raise BadInputError(where, 'has no name', remedy="such as name = 'my_effect'")


def tried(effect: Effect, where: str, remedy: str = 'see docs/extend.md') -> None:
    """Raise BadInputError where its laws give no arrays like their signals, or are not linear.

    `remedy`: what helps where one cannot be evaluated.
    """
    linear = np.array([spec.spread is None for spec in effect.parameters])
    start = effect.centre()
    data, s = _made_up()
    steps = np.where(linear, [[1.0], [0.3]], 0.0) * (1.0 + np.arange(start.size))
    try:
        settings = effect.prepare(data)
        if isinstance(settings, str) or max(effect.motors, default=0) >= MOTORS:
            return
        # as a stored model has them: lists and arrays are tuples there
        part = Part(effect, {name: tuple(np.asarray(value).tolist())
                             if isinstance(value, list | np.ndarray) else value
                             for name, value in {**settings}.items()})
        with np.errstate(all='ignore'):
            first, other, joint = (_laws(part, start + step, s)
                                   for step in (*steps, steps.sum(axis=0)))
            some = _laws(part, start + steps[0], s.at(SOME))
    except Exception as error:
        raise BadInputError(where, 'its law cannot be evaluated',
                            f'{type(error).__name__}: {error}', remedy) from error
    if 'torque' not in first and (not effect.moves_command or linear.any()):
        raise BadInputError(where, 'adds no torque to which its parameters belong',
                            remedy='write `torque`, or `command` with a `spread` for each')
    for name, given in first.items():
        rows = {'torque': (), 'command': (), 'advance': first.get('begin', given).shape[:1]}.get(
            name, given.shape[:1])
        law = 'its law' if effect.kind == LAW else f'`{name}`'
        if given.shape != (*rows, s.rate.size):
            raise BadInputError(where, f'{law} must give an array like s.rate'
                                + ', one for each state' * bool(rows),
                                f'{given.shape} for {(*rows, s.rate.size)}')
        if not np.isfinite([given, joint[name]]).all():
            raise BadInputError(where, f'{law} must be finite', 'NaN or infinity',
                                'mind values of 0 and below')
        if not np.allclose(given[..., SOME], some[name], rtol=1e-9, atol=1e-12):
            raise BadInputError(where, f'{law} must take each sample by itself',
                                'a result that depends on other samples',
                                'what it remembers are its `states`')
    if linear.any() and not np.allclose(joint['torque'], first['torque'] + other['torque'],
                                        rtol=1e-6, atol=1e-9):
        names = ', '.join(spec.name for spec in effect.parameters if spec.spread is None)
        raise BadInputError(where, '`torque` is not linear in its parameters', names,
                            'give a `spread` to each that is an exponent, a limit or a frequency')


MOTORS = 4
"""Of the made-up craft."""
SOME = np.arange(500)[::-3]
"""Samples of the made-up signals, in an order of their own."""


def _laws(part: Part, p: FloatArray, s: Signals) -> dict[str, FloatArray]:
    """What an effect makes of signals (n,), which it may not change, by the names of its laws."""
    effect, made = part.effect, dict[str, FloatArray]()
    if effect.wanders:
        s = s.replaced(hidden=np.ones((1, *s.time.shape)))
    elif effect.states:
        made['begin'] = np.array(effect.begin(_fixed(s), p, part.settings))
        s = s.replaced(hidden=made['begin'])
        made['advance'] = np.array(effect.advance(made['begin'], _fixed(s), p, part.settings))
        s = s.replaced(hidden=made['advance'])
    torque = effect.torque(_fixed(s), p, part.settings)
    if torque is not None:
        made['torque'] = np.asarray(torque)
    if effect.moves_command:
        made['command'] = np.asarray(effect.command(s, p, part.settings))
        drive = drive_of([ActingEffect(part, p)], s, lambda *_: s.hidden)
        made['actuate'] = np.concatenate([drive.commands, drive.lag, required(drive.ages)])
    return made


def _fixed(s: Signals) -> Signals:
    """The signals, whose arrays cannot be written to from now on."""
    for value in vars(s).values():
        for array in value if isinstance(value, tuple) else (value,):
            if isinstance(array, np.ndarray):
                array.setflags(write=False)
    return s


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
