"""An AxisModel as matrices: the linear plant with held command, delay and gyro filter.

Effects that are not linear cannot be matrices; their names, parameters and units go along as they
are. No files.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.loop.from_model import loop_plant
from quad_sysid.loop.plant import Slopes, dynamics, state_space
from quad_sysid.model import AxisModel

OUTPUTS = ('rate', 'angle')
"""rad/s behind the gyro filter, rad."""
OUTPUT_UNITS = ('rad/s', 'rad')


@dataclass(frozen=True)
class LinearModel:
    """One axis from the normalised command to measured rate and angle."""

    axis: str
    a: FloatArray
    """(n, n) continuous, without the delay."""
    b: FloatArray
    """(n, 1)"""
    c: FloatArray
    """(2, n)"""
    delay_s: float
    """Of the command, before a, b, c."""
    dt: float
    """Control cycle, s."""
    a_discrete: FloatArray
    """(m, m) of one cycle, the delay as states; exact for a held command."""
    b_discrete: FloatArray
    """(m, 1)"""
    c_discrete: FloatArray
    """(2, m)"""


def linear_model(model: AxisModel) -> LinearModel:
    """The linear part of a model: base, gyro filter, slow motors and modes; no curves."""
    plant = loop_plant(model)
    a, b, c = dynamics(plant, Slopes())
    cycle = state_space(plant)
    return LinearModel(
        axis=model.axis, a=a, b=b[:, :1], c=c, delay_s=plant.delay_s, dt=plant.dt,
        a_discrete=cycle.a, b_discrete=cycle.b, c_discrete=cycle.c,
    )


def to_control(model: AxisModel) -> Any:
    """A discrete `control.StateSpace` of one cycle, delay included; BadInputError without it."""
    try:
        import control
    except ImportError as error:
        raise BadInputError('export', 'needs the package control', remedy='pip install control'
                            ) from error
    found = linear_model(model)
    return control.ss(
        found.a_discrete, found.b_discrete, found.c_discrete, 0.0, found.dt,
        inputs=['command'], outputs=list(OUTPUTS), name=model.axis,
    )
