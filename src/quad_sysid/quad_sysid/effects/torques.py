"""Torques that are one expression of the signals, divided by the axis' inertia: rad/s².

Those of rate and angle, then the couplings from the other two axes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from quad_sysid.contract import AXES, FloatArray
from quad_sysid.model.data import AxisData
from quad_sysid.model.effect import (
    LEAST_TRANSITION,
    TRANSITION,
    Effect,
    Settings,
    Signals,
    Spec,
    per_unit,
    required,
)

BY_LABEL: dict[str, Effect] = {}
"""The package's effects by their labels; it enters them where it joins its tables."""


class Row(Effect):
    """An effect as a row of a table: its law, and what else differs from Effect by name.

    A law has no name in its module, so another process looks the row up by its label.
    """

    law: Callable[..., Any]

    def __init__(self, name: str, signals: tuple[str, ...], parameters: tuple[Spec, ...],
                 law: Callable[..., Any], **more: object) -> None:
        vars(self).update(more, name=name, signals=signals, parameters=parameters, law=law)

    def __reduce__(self) -> tuple[Callable[[str], Effect], tuple[str]]:
        return built_in, (self.label,)


def built_in(label: str) -> Effect:
    """The row of that label: in another process too it is one of the package's."""
    return BY_LABEL[label]


class Torque(Row):
    """A torque, rad/s², by the law of the signals `s` and the parameters (p,)."""

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        return self.law(s, p)


DRY = (Spec('torque', 'rad/s²', positive=True), TRANSITION)
LEAST_CLIMB_M = 0.1
"""Least change of the altitude, m, for the ground effect."""
LEAST_HEIGHT = 0.5
"""Below this share of the least height that was trained on it grows no more."""


def _stribeck(s: Signals, p: FloatArray) -> FloatArray:
    near = np.exp(-((s.rate / max(p[3], LEAST_TRANSITION)) ** 2))
    return (p[0] + p[2] * near) * per_unit('friction', s, p[1])


class GroundEffect(Effect):
    """Thrust that grows near the ground, 1 / (1 - (R / 4 z)²) of what it is far from it.

    R is that of all rotors together (Cheeseman, Bennett 1955), `clearance` the least height z that
    was flown.
    """

    name = 'ground_effect'
    signals = ('angle',)
    term = 'gain'
    axes = ('climb',)
    parameters = (
        Spec('strength', 'm²', spread=0.05, positive=True),  # (R / 4)²; R of 0.9 m
        Spec('clearance', 'm', spread=1.0, centre=math.log(0.3), log=True,
             starts=(0.1, 0.3, 0.8)),
    )

    def prepare(self, data: AxisData) -> Settings | str:
        altitude = data.signal('angle')
        if isinstance(altitude, str):
            return 'the flight holds no altitude'
        altitudes = data.training(altitude)
        if np.ptp(altitudes) < LEAST_CLIMB_M:
            return f'the altitude changes by {np.ptp(altitudes):.2g} m only during training'
        return {'lowest': float(np.min(altitudes))}

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        height = required(s.angle) - settings['lowest'] + p[1]
        square = np.maximum(height, LEAST_HEIGHT * p[1]) ** 2
        # at most doubled, as at z = 0.35 R, where the law of a single source ends
        return p[0] / np.maximum(square - p[0], p[0]) * s.drive

    def readable(self, p: FloatArray, settings: Settings) -> Mapping[str, tuple[float, str]]:
        return {'radius': (4.0 * math.copysign(math.sqrt(abs(p[0])), p[0]), 'm'),
                'ground': (float(settings['lowest'] - p[1]), 'm')}

    def fitted(self, values: Mapping[str, float], settings: Settings) -> FloatArray:
        radius = values['radius']
        return np.array([math.copysign((0.25 * radius) ** 2, radius),
                         settings['lowest'] - values['ground']])


TORQUES: tuple[Effect, ...] = (
    Torque(  # Coulomb 1785
        'coulomb_friction', ('rate',), DRY, lambda s, p: p[0] * per_unit('friction', s, p[1])),
    Torque(  # Armstrong-Hélouvry et al. 1994
        'coulomb_friction', ('rate',),
        (
            *DRY, Spec('static', 'rad/s²', positive=True),
            Spec('stribeck_rate', 'rad/s', spread=1.5, centre=math.log(0.1), log=True,
                 starts=(0.05, 0.4)),
        ),
        _stribeck, variant='stribeck',
    ),
    Torque(
        'quadratic_drag', ('rate',),
        (Spec('coefficient', 'rad/s² per (rad/s)²', positive=True),),
        lambda s, p: -p[0] * s.rate * np.abs(s.rate)),
    Torque(
        'pendulum_stiffness', ('angle',), (Spec('stiffness', 'rad/s² per rad'),),
        lambda s, p: -p[0] * np.sin(required(s.angle)), axes=AXES),
    Torque(
        'cubic_stiffness', ('angle',), (Spec('stiffness', 'rad/s² per rad³'),),
        lambda s, p: -p[0] * required(s.angle) ** 3),
    Torque(  # wells at equal angles, as of magnets or teeth
        'shape:angle', ('angle',),
        (
            Spec('waves', '1/rad', spread=1.0, centre=math.log(40.0), log=True,
                 starts=tuple(np.geomspace(10.0, 200.0, 30))),
            Spec('cosine', 'rad/s²'), Spec('sine', 'rad/s²'),
        ),
        lambda s, p: p[1] * np.cos(p[0] * required(s.angle))
        + p[2] * np.sin(p[0] * required(s.angle)),
        kind='shape', variant='periodic', size=lambda s, *_: per_unit('torque', s)),
    GroundEffect(),
)


def _gyroscopic(other: int) -> Effect:
    return Torque(
        'gyroscopic_coupling', ('other rate',), (Spec('coefficient', '1/s'),),
        lambda s, p: p[0] * required(s.other_rates)[other],
        others=(other,), variant=f'other axis {other + 1}', axes=AXES)


COUPLINGS: tuple[Effect, ...] = (  # paper, eqs. 4 to 6
    _gyroscopic(0), _gyroscopic(1),
    Torque(
        'inertia_coupling', ('product of other rates',), (Spec('coefficient', '1'),),
        lambda s, p: p[0] * required(s.other_rates)[0] * required(s.other_rates)[1],
        others=(0, 1), axes=AXES),
)
