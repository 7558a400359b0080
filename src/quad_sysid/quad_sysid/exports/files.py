"""Identified models as files for other tools: JSON, MATLAB .mat, a Python file for python-control.

The linear plant as matrices, with held command, delay and gyro filter. Nonlinear effects are
listed by name, with parameters and units.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.loop.from_model import loop_plant
from quad_sysid.loop.plant import Slopes, dynamics, state_space
from quad_sysid.model import AxisModel, Parameter

OUTPUTS = ('rate', 'angle')
"""Outputs: rate after the gyro filter, rad/s; angle, rad."""
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
    """Delay of the command, s, not contained in a, b, c."""
    dt: float
    """Control cycle, s."""
    a_discrete: FloatArray
    """(m, m) over one cycle with the delay as states; exact for a held command."""
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


SCHEMA = 'quad_sysid/export/1'
NOTE = (
    'Linear part: d(rate)/dt = gain * (command behind delay and lag) - damping * rate + bias, the '
    'measured rate behind the gyro filter where that is known. The bias and all effects that are '
    'not linear are not in the matrices.'
)


def tree(model: AxisModel) -> dict[str, Any]:
    """Plain values of one axis."""
    found = linear_model(model)
    return {
        'input': 'command', 'input_unit': 'normalised', 'outputs': list(OUTPUTS),
        'output_units': list(OUTPUT_UNITS),
        'base': [_parameter(p) for p in model.base],
        'effects': [
            {'name': e.name, 'parameters': [_parameter(p) for p in e.parameters],
             'settings': {k: v for k, v in e.settings.items() if _plain(v)}}
            for e in model.effects
        ],
        'continuous': {
            'A': found.a.tolist(), 'B': found.b.tolist(), 'C': found.c.tolist(),
            'delay_s': found.delay_s,
        },
        'discrete': {
            'A': found.a_discrete.tolist(), 'B': found.b_discrete.tolist(),
            'C': found.c_discrete.tolist(), 'dt_s': found.dt,
        },
        'trusted_band_rad_s':
            None if model.trusted_band_rad_s is None else list(model.trusted_band_rad_s),
        'gains_flown': {k: v for k, v in model.active_gains.items()
                        if k.startswith((model.axis, 'sensor'))},
    }


def as_json(models: Mapping[str, AxisModel]) -> bytes:
    """All axes as JSON."""
    content = {'schema': SCHEMA, 'note': NOTE, 'axes': {a: tree(m) for a, m in models.items()}}
    return (json.dumps(content, indent=1, allow_nan=False) + '\n').encode()


def as_mat(models: Mapping[str, AxisModel]) -> bytes:
    """All axes as a MATLAB file of version 5: one struct per axis.

    `sys = ss(roll.A, roll.B, roll.C, 0, 'InputDelay', roll.delay_s)`, or of `roll.Ad` … with
    `roll.dt_s`.
    """
    from scipy.io import savemat

    content: dict[str, Any] = {'note': NOTE}
    for axis, model in models.items():
        found = linear_model(model)
        content[axis] = {
            'A': found.a, 'B': found.b, 'C': found.c, 'delay_s': found.delay_s,
            'Ad': found.a_discrete, 'Bd': found.b_discrete, 'Cd': found.c_discrete,
            'dt_s': found.dt, 'outputs': list(OUTPUTS),
            'base': {p.name: p.value for p in model.base},
            'effects': {
                e.name.replace(':', '_'): {p.name: p.value for p in e.parameters}
                for e in model.effects
            },
        }
    stream = io.BytesIO()
    savemat(stream, content, oned_as='column', long_field_names=True)
    return stream.getvalue()


def as_control(models: Mapping[str, AxisModel]) -> bytes:
    """A Python file that needs numpy and control alone, and defines `axes`: name to system."""
    lines = [
        '"""Identified by quad-sysid; for python-control.', '', NOTE, '"""', '',
        'import control', 'import numpy as np', '', 'axes = {}',
    ]
    for axis, model in models.items():
        found = linear_model(model)
        lines += [
            '', (f'# {axis}: normalised command to rate (rad/s) and angle (rad), held over '
            f'{found.dt:g} s,'), f'# the delay of {found.delay_s:.6g} s as states',
            *(f'# {p.name} = {p.value:.6g} {p.unit}' for p in model.base),
            *(f'# not in the matrices: {e.name}.{p.name} = {p.value:.6g} {p.unit}'
              for e in model.effects for p in e.parameters),
            f'axes[{axis!r}] = control.ss(',
            f'    {_matrix(found.a_discrete)},', f'    {_matrix(found.b_discrete)},',
            f'    {_matrix(found.c_discrete)},', f'    0.0, {found.dt!r},',
            f"    inputs=['command'], outputs={list(OUTPUTS)!r}, name={axis!r},", ')',
        ]
    return ('\n'.join(lines) + '\n').encode()


WRITERS: Mapping[str, tuple[Callable[[Mapping[str, AxisModel]], bytes], str]] = {
    'json': (as_json, '.json'), 'mat': (as_mat, '.mat'), 'control': (as_control, '.py'),
}
"""Format → its writer and the file's suffix."""


def _matrix(values: FloatArray) -> str:
    rows = ', '.join(
        '[' + ', '.join(repr(float(v)) for v in row) + ']' for row in np.atleast_2d(values)
    )
    return f'np.array([{rows}])'


def _parameter(p: Parameter) -> dict[str, Any]:
    return {'name': p.name, 'value': p.value, 'std': p.std, 'unit': p.unit}


def _plain(value: object) -> bool:
    return isinstance(value, str | int | float | list | tuple)
