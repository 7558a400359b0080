"""The selected black-box models in model.json: `blackbox` beside `axes`, by axis, and back.

The file itself, whole and checked, is model_file.py's business.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from quad_sysid.blackbox import Model
from quad_sysid.errors import BadInputError
from quad_sysid.json_file import read_json

POLYNOMIALS = ('A', 'B', 'C', 'D', 'F')


def tree_of(model: Model) -> dict[str, Any]:
    """A polynomial model as plain values; B with its leading zeros, covariance null if unknown."""
    covariance = model.covariance
    known = covariance is not None and bool(np.isfinite(covariance).all())
    return {
        'structure': model.structure,
        'orders': {name: int(value) for name, value in model.orders.items()},
        'approach': model.approach,
        **{name: [float(x) for x in getattr(model, name)] for name in POLYNOMIALS},
        'nk': int(model.nk),
        'dt': float(model.dt),
        'noise_variance': float(model.noise_variance),
        'parameter_names': list(model.parameter_names),
        'covariance': covariance.tolist() if known and covariance is not None else None,
    }


def load_blackbox(path: str | os.PathLike[str]) -> dict[str, Model]:
    """The black-box models of a model.json by axis; empty where it holds none.

    Raises BadInputError naming file and field where they cannot be read.
    """
    tree = read_json(path)
    axes = tree.get('blackbox', {}) if isinstance(tree, dict) else {}
    if not isinstance(axes, dict):
        raise BadInputError(f'{path}: blackbox', 'must be an object', type(axes).__name__)
    return {axis: _model_of(one, f'{path}: blackbox.{axis}') for axis, one in axes.items()}


def _model_of(tree: Mapping[str, Any], where: str) -> Model:
    try:
        a, b, c, d, f = (np.asarray(tree[name], dtype=float) for name in POLYNOMIALS)
        model = Model(
            structure=str(tree['structure']),
            orders={str(name): int(value) for name, value in tree['orders'].items()},
            approach=str(tree['approach']), nk=int(tree['nk']), dt=float(tree['dt']),
            noise_variance=float(tree['noise_variance']), covariance=tree['covariance'],
            A=a, B=b, C=c, D=d, F=f,
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise BadInputError(where, 'is not a polynomial model', repr(error)) from error
    p = model.parameters.size
    for name in POLYNOMIALS:
        poly = getattr(model, name)
        if poly.ndim != 1 or not poly.size or not np.isfinite(poly).all():
            raise BadInputError(f'{where}.{name}', 'must be a list of finite numbers')
        if name != 'B' and poly[0] != 1.0:
            raise BadInputError(f'{where}.{name}', 'must start with 1', float(poly[0]))
    if not (math.isfinite(model.dt) and model.dt > 0.0):
        raise BadInputError(f'{where}.dt', 'must be a positive number of seconds', model.dt)
    if model.covariance is not None and model.covariance.shape != (p, p):
        raise BadInputError(f'{where}.covariance', f'must be {p} by {p}', model.covariance.shape)
    return model
